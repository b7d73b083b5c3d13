# SPDX-License-Identifier: Apache-2.0
"""Text from outside is data: hostile texts through every file, picture, page and terminal, and a board of them."""

import csv
import io
import json
import re
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.table import Table

import sasgeo_bench
from sasgeo_bench.boards.board_files import write_board
from sasgeo_bench.boards.cases import pixels_of
from sasgeo_bench.boards.plots import BoardPage, line_keys
from sasgeo_bench.boards.site import environment
from sasgeo_bench.boards.site_files import svg_fault
from sasgeo_bench.boards.text import Contents, board_latex, board_markdown
from sasgeo_bench.cli.console import Bars, errors, print_table, say, tell
from sasgeo_bench.core.canvas import PlainFigure, page
from sasgeo_bench.core.texts import (
    csv_cell,
    json_text,
    markdown,
    markdown_code,
    markdown_item,
    plain,
    plain_lines,
    quoted,
    tex,
)
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Prediction, RejectorCard
from sasgeo_bench.regions.region_files import read_manifest, write_manifest
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import RunManifest
from sasgeo_bench.scoring.controls import Verdict
from sasgeo_bench.scoring.tables import leaderboard
from sasgeo_bench.tasks import task_files
from tests.handmade import about_of, asked, entry_of

