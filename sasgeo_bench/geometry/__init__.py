# SPDX-License-Identifier: Apache-2.0
"""Angles, poses and grids."""
