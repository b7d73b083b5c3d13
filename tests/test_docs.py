# SPDX-License-Identifier: Apache-2.0
"""The documentation: reference pages hold all that the code has, and the written pages keep to their limits."""

import ast
import os
import re
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import typer
from PIL import Image

import sasgeo_bench as sgb
from docs.site import boards, reference
from sasgeo_bench.cli import program
from sasgeo_bench.core.errors import PerturbError
from sasgeo_bench.matching.scaffold import package_files
from tests.test_repository import markdown_links

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
# Pages that are written here; results are made by commands, and decisions are kept as they were made.
WRITTEN = sorted(
    path
    for path in DOCS.rglob("*.md")
    if path.relative_to(DOCS).parts[0] not in ("results", "decisions") and path.name not in ("summary.md", "ageing.md")
)
PROSE = [  # rows of tables and code may be longer
    *WRITTEN,
    *sorted((DOCS / "decisions").glob("*.md")),
    *(ROOT / name / "README.md" for name in (".", "benchmarks", "docs/results", "pipelines", "regions", "splits")),
    *(ROOT / name for name in ("CHANGELOG.md", "CONTRIBUTING.md", "DATA-LICENSE.md", "submissions/README.md")),
]
LIBRARIES = {"geopandas", "matplotlib", "numpy", "pandas", "torch"}  # that a reader of notebooks knows
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.py"))
PATHS = re.compile(r"\b(?:sasgeo_bench|baselines|benchmarks|tests|docs)/[\w./-]*\w\.(?:py|md|toml|sh)\b")
MOST_TERMS = 60
ENTRY_POINTS = tuple(f"sasgeo_bench.{kind}" for kind in ("matchers", "rejectors", "segmenters", "trackers"))


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def pages():
    return reference.pages()


def test_every_command_and_option_is_in_the_reference(pages):
    for name in (name for commands in program.COMMANDS.values() for name in commands):
        (section,) = re.findall(rf"^### {name}$(.*?)(?=^##|\Z)", pages["reference/cli.md"], re.MULTILINE | re.DOTALL)
        with typer.Context(typer.main.get_command(program.app)) as parent:
            command = program.load(name)
            shown = [one for one in command.get_params(typer.Context(command, parent=parent)) if not one.hidden]
        options = [option for parameter in shown if parameter.name != "help" for option in parameter.opts]
        assert [option for option in options if option not in section] == [], name


