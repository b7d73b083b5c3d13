# SPDX-License-Identifier: Apache-2.0
"""The baselines of sasgeo-bench, written as an outsider would write a plugin: one file for each matcher."""
