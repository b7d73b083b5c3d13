# SPDX-License-Identifier: Apache-2.0
"""Boards: entries scored, ranked, tabled and drawn; on disk."""
