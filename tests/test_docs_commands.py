# SPDX-License-Identifier: Apache-2.0
"""Every command of the documents: run where that is quick, and held against the program's own flags where it is not."""

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
import typer

from sasgeo_bench import cli
from sasgeo_bench.boards.archive import pack_board
from sasgeo_bench.boards.manifests import PipelineRecord
from sasgeo_bench.cli import program
from sasgeo_bench.matching.scaffold import package_files
from sasgeo_bench.tasks.suites.all_suites import EVERY_SUITE
from tests import world
from tests.threaded import threaded

ROOT = Path(__file__).parents[1]
UsageError = typer.BadParameter.__base__  # of whichever click it is that typer brings along
# In the order in which a command that stands in several of them is run: in the first that has it.
GUIDES = ("docs/howto/matcher.md", "docs/howto/region.md", "docs/howto/suite.md")
DOCUMENTS = (
    *GUIDES,
    *sorted(
        path.relative_to(ROOT).as_posix()
        for path in ROOT.glob("docs/**/*.md")
        if path.relative_to(ROOT).as_posix() not in GUIDES
    ),
    *("README.md", "CONTRIBUTING.md", "submissions/README.md"),
    *(f"{folder}/README.md" for folder in ("pipelines", "regions", "splits", "benchmarks", "findings")),
)

