# SPDX-License-Identifier: Apache-2.0
"""Intervals of a board's contrasts, computed again with numpy and statsmodels alone.

Reads `scores.parquet`, `contrasts.parquet` and `board.json` of a board, none of the program's code, and prints for each
contrast by success, interaction or shift: its bootstrap interval by places (places, blocks and sites drawn one by one),
by countries where places share some, the cluster-robust interval of statsmodels, a sign-flip p over places, and what
the board says. The cluster-robust interval is the narrower one: it does not resample blocks and sites.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import statsmodels.api as sm

DRAWS, FLIPS = 1000, 100_000
FOUND_M, FOUND_DEG = 25.0, 5.0  # success
SITE = ["suite", "pair_id", "view_cells", "detector"]  # of which a control belongs to a stress
VARIANT = ["suite", "pair_id", "view_cells", "kind", "strength"]  # of which there is a view by each detector
Tree = list[Any]  # of clusters within clusters; the innermost are arrays of differences


def differences(scores: pd.DataFrame, contrast: dict[str, Any]) -> pd.DataFrame:
    """Return first less second for each query of a contrast under stress, with its clusters.

    Of an interaction the difference on the control of the same site is taken off, of a shift that on the view of the
    same variant by the detector `published`; queries without one do not count.
    """
    rows = scores[scores["suite"].isin(contrast["suites"]) & (scores["track"] == contrast["track"])]
    is_shift = contrast["metric"] == "shift"
    if contrast.get("detectors"):
        rows = rows[rows["detector"].isin([*contrast["detectors"], *(["published"] if is_shift else [])])]
    hit = (rows["position_error_m"] <= FOUND_M) & (rows["yaw_error_deg"] <= FOUND_DEG)
    rows = rows.assign(hit=hit.astype(float), detector=rows["detector"].fillna("published"))
    keys = list(dict.fromkeys(["query_id", "country", "place", "block", "role", "is_present", *SITE, *VARIANT]))
    wide = rows.pivot_table(index=keys, columns="matcher", values="hit", observed=True).reset_index()
    wide = wide.dropna(subset=[contrast["first"], contrast["second"]])
    wide = wide.assign(gap=wide[contrast["first"]] - wide[contrast["second"]])
    counts = wide["kind"].str.startswith(tuple(contrast["kinds"]) or "") & ~wide["kind"].str.startswith("unrivalled")
    stress: pd.DataFrame = wide[(wide["role"] == "stress") & wide["is_present"] & counts]
    if contrast["metric"] == "primary":
        return stress
    other, on = wide[wide["role"] == "control"], SITE
    if is_shift:
        is_other = stress["detector"] == "published"
        other, on, stress = stress[is_other], VARIANT, stress[~is_other]
    control = other.groupby(on)["gap"].mean().rename("control").reset_index()
    both: pd.DataFrame = stress.merge(control, on=on)
    return both.assign(gap=both["gap"] - both["control"])


def tree_of(gaps: pd.DataFrame, levels: list[str]) -> Tree:
    """Return the differences as clusters within clusters, one level for each name."""
    if not levels:
        return list(gaps["gap"].to_numpy())
    return [tree_of(part, levels[1:]) for _, part in gaps.groupby(levels[0])]


def drawn(tree: Tree, depth: int, rng: np.random.Generator) -> Iterator[float]:
    """Yield the differences of clusters that are drawn with replacement at each of so many levels."""
    for at in rng.integers(0, len(tree), len(tree)):
        if depth == 1:
            yield from tree[at]
        else:
            yield from drawn(tree[at], depth - 1, rng)


def interval(gaps: pd.DataFrame, levels: list[str], rng: np.random.Generator) -> str:
    """Return the 95 % percentile interval of the mean, as a text."""
    tree = tree_of(gaps, levels)
    means = [np.mean(list(drawn(tree, len(levels), rng))) for _ in range(DRAWS)]
    return "[{:.3f}, {:.3f}]".format(*np.quantile(means, [0.025, 0.975]))


def main() -> None:
    """Print a line for each contrast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--board", type=Path, default=Path("docs/results/modules"))
    board = parser.parse_args().board
    said = pd.read_parquet(board / "contrasts.parquet").set_index("name")
    scores = pd.read_parquet(board / "scores.parquet")
    rng = np.random.default_rng(7)
    for contrast in json.loads((board / "board.json").read_text(encoding="utf-8"))["contrasts"]:
        if contrast["metric"] not in {"primary", "interaction", "shift"} or contrast["track"] != "localization":
            continue
        gaps = differences(scores, contrast)
        groups = gaps["place"].astype("category").cat.codes
        fit = sm.OLS(gaps["gap"], np.ones(len(gaps))).fit(cov_type="cluster", cov_kwds={"groups": groups})
        robust = fit.conf_int().iloc[0]
        sums = gaps.groupby("place")["gap"].sum().to_numpy()
        flipped = rng.choice([-1, 1], (FLIPS, len(sums))) @ sums
        p_value = (np.abs(flipped) >= abs(sums.sum()) - 1e-9).mean()
        row = said.loc[contrast["name"]]
        print(
            f"{contrast['name']}: n = {len(gaps)}, {gaps['gap'].mean():.3f}; bootstrap "
            f"{interval(gaps, ['place', 'block', 'pair_id'], rng)}, cluster-robust [{robust[0]:.3f}, {robust[1]:.3f}], "
            f"p {p_value:.4f}; the board {row['difference']:.3f} [{row['lo']:.3f}, {row['hi']:.3f}], "
            f"p {row['p_places']:.4f}"
        )
        if not np.isnan(row["lo_countries"]):
            print(
                f"  by countries {interval(gaps, ['country', 'place', 'block'], rng)}; "
                f"the board [{row['lo_countries']:.3f}, {row['hi_countries']:.3f}]"
            )


if __name__ == "__main__":
    main()
