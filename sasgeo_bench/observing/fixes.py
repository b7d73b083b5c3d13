# SPDX-License-Identifier: Apache-2.0
"""What `locate` is asked, and what it answers: a fix for each picture."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.observing.pictures import Sight, Told
from sasgeo_bench.regions.evidence import Evidence
from sasgeo_bench.regions.region import Manifest
from sasgeo_bench.running.worker import Limits
from sasgeo_bench.sensing.segmentation import Segmentation

Found = Literal["found", "withheld", "not on this map", "failed"]
MATCHER: Final = "sasgeo"
SEGMENTER: Final = "osm_unet"
RADIUS_M: Final = 500.0
NOWHERE: Final = 0.9  # from this P(false fix) on, no place of the map explains a picture
MOST_FALSE: Final = 0.05


@dataclass(frozen=True, kw_only=True)
class LocateRequest:
    """Pictures to locate, and what is known of them.

    Parameters
    ----------
    pictures : Path
        A file, or a folder of them.
    out : Path
        Root of what is built; regions lie in `out/regions`.
    into : Path
        Folder of the results.
    region : Path, optional
        Folder of the map; by default the newest built one that holds the first position.
    near : tuple of float, optional
        Longitude and latitude of the middle of the search, in place of positions in the files.
    radius_m : float
        Of the disc that is searched.
    heading : tuple of float, optional
        Of the pictures' up, degrees clockwise from true north, and its standard deviation.
    is_turned : bool
        Whether any heading is possible, whatever the files say.
    told : Told
        Height or width of the ground.
    matcher, segmenter : str
        Names, or module:Class.
    uses_position : bool
        Whether positions in the files may be used; without, and without `near`, the whole map is searched.
    most_false : float
        P(false fix) up to which a fix is accepted.
    """

    pictures: Path
    out: Path
    into: Path
    region: Path | None = None
    near: tuple[float, float] | None = None
    radius_m: float = RADIUS_M
    heading: tuple[float, float] | None = None
    is_turned: bool = False
    told: Told = field(default_factory=Told)
    matcher: str = MATCHER
    segmenter: str = SEGMENTER
    uses_position: bool = True
    most_false: float = MOST_FALSE
    limits: Limits = field(default_factory=Limits)
    is_sandboxed: bool = True

    def __post_init__(self) -> None:
        if not 10.0 <= self.radius_m <= 100_000.0:
            raise ConfigError(f"--radius lies within 10 and 100000 m, got {self.radius_m!r}")
        if self.heading is not None and not -180 <= self.heading[0] <= 360:
            raise ConfigError(f"--heading lies within -180 and 360 degrees, got {self.heading[0]:g}")
        if not 0 < self.most_false < 1:
            raise ConfigError(f"--most-false lies between 0 and 1, got {self.most_false!r}")
        if self.told.dem is not None and not self.uses_position:
            raise ConfigError(
                "--dem tells the height of the ground at the position in a file: leave out --no-exif-position, or say "
                "--height"
            )
        if self.near is not None and not (abs(self.near[0]) <= 180 and abs(self.near[1]) <= 84):  # UTM ends there
            raise ConfigError(f"--near is longitude,latitude, degrees, got {self.near[0]:g},{self.near[1]:g}")


@dataclass(frozen=True, kw_only=True)
class Fix:
    """Where one picture was taken, as far as that can be said; the columns of `locate.csv`, and what a page shows.

    `lon`, `lat` and `x_m`, `y_m` (in the map's CRS) are the best place for the camera; `heading_deg` counts from true
    north. They are there unless nothing was found at all, also where the fix is not accepted. `prior_*` is the disc
    that was searched. `file_distance_m` is how far the best place is from the position that the file carries.
    """

    file: str
    status: Found
    lon: float | None = None
    lat: float | None = None
    x_m: float | None = None
    y_m: float | None = None
    heading_deg: float | None = None
    p_false: float | None = None
    is_accepted: bool = False
    reason: str = ""
    prior_lon: float | None = None
    prior_lat: float | None = None
    prior_radius_m: float | None = None
    file_distance_m: float | None = None
    seconds: float = 0.0
    # What is not in the table:
    side_m: float | None = None
    height_m: float | None = None
    taken_at: str | None = None
    note: str = ""
    view: tuple[float, float, float, float] | None = None  # easting, northing, yaw and scale of the view's middle
    key: str = ""  # of all that the answer follows from

    @property
    def view_pose(self) -> Pose | None:
        """Return the pose of the middle of what was seen, on the map's grid."""
        if self.view is None:
            return None
        return Pose(easting_m=self.view[0], northing_m=self.view[1], yaw_deg=self.view[2], scale=self.view[3])


COLUMNS: Final = (
    *("file", "status", "lon", "lat", "x_m", "y_m", "heading_deg", "p_false", "is_accepted", "reason"),
    *("prior_lon", "prior_lat", "prior_radius_m", "file_distance_m", "seconds"),
)


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What a page shows of one picture beside its fix."""

    fix: Fix
    sight: Sight
    segmentation: Segmentation
    evidence: Evidence


@dataclass(frozen=True, kw_only=True)
class Located:
    """All fixes of a request, in the order of the pictures; the map they are on, and how far P(false fix) holds."""

    request: LocateRequest
    region: Path
    manifest: Manifest
    fixes: tuple[Fix, ...]
    calibration: str


class Watch:
    """Gets each picture when it is done; what it does not want costs nothing."""

    def seen(self, number: int, seen: Seen) -> None:
        """Take a picture with its evidence."""

    def is_shown(self, number: int, fix: Fix) -> bool:  # noqa: ARG002
        """Return whether a picture was taken by an earlier call already."""
        return True


def verdict(
    answer: Prediction, p_false: float | None, prior: Prior, *, side_m: float, most_false: float
) -> tuple[Found, str]:
    """Return whether a picture was found, and why not; `side_m` is that of the square of ground that was looked for."""
    if p_false is None:
        return "withheld", "P(false fix) is not calibrated for this matcher and segmenter"
    if p_false <= most_false:
        return "found", ""
    where = "on the map" if prior.radius_m is None else f"within {prior.radius_m:g} m"
    if p_false >= NOWHERE:
        # The usual cause on the map: a height that is not that above the ground
        return "not on this map", f"no place {where} explains what is seen, taken as {side_m:.0f} m wide"
    rivals = round(answer.diagnostics.get("modes_above", 1.0)) - 1
    alike = f"{counted(rivals, 'other place')} {where} {'looks' if rivals == 1 else 'look'} alike"
    weak = f"P(false fix) is above {most_false:g}"
    return "withheld", alike if rivals > 0 else weak
