# SPDX-License-Identifier: Apache-2.0
"""Regions -> queries and their truths: splits, sampling, suites and perturbations."""