def test_every_published_board_has_its_headline_and_what_entering_takes_with_where_to_begin():
    page = boards.page(reference.table)
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| [`")]
    names = [row[0].split("`")[1] for row in rows]
    assert sorted(names) == sorted(path.parent.name for path in (DOCS / "results").glob("*/pack.json"))
    assert sorted(re.findall(r"^## \[.+\]\(boards/([\w-]+)/index.html\)$", page, re.MULTILINE)) == sorted(names)
    assert "- **flight-gap**: sasgeo_track (0.901) has the first rank alone; " in page
    queries = dict(zip(names, (int(row[1]) for row in rows), strict=True))
    assert list(queries.values()) == sorted(queries.values())
    can_be_entered = {name for name, row in zip(names, rows, strict=True) if row[-1] == "yes"}
    assert {"towns", "modules"}.isdisjoint(can_be_entered)  # made on maps that are made otherwise now
    assert min(can_be_entered, key=queries.__getitem__) == "systems-objects"  # where to begin
    assert "**Begin with `systems-objects`**" in page


def test_every_link_between_documents_leads_somewhere(pages):
    """To a file, or to a page of the site that is made from the code, so that no file holds it."""
    broken = [
        f"{path.relative_to(ROOT)} -> {target}"
        for path, target in markdown_links()
        if not (path.parent / target).exists()
        and os.path.relpath(path.parent / target, DOCS) not in {*pages, boards.PAGE}
    ]
    assert broken == []


def test_what_a_docstring_says_of_several_parameters_is_said_of_each():
    class Both:
        """Return nothing.

        Parameters
        ----------
        lo, hi : float
            Ends of an
            interval.
        name : str
            What it is called.

        Notes
        -----
        None.
        """

    interval = "Ends of an interval."
    assert reference.meanings([Both]) == {"lo": interval, "hi": interval, "name": "What it is called."}


@pytest.mark.parametrize("path", PROSE, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_line_of_prose_is_too_long(path):
    prose = re.sub(r"^( *)```.*?^\1```$", "", read(path), flags=re.MULTILINE | re.DOTALL)
    assert [line for line in prose.splitlines() if len(line) > 120 and not line.lstrip().startswith("|")] == []


@pytest.mark.parametrize("path", [*WRITTEN, ROOT / "README.md"], ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_file_that_a_document_names_is_there(path):
    text = re.sub(r"^```.*?^```$", "", read(path), flags=re.MULTILINE | re.DOTALL)
    assert [name for name in PATHS.findall(text) if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("path", WRITTEN, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_name_of_the_code_in_a_document_is_there(path):
    for name in set(re.findall(r"\bsasgeo_bench(?:\.\w+)+|\bsgb\.\w+", read(path))):
        parts = name.replace("sgb.", "sasgeo_bench.").split(".")
        if name not in ENTRY_POINTS and parts[-1] not in ("toml", "py"):
            assert resolves(parts), name


def resolves(parts):
    """Whether a dotted name is a module, or something in one."""
    module = ".".join(parts[:-1])
    return hasattr(import_module(module), parts[-1]) or find_spec(".".join(parts)) is not None


def test_the_perturbations_of_the_guide_keep_to_its_rules():
    codes = re.findall(r"^```python\n(.*?)^```$", read(DOCS / "howto" / "perturbation.md"), re.MULTILINE | re.DOTALL)
    made: dict[str, object] = {}
    for code in codes[:2]:
        exec(code, made)  # noqa: S102 - of our own documents
    view = sgb.Evidence(classes=("water",), cells=np.zeros((1, 8, 4), dtype=np.uint8), cell_size_m=1.0)
    seen = made["Stripes"](share=0.5)(view, np.random.default_rng(0))  # type: ignore[operator]
    assert seen.unknown_share == 0.5
    assert made["Stripes"](share=0.0)(view, np.random.default_rng(0)) is view  # type: ignore[operator]
    houses = sgb.Evidence(classes=("building",), cells=np.eye(9, dtype=np.uint8)[None, ::2, ::2], cell_size_m=1.0)
    assert houses.cells.any()
    for share, left in ((1.0, 0), (0.0, houses.cells.sum())):
        seen = made["MissedBuildings"](share=share)(houses, np.random.default_rng(0))  # type: ignore[operator]
        assert seen.cells.sum() == left
    with pytest.raises(PerturbError, match=r"MissedBuildings: share lies between 0 and 1, got 2\.0"):
        made["MissedBuildings"](share=2.0)  # type: ignore[operator]


def test_the_segmenter_of_the_guide_keeps_to_the_door():
    (first, _) = re.findall(r"^```python\n(.*?)^```$", read(DOCS / "howto" / "segmenter.md"), re.MULTILINE | re.DOTALL)
    made: dict[str, object] = {}
    exec(first, made)  # noqa: S102 - of our own documents
    assert sgb.check_segmentation(made["found"], made["picture"]) is made["found"]


def test_a_picture_of_ones_own_is_seen_as_the_card_says(tmp_path, monkeypatch):
    text = read(DOCS / "concepts" / "osm-unet.md")
    (_, code) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.random.default_rng(1).integers(0, 256, (96, 128, 3), dtype=np.uint8)).save("mine.png")
    made: dict[str, object] = {}
    exec(code, made)  # noqa: S102 - of our own documents
    assert made["building"].shape == (96, 128)  # type: ignore[attr-defined]
    assert Image.open("seen.png").size == (128, 96)


def test_the_readme_is_read_in_two_minutes():
    text = read(ROOT / "README.md")
    assert len(text.splitlines()) <= 70
    assert len(text.split()) <= 2 * 250


def test_the_matcher_of_the_readme_answers(tmp_path):
    (code,) = re.findall(r"^```python\n(.*?)^```$", read(ROOT / "README.md"), re.MULTILINE | re.DOTALL)
    (tmp_path / "card.toml").write_text(
        package_files("matcher", "my-matcher")["src/my_matcher/card.toml"], encoding="utf-8"
    )
    made: dict[str, object] = {"__file__": str(tmp_path / "matcher.py")}
    exec(code, made)  # noqa: S102 - of our own documents
    matcher, place = made["MyMatcher"](), sgb.tiny_place(tmp_path)  # type: ignore[operator]
    matcher.prepare(place.region, None)
    for query in (one for one in place.queries if one.candidates or one.prior.center_m):  # the card needs a position
        match = matcher.match(query, top_k=3)
        assert len(match.poses) == min(3, len(query.candidates or [None]))
        assert list(match.scores) == sorted(match.scores, reverse=True)


def test_the_glossary_is_short_and_in_order():
    head, *items = read(DOCS / "glossary.md").strip().split("\n\n")
    terms = [item.split("\n:   ")[0] for item in items]
    assert head == "# Glossary"
    assert terms == sorted(set(terms), key=str.lower)
    assert len(terms) <= MOST_TERMS
    assert [item for item in items if not 2 <= len(item.splitlines()) <= 3] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_needs_public_names_and_common_libraries_alone(path):
    nodes = list(ast.walk(ast.parse(read(path))))
    imported = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    assert "sasgeo_bench" in imported
    assert {name.split(".")[0] for name in imported} - {"sasgeo_bench"} <= sys.stdlib_module_names | LIBRARIES
    cells = re.findall(r'^# %% magic_args="-e" language="bash"\n((?:# .*\n)+)', read(path), flags=re.MULTILINE)
    assert {line.split()[1] for cell in cells for line in cell.splitlines()} <= {"sasgeo-bench"}
    assert not re.search(r"^# !", read(path), flags=re.MULTILINE)  # its failure would go unseen


@pytest.mark.slow  # half a minute; `make docs` does it, and runs the notebook too
def test_the_site_is_built_without_a_warning(tmp_path):
    if find_spec("mkdocs") is None:
        pytest.skip("mkdocs is not installed (make docs brings it)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    outside = os.environ | {"DOCS_RUN": "0", "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, cwd=ROOT, env=outside, capture_output=True, text=True, check=False)  # noqa: S603 - our own
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "site" / "reference" / "api" / "index.html").exists()


def test_every_line_of_kept_right_has_its_test_and_its_script():
    lines = (ROOT / "docs" / "concepts" / "kept-right.md").read_text(encoding="utf-8").splitlines()
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    rows = [line for line in lines if line.startswith("| ")][1:]
    assert len(rows) == 16
    for row in rows:
        named = re.findall(r"`(test_\w+)`", row)
        assert named, row
        assert all(f"def {name}(" in code for name in named), row
        assert all((ROOT / "findings" / name).is_file() for name in re.findall(r"`(\w+\.sh)`", row)), row
