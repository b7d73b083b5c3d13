# SPDX-License-Identifier: Apache-2.0
"""Runs: matchers in processes of their own, and rows that survive whatever happens to them."""
