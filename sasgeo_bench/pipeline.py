# SPDX-License-Identifier: Apache-2.0
"""A pipeline file -> queries, runs and a board; what is up to date is not done again."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from sasgeo_bench.boards import Board, ScoreRequest, make_board
from sasgeo_bench.errors import ConfigError
from sasgeo_bench.paper import made_paper_task, make_paper_task
from sasgeo_bench.paperboard import paper_extra
from sasgeo_bench.pipelinefile import PAPER_SUITE, PipelineFile
from sasgeo_bench.plugins import check_names
from sasgeo_bench.query import CONTROLS, PriorGroup
from sasgeo_bench.report.contrasts import Contrast
from sasgeo_bench.request import Request, Wanted, plan_requests
from sasgeo_bench.run.plan import RunRequest, plan_run
from sasgeo_bench.run.runner import Progress, run
from sasgeo_bench.run.worker import Limits
from sasgeo_bench.tasks import ensure_tasks, made_tasks

# Every board has controls: of small towns that everybody can build, asked of all matchers and of a plain search.
CONTROL_REGIONS: Final = ("town-riverside", "town-suburb")
CONTROL_SPLIT: Final = "crossfit"
CONTROL_SITES: Final = 8
CONTROL_MATCHERS: Final = ("oracle_pose", "prior_centre")  # on all queries of every board
REFERENCE: Final = "fft_vote"  # on the controls of every board
MOST_LINES: Final = 6  # of what could not be drawn; the rest is counted

Tell = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class PipelinePlan:
    """What a pipeline will do; `requests` in the order of the file, `controls` those of every board."""

    spec: PipelineFile
    requests: tuple[Request, ...]
    controls: tuple[Request, ...]
    out: Path
    jobs: int
    dask: str | None = None

    def to_text(self) -> str:
        """A line for each stage, with what of it is up to date."""
        made = [made_tasks(request) is not None for request in self.requests]
        lines = [f"{self.spec.id}: {self.spec.title}"]
        if made:
            lines.append(f"  queries: {len(made)} suites on regions, {sum(made)} of them up to date")
        lines += [
            f"    {request.suite} on {request.region.id}: {'up to date' if done else 'to be drawn'}"
            for request, done in zip(self.requests, made, strict=True)
        ]
        lines += _paper_lines(self)
        lines.append(f"  controls: on {', '.join(request.region.id for request in self.controls)}")
        lines.append(f"  run: {', '.join(self.matchers)}; {REFERENCE} on the controls")
        lines.append(f"  score: {len(self.spec.rejectors)} rejectors, {len(self.spec.contrast)} contrasts")
        lines.append(f"  board: {board_folder(self)}")
        return "\n".join(lines)

    @property
    def matchers(self) -> tuple[str, ...]:
        """Those of the file, and those that every board has."""
        return tuple(dict.fromkeys((*CONTROL_MATCHERS, *self.spec.matchers)))


def _paper_lines(plan: PipelinePlan) -> list[str]:
    """A line for each seed of the paper's experiment."""
    paper = plan.spec.paper
    if paper is None:
        return []
    made = [made_paper_task(seed=seed, trials=paper.trials, out=plan.out) is not None for seed in paper.seeds]
    return [
        f"  the paper's {paper.trials} trials, seed {seed}: {'up to date' if done else 'to be drawn'}"
        for seed, done in zip(paper.seeds, made, strict=True)
    ]


def board_folder(plan: PipelinePlan) -> Path:
    """Where the board goes."""
    return plan.out / "boards" / plan.spec.id


def plan_pipeline(
    spec: PipelineFile,
    *,
    out: Path,
    tell: Tell,
    extract_folders: tuple[Path, ...] = (),
    region_folders: tuple[Path, ...] = (),
    jobs: int = 1,
    dask: str | None = None,
) -> PipelinePlan:
    """Turn a pipeline file into requests; nothing is read but files of settings.

    Parameters
    ----------
    spec : PipelineFile
        The file.
    out : Path
        Root of what is built.
    tell : callable
        Gets a line for what is left out.
    extract_folders, region_folders : tuple of Path
        For regions that are not built yet, and of files of one's own.
    jobs : int
        Processes of each matcher.
    dask : str, optional
        A cluster to run on instead.

    Raises
    ------
    ConfigError
        If a suite, region or split is unknown, or no region can be built here.
    MatchError
        If no installed package has a matcher or a rejector of a name.
    """
    check_names(matchers=(*spec.matchers, *CONTROL_MATCHERS, REFERENCE), rejectors=spec.rejectors)
    requests: list[Request] = []
    for number, task in enumerate(spec.task):
        wanted = Wanted(
            suites=tuple(task.suites),
            regions=tuple(spec.regions),
            split=str(spec.split),  # a file with tasks names one
            count=task.sites,
            seed=spec.seed,
            out=out,
            group=None if task.prior is None else PriorGroup.parse(task.prior),
            extract_folders=extract_folders,
            region_folders=region_folders,
            may_be_fewer=True,
        )
        requests += plan_requests(wanted, tell=tell if number == 0 else _silent)
    if spec.task and not requests:
        message = f"pipeline {spec.id!r} has no region that can be built here: name --extracts"
        raise ConfigError(message)
    controls = Wanted(
        suites=(CONTROLS,),
        regions=CONTROL_REGIONS,
        split=CONTROL_SPLIT,
        count=CONTROL_SITES,
        seed=spec.seed,
        out=out,
        may_be_fewer=True,
    )
    return PipelinePlan(
        spec=spec,
        requests=tuple(requests),
        controls=plan_requests(controls, tell=_silent),
        out=out,
        jobs=jobs,
        dask=dask,
    )


