# SPDX-License-Identifier: Apache-2.0
"""The page of a profile: what a matcher costs on a small computer, in a folder of its own."""

import base64
import hashlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from matplotlib.lines import Line2D

from sasgeo_bench.boards.site import environment
from sasgeo_bench.core.canvas import Page, page
from sasgeo_bench.core.errors import StoreError, counted
from sasgeo_bench.core.folders import check_known, check_room, fresh_folder, is_ours, locked
from sasgeo_bench.regions.build import package_version
from sasgeo_bench.regions.region import ATTRIBUTION
from sasgeo_bench.running.profiling import Profile

RECORD: Final = "profile.json"
PAGE: Final = "index.html"
FIGURE: Final = "latency.svg"
_FILES: Final = frozenset({RECORD, PAGE, FIGURE})
_MOST_DRAWN: Final = 5000  # fixes


def facts(of: Profile) -> Iterator[tuple[str, str, str]]:
    """Yield names, values and meanings of what a profile says."""
    yield "latency p50", _seconds(of.latency_s(0.5)), "half of the answers take no longer"
    yield "latency p95", _seconds(of.latency_s(0.95)), "19 of 20 answers take no longer"
    yield "latency p99", _seconds(of.latency_s(0.99)), "99 of 100 answers take no longer"
    yield "processor per fix", _seconds(_mean([fix.cpu_s for fix in of.answered])), "by the matcher's process"
    yield "first fix", _seconds(of.first_s), "after the map was prepared; not among the others"
    yield "start", _seconds(of.start_s), "until the process had loaded the matcher"
    yield "map prepared", _seconds(of.prepare_s), "before the first fix, once"
    yield "peak memory", _megabytes(of.peak_bytes), "of all processes of the matcher, the interpreter included"
    yield "growth by the map", _megabytes(of.index_bytes), "while it was prepared"
    yield "map on disk", _megabytes(of.map_bytes), f"{of.map_bytes / 1e3 / of.km2:,.0f} kB a km2"
    yield "bytes per fix", f"{of.query_bytes:,.0f}", "of a query, as it is sent to the matcher"
    if of.joules is None:
        yield "energy per fix", "-", "this computer has no counter that we may read"
    else:
        yield "energy per fix", f"{of.joules / max(len(of.fixes), 1):.2f} J", "of all the computer's processor packages"


def _mean(values: list[float]) -> float:
    return sum(values) / len(values) if values else math.nan


def _seconds(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.2f} s" if value >= 1 else f"{1e3 * value:.3g} ms"


def _megabytes(value: float) -> str:
    return f"{value / 1e6:,.1f} MB"


def check_profile(folder: Path) -> None:
    """Raise `StoreError` if a profile could not be written there, or would replace something else."""
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is no folder: name another one")
    check_known(folder, _FILES if is_ours(folder / RECORD) else (), "a profile")
    check_room(folder)


def write_profile(of: Profile, folder: Path) -> None:
    """Write a profile, its page and its figure, whole or not at all; an earlier profile is replaced.

    Raise `StoreError` if the folder holds other files, or cannot be written.
    """
    check_profile(folder)
    made_by = f"sasgeo-bench {package_version()}"
    try:
        with locked(folder), fresh_folder(folder) as scratch:
            record = json.dumps({"attribution": ATTRIBUTION, "made_by": made_by, **of.to_dict()}, indent=1)
            (scratch / RECORD).write_text(record, encoding="utf-8")
            _draw(of, scratch / FIGURE)
            template = environment().get_template("profile.html")
            style = hashlib.sha256(environment().get_template("site.css").render().encode()).digest()
            style_sha256 = base64.b64encode(style).decode()
            text = template.render(of=of, rows=list(facts(of)), made_by=made_by, style_sha256=style_sha256)
            (scratch / PAGE).write_text(text, encoding="utf-8")
    except StoreError:
        raise
    except OSError as error:
        raise StoreError(
            f"{folder} cannot be written ({error.strerror or error}): check the free space and your rights"
        ) from error


def _draw(of: Profile, path: Path) -> None:
    """Draw latency against time, and the median of each minute."""
    step = -(-len(of.answered) // _MOST_DRAWN) or 1
    shown = of.answered[::step]
    note = f"one of {step} answers is drawn" if step > 1 else ""
    rows = of.minutes()
    about = Page(
        title=f"Latency of {of.matcher} on {of.region}",
        data=ATTRIBUTION,
        facts=f"{counted(int(of.machine['cores']), 'core')} of {of.machine['processor']}",
        note=note,
        panel_inches=(6.4, 2.6),
        keys=(
            Line2D([], [], marker=".", linestyle="none", color="C0", label="an answer"),
            Line2D([], [], color="C1", label="median of a minute"),
        ),
    )
    with page(path, about) as ((chart,),):
        chart.plot([fix.since_s for fix in shown], [fix.seconds for fix in shown], ".", color="C0", markersize=3)
        for row in rows:
            since_s = 60.0 * (row["minute"] - 1)
            chart.plot([since_s, since_s + 60.0], [row["p50_s"]] * 2, color="C1", linewidth=2)
        chart.set_xlabel("time since the first (s)")
        chart.set_ylabel("latency (s)")
        chart.set_ylim(bottom=0.0)
        chart.set_xlim(0.0, max([fix.since_s + fix.seconds for fix in of.fixes], default=1.0))
