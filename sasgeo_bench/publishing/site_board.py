# SPDX-License-Identifier: Apache-2.0
"""Registered contrasts in plain words, as a site shows them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import pandas as pd

from sasgeo_bench.errors import counted
from sasgeo_bench.leaderboard.tables import (
    Bar,
    Record,
    file_stem,
    interval_text,
    number_text,
)
from sasgeo_bench.publishing.site_source import SiteSource
from sasgeo_bench.scoring.contrasts import LESS_THAN_MATTERS, Contrast, chosen_rows

OUTCOMES: Final = ("decided", "cause open", "decided, small", "null", "not decided")  # in the order of the page
_LEAST_P: Final = 5e-4  # less would read as nought


@dataclass(frozen=True, slots=True, kw_only=True)
class ContrastSummary:
    """A registered contrast in plain words.

    `outcome` is one of `OUTCOMES`; the cause of a gain is open where the falsifiers of the contrast gain, too.
    `unstressed` says how both fare where they should not differ, empty where nobody looked; `bar` spans from -`reach`
    to `reach`, with `least` of it on both sides of the middle too small to matter, in per cent.
    """

    name: str
    outcome: str
    headline: str
    sentence: str
    facts: tuple[str, ...]
    unstressed: str
    why: str
    figure: str
    bar: Bar | None
    least: float
    reach: float


def contrasts_of(source: SiteSource) -> tuple[ContrastSummary, ...]:
    """Registered contrasts, what is decided first."""
    records = [{str(name): value for name, value in row.items()} for row in source.contrasts.to_dict("records")]
    ends = [abs(float(row[name])) for row in records for name in ("lo", "hi", "difference")]
    reach = max((end for end in ends if math.isfinite(end)), default=1.0) or 1.0
    found = [_summary(row, source, reach) for row in records]
    return tuple(sorted(found, key=lambda item: OUTCOMES.index(item.outcome)))


def _summary(row: Record, source: SiteSource, reach: float) -> ContrastSummary:
    verdict, name = str(row["verdict"]), str(row["name"])
    falsifier = _falsifier_of(source.falsifiers, name)
    outcome = _outcome(row, falsifier)
    contrast = next((item for item in source.registered if item.name == name), None)
    figure = next((item.file for item in source.figures if item.file == f"{file_stem('contrast', name)}.svg"), "")
    known = [float(row[end]) for end in ("lo", "hi", "difference")]
    least = float(row["min_effect"]) * (1.0 if row["metric"] == "primary" else abs(float(row["second_value"])))
    bar = None
    if all(map(math.isfinite, known)):
        lo, hi, at = (round(50 + 50 * value / reach, 1) for value in known)
        bar = Bar(lo=lo, hi=hi, at=at)
    return ContrastSummary(
        name=name,
        outcome=outcome,
        headline=_headline(row, verdict, outcome),
        sentence=_sentence(row, least),
        facts=tuple(_contrast_facts(row, source, contrast)),
        unstressed="" if falsifier is None else _unstressed(falsifier),
        why=source.reasons.get(name, ""),
        figure=figure,
        bar=bar,
        least=0.0 if math.isnan(least) else min(50.0, round(50 * least / reach, 1)),
        reach=reach,
    )


def _headline(row: Record, verdict: str, outcome: str) -> str:
    first, second = row["first"], row["second"]
    if outcome not in {"null", "not decided"}:
        better, worse = (first, second) if verdict.startswith(f"{first} is better") else (second, first)
        return f"{better} is better than {worse}" + verdict.partition(" is better")[2]
    return f"{first} against {second}: {verdict.partition(': ')[2] or verdict}"


def _sentence(row: Record, least: float) -> str:
    """Return the difference with its interval, in words that say which way is good."""
    if not int(row["n"]):
        return "No query of this board counts for it."
    difference = interval_text(*(float(row[name]) for name in ("difference", "lo", "hi")))
    values = f"{number_text(float(row['first_value']))} against {number_text(float(row['second_value']))}"
    what = "share of queries that are right" if row["metric"] == "primary" else "area under risk (lower is better)"
    return f"Difference {difference} in the {what}: {values}. A difference from {number_text(least)} on was to matter."


def _falsifier_of(falsifiers: pd.DataFrame, contrast: str) -> Record | None:
    """Return how both sides fare without the stress, all suites together: the first row of a contrast."""
    mine = falsifiers[falsifiers["contrast"] == contrast] if len(falsifiers) else falsifiers
    return None if mine.empty else {str(name): value for name, value in mine.iloc[0].items()}


def _outcome(row: Record, falsifier: Record | None) -> str:
    verdict = str(row["verdict"])
    if verdict.startswith(("not decided", "not tested")):
        return "not decided"
    if verdict.startswith("null"):
        return "null"
    if verdict.endswith(LESS_THAN_MATTERS):
        return "decided, small"
    is_gained = falsifier is not None and falsifier["lo"] > 0 and verdict.startswith(f"{row['first']} is better")
    return "cause open" if is_gained else "decided"


def _unstressed(row: Record) -> str:
    difference = interval_text(*(float(row[name]) for name in ("difference", "lo", "hi")))
    gained = " What it gains there is not owed to what the contrast is named for." if row["lo"] > 0 else ""
    return (
        f"Without the stress, where they should not differ: {difference}, {row['verdict'].lower()} "
        f"(n = {row['n']}, {counted(int(row['blocks']), 'block')}).{gained}"
    )


def _contrast_facts(row: Record, source: SiteSource, contrast: Contrast | None) -> Iterator[str]:
    p = float(row["p_holm"])
    if not math.isnan(p):
        shown = "below 0.001" if p < _LEAST_P else number_text(p)
        yield f"adjusted p {shown} (Holm, {counted(len(source.contrasts), 'contrast')})"
    yield f"n = {counted(int(row['n']), 'query', 'queries')}"
    yield counted(int(row["blocks"]), "block")
    places = 0 if contrast is None else places_of(contrast, source.scores, int(row["n"]))
    if places:
        yield counted(places, "place")
    if row["metric"] == "primary":
        yield f"right by the first alone {row['first_only']}, by the second alone {row['second_only']}"
    detectable = float(row["detectable"])
    if not math.isnan(detectable):
        yield f"least difference these queries would show {number_text(detectable)}"
    if contrast is not None:
        yield f"suites {', '.join(contrast.suites)}"


def places_of(contrast: Contrast, scores: pd.DataFrame, n: int) -> int:
    """Count the places of a contrast's queries; 0 if the scored rows are not those that were tested."""
    if not len(scores) or "matcher" not in scores:
        return 0
    whose = [side.partition(" x ")[0] for side in (contrast.first, contrast.second)]
    rows = [chosen_rows(contrast, scores[scores["matcher"] == name]) for name in whose]
    shared = rows[0][rows[0]["query_id"].isin(rows[1]["query_id"])]
    return int(shared["place"].nunique()) if len(shared) == n else 0
