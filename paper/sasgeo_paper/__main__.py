# SPDX-License-Identifier: Apache-2.0
"""`python -m sasgeo_paper`: the paper's first variant under every reading of decoys and descriptor.

Draws the region if it is not there, and writes OUT/paper-decoys.parquet and OUT/paper-decoys.md. Takes a minute.
"""

import argparse
from pathlib import Path

from sasgeo_bench.core.progress import reporting
from sasgeo_bench.regions.region_files import read_region
from sasgeo_paper import made_paper_task, make_paper_task
from sasgeo_paper.decoys import decoys_frame, decoys_markdown, every_reading
from sasgeo_paper.task import TRIALS, region_name


def main() -> None:
    """Print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--out", type=Path, default=Path("out"), help="root of what is built (default: out)")
    words = parser.parse_args()
    asked = {"seed": words.seed, "trials": words.trials, "out": words.out}
    with reporting(print):
        made_paper_task(**asked) or make_paper_task(**asked)
    region = read_region(words.out / "regions" / region_name(words.seed))
    table = decoys_frame(region, seed=words.seed, trials=words.trials, readings=list(every_reading()))
    text = decoys_markdown(table)
    table.to_parquet(words.out / "paper-decoys.parquet", index=False)
    (words.out / "paper-decoys.md").write_text(text, encoding="utf-8")
    print(text)  # noqa: T201 - its output


if __name__ == "__main__":
    main()
