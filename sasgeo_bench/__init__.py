# SPDX-License-Identifier: Apache-2.0
"""sasgeo-bench: benchmark and dataset builder for map localization of UAVs without GNSS."""

__version__ = "0.1.0"
