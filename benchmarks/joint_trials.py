# SPDX-License-Identifier: Apache-2.0
"""Say what each term of the joint score is worth: the scorer with one switch set otherwise, on train places.

    .venv/bin/python benchmarks/joint_trials.py --out out/joint-trials
    .venv/bin/python benchmarks/joint_trials.py --out out/joint-trials --arm sasgeo --arm sasgeo_gains
    .venv/bin/python benchmarks/joint_trials.py --out out/joint-trials-again --seed 4321 --arm sasgeo --arm sasgeo_gains
    .venv/bin/python benchmarks/joint_trials.py --out out/joint-trials-again --seed 4321 --arm sasgeo~0.5 --arm sasgeo~1
    .venv/bin/python benchmarks/joint_trials.py --table docs/results/joint-trials.csv

The first command draws views of 192 m of a train place of each train country (split `trials`) of the suites in `DRAWN`,
and views of 96 m of all train places that have look-alikes; learns from the places of the other half, asks each arm,
and writes each answer; it resumes. `listed` is whether the truth is among the modes that the arm ranked. An arm with
`~` and a share is one whose learned numbers are drawn to those by hand, by that share of their logits and logarithms:
at 1 all are by hand. The last prints the table of stored answers: the share that is found within 25 m and 5 degrees,
and flips to right and to wrong against `sasgeo_gains`, which ranks by Eq. 11 alone, or the arm of `--against`.
Intervals are 95 %, by resampling places.
"""

import argparse
import csv
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import special

import sasgeo_bench as sgb
from benchmarks.open_numbers import places
from sasgeo_bench.core.errors import SasgeoError
from sasgeo_bench.geometry.pose import wrap_deg
from sasgeo_bench.running.training_tasks import spread
from sasgeo_bench.sasgeo.scorer_model import ScorerModel
from sasgeo_bench.sasgeo.variants import LISTED
from sasgeo_bench.scoring.intervals import ClusterDraws, mean_interval
from sasgeo_bench.tasks.query import base_of
from sasgeo_bench.tasks.split import find_split_file, read_split_file