ROOT = Path(__file__).parents[2]
NASTY = (
    *(r"cost $\nosuchthing$", "$x^2$ and $$", r"\$5", "=1+1", "=cmd|'/C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "'=1"),
    *("\t=1+1", "\r=1+1", "\uff1d1+1", "-0.5", "-", "--", "---", "- x", "* x", "+ x", "# x", "## x ##", "1. x", "> x"),
    *("[red]x[/red]", "[/]", "[link=https://x.org]x[/link]", ":smile:", "\x1b[31mred\x1b[0m", "\x1b]8;;x\x07y\x9b31m"),
    *("<script>alert(1)</script>", "</script><img src=x onerror=alert(1)>", "\"><svg onload='x'>", "<!-- x",
     "&lt;b&gt;"),
    *("javascript:alert(1)", "]]>", "<?xml?>", ' style="} * {display:none} .x {" x="1.23456"', "{{ 7 * 7 }}", "{0.x}"),
    *("a|b", r"a\|b", "[x](javascript:alert(1))", "![x](y)", "[x]: y", "[x][y]", "[ ] x", "`x`", "``", "*x*",
     "_x_ __y__"),
    *("~~x~~", "<https://x.org>", "http://x.org www.x.org", "x\n\n# y", "x\r\n| y |", "===", "    x", "a_b_c", "^1"),
    *(r"\input{/etc/passwd}", r"\end{table}", "^^5cinput", "100 % #1 & {y} ~", "[2pt] x", "*", "?` !` -- --- `` ''"),
    *('a: "b" # c', "key: [x", "!!python/object:x", "}, title = {x", "\\", '"', "'", "%s %d", "../../x", "..", "con"),
    *("\u202egpj.exe", "\u2066x\u2069", "\u200b", "\ud800", "x\udfffy", "\x00", "\x7f", "\x85", "\u2028", "\xa0x",
     "\ufeff"),
    *("café §2", "匹配器 🛰", "עברית", "x" * 5000, " ", "\U000e0041"),
)  # fmt: skip
LETTERS = st.text(
    st.one_of(st.characters(), st.sampled_from("\\`*_[]()<>#+-.!|~$&@:=^{}\"'%/ \t\n\r\x1b\u202e\ud800x1"))
)
TEXTS = st.one_of(st.sampled_from(NASTY), LETTERS, st.tuples(LETTERS, st.sampled_from(NASTY), LETTERS).map("".join))
FEW = settings(max_examples=10)


def shown(text):
    """What a reader is to see of a text in one line."""
    return plain(text).strip()


# --- one line of printable characters -------------------------------------------------------------------------------


@given(TEXTS)
def test_a_plain_text_is_as_long_and_printable_and_stays_as_it_is(text):
    found = plain(text)
    assert found.isprintable()
    assert len(found) == len(text)
    assert plain(found) == found
    assert found.encode().decode() == found
    assert plain_lines(text).count("\n") == text.count("\n")


# --- Markdown -------------------------------------------------------------------------------------------------------


def parsed(text):
    return MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(text)


def words_of(tokens):
    """Texts of a document, block by block; refuses every mark within one."""
    found = []
    for token in tokens:
        for part in token.children or ():
            assert part.type in {"text", "text_special"}, part
        if token.type == "inline":
            found.append("".join(part.content for part in token.children))
    return found


@given(TEXTS)
def test_markdown_shows_a_text_as_it_is_wherever_it_stands(text):
    cell, item = markdown(text), markdown_item(text)
    table = parsed(f"| a | b |\n|---|---|\n| {cell} | c |\n")
    assert words_of(table) == ["a", "b", shown(text), "c"]
    assert [token.type for token in table if token.type.endswith("_open")].count("td_open") == 2
    assert words_of(parsed(f"# {cell}\n")) == [shown(text)]
    assert words_of(parsed(f"Of {cell}.\n")) == [f"Of {shown(text)}." if shown(text) else "Of ."]
    listed = parsed(f"- {item}\n- b\n")
    assert words_of(listed) == [*filter(None, [shown(text)]), "b"]
    assert {token.type.rpartition("_")[0] for token in listed if token.children is None} <= {
        *("bullet_list", "list_item", "paragraph")
    }


@given(TEXTS)
def test_markdown_holds_no_address_that_is_made_a_link(text):
    assert not re.search(r"://|www\.", markdown(text), flags=re.IGNORECASE)


@given(TEXTS)
def test_code_of_markdown_holds_names_alone(text):
    (token,) = (one for one in parsed(f"x {markdown_code(text)} x") if one.type == "inline")
    assert {part.type for part in token.children} <= {"text", "text_special", "code_inline"}


# --- LaTeX ----------------------------------------------------------------------------------------------------------

OF_TEX = re.compile(
    r"\\[_%&#${}]|\$[<>|]\$|\$\^\\dagger\$|\\text(?:asciitilde|asciicircum|backslash)\{\}|\{\\char34\}|\{\}|\[U\+\w+\]"
)
MEANT = {r"\textasciitilde{}": "~", r"\textasciicircum{}": "^", r"\textbackslash{}": "\\", r"{\char34}": '"', "{}": ""}
MEANT |= {r"$^\dagger$": "†", **{f"${letter}$": letter for letter in "<>|"}}
MEANT |= {f"\\{letter}": letter for letter in "_%&#${}"}


def by_letter(text):
    """A text with the letters that LaTeX has by number."""
    return re.sub(r"\[U\+([0-9A-F]{4,5})\]", lambda said: chr(int(said[1], 16)), text)


@given(TEXTS)
def test_latex_says_the_text_again_and_holds_no_command_of_it(text):
    found = tex(text)
    assert not set(OF_TEX.sub("", found)) & set('\\{}$&#^_%~<>|"\n\r\t')
    assert not re.search(r"--|\?`|!`|``|''", found)
    assert not found.startswith(("[", "*"))
    read = OF_TEX.sub(lambda said: MEANT.get(said[0]) or ("" if said[0] == "{}" else said[0]), found)
    assert by_letter(read) == by_letter(plain(text))


# --- CSV, TOML, YAML, JSON ------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(TEXTS, st.floats(allow_nan=False, allow_infinity=False)), min_size=1, max_size=4))
def test_a_spreadsheet_gets_the_same_data_and_no_formula(rows):
    rows = [(text.encode(errors="replace").decode(), number) for text, number in rows]  # pandas holds no half pairs
    frame = pd.DataFrame(rows, columns=["name", "value"])
    back = list(csv.reader(io.StringIO(frame.map(csv_cell).to_csv(index=False, lineterminator="\n"))))[1:]
    for (text, number), (name, value) in zip(rows, back, strict=True):
        assert float(value) == number
        assert name.removeprefix("'") == plain(text)
        assert not name.lstrip().startswith(("=", "+", "-", "@")) or re.fullmatch(r"[+-][\d.eE+-]+", name)


@given(TEXTS)
def test_toml_yaml_and_json_read_the_text_again(text):
    assert tomllib.loads(f"name = {quoted(text)}\n") == {"name": plain(text)}
    assert yaml.safe_load(f"name: {quoted(text)}\nrest: 1\n") == {"name": plain(text), "rest": 1}
    read = json.loads(json_text({text: [text]}))
    kept = "".join("?" if "\ud800" <= letter <= "\udfff" else letter for letter in text)
    assert read == {kept: [kept]}
    assert json_text([text]).replace("\n", "").isprintable()
    json_text([text]).encode()


# --- figures --------------------------------------------------------------------------------------------------------


def drawn(path, text):
    """A figure with a text in every place that a figure has."""
    about = BoardPage(title=text or "x", note=text, below=text, keys=line_keys([text or "x", "other"]))
    with page(path, about) as charts:
        (chart,) = charts[0]
        chart.plot([0, 1], [1, 0], label=text)
        chart.set_title(text)
        chart.set_ylabel(text)
        chart.set_yticks([0, 1], [plain(text)[:40], "other"])
        chart.annotate(text[:40], (0, 0))
        chart.legend([text])
    return path.read_bytes()


STYLE = re.compile(r"\.s\d+\{([^}]*)\}")


def properties_of(svg):
    """Names of the properties that the styles of a figure set."""
    return {one for rule in STYLE.findall(svg) for one in re.findall(r"([\w-]+):", rule)}


@pytest.fixture(scope="module")
def harmless(tmp_path_factory):
    """Properties of figures of plain text, of one line and of two, which are set otherwise."""
    path = tmp_path_factory.mktemp("harmless") / "figure.svg"
    return {name for text in ("style of x", "style\nof x") for name in properties_of(drawn(path, text).decode())}


@FEW
@example(r"cost $\nosuchthing$")
@example("\x00\x1b\ud800")
@example(' style="} * {display:none} .x {" x="1.23456"')
@given(TEXTS)
def test_a_figure_is_drawn_and_shows_the_text(tmp_path_factory, harmless, text):
    path = tmp_path_factory.mktemp("figure") / "figure.svg"
    svg = drawn(path, text[:200]).decode()
    assert svg_fault(svg) is None
    values = {"".join(item.itertext()) for item in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")}  # noqa: S314
    for line in text[:200].split("\n"):
        assert plain(line) in values or not plain(line).strip()
    assert properties_of(svg) <= harmless | {"transform", "text-anchor", "font", "fill"}


def test_the_metadata_of_a_picture_are_lines(tmp_path):
    figure = PlainFigure(figsize=(1, 1))
    figure.savefig(tmp_path / "a.png", format="png", metadata={"Title": "a\nb\ud800\x1b", "Software": None})
    assert b"Title\x00a b??" in (tmp_path / "a.png").read_bytes()


# --- the terminal ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", NASTY)
def test_a_terminal_gets_the_text_and_nothing_that_steers_it(capsys, text):
    text = text[:120]
    table = Table(f"head {text}", "n", title=text, box=None)
    table.add_row(f"<{text}>", "1")
    print_table(table)
    say(f"<{text}>")
    tell(f"<{text}>")
    out = capsys.readouterr()
    for line in (*out.out.split("\n"), *out.err.split("\n")):
        assert line.isprintable()
    assert plain_lines(f"<{text}>") in out.out
    assert f"<{plain(text)}>" in out.err
    assert out.err.count("\n") == 1


@pytest.mark.parametrize("text", ["[red]x[/red]", ":smile:", "[/]", "\x1b[31m"])
def test_bars_show_labels_as_they_are(capsys, monkeypatch, text):
    monkeypatch.setattr(errors, "_force_terminal", False)
    with Bars() as bars:
        bars.begin(text, 2)
        bars.advance(text, 2)
    assert plain(text) in capsys.readouterr().err


# --- pages ----------------------------------------------------------------------------------------------------------


class Tags(HTMLParser):
    """Tags of a page with the names of their attributes, and the texts between them."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, [name for name, _ in attrs]))
        self.words += [value for name, value in attrs if name in {"alt", "title"}]

    def handle_endtag(self, tag):
        self.tags.append(f"/{tag}")

    def handle_data(self, data):
        self.words.append(data)


@given(TEXTS)
def test_a_page_has_the_same_tags_whatever_its_texts_are(text):
    template = environment().from_string('<p title="{{ x }}">{{ x }}</p><img alt="{{ x }}">')
    found, harmless = (Tags(template.render(x=one)) for one in (text, "x"))
    assert found.tags == harmless.tags
    assert {"".join(found.words[1:-1]), found.words[0], found.words[-1]} == {plain(text)}


# --- one place for each ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def callers():
    """Files of the package by the names of the functions and classes that they call."""
    found = {}
    package = Path(sasgeo_bench.__file__).parent
    for path in package.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for name in set(re.findall(r"\b(\w+)\(", text)) - set(re.findall(r"\bdef (\w+)\(", text)):
            found.setdefault(name, set()).add(path.relative_to(package).as_posix())
    return found


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("Figure", set()),
        ("Console", set()),
        ("echo", {"cli/console.py", "cli/entering.py"}),
        ("Environment", {"boards/site.py"}),
        ("Markup", set()),
        ("to_csv", {"boards/board_files.py"}),
        ("to_markdown", set()),
        ("to_html", set()),
        ("to_latex", set()),
    ],
)
def test_every_text_goes_out_by_the_one_place_of_its_kind(callers, name, files):
    assert callers.get(name, set()) == files


# --- boards ---------------------------------------------------------------------------------------------------------


def test_a_board_of_hostile_names_is_a_table_of_them_in_every_format(tmp_path):
    names = [text[:300] for text in NASTY if text.isprintable()][:20]
    names += ["=1+1", "a|b [x](javascript:alert(1))", r"\input{x} $\nosuchthing$"]
    board = leaderboard({name: asked(0.5, count=8) for name in dict.fromkeys(names)}, draws=100)
    entries = [entry_of(name, set_apart="- # | <b>") for name in names[:3]]
    about = about_of(entries)
    verdicts = [Verdict(control="a|b", matcher=names[0], n=4, found=1, expected=0, p=0.0, holds=False)]
    text = board_markdown(about, Contents(leaderboard=board, entries=about.entries, verdicts=verdicts))
    plain_names = {name: f"m{at:02d}" for at, name in enumerate(dict.fromkeys(names))}
    plain_about = about_of([entry_of(f"m{at:02d}", set_apart="x") for at in range(3)])
    plain_text = board_markdown(
        plain_about,
        Contents(
            leaderboard=board.assign(matcher=board["matcher"].map(plain_names)),
            entries=plain_about.entries,
            verdicts=[Verdict(control="c", matcher="m00", n=4, found=1, expected=0, p=0.0, holds=False)],
        ),
    )
    assert [one.type for one in parsed(text)] == [one.type for one in parsed(plain_text)]
    assert not {"link_open", "image", "html_inline"} & {
        part.type for one in parsed(text) for part in one.children or ()
    }
    assert not re.search(
        r"(?<!\\)\\(?:input|end\{(?!table|tabular))", board_latex(about_of([]), Contents(leaderboard=board))
    )
    write_board(tmp_path / "board", tables={"leaderboard": board}, about=about)
    back = list(csv.reader((tmp_path / "board" / "leaderboard.csv").open(encoding="utf-8", newline="")))
    assert {row[0].removeprefix("'") for row in back[1:]} == {plain(name) for name in names}
    assert not [cell for row in back for cell in row if cell[:1] in tuple("=+@\t\r")]


# --- everything, from the runs to the site and the release ----------------------------------------------------------

WORDS = r"$\nosuchthing$ | [x](javascript:alert(1)) <img src=x onerror=alert(2)> [red] :smile: =1+1"
SAID = {"name": "mine", "version": "1", "title": "Mine", "source": "original", "ours": "all", "licence": "MIT"}
HASH = "0123456789ab"
ASKED = (("clean", "town-riverside"), ("alias", "town-grid+alias"))


class Doubter:
    """A rejector whose words are hostile."""

    card = RejectorCard(**SAID | {"name": "doubter", "title": WORDS, "source": WORDS})
    remark = f"{WORDS}\x1b[31m"

    def fit(self, predictions, is_false):
        """Learn nothing."""

    def p_false(self, predictions):
        return np.full(len(predictions), 0.5)


class Breaks(Doubter):
    """One that fails, and says so in hostile words."""

    card = RejectorCard(**SAID | {"name": "breaks"})

    def p_false(self, predictions):
        raise ValueError(f"{WORDS}\x1b[31m {len(predictions)}")


@pytest.fixture(scope="module")
def root(tasks, tmp_path_factory):
    """A root whose maps, runs, answers and cards say hostile things."""
    out = tmp_path_factory.mktemp("hostile") / "out"
    out.mkdir()
    for kind in ("tasks", "truth"):
        (out / kind).symlink_to(tasks / kind)
    for place in (tasks / "regions").glob("[!.]*"):
        folder = out / "regions" / place.name
        folder.mkdir(parents=True)
        for file in place.iterdir():
            (folder / file.name).symlink_to(file)
        record = read_manifest(place)
        (folder / "region.json").unlink()
        drops = {f"highway={WORDS}\n\x1b[31m": 3}
        write_manifest(folder, record.model_copy(update={"title": WORDS, "drops": drops, "warnings": (WORDS,)}))
    card = SAID | dict.fromkeys(("title", "source", "ours", "licence", "limits"), WORDS)
    for suite, region in ASKED:
        folder, task = out / "runs" / "mine" / HASH / suite / region, out / "tasks" / suite / region
        answers = [
            Prediction(query_id=query.query_id, status="crash", message=WORDS)
            if at % 4 == 3
            else Prediction(
                query_id=query.query_id,
                candidates=(((query.candidates or [Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)])[0], 1.0),),
                diagnostics={WORDS[:64]: 1.0, "cost $\\nosuchthing$": 2.0, "=1+1": 3.0},
                confidence=0.5,
            )
            for at, query in enumerate(task_files.read_queries(task))
        ]
        prediction_files.write_part(folder, answers, asked=task_files.Task.open(task).asked)
        about = {"matcher": card, "hash": HASH, "suite": suite, "region": region, "isolation": {"network": WORDS}}
        sha256 = task_files.read_task(task)["files"][task_files.QUERIES]["sha256"]
        RunManifest(**about, queries_sha256=sha256).save(folder)
    return out


@pytest.fixture
def printed(program):
    """Run the program; all it prints, which must be printable."""

    def run(*words, status=0):
        code, out, err = program(*words)
        assert code == status, err
        assert (out + err).replace("\n", "").isprintable()
        return out, err

    return run


@pytest.mark.slow
@pytest.mark.usefixtures("few_figures", "plain_site")
def test_a_hostile_board_is_scored_looked_at_published_and_released(root, printed, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    rejectors = ("--rejector", "margin", "--rejector", "tests.core.test_texts:Doubter")
    score = ("score", "--predictions", root / "runs", "--name", "mine", "--draws", "100", *rejectors, "--out", root)
    printed(*score)
    board = root / "boards" / "mine"
    assert list((board / "figures").glob("*.svg"))
    assert "reported_=1+1" in (board / "pictures" / "pictures.json").read_text(encoding="utf-8")
    for name in ("leaderboard.csv", "protection.csv"):
        if (board / name).is_file():
            cells = [cell for row in csv.reader((board / name).open(encoding="utf-8", newline="")) for cell in row]
            assert not [cell for cell in cells if cell[:1] in ("=", "+", "@")]
    run = root / "runs" / "mine" / HASH
    printed("inspect", run, "--out", root)
    query = task_files.Task.open(root / "tasks" / "clean" / "town-riverside").ids()[0]
    out, _ = printed("inspect", run, "--query", query, "--out", root)
    assert cv2.imread(out.removeprefix("picture: ").strip()).shape[2] == 3
    assert plain(WORDS) in printed("inspect", root / "regions" / "town-grid", "--out", root)[0]
    printed("inspect", "clean/town-riverside", "--rows", "1", "--out", root)
    printed("publish", "--board", board, "--into", tmp_path / "site")
    pages = [Tags(path.read_text(encoding="utf-8")) for path in (tmp_path / "site").glob("*.html")]
    tags = [one for found in pages for one in found.tags if isinstance(one, tuple)]
    assert not [names for _, names in tags if any(name.startswith("on") for name in names)]
    with_map = 2  # more scripts, on the page with the map
    assert [names for tag, names in tags if tag == "script"] == [["src", "defer"]] * (len(pages) + with_map)
    assert any(WORDS in word for found in pages for word in found.words)
    regions = ("--regions", "town-grid", "--regions", "town-riverside")
    printed(
        "release", *regions, "--suites", "clean", "--suites", "alias", "--into", tmp_path / "release", "--out", root
    )
    card = (tmp_path / "release" / "README.md").read_text(encoding="utf-8")
    head, body = card.removeprefix("---\n").split("\n---\n", maxsplit=1)
    assert [item["config_name"] for item in yaml.safe_load(head)["configs"]] == ["alias", "clean"]
    (cells,) = ({token.content for token in parsed(body) if token.type == "inline" and "nosuch" in token.content},)
    assert {"".join(part.content for part in parsed(cell)[1].children) for cell in cells} == {shown(WORDS)}


def test_pixels_are_drawn_of_any_figure():
    figure = PlainFigure(figsize=(1, 1))
    figure.text(0, 0, r"$\nosuchthing$")
    assert pixels_of(figure).shape[2] == 3
