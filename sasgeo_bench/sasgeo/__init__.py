# SPDX-License-Identifier: Apache-2.0
"""The SASGeo scorer: evidence, raster and graph scores, their sum, and how likely a fix is false."""
