# SPDX-License-Identifier: Apache-2.0
"""Datasets and metrics of other benchmarks: folders read without a change, metrics as released and as corrected."""
