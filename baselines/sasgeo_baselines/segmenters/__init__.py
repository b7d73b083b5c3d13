# SPDX-License-Identifier: Apache-2.0
"""Segmenters: what is on an aerial image, by colour alone, or by trees that learn from labelled images."""