def _silent(line: str) -> None:
    """Say once what is left out, not for every group of suites."""
    del line


def run_pipeline(plan: PipelinePlan, *, tell: Tell, progress: Progress | None = None) -> Board:
    """Draw what is missing, run what has no row, score all of it and write the board.

    Parameters
    ----------
    plan : PipelinePlan
        From `plan_pipeline`.
    tell : callable
        Gets a line for every step.
    progress : Progress, optional
        Is told of every answer.

    Returns
    -------
    Board
        As it was written to out/boards/<id>/.

    Raises
    ------
    ConfigError
        If no region can carry any of the suites.
    """
    tasks = [*_draw(plan.requests, tell), *_draw_paper(plan, tell)]
    if not tasks:
        message = f"pipeline {plan.spec.id!r}: no region carries any of its suites"
        raise ConfigError(message)
    controls = _draw(plan.controls, tell)
    folders = [folder for spec in plan.matchers for folder in _run(plan, spec, [*tasks, *controls], tell, progress)]
    if REFERENCE not in plan.matchers:
        folders += _run(plan, REFERENCE, controls, tell, progress)
    request_board = ScoreRequest(
        predictions=folders,
        tasks=[*tasks, *controls],
        root=plan.out,
        board=board_folder(plan),
        split=plan.requests[0].split if plan.requests else None,
        rejectors=plan.spec.rejectors,
        contrasts=_contrasts(plan.spec),
        draws=plan.spec.draws,
        extras=() if plan.spec.paper is None else (partial(paper_extra, root=plan.out),),
        by_region=(PAPER_SUITE,) if plan.spec.paper is not None and len(plan.spec.paper.seeds) > 1 else (),
    )
    return make_board(request_board, tell=tell)


def _run(plan: PipelinePlan, spec: str, tasks: list[Path], tell: Tell, progress: Progress | None) -> list[Path]:
    """Folders of the runs of one matcher, after whatever had no row was asked."""
    request = RunRequest(
        spec=spec,
        tasks=tasks,
        out=plan.out,
        top_k=plan.spec.top_k,
        limits=Limits(match_s=plan.spec.match_s),
        jobs=plan.jobs,
        dask=plan.dask,
    )
    planned = plan_run(request)
    left, done = sum(len(part.left) for part in planned.parts), sum(part.done for part in planned.parts)
    tell(f"{spec}: {left} queries to ask, {done} answered before")
    run(planned, tell=tell if left else _silent, progress=progress)
    return [part.folder for part in planned.parts]


def _draw(requests: Sequence[Request], tell: Tell) -> list[Path]:
    """Task folders of every request that a region carries; those that are up to date are left as they are."""
    tasks: list[Path] = []
    lacking: list[str] = []
    for request in requests:
        try:
            tasks += ensure_tasks(request, tell=tell)
        except ConfigError as error:
            lacking.append(str(error).removesuffix(" (--skip passes on to the next suite)"))
    for line in lacking[:MOST_LINES]:
        tell(f"left out: {line}")
    if len(lacking) > MOST_LINES:
        tell(f"left out: {len(lacking) - MOST_LINES} more")
    return tasks


def _draw_paper(plan: PipelinePlan, tell: Tell) -> list[Path]:
    """Task folders of every seed of the paper's experiment; those that are up to date are left as they are."""
    paper = plan.spec.paper
    if paper is None:
        return []
    return [
        made_paper_task(seed=seed, trials=paper.trials, out=plan.out)
        or make_paper_task(seed=seed, trials=paper.trials, out=plan.out, tell=tell)
        for seed in paper.seeds
    ]


def _contrasts(spec: PipelineFile) -> tuple[Contrast, ...]:
    return tuple(
        Contrast(
            name=item.name,
            first=item.first,
            second=item.second,
            suites=tuple(item.suites),
            kinds=tuple(item.kinds),
            metric=item.metric,
            track=item.track,
            min_effect=item.min_effect,
        )
        for item in spec.contrast
    )
