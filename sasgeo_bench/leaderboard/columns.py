# SPDX-License-Identifier: Apache-2.0
"""Columns of tables, and the words next to names: what each means, for boards, the site and the documentation."""

from typing import Final

from sasgeo_bench.errors import ConfigError, counted
from sasgeo_bench.leaderboard.board_files import SCHEMAS
from sasgeo_bench.leaderboard.manifests import BoardEntry
from sasgeo_bench.leaderboard.tables import DAGGER, Column, Mark
from sasgeo_bench.scoring.metrics import METRICS
from sasgeo_bench.scoring.rows import AS_SUBMITTED, NOT_REPRODUCED, PACKED, REPRODUCED, RUN_HERE
from sasgeo_bench.scoring.verdicts import LEAST_PLACES
from sasgeo_bench.tasks.query import PriorGroup
from sasgeo_bench.tasks.suites.all_suites import known_suite
from sasgeo_bench.tasks.suites.base import SuiteCard

_UNKNOWN: Final = "no meaning is written down for this column"
_HEADS: Final = {one.head: one.meaning for schema in SCHEMAS.values() for one in schema.columns if one.head}


def _said(*heads: str) -> dict[str, str]:
    """Return what the schemas of tables say of some columns, by the titles of these."""
    return {head: _HEADS[head] for head in heads}


_OTHER_COLUMNS: Final = {  # all but the metrics, which bring their own
    **_said("matcher"),
    "rank": "Ranks that the matcher can have, all pairs compared at once. Matchers that share a rank cannot be "
    f"distinguished. With fewer than {LEAST_PLACES} places nobody is ranked (-)",
    "control": "The same figure at the same places without the stress",
    "false fixes": "Share of absent places that were answered; each such answer is a false fix. Lower is better",
    **_said("detectable", "n"),
    "mean": "Mean of the suites beside it in which somebody is ranked, which weigh alike; of entries that were asked "
    "about all suites",
    **_said("missing", "blocks", "suite", "part", "kind"),
    "risk kept": "Whether at most 5 % of all answers are false: yes or no where the whole interval says so, else open",
    **_said("rejector", "track", "contrast", "first", "second", "difference"),
    "by blocks": "The interval of the difference if blocks, not places, are resampled: of these places alone",
    "by countries": "The interval of the difference if countries are resampled, then places in them",
    **_said("attainable", "matters", "p (Holm)"),
    "discordant": "Queries that only the first got right, and only the second",
    **_said("verdict", "control query", "outcome", "found", "expected", "p"),
    "fails at": "How many right ones fail the control; never: even if all were right, guessing could have done it",
    "figure": "Success or recall under stress, or false fixes at absent places",
    "public": "The figure on the public seed of this board",
    "private": "The same on a private seed, whose queries nobody else can draw",
    "private less public": "Difference with its interval; all intervals of a matcher hold at once (95 %)",
    "shown": "Whether the private figure is shown to be worse",
    "class": "Semantic class of the map",
    "place": "Regions so near each other that they count as one: places are resampled, and kept apart by the split",
    "compared at": "Where maps of several dates were compared",
    "queries": "Track of the queries, and what was known of the pose before",
    "years": "From the first map to the last",
    "things": "Things of the class on the first map and on the last",
    "vanishes": "Share of what the map shows that is gone after a year, with its 95 % interval, over all dates",
    "appears": "Share of a newer map that one a year older lacks, with its 95 % interval; late mapping is in it",
    "re-drawn": "Of the older amount: kept, but moved by more than 1 m between the first map and the last",
    "moved": "How far what was kept moved, median; of areas that of the centroid",
    "no.": "As on the map above",
    "half or part": "What the split keeps apart: one half trains and calibrates for the other, or train, calibration "
    "and test",
    "regions": "Maps of this board that lie there",
    "dates": "Dates of the maps",
    "suites": "Suites that were drawn there",
    "scenes": "Kind of place, as its region file says",
    "kind of place": "Places of one kind, as their region files say; a place with several kinds counts in each",
    **_said(
        "method",
        "absence",
        "absent",
        "coverage",
        "risk of fixes",
        "risk",
        "available",
        "misleading",
        "hazardous",
        "exceeded",
        "supports",
    ),
}
_OF_CONTRASTS: Final = {  # metrics of registered contrasts alone
    "primary": "Share of queries that are right",
    "interaction": "Share of queries that are right under stress, less that on the controls of the same sites: what "
    "the stress adds to the difference",
    "shift": "Share of queries that are right, less that on the views of the same sites by the detector `published`: "
    "what another detector adds to the difference",
}
MEANINGS: Final = {metric.name: metric.meaning for metric in METRICS} | _OTHER_COLUMNS | _OF_CONTRASTS
NOTE: Final = (
    "Intervals are 95 %: a bootstrap over places, then blocks, then sites ({draws} draws), never narrower than over "
    f"blocks alone, nor than Wilson's with as many trials as there are sites; {DAGGER} marks those where Wilson's is "
    "wider."
)
RANKS_NOTE: Final = (
    "The first figure of a suite counts the stressed queries, or all where nothing is stressed; matchers are ranked by "
    "it. A rank is an interval: matchers that share one cannot be distinguished. Nothing is ranked across prior groups."
    " Ranks compare all matchers of one suite; what a registered contrast says is adjusted for all contrasts of the "
    "board, so that it may leave open what ranks tell apart."
)
TERMS: Final = {  # what tables show that is no column
    DAGGER: "Wilson's interval: of a few sites, or where all answers are right, draws alone would be too narrow",
    "-": "nothing to show: no such query, no rank, nobody to compare with",
    "the prior alone": "what `prior_centre` reaches, which looks at nothing: it answers with the middle of the prior's "
    "disc, or of the map without one; of candidates with the one nearest to the middle of all",
    "the odometer alone": "what `dead_reckoning` reaches: it adds up the odometer's steps from the middle of the prior",
    "chance": "what guessing among the candidates reaches",
    "prior group": "what is known before: radius in m (rnone: anywhere), heading known to 5, 20 or 360 deg, scale in %",
}
FAILED_CONTROL: Final = "failed a control"
MARKS: Final[dict[str, str]] = {  # words next to names and ranks
    RUN_HERE: "the matcher's code was run here, on queries of a public seed, which code can draw again",
    REPRODUCED: "it was run on a private seed of 128 bits too, and no figure is shown to be worse there",
    NOT_REPRODUCED: "it was run on a private seed too, and is shown to be worse there: do not trust the row",
    AS_SUBMITTED: "a file of answers; nobody here has run its code",
    PACKED: "answers of an archive that lay beside the pipeline file; what is not in it was asked here",
    "trained on": "the places that its parameters come from",
    "set apart": "in a table of its own and in no rank, for the reason stated there",
    FAILED_CONTROL: "it fails a control of the board, whose right score is known beforehand: do not trust the row",
    "tie": "shares ranks with others, who are named below the table; neighbouring ties differ in colour",
}
CONTROL: Final = Mark(text="control", meaning="no rival: it shows what a figure means that nobody earned")
FEW: Final = Mark(
    text="few",
    meaning=f"fewer than {LEAST_PLACES} places: nobody is ranked, and other places of the kind may well differ",
    tone="warn",
)
_TONES: Final = {RUN_HERE: "plain", REPRODUCED: "good", NOT_REPRODUCED: "warn", AS_SUBMITTED: "warn", PACKED: "warn"}