SPLIT, WORLD, SEED, PRIOR = "trials", "world", 1234, "r500-weak-s3"
DRAWN: Final = {  # sites of each region, by suite
    "clean": 6,
    "volatile-lure": 4,
    "absent": 4,
    "local-warp": 2,
    "occlusion": 1,
    "topology-twins": 1,
    "instance-twins": 1,
    "real-age": 8,
    "natural-twins": 4,
}
DATED: Final = ("dreieich", "malabo")  # regions of the split with maps of several dates
TWINS: Final = "natural-twins"  # few places have some, so all train places are looked at
LESSONS: Final = ("real-age", "clean", "local-warp")
MOST, VIEW_M, RIGHT_M, RIGHT_DEG = 100, 192.0, 25.0, 5.0
USUAL: Final = "sasgeo_gains"
SHARES: Final = ("hit", "false_alarm", "missing")  # of the rates: chances, whose logits are mixed
ARMS: Final = (
    "sasgeo",
    USUAL,
    "sasgeo_gains_search",
    "sasgeo_no_pose_prior",
    "sasgeo_no_amounts",
    "sasgeo_no_overlap",
    "sasgeo_overlap_always",
    "sasgeo_graph_alone",
    "sasgeo_no_graph",
    "sasgeo_prior",
    "sasgeo~0.5",
    "sasgeo~1",
    "schmidt_segcorr",
    "raster_soft",
)
# What is asked: suite, role, and kinds as they begin.
ASKED: Final = (
    ("clean", "stress", "perception"),  # at 1 to 4 times the detector's error
    ("volatile-lure", "stress", "S2"),
    ("absent", "stress", "feature-poor"),
    ("real-age", "stress", ""),
    ("real-age", "control", ""),
    ("occlusion", "stress", "U4"),
    ("topology-twins", "stress", ""),
    ("instance-twins", "stress", ""),
    (TWINS, "stress", "N1 vectors"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """An answer of an arm to a view: whether it is right, whether the truth was listed, seconds of the processor."""

    arm: str
    group: str
    place: str
    query_id: str
    is_found: bool
    is_listed: bool
    view_s: float


@dataclass(frozen=True, slots=True)
class _Lesson:
    place: str
    suite: str
    query: sgb.Query
    truth: sgb.Truth

    @property
    def query_id(self) -> str:
        return self.query.query_id


@cache
def countries() -> dict[str, str]:
    """Return the first region of each train place of the world, with its country."""
    listed = read_split_file(find_split_file(WORLD)).place
    return {place.region_ids[0]: place.country or place.name for place in listed if place.part == "train"}


def draw(out: Path, seed: int) -> None:
    """Draw the views of all suites; a region of which there are some is left alone."""
    on = {"real-age": DATED, TWINS: tuple(countries())}
    for suite, sites in DRAWN.items():
        there = {base_of(folder.name) for folder in (out / "tasks" / suite).glob("*")}
        wanted = [name for name in on.get(suite, tuple(places())) if name not in there]
        prior = {"prior": PRIOR} if suite in ("clean", "volatile-lure", "absent") else {}
        if wanted:
            sgb.make_tasks(
                suite=[suite],
                regions=wanted,
                split=WORLD if suite == TWINS else SPLIT,
                n=sites,
                seed=seed,
                out=out,
                up_to=True,
                skip=True,
                **prior,
            )


def pairs(out: Path, suite: str) -> Iterator[tuple[sgb.Query, sgb.Truth]]:
    """Yield the views of a suite, with their truths."""
    for folder in sorted((out / "tasks" / suite).iterdir()):
        truths = {truth.query_id: truth for truth in sgb.read_truths(out / "truth" / suite / folder.name)}
        for query in sgb.read_queries(folder):
            if query.track == "localization":
                yield query, truths[query.query_id]


def groups(out: Path) -> Iterator[tuple[str, sgb.Query, sgb.Truth]]:
    """Yield what is asked, by group: suite, role where it is no stress, and strength of clean views."""
    for suite, role, kind in ASKED:
        for query, truth in pairs(out, suite):
            is_meant = truth.role == role and truth.kind.removeprefix("unrivalled ").startswith(kind)
            is_meant &= suite != "clean" or truth.strength >= 1
            is_meant &= suite == TWINS or round(max(query.evidence.size_m)) == VIEW_M
            if is_meant and truth.is_present and truth.pose:
                at = f" x{truth.strength:g}" if suite == "clean" else ""
                yield f"{suite}{at}{'' if role == 'stress' else ' ' + role}", query, truth


def learned(out: Path, arm: str, half: str) -> str | None:
    """Return what an arm learns from the places of the other half; learned once, and stored."""
    arm, _, share = arm.partition("~")
    if share:
        text = learned(out, arm, half)
        return None if text is None else drawn_to_hand(ScorerModel.from_text(text), float(share)).to_text()
    matcher: Any = sgb.load_matcher(arm)
    if not isinstance(matcher, sgb.Learner):
        return None
    path = out / "learned" / f"{arm}-for-{half}.json"
    if not path.exists():
        lessons = [
            _Lesson(base_of(query.region), suite, query, truth)
            for suite in LESSONS
            for query, truth in pairs(out, suite)
            if half_of(query.region) != half
            and truth.is_present
            and (truth.role != "stress" or truth.kind.startswith(("S1", "perception")))
        ]
        keys = (lambda one: one.place, lambda one: one.suite, lambda one: one.truth.pair_id)
        chosen = spread(lessons, keys)[:MOST]  # type: ignore[arg-type] # as a run does
        regions = {name: sgb.read_region(out / "regions" / name) for name in {one.query.region for one in chosen}}
        path.parent.mkdir(parents=True, exist_ok=True)
        text = matcher.learn(sgb.Training(regions=regions, pairs=[(one.query, one.truth) for one in chosen]))
        path.write_text(text, encoding="utf-8")
    return path.read_text(encoding="utf-8")


def drawn_to_hand(model: ScorerModel, share: float) -> ScorerModel:
    """Return a model whose numbers lie between the learned ones, at a share of 0, and those by hand, at 1.

    >>> hand = ScorerModel.by_hand(["building"])
    >>> twice = replace(hand, scaling=4 * hand.scaling)
    >>> (drawn_to_hand(twice, 0.5).scaling / hand.scaling).round(6).tolist(), drawn_to_hand(twice, 1.0) == hand
    ([2.0], True)
    >>> sure = replace(hand, rates=(replace(hand.rates[0], hit=0.25),))  # chances are mixed by their odds
    >>> odds = [one.rates[0].hit / (1 - one.rates[0].hit) for one in (sure, hand, drawn_to_hand(sure, 0.5))]
    >>> round(odds[2] ** 2 / (odds[0] * odds[1]), 6)
    1.0
    """
    hand = ScorerModel.by_hand(model.classes)

    def between(one: Any, two: Any, name: str = "") -> Any:  # noqa: ANN401 - numbers or arrays of them
        if name in SHARES:
            odds = (special.logit(np.clip(value, 1e-6, 1 - 1e-6)) for value in (one, two))
            return special.expit(np.average(list(odds), axis=0, weights=[1 - share, share]))
        logs = (np.log(np.maximum(value, 1e-6)) for value in (one, two))
        return np.exp(np.average(list(logs), axis=0, weights=[1 - share, share]))

    def each(one: Any, two: Any, left_out: str = "") -> dict[str, float]:  # noqa: ANN401 - of a dataclass
        both = ((item.name, getattr(one, item.name), getattr(two, item.name)) for item in fields(one))
        return {name: float(between(a, b, name)) for name, a, b in both if name != left_out}

    # How much of the ground a class covers is counted, not learned.
    rates = [replace(one, **each(one, two, "mapped")) for one, two in zip(model.rates, hand.rates, strict=True)]
    return replace(
        model,
        rates=tuple(rates),
        likeness=np.average([model.likeness, hand.likeness], axis=0, weights=[1 - share, share]),
        missed_share=np.average([model.missed_share, hand.missed_share], axis=0, weights=[1 - share, share]),
        scaling=between(model.scaling, hand.scaling),
        blend=replace(model.blend, **each(model.blend, hand.blend)),
    )


@cache
def half_of(region: str) -> str:
    """Return the half of the split that the country of a region is in; "a" of a country that it does not have."""
    listed = read_split_file(find_split_file(SPLIT)).place
    own = next((place for place in listed if base_of(region) in place.region_ids), None)
    country = own.country if own else countries().get(base_of(region))
    return str(next((place.half for place in listed if place.country == country), "a"))


def ask(out: Path, arm: str, done: set[tuple[str, str]]) -> Iterator[Answer]:
    """Yield the answers of an arm that are not there yet."""
    matcher: Any = None
    on = ""
    for group, query, truth in sorted(groups(out), key=lambda item: item[1].region):
        if (arm, query.query_id) in done or truth.pose is None:
            continue
        if query.region != on:
            matcher, on = sgb.load_matcher(arm.partition("~")[0]), query.region
            matcher.prepare(sgb.read_region(out / "regions" / on), learned(out, arm, half_of(on)))
        start = time.process_time()
        poses = matcher.match(query, top_k=LISTED).poses
        view_s = time.process_time() - start
        right = [is_right(pose, truth.pose) for pose in poses]
        yield Answer(
            arm=arm,
            group=group,
            place=base_of(query.region),
            query_id=query.query_id,
            is_found=bool(right and right[0]),
            is_listed=any(right),
            view_s=round(view_s, 3),
        )


def is_right(pose: sgb.Pose, truth: sgb.Pose) -> bool:
    """Return whether a pose is right."""
    far_m = np.hypot(pose.easting_m - truth.easting_m, pose.northing_m - truth.northing_m)
    return bool(far_m <= RIGHT_M and abs(wrap_deg(pose.yaw_deg - truth.yaw_deg)) <= RIGHT_DEG)


def read_answers(path: Path) -> list[Answer]:
    """Read stored answers; none where there is no file."""
    if not path.exists():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Answer(
                **{name: row[name] for name in ("arm", "group", "place", "query_id")},
                is_found=row["is_found"] == "True",
                is_listed=row["is_listed"] == "True",
                view_s=float(row["view_s"]),
            )
            for row in csv.DictReader(file)
        ]


def lines(answers: Sequence[Answer], usual: str = USUAL) -> Iterator[str]:
    """Yield a row for each arm: what it finds in each group, and how that differs from the usual one."""
    of_arm = {arm: {one.query_id: one for one in answers if one.arm == arm} for arm in ARMS}
    of_arm = {arm: own for arm, own in of_arm.items() if own}
    every = list(dict.fromkeys(one.group for one in answers))
    wanted = {"clean x3 + x4": ("clean x3", "clean x4"), **{name: (name,) for name in sorted(every)}}
    yield f"| Arm | s | {' | '.join(wanted)} |"
    yield f"|---|---:|{'---|' * len(wanted)}"
    for arm, own in of_arm.items():
        cells = [f"{np.median([one.view_s for one in own.values()]):.2f}"]
        for names in wanted.values():
            asked = [one for one in own.values() if one.group in names and one.query_id in of_arm.get(usual, {})]
            cells.append(
                _cell(
                    asked,
                    [of_arm[usual][one.query_id] for one in asked],
                    with_interval=len(names) > 1 or TWINS in names,
                )
            )
        yield f"| `{arm}` | {' | '.join(cells)} |"


def _cell(own: Sequence[Answer], usual: Sequence[Answer], *, with_interval: bool) -> str:
    if not own:
        return "-"
    more = np.array([int(one.is_found) - int(two.is_found) for one, two in zip(own, usual, strict=True)])
    told = f"{np.mean([one.is_found for one in own]):.3f} of {np.mean([one.is_listed for one in own]):.3f}"
    if with_interval:
        gain = mean_interval(100.0 * more, ClusterDraws(blocks=[one.place for one in own], seed=SEED))
        told += f", {gain.value:+.1f} [{gain.lo:.1f}, {gain.hi:.1f}]"
    return f"{told} ({(more > 0).sum()}/{(more < 0).sum()}), n {len(own)}"


def main() -> None:
    """Draw, learn, ask and store; or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/joint-trials"), help="folder of maps, views and answers")
    parser.add_argument("--arm", action="append", default=[], help="matcher to ask; may be repeated; default: all")
    parser.add_argument(
        "--seed", type=int, default=SEED, help="of the views: another one takes other sites of the places"
    )
    parser.add_argument("--against", default=USUAL, help="arm that the others are compared with")
    parser.add_argument("--table", type=Path, help="print the table of stored answers, and stop")
    options = parser.parse_args()
    try:
        if options.table is None:
            draw(options.out, options.seed)
            path = options.out / "answers.csv"
            for arm in options.arm or ARMS:
                done = {(one.arm, one.query_id) for one in read_answers(path)}
                with path.open("a", encoding="utf-8", newline="") as file:
                    table = csv.DictWriter(file, [item.name for item in fields(Answer)], lineterminator="\n")
                    if not done:
                        table.writeheader()
                    for one in ask(options.out, arm, done):
                        table.writerow(asdict(one))
                        file.flush()
        print(*lines(read_answers(options.table or options.out / "answers.csv"), options.against), sep="\n")
    except SasgeoError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
