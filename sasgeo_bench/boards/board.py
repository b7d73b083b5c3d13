# SPDX-License-Identifier: Apache-2.0
"""A board: its manifest and tables, opened from its folder or saved to it, and the figures that they make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Self

import pandas as pd
from matplotlib.figure import Figure

from sasgeo_bench.boards.archive_file import is_pack
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
from sasgeo_bench.boards.flight_plots import draw_intervals, interval_frame, kinds_of
from sasgeo_bench.boards.manifests import BoardManifest
from sasgeo_bench.boards.plots import (
    MOST_MATCHERS,
    ages_frame,
    draw_ages,
    draw_forest,
    draw_risk,
    draw_stanford,
    draw_steps,
    ranked_matchers,
    risk_frame,
    shown_matchers,
)
from sasgeo_bench.boards.pooled_plots import draw_contrasts, draw_tradeoff, price_frame
from sasgeo_bench.boards.stored_frames import check_stored, levels_of, measured_of
from sasgeo_bench.core.canvas import on_paper
from sasgeo_bench.core.errors import ConfigError, counted
from sasgeo_bench.core.parquet import read_frame
from sasgeo_bench.core.paths import given_path
from sasgeo_bench.core.texts import html_facts
from sasgeo_bench.scoring.compare import CONTRAST_SCHEMA, Finding
from sasgeo_bench.scoring.contrasts import by_place
from sasgeo_bench.scoring.controls import CONTROL_SCHEMA, Verdict
from sasgeo_bench.scoring.rejection import OWN, own_confidence
from sasgeo_bench.scoring.rejection_rows import AS_DRAWN
from sasgeo_bench.scoring.rows import ALL_SUITES, is_unranked
from sasgeo_bench.scoring.score import FIX_M
from sasgeo_bench.scoring.strata import queries_of, steps_frame
from sasgeo_bench.tasks.split import find_split

_LISTED: Final = "the columns suite, track and prior_group of its leaderboard list what there is"
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

    def plot_tradeoff(
        self, suite: str | None = None, *, track: str = "localization", width_mm: float | None = None
    ) -> Figure:
        """Draw success with its 95 % interval against the median latency, a panel for each prior group.

        Controls are grey. Of more than eight matchers the best eight have a colour; the others are grey, too. Groups
        are apart, because who knows more finds more.

        Parameters
        ----------
        suite : str, optional
            Matchers compare on its queries; by default the one that most of them were asked.
        track : str
            "localization", "retrieval" or "sequence".
        width_mm : float, optional
            Width on paper, as 85 for a column: letters are as small as there, and what a page says around the panels
            is the `caption` of the figure. Without it the figure is that of the site.

        Returns
        -------
        Figure
            `savefig` writes it, as .svg or .pdf by the name of the file.

        Raises
        ------
        ConfigError
            If the board has no latencies of that suite and track.

        Examples
        --------
        >>> import sasgeo_bench as sgb
        >>> figure = sgb.read_board("docs/results/towns").plot_tradeoff("clean", width_mm=85)  # doctest: +SKIP
        >>> figure.savefig("tradeoff.pdf")  # doctest: +SKIP
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
        with on_paper(width_mm):
            return draw_tradeoff(None, rows, self._shown(rows["matcher"]))

    def plot_contrasts(self, *, width_mm: float | None = None) -> Figure:
        """Draw the difference of each registered contrast with its 95 % interval; grey is what would not matter.

        `width_mm` is as of `plot_tradeoff`. Raise `ConfigError` if none was registered.
        """
        if self.contrasts.empty:
            raise ConfigError(f"{self.folder} has no registered contrasts: a pipeline file registers them")
        with on_paper(width_mm):
            return draw_contrasts(None, self.contrasts)

    def plot_forest(self, contrast: str, *, width_mm: float | None = None) -> Figure:
        """Draw a registered contrast place by place, with 95 % intervals, and all places together below.

        Parameters
        ----------
        contrast : str
            Its name in `contrasts`.
        width_mm : float, optional
            As of `plot_tradeoff`.

        Raises
        ------
        ConfigError
            If the board has no such contrast, nothing was asked for it, or it compares rejectors, which have no rows on
            a stored board.

        Examples
        --------
        >>> import sasgeo_bench as sgb
        >>> board = sgb.read_board("docs/results/modules")  # doctest: +SKIP
        >>> board.plot_forest(board.contrasts["name"][0], width_mm=85).savefig("forest.svg")  # doctest: +SKIP
        """
        known = {item.name: item for item in self.about.contrasts or ()}
        finding = next((one for one in self.findings if one.name == contrast and one.n), None)
        if contrast not in known or finding is None:
            there = ", ".join(one.name for one in self.findings if one.n) or "none"
            raise ConfigError(f"{self.folder} has no answered contrast {contrast!r}: it has {there}")
        chosen = known[contrast]
        if " x " in f"{chosen.first}{chosen.second}":
            raise ConfigError(f"{contrast} compares rejectors, whose answers a board does not keep: see its site")
        with on_paper(width_mm):
            return draw_forest(None, chosen, finding, by_place(chosen, by_entry(self.scores), {}))

    def plot_risk(
        self,
        prior_group: str,
        *,
        suite: str = ALL_SUITES,
        track: str = "localization",
        width_mm: float | None = None,
    ) -> Figure:
        """Draw how many of the accepted fixes are false, by how many are accepted: each matcher's own confidence.

        `width_mm` is as of `plot_tradeoff`. Raise `ConfigError` if no matcher gives a confidence there, or every place
        of the suite is present.
        """
        shown = self._shown(self.scores["matcher"])
        own = {(name, OWN): own_confidence(frame) for name, frame in by_entry(self.scores).items() if name in shown}
        rows = risk_frame(own, shown)
        for column, value in (("suite", suite), ("track", track), ("prior_group", prior_group), ("mixture", AS_DRAWN)):
            rows = rows[rows[column] == value]
        if rows.empty:
            raise ConfigError(f"{self.folder} has no confidences on {suite!r}, {track}, {prior_group!r}: {_LISTED}")
        with on_paper(width_mm):
            return draw_risk(None, rows, shown)

    def plot_steps(
        self, suite: str, prior_group: str, *, track: str = "localization", width_mm: float | None = None
    ) -> Figure:
        """Draw success step by step: against the age of the map where ages were measured, else against the strength.

        Ages stand in stored results; of other boards the steps are those that were asked for.

        Parameters
        ----------
        suite : str
            One with several steps, as "real-age".
        prior_group : str
            What is known before, as in the column `prior_group`.
        track : str
            "localization" or "retrieval".
        width_mm : float, optional
            As of `plot_tradeoff`.

        Raises
        ------
        ConfigError
            If the suite has no steps there.

        Examples
        --------
        >>> import sasgeo_bench as sgb
        >>> board = sgb.read_board("docs/results/modules")  # doctest: +SKIP
        >>> board.plot_steps("real-age", "r500-weak-s3", width_mm=85).savefig("age.pdf")  # doctest: +SKIP
        """
        shown, queries = self._shown(self.scores["matcher"]), queries_of(by_entry(self.scores))
        steps = steps_frame(self.leaderboard, queries, shown)
        for column, value in (("suite", suite), ("track", track), ("prior_group", prior_group)):
            steps = steps[steps[column] == value]
        if steps.empty:
            raise ConfigError(f"{self.folder} has no steps of {suite!r}, {track}, {prior_group!r}: {_LISTED}")
        ages = ages_frame(steps, queries, measured_of(self.folder) if is_pack(self.folder) else {})
        with on_paper(width_mm):
            return draw_steps(None, steps, shown) if ages.empty else draw_ages(None, ages, shown)

    def plot_distance(self, suite: str, prior_group: str, *, width_mm: float | None = None) -> Figure:
        """Draw how much of the way of flights stays within 25 m by the distance from one fix to the next.

        Between fixes the odometer alone says where the drone is; a panel for each kind of flight.

        Parameters
        ----------
        suite : str
            A suite of flights, as "flight-clean".
        prior_group : str
            What is known before, as in the column `prior_group`.
        width_mm : float, optional
            As of `plot_tradeoff`.

        Raises
        ------
        ConfigError
            If the board has no such flights.

        Examples
        --------
        >>> import sasgeo_bench as sgb
        >>> board = sgb.read_board("docs/results/flights")  # doctest: +SKIP
        >>> board.plot_distance("flight-clean", "r500-weak-s3", width_mm=85).savefig("way.pdf")  # doctest: +SKIP
        """
        shown = self._shown(self.scores["matcher"])
        rows = interval_frame(self.leaderboard, kinds_of(by_entry(self.scores)), shown)
        rows = rows[(rows["suite"] == suite) & (rows["prior_group"] == prior_group)]
        if rows.empty:
            raise ConfigError(f"{self.folder} has no flights of {suite!r}, {prior_group!r}: {_LISTED}")
        with on_paper(width_mm):
            return draw_intervals(None, rows, shown)

    def plot_stanford(
        self, prior_group: str, *, matcher: str | None = None, risk: float = 0.01, width_mm: float | None = None
    ) -> Figure:
        """Draw protection levels against errors, a panel for each matcher and method, at an alert limit of 25 m.

        Parameters
        ----------
        prior_group : str
            What is known before, as in the column `prior_group`.
        matcher : str, optional
            One of those that report levels; by default all that have a colour.
        risk : float
            Share of queries whose error may exceed the level.
        width_mm : float, optional
            As of `plot_tradeoff`.

        Raises
        ------
        ConfigError
            If no matcher reports levels there, or the board is not read from stored results, which hold the answers.

        Examples
        --------
        >>> import sasgeo_bench as sgb
        >>> board = sgb.read_board("docs/results/modules")  # doctest: +SKIP
        >>> board.plot_stanford("r500-weak-s3", width_mm=85).savefig("stanford.pdf")  # doctest: +SKIP
        """
        check_stored(self.folder)
        scores = by_entry(self.scores)
        shown = [name for name in self._shown(self.scores["matcher"]) if matcher in {None, name}]
        split = None if self.about.split is None else find_split(self.about.split)
        levels = levels_of(self.folder, scores, shown, prior_group=prior_group, risk=risk, split=split)
        if not levels:
            raise ConfigError(
                f"{self.folder} has no protection levels at risk {risk:g} of {matcher or 'any matcher'}, "
                f"{prior_group!r}: its table `protection` lists what there is"
            )
        with on_paper(width_mm):
            return draw_stanford(None, levels, FIX_M)

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
