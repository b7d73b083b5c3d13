# ---
# jupyter:
#   # SPDX-License-Identifier: Apache-2.0
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Reading a board
#
# A board is a folder of tables. This notebook reads the one of the registered experiment `modules`, which lies in the
# repository, and asks of it: who finds places on old maps, how surely is that known, and whom may one believe when it
# says "here"? Nothing is run or scored; it takes ten seconds.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import sasgeo_bench as sgb

repository = Path(sgb.__file__).parents[1]
board = sgb.read_board(repository / "docs" / "results" / "modules")
board

# %% [markdown]
# ## One figure, one row
#
# `leaderboard` holds every figure with what is needed to read it: how many queries `n`, in how many blocks of ground
# and places, the 95 % interval, and the ranks that the data leave open. A *suite* is one thing that is done to a view
# or a map; its *stratum* says which of its queries. `success_25m` is the share of queries answered within 25 m and
# 5 deg.

# %%
rows = board.leaderboard
aged = rows[(rows["suite"] == "real-age") & (rows["metric"] == "success_25m") & (rows["stratum"] == "stress")]
columns = ["matcher", "is_control", "n", "blocks", "places", "value", "lo", "hi", "rank_best", "rank_worst"]
aged.sort_values("value", ascending=False)[columns].round(3)

# %% [markdown]
# In the suite `real-age` the view is of today and the map is up to ten years old. The three controls do not compete:
# `oracle_pose` is told the answer, `prior_centre` and `random` guess. All others share their ranks. No pair of them can
# be told apart by these places, and the order of the table is not a result.

# %% [markdown]
# ## Older maps
#
# The steps of the suite are strata of their own.

# %%
steps = {
    "no age": "control",
    "2 years": "S1 2, 192 cells",
    "5 years": "S1 5, 192 cells",
    "10 years": "S1 10, 192 cells",
}
some = rows[(rows["suite"] == "real-age") & (rows["metric"] == "success_25m") & ~rows["is_control"]]
figure, chart = plt.subplots(figsize=(7.5, 3.6), layout="constrained")
for number, (matcher, mine) in enumerate(some.groupby("matcher")):
    line = mine.set_index("stratum").loc[list(steps.values())]
    at = np.arange(len(steps)) + 0.06 * (number - 2.5)
    errors = np.abs(line[["lo", "hi"]].to_numpy().T - line["value"].to_numpy())
    chart.errorbar(at, line["value"], yerr=errors, marker="o", ms=4, lw=1.2, elinewidth=0.8, label=matcher)
chart.set(xticks=range(len(steps)), xticklabels=list(steps), ylim=(0, 1.03), ylabel="success within 25 m and 5 deg")
_ = chart.legend(ncols=2, fontsize=8, loc="lower left")

# %% [markdown]
# All lines end lower than they begin, and at each step their intervals overlap. Places differ far more than matchers
# do: that is what the width of the bars is made of.
#
# ## The same places, pair by pair
#
# Much of that width cancels if two matchers are compared on the same queries. Here is such a comparison by hand: the
# difference at each query. Queries of one place are alike, and so are those of one block of ground, of about 1 km. So
# whole places are drawn anew, and in each its blocks.

# %%
queries = board.scores[
    (board.scores["suite"] == "real-age")
    & (board.scores["role"] == "stress")
    & (board.scores["detector"] == "measured")
    & board.scores["is_present"]
]
found = queries.assign(found=(queries["is_right"] & (queries["yaw_error_deg"] <= 5)).astype(float))
pairs = found.pivot_table(index=["place", "block", "query_id"], columns="matcher", values="found")
difference = pairs["sasgeo"] - pairs["sasgeo_prior"]

sums = difference.groupby(["place", "block"]).agg(["sum", "size"])
places = [blocks.to_numpy() for _, blocks in sums.groupby("place")]


def drawn_again(rng: np.random.Generator, *, with_blocks: bool) -> float:
    """Mean difference of places drawn with replacement, and of blocks drawn in each of them."""
    total = np.zeros(2)
    for place in (places[at] for at in rng.integers(0, len(places), len(places))):
        total += place[rng.integers(0, len(place), len(place))].sum(axis=0) if with_blocks else place.sum(axis=0)
    return total[0] / total[1]


print(f"difference {difference.mean():+.3f}, {len(difference)} queries of {len(places)} places")
for with_blocks in (False, True):
    rng = np.random.default_rng(0)
    lo, hi = np.quantile([drawn_again(rng, with_blocks=with_blocks) for _ in range(2000)], [0.025, 0.975])
    print(f"[{lo:+.3f}, {hi:+.3f}] of places {'and their blocks' if with_blocks else 'alone'}")

stored = board.contrasts.set_index("name").loc["learned-age"]
print(f"[{stored['lo']:+.3f}, {stored['hi']:+.3f}] on the board, difference {stored['difference']:+.3f}")
print(stored["verdict"])

# %% [markdown]
# What is drawn decides: places alone, as if each were fully known, would have shown a difference. The board draws both,
# and says that nothing is shown. Nor is it a tie: that would need the whole interval within what was registered to
# matter, three percent either way.
#
# ## All registered contrasts
#
# They were named, with the least difference that matters, before anything was run.

# %%
board.plot_contrasts()

# %%
board.contrasts[["name", "first", "second", "n", "difference", "lo", "hi", "p_holm", "outcome"]].round(3)

# %% [markdown]
# Thirteen questions give thirteen chances to find something by luck, hence the adjustment by Holm. It is why an
# interval may leave out 0 and still not be decided.
#
# ## Cost
#
# Latency is that of the machine where each matcher ran. Matchers compare on the suite that most of them were asked.

# %%
board.plot_tradeoff()

# %% [markdown]
# ## Whom to believe
#
# A drone rather wants no fix than a false one. Each matcher states a confidence. Accept the surest answers first, and
# see how many of the accepted ones are false: a good line stays at the bottom for long. Panels have queries of their
# own: compare shapes, not heights.

# %%
board.plot_risk("r500-weak-s3")

# %%
risks = rows[(rows["metric"] == "aurc") & (rows["suite"] == "absent") & ~rows["is_control"]]
risks.pivot_table(index="matcher", columns="rejector", values="value").round(3)

# %% [markdown]
# `aurc` is the area under such a line, less is better; most views of the suite `absent` show places that are not on the
# map. A *rejector* estimates from what an answer tells how likely it is false; `own` is the matcher's own confidence.
#
# ## May the board itself be believed?
#
# Controls are queries whose right score is known beforehand. One that fails is named here; then do not trust the row.

# %%
checks = board.controls.groupby("control")["holds"].agg(["sum", "size"])
checks.rename(columns={"sum": "held", "size": "asked"})

# %% [markdown]
# ## Where to go on
#
# - [How a board is made](../concepts/board.md) and [metrics](../reference/metrics.md) define every column.
# - [Results](../results/modules.md) says what this experiment shows, in words.
# - [A matcher, from idea to board row](idea-to-board-row.py) puts a row of your own on a board.
