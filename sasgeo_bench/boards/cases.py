# SPDX-License-Identifier: Apache-2.0
"""Queries that went wrong, each in one class of failure, and a few of each class to look at.

The classes, in the order in which they are tried; every failure is in the first that fits:

absent accepted
    The place is absent, and the answer is accepted.
right but not accepted
    The fix is right, and is not accepted.
aged
    Under a stress whose view differs more from the map than that of its control does (`changed_share`, by at least
    0.1), the answer is wrong or none, and that of the control is right: same matcher, site, track, prior group and
    size of view.
occluded
    The same with more of the view unknown (`unknown_share`, by at least 0.05).
one of several
    The answer is wrong and accepted, and no answer is better: the searched map holds the place several times, so
    that its ceiling is below 1. The controls and falsifiers of twins are such.
aliased
    The answer is wrong and accepted, at a place that has a double: alias index at least 0.9, the highest bin of a
    board, or a suite that copies places.
also without the stress
    Under a stress the answer is wrong or none, and so is that of a control at the site: the stress is not to blame.
other
    Any other control or stress at a present place without a right answer.

Accepted is what the operating rejector accepts at the threshold that kept the risk at 5 % on calibration places; where
there is none, every answer. Right is within 25 m whatever the heading, on both tracks, as in all figures of
rejection. Falsifiers are no cases: of some of them nothing else is asked than no answer.
"""

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self, TypedDict

import cv2
import numpy as np
import pandas as pd
import shapely
from matplotlib import patheffects
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle
from numpy.typing import NDArray

from sasgeo_bench.boards.tables import prior_words
from sasgeo_bench.core.canvas import GREY, Page, new_figure, styled, without_ticks
from sasgeo_bench.core.errors import ConfigError, SasgeoError, StoreError, check_given, counted
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose, wrap_deg
from sasgeo_bench.regions.evidence import CERTAIN, UNKNOWN, Evidence, LayerBits, footprint, observe
from sasgeo_bench.regions.layers import PRESENT
from sasgeo_bench.regions.painting import GROUND, HIDDEN, paint_evidence, paint_overview, pooled
from sasgeo_bench.regions.preview import class_keys, scale_bar
from sasgeo_bench.regions.region import Manifest, Region
from sasgeo_bench.scoring.base import Bools
from sasgeo_bench.scoring.contrasts import Contrast
from sasgeo_bench.scoring.pose import SUCCESS_DEG
from sasgeo_bench.scoring.rejection import OWN
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.tasks.query import SEQUENCE, TRUTH_SIGMA, Query, Truth, base_of
from sasgeo_bench.tasks.segmented import Segmented

BOTH: Final = "also without the stress"
SEVERAL: Final = "one of several"
FAILURES: Final = (
    *("aliased", "aged", "occluded", "absent accepted", "right but not accepted", SEVERAL, BOTH, "other"),
)
MEANINGS: Final = {  # of the classes, as pages show them; above in full
    "aliased": "wrong and accepted, where the map has a place much alike",
    "aged": "right on the map of the day, wrong where more of the map has changed",
    "occluded": "right in the open, wrong where more of the view is hidden",
    "absent accepted": "an answer is accepted although the place is not on the map",
    "right but not accepted": "the answer is right, and the rejector refuses it",
    SEVERAL: "wrong and accepted, but the map holds the place several times, and nothing tells which it is",
    BOTH: "as wrong without the stress, which is not to blame",
    "other": "no right answer, for no reason listed here",
}
OPERATING: Final = "accepted_0.05"  # column of judged rows
COLUMNS: Final = ("query_id", "matcher", "failure", "suite", "region", "kind")
MOST_CASES: Final = 60  # of a board
_ALIAS: Final = 0.9
_UNKNOWN_MORE: Final = 0.05
_CHANGED_MORE: Final = 0.1  # the lowest bin of a board ends there: less is hardly a change
_COPIES: Final = ("alias", "topology-twins", "instance-twins")  # suites where every place has a double
_SITE: Final = ("pair_id", "track", "prior_group", "view_cells")


def operating_rejector(
    judged: Mapping[tuple[str, str], pd.DataFrame], matcher: str, contrasts: Sequence[Contrast] = ()
) -> str | None:
    """Return the rejector whose threshold accepts a matcher's answers; None if none has a threshold.

    It is that of the first contrast with the matcher as its first side, else the first in `judged`, else the matcher's
    own confidence.

    >>> rows = pd.DataFrame({"accepted_0.05": [True]})
    >>> operating_rejector({("m", "own"): rows, ("m", "margin"): rows}, "m")
    'margin'
    """
    sides = [item.first.partition(" x ") for item in contrasts]
    first = [rejector for name, _, rejector in sides if name == matcher and rejector]
    known = [rejector for name, rejector in judged if name == matcher]
    for rejector in (*first, *(name for name in known if name != OWN), OWN):
        frame = judged.get((matcher, rejector))
        if frame is not None and frame[OPERATING].notna().any():
            return rejector
    return None


