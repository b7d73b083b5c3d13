# SPDX-License-Identifier: Apache-2.0
"""Rivals of drawn queries: in how many the disc and a plain search's list hold the true place and all its twins.

Reads the truths below OUT/truth (`make-queries` or a pipeline draws them) and prints a row for each suite and role:
queries, and shares of them that hold all rivals in the disc, that list all rivals, and that list the true place too. A
stress that does not is `unrivalled`. The last column is the share, of the queries that list both, whose best rival
scores lower than the true place; in the stress of `volatile-lure` such a lure tempts no search with even weights.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.suites.rivals import IN_DISC, LEAD, LISTED, RIVALS, TRUTH_LISTED, UNRIVALLED

ROLES = ("stress", "control", "falsifier")


def measured(out: Path) -> Iterator[dict[str, object]]:
    """Yield the measures of every query that has rivals."""
    for path in sorted((out / "truth").glob(f"*/*/{task_files.TRUTH}")):
        for truth in task_files.read_truths(path.parent):
            if RIVALS in truth.measured:
                told = truth.measured
                yield {
                    "suite": path.parent.parent.name,
                    "role": truth.role,
                    "in disc": told[IN_DISC] == told[RIVALS],
                    "rivals listed": told[LISTED] == told[RIVALS],
                    "both listed": told[LISTED] == told[RIVALS] and told[TRUTH_LISTED] == 1,
                    "unrivalled": truth.kind.startswith(UNRIVALLED),
                    "rival lower": told[LEAD] < 0 if LEAD in told else np.nan,
                }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out"))
    table = pd.DataFrame(measured(parser.parse_args().out))
    if table.empty:
        print("no truth below this folder has rivals: draw topology-twins, instance-twins or another suite of twins")
        return
    groups = table.groupby(["suite", "role"])
    shares = groups.mean().astype(float).round(3)
    shares.insert(0, "queries", groups.size())
    shares["unrivalled"] = groups["unrivalled"].sum().astype(int)
    print(shares.reindex(ROLES, level="role").to_string())


if __name__ == "__main__":
    main()
