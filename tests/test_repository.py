# SPDX-License-Identifier: Apache-2.0
"""The repository around the code: licences, the lock file, the Makefile, the documents and what a wheel holds."""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
CODE = ("sasgeo_bench", "baselines", "paper", "benchmarks", "tests")
LOCKS = ("requirements.lock", "requirements-docs.lock")
SHIPPED = ("regions", "splits", "pipelines")
# Made by commands, not by hand (.gitignore names them too).
GENERATED = {
    *(".git", ".venv", ".venv-oldest", ".venv-wheel", "out", "dist", "__pycache__", ".benchmarks", ".hypothesis"),
    *(".mypy_cache", ".pytest_cache", ".ruff_cache"),
}
MAX_FILE_BYTES = 500_000
HEAD_START = "pipelines/demo.tar.xz"  # docs/howto/head-start.md
# tests/baselines/test_osm_unet.py holds their size
WEIGHTS = "baselines/sasgeo_baselines/segmenters/osm_unet*.onnx"


# Distributions whose module has another name.
IMPORTED_AS = {
    "huggingface-hub": "huggingface_hub",
    "lazy-loader": "lazy_loader",
    "pillow": "PIL",
    "opencv-python-headless": "cv2",
    "rio-cogeo": "rio_cogeo",
    "scikit-image": "skimage",
    "scikit-learn": "sklearn",
}

# Declared, though no file of ours imports them: another library needs them for what we ask of it.
INDIRECT = {"tqdm": "the progress bar of pooch"}


def repository_files() -> list[Path]:
    """Every file of the repository; needs no git, so an unpacked archive is checked the same way."""
    found = []
    for folder, folders, names in os.walk(ROOT):
        folders[:] = [name for name in folders if name not in GENERATED]
        found += [Path(folder, name) for name in names]
    return sorted(found)


def python_files() -> list[Path]:
    return [path for path in repository_files() if path.suffix == ".py" and path.relative_to(ROOT).parts[0] in CODE]


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def project(name: str = "pyproject.toml") -> dict:
    return tomllib.loads(read(name))["project"]


def requirement_names(requirements: list[str]) -> set[str]:
    """`rasterio>=1.4` -> `rasterio`."""
    return {re.match(r"[\w.-]+", requirement)[0].lower() for requirement in requirements}


def locked_blocks(name: str = "requirements.lock") -> list[str]:
    """One text for each pinned requirement of a lock file, with its hashes."""
    body = re.sub(r"^#.*\n", "", read(name), flags=re.MULTILINE)
    return re.sub(r"\\\n\s*", "", body).strip().splitlines()


def markdown_links() -> Iterator[tuple[Path, str]]:
    """Every link of a document to another file of the repository."""
    for path in repository_files():
        if path.suffix == ".md":
            for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text(encoding="utf-8")):
                if "://" not in target and not target.startswith("mailto:"):
                    yield path, target


# Licences


def test_every_python_file_begins_with_its_licence_and_a_docstring() -> None:
    wrong = []
    for path in python_files():
        text = path.read_text(encoding="utf-8")
        if not re.match(r'# SPDX-License-Identifier: Apache-2\.0\n(#.*\n|\n)*r?"""[^"\s]', text):
            wrong.append(str(path.relative_to(ROOT)))
    assert wrong == []
    assert len(python_files()) > 5


def test_no_file_is_larger_than_half_a_megabyte() -> None:
    # Answers of others and stored results have limits of their own, which `read_submission` and test_results.py hold.
    apart = ("submissions/*/*/predictions/*.parquet", "docs/results/*/*", HEAD_START, WEIGHTS)
    files = [path for path in repository_files() if not any(path.match(pattern) for pattern in apart)]
    large = [str(path.relative_to(ROOT)) for path in files if path.stat().st_size > MAX_FILE_BYTES]
    assert large == []
    assert (ROOT / HEAD_START).stat().st_size <= 15 * MAX_FILE_BYTES


# What others bring along


def test_actions_and_the_base_image_are_pinned_by_what_cannot_be_moved() -> None:
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    used = re.findall(r"uses: (\S+)(.*)", "\n".join(path.read_text("utf-8") for path in workflows))
    assert len(used) > 5
    for action, comment in used:
        assert re.fullmatch(r"[\w.-]+/[\w.-]+@[0-9a-f]{40}", action), action
        assert re.fullmatch(r" # v\d+\.\d+\.\d+", comment), f"{action} does not say its version"
    assert re.search(r"^ARG BASE=\S+@sha256:[0-9a-f]{64}$", read("Containerfile"), flags=re.MULTILINE)


