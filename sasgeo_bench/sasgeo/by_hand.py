# SPDX-License-Identifier: Apache-2.0
"""Map and view for the search with rates set by hand: likelihoods of a scorer that has learned nothing."""

import datetime as dt
from collections.abc import Sequence
from typing import Final

import numpy as np

from sasgeo_bench.regions.region import Region
from sasgeo_bench.sasgeo.raster import CELL_M, RasterView, doubted, likeness_by_hand, read_field
from sasgeo_bench.sasgeo.rates import hand_rates
from sasgeo_bench.sasgeo.weights import by_hand, likelihood_gains
from sasgeo_bench.search.field import Field, Template
from sasgeo_bench.tasks.query import Query

_DAYS_PER_YEAR: Final = 365.25


def map_by_hand(region: Region, *, cell_size_m: float = CELL_M) -> Field:
    """Return a map for the search: areas as they are, lines fading by exp(-D^2 / 2 tau^2) with tau 4 m.

    Cells have a whole number of map cells a side, of about `cell_size_m`.

    Examples
    --------
    >>> import tempfile
    >>> import sasgeo_bench as sgb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     town = sgb.tiny_place(folder).region
    >>> map_by_hand(town, cell_size_m=4.0).grid.shape
    (256, 256)
    """
    return read_field(region, likeness_by_hand(region.classes), cell_size_m=cell_size_m)


def view_by_hand(query: Query, classes: Sequence[str], *, map_date: dt.date) -> Template:
    """Return the template of a view in the classes of a map, by rates of seeing, mapping and ageing set by hand.

    A score is a sum over classes and cells of log-likelihood ratios of the view with and without the map, in nats, each
    times the area of its cell in m2. Cells are far from independent, so scores need a factor (a temper) to be
    likelihoods of the whole view, and a bound on what a view says if a filter shall survive its errors. Unknown cells
    count 0, and so do cells near a seen line that are seen without it: a line mapped there may be the same.

    Parameters
    ----------
    query : Query
        The view, its date and its season.
    classes : sequence of str
        Classes of the map, as in `Region.classes`; those that the view lacks count 0.
    map_date : datetime.date
        Date of the map: `region.manifest.extract.date`. The older it is, the less it says.

    Examples
    --------
    >>> import tempfile
    >>> import sasgeo_bench as sgb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = sgb.tiny_place(folder)
    >>> town, query, truth = place.region, place.queries[0], place.truths[0]
    >>> field = map_by_hand(town)
    >>> view = view_by_hand(query, town.classes, map_date=town.manifest.extract.date)
    >>> away = sgb.Pose(easting_m=truth.pose.easting_m + 60.0, northing_m=truth.pose.northing_m, yaw_deg=90.0)
    >>> sgb.score_at(field, view, truth.pose) > sgb.score_at(field, view, away)
    True
    """
    age_years = max(0.0, (query.observed_on - map_date).days / _DAYS_PER_YEAR)
    rates = [hand_rates(name) for name in classes]
    gains = likelihood_gains(rates, age_years=age_years, persists=by_hand(query.season, classes).tolist())
    view = RasterView.of(doubted(query.evidence), classes, gains)
    return view.times(np.float32(query.evidence.cell_size_m**2)).template()
