# SPDX-License-Identifier: Apache-2.0
"""What the words of a site mean; docs/scoring.md says the same at more length."""

from collections.abc import Mapping
from typing import Any, Final

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.leaderboard.text import DAGGER
from sasgeo_bench.publishing.site_table import Column, Mark
from sasgeo_bench.scoring.compare import LEAST_BLOCKS
from sasgeo_bench.scoring.rows import AS_SUBMITTED, NOT_REPRODUCED, REPRODUCED, RUN_HERE
from sasgeo_bench.tasks.query import PriorGroup

_UNKNOWN: Final = "no meaning is written down for this column"
MEANINGS: Final[dict[str, str]] = {
    "matcher": "Who answered; the name leads to its card. Controls are beside the ranks: they show what a figure is "
    "worth that nobody earned",
    "success_25m": "Share of the stressed queries whose pose is within 25 m and 5 deg, with its 95 % interval; of all "
    "queries where nothing is stressed. No answer is a miss. Matchers are ranked by it",
    "recall_1": "Share of the stressed queries whose first candidate is the right one, with its 95 % interval. Ties "
    "count in proportion, no answer is a miss. Matchers are ranked by it",
    "rank": "Ranks it can have, all pairs compared at once. Who shares a rank cannot be told apart. With fewer than "
    f"{LEAST_BLOCKS} blocks nobody is ranked (-)",
    "within_25m": "The same as success_25m whatever the heading: what counts as a fix that is not false",
    "control": "The same figure at the same places without the stress",
    "false fixes": "Share of absent places that were answered; each such answer is a false fix. Lower is better",
    "detectable": "Least difference from the best other matcher that these queries would show (5 %, power 80 %); inf: "
    "none would",
    "n": "Queries in the denominator, the same for every matcher",
    "missing": "Queries without a row; they count as misses",
    "blocks": "Pieces of ground of about 1 km that the queries come from, and in how many places: what intervals draw",
    "suite": "What is done to a view or a map; the name leads to what and why",
    "part": "Which of the suite's queries: a role, a kind of stress, one of its steps at one size of view, or a bin "
    "of what was measured at the truth",
    "rejector": "Says of each answer how likely it is false; own: the matcher's own confidence, fitted to nothing",
    "aurc": "Area under risk against coverage: mean share of false fixes among the surest 1, 2, ..., all queries. "
    "Lower is better",
    "coverage_at_risk_0.05": "Share of queries accepted by the threshold that kept false fixes at 5 % on other places",
    "risk_reached_at_0.05": "Share of false fixes among those accepted so, here. Above 0.05 the promise did not hold",
    "brier": "Mean square of stated chance less truth, of rejectors that state chances. Lower is better",
    "ece": "Mean distance of stated chance and truth over bins with equally many answers. Lower is better",
    "cost_20": "Mean cost of a query where a false fix costs 20 and withholding a right one 1. Compares rejectors on "
    "one matcher",
    "cost_20_place": "The same, but every present place without an accepted fix costs 1. Compares whole methods",
    "latency_p50": "Median seconds of one answer; a time-out counts as infinite",
    "latency_p95": "Seconds that 95 % of the answers do not exceed; a time-out counts as infinite",
    "prepare": "Seconds to make a map ready, once; the longest of all maps",
    "peak_memory": "Memory of all processes of the matcher together, the most of all maps",
    "map_per_km2": "Files of the maps and what the matcher wrote beside them, over their mapped area",
    "cpu_per_fix": "Processor seconds of all queries over those answered",
    "observation_per_fix": "Views of all queries, packed and not compressed, over those answered: what a drone would "
    "have to send",
    "track": "localization: find the place on the map; retrieval: pick it among candidates",
    "class": "Semantic class of the map",
    "place": "Where maps of several dates were compared",
    "years": "From the first map to the last",
    "things": "Things of the class on the first map and on the last",
    "vanishes": "Share of what the map shows that is gone after a year, with its 95 % interval, over all dates",
    "appears": "Share of a newer map that one a year older lacks, with its 95 % interval; mapping that catches up is "
    "in it",
    "re-drawn": "Of the older amount: kept, but moved by more than 1 m between the first map and the last",
    "shift": "How far what was kept moved, median; of areas that of the centroid",
    "no.": "As on the map above",
    "half or part": "What the split keeps apart: one half learns and calibrates for the other, or train, calibration "
    "and test",
    "regions": "Maps of this board that lie there",
    "dates": "Days that the maps speak of",
    "suites": "Suites that were drawn there",
    "scenes": "What the place is like, as its region file says",
    "method": "How the level is computed",
    "risk": "How often the error may exceed the level, as was promised",
    "available": "Share of queries whose level is within the alert limit, with its 95 % interval",
    "misleading": "Share that is available and has an error beyond its level, with its 95 % interval",
    "hazardous": "Share that is misleading and has an error beyond the alert limit, with its 95 % interval",
    "exceeded": "Share with an error beyond the level, available or not, with its 95 % interval",
    "supports": "What the misleading ones among the available support",
    "figure": "Of what: success or recall under stress, or false fixes at absent places",
    "public": "The figure on the public seed of this board",
    "private": "The same on a private seed, whose queries nobody else can draw",
    "private less public": "Difference with its interval; all intervals of a matcher hold at once (95 %)",
    "shown": "Whether the private figure is shown to be worse",
    "verdict": "held, or FAILED: then do not trust this board",
    "found": "How many were right, or answered where none must be",
    "expected": "What guessing is worth, or how many there must be",
    "p": "Chance of finding as many or more by guessing; a control fails below 0.0001",
}
NOTE: Final = (
    "Intervals are 95 %: a bootstrap over blocks, then sites ({draws} draws), and never narrower than Wilson's of as "
    f"many trials as there are sites; {DAGGER} marks those that Wilson's reaches farther out."
)
_HEADINGS: Final = {"known": "to 5 deg", "weak": "to 20 deg", "unknown": "unknown"}
MARKS: Final[dict[str, str]] = {  # words beside names and ranks
    "run here": "the matcher's code was run here, on queries of a public seed, which code can draw again",
    "reproduced": "it was run on a private seed of 128 bits too, and no figure is shown to be worse there",
    "not reproduced": "it was run on a private seed too, and is shown to be worse there: do not trust the row",
    "as submitted": "a file of answers; nobody here has run its code",
    "trained on": "the places that its parameters come from",
    "set apart": "in a table of its own, for the reason that is told there",
    "tie": "shares ranks with others, who are named below the table; ties beside each other differ in colour",
}
CONTROL: Final = Mark(text="control", meaning="no rival: it shows what a figure is worth that nobody earned")
_HOW: Final = {
    name: Mark(text=name, meaning=MARKS[name], tone=tone)
    for name, tone in {
        RUN_HERE: "plain",
        REPRODUCED: "good",
        NOT_REPRODUCED: "warn",
        AS_SUBMITTED: "warn",
    }.items()
}


