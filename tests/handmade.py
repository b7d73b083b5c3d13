# SPDX-License-Identifier: Apache-2.0
"""Boards made by hand, for their sites: ranks, ties, controls, hostile names, pictures of failures."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from sasgeo_bench.boards.board_files import ANSWER_SCHEMA, AdditionalFiles, write_board
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.plots import BoardPage
from sasgeo_bench.core.canvas import page
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA
from sasgeo_bench.scoring.contrasts import Contrast, evaluate_contrasts
from sasgeo_bench.scoring.controls import CONTROL_SCHEMA, Verdict
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, RUN_HERE, EntryLabel, Row, with_entry_labels
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.scoring.tables import leaderboard
from tests.scoring.test_tables import scores

HOSTILE = "<script>alert(1)</script>"
MARKUP = "<img src=x onerror=alert(2)> & <b>bold</b> \"quoted\" 'too'"
SHARES = {"graph": 0.9, "raster": 0.88, "weak": 0.2, "far": 0.05, "random": 0.02}  # of right answers
COUNT = 160
CONTRASTS = (
    Contrast(name="real", first="graph", second="weak", suites=("real-age",)),
    Contrast(name="close", first="graph", second="raster", suites=("real-age",)),
)


def asked(share, *, suite="real-age", track="localization", prior="r500-weak-s3", count=COUNT):
    """Rows of one matcher that is right on a share of the queries, the easiest; half of them are controls."""
    at = np.arange(count)
    is_right = ((at * 37) % count) < share * count
    is_stress = at % 2 > 0
    return scores(
        np.where(is_right, 2.0, 80.0),
        blocks=40,
        suite=suite,
        track=track,
        prior_group=prior,
        kind=np.where(is_stress, "S1", "control"),
        role=np.where(is_stress, "stress", "control"),
        strength=np.where(is_stress, np.where(at % 4 == 1, 5.0, 10.0), 0.0),
        query_id=[f"{suite}-{track}-{prior}-{one:05d}" for one in at],
        place=[f"place{one % 20}" for one in at],
        block=[f"place{one % 20}/{one % 40}" for one in at],
        pool=10 if track == "retrieval" else 0,
        above=np.where(is_right, 0, 1),
        tied=1,
        right=1,
    )


def asked_everything(share):
    """Two suites, both tracks and two prior groups."""
    return pd.concat(
        [
            asked(share),
            asked(share, prior="rnone-unknown-s15", count=80),
            asked(share, suite="occlusion"),
            asked(share, suite="occlusion", track="retrieval", prior="rnone-weak-s3"),
        ],
        ignore_index=True,
    )


def card_of(name, **changes):
    values = {"name": name, "version": "1", "title": f"Title of {name}", "source": "original", "ours": "all of it"}
    values |= {"licence": "MIT", "tracks": ["localization", "retrieval"], "needs": [], "limits": "", "trained_on": []}
    return values | changes


def entry_of(name, **changes):
    values = {"name": name, "version": "1", "hash": "0123abcd", "how": "run here", "card": card_of(name), "learned": []}
    return values | {"isolation": {"network": "none"}} | changes


def about_of(entries, **changes):
    regions = ("vaduz@2015-07-27", "vaduz+alias", "monaco", "oakland", "town-grid")
    tasks = [
        {"suite": "real-age", "region": name, "map_date": "2015-07-27", "queries_sha256": "ab"} for name in regions
    ]
    values = {"scorer_version": SCORER_VERSION, "task_version": 1, "data_version": 1, "made_by": "sasgeo-bench 0.1.0"}
    values |= {"libraries": {"numpy": "2"}, "pipeline": None, "split": "crossfit", "draws": 200, "by_region": []}
    values |= {"rejectors": [], "remarks": [], "entries": entries, "tasks": tasks}
    return BoardManifest.model_validate(values | changes)


def put_board(folder, *, table=None, entries=(), findings=(), verdicts=(), scored=None, extras=(), **about):
    """Write a board of these parts."""
    table = FIGURE_SCHEMA.frame([]) if table is None else table
    named = {entry["name"]: EntryLabel(entry["version"], entry["hash"], RUN_HERE) for entry in entries}
    nobody = EntryLabel("1", "", RUN_HERE)
    write_board(
        folder,
        tables={
            "leaderboard": with_entry_labels(table, dict.fromkeys(table["matcher"], nobody) | named),
            "scores": pd.DataFrame() if scored is None else scored,
            "contrasts": CONTRAST_SCHEMA.frame(findings),
            "controls": CONTROL_SCHEMA.frame(verdicts),
        },
        about=about_of(list(entries), **about),
        extras=[AdditionalFiles(texts={"leaderboard.md": "# Board\n", "leaderboard.tex": "% board\n"}), *extras],
    )
    return folder


def verdict(*, holds=True):
    return Verdict(control="blind views withheld", matcher="graph", n=4, found=0, expected=0, p=np.nan, holds=holds)


def draw(path):
    """A figure of the board's."""
    about = BoardPage(title="Success against the age of the map: real-age", note="n 80 each", below="years")
    with page(path, about) as charts:
        charts[0][0].plot([0, 1], [1, 0])


