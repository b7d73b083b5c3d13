# SPDX-License-Identifier: Apache-2.0
"""Say what is left of success when evidence comes from pictures: modelled, rendered, shifted, real; suite by suite.

    .venv/bin/python benchmarks/sim_to_real.py docs/results/aerial

Reads `scores.parquet` of a board of `pipelines/aerial.toml`. Found is within 25 m and 5 deg, or, as `--metres 10
--degrees 10` says, within other limits; no answer is a miss. Intervals (95 %) draw places, then blocks and sites within
them; of a single place blocks and sites, and they say nothing of other places. Where all draws agree the interval is
Wilson's, of as many sites as there are. Differences are of the same views, or of views of one site.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sasgeo_bench.scoring.intervals import ClusterDraws, percentile_interval, seed_of_text, wilson_share

LOOKS = ("published", "rendered", "shifted")
VIEW = ["matcher", "suite", "pair_id", "role", "kind", "strength", "view_cells"]
SITE = ["matcher", "suite", "pair_id", "detector"]
BLIND = ("oracle_pose", "prior_centre", "random")  # controls, which look at no evidence
HEAD = "| Matcher | Evidence | Views | n | Places | Found, % | 95 % |\n|---|---|---|---:|---:|---:|---|"


def estimate(rows: pd.DataFrame, values: pd.Series) -> tuple[float, float, float]:
    """Return the mean of some values in percent and its interval; `rows` have place, block and pair_id."""
    drawn = ClusterDraws(
        blocks=rows["block"].tolist(),
        sites=rows["pair_id"].tolist(),
        places=rows["place"].tolist(),
        seed=seed_of_text("sim_to_real"),
    )
    table = np.column_stack((values.to_numpy(float), np.ones(len(values))))
    sums = np.concatenate(list(drawn.sums(table)))
    found = percentile_interval(float(values.mean()), sums[:, 0] / np.maximum(sums[:, 1], 1))
    if found.lo == found.hi and set(values) <= {0.0, 1.0}:
        found = wilson_share(float(values.mean()), rows["pair_id"].nunique())
    return 100 * found.value, 100 * found.lo, 100 * found.hi


def read_scores(board: Path, metres: float, degrees: float) -> pd.DataFrame:
    """Return the rows of present places with `hit`, and the suite without its segmenter, which is a column."""
    scores = pd.read_parquet(board / "scores.parquet")
    scores = scores[scores["is_present"] & scores["suite"].str.contains("+", regex=False)]
    hit = (scores["position_error_m"] <= metres) & (scores["yaw_error_deg"] <= degrees)
    parts = scores["suite"].str.split("+", n=1, expand=True)
    text = {name: scores[name].astype(str) for name in ("matcher", "place", "block", "pair_id", "kind", "detector")}
    return scores.assign(hit=hit.astype(float), suite=parts[0], segmenter=parts[1], **text)


def asked(scores: pd.DataFrame) -> list[str]:
    """Return the matchers that look at evidence, by name."""
    return sorted(set(scores["matcher"]) - set(BLIND))


def line(*cells: object) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def row_of(rows: pd.DataFrame, *labels: object) -> str:
    """Return a row with the share that is found."""
    value, lo, hi = estimate(rows, rows["hit"])
    return line(*labels, len(rows), rows["place"].nunique(), f"{value:.0f}", f"{lo:.0f} to {hi:.0f}")


def by_evidence(scores: pd.DataFrame) -> Iterator[str]:
    """Yield what is found of the views of suite aerial by where their evidence comes from, and of real pictures."""
    yield HEAD
    aerial = scores[(scores["suite"] == "aerial") & (scores["role"] != "falsifier")]
    real = scores[(scores["suite"] == "real-image") & (scores["role"] != "falsifier")]
    real = real[~real["kind"].str.startswith(("R3", "R5"))]  # older maps, several frames
    for matcher in asked(aerial):
        for cells, name in ((192, "192 m from 160 m"), (96, "96 m from 80 m")):
            own = aerial[(aerial["matcher"] == matcher) & (aerial["view_cells"] == cells)]
            for look in LOOKS:
                yield row_of(own[own["detector"] == look], matcher, look, name)
        for place, segmenter in sorted(set(zip(real["place"], real["segmenter"], strict=True))):
            own = real[(real["matcher"] == matcher) & (real["place"] == place) & (real["segmenter"] == segmenter)]
            for is_degraded, words in ((False, ""), (True, ", worse map")):
                of_map = own[own["kind"].str.startswith("R2") == is_degraded]
                for side_m, rows in sorted(of_map.groupby(of_map["view_cells"] * of_map["cell_size_m"]), reverse=True):
                    yield row_of(rows, matcher, f"{place}, {segmenter}", f"{side_m:g} m{words}")


def by_difference(scores: pd.DataFrame) -> Iterator[str]:
    """Yield the differences of two looks on the same views of suite aerial."""
    yield "| Matcher | Difference | Views | n | Places | Points | 95 % |\n|---|---|---|---:|---:|---:|---|"
    aerial = scores[(scores["suite"] == "aerial") & (scores["role"] != "falsifier")]
    for matcher in asked(aerial):
        for first, second in (("rendered", "published"), ("shifted", "rendered")):
            for cells in (192, 96):
                own = aerial[(aerial["matcher"] == matcher) & (aerial["view_cells"] == cells)]
                one, two = (own[own["detector"] == look] for look in (first, second))
                both = one.merge(two[[*VIEW, "hit"]], on=VIEW, suffixes=("", "_second"))
                value, lo, hi = estimate(both, both["hit"] - both["hit_second"])
                name = f"{first} less {second}"
                labels = (matcher, name, f"{cells} m", len(both), both["place"].nunique())
                yield line(*labels, f"{value:+.0f}", f"{lo:+.0f} to {hi:+.0f}")


def by_suite(scores: pd.DataFrame, suites: Sequence[str], matcher: str) -> Iterator[str]:
    """Yield by suite and step what a matcher finds, and the difference from the control of the same site."""
    yield (
        "| Suite | Segmenter | Step | n | Places | Found, % | Less control, points | 95 % |\n"
        "|---|---|---|---:|---:|---:|---:|---|"
    )
    own = scores[(scores["matcher"] == matcher) & (scores["detector"] == "rendered")]
    for suite in suites:
        for segmenter in sorted(set(own.loc[own["suite"] == suite, "segmenter"])):
            rows = own[(own["suite"] == suite) & (own["segmenter"] == segmenter)]
            control = rows[rows["role"] == "control"]
            yield line(suite, segmenter, "control", len(control), control["place"].nunique(), share(control), "", "")
            steps = rows[rows["role"] != "control"]
            for (role, kind, strength), part in steps.groupby(["role", "kind", "strength"], observed=True):
                both = part.merge(control[[*SITE, "hit"]], on=SITE, suffixes=("", "_control"))
                if both.empty:
                    continue
                value, lo, hi = estimate(both, both["hit"] - both["hit_control"])
                step = f"{kind} {strength:g}" if role == "stress" else f"falsifier: {kind}"
                cells = (len(both), both["place"].nunique(), share(both), f"{value:+.0f}", f"{lo:+.0f} to {hi:+.0f}")
                yield line(suite, segmenter, step, *cells)


def share(rows: pd.DataFrame) -> str:
    """Return what is found of some rows, percent."""
    return f"{100 * rows['hit'].mean():.0f}"


def main() -> None:
    """Print the three tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board", type=Path)
    parser.add_argument("--metres", type=float, default=25.0)
    parser.add_argument("--degrees", type=float, default=5.0)
    parser.add_argument("--matcher", default="sasgeo", help="of the table suite by suite")
    given = parser.parse_args()
    scores = read_scores(given.board, given.metres, given.degrees)
    suites = [name for name in dict.fromkeys(scores["suite"]) if name not in ("aerial", "real-image")]
    for table in (
        by_evidence(scores),
        by_difference(scores),
        by_suite(scores, ["aerial", *sorted(suites)], given.matcher),
    ):
        print("\n".join(table), end="\n\n")


if __name__ == "__main__":
    main()
