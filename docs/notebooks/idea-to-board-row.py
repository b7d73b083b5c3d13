# ---
# jupyter:
#   # SPDX-License-Identifier: Apache-2.0
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A matcher, from idea to board row
#
# This notebook takes an idea to a row on a board, on a synthetic town, in about a minute. It uses the public API and
# the command line, and nothing is downloaded. To follow along, activate the environment of the checkout and work in
# an empty folder.
#
# **The idea.** Roads are everywhere, so that a road under a road says little. Water or a railway is rare, so that it
# says much. The matcher counts the cells on which view and map agree, and weighs each class by its rarity on the map.

# %% [markdown]
# ## Look at a query
#
# `tiny_place` builds a town of 1 km2 with a few queries and their truths. A query holds what was seen, class by class,
# and what is known before.

# %%
from pathlib import Path

import sasgeo_bench as sgb

place = sgb.tiny_place(Path("tiny"))
query, truth = place.queries[0], place.truths[0]
print(place.region.classes)
print(query.track, query.evidence.cells.shape, query.evidence.cell_size_m, "m a cell")
print(query.prior)

# %% [markdown]
# A cell is absent (0), present (1) or unknown (2). An unknown cell says nothing, in either direction.

# %%
cells = query.evidence.cells
for name, band in zip(query.evidence.classes, cells, strict=True):
    if (band == sgb.PRESENT).any():
        print(f"{name:15} {(band == sgb.PRESENT).mean():6.1%} present {(band == sgb.UNKNOWN).mean():6.1%} unknown")

# %% [markdown]
# ## Write the matcher
#
# A matcher is a class with a card and two methods. `prepare` gets a map, once. `match` gets a query and returns poses,
# best first. The class goes into a file of its own, because every matcher runs in its own process.

# %%
# %%writefile rare_class.py
import sasgeo_bench as sgb

STEPS = 17  # places a side of the lattice over the disc of the prior


class RareClass:
    """Count agreeing cells, and weigh each class by its rarity on the map."""

    card = sgb.MatcherCard(
        name="rare_class",
        version="1",
        title="Agreement weighted by rarity",
        source="original",
        ours="all of it",
        licence="Apache-2.0",
        tracks=("retrieval", "localization"),
        needs=("position",),
        limits="a coarse lattice, refined around its three best places; no confidence",
    )

    def prepare(self, region: sgb.Region, learned: str | None) -> None:
        """Keep the map, and the weight of each class."""
        self.region = region
        self.layers = sgb.LayerBits.of(region.layers)
        self.weights = 1 / ((region.layers == sgb.PRESENT).mean(axis=(1, 2)) + 0.01) ** 0.5

    def match(self, query: sgb.Query, *, top_k: int) -> sgb.Match:
        """Rank the candidates; or search a lattice of places, and refine the best."""
        if (query.evidence.cells == sgb.UNKNOWN).all():
            return sgb.WITHHELD
        ranked = self.rank(query, query.candidates or self.lattice(query))[:top_k]
        if not query.candidates:
            ranked = self.rank(query, [self.refine(query, pose) for _, pose in ranked[:3]])
        return sgb.Match(poses=[pose for _, pose in ranked], scores=[score for score, _ in ranked])

    def rank(self, query: sgb.Query, poses: list[sgb.Pose]) -> list[tuple[float, sgb.Pose]]:
        """Poses with their scores, best first."""
        return sorted(((self.score(query, pose), pose) for pose in poses), key=lambda item: -item[0])

    def lattice(self, query: sgb.Query) -> list[sgb.Pose]:
        """Places spread over the disc of the prior, with its heading."""
        (east, north), radius = query.prior.center_m, query.prior.radius_m
        steps = [2 * at / (STEPS - 1) - 1 for at in range(STEPS)]
        yaw = query.prior.yaw_deg or 0.0
        return [
            sgb.Pose(easting_m=east + x * radius, northing_m=north + y * radius, yaw_deg=yaw)
            for x in steps
            for y in steps
            if x * x + y * y <= 1
        ]

    def refine(self, query: sgb.Query, pose: sgb.Pose) -> sgb.Pose:
        """Move to the best neighbour, again and again, by ever smaller steps."""
        step_m, step_deg = query.prior.radius_m / STEPS, 16.0
        while step_m > 2:
            around = [
                sgb.Pose(
                    easting_m=pose.easting_m + x * step_m,
                    northing_m=pose.northing_m + y * step_m,
                    yaw_deg=pose.yaw_deg + turn * step_deg,
                )
                for x in (0, -1, 1)
                for y in (0, -1, 1)
                for turn in (0, -1, 1)
            ]
            pose = self.rank(query, around)[0][1]
            step_m, step_deg = step_m / 2, step_deg / 2
        return pose

    def score(self, query: sgb.Query, pose: sgb.Pose) -> float:
        """Weighted overlap of view and map; unknown cells are left out."""
        seen = query.evidence
        size, cell_size_m = seen.shape[0], seen.cell_size_m
        mapped = sgb.observe(self.layers, self.region.grid, pose, size_cells=size, cell_size_m=cell_size_m)
        order = [self.region.classes.index(name) for name in seen.classes]
        mapped, weights = mapped[order], self.weights[order]
        known = (seen.cells != sgb.UNKNOWN) & (mapped != sgb.UNKNOWN)
        here, there = seen.cells == sgb.PRESENT, mapped == sgb.PRESENT
        agree = (known & here & there).sum(axis=(1, 2)) @ weights
        either = (known & (here | there)).sum(axis=(1, 2)) @ weights
        return float(agree / either) if either else 0.0


