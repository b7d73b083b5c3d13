# SPDX-License-Identifier: Apache-2.0
"""Query: what a matcher may see; its head: the same without the view. Truth: what only the scorer sees."""

import datetime as dt
import math
from dataclasses import dataclass, field
from importlib import import_module
from itertools import product
from typing import TYPE_CHECKING, Final, Literal, Self, cast

import numpy as np
import shapely

from sasgeo_bench.core.errors import ConfigError, PoseError, ShapeError
from sasgeo_bench.core.texts import html_facts
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.regions.evidence import PRESENT, Evidence
from sasgeo_bench.tasks.frames import Frame, FrameLabels

if TYPE_CHECKING:
    import geopandas as gpd
    from matplotlib.figure import Figure

    from sasgeo_bench.regions.region import Region

TWIN_EAST, TWIN_NORTH = "twin_east_m", "twin_north_m"  # measured: offset from a site to its copy
TWIN_TURN: Final = "twin_turn_deg"  # measured: clockwise, from a heading to that at which the twin looks like it
CEILING: Final = "ceiling"  # measured: the most that a matcher can expect, where copies leave nothing to tell them by
UNRIVALLED: Final = "unrivalled"  # begins the kind of a stress whose rival is out of reach: it decides nothing
COPIES: Final = "twins"  # measured: exact copies of the place among the candidates
TRUTH_SIGMA: Final = "m, standard deviation of the truth"  # unit of the strength of truths that are not exact
TASK_VERSION: Final = 5  # of queries.parquet and truth.parquet: raised when the same request gives other queries
TASK_VERSIONS: Final = (1, 2, 3, 4, TASK_VERSION)  # readable versions: their files are alike

Track = Literal["retrieval", "localization", "sequence"]
Yaw = Literal["known", "weak", "unknown"]
Role = Literal["control", "stress", "falsifier"]
# Families of errors of perception: four models of a detector, and looks of pictures, which a segmenter sees.
Detector = Literal["published", "measured", "silent", "profile", "rendered", "shifted", "real"]
PUBLISHED: Final[Detector] = "published"  # the one that is meant where none is named
RENDERED: Final[Detector] = "rendered"  # pictures of the ordinary look; from these segmenters learn
REAL: Final[Detector] = "real"
PROFILE: Final[Detector] = "profile"  # the measured confusions of a segmenter, from a file
SILENT: Final[Detector] = "silent"  # those of one segmenter that withholds what it is unsure of; they ship
PERCEIVED: Final[tuple[Detector, ...]] = (PUBLISHED, "measured", SILENT, PROFILE)  # the first if none is chosen
PAINTED: Final[tuple[Detector, ...]] = (RENDERED, "shifted")  # looks of rendered pictures, the first if none is chosen
BY: Final = "+"  # between a suite of pictures and the segmenter that made its evidence
_MOST_M: Final = 1e6  # of a view's vectors from its middle: no view is as large
RECALIBRATED: Final = "+shares"  # after the segmenter: by the map's shares of the classes
# Kinds of queries whose right score is known beforehand; the scorer knows them by these names.
CONTROLS: Final = "controls"  # their suite
NOISE_FREE: Final = "noise-free"
SHUFFLED: Final = "shuffled map"
TURNED: Final = "turned map"
TWINS: Final = "identical twins"
BLIND: Final = "all unknown"
SEQUENCE: Final = "sequence"  # the track of flights
SEQUENCE_DIGITS: Final = 18  # of the id of a flight; the id of a view has more
_FRAME_DIGITS: Final = 6  # at the end of the id of a view
YAW_SIGMA_DEG: Final = {"known": 5.0, "weak": 20.0, "unknown": None}


def base_of(region: str) -> str:
    """Return the region of a map without its date and edits.

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
        Radius of the disc that holds the place; None if it may be anywhere in the region.
    yaw : {"known", "weak", "unknown"}
        Standard deviation of the heading: 5 degrees, 20 degrees, or nothing known.
    scale_sigma : float
        Standard deviation of the scale around 1: 0.01 (a laser altimeter), 0.03, 0.10 or 0.15.
    is_gnss : bool
        Of flights: whether every view has a disc, around the fix of a weak receiver. `radius_m` is that of a drawn one.

    Examples
    --------
    >>> group = PriorGroup(radius_m=500.0, yaw="weak", scale_sigma=0.03)
    >>> group.name, group.words
    ('r500-weak-s3', 'searched: disc of 500 m, heading +-20 deg, scale +-3 %')
    >>> PriorGroup.parse("gnss") == PriorGroup.parse("gnss-weak-s3")
    True
    """

    radius_m: float | None
    yaw: Yaw
    scale_sigma: float
    is_gnss: bool = False

    @property
    def name(self) -> str:
        """Return the short name, as in "r500-weak-s3": metres, yaw, per cent of scale."""
        radius = "none" if self.radius_m is None else f"{self.radius_m:g}"
        place = GNSS if self.is_gnss else f"r{radius}"
        return f"{place}-{self.yaw}-s{100 * self.scale_sigma:g}"

    @property
    def words(self) -> str:
        """Return the group in words, as people read it."""
        place = "whole map" if self.radius_m is None else f"disc of {self.radius_m:g} m"
        place = "disc around each fix of a weak receiver" if self.is_gnss else place
        heading = {"known": "+-5 deg", "weak": "+-20 deg", "unknown": "unknown"}[self.yaw]
        return f"searched: {place}, heading {heading}, scale +-{100 * self.scale_sigma:g} %"

    @classmethod
    def parse(cls, name: str) -> Self:
        """Return the group of a name; raise a ConfigError if there is none."""
        places = [*((radius_m, False) for radius_m in RADII_M), (GNSS_M, True)]
        declared = [
            cls(radius_m=radius_m, yaw=yaw, scale_sigma=scale_sigma, is_gnss=is_gnss)
            for (radius_m, is_gnss), yaw, scale_sigma in product(places, YAWS, SCALE_SIGMAS)
        ]
        groups = {group.name: group for group in declared}
        groups[GNSS] = groups[f"{GNSS}-weak-s3"]
        if name not in groups:
            raise ConfigError(
                f"{name!r} is no prior group: r50, r100, r250, r500, r2000, rnone, or of flights {GNSS}, then known, "
                "weak or unknown yaw, then s1, s3, s10 or s15, as in r500-weak-s3"
            )
        return groups[name]