def column(term: str, *, is_number: bool = True, order: str = "none", title: str = "") -> Column:
    """Return the column of a term with its meaning; `title` where it is shown under another name.

    >>> column("n").meaning
    'Queries, or flights, in the denominator. Rows with different n do not compare: they are of different ones'
    """
    meaning = MEANINGS.get(term, _UNKNOWN)
    return Column(term=term, name=title or term, meaning=meaning, is_number=is_number, order=order)


def words(*terms: str) -> tuple[Column, ...]:
    """Return columns of text.

    >>> [one.is_number for one in words("matcher", "suite")]
    [False, False]
    """
    return tuple(column(term, is_number=False) for term in terms)


def prior_words(name: str) -> str:
    """Return a prior group in words, or its name where that is none of ours.

    >>> prior_words("r500-weak-s3")
    'searched: disc of 500 m, heading +-20 deg, scale +-3 %'
    >>> prior_words("rnone-unknown-s15"), prior_words("another")
    ('searched: whole map, heading unknown, scale +-15 %', 'another')
    """
    try:
        return PriorGroup.parse(name).words
    except ConfigError:
        return name


def suite_card(suite: str) -> SuiteCard | None:
    """Return the card of a suite of this version, whichever segmenter made its evidence; None for any other."""
    found = known_suite(suite)
    return None if found is None else found.card


def suite_words(suite: str) -> str:
    """Return the title of a suite and what is done in it; "" for one that this version does not know.

    >>> suite_words("aerial+pixel_forest").partition(". ")[0]
    'Pictures from straight above (P1)'
    """
    card = suite_card(suite)
    return "" if card is None else f"{card.title}. {card.what}"


def marks_of(entry: BoardEntry, *, is_control: bool) -> tuple[Mark, ...]:
    """Return the words next to an entry's name: control, how its answers were made, what it was trained on.

    >>> mine = BoardEntry(name="mine", how="as submitted", trained_on=["porto"])
    >>> [mark.text for mark in marks_of(mine, is_control=False)]
    ['as submitted', 'trained on 1 place']
    """
    how = entry.how or ""
    how = RUN_HERE if how == REPRODUCED and entry.private is None else how  # older boards had no private seed
    marks = [Mark(text=how, meaning=MARKS.get(how, "as the board says"), tone=_TONES.get(how, "plain"))] if how else []
    if is_control:
        return (CONTROL, *(mark for mark in marks if how == PACKED))
    if entry.trained_on:
        meaning = f"its parameters come from {', '.join(entry.trained_on)}"
        marks.append(Mark(text=f"trained on {counted(len(entry.trained_on), 'place')}", meaning=meaning))
    if entry.failed_controls:
        marks.append(Mark(text=FAILED_CONTROL, meaning="; ".join(entry.failed_controls), tone="warn"))
    if entry.set_apart:
        marks.append(Mark(text="set apart", meaning=entry.set_apart, tone="warn"))
    return tuple(marks)
