# SPDX-License-Identifier: Apache-2.0
"""The search of `find` for many views at once, by PyTorch on a processor or a GPU."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import field as made
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError, ShapeError
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.search.field import FULL, Field, Template
from sasgeo_bench.search.find import Search
from sasgeo_bench.search.plan import Found, Mode, Null, Plan
from sasgeo_bench.search.torch_coarse import Coarse, Views
from sasgeo_bench.search.torch_modes import Guesses, Windows, climbed, polished, torch

Tensor = Any

DEVICES: Final = ("cpu", "cuda")
_AT_ONCE: Final = 64  # views: bounds the memory of what is held for each
MOST_BYTES: Final = {"cpu": 2**29, "cuda": 2**33}  # of what is made for a part of the views, headings or modes
_NONE: Final = Found(modes=(), null=Null(best=0.0, mean=0.0, deviation=0.0, places=0))


def search_batch(
    field: Field,
    templates: Sequence[Template],
    priors: Sequence[Prior],
    plan: Plan | None = None,
    *,
    count: int = 10,
    device: str = "cpu",
) -> list[Found]:
    """Find the best modes of several views on one map: what `find.search` finds for each, to rounding.

    Parameters
    ----------
    field : Field
        The map.
    templates, priors : sequences of equal length
        A view and its prior for each search. Views of one shape are refined together; those that also have one prior
        share the transforms of the map.
    plan : Plan, optional
        Settings of the search; its `threads` are those of `find` alone.
    count : int
        Most modes of a view.
    device : str
        "cpu", or "cuda" for a GPU.

    Returns
    -------
    list of Found
        One for each view, with no modes for an empty template or a prior beyond the map.

    Raises
    ------
    ConfigError
        If PyTorch or the device is missing.
    ShapeError
        If numbers of views, priors or classes differ.

    Notes
    -----
    Positions on the map are not rounded to 1/32 of a cell, nor its values to 1/255, as OpenCV does. On a GPU the
    coarsest level is scored in half precision, summed in single. So scores differ by some 0.1 %, and modes that score
    alike may change places.

    Examples
    --------
    Two views cut out of one map, one laid with its top to the north, one with its top to the south:

    >>> import numpy as np
    >>> from sasgeo_bench.geometry.grid import Grid
    >>> town = np.where(np.random.default_rng(0).random((1, 64, 64)) < 0.1, FULL, 0).astype(np.uint8)
    >>> grid = Grid(epsg=32632, west_m=0.0, north_m=64.0, cell_size_m=1.0, rows=64, cols=64)
    >>> field = Field.of(grid=grid, layers=town, known=np.full((64, 64), FULL, np.uint8))
    >>> seen = (town[:, 20:52, 10:42] / FULL).astype(np.float32)
    >>> views = [Template(weights=2 * s - 0.5, known=-s[0], cell_size_m=1.0) for s in (seen, seen[:, ::-1, ::-1])]
    >>> anywhere = Prior(center_m=None, radius_m=None, yaw_deg=None, yaw_sigma_deg=None, scale_sigma=0.0)
    >>> poses = [found.modes[0].pose for found in search_batch(field, views, [anywhere] * 2)]  # doctest: +SKIP
    >>> [(round(pose.easting_m), round(pose.northing_m), round(pose.yaw_deg) % 360) for pose in poses]  # doctest: +SKIP
    [(26, 28, 0), (26, 28, 180)]
    """
    return BatchSearch(field=field, plan=plan or Plan(), device=device).places(templates, priors, count=count)


@dataclass(frozen=True, kw_only=True)
class BatchSearch:
    """A map held on a device for searches: each of its levels is copied there once, as 4 bytes a cell and class.

    Headings lie at most `yaw_step_deg` apart, and scales likewise. See `search_batch` for the rest.
    """

    field: Field
    plan: Plan = made(default_factory=Plan)
    device: str = "cpu"
    yaw_step_deg: float = math.inf
    _searches: dict[tuple[object, ...], Search] = made(default_factory=dict, init=False, repr=False, compare=False)
    _levels: dict[int, Tensor] = made(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if torch is None:
            raise ConfigError("search_batch needs PyTorch: pip install 'sasgeo-bench[torch]'")
        if self.device not in DEVICES:
            raise ConfigError(f"device must be one of {', '.join(DEVICES)}, got {self.device!r}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ConfigError(
                "PyTorch finds no GPU for device 'cuda': use 'cpu', or install a build of PyTorch for this GPU"
            )

    def places(self, templates: Sequence[Template], priors: Sequence[Prior], *, count: int = 10) -> list[Found]:
        """Return the best modes of each view within its prior: at most `count`, best first."""
        if len(templates) != len(priors):
            raise ShapeError(f"each view has a prior, got {len(templates)} templates and {len(priors)} priors")
        groups: dict[tuple[object, ...], list[int]] = {}
        for at, template in enumerate(templates):
            if len(template.bands) != self.field.cells.shape[-1]:
                raise ShapeError(
                    f"templates[{at}] has {len(template.weights)} classes, the map {len(self.field.layers)}"
                )
            if len(template.active):
                patches = self._search(template, priors[at]).patches
                groups.setdefault((template.weights.shape, template.cell_size_m, patches), []).append(at)
        found = [_NONE] * len(templates)
        with torch.inference_mode():
            for group in groups.values():
                for start in range(0, len(group), _AT_ONCE):
                    part = group[start : start + _AT_ONCE]
                    some = self._together([templates[at] for at in part], [priors[at] for at in part], count)
                    for at, one in zip(part, some, strict=True):
                        found[at] = one
        return found

    def _together(self, templates: Sequence[Template], priors: Sequence[Prior], count: int) -> list[Found]:
        """Search for views of one shape, in areas of about one size."""
        views, searches = Views.of(templates, self.device), [self._search(templates[0], prior) for prior in priors]
        guesses, nulls = self.begun(views, searches)
        found = self.followed(views, searches, guesses)[:count]
        rows = zip(found.pose.cpu().numpy(), found.score.cpu().numpy(), nulls, strict=True)
        return [Found(modes=_modes(poses, scores), null=null) for poses, scores, null in rows]

    def _search(self, template: Template, prior: Prior) -> Search:
        """Return the settings of a search for any view of one shape; those of the last priors are kept."""
        key = (template.known.shape, template.cell_size_m, prior)
        if key not in self._searches:
            if len(self._searches) >= _AT_ONCE:
                self._searches.clear()
            self._searches[key] = Search(
                field=self.field, template=template, prior=prior, plan=self.plan, yaw_step_deg=self.yaw_step_deg
            )
        return self._searches[key]

    def _coarse(self, views: Views, search: Search) -> Coarse:
        level = self.field.level(search.factor)
        return Coarse.of(
            cells=self._cells(views, search.factor),
            level=level,
            views=views,
            turns=search.turns,
            most_bytes=MOST_BYTES[self.device],
        )

    def begun(self, views: Views, searches: Sequence[Search]) -> tuple[Guesses, list[Null]]:
        """Return modes of the coarsest level, best first, and statistics of its scores, for each view."""
        groups: dict[Prior, list[int]] = {}
        for at, search in enumerate(searches):
            groups.setdefault(search.prior, []).append(at)
        guesses, nulls = Guesses.none(len(searches), 1, self.device), [_NONE.null] * len(searches)
        for group in groups.values():
            search = searches[group[0]]
            tiles = [tile for tile in search.tiles if tile.allowed.any()]
            if tiles:
                found, some = self._coarse(views.some(group), search).found(
                    tiles, most=self.plan.width(0, search.patches)
                )
                most = max(found.score.shape[1], guesses.score.shape[1])
                guesses, found = guesses.filled(most), found.filled(most)
                guesses.pose[group], guesses.score[group] = found.pose, found.score
                for at, null in zip(group, some, strict=True):
                    nulls[at] = null
        return guesses, nulls

    def followed(self, views: Views, searches: Sequence[Search], guesses: Guesses) -> Guesses:
        """Refine modes to the map's own cells and between them; best first, then dropped ones."""
        plan, factor, cell_m = self.plan, searches[0].factor, self.field.grid.cell_size_m
        patches = searches[0].patches
        stride = self._tensor([(each.turns.yaw_step_deg, each.turns.scale_step) for each in searches])
        width = plan.width(0, patches)
        kept, behind = guesses[:width], [guesses[width - 1 :]]
        while factor > 1:
            factor, stride = factor // 2, stride / 2
            moved = climbed(self._level_views(views, factor), stride, kept, self._discs(searches, factor)).ranked()
            merged = moved.merged(factor * cell_m, stride[:, 0])
            width = plan.width(len(behind), patches)
            kept, behind = merged[:width], [*behind, merged[width - 1 :]]
        level_views, near = self._level_views(views, 1), self._discs(searches, 1)
        for move in (climbed, climbed, polished):
            kept, stride = move(level_views, stride, kept, near).ranked(), stride / 2
        for rest in reversed(behind):
            kept = kept.with_dropped(rest)
        return kept.inside(near).thinned(plan.apart_m)

    def _cells(self, views: Views, factor: int) -> Tensor:
        """Return the bands of a level that views need, 0..1, shape (B, rows, cols)."""
        if factor not in self._levels:
            cells = torch.from_numpy(self.field.level(factor).cells).to(self.device)
            self._levels[factor] = (
                cells.permute(2, 0, 1).to(torch.float32, memory_format=torch.contiguous_format) / FULL
            )
        cells = self._levels[factor]
        return cells if len(cells) == len(views.active) else cells[views.active]

    def _level_views(self, views: Views, factor: int) -> Windows:
        """Prepare views for one level, as `dense.LevelView` does."""
        level = self.field.level(factor)
        bands, frame = views.pooled(level, max(1, round(level.grid.cell_size_m / views.template.cell_size_m)))
        return Windows.of(
            cells=self._cells(views, factor),
            grid=level.grid,
            bands=bands,
            frame=frame,
            most_bytes=MOST_BYTES[self.device],
        )

    def _discs(self, searches: Sequence[Search], factor: int) -> Tensor:
        """Return easting, northing and radius of where each view may lie, shape (Q, 3); infinite without a prior."""
        discs = [search.within(factor) for search in searches]
        return self._tensor(
            [(*disc.center_m, disc.radius_m) if disc.center_m else (0.0, 0.0, math.inf) for disc in discs]
        )

    def _tensor(self, rows: Sequence[tuple[float, ...]]) -> Tensor:
        return torch.tensor(rows, dtype=torch.float64, device=self.device)


def _modes(poses: NDArray[np.float64], scores: NDArray[np.float64]) -> tuple[Mode, ...]:
    rows = zip(poses.tolist(), scores.tolist(), strict=True)
    return tuple(
        Mode(pose=Pose(easting_m=row[0], northing_m=row[1], yaw_deg=row[2], scale=row[3]), score=score)
        for row, score in rows
        if math.isfinite(score)
    )
