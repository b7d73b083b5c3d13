# SPDX-License-Identifier: Apache-2.0
"""Suites, by family: they draw queries and truths from a region, sites and a seed."""
