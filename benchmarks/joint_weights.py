# SPDX-License-Identifier: Apache-2.0
"""What other weights and gates of the joint score would find among the modes that the scorer lists, on train places.

    .venv/bin/python -m benchmarks.joint_weights --out out/joint-trials

Takes the views, maps and models of `benchmarks/joint_trials.py` (run that first, with `--arm sasgeo`), searches each
view once, stores the terms of its modes (`modes.json`), and prints how many views each setting finds: the learned
weights of amounts and of the overlap times a factor, and gates for the say of areas by the overlap of lines, summed
over their classes or of their ground as one. The search stays as it is.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from benchmarks.joint_trials import groups, half_of, is_right
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.sasgeo.ablations import Switches
from sasgeo_bench.sasgeo.joint import columns
from sasgeo_bench.sasgeo.overlap import BADLY_SEEN, BLUNT, LEAST_M2, Compared
from sasgeo_bench.sasgeo.reading import Reader
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import LISTED
from sasgeo_bench.search.find import search
from sasgeo_bench.search.plan import Plan

Floats = NDArray[np.float64]
FACTORS: Final = (0.5, 0.7, 1.0, 1.4, 2.0)


@dataclass(frozen=True, kw_only=True)
class Modes:
    """The modes of a view: which are right, terms of Eq. 11 and those of heading and scale, and what is compared.

    `terms` has shape (M,), `unlike` too; `overlaps`, `both` and `either`, areas, have shape (M, C), `is_line` (C,).
    """

    group: str
    right: NDArray[np.bool_]
    terms: Floats
    unlike: Floats
    overlaps: Floats
    both: Floats
    either: Floats
    is_line: NDArray[np.bool_]
    weights: tuple[float, float]  # of amounts and of the overlap

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Self:
        """Read a view as it is stored."""
        arrays = {name: np.array(value) for name, value in stored.items() if isinstance(value, list)}
        return cls(group=stored["group"], **arrays | {"weights": tuple(stored["weights"])})

    def lines_seen(self, *, as_one: bool) -> float:
        """Return how well lines are seen at the best of all modes: the sum over classes, or their ground as one."""
        if not as_one:
            return float(self.overlaps[:, self.is_line].sum(axis=1).max())
        both, either = (areas[:, self.is_line].sum(axis=1) for areas in (self.both, self.either))
        return float((both / np.maximum(either, LEAST_M2)).max())

    def finds(self, *, say: float, amount: float = 1.0, overlap: float = 1.0) -> bool:
        """Return whether the best mode is right, areas having some say, weights of amounts and overlap some factors."""
        of_all = self.overlaps[:, self.is_line].sum(axis=1) + say * self.overlaps[:, ~self.is_line].sum(axis=1)
        scores = self.terms - amount * self.weights[0] * self.unlike + overlap * self.weights[1] * of_all
        return bool(self.right[scores.argmax()])


def searched(out: Path) -> Iterator[dict[str, Any]]:
    """Yield the modes of each view, as they are stored."""
    on, reader = "", None
    for group, query, truth in sorted(groups(out), key=lambda item: item[1].region):
        if query.region != on:
            on, region = query.region, sgb.read_region(out / "regions" / query.region)
            text = (out / "learned" / f"sasgeo-for-{half_of(on)}.json").read_text(encoding="utf-8")
            reader = Reader.of(region, ScorerModel.from_text(text), Switches())
        if reader is None or truth.pose is None:
            continue
        reading = reader.read(query)
        plan = reading.plan(Plan())
        found = search(reader.field, reading.searched, query.prior, plan, count=LISTED, starts=reading.proposed())
        poses = [mode.pose for mode in found.modes]
        if not poses:
            continue
        verified, blend = reading.verified(poses), reader.model.blend
        graph = None if verified is None else np.array([one.score for one in verified])
        nodes = 0 if graph is None else len(reading.observed.nodes)
        terms = columns(reading.by_class(poses) * reader.model.scaling, graph, blend, nodes=nodes).sum(axis=1)
        beside, names = reading.beside(poses), reader.region.classes
        near = reader.model.likeness[:, 1]
        compared = Compared.of(query.evidence, names, reader.field, poses, near=near)
        yield {
            "group": group,
            "right": [is_right(pose, truth.pose) for pose in poses],
            "terms": (terms + beside[:, :2] @ blend.beside[:2]).tolist(),
            "unlike": compared.unlike.sum(axis=1).tolist(),
            "overlaps": compared.overlaps.tolist(),
            "both": compared.both.tolist(),
            "either": compared.either.tolist(),
            "is_line": [name in load_taxonomy().lines for name in names],
            "weights": [blend.amount, blend.overlap],
        }


def settings() -> Iterator[tuple[str, Callable[[Modes], bool]]]:
    """Yield settings by name: whether one finds a view."""

    def gated(view: Modes, middle: float, width: float, *, as_one: bool) -> float:
        return float(1 / (1 + np.exp((view.lines_seen(as_one=as_one) - middle) / width)))

    yield "areas always count", lambda view: view.finds(say=1.0)
    yield "areas never count", lambda view: view.finds(say=0.0)
    for as_one, middle, width in (
        *((False, at, 0.05) for at in (0.2, 0.25, 0.3, 0.4)),
        *((True, at, 0.03) for at in (0.1, 0.15, 0.2, 0.25, 0.3)),
    ):
        name = f"lines {'as one' if as_one else 'by class'}, {middle:g} / {width:g}"
        yield name, lambda view, g=(middle, width, as_one): view.finds(say=gated(view, g[0], g[1], as_one=g[2]))
    for key in ("amount", "overlap"):
        for factor in FACTORS:
            yield (
                f"{factor:g} times the {key}",
                lambda view, f={key: factor}: view.finds(say=gated(view, BADLY_SEEN, BLUNT, as_one=True), **f),
            )


def main() -> None:
    """Search and store, unless that is done; print a row for each setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/joint-trials"), help="folder of joint_trials.py")
    out = parser.parse_args().out
    kept = out / "modes.json"
    if not kept.exists():
        kept.write_text(json.dumps(list(searched(out))), encoding="utf-8")
    views = [Modes.of(one) for one in json.loads(kept.read_text(encoding="utf-8"))]
    names = sorted({view.group for view in views})
    print(f"| Setting | {' | '.join(names)} |\n|---|{'---:|' * len(names)}")
    listed = [sum(bool(view.right.any()) for view in views if view.group == name) for name in names]
    print(f"| (listed) | {' | '.join(map(str, listed))} |")
    for name, finds in settings():
        counts = [sum(finds(view) for view in views if view.group == group) for group in names]
        print(f"| {name} | {' | '.join(map(str, counts))} |")


if __name__ == "__main__":
    main()