def column(name: str, *, is_number: bool = True, order: str = "none", title: str = "") -> Column:
    """A column with its meaning; `title` where it is shown under another name.

    Examples
    --------
    >>> column("n").meaning
    'Queries in the denominator, the same for every matcher'
    """
    return Column(name=title or name, meaning=MEANINGS.get(name, _UNKNOWN), is_number=is_number, order=order)


def prior_words(name: str) -> str:
    """What is known before, in words.

    Examples
    --------
    >>> prior_words("r500-weak-s3")
    'within 500 m, heading known to 20 deg, scale to 3 %'
    >>> prior_words("rnone-unknown-s15"), prior_words("another")
    ('anywhere on the map, heading unknown, scale to 15 %', 'another')
    """
    try:
        group = PriorGroup.parse(name)
    except ConfigError:
        return name
    place = "anywhere on the map" if group.radius_m is None else f"within {group.radius_m:g} m"
    known = _HEADINGS[group.yaw]
    heading = f"heading {known}" if group.yaw == "unknown" else f"heading known {known}"
    return f"{place}, {heading}, scale to {100 * group.scale_sigma:g} %"


def marks_of(entry: Mapping[str, Any], *, is_control: bool) -> tuple[Mark, ...]:
    """Words beside a contestant's name: control, how its answers came to be, what it was trained on.

    Examples
    --------
    >>> [mark.text for mark in marks_of({"how": "as submitted", "trained_on": ["porto"]}, is_control=False)]
    ['as submitted', 'trained on 1 place']
    """
    if is_control:
        return (CONTROL,)
    how = str(entry.get("how") or "")
    how = RUN_HERE if how == REPRODUCED and not entry.get("private") else how  # said by programs before there was one
    marks = [_HOW.get(how, Mark(text=how, meaning="as the board says"))] if how else []
    places = [str(place) for place in entry.get("trained_on") or ()]
    if places:
        word = f"trained on {len(places)} place{'' if len(places) == 1 else 's'}"
        marks.append(Mark(text=word, meaning=f"its parameters come from {', '.join(places)}"))
    if entry.get("set_apart"):
        marks.append(Mark(text="set apart", meaning=str(entry["set_apart"]), tone="warn"))
    return tuple(marks)
