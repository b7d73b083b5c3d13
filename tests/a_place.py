# SPDX-License-Identifier: Apache-2.0
"""What every system must do: build a place, draw queries, ask a matcher, score and publish: `a_place.py FOLDER`.

Where there is no sandbox, it is refused in one line, and the matcher is asked without it.
"""

import sys
from pathlib import Path

import sasgeo_bench as sgb
from sasgeo_bench.core.errors import ConfigError

TOWN = "town-riverside"
WORDS = "Without the sandbox (--trusted), so that nothing kept the truths from it: prior_centre."


def main(folder: Path) -> None:
    """Do it all below a folder; raise what goes wrong."""
    out, has_sandbox = folder / "out", sys.platform == "linux"
    sgb.build_region(TOWN, out=out)
    tasks = sgb.make_tasks(suite="clean", regions=TOWN, n=1, out=out)
    if not has_sandbox:
        try:
            sgb.run(matcher="prior_centre", tasks=tasks, out=out)
        except ConfigError as error:
            print(error)  # noqa: T201 - a script
        else:
            raise RuntimeError("a matcher ran in a sandbox that this system has not")
    report = sgb.run(matcher="prior_centre", tasks=tasks, trusted=not has_sandbox, out=out)
    if set(report.counts) != {"ok"}:
        raise RuntimeError(f"answers are not sound: {report}")
    board = sgb.score(predictions=out / "runs", name="mine", draws=100, out=out)
    site = sgb.publish(board=board.folder)
    for page in (board.folder / "leaderboard.md", site.folder / "index.html"):
        if (WORDS in page.read_text(encoding="utf-8")) == has_sandbox:
            raise RuntimeError(f"{page} does not say how the matcher ran")
    print(site.to_text())  # noqa: T201 - a script


if __name__ == "__main__":
    main(Path(sys.argv[1]))
