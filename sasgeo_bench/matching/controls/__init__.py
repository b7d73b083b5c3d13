# SPDX-License-Identifier: Apache-2.0
"""Matchers that every board holds as controls, and the dense matcher that raster baselines build on."""