def find_cases(scores: pd.DataFrame, matcher: str, judged: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return the failures of one matcher in the order of its scored rows, with the columns `COLUMNS`.

    `judged` are the results of the operating rejector; rows that it lacks have no threshold.
    """
    taken, has_threshold = _accepted(scores, judged)
    is_present, is_right, is_answered = (
        scores[name].to_numpy(bool) for name in ("is_present", "is_right", "is_answered")
    )
    is_stress, is_asked = ((scores["role"] != role).to_numpy(bool) for role in ("control", "falsifier"))
    is_applicable = (scores["status"] != "not applicable").to_numpy(bool)  # else its card says so: nothing failed
    is_asked = is_asked & is_applicable
    is_wrong = is_present & ~is_right & is_asked
    control = _controls(scores)
    is_paired = is_wrong & is_stress & control["is_right"].to_numpy(bool)
    changed, unknown = (scores[name].to_numpy(float) for name in ("changed_share", "unknown_share"))
    alias = scores["alias_index"].astype(float).fillna(0.0).to_numpy(float)
    has_double = (alias >= _ALIAS) | scores["suite"].isin(_COPIES).to_numpy(bool)
    rules = (
        ("absent accepted", ~is_present & is_answered & taken & is_asked),
        ("right but not accepted", is_present & is_right & has_threshold & ~taken & is_asked),
        ("aged", is_paired & (changed >= control["changed_share"].to_numpy(float) + _CHANGED_MORE)),
        ("occluded", is_paired & (unknown >= control["unknown_share"].to_numpy(float) + _UNKNOWN_MORE)),
        (SEVERAL, is_wrong & is_answered & taken & (scores["ceiling"] < 1.0).to_numpy(bool)),
        ("aliased", is_wrong & is_answered & taken & has_double),
        (BOTH, is_wrong & is_stress & control["is_wrong"].to_numpy(bool)),
        ("other", is_wrong),
    )
    failure = np.select([mask for _, mask in rules], [name for name, _ in rules], default="")
    found = scores.assign(matcher=matcher, failure=failure)
    return pd.DataFrame(found[failure != ""], columns=list(COLUMNS)).reset_index(drop=True)


def _accepted(scores: pd.DataFrame, judged: pd.DataFrame | None) -> tuple[Bools, Bools]:
    """Return which answers are accepted, and for which a threshold exists."""
    answered = scores["is_answered"].to_numpy(bool)
    if judged is None:
        return answered, np.zeros(len(scores), dtype=bool)
    operating = dict(zip(judged["query_id"], judged[OPERATING], strict=True))
    known = np.array([float(operating.get(name, np.nan)) for name in scores["query_id"]], dtype=np.float64)
    is_known = ~np.isnan(known)
    return np.where(is_known, known > 0, answered), is_known


def _controls(scores: pd.DataFrame) -> pd.DataFrame:
    """Return for each row the controls at its site: whether all are right, some are wrong, and their shares."""
    controls = scores[(scores["role"] == "control").to_numpy(bool) & scores["is_present"].to_numpy(bool)]
    how = {"is_right": "all", "changed_share": "max", "unknown_share": "max"}
    found = controls.groupby(list(_SITE), as_index=False).agg(how)
    joined = scores[list(_SITE)].merge(found, on=list(_SITE), how="left")
    shares = {"is_right": joined["is_right"].eq(other=True), "is_wrong": joined["is_right"].eq(other=False)}
    return joined.assign(**shares).fillna({"changed_share": 0.0, "unknown_share": 0.0})


def sample_cases(cases: pd.DataFrame, *, each: int, most: int = MOST_CASES) -> pd.DataFrame:
    """Return at most `each` failures of each class and matcher; the choice depends on their names only.

    `cases` are from `find_cases`, one matcher after the other. At most `most` are chosen in all: the first of every
    class and matcher, then the second of each, and so on. They are in the order of classes, then of matchers as given.
    """
    if cases.empty:
        return cases
    matchers = list(dict.fromkeys(cases["matcher"]))
    ranked = cases.assign(
        _class=cases["failure"].map(FAILURES.index),
        _who=cases["matcher"].map(matchers.index),
        _mark=[
            hashlib.sha256(f"{matcher}/{query_id}".encode()).hexdigest()
            for matcher, query_id in zip(cases["matcher"], cases["query_id"], strict=True)
        ],
    ).sort_values(["_class", "_who", "_mark"])
    ranked = ranked.assign(_round=ranked.groupby(["_class", "_who"]).cumcount())
    chosen = ranked[ranked["_round"] < each].sort_values(["_round", "_class", "_who"], kind="stable").head(most)
    chosen = chosen.sort_values(["_class", "_who", "_round"], kind="stable")
    return chosen[list(cases.columns)].reset_index(drop=True)


def count_cases(cases: pd.DataFrame) -> dict[str, int]:
    """Return the number of failures of each class."""
    counts = cases["failure"].value_counts()
    return {name: int(counts.get(name, 0)) for name in FAILURES}


def is_turned(scores: pd.DataFrame) -> Bools:
    """Return which fixes are right with a heading that is off by more than success allows; no failure holds them.

    >>> is_turned(pd.DataFrame({"is_right": [True, True, False], "yaw_error_deg": [4.0, 6.0, 90.0]})).tolist()
    [False, True, False]
    """
    return np.asarray(scores["is_right"].astype(bool) & (scores["yaw_error_deg"] > SUCCESS_DEG), dtype=bool)


def turned_line(scores: pd.DataFrame) -> str:
    """Return how many fixes of one matcher are right with another heading, and which figures count them; "" if none."""
    turned = scores[is_turned(scores)]
    if not len(turned):
        return ""
    stated = " the one that its file states" if is_own(turned).all() else ""
    return (
        f"{counted(len(turned), 'more query is', 'more queries are')} within {FIX_M:g} m of the place with a heading "
        f"more than {SUCCESS_DEG:g} degrees off{stated}: within_25m counts them, success_25m does not"
    )


def own_lines(scores: pd.DataFrame) -> list[str]:
    """Return `turned_line` of each matcher on single views of a user's own pictures.

    >>> rows = {"matcher": ["a", "b"], "is_right": True, "yaw_error_deg": [6.0, 4.0]}
    >>> own_lines(pd.DataFrame(rows | {"strength_unit": TRUTH_SIGMA, "track": "localization"}))
    ['a: 1 more query is within 25 m of the place with a heading more than 5 degrees off the one that its file states: \
within_25m counts them, success_25m does not']
    """
    own = scores[is_own(scores) & (scores["track"] != SEQUENCE)] if len(scores) else scores
    lines = {str(name): turned_line(rows) for name, rows in own.groupby("matcher", sort=True)} if len(own) else {}
    return [f"{name}: {line}" for name, line in lines.items() if line]


def is_own(scores: pd.DataFrame) -> Bools:
    """Return which scored rows are of a user's own pictures, whose true poses are as good as a file says."""
    return scores["strength_unit"].eq(TRUTH_SIGMA).to_numpy(bool)


class Words(TypedDict):
    """What rejectors state of one answer, by rejector: chance to be false, or an order, and whether it is accepted."""

    p_false: dict[str, float]
    orders: dict[str, float]
    accepted: dict[str, bool]


def words_of(words: Mapping[tuple[str, str], pd.DataFrame], matcher: str, query_id: str) -> Words:
    """Return what rejectors state of one answer: chance to be false or rank, and whether they accept it.

    `words` are rows of `RejectionResult` by matcher and rejector, with the query ids as index.
    """
    p_false: dict[str, float] = {}
    orders: dict[str, float] = {}
    accepted: dict[str, bool] = {}
    for (name, rejector), frame in words.items():
        if name != matcher or query_id not in frame.index:
            continue
        row: Any = frame.loc[query_id]
        if pd.notna(row["p_right"]):
            is_chance = bool(row.get("is_calibrated", True))
            (p_false if is_chance else orders)[rejector] = 1.0 - float(row["p_right"])
        if pd.notna(row[OPERATING]) and row["is_answered"]:
            accepted[rejector] = bool(row[OPERATING])
    return Words(p_false=p_false, orders=orders, accepted=accepted)


WEBP: Final = ".webp"
PNG: Final = ".png"
_QUALITIES: Final = (80, 65, 50, 35, 20, 10)
_SCALES: Final = (1.0, 0.75, 0.5)


def pixels_of(figure: Figure) -> NDArray[np.uint8]:
    """Return a figure as pixels, shape (rows, cols, 3), blue first."""
    canvas: Any = FigureCanvasAgg(figure)  # without types
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba(), dtype=np.uint8)[..., 2::-1])


