# SPDX-License-Identifier: Apache-2.0
"""The packaged coastlines are longitude and latitude."""

import numpy as np

from sasgeo_bench.boards.site_maps import COASTS


def test_every_coastline_is_a_line_on_the_globe():
    for line in COASTS:
        assert line.ndim == 2
        assert len(line) > 1
        assert (np.abs(line) <= (180.0, 90.0)).all()