# %% [markdown]
# ## Check it
#
# `check` asks what every matcher must hold to: finite scores in order, the same answer twice, no answer where
# everything is unknown. `module:Class` names a matcher that is not installed; a package of your own begins with
# `sasgeo-bench new matcher`.

# %% magic_args="-e" language="bash"
# sasgeo-bench check rare_class:RareClass

# %% [markdown]
# ## Ask it questions
#
# Build a synthetic town, draw the suite `clean` on it at two sites, and answer the queries. `random` and
# `prior_centre` are the baselines to beat: one guesses, the other answers with the centre of the prior.

# %% magic_args="-e" language="bash"
# sasgeo-bench build-region town-riverside
# sasgeo-bench make-queries --suite clean --regions town-riverside --n 2

# %% magic_args="-e" language="bash"
# sasgeo-bench run --matcher rare_class:RareClass --tasks out/tasks/clean/town-riverside --jobs 2
# sasgeo-bench run --matcher prior_centre --tasks out/tasks/clean/town-riverside
# sasgeo-bench run --matcher random --tasks out/tasks/clean/town-riverside

# %% [markdown]
# ## Read the row
#
# `score` holds the answers against the truths and writes a board: tables, figures and pictures of failures.

# %% magic_args="-e" language="bash"
# sasgeo-bench score --predictions out/runs --tasks out/tasks/clean/town-riverside --name first

# %% [markdown]
# The row is there, with its interval. `out/boards/first/leaderboard.md` holds the whole board, with costs, strata and
# the meaning of each column.
#
# Two sites in one place are one block, or few. Intervals are wide, and with fewer than six blocks no entry is ranked:
# the board says so instead of showing an order that the next draw would change. For a row that can be ranked, ask more
# sites in more places: `sasgeo-bench leaderboard demo --matcher rare_class:RareClass`.
#
# ## Where to go on
#
# - `sasgeo-bench inspect out/runs/rare_class` lists the failures by class, and `--query ID` draws one.
# - [Add a matcher](../howto/matcher.md) says what a matcher may read, learn and report.
# - [Board](../concepts/board.md) explains every part of what you saw above.
