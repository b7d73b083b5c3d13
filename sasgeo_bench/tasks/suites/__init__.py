# SPDX-License-Identifier: Apache-2.0
"""Suites, one file each: they draw queries and truths from a region, sites and a seed."""
