# SPDX-License-Identifier: Apache-2.0
"""Segmenters: what is on an aerial image, by colour alone, or by trees or a network that learn from labels."""