def fitted(pixels: NDArray[np.uint8], most_bytes: int) -> bytes:
    """Return pixels (blue first) as WebP of at most `most_bytes`, as good and then as large as fits.

    The same pixels give the same bytes. Raise StoreError if even half of its size in the worst quality takes more.
    """
    for scale in _SCALES:
        smaller = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        for quality in _QUALITIES:
            data = _encoded(WEBP, smaller, [cv2.IMWRITE_WEBP_QUALITY, quality])
            if len(data) <= most_bytes:
                return data
    raise StoreError(f"a picture of {pixels.shape[1]} x {pixels.shape[0]} pixels does not fit into {most_bytes} bytes")


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write pixels without loss, whole or not at all.

    Raise StoreError if the folder cannot be written.
    """
    scratch = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch.write_bytes(_encoded(PNG, pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9]))
        scratch.replace(path)
    except SasgeoError:  # an error with a cause of its own, though it may be an `OSError`
        raise
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error


def _encoded(kind: str, pixels: NDArray[np.uint8], settings: list[int]) -> bytes:
    is_done, data = cv2.imencode(kind, pixels, settings)
    if not is_done:
        raise StoreError(f"a picture cannot be written as {kind}")
    return bytes(data)


MOST_MODES: Final = 8  # bars of an answer; a list may be longer
TRUE: Final = "#000000"
ANSWERED: Final = "#d55e00"
_OTHER: Final = "#0072b2"
_SIDE: Final = 1.72  # of a small panel, inches
_MAP: Final = 3.9
_DPI: Final = 100
_MOST_CELLS: Final = 560  # of a piece of a map, along a side: more are no more to see
_HALO: Final = (patheffects.withStroke(linewidth=2.6, foreground="white"),)


@dataclass(frozen=True, kw_only=True)
class MapPart:
    """A piece of a map as it is drawn: colours of shape (rows, cols, 3), and its edges in metres."""

    colours: NDArray[np.uint8]
    west_m: float
    south_m: float
    east_m: float
    north_m: float

    @classmethod
    def of(cls, layers: NDArray[np.uint8], grid: Grid, manifest: Manifest) -> Self:
        """Paint layers, shape (C, rows, cols), on their grid; at most `_MOST_CELLS` along a side."""
        coarse = pooled(layers, most_cells=_MOST_CELLS)
        step = grid.rows // coarse.shape[1]
        west_m, south_m, east_m, north_m = grid.window(0, 0, *(side * step for side in coarse.shape[1:])).bounds_m
        colours = paint_overview(manifest, coarse)
        return cls(colours=colours, west_m=west_m, south_m=south_m, east_m=east_m, north_m=north_m)


@dataclass(frozen=True, kw_only=True)
class CasePicture:
    """Content of the picture of one query.

    Parameters
    ----------
    title : str
        Whose answer to what, and how it failed.
    view : Evidence
        What was seen.
    part : MapPart
        The map around the places.
    true : Pose, optional
        Where the view was taken; None where that is not on the map.
    is_present : bool
        Whether that place can be found; else it is drawn, and named so.
    modes : sequence of (Pose, float)
        The answer, best first; none where it was withheld.
    at_true, at_answer : Evidence, optional
        What the map shows at the true and at the first place.
    disc : (float, float, float), optional
        Easting, northing and radius of the disc that is searched.
    lines : sequence of str
        Lines on what the answer and the integrity model say.
    attribution : str
        Of the map.
    what, region : str
        Kind and strength of the stress, and the map that is searched.
    picture : ndarray of uint8, shape (H, W, 3), optional
        The newest picture that the evidence was made of, RGB.
    segmented : Segmented, optional
        What a segmenter says of that picture.
    is_own : bool
        Whether it is a user's own picture, whose true heading is the one that its file states.
    """

    title: str
    view: Evidence
    part: MapPart
    true: Pose | None
    is_present: bool
    modes: Sequence[tuple[Pose, float]]
    at_true: Evidence | None
    at_answer: Evidence | None
    disc: tuple[float, float, float] | None
    lines: Sequence[str]
    attribution: str
    what: str = ""
    region: str = ""
    picture: NDArray[np.uint8] | None = None
    segmented: Segmented | None = None
    is_own: bool = False

    @property
    def error_m(self) -> float | None:
        """Return the distance of the first place from the true one; None without either."""
        if self.true is None or not self.modes:
            return None
        first = self.modes[0][0]
        return math.hypot(first.easting_m - self.true.easting_m, first.northing_m - self.true.northing_m)

    @property
    def error_deg(self) -> float | None:
        """Return the difference of the first heading from the true one, 0 to 180; None without either."""
        if self.true is None or not self.modes:
            return None
        return abs(float(wrap_deg(self.modes[0][0].yaw_deg - self.true.yaw_deg)))

    @property
    def is_found(self) -> bool:
        """Return whether the first pose is right: within 25 m and 5 degrees, as `success_25m` counts it."""
        error_m, error_deg = self.error_m, self.error_deg
        if error_m is None or error_deg is None or not self.is_present:
            return False
        return error_m <= FIX_M and error_deg <= SUCCESS_DEG

    @property
    def is_turned(self) -> bool:
        """Return whether the place is right, as `within_25m` counts it, and the heading is not."""
        return self.is_present and self.error_m is not None and self.error_m <= FIX_M and not self.is_found


def disc_of(query: Query) -> tuple[float, float, float] | None:
    """Return the middle and radius of the searched disc, if the search is in a disc."""
    center_m, radius_m = query.prior.center_m, query.prior.radius_m
    return None if center_m is None or radius_m is None or query.candidates else (*center_m, radius_m)


def window_around(grid: Grid, middle_m: NDArray[np.float64], half_m: float) -> tuple[int, int, int, int]:
    """Return row, column, rows and columns of a square around a point, as far as the map reaches."""
    ends = grid.to_cells(middle_m + half_m * np.array([(-1.0, 1.0), (1.0, -1.0)]))
    row, col = np.clip(ends[0], 0, [grid.rows - 1, grid.cols - 1]).tolist()
    end_row, end_col = np.clip(ends[1] + 1, [row + 1, col + 1], [grid.rows, grid.cols]).tolist()
    return (row, col, end_row - row, end_col - col)


def seen_at(pose: Pose, view: Evidence, layers: LayerBits, grid: Grid, manifest: Manifest) -> Evidence:
    """Return the map at a place as a view of the size and classes of `view`."""
    cells = observe(layers, grid, pose, size_cells=view.shape[0], cell_size_m=view.cell_size_m)
    return view.replace(cells[[manifest.classes.index(name) for name in view.classes]])


def evidence_keys(shown: Collection[str]) -> list[Artist]:
    """Return legend entries of classes, in the order of the taxonomy, of none of them, and of what is unknown."""
    rest = {"none of these classes": GROUND, "unknown": HIDDEN}
    return [
        *class_keys(shown),
        *(Patch(facecolor=colour, edgecolor="#666666", lw=0.4, label=name) for name, colour in rest.items()),
    ]


def case_pixels(case: CasePicture) -> NDArray[np.uint8]:
    """Draw a query and its answer; pixels as of `picture.pixels_of`, the same for the same case."""
    about = Page(title=case.title, data=case.attribution)
    with styled():
        figure = new_figure((3 * _SIDE + _MAP + 0.5, _MAP + 1.2), dpi=_DPI)
        left, right = figure.framed(about).subfigures(1, 2, width_ratios=(3 * _SIDE, _MAP))
        above, below = left.subfigures(2, 1, height_ratios=(_SIDE, _MAP - _SIDE))
        where = "map at the true place" if case.is_present else "map where it was taken"
        panels = [("view", case.view), (where, case.at_true), ("map at the answer", case.at_answer)]
        charts = list(above.subplots(1, len(panels) + (case.picture is not None)))
        if case.picture is not None:
            draw_picture(charts.pop(0), case.picture)
        for chart, (name, evidence) in zip(charts, panels, strict=True):
            draw_panel(chart, name, evidence)
        draw_map(right.subplots(), case)
        modes, text = below.subplots(1, 2)
        _draw_modes(modes, case)
        text.axis("off")
        text.text(0, 1, "\n".join(case.lines), va="top", fontsize=6.8, linespacing=1.32)
        return pixels_of(figure)


def draw_panel(chart: Axes, name: str, evidence: Evidence | None) -> None:
    """Draw evidence, or that there is none."""
    without_ticks(chart)
    chart.set_title(name, fontsize=7.5)
    if evidence is None:
        chart.text(0.5, 0.5, "none", ha="center", va="center", fontsize=8, color=GREY, transform=chart.transAxes)
    else:
        chart.imshow(paint_evidence(evidence), interpolation="antialiased")


def draw_picture(chart: Axes, picture: NDArray[np.uint8]) -> None:
    """Draw the newest picture of a query."""
    without_ticks(chart)
    chart.set_title("picture", fontsize=7.5)
    chart.imshow(picture, interpolation="antialiased")


def draw_map(chart: Axes, case: CasePicture) -> None:
    """Draw the map, north up, in metres from the lower left corner."""
    part = case.part
    width_m, height_m = part.east_m - part.west_m, part.north_m - part.south_m
    side_m = max(width_m, height_m)
    chart.imshow(part.colours, extent=(0, width_m, 0, height_m), interpolation="antialiased", alpha=0.75)
    chart.set_xlim(0, side_m)
    chart.set_ylim(0, side_m)
    chart.set_facecolor(HIDDEN)
    chart.add_patch(Rectangle((0, 0), width_m, height_m, color="white", lw=0, zorder=-1))
    without_ticks(chart)
    shown = [("true place solid" if case.is_present else "where it was taken solid", case.true is not None)]
    shown += [("answer dashed", bool(case.modes)), ("search dotted", case.disc is not None)]
    key = ", ".join(name for name, is_there in shown if is_there)
    chart.set_title(f"map, north up, {side_m:.0f} m across:\n{key}", fontsize=7.5)
    if case.disc is not None:
        easting_m, northing_m, radius_m = case.disc
        middle = (easting_m - part.west_m, northing_m - part.south_m)
        chart.add_patch(Circle(middle, radius_m, fill=False, ec="#555555", lw=0.8, ls=":"))
    for number, (pose, _) in reversed(list(enumerate(case.modes[:MOST_MODES], start=1))[1:]):
        at = _at(pose, part)
        if 0 <= at[0] <= side_m and 0 <= at[1] <= side_m:
            chart.text(*at, str(number), fontsize=6.5, color=_OTHER, ha="center", va="center", path_effects=_HALO)
    size_m = case.view.size_m
    if case.true is not None:
        _outline(chart, case.true, size_m, part, colour=TRUE, dash="-")
    if case.modes:  # last: its dashes leave the true outline to be seen where both agree
        _outline(chart, case.modes[0][0], size_m, part, colour=ANSWERED, dash="--")
    if case.true is not None and case.modes:
        _offset(chart, case, part)
    scale_bar(chart, side_m, side_m)


def _at(pose: Pose, part: MapPart) -> tuple[float, float]:
    return (pose.easting_m - part.west_m, pose.northing_m - part.south_m)


def _outline(chart: Axes, pose: Pose, size_m: tuple[float, float], part: MapPart, *, colour: str, dash: str) -> None:
    """Draw the footprint of a view, with a notch at its top."""
    ring = shapely.get_coordinates(footprint(pose, size_m=size_m)) - (part.west_m, part.south_m)
    width = 2.6 if dash == "-" else 1.4
    halo = _HALO if dash == "-" else ()
    chart.plot(ring[:, 0], ring[:, 1], color=colour, ls=dash, lw=width, path_effects=halo)
    up = np.array([(0.0, 0.5), (0.0, 0.36)]) * size_m[1]
    top = pose.to_map(up) - (part.west_m, part.south_m)
    chart.plot(top[:, 0], top[:, 1], color=colour, lw=1.6, path_effects=_HALO)
    chart.plot(*_at(pose, part), color=colour, marker="o", ms=3.5, path_effects=_HALO)


def _offset(chart: Axes, case: CasePicture, part: MapPart) -> None:
    """Draw a line between both places, with its length."""
    if case.true is None:
        return
    ends = np.array([_at(case.true, part), _at(case.modes[0][0], part)])
    chart.plot(ends[:, 0], ends[:, 1], color="#000000", lw=0.7)
    middle = ends.mean(axis=0)
    text = f"{float(np.hypot(*(ends[1] - ends[0]))):.0f} m"
    chart.text(
        float(middle[0]),
        float(middle[1]),
        text,
        fontsize=7.5,
        ha="center",
        va="bottom",
        weight="bold",
        path_effects=_HALO,
    )


def _draw_modes(chart: Axes, case: CasePicture) -> None:
    """Draw the scores of the modes as bars from the least, each named by its distance from the true place."""
    chart.set_title("scores of the modes", fontsize=7.5)
    modes = list(case.modes[:MOST_MODES])
    chart.set_yticks([])
    if not modes:
        chart.set_xticks([])
        chart.text(0.5, 0.5, "no answer", ha="center", va="center", fontsize=8, color=GREY, transform=chart.transAxes)
        return
    scores = np.array([score for _, score in modes])
    least = min(0.0, float(scores.min())) if float(scores.min()) < 0 <= float(scores.max()) else float(scores.min())
    room = (float(scores.max()) - least) or 1.0
    base = least - 0.12 * room if least == float(scores.min()) else least
    places = np.arange(len(modes))
    colours = [ANSWERED if at == 0 else _OTHER for at in places]
    chart.barh(places, scores - base, left=base, height=0.7, color=colours)
    chart.set_yticks(places, [_away(case, pose, at + 1) for at, (pose, _) in enumerate(modes)], fontsize=6.3)
    chart.set_ylim(len(modes) - 0.4, -0.6)
    chart.set_xlim(base, float(scores.max()) + 0.04 * room)
    ends = sorted({float(scores.min()), float(scores.max())})
    chart.set_xticks(ends, [f"{end:.4g}" for end in ends], fontsize=6.3)
    chart.tick_params(axis="y", length=0, pad=2)
    rest = len(case.modes) - len(modes)
    unit = "score (the matcher's own unit)" + (f"; {rest} more" if rest > 0 else "")
    chart.set_xlabel(unit, fontsize=6.3, labelpad=1)


def _away(case: CasePicture, pose: Pose, number: int) -> str:
    """Return the number of a mode, and its distance from the true place."""
    if case.true is None:
        return str(number)
    away_m = np.hypot(pose.easting_m - case.true.easting_m, pose.northing_m - case.true.northing_m)
    return f"{number}: {away_m:.0f} m"


_SIDE_INCHES: Final = 2.7  # of the view
_MAP_INCHES: Final = 4.2
_ROOM: Final = 1.1  # around the disc of the prior
_CANDIDATE: Final = "#0072b2"


def plot_query(query: Query, region: Region, truth: Truth | None = None) -> Figure:
    """Draw a query: its picture, if it has one, its view, and the map around its prior.

    Parameters
    ----------
    query : Query
        A question, as of `read_queries`.
    region : Region
        The map that it searches: `read_region` of the region that it names.
    truth : Truth, optional
        Its answer, as of `read_truths`. With it, the map at the true place stands beside the view, and the footprint
        of the view is drawn on the map, its top marked.

    Returns
    -------
    matplotlib.figure.Figure
        A figure of its own, with the attribution of the map. A notebook shows it.

    Raises
    ------
    ConfigError
        If the region is not the one that the query names, or the truth is of another query.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import sasgeo_bench as sgb
    >>> with TemporaryDirectory() as folder:
    ...     place = sgb.tiny_place(Path(folder))
    ...     figure = plot_query(place.queries[0], place.region, place.truths[0])
    >>> [chart.get_title("left").partition(",")[0] for chart in figure.axes]
    ['view', 'map at the true place', 'map']
    """
    check_given(query, Query, "read_queries reads those of a task")
    check_given(region, Region, "read_region reads one from its folder")
    if truth is not None:
        check_given(truth, Truth, "read_truths reads those of a task")
    name = region.manifest.id
    if base_of(query.region) != base_of(name):
        raise ConfigError(f"query {query.query_id!r} searches the map {query.region!r}, got {name!r}: read that region")
    if truth is not None and truth.query_id != query.query_id:
        raise ConfigError(
            f"the truth is of query {truth.query_id!r}, the query is {query.query_id!r}: give its own truth"
        )
    case = _content(query, region, truth)
    panels = [("view", case.view), ("map at the true place", case.at_true)][: 1 + (case.at_true is not None)]
    count = len(panels) + (case.picture is not None)
    facts, keys = prior_words(query.prior_group), _keys(case, region)
    about = Page(title=case.title, facts=facts, data=case.attribution, keys=keys, columns=count + 2)
    with styled():
        figure = new_figure((count * _SIDE_INCHES + _MAP_INCHES, _MAP_INCHES + 1.6))
        ratios = (*[_SIDE_INCHES] * count, _MAP_INCHES)
        *small, large = figure.framed(about).subplots(1, count + 1, width_ratios=ratios)
        if case.picture is not None:
            draw_picture(small.pop(0), case.picture)
        for chart, (name, evidence) in zip(small, panels, strict=True):
            draw_panel(chart, name, evidence)
        draw_map(large, case)
        at = [(pose.easting_m - case.part.west_m, pose.northing_m - case.part.south_m) for pose in query.candidates]
        if at:
            large.plot(*np.transpose(at), color=_CANDIDATE, marker="x", ms=5, ls="")
        figure.arrange()
    return figure


def plot_evidence(evidence: Evidence, *, title: str = "evidence of one view", data: str = "not stated") -> Figure:
    """Draw what was seen in one view: the classes in their colours, and beside them how much is known.

    Parameters
    ----------
    evidence : Evidence
        What a segmenter, a mask or a view of the map says: `query.evidence`, or `Evidence.of_probabilities`.
    title, data : str
        What stands above, and whose data it is, below.

    Returns
    -------
    matplotlib.figure.Figure
        A figure of its own. The first panel is the view, up is where the camera looked; of evidence with a confidence
        the second one is the mean confidence of its known classes.

    Raises
    ------
    ConfigError
        If it is no evidence.

    Examples
    --------
    >>> chance = np.array([[[0.9, 0.2, np.nan]]])
    >>> figure = plot_evidence(Evidence.of_probabilities(("water",), chance, cell_size_m=2.0))
    >>> [chart.get_title("left") for chart in figure.axes]
    ['view, 6 m across', 'confidence, mean of the known classes']
    """
    check_given(evidence, Evidence, "query.evidence is one, or make it by Evidence.of_probabilities")
    rows, cols = evidence.shape
    width_m, height_m = cols * evidence.cell_size_m, rows * evidence.cell_size_m
    shown = {name for name, cells in zip(evidence.classes, evidence.cells, strict=True) if (cells == PRESENT).any()}
    known = evidence.cells != UNKNOWN
    facts = (
        f"{rows} x {cols} cells of {evidence.cell_size_m:g} m, {counted(len(evidence.classes), 'class', 'classes')}, "
        f"{evidence.unknown_share:.0%} unknown"
    )
    count = 1 if evidence.confidence is None else 2
    with styled():
        figure = new_figure((count * _MAP_INCHES + 0.6, _MAP_INCHES + 1.6))
        about = Page(title=title, facts=facts, data=data, keys=evidence_keys(shown), columns=2 * count)
        charts = figure.framed(about).subplots(1, count, squeeze=False)[0]
        extent = (0.0, width_m, 0.0, height_m)
        charts[0].imshow(paint_evidence(evidence), extent=extent, interpolation="nearest")
        charts[0].set_title(f"view, {width_m:.0f} m across", fontsize=7.5)
        scale_bar(charts[0], width_m, height_m)
        if evidence.confidence is not None:
            sure = np.where(known, evidence.confidence / CERTAIN, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
            hidden = np.ma.masked_array(sure, mask=~known.any(axis=0))
            charts[1].set_facecolor(HIDDEN)
            drawn = charts[1].imshow(hidden, extent=extent, vmin=0, vmax=1, cmap="cividis", interpolation="nearest")
            charts[1].set_title("confidence, mean of the known classes", fontsize=7.5)
            bar = charts[1].inset_axes((1.03, 0, 0.04, 1))
            charts[1].figure.colorbar(drawn, cax=bar)
            bar.tick_params(labelsize=6.5)
        for chart in charts:
            without_ticks(chart)
        figure.arrange()
    return figure


def _content(query: Query, region: Region, truth: Truth | None) -> CasePicture:
    """Return what is drawn; there is no answer in it."""
    row, col, rows, cols = _window(query, region.grid)
    layers, grid = region.layers[:, row : row + rows, col : col + cols], region.grid.window(row, col, rows, cols)
    true, manifest = None if truth is None else truth.pose, region.manifest
    shown = [manifest.attribution]
    if query.frames and manifest.imagery is not None:
        shown.append(manifest.imagery.attribution)
    return CasePicture(
        title=f"{query.suite} on {query.region}, {query.track}: query {query.query_id}",
        view=query.evidence,
        part=MapPart.of(layers, grid, manifest),
        true=true,
        is_present=truth is not None and truth.is_present,
        modes=(),
        at_true=None if true is None else seen_at(true, query.evidence, LayerBits.of(layers), grid, manifest),
        at_answer=None,
        disc=disc_of(query),
        lines=(),
        attribution="; ".join(shown),
        picture=query.frames[-1].image().rgb if query.frames else None,
    )


def _window(query: Query, grid: Grid) -> tuple[int, int, int, int]:
    """Return row, column, rows and columns of the map within reach of the prior; all of it without a disc."""
    disc = disc_of(query)
    if disc is None:
        return (0, 0, grid.rows, grid.cols)
    half_m = _ROOM * (disc[2] + float(np.hypot(*query.evidence.size_m)) / 2)
    return window_around(grid, np.array(disc[:2]), half_m)


def _keys(case: CasePicture, region: Region) -> list[Artist]:
    """Return the legend: the pose, the disc, candidates, and the classes of the map."""
    keys: list[Artist] = []
    if case.true is not None:
        keys.append(Line2D([], [], color=TRUE, lw=1.8, marker="o", ms=3.5, label="true pose"))
    if case.disc is not None:
        keys.append(Line2D([], [], color=GREY, lw=1.0, ls=":", label="prior: the place is in it"))
    else:
        keys.append(Line2D([], [], color=_CANDIDATE, marker="x", ms=5, ls="", label="candidate"))
    bands = [*zip(region.classes, region.layers, strict=True), *zip(case.view.classes, case.view.cells, strict=True)]
    return [*keys, *evidence_keys({name for name, cells in bands if (cells == PRESENT).any()})]
