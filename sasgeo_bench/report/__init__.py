# SPDX-License-Identifier: Apache-2.0
"""Boards: scored rows -> figures with intervals and ranks -> tables for people."""
