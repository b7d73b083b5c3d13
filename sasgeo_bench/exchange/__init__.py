# SPDX-License-Identifier: Apache-2.0
"""Boards and regions for others: sites, archives, releases, submissions."""
