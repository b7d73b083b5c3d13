# SPDX-License-Identifier: Apache-2.0
"""Figures of a stored board that hold whoever is scored beside its entries, so that nothing is fitted twice."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from sasgeo_bench.files.parquet import read_frame
from sasgeo_bench.leaderboard.board_files import ACCEPTANCE, MEND, read_board
from sasgeo_bench.matching.matcher import RejectorCard
from sasgeo_bench.scoring.acceptance import ACCEPTANCE_SCHEMA
from sasgeo_bench.scoring.rejection import RejectionResult
from sasgeo_bench.scoring.rows import FIGURE_SCHEMA, LEADERBOARD_SCHEMA
from sasgeo_bench.scoring.score import SCORER_VERSION
from sasgeo_bench.scoring.verdicts import CONTRAST_SCHEMA, Finding

_CARD: Final = ("name", "version")  # of a rejector: another version fits otherwise


@dataclass(frozen=True, kw_only=True)
class StoredFigures:
    """Results of rejectors and registered contrasts of the entries `names` of a stored board.

    `rows` and `acceptance` are those of its tables; both depend on the answers of one entry alone. Ranks do not: a new
    entry changes them, and they are made anew.
    """

    names: frozenset[str]
    rows: pd.DataFrame
    acceptance: pd.DataFrame
    remarks: tuple[str, ...]
    findings: tuple[Finding, ...]

    def joined(self, mine: RejectionResult) -> RejectionResult:
        """Return the results of all entries, by the names of entries as on a board that is scored whole."""
        acceptance = [part for part in (self.acceptance, mine.acceptance) if len(part)]
        return replace(
            mine,
            rows=[_by_name([self.rows, *mine.rows])],
            acceptance=_by_name(acceptance) if acceptance else mine.acceptance,
            remarks=(*self.remarks, *mine.remarks),
        )


def _by_name(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    whole = pd.concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)
    return whole.iloc[np.argsort(whole["matcher"].to_numpy(str), kind="stable")].reset_index(drop=True)


def why_anew(about: Mapping[str, Any], cards: Sequence[RejectorCard]) -> str | None:
    """Return why the figures of a stored board are no longer those of this program, None if they are.

    `about` is the content of its `board.json`, `cards` those of the rejectors here. The version of tasks does not
    matter: answers are scored against the stored queries, whoever draws which others today.

    >>> why_anew({"scorer_version": 1}, [])
    'the board is of scorer version 1, this program of 6'
    """
    if about["scorer_version"] != SCORER_VERSION:
        return f"the board is of scorer version {about['scorer_version']}, this program of {SCORER_VERSION}"
    stored = {tuple(str(one.get(name)) for name in _CARD) for one in about.get("rejectors", ())}
    here = {tuple(str(getattr(card, name)) for name in _CARD) for card in cards}
    changed = sorted({name for name, _ in stored ^ here})
    return f"the rejector {changed[0]} has another version here" if changed else None


def read_stored_figures(folder: Path) -> StoredFigures:
    """Read the figures of a stored board; raise `StoreError` if a table is missing or damaged."""
    about, table = read_board(folder)
    contrasts = read_frame(folder / "contrasts.parquet", mend=MEND)
    LEADERBOARD_SCHEMA.check(table)
    CONTRAST_SCHEMA.check(contrasts)
    acceptance = folder / f"{ACCEPTANCE}.parquet"
    return StoredFigures(
        names=frozenset(str(entry["name"]) for entry in about["entries"]),
        rows=table.loc[table["rejector"] != "", list(FIGURE_SCHEMA.names)],
        acceptance=read_frame(acceptance, mend=MEND) if acceptance.is_file() else ACCEPTANCE_SCHEMA.empty(),
        remarks=tuple(about.get("remarks", ())),
        findings=tuple(CONTRAST_SCHEMA.rows(Finding, contrasts)),
    )
