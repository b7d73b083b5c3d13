# SPDX-License-Identifier: Apache-2.0
"""Coastlines of the world, coarse, for overview maps: Natural Earth, 1:110m physical vectors (land), public domain."""

import json
from importlib import resources
from typing import Final

import numpy as np

_FEATURE: Final = json.loads(resources.files("sasgeo_bench.publishing").joinpath("coast.geojson").read_text("utf-8"))
# Longitude and latitude of each line, shape (N, 2), degrees.
COASTS: Final = tuple(np.array(line, dtype=float) for line in _FEATURE["geometry"]["coordinates"])