# Commands of the program that are not run, each with its reason; all are held against its flags.
ONLY_PARSED = {
    r"vaduz|liechtenstein": "needs an extract of Liechtenstein",
    r"--extracts|--extract ": "needs extracts",
    r"^sasgeo-bench new-region |my-place": "needs extracts; tests/regions/test_new_region.py makes some",
    r"--imagery|zanzibar": "needs aerial pictures; tests/regions/test_imagery.py makes some",
    r"^sasgeo-bench leaderboard (?!.*--dry-run)": "too long; tests/experiments/test_pipeline.py does a small one",
    r"(check|--matcher|runs/) ?my-tracker": "half a minute; tests/running/test_tracker_testing.py flies it",
    r"--segmenter my-segmenter": "needs tasks of pictures; tests/running/test_segment_tasks.py makes some",
    r"--suite aerial|/aerial": "minutes of painting; tests/tasks/suites/test_pictures.py takes small ones",
    r"flight-image": "a minute of painting; tests/tasks/suites/test_flight_image.py flies a short one",
    r"--dask": "needs a scheduler; tests/running does it",
    r"s3://": "needs a store; tests/core/test_storage.py has one in memory",
    r"^sasgeo-bench profile ": "five minutes; tests/running/test_profiling.py does a moment",
    r"^sasgeo-bench enter ": "minutes of drawing; tests/experiments/test_entering.py enters a small board",
    r"docs/results/": "needs results that a long run has stored; the walk of a matcher does it with those of the demo",
    r"mine\.parquet|shard\d/": "needs a file of the reader's own; tests/cli/test_cli_runs.py does it",
    r"^sasgeo-bench replay ": "needs a run over flights; tests/cli/test_cli_replay.py makes one",
    r"^sasgeo-bench import-flight ": "needs a log of the reader's own; tests/cli/test_cli_flights.py reads some",
    r"^sasgeo-bench measure-drift .*\.ulg": "needs a log of the reader's own; tests/cli/test_cli_flights.py has some",
    r"runs/sasgeo_track|my-flight": "needs a flight of the reader's own; tests/running/test_trackers.py flies some",
    r"--train ": "needs a matcher that learns; tests/running does it",
    r"--maps ": "needs a task on that map; tests/running/test_packed_runs.py asks some",
    r"FILE\.json|<hash>": "needs what a matcher has learnt",
    r"HASH|--query ID": "needs a run or a query of the reader's own; tests/boards/test_board_pictures.py does it",
    r"out/boards/demo": "needs the board of the demo; tests/boards/test_publish.py publishes small ones",
    r"^sasgeo-bench (build-region|make-queries) .*-ortho": "needs an extract and a picture",
    r"^sasgeo-bench leaderboard pictures": "hours, and needs extracts and pictures",
    r"^sasgeo-bench verify crossfit": "minutes: tests/cli/test_cli_queries.py does it",
    r"^sasgeo-bench locate ": "needs pictures of the reader's own; tests/observing/test_locate.py draws some",
    r"^sasgeo-bench import-photos |tasks/photos": "needs photos; tests/observing/test_import_photos.py makes some",
    r"^sasgeo-bench import-masks |tasks/masks": "needs masks; tests/observing/test_import_masks.py makes some",
    r"^sasgeo-bench import-dataset ": "needs a dataset of others; tests/cli/test_cli_importing.py makes some",
    r"^sasgeo-bench score --predictions out/runs --name mine$": "any run that lies there, those of other documents too",
}
# Commands of other programs that are not run, each with its reason.
OTHERS = {
    r"^pip install -e my-(matcher|segmenter|tracker|suite|metric|stress)$": "by hand: it needs the package registry",
    r"^python -c .import pandas; print": "reads stored results of the checkout, which a desk of tests lacks",
    r"^(sha256sum |install -m 600 |source \.venv/bin/activate$)": "programs of the system, and of the shell",
    r"^'?\(cd'? my-tiles ": "programs of the system; tests/regions/test_tiles.py holds what they print",
    r"^podman ": "downloads and builds an image; tests/test_repository.py reads what it is built by",
    r"^bash findings/": "installs packages from the registry",
    r"^python docs/figures/rendered\.py ": "writes into docs/; tests/sensing/test_rendering.py renders small scenes",
    r"^python answer\.py ": "tests/experiments/test_board_queries.py runs this program on a small board",
    r"^python benchmarks/segmenters\.py ": "minutes; tests/scoring/test_segmenter_program.py makes a small board",
    r"^python benchmarks/(real_)?pictures\.py ": "needs extracts and pictures",
    r"^python benchmarks/self_train\.py ": "needs pictures, PyTorch and minutes; tests/baselines/test_self_training.py",
    r"^python benchmarks/image_matchers\.py ": "minutes of matching, on a region with imagery and a task of pictures",
    r"^python benchmarks/(open_numbers|scorer_trials)\.py ": "minutes; tests/baselines/test_tunable.py makes some",
    r"^python -m benchmarks\.cross_check_osm ": "needs extracts; tests/osm/test_cross_check.py reads small maps",
    r"^bash findings/NAME\.sh": "needs the package registry, and a name",
    r"^python -m benchmarks\.related_work docs/results/": "tests/boards/test_results.py prints the same table",
    r"^python -m benchmarks\.unsolved ": "writes into docs/; tests/boards/test_unsolved.py compares what it writes",
    r"^(git show b92bad11|\S*python docs/ageing/measure\.py )": "needs extracts; tests/ageing/ holds what it writes",
    r"umask.*secrets\.token_hex": "makes a secret; tests/tasks/test_private_seed.py reads one",
    r"^pip install ('sasgeo-bench\[(logs|publish)\]'|\. \./baselines)$": "an installation needs the package registry",
    r"^hf upload ": "needs an account; tests/exchange/test_release.py reads the command",
}
PLUGIN = """[sasgeo_bench.matchers]
my-matcher = my_matcher.matcher:MyMatcher

[sasgeo_bench.segmenters]
my-segmenter = my_segmenter.segmenter:MySegmenter
[sasgeo_bench.suites]
my-suite = my_suite.suite:SUITE
my-stress = my_stress.suite:SUITE
[sasgeo_bench.perturbations]
my-stress = my_stress.perturbation:MyStress
[sasgeo_bench.metrics]
my-metric = my_metric.metric:METRIC
"""


@dataclass(frozen=True)
class Line:
    """One command of a document."""

    document: str
    number: int
    text: str

    @property
    def words(self) -> list[str]:
        return shlex.split(self.text)