GNSS: Final = "gnss"  # prior groups of a weak receiver
GNSS_M: Final = 50.0  # radius of the disc around a drawn fix: tens of metres in a street, or beside a jammer
RADII_M: Final = (None, 50.0, 100.0, 250.0, 500.0, 2000.0)
SCALE_SIGMAS: Final = (0.01, 0.03, 0.10, 0.15)
YAWS: Final[tuple[Yaw, ...]] = ("known", "weak", "unknown")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Question:
    query_id: str
    track: Track
    suite: str
    suite_version: int
    part: str
    region: str
    prior_group: str
    candidates: tuple[Pose, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Where a query stands in a flight, and what the odometer says of the way to it.

    Parameters
    ----------
    sequence_id : str
        The flight; reveals nothing about where it is.
    frame : int
        0 for the first view of the flight, then 1, 2, ...
    increment : tuple of float, optional
        Right and up, metres, and the turn of the heading, degrees clockwise, in the axes of the view before. None for
        the first view, and where the odometer lost its way.
    covariance : tuple of float, optional
        Of the increment as the odometer believes: 3 x 3, row by row, in m2, m deg and deg2, 0 of one that is exact;
        None without an increment.

    Raises
    ------
    PoseError
        If a number is not finite, there are not three and nine of them, only one of the two is given, a first view has
        an increment, or the covariance is none: not symmetric, or with a negative variance in some direction.

    Examples
    --------
    >>> Step(sequence_id="f1", frame=1, increment=(0.5, 50.0, -2.0), covariance=(1, 0, 0, 0, 1, 0, 0, 0, 4)).increment
    (0.5, 50.0, -2.0)
    """

    sequence_id: str
    frame: int
    increment: tuple[float, float, float] | None = None
    covariance: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        counts = [0 if values is None else len(values) for values in (self.increment, self.covariance)]
        numbers = (*(self.increment or ()), *(self.covariance or ()))
        is_whole = counts == [0, 0] or (counts == [3, 9] and self.frame > 0)
        if not is_whole or not all(map(math.isfinite, numbers)) or self.frame < 0:
            raise PoseError(
                "a step has a frame from 0 on and, after the first, 3 finite numbers with a covariance of 9 or "
                f"neither, got {self!r}"
            )
        if self.covariance is not None and not _is_covariance(self.covariance):
            raise PoseError(f"a covariance is symmetric and positive semidefinite, got {self.covariance!r}")


def _is_covariance(values: tuple[float, ...]) -> bool:
    matrix = np.reshape(values, (3, 3))
    slack = 1e-6 * float(np.abs(matrix).max())
    return bool((np.abs(matrix - matrix.T) <= slack).all()) and float(np.linalg.eigvalsh(matrix).min()) >= -slack


def view_id(sequence_id: str, frame: int) -> str:
    """Return the query id of a view of a flight; ids sort by flight, then by time.

    >>> view_id("00ff", 12), flight_id(view_id("00ff", 12))
    ('00ff00000c', '00ff')
    """
    return f"{sequence_id}{frame:0{_FRAME_DIGITS}x}"


def flight_id(query_id: str) -> str:
    """Return the flight that the query of a view belongs to (`view_id`)."""
    return query_id[:-_FRAME_DIGITS]


@dataclass(frozen=True, slots=True, kw_only=True)
class Query(_Question):
    """One question to a matcher.

    Parameters
    ----------
    query_id : str
        Reveals nothing about the answer.
    track : {"retrieval", "localization", "sequence"}
        Whether to rank `candidates`, to find the pose of a view, or to follow a flight.
    suite, suite_version, part : str, int, str
        Its suite, and "train", "calibration", "test", or "crossfit".
    region : str
        Folder name of the map to search.
    evidence : Evidence
        The view.
    observed_on, season : date, str
        Date and season of the view: "leaf_on", "snow", "low_water", "harvest", or "" for unspecified.
    prior, prior_group : Prior, str
        What is known before, and the name of its group.
    candidates : tuple of Pose
        For retrieval: the places to rank; empty for localization.
    vectors : geopandas.GeoDataFrame, optional
        Perceived vectors in the view's frame ((right, up) from its middle, metres): columns class, level, is_bridge.
    frames : tuple of Frame
        Pictures, oldest first, each with its believed camera in the view's frame; empty where perception is modelled.
        Until a segmenter has made evidence of them, all of `evidence` is unknown.
    step : Step, optional
        Where the query stands in a flight; None for a view alone. Only the first view of a flight has a prior of place
        and heading; in the groups `gnss` every view that has a fix has one of place.

    Raises
    ------
    ShapeError
        If vectors lack a column, or a geometry is missing, empty, or has a coordinate beyond any view or not finite.
    """

    evidence: Evidence
    observed_on: dt.date
    season: str
    prior: Prior
    vectors: "gpd.GeoDataFrame | None" = None
    frames: tuple[Frame, ...] = ()
    step: Step | None = None

    def _repr_html_(self) -> str:
        """Return what a notebook shows of a query; `plot` draws it."""
        view, (rows, cols) = self.evidence, self.evidence.shape
        seen = [name for name, cells in zip(view.classes, view.cells, strict=True) if (cells == PRESENT).any()]
        facts = {
            "asked": f"{self.track}, {self.suite} on {self.region}, {self.part}",
            "prior group": self.prior_group,
            "view": f"{rows} x {cols} cells of {view.cell_size_m:g} m, {view.unknown_share:.0%} unknown",
            "classes seen": ", ".join(seen) or "none",
            "observed": f"{self.observed_on} {self.season}".strip(),
            "pictures": len(self.frames),
            "candidates": len(self.candidates),
        }
        return html_facts(f"query {self.query_id}", facts)

    def plot(self, region: "Region", truth: "Truth | None" = None) -> "Figure":
        """Draw the query on its map in one call, with the true place if its truth is given; see `sgb.plot_query`."""
        # By its public name: the drawing stands below in the order of folders
        return cast("Figure", import_module("sasgeo_bench").plot_query(self, region, truth))

    def __post_init__(self) -> None:
        if self.vectors is None or not len(self.vectors):
            return
        is_whole = all(name in self.vectors for name in ("class", "level", "is_bridge"))
        shapes = self.vectors.geometry
        has_shapes = not (shapes.isna() | shapes.is_empty).any()
        if not (is_whole and has_shapes and (np.abs(shapely.get_coordinates(shapes)) <= _MOST_M).all()):
            raise ShapeError(
                f"vectors of query {self.query_id!r} have columns class, level and is_bridge, and geometries with "
                f"coordinates of at most {_MOST_M:g} m"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Head(_Question):
    """A query without its view: all that scoring needs of it.

    `view_cells` is the side of the view. Views of a flight have `sequence_id`, `frame` and `increment` of their `Step`.
    """

    view_cells: int
    cell_size_m: float
    sequence_id: str | None = None
    frame: int | None = None
    increment: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """The answer to one query, and the strata it belongs to.

    Parameters
    ----------
    is_present : bool
        Whether the place is on the searched map (for retrieval: among the candidates). A view of a flight is absent
        where its middle lies off the map, and its pose is known all the same: what was flown there counts too.
    pose : Pose, optional
        Where the view was taken; None if it was not taken in this place at all.
    candidate : int
        Index of the right candidate; -1 for localization or if it is absent.
    pair_id, role : str
        Site, shared by a control and its stresses, and "control", "stress" or "falsifier".
    kind : str
        Kind within the suite, as in "U2 wedge".
    strength, strength_unit : float, str
        Step of the suite's ladder, 0 for controls, and its unit.
    unknown_share, changed_share, feature_density : float
        Fraction of unknown cells; fraction of known cells that differ from the map at the truth; fraction of cells with
        a road, building or other drawn feature on the map of the seen place.
    alias_index : float, optional
        Likeness of the most similar other place, 0..1; None if the view was not taken at the site.
    block, scene : str
        Evaluation block of the centre, the unit of resampling, and scene tags of the region.
    measured : mapping of str to float
        Manipulation check: measures of the applied change.
    detector : {"published", "measured", "silent", "profile", "rendered", "shifted", "real"}
        Family of the errors of perception, or of the look of pictures; the query does not tell it.
    labels : tuple of FrameLabels
        What is on the pixels of each frame; only in memory, and in a file beside the truths.
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
    detector: Detector = PUBLISHED
    labels: tuple[FrameLabels, ...] = field(default=(), repr=False, compare=False)

    @property
    def is_own(self) -> bool:
        """Return whether it is of a user's own picture, whose pose is as good as its file says."""
        return self.strength_unit == TRUTH_SIGMA

    @property
    def title(self) -> str:
        """Return role and kind; of a user's own picture, which is the control of nothing, the kind alone."""
        return self.kind if self.is_own else f"{self.role}: {self.kind}"
