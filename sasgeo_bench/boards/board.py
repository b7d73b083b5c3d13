# SPDX-License-Identifier: Apache-2.0
"""A board: its manifest and tables, opened from its folder or saved to it, and the figures that they make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

import pandas as pd
from matplotlib.figure import Figure

from sasgeo_bench.boards.board_files import (
    LEADERBOARD,
    MEND,
    SCHEMAS,
    TABLES,
    AdditionalFiles,
    read_board_manifest,
    read_leaderboard,
    write_board,
)
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.plots import MOST_MATCHERS, draw_risk, ranked_matchers, risk_frame, shown_matchers
from sasgeo_bench.boards.pooled_plots import draw_contrasts, draw_tradeoff, price_frame
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.texts import html_facts
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA, Finding
from sasgeo_bench.scoring.controls import CONTROL_SCHEMA, Verdict
from sasgeo_bench.scoring.rejection import OWN, own_confidence
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked

_ALWAYS: Final = (LEADERBOARD, "scores", "contrasts", "falsifiers", "controls")  # tables that every board has


@dataclass(frozen=True, kw_only=True)
class Board:
    """A board: its manifest and its tables, as they lie in its folder.

    Parameters
    ----------
    folder : Path
        Where it lies, or is to be saved.
    about : BoardManifest
        Content of `board.json`: pipeline, versions, entries with their cards, tasks.
    leaderboard : DataFrame
        Every figure with its interval: a row for each matcher, rejector, suite, stratum and metric.
    scores : DataFrame
        A row for each matcher and query.
    contrasts : DataFrame
        Registered contrasts: difference, interval, verdict.
    controls, falsifiers : DataFrame
        Checks of the benchmark itself, and of its suites.
    acceptance, protection : DataFrame
        Figures of rejectors at absent places, and of protection levels; empty where the board has none.
    requirements : DataFrame
        Which entries pass or fail the requirements that were stated; empty without any.
    answers : DataFrame
        True place and fix of each query of each ranked matcher, and the class of its failure; empty of stored results.
    """

    folder: Path
    about: BoardManifest
    leaderboard: pd.DataFrame = field(repr=False)
    scores: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    contrasts: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    controls: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    falsifiers: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    acceptance: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    protection: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    requirements: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)
    answers: pd.DataFrame = field(repr=False, default_factory=pd.DataFrame)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read the manifest and every table of a board; raise `StoreError` if there is none, or one is damaged."""
        about, leaderboard = read_board_manifest(folder), read_leaderboard(folder)
        files = {name: folder / f"{name}.parquet" for name in TABLES}
        tables = {name: read_frame(file, mend=MEND) for name, file in files.items() if file.is_file()}
        for name, table in {LEADERBOARD: leaderboard, **tables}.items():
            SCHEMAS[name].check(table)
        return cls(folder=folder, about=about, leaderboard=leaderboard, **tables)

    def save(self, extras: Sequence[AdditionalFiles], *, failed: Mapping[str, str]) -> Self:
        """Write the board with texts, figures and pictures, all or nothing; return it with what failed meanwhile.

        Tables that a board may lack are not written if they are empty. `failed` grows until the last figure is drawn.
        """
        tables = {name: getattr(self, name) for name in (LEADERBOARD, *TABLES)}
        tables = {name: table for name, table in tables.items() if name in _ALWAYS or len(table)}
        write_board(self.folder, tables=tables, about=self.about, failed=failed, extras=extras)
        return self.with_failures(failed)

    def with_failures(self, failed: Mapping[str, str]) -> Self:
        """Return the board with what failed on it, by name."""
        return replace(self, about=self.about.model_copy(update={"failed": dict(failed)}))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return the registered contrasts as they were found."""
        return tuple(CONTRAST_SCHEMA.rows(Finding, self.contrasts))

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Return which controls hold, those that fail first."""
        return tuple(CONTROL_SCHEMA.rows(Verdict, self.controls))

    def plot_tradeoff(self, suite: str | None = None, *, track: str = "localization") -> Figure:
        """Draw success with its 95 % interval against the median latency, a panel for each prior group.

        Matchers compare on the queries of one suite, by default the one that most of them were asked. Controls are
        grey. Of more than eight matchers the best eight have a colour; the others are grey, too. Groups are apart,
        because who knows more finds more. Raise `ConfigError` if the board has no latencies of that suite and track.
        """
        ranked, asked = ranked_matchers(self.leaderboard), self.scores[self.scores["track"] == track]
        counts = asked[asked["matcher"].isin(ranked)].groupby("suite")["matcher"].nunique()
        chosen = suite or (str(counts.idxmax()) if len(counts) else "")
        some = by_entry(asked[asked["suite"] == chosen])
        rows = price_frame(self.leaderboard, some, [*ranked, *filter(is_unranked, some)])
        rows = rows[rows["latency_s"].notna()]
        if rows.empty:
            known = ", ".join(sorted(set(asked["suite"]))) or "none"
            raise ConfigError(
                f"{self.folder} has no latencies of {chosen!r}, {track}: its suites of that track are {known}"
            )
        return draw_tradeoff(None, rows, self._shown(rows["matcher"]))

    def plot_contrasts(self) -> Figure:
        """Draw the difference of each registered contrast with its 95 % interval; grey is what would not matter.

        Raise `ConfigError` if none was registered.
        """
        if self.contrasts.empty:
            raise ConfigError(f"{self.folder} has no registered contrasts: a pipeline file registers them")
        return draw_contrasts(None, self.contrasts)

    def plot_risk(self, prior_group: str, *, suite: str = ALL_SUITES, track: str = "localization") -> Figure:
        """Draw how many of the accepted fixes are false, by how many are accepted: each matcher's own confidence.

        Raise `ConfigError` if no matcher gives a confidence there, or every place of the suite is present.
        """
        shown = self._shown(self.scores["matcher"])
        own = {(name, OWN): own_confidence(frame) for name, frame in by_entry(self.scores).items() if name in shown}
        rows = risk_frame(own, shown)
        for column, value in (("suite", suite), ("track", track), ("prior_group", prior_group), ("mixture", AS_DRAWN)):
            rows = rows[rows[column] == value]
        if rows.empty:
            raise ConfigError(
                f"{self.folder} has no confidences on {suite!r}, {track}, {prior_group!r}: the columns suite, track "
                "and prior_group of its leaderboard list what there is"
            )
        return draw_risk(None, rows, shown)

    def _shown(self, matchers: "pd.Series[str]") -> tuple[str, ...]:
        """Return at most eight of some matchers that have a colour, the best if there are more."""
        return shown_matchers(self.leaderboard[self.leaderboard["matcher"].isin(set(matchers))], ())[:MOST_MATCHERS]

    def _repr_html_(self) -> str:
        """Return what a notebook shows of a board."""
        about = self.about
        failed = [one.name for one in about.entries if one.failed_controls]
        facts = {
            "pipeline": "none" if about.pipeline is None else about.pipeline.id,
            "entries": ", ".join(one.name for one in about.entries),
            "suites": ", ".join(sorted({one.suite for one in about.tasks})),
            "maps": len({one.region for one in about.tasks}),
            "scored": counted(len(self.scores), "answer"),
            "contrasts": len(self.contrasts),
            "failed controls": ", ".join(failed) or "none",
            "scorer version": about.scorer_version,
            "data": about.attribution,
        }
        return html_facts(f"board {self.folder.name}", facts)


StoredBoard = Board  # its public name


def by_entry(scores: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the scored rows of each entry."""
    return {str(name): frame for name, frame in scores.groupby("matcher", sort=False)}


def read_board(path: str | Path) -> Board:
    """Read the tables of a board, or of stored results, as data frames.

    Parameters
    ----------
    path : str or Path
        Folder of a board, as in `out/boards/demo` or `docs/results/modules`.

    Returns
    -------
    Board
        Its tables, and the figures that they make.

    Raises
    ------
    StoreError
        If there is no board, or a table is damaged.

    Examples
    --------
    >>> board = read_board("docs/results/towns")  # doctest: +SKIP
    >>> board.contrasts[["name", "difference", "lo", "hi", "verdict"]]  # doctest: +SKIP
    >>> board.plot_tradeoff().savefig("tradeoff.png")  # doctest: +SKIP
    """
    return Board.open(given_path(path))