def blocks(document: str, language: str) -> list[tuple[int, str]]:
    """Number of the first line and text of each block of a language."""
    text = (ROOT / document).read_text(encoding="utf-8")
    found = re.finditer(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    return [(text[: item.start(1)].count("\n") + 1, item[1]) for item in found]


def plain(text: str) -> str:
    """A command without its comment, its variables, and the folder of its program."""
    words = shlex.split(text, comments=True)
    return re.sub(r"^(\w+=\S+ )*(\.venv/bin/)?", "", shlex.join(words))


def commands(document: str) -> list[Line]:
    """Every command of a document, continued lines joined."""
    found = []
    for first, block in (*blocks(document, "bash"), *blocks(document, "sh"), *blocks(document, "console")):
        joined = re.sub(r"\\\n\s*", " ", block)
        for at, text in enumerate(joined.splitlines()):
            if plain(text):
                found.append(Line(document, first + at, plain(text)))
    return found


def reason(text: str, table: dict[str, str]) -> str | None:
    return next((why for pattern, why in table.items() if re.search(pattern, text)), None)


def is_ours(line: Line) -> bool:
    return line.words[0] == "sasgeo-bench"


def parsed(text: str) -> None:
    """Hold a command against the program's flags and choices, without doing anything."""
    name, *words = shlex.split(text)[1:]
    with typer.Context(typer.main.get_command(program.app), info_name="sasgeo-bench") as parent:
        program.load(name).make_context(name, words, parent=parent)


def first_runs() -> dict[str, Line]:
    """Where each command is run: in the first document that has it."""
    found: dict[str, Line] = {}
    for document in DOCUMENTS:
        for line in commands(document):
            if is_ours(line) and reason(line.text, ONLY_PARSED) is None:
                found.setdefault(line.text, line)
    return found


EVERY = [line for document in DOCUMENTS for line in commands(document)]
RUN = first_runs()
WALKS = sorted({line.document for line in RUN.values()}, key=DOCUMENTS.index)
FIRST = ("README.md", "docs/quickstart.md")  # the others take a minute, and are among the slow ones


def test_every_command_of_a_document_is_one_that_this_test_knows() -> None:
    unknown = [
        f"{line.document}:{line.number}: {line.text}"
        for line in EVERY
        if line.words[0] not in ("make", "sasgeo-bench") and reason(line.text, OTHERS) is None
    ]
    assert unknown == []
    assert len(EVERY) > 50


def test_every_document_is_looked_at() -> None:
    written = {path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.md") if "```bash" in path.read_text("utf-8")}
    hidden = {name for name in written if name.startswith((".", "out/", "dist/"))}
    assert written - hidden - set(DOCUMENTS) == set()


@pytest.mark.parametrize("table", [ONLY_PARSED, OTHERS])
def test_every_reason_not_to_run_a_command_is_still_needed(table: dict[str, str]) -> None:
    unused = [pattern for pattern in table if not any(re.search(pattern, line.text) for line in EVERY)]
    assert unused == []


def test_every_command_of_the_program_has_flags_that_there_are() -> None:
    for line in filter(is_ours, EVERY):
        try:
            parsed(line.text)
        except UsageError as error:
            if "does not exist" not in error.format_message():  # a reader's own folder
                pytest.fail(f"{line.document}:{line.number}: {line.text}: {error.format_message()}")


def test_a_flag_that_is_made_up_is_found() -> None:
    for text in ("sasgeo-bench score --predictions a --nome b", "sasgeo-bench run --tasks a", "sasgeo-bench run a"):
        with pytest.raises(UsageError):
            parsed(text)


@pytest.mark.parametrize("text", sorted({line.text for line in EVERY if line.words[0] == "make"}))
def test_every_make_command_would_run(text: str) -> None:
    words = shlex.split(text)
    # Flags of the make that runs these tests are not those of a reader.
    outside = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "ARGS")}
    shown = subprocess.run([*words, "-n"], cwd=ROOT, env=outside, capture_output=True, text=True, check=False)  # noqa: S603 - of our own documents
    assert shown.returncode == 0, shown.stderr
    recipe = re.sub(r"\\\n\s*", " ", shown.stdout)
    for line in (plain(item) for item in recipe.splitlines() if item.startswith(".venv/bin/sasgeo-bench")):
        parsed(line)


# --- run --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def desk(towns: Path, lay_towns: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a reader has it after `make demo`, on a smaller scale: towns built, tasks drawn, results stored."""
    out = tmp_path_factory.mktemp("desk") / "out"
    lay_towns(Path(shutil.copytree(towns, out)), "town-suburb")
    world.answered(out, "random", world.drawn(out, "clean", "town-riverside", "town-suburb"))
    pack_board(*world.scored(out, "demo", pipeline=PipelineRecord(id="demo", sha256="0")), out / "results" / "demo")
    return out.parent


@pytest.fixture
def reader(desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A desk of one's own, and a package that counts as installed as soon as it is there."""
    folder = Path(shutil.copytree(desk, tmp_path / "desk"))
    about = tmp_path / "site" / "my_matcher-0.1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-matcher\nVersion: 0.1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(PLUGIN, encoding="utf-8")
    kinds = ("matcher", "segmenter", "suite", "stress", "metric")
    for path in (tmp_path / "site", *(folder / f"my-{kind}" / "src" for kind in kinds)):
        monkeypatch.syspath_prepend(str(path))
    monkeypatch.chdir(folder)
    monkeypatch.delenv("SASGEO_EXTRACTS", raising=False)
    monkeypatch.delenv("SASGEO_OUT", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder


def write_files(document: str, folder: Path) -> None:
    """Files that a document tells its reader to write: TOML that is named in the line before."""
    text = (ROOT / document).read_text(encoding="utf-8")
    for name, content in re.findall(r"`([\w./-]+\.toml)`:\n\n```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")


def write_plugin(folder: Path) -> None:
    """Make the package that the guide to a matcher ends with; other documents go on from there."""
    for name, content in package_files("matcher", "my-matcher").items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")


def enter_suites(document: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Suites that a document tells its reader to write."""
    for _, code in blocks(document, "python"):
        if "SUITE = " in code:
            found: dict[str, object] = {}
            exec(code, found)  # noqa: S102 - of our own documents
            monkeypatch.setitem(EVERY_SUITE, found["SUITE"].card.name, found["SUITE"])  # type: ignore[attr-defined]


def told(words: list[str], monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    """Exit status of the program, and all that it said."""
    monkeypatch.setattr(sys, "argv", words)
    given = io.StringIO()
    with redirect_stdout(given), redirect_stderr(given), pytest.raises(SystemExit) as leaving:
        cli.main()
    return int(leaving.value.code or 0), given.getvalue()


def by_one_process(words: list[str]) -> list[str]:
    """A command without its --jobs: processes take seconds to start, and tests/running starts some."""
    return [word for before, word in zip(["", *words], words, strict=False) if "--jobs" not in (before, word)]


@pytest.mark.usefixtures("without_drawings")
@pytest.mark.parametrize(
    "document", [pytest.param(one, marks=() if one in FIRST else pytest.mark.slow) for one in WALKS]
)
def test_the_commands_of_a_document_do_what_they_say(
    document: str, reader: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(document, reader)
    if document != GUIDES[0]:  # which makes the package itself
        write_plugin(reader / "my-matcher")
    enter_suites(document, monkeypatch)
    for line in commands(document):
        if RUN.get(line.text) is not None and RUN[line.text] == line:
            with nullcontext() if line.words[1] == "check" else threaded():
                code, given = told(by_one_process(line.words), monkeypatch)
            assert code == 0, f"{document}:{line.number}: {line.text}\n{given}"
