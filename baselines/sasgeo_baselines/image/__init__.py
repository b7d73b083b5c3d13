# SPDX-License-Identifier: Apache-2.0
"""Baselines that look at pictures: they hold the picture of a query against the imagery of a map, without classes."""
