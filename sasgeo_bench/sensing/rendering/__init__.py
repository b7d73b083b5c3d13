# SPDX-License-Identifier: Apache-2.0
"""Aerial pictures of a region as drawn from its map: things with heights, light, camera and sensor."""
