# SPDX-License-Identifier: Apache-2.0
"""What is kept, and at what risk, where a declared share of the places is absent, by kind of absence.

    .venv/bin/python -m benchmarks.absent_places docs/results/systems --matchers sasgeo schmidt_segcorr

Reads a board whose suites `absent` and `clean` the matchers were asked. A rejector is fitted on the calibration places
of each test place, and a threshold is chosen there: the one of largest coverage whose risk, the share of false fixes
among the accepted, is at most `--risk` where absent places of all kinds make up `--absent` of the views. Chances of
calibration places are from fits on other countries. Neither fit nor threshold sees a place of the country that is
tested.

With `--conformal` the threshold is the one of largest coverage that conformal risk control allows, with places as what
is exchangeable (Angelopoulos, Bates, Fisch, Lei and Schuster, ICLR 2024): with n calibration places, and L the sum over
them of the share of their views that has an accepted false fix, (L + 1) / (n + 1) is at most `--risk`. That is a
promise in the mean over places like these. It needs 1 / `--risk` - 1 calibration places at least: with fewer it accepts
nothing.

Printed is, for each matcher and rejector, what that threshold does at the test places: of the right answers the share
that it keeps, where an oracle keeps all at no risk; and the risk with each kind of absence making up the same share of
the views. The last column is of views that show little: of present places, their right answers kept. Each with its 95 %
interval by places. A risk that none is accepted to tell is `-`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from sasgeo_bench.boards.archive import laid_out, request_of
from sasgeo_bench.boards.archive_file import read_stored_predictions
from sasgeo_bench.boards.board_files import read_board_manifest, read_scores
from sasgeo_bench.boards.score import score_board
from sasgeo_bench.core.errors import ConfigError, SasgeoError
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.plugins import rejector_maker
from sasgeo_bench.scoring.base import Floats
from sasgeo_bench.scoring.decisions import Fixes, accept, presence_weights, risk_coverage
from sasgeo_bench.scoring.intervals import BoardDraws, BoardInterval, seed_of_text
from sasgeo_bench.scoring.rejection import OWN, turns
from sasgeo_bench.scoring.rejection_rows import Share, share_intervals
from sasgeo_bench.tasks.split import Split, find_split

SUITES, PRIOR = ("absent", "clean"), "r500-weak-s3"
KINDS = ("outside", "wrong place", "corrupted view")
POOR = "feature-poor"  # its places are present
FOLDS, DRAWS = 5, 1000
COLUMNS = ("right answers kept", "risk", *(f"risk, {kind}" for kind in KINDS), f"kept of {POOR}")
_NOTHING = 1e-9
Said = dict[str, Prediction]


def chances(rejector: str, known: pd.DataFrame, asked: pd.DataFrame, said: Said) -> Floats:
    """Return the chance of a right fix at some views from a fit on others; NaN without an answer."""
    is_answered = asked["is_answered"].to_numpy(bool)
    found = np.where(is_answered, asked["confidence"].to_numpy(float), np.nan)
    if rejector == OWN:
        return found
    fitted, taught = rejector_maker(rejector)(), known[known["is_answered"].astype(bool)]
    fitted.fit([said[name] for name in taught["query_id"]], ~taught["is_right"].to_numpy(bool))
    some = [said[name] for name in asked.loc[is_answered, "query_id"]]
    if some:
        found[is_answered] = 1.0 - np.asarray(fitted.p_false(some), dtype=np.float64)
    return found


def held_back(rejector: str, known: pd.DataFrame, said: Said) -> Floats:
    """Return chances of calibration views, each from a fit without its country."""
    fold = known["country"].astype("category").cat.codes.to_numpy() % FOLDS
    if rejector == OWN or len(set(fold)) == 1:
        return chances(rejector, known, known, said)
    found = np.full(len(known), np.nan)
    for one in set(fold):
        found[fold == one] = chances(rejector, known[fold != one], known[fold == one], said)
    return found


def risk_threshold(here: Fixes, mass: Floats, risk: float) -> float:
    """Return the threshold of largest coverage whose risk among the accepted is small enough; inf if none is."""
    curve = risk_coverage(here, mass)
    kept = np.flatnonzero(curve.risk <= risk)
    return float(curve.threshold[kept[-1]]) if len(kept) else np.inf


def conformal_threshold(here: Fixes, mass: Floats, place: Sequence[str], risk: float) -> float:
    """Return the threshold of largest coverage that conformal risk control by places allows; inf if none.

    >>> facts = {"is_answered": [1] * 20, "is_right": [1] * 19 + [0], "is_present": [1] * 20}
    >>> here = Fixes(confidence=np.linspace(1, 0, 20), **facts)
    >>> conformal_threshold(here, np.ones(20), [str(at) for at in range(20)], 0.05) > 0
    True
    >>> conformal_threshold(here, np.ones(20), ["one"] * 20, 0.05)
    inf
    """
    at = np.unique(np.asarray(place), return_inverse=True)[1]
    whole, best = np.bincount(at, weights=mass), np.inf
    for threshold in risk_coverage(here, mass).threshold:
        is_false = accept(here, threshold) & ~here.is_right
        shares = np.bincount(at, weights=mass * is_false) / np.maximum(whole, np.finfo(float).tiny)
        if (shares.sum() + 1) / (len(whole) + 1) > risk + _NOTHING:
            break
        best = float(threshold)
    return best


def answers(rows: pd.DataFrame, chance: Floats) -> Fixes:
    """Return views as answers with chances."""
    facts = {name: rows[name].to_numpy(bool) for name in ("is_answered", "is_right", "is_present")}
    return Fixes(confidence=chance, **facts)


def accepted(
    rejector: str, rows: pd.DataFrame, said: Said, split: Split, words: argparse.Namespace, *, is_taught: bool
) -> pd.DataFrame:
    """Return the tested views with `accepted`, by thresholds of calibration places."""
    parts = []
    for turn in turns(rows, split, is_taught=is_taught):
        known, asked = rows[turn.calibration], rows[turn.test]
        here = answers(known, held_back(rejector, known, said))
        mass = presence_weights(here.is_present, 1.0 - words.absent)
        choose = partial(conformal_threshold, place=known["place"].tolist()) if words.conformal else risk_threshold
        threshold = choose(here, mass, risk=words.risk)
        taken = accept(answers(asked, chances(rejector, known, asked, said)), threshold)
        parts.append(asked.assign(accepted=taken))
    return pd.concat(parts, ignore_index=True)


def figures(rows: pd.DataFrame, absent: float) -> list[BoardInterval]:
    """Return what is kept, the risk with all kinds of absence and with each, and what is kept of feature-poor views."""
    taken, right, present = (rows[name].to_numpy(float) for name in ("accepted", "is_right", "is_present"))
    kind = rows["kind"].to_numpy()
    shares = [Share(counted=taken, mass=right)]
    for some in (KINDS, *((one,) for one in KINDS)):
        of_kind = (present == 0) & np.isin(kind, some)
        mass = np.where(present == 1, (1 - absent) / present.sum(), absent * of_kind / max(of_kind.sum(), 1))
        shares.append(Share(counted=1.0 - right, mass=mass * len(rows) * taken))
    shares.append(Share(counted=taken, mass=right * (kind == POOR)))
    place, block, site = (np.unique(rows[name], return_inverse=True)[1] for name in ("place", "block", "pair_id"))
    drawn = BoardDraws.of(place, block, site, seed=seed_of_text("absent places"), draws=DRAWS)
    return share_intervals(shares, site, drawn)


def cell(found: BoardInterval) -> str:
    """Return a figure with its interval.

    >>> cell(BoardInterval(value=0.5, lo=0.25, hi=1.0))
    '0.50 [0.25, 1.00]'
    """
    return "-" if np.isnan(found.value) else f"{found.value:.2f} [{found.lo:.2f}, {found.hi:.2f}]"


def rows_of(board: Path, split: Split) -> pd.DataFrame:
    """Return the scored rows of a board; where those of calibration places are not stored, they are scored again."""
    scores = read_scores(board)
    if all(turn.calibration.any() for turn in turns(scores, split, is_taught=False)):
        return scores
    print("the board stores no rows of calibration places: scoring its answers again", file=sys.stderr)
    with TemporaryDirectory() as scratch:
        request = request_of([board], board=Path(scratch) / board.name, root=Path(scratch))
        with laid_out(replace(request, rejectors=(), contrasts=(), draws=DRAWS)) as laid:
            scored = score_board(laid)
    rows = pd.concat([frame.assign(matcher=name) for name, frame in scored.with_calibration.items()], ignore_index=True)
    if not all(turn.calibration.any() for turn in turns(rows, split, is_taught=False)):
        raise ConfigError(f"{board} asked no calibration place of {split.spec.id}: no threshold can be chosen")
    return rows


def lines(words: argparse.Namespace) -> list[str]:
    """Return the table of what `parsed` returns, a line for each matcher and rejector of the board.

    Raises
    ------
    SasgeoError
        If the folder holds no board with such answers, or it is damaged.
    """
    about = read_board_manifest(words.board)
    split = find_split(about.split or "crossfit")
    scores = rows_of(words.board, split)
    taught = {entry.name: bool(entry.learned) for entry in about.entries}
    chosen = scores["suite"].isin(SUITES) & (scores["track"] == "localization") & (scores["prior_group"] == PRIOR)
    found = [f"| matcher | rejector | {' | '.join(COLUMNS)} |", "|---|---|" + "---:|" * len(COLUMNS)]
    for matcher in words.matchers:
        rows = scores[chosen & (scores["matcher"] == matcher)].reset_index(drop=True)
        said = {one.query_id: one for one in read_stored_predictions(words.board, matcher)}
        for rejector in (OWN, *(str(one.name) for one in about.rejectors)):
            judged = accepted(rejector, rows, said, split, words, is_taught=taught[matcher])
            cells = " | ".join(map(cell, figures(judged, words.absent)))
            found.append(f"| {matcher} | {rejector} | {cells} |")
    return found


def parsed(given: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the words of a command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board", type=Path)
    parser.add_argument("--matchers", nargs="+", required=True)
    parser.add_argument("--absent", type=float, default=0.3, help="share of absent places")
    parser.add_argument("--risk", type=float, default=0.05, help="share of false fixes among accepted ones")
    parser.add_argument("--conformal", action="store_true", help="bound the risk in the mean over places")
    words = parser.parse_args(given)
    for name in ("absent", "risk"):
        if not 0 < getattr(words, name) < 1:
            parser.error(f"--{name} lies between 0 and 1, got {getattr(words, name):g}")
    return words


def main() -> None:
    """Print the table."""
    try:
        print("\n".join(lines(parsed())))
    except SasgeoError as error:
        raise SystemExit(f"absent_places: {error}") from error


if __name__ == "__main__":
    main()
