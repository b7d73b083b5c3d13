# SPDX-License-Identifier: Apache-2.0
"""Query: what a matcher may see, and its head without the view. Truth: what only the scorer sees."""

import datetime as dt
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, Self

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import Evidence

if TYPE_CHECKING:
    import geopandas as gpd

TWIN_EAST, TWIN_NORTH = "twin_east_m", "twin_north_m"  # measured: from a site to its copy
TASK_VERSION: Final = 2  # of queries.parquet and truth.parquet: raised whenever the same request gives other queries
TASK_VERSIONS: Final = (1, TASK_VERSION)  # those that are read: their files are alike, and answers belong to queries

Track = Literal["retrieval", "localization"]
Role = Literal["control", "stress", "falsifier"]
# Kinds of the queries whose right score is known beforehand: those who draw and those who score agree on these words.
CONTROLS: Final = "controls"  # their suite
NOISE_FREE: Final = "noise-free"
SHUFFLED: Final = "shuffled map"
TURNED: Final = "turned map"
TWINS: Final = "identical twins"
BLIND: Final = "all unknown"
YAW_SIGMA_DEG: Final = {"known": 5.0, "weak": 20.0, "unknown": None}


def base_of(region: str) -> str:
    """The region of a map, whatever its date and edits.

    Examples
    --------
    >>> base_of("vaduz@2013-08-03+alias")
    'vaduz'
    """
    return region.split("+", maxsplit=1)[0].split("@", maxsplit=1)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class PriorGroup:
    """How much is known before matching; results are never ranked across groups.

    Parameters
    ----------
    radius_m : float, optional
        Radius of the disc that holds the place; None where it may lie anywhere in the region.
    yaw : {"known", "weak", "unknown"}
        Standard deviation of the heading: 5 degrees, 20 degrees, or nothing known.
    scale_sigma : float
        Standard deviation of the scale around 1: 0.03, 0.10 or 0.15.

    Examples
    --------
    >>> PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03).name
    'r500-weak-s3'
    >>> PriorGroup.parse("rnone-unknown-s15").radius_m is None
    True
    """

    radius_m: float | None
    yaw: Literal["known", "weak", "unknown"]
    scale_sigma: float

    @property
    def name(self) -> str:
        """Short name, as in "r500-weak-s3": metres, yaw, per cent of scale."""
        radius = "none" if self.radius_m is None else f"{self.radius_m:g}"
        return f"r{radius}-{self.yaw}-s{100 * self.scale_sigma:g}"

    @classmethod
    def parse(cls, name: str) -> Self:
        """Read a name back.

        Raises
        ------
        ConfigError
            If it is no name of a declared group.
        """
        groups = {
            group.name: group
            for radius_m in RADII_M
            for yaw in ("known", "weak", "unknown")
            for scale_sigma in SCALE_SIGMAS
            for group in (cls(radius_m=radius_m, yaw=yaw, scale_sigma=scale_sigma),)
        }
        if name not in groups:
            message = (
                f"{name!r} is no prior group: r100, r250, r500, r2000 or rnone, then known, weak or unknown yaw, "
                "then s3, s10 or s15, as in r500-weak-s3"
            )
            raise ConfigError(message)
        return groups[name]


RADII_M: Final = (None, 100.0, 250.0, 500.0, 2000.0)
SCALE_SIGMAS: Final = (0.03, 0.10, 0.15)


@dataclass(frozen=True, slots=True, kw_only=True)
class Query:
    """One question to a matcher.

    Parameters
    ----------
    query_id : str
        Says nothing about the answer.
    track : {"retrieval", "localization"}
        Whether `candidates` are to be ranked, or poses are to be found.
    suite, suite_version : str, int
        Where it comes from.
    part : str
        "train", "calibration", "test", or "crossfit".
    region : str
        Folder name of the map to search.
    evidence : Evidence
        What was seen.
    observed_on : date
        Of the view.
    season : str
        What the view's date says about the season: "leaf_on", "snow", "low_water", "harvest", or "" for nothing said.
    prior : Prior
        What is known before.
    prior_group : str
        Name of the declared group.
    candidates : tuple of Pose
        For retrieval: the places to rank; empty for localization.
    vectors : geopandas.GeoDataFrame, optional
        Perceived vectors in the view's frame ((right, up) from its middle, metres): columns class, level, is_bridge.
    """

    query_id: str
    track: Track
    suite: str
    suite_version: int
    part: str
    region: str
    evidence: Evidence
    observed_on: dt.date
    season: str
    prior: Prior
    prior_group: str
    candidates: tuple[Pose, ...] = ()
    vectors: "gpd.GeoDataFrame | None" = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Head:
    """A query without what was seen: all that scoring needs of it. Fields are those of a `Query`.

    `view_cells` is the side of the view.
    """

    query_id: str
    track: Track
    suite: str
    suite_version: int
    part: str
    region: str
    view_cells: int
    cell_size_m: float
    prior_group: str
    candidates: tuple[Pose, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """The answer to one query, and the strata it is counted in.

    Parameters
    ----------
    query_id : str
        Of the query.
    is_present : bool
        Whether the place is on the map that is searched (for retrieval: among the candidates).
    pose : Pose, optional
        Where the view was taken; None where it was not taken in this map at all.
    candidate : int
        Index of the right candidate; -1 for localization or where it is absent.
    pair_id : str
        Shared by all queries of one site: a control and its stresses.
    role : {"control", "stress", "falsifier"}
        What the query is within the site.
    kind : str
        Sub-suite, as in "U2 wedge".
    strength : float
        Step of the suite's ladder, in `strength_unit`; 0 for controls.
    strength_unit : str
        Unit of the strength.
    unknown_share, changed_share, feature_density : float
        Share of unknown cells; share of known cells that differ from the map at the truth; share of cells with a road,
        building or other drawn thing on the map of the place that is seen.
    alias_index : float, optional
        Likeness of the most similar other place, 0..1; None where the view was not taken at the site.
    block : str
        Evaluation block of the centre; resampling is by block.
    scene : str
        Scene tags of the region.
    measured : mapping of str to float
        The manipulation check: what was measured to have been done.
    """

    query_id: str
    is_present: bool
    pose: Pose | None
    candidate: int
    pair_id: str
    role: Role
    kind: str
    strength: float
    strength_unit: str
    unknown_share: float
    changed_share: float
    feature_density: float
    alias_index: float | None
    block: str
    scene: str
    measured: dict[str, float] = field(default_factory=dict)