def full_board(folder, *, shares=SHARES, holds=True, tested="graph", changes=None, added=()):
    """A board with all there can be but pictures; `changes` are of entries, by name, `tested` had the control."""
    scored = {name: asked_everything(share) for name, share in shares.items()}
    facts = {"track": "localization", "n": 160, "answered": 160, "missing": 0, "blocks": 40, "places": 20}
    facts |= {"suite": "all suites", "prior_group": "r500-weak-s3", "better": "lower"}
    judged = [
        Row(
            matcher=name,
            rejector="own",
            stratum="as drawn",
            metric=metric,
            unit="1",
            value=0.2,
            lo=0.1,
            hi=0.3,
            **facts,
        )
        for name in list(shares)[:2]
        for metric in ("aurc", "coverage_at_risk_0.05", "brier")
    ]
    costs = [
        Row(matcher=name, rejector="", stratum="all", metric=metric, unit=unit, value=1.5, **facts | {"track": track})
        for name in shares
        for metric, unit, track in (("latency_p50", "s", "localization"), ("peak_memory", "MB", "all"))
    ]
    known = [item for item in CONTRASTS if {item.first, item.second} <= shares.keys()]
    return put_board(
        folder,
        table=pd.concat([leaderboard(scored, draws=200), FIGURE_SCHEMA.frame([*judged, *costs])], ignore_index=True),
        entries=[entry_of(name, **(changes or {}).get(name, {})) for name in shares],
        findings=evaluate_contrasts(known, scored, {}, draws=200),
        verdicts=[replace(verdict(holds=holds), matcher=tested)],
        scored=pd.concat([frame.assign(matcher=name) for name, frame in scored.items()], ignore_index=True),
        extras=[
            AdditionalFiles(
                figures={"age-real-age-localization-r500-weak-s3.svg": draw},
                tables={"answers": answers_of([*shares, "__proto__"])},  # a name that means something in JavaScript
            )
        ],
        contrasts=[
            {name: getattr(item, name) for name in ("name", "first", "second", "suites", "kinds", "metric", "track")}
            for item in known
        ],
        added=list(added),
    )


def answers_of(names, **changes):
    """Three answers of each matcher: a right one, one 300 m off, and none to a place that is absent."""
    right = {"true_easting_m": 540100.0, "true_northing_m": 5220200.0, "true_yaw_deg": 90.0}
    right |= {"fix_easting_m": 540100.0, "fix_northing_m": 5220200.0, "fix_yaw_deg": 90.0}
    rows = [
        right | {"query_id": "q0", "failure": ""},
        right | {"query_id": "q1", "failure": "aliased", "fix_easting_m": 540400.0},
        right
        | {"query_id": "q2", "failure": "of tomorrow", "is_present": False}
        | {"fix_easting_m": np.nan, "fix_northing_m": np.nan, "fix_yaw_deg": np.nan},
    ]
    facts = {"suite": "real-age", "region": "vaduz@2015-07-27", "kind": "S1", "role": "stress", "status": "ok"}
    facts |= {"is_present": True, "view_m": 128.0}
    table = pd.DataFrame([facts | row | {"matcher": name} for name in names for row in rows])
    return table[list(ANSWER_SCHEMA.names)].assign(**changes)


BOUNDS_M = [540000.0, 5220000.0, 541000.0, 5220800.0]  # of the handmade map


def put_pictures(folder, *, failures=("aliased", "occluded", "odd one"), **changes):
    """Previews, examples and failures beside a board."""
    home = Path(folder) / "pictures"
    (home / "cases").mkdir(parents=True)
    image = np.full((60, 80, 3), 200, np.uint8)
    names = ["vaduz.png", "example.png", *(f"cases/{at}.png" for at in range(len(failures)))]
    for name in names:
        cv2.imwrite(str(home / name), image)
    values = {
        "regions": [
            {"region": "vaduz", "file": "vaduz.png", "alt": "Vaduz from above", "bounds_m": BOUNDS_M}
            | {"blocks": [{"name": f"vaduz/0-0 {MARKUP}", "bounds_m": BOUNDS_M}]}
        ],
        "suites": [{"suite": "real-age", "file": "example.png", "alt": f"Example {MARKUP}"}],
        "cases": [
            {"query_id": f"q{at}", "matcher": "graph", "failure": failure, "file": f"cases/{at}.png"}
            | {"suite": "real-age", "region": "vaduz", "kind": "S1", "alt": f"Case {at}"}
            | {"facts": {"error (m)": 412.5, "note": MARKUP}}
            for at, failure in enumerate(failures)
        ],
    }
    (home / "pictures.json").write_text(json.dumps(values | changes), encoding="utf-8")


def many_rows(count):
    """Rows of so many matchers, two of them with hostile names."""
    names = [HOSTILE, MARKUP, *(f"matcher-{at:03d}" for at in range(count - 2))][:count]
    return FIGURE_SCHEMA.frame(
        [
            Row(
                matcher=name,
                rejector="",
                suite="real-age",
                track="localization",
                prior_group="r500-weak-s3",
                stratum="stress",
                n=80,
                answered=80,
                missing=0,
                blocks=20,
                places=20,
                metric="success_25m",
                unit="1",
                better="higher",
                value=value,
                lo=max(0.0, value - 0.1),
                hi=min(1.0, value + 0.1),
                interval="places",
                rank_best=max(1, at - 2),
                rank_worst=min(count, at + 4),
                detectable=0.1,
            )
            for at, name in enumerate(names)
            for value in (round(1 - at / count, 4),)
        ]
    )


def split_file(folder: Path, kind: str = "holdout", **places: str) -> Path:
    """A split of embedded towns, 5 km between parts: each town is a place with a part or half, or "sealed" before it.

    `split_file(folder, suburb="train", grid="sealed test")` trains on one town and seals another.
    """
    lines = [f'id = "towns-alone"\ntitle = "Towns"\nkind = "{kind}"\nbuffer_m = 5000.0']
    for name, text in places.items():
        *seal, part = text.split()
        key = "part" if kind == "holdout" else "half"
        town = f"town-{name.replace('_', '-')}"
        lines.append(f'[[place]]\nname = "{town}"\nregions = ["{town}"]\n{key} = "{part}"')
        lines += ["sealed = true"] if seal else []
    path = folder / "towns-alone.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