def test_no_image_holds_a_private_seed() -> None:
    assert "**/*.seed" in read(".dockerignore").splitlines()
    assert "*.seed" in read(".gitignore").splitlines()


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no git repository here")
def test_no_line_of_what_git_grep_prints_is_longer_than_a_screen_holds() -> None:
    found = subprocess.run(["git", "grep", "-l", "-I", "-P", ".{5000}"], cwd=ROOT, capture_output=True, text=True)  # noqa: S607, PLW1510
    assert (found.stdout, found.stderr, found.returncode) == ("", "", 1)  # nothing found


# What is installed


@pytest.mark.parametrize("name", LOCKS)
def test_the_lock_pins_every_requirement_with_hashes_and_names_no_address(name: str) -> None:
    blocks = locked_blocks(name)
    assert len(blocks) > 30
    for word in ("://", "--index", "--extra-index", "--find-links", "--trusted-host", " @ ", "file:", "-e "):
        assert word not in read(name), word
    for block in blocks:
        assert re.match(r"[\w.-]+==[\w.+!]+ ", block), block
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), block


def test_the_lock_holds_every_declared_requirement() -> None:
    # PyTorch is large and built for each GPU: whoever wants it chooses a build.
    groups = project()["optional-dependencies"].items()
    declared = project()["dependencies"] + [name for extra, names in groups if extra != "torch" for name in names]
    missing = requirement_names(declared) - requirement_names(locked_blocks())
    assert missing == set(), "run `make lock`"


def test_the_tools_of_the_documentation_are_locked_to_the_same_versions_and_installed_by_nothing_else() -> None:
    groups = tomllib.loads(read("pyproject.toml"))["dependency-groups"]
    assert requirement_names(groups["docs"]) - requirement_names(locked_blocks("requirements-docs.lock")) == set()
    assert requirement_names(groups["docs"]) & requirement_names(locked_blocks()) == set()
    pinned, tools = ({re.match(r"[\w.-]+==\S+", one)[0] for one in locked_blocks(name)} for name in LOCKS)
    shared = requirement_names(list(pinned)) & requirement_names(list(tools))
    assert {one for one in tools if requirement_names([one]) & shared} <= pinned


def test_the_declared_requirements_are_what_the_code_imports() -> None:
    imported = set()
    for path in (ROOT / "sasgeo_bench").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(str(node.module).split(".")[0])
    imported -= {*sys.stdlib_module_names, "sasgeo_bench"}
    extras = [name for extra, names in project()["optional-dependencies"].items() if extra != "dev" for name in names]
    declared = requirement_names(project()["dependencies"] + extras) - set(INDIRECT)
    assert {IMPORTED_AS.get(name, name) for name in declared} == imported


def test_a_wheel_holds_the_types_the_taxonomy_and_the_shipped_folders(tmp_path: Path) -> None:
    if find_spec("hatchling") is None:
        pytest.skip("hatchling, the build backend, is not installed (make install brings it)")
    from hatchling.builders.wheel import WheelBuilder  # noqa: PLC0415 - only where it is installed

    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = set(zipfile.ZipFile(wheel).namelist())
    files = ("py.typed", "__init__.pyi", "osm/taxonomy.toml", "ageing/ratebook.toml", "cli/program.py")
    files += ("osm/regional_extracts.toml",)
    expected = {f"sasgeo_bench/{name}" for name in files}
    templates = (ROOT / "sasgeo_bench" / "boards" / "templates").iterdir()
    expected |= {f"sasgeo_bench/boards/templates/{path.name}" for path in templates}
    for folder in SHIPPED:
        expected |= {f"sasgeo_bench/shipped/{folder}/{path.name}" for path in (ROOT / folder).iterdir()}
    assert expected - names == set()
    assert [name for name in names if name.startswith(("tests/", "baselines/", "paper/", "regions/"))] == []


def test_every_extra_is_documented_with_its_packages() -> None:
    rows = re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", read("docs/howto/install.md"), flags=re.MULTILINE)
    shown = {name: set(packages.split(", ")) for name, packages in rows}
    extras = project()["optional-dependencies"]
    assert shown.keys() == extras.keys()
    assert {name: requirement_names(extras[name]) for name in shown if name != "dev"} == {
        name: packages for name, packages in shown.items() if name != "dev"
    }


