# SPDX-License-Identifier: Apache-2.0
"""Intervals of a board's contrasts by places, computed again with numpy and statsmodels alone.

Reads `scores.parquet`, `contrasts.parquet` and `board.json` of a board, none of the program's code, and prints for each
contrast by success: its bootstrap interval (places, blocks and sites drawn one by one), the cluster-robust interval of
statsmodels, a sign-flip p over places, and what the board says. The cluster-robust interval is the narrower one: it
does not resample blocks and sites.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd
import statsmodels.api as sm

DRAWS, FLIPS = 1000, 100_000
FOUND_M, FOUND_DEG = 25.0, 5.0  # success


def differences(board: Path, contrast: dict) -> pd.DataFrame:
    """Return first less second for each query of a contrast under stress, with its place, block and site."""
    scores = pd.read_parquet(board / "scores.parquet")
    rows = scores[
        scores["suite"].isin(contrast["suites"])
        & (scores["track"] == contrast["track"])
        & (scores["role"] == "stress")
        & scores["is_present"]
        & scores["kind"].str.startswith(tuple(contrast["kinds"]) or "")
    ]
    if contrast.get("detectors"):
        rows = rows[rows["detector"].isin(contrast["detectors"])]
    rows = rows.assign(hit=((rows["position_error_m"] <= FOUND_M) & (rows["yaw_error_deg"] <= FOUND_DEG)).astype(float))
    wide = rows.pivot_table(index=["query_id", "place", "block", "pair_id"], columns="matcher", values="hit")
    wide = wide.reset_index().dropna(subset=[contrast["first"], contrast["second"]])
    return wide.assign(gap=wide[contrast["first"]] - wide[contrast["second"]])


def bootstrap(gaps: pd.DataFrame, rng: np.random.Generator) -> np.ndarray:
    """Return means of places, blocks in them, and sites in these, each drawn with replacement, shape (DRAWS,)."""
    places = [
        [[site["gap"].to_numpy() for _, site in block.groupby("pair_id")] for _, block in place.groupby("block")]
        for _, place in gaps.groupby("place")
    ]
    means = []
    for _ in range(DRAWS):
        drawn = []
        for at in rng.integers(0, len(places), len(places)):
            blocks = places[at]
            for which in rng.integers(0, len(blocks), len(blocks)):
                sites = blocks[which]
                drawn += [sites[one] for one in rng.integers(0, len(sites), len(sites))]
        means.append(np.concatenate(drawn).mean())
    return np.array(means)


def main() -> None:
    """Print a line for each contrast."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--board", type=Path, default=Path("docs/results/leaderboard"))
    board = parser.parse_args().board
    said = pd.read_parquet(board / "contrasts.parquet").set_index("name")
    rng = np.random.default_rng(7)
    for contrast in json.loads((board / "board.json").read_text(encoding="utf-8"))["contrasts"]:
        if contrast["metric"] != "primary" or contrast["track"] != "localization":
            continue
        gaps = differences(board, contrast)
        lo, hi = np.quantile(bootstrap(gaps, rng), [0.025, 0.975])
        groups = gaps["place"].astype("category").cat.codes
        fit = sm.OLS(gaps["gap"], np.ones(len(gaps))).fit(cov_type="cluster", cov_kwds={"groups": groups})
        robust = fit.conf_int().iloc[0]
        sums = gaps.groupby("place")["gap"].sum().to_numpy()
        flipped = rng.choice([-1, 1], (FLIPS, len(sums))) @ sums
        p_value = (np.abs(flipped) >= abs(sums.sum()) - 1e-9).mean()
        row = said.loc[contrast["name"]]
        print(
            f"{contrast['name']}: n = {len(gaps)}, {gaps['gap'].mean():.3f}; bootstrap [{lo:.3f}, {hi:.3f}], "
            f"cluster-robust [{robust[0]:.3f}, {robust[1]:.3f}], p {p_value:.4f}; "
            f"the board [{row['lo']:.3f}, {row['hi']:.3f}], p {row['p_places']:.4f}"
        )


if __name__ == "__main__":
    main()