# Commands


def test_ci_builds_the_image_runs_its_commands_and_knows_every_system() -> None:
    jobs = yaml.safe_load(read(".github/workflows/checks.yml"))["jobs"]
    ran = [step["run"] for step in jobs["container"]["steps"] if "run" in step]
    for text in (read("Containerfile"), read("docs/howto/install.md")):
        assert re.findall(r"^(?:#   )?(podman .*)$", text, flags=re.MULTILINE)[:3] == ran
    assert [system.split("-")[0] for system in jobs["elsewhere"]["strategy"]["matrix"]["system"]] == [
        "macos",
        "windows",
    ]


def test_make_alone_prints_every_target_with_its_line() -> None:
    shown = subprocess.run(["make"], cwd=ROOT, capture_output=True, text=True, check=True).stdout  # noqa: S607 - make of PATH
    phony = re.search(r"^\.PHONY: (.*)$", read("Makefile"), flags=re.MULTILINE)[1].split()
    assert set(re.findall(r"^  ([a-z-]+) +\S", shown, flags=re.MULTILINE)) == set(phony)


@pytest.mark.slow  # make test finds it too, by chance: its two processes must collect the same
def test_two_processes_collect_the_same_tests_whenever_and_wherever_they_do() -> None:
    found = []
    for seed, zone, tongue in (("1", "Asia/Kolkata", "C"), ("2", "America/Lima", "C.UTF-8")):
        place = {"PYTHONHASHSEED": seed, "TZ": zone, "LC_ALL": tongue, "COLUMNS": "40"}
        command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", "tests"]
        done = subprocess.run(command, cwd=ROOT, env=os.environ | place, capture_output=True, text=True, check=True)  # noqa: S603 - our own tests
        found.append([line for line in done.stdout.splitlines() if "::" in line])
    assert len(found[0]) > 3000
    assert found[0] == found[1]


def test_every_make_command_in_a_document_exists() -> None:
    targets = set(re.findall(r"^([a-z-]+):", read("Makefile"), flags=re.MULTILINE))
    for path in repository_files():
        if path.suffix == ".md":
            named = set(re.findall(r"(?:`|^)make ([a-z-]+)", path.read_text(encoding="utf-8"), flags=re.MULTILINE))
            assert named <= targets, path


# Documents and data


def test_the_changelog_and_the_package_say_the_version_it_is_released_under() -> None:
    newest = re.search(r"^## \[?([\w.]+)", read("CHANGELOG.md"), flags=re.MULTILINE)[1]
    in_code = re.search(r'^__version__ = "([^"]+)"$', read("sasgeo_bench/__init__.py"), flags=re.MULTILINE)[1]
    assert newest == project()["version"] == in_code


def test_the_baselines_ask_for_the_package_by_its_name() -> None:
    asked = requirement_names(project("baselines/pyproject.toml")["dependencies"])
    assert asked == {project()["name"], "lightgbm", "networkx", "scikit-learn"}
    assert project("paper/pyproject.toml")["dependencies"] == [f"{project()['name']}=={project()['version']}"]


def test_every_citation_says_what_the_package_says_of_itself() -> None:
    package, cff, zenodo = project(), yaml.safe_load(read("CITATION.cff")), json.loads(read(".zenodo.json"))
    for name in ("version", "license", "keywords"):
        assert cff[name] == zenodo[name] == package[name], name
    assert cff["title"] == zenodo["title"]
    assert cff["authors"] == zenodo["creators"] == package["authors"]
    (reference,) = cff["references"]
    assert zenodo["references"][0].endswith(f": {reference['title']}")
    for name, value in (("version", package["version"]), ("title", cff["title"])):
        assert re.search(rf"{name} += \{{(.*)\}}", read("README.md"))[1] == value
    for other in ("baselines", "paper"):
        assert project(f"{other}/pyproject.toml")["version"] == package["version"], other


def test_an_image_installs_from_the_lock_and_runs_as_a_user_without_rights() -> None:
    steps = re.findall(r"^([A-Z]+) (.*)$", read("Containerfile"), flags=re.MULTILINE)
    names = [name for name, _ in steps]
    assert names.index("USER") < names.index("COPY")
    assert ("USER", "sasgeo") in steps
    assert ("VOLUME", "/work/out") in steps
    assert [text.startswith("make install") for name, text in steps if name == "RUN"] == [False, True]
    assert set(read(".dockerignore").split()) >= {".git", ".venv*", "dist", "out"}
