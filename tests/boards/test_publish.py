# SPDX-License-Identifier: Apache-2.0
"""Publishing a board: whole or not at all, from its folder alone, all shown as text, every link leading on."""

import gzip
import json
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from sasgeo_bench.boards import publish as build
from sasgeo_bench.boards import site_files
from sasgeo_bench.boards.board_files import check_board
from sasgeo_bench.boards.publish import publish
from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import reporting
from tests.handmade import (
    HOSTILE,
    MARKUP,
    SHARES,
    card_of,
    entry_of,
    full_board,
    many_rows,
    put_board,
    put_pictures,
    verdict,
)

KILLED = """
import os, signal, sys
from pathlib import Path
from sasgeo_bench.boards import publish as publish
from sasgeo_bench.boards import site_files

put = site_files._put
def put_and_die(path, data):
    put(path, data)
    os.kill(os.getpid(), signal.SIGKILL)
site_files._put = put_and_die
publish.publish(Path(sys.argv[1]))
"""
VOID = {"meta", "link", "img", "br", "rect", "wbr", "input"}


class Reader(HTMLParser):
    """What a page says: its elements with their attributes, its text by element, and whether it is well nested."""

    def __init__(self, text):
        super().__init__()
        self.found, self.texts, self.open, self.faults = [], [], [], []
        self.feed(text)
        self.faults += self.open

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self.texts.append([tag, ""])
        if tag not in VOID:
            self.open.append((tag, len(self.texts) - 1))

    def handle_startendtag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        self.texts.append([tag, ""])

    def handle_endtag(self, tag):
        if not self.open or self.open.pop()[0] != tag:
            self.faults.append(tag)

    def handle_data(self, data):
        for _, at in self.open:
            self.texts[at][1] += data

    def said(self, tag):
        return [" ".join(text.split()) for name, text in self.texts if name == tag]


def read(site):
    return {path.name: Reader(path.read_text(encoding="utf-8")) for path in site.glob("*.html")}


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def quiet(_):
    """Tell nobody."""


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A board with pictures and hostile names; read it, do not write to it."""
    folder = tmp_path_factory.mktemp("publish") / "mine"
    hostile = card_of(HOSTILE, title=MARKUP, limits=MARKUP, needs=["vectors"], tracks=["localization"])
    full_board(
        folder,
        shares=SHARES | {HOSTILE: 0.5},
        changes={
            HOSTILE: {"card": hostile},
            "raster": {"how": "as submitted", "card": None, "isolation": None},
            "far": {"set_apart": "trained on a test place", "trained_on": ["vaduz"]},
        },
    )
    put_pictures(folder)
    return folder


@pytest.fixture(scope="module")
def site(board, tmp_path_factory):
    """Its site, under a sub-path."""
    target = tmp_path_factory.mktemp("host") / "deep" / "under" / "site"
    publish(board, target)
    return target


@pytest.fixture(scope="module")
def pages(site):
    return read(site)


@pytest.fixture
def own(board, tmp_path):
    return Path(shutil.copytree(board, tmp_path / "mine"))


@pytest.fixture
def few(tmp_path):
    """A board of one's own with two rows and no figures: for tests that are about whole sites and their folders."""
    folder = put_board(tmp_path / "mine", table=many_rows(2))
    (folder / "figures").mkdir(exist_ok=True)
    return folder


def test_a_site_has_every_page_and_each_leads_only_to_what_is_there(site, pages):
    assert pages.keys() >= {"index.html", "suites.html", "matchers.html", "rejection.html", "figures.html"}
    assert pages.keys() >= {"failures.html", "regions.html", "ageing.html", "method.html", "suite-real-age.html"}
    assert pages.keys() >= {"matcher-graph.html", "matcher-script-alert-1-script.html"}
    led_to = set()
    for name, page in pages.items():
        ids = [each["id"] for _, each in page.found if "id" in each]
        assert len(ids) == len(set(ids)), name
        for tag, each in page.found:
            target = each.get("href") or each.get("src")
            if target is None or target == "data:,":
                continue
            if "://" in target:
                assert (tag, target) == ("a", "https://www.openstreetmap.org/copyright")
                continue
            file, _, part = target.partition("#")
            file = file.partition("?")[0]
            assert not file.startswith("/"), target
            assert not file or (site / file).is_file(), (name, target)
            if part:
                there = pages[file or name]
                assert part in {each["id"] for _, each in there.found if "id" in each}, (name, target)
            led_to.add(file or name)
    led_to |= {each["data-file"] for _, each in pages["map.html"].found if "data-file" in each}
    assert contents(site).keys() - led_to - {"site.json"} == set()


def test_every_page_is_well_formed_and_says_whose_data_it_is(site, pages):
    for name, page in pages.items():
        assert page.faults == [], name
        assert len(page.said("h1")) == 1, name
        assert page.found[0] == ("html", {"lang": "en"})
        assert "OpenStreetMap contributors" in page.said("footer")[0]
        assert "ODbL" in page.said("footer")[0]
        for tag, each in page.found:
            assert tag != "img" or each.get("alt"), name
            assert not any(one.startswith("on") for one in each), (name, each)
    for path in site.rglob("*.svg"):
        assert "(c) OpenStreetMap contributors, ODbL" in path.read_text(encoding="utf-8"), path
    for name in ("suite-real-age.html", "failures.html", "regions.html"):
        credits_ = [each for tag, each in pages[name].found if each.get("class") == "credit"]
        pictures = [each for tag, each in pages[name].found if tag == "img" and each["src"].startswith("pictures/")]
        assert len(credits_) == len(pictures) > 0


def test_hostile_names_and_cards_with_markup_are_shown_as_text(pages):
    assert HOSTILE in " ".join(pages["index.html"].said("table"))
    card = " ".join(pages["matcher-script-alert-1-script.html"].said("dl"))
    assert MARKUP in card
    assert MARKUP in " ".join(pages["matcher-script-alert-1-script.html"].said("li"))
    assert MARKUP in " ".join(pages["failures.html"].said("dl"))
    for name, page in pages.items():
        files = ["site.js", "leaflet.js", "map.js"] if name == "map.html" else ["site.js"]
        scripts = [each for tag, each in page.found if tag == "script"]
        assert scripts == [{"src": file, "defer": None} for file in files], name
        assert not [each for tag, each in page.found if tag == "img" and each["src"] == "x"]


def test_the_board_is_what_its_tables_say_read_by_meaning(pages):
    index = pages["index.html"]
    assert index.said("h1") == ["mine"]
    heads = index.said("h2")
    assert heads[0] == "Who is good at what: localization, searched: disc of 500 m, heading +-20 deg, scale +-3 %"
    rest = [text for text in heads if not text.startswith("Who is good at what")]
    assert rest[:3] == ["What this is", "Which differences are real", "Whether to trust the board"]
    lines = [text for text in index.said("li") if text.startswith(("real-age: ", "occlusion: "))]
    sentences = [text for text in lines if " rank " in text]
    assert len(sentences) == 4
    assert all("2 share the first rank" in text and "graph and raster; " in text for text in sentences)
    outcomes = [text for text in index.said("h3") if text.startswith(("decided", "equal", "not decided"))]
    assert outcomes[0] == "decided real: graph is better than weak, by as much as matters"
    assert outcomes[1] == "not decided close: graph against raster"
    assert any(text.startswith("No difference shown") for text in index.said("p"))
    first = " ".join(index.said("li"))
    assert re.search(r"Difference 0\.\d{3} \[0\.\d{3}, 0\.\d{3}\] in the share of queries that are right", first)
    assert re.search(r"adjusted p 0\.004 \(Holm, 2 contrasts\); n = 120 queries; 20 blocks; 10 places;", first)
    assert "Controls: all 1 held." in index.said("p")
    heads = [text for text in index.said("h3") if text.startswith(("real-age", "occlusion"))]
    assert heads == [
        "occlusion: localization, searched: disc of 500 m, heading +-20 deg, scale +-3 %",
        "occlusion: retrieval, searched: whole map, heading +-20 deg, scale +-3 %",
        "real-age: localization, searched: disc of 500 m, heading +-20 deg, scale +-3 %",
        "real-age: localization, searched: whole map, heading unknown, scale +-15 %",
    ]
    tied = [text for text in index.said("p") if text.startswith("Tied: ")]
    assert tied
    assert all("graph, raster share ranks 1 to 2" in text for text in tied)
    marks = {text for text in index.said("span") if text in {"run here", "as submitted", "control", "tie", "set apart"}}
    assert marks == {"run here", "as submitted", "control", "tie", "set apart"}
    assert any(text.startswith("Set apart, not to be compared with those above: ") for text in index.said("h4"))


def test_every_column_of_every_table_says_what_it_means_to_a_keyboard_too(pages):
    for name, page in pages.items():
        tips = {
            each["id"]: text
            for (_, each), (_, text) in zip(page.found, page.texts, strict=True)
            if each.get("role") == "tooltip"
        }
        buttons = [each for tag, each in page.found if tag == "button" and each.get("id") not in {"previous", "next"}]
        words = [each for each in buttons if each.get("class") == "term"]
        for each in buttons:
            assert len(tips[each["aria-describedby"]]) > 20, name
        assert not any("no meaning is written down" in text for text in tips.values()), name
        assert bool(words) == (name == "index.html")
        assert len(buttons) - len(words) == len([1 for tag, each in page.found if tag == "th" and "aria-sort" in each])


def test_no_figure_stands_without_interval_and_n(pages):
    for name in ("index.html", "suite-real-age.html", "matcher-graph.html"):
        for table in re.findall(r"success_25m.*?</table>", "".join(map(str, pages[name].said("table")))):
            assert "[" in table
        heads = [text for text in pages[name].said("thead") if "success_25m" in text]
        assert heads
        assert all(re.search(r"\bn: ", text) or " n" in text for text in heads)


def test_a_suite_says_what_is_done_and_a_matcher_what_it_cannot(pages):
    card = " ".join(pages["suite-real-age.html"].said("dl"))
    assert "The map is that of an extract about 2, 5 or 10 years older" in card
    assert "The same views against the map of the same day." in card
    assert "S1" in " ".join(pages["suite-real-age.html"].said("tbody"))
    lines = pages["matcher-script-alert-1-script.html"].said("li")
    assert "Needs vectors; where a query lacks that it is not applicable" in lines
    assert "Does not answer retrieval" in lines
    assert "latency_p50, localization" in " ".join(pages["matcher-graph.html"].said("dt"))
    assert "A file of predictions brings no card" in " ".join(pages["matcher-raster.html"].said("p"))


def test_the_failures_lead_from_one_to_the_next_without_scripts(pages):
    titles = pages["failures.html"].said("h3")
    assert titles == ["1 of 3: aliased, graph", "2 of 3: occluded, graph", "3 of 3: odd one, graph"]
    turns = [each["href"] for _, each in pages["failures.html"].found if each.get("rel") in ("next", "prev")]
    assert turns == ["#case-2", "#case-1", "#case-3", "#case-2"]


def test_what_is_offered_is_what_the_board_holds(board, site):
    for name in ("leaderboard.parquet", "leaderboard.csv", "leaderboard.tex", "contrasts.parquet"):
        data = (
            gzip.decompress((site / "files" / f"{name}.gz").read_bytes())
            if not (site / "files" / name).is_file()
            else (site / "files" / name).read_bytes()
        )
        assert data == (board / name).read_bytes()


def test_the_site_is_small(site):
    total = sum(len(data) for name, data in contents(site).items() if not name.startswith(("pictures/", "files/")))
    assert total < site_files.MOST_BYTES


def test_stored_results_make_the_same_pages(board, site, tmp_path):
    stored = Path(shutil.copytree(board, tmp_path / "mine"))
    for path in (stored / "leaderboard.csv", *stored.glob("figures/*.svg")):
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes()))
        path.unlink()
    publish(stored)
    assert contents(stored / "site") == contents(site)


def test_a_site_of_tables_alone_scores_nothing_and_says_what_it_lacks(tmp_path, monkeypatch):
    stored = Path("docs/results/systems-objects").absolute()
    monkeypatch.setattr(build, "score_all", None)
    folder = publish(stored, tmp_path / "site", tables_only=True).folder
    held = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {name for name in held if name.startswith(("files/", "pictures/", "figures/"))} == {
        *("figures/ageing-rates.svg", "figures/first-times.svg", "figures/places.svg", "files/kinds-of-place.csv")
    }
    index = Reader((folder / "index.html").read_text(encoding="utf-8"))
    (line,) = [text for text in index.said("p") if text.startswith("This site is of tables alone.")]
    assert "sasgeo-bench publish --board FOLDER makes one with files, figures" in line
    assert "0.768" in " ".join(index.said("table"))


def test_a_site_of_tables_alone_of_a_scored_board_has_no_figures_or_pictures_either(own, mistake):
    folder = publish(own, own.parent / "tables", tables_only=True).folder
    assert not (folder / "pictures").exists()
    assert {path.name for path in (folder / "figures").iterdir()} <= {
        "ageing-rates.svg",
        "first-times.svg",
        "places.svg",
    }
    err = mistake("publish", "--board", own, "--tables-only", "--submissions", own.parent / "submissions")
    assert "--tables-only scores nothing, and --submissions have to be scored: leave one out" in err


def test_rows_that_an_older_version_scored_have_a_site_without_kinds_of_place(tmp_path):
    stored = Path("docs/results/countries").absolute()  # of before `nees_in_band`
    assert "nees_in_band" not in pq.read_schema(stored / "scores.parquet").names
    folder = publish(stored, tmp_path / "site", tables_only=True).folder
    assert not (folder / "kinds-of-place.html").exists()


def test_every_table_and_figure_can_be_linked(pages):
    for page in pages.values():
        ids = {each["id"] for _, each in page.found if "id" in each}
        own = [each["href"] for _, each in page.found if each.get("class") == "here"]
        assert {address.removeprefix("#") for address in own} <= ids
        assert {each["aria-labelledby"] for tag, each in page.found if tag == "table" and len(each) > 1} <= ids
    for name in ("index.html", "suite-real-age.html", "matchers.html", "figures.html"):
        assert any(each.get("class") == "here" for _, each in pages[name].found), name
    (figure,) = [each["id"] for tag, each in pages["figures.html"].found if tag == "figure"]
    assert figure == "age-real-age-localization-r500-weak-s3"


@pytest.mark.usefixtures("plain_site")
def test_a_board_with_its_site_in_it_is_still_a_board_that_can_be_replaced(own):
    publish(own)
    assert (own / "site" / "index.html").is_file()
    about = json.loads((own / "board.json").read_text(encoding="utf-8"))
    check_board(own, scorer_version=about["scorer_version"])
    publish(own)


@pytest.mark.parametrize("count", [1, 40])
@pytest.mark.usefixtures("plain_site")
def test_a_board_of_few_or_many_rows_has_a_page_for_each(tmp_path, count):
    put_board(tmp_path / "mine", table=many_rows(count))
    written = publish(tmp_path / "mine")
    assert written.pages == count + 7
    pages = read(written.folder)
    assert len(re.findall(r"\[0\.\d{3}", " ".join(pages["index.html"].said("tbody")))) == count
    assert "Controls: none were drawn for this board" in " ".join(pages["index.html"].said("p"))


@pytest.mark.slow
def test_pages_of_a_board_of_500_rows_stay_small(tmp_path):
    put_board(tmp_path / "mine", table=many_rows(500))
    written = publish(tmp_path / "mine")
    assert written.pages == 507
    assert max(path.stat().st_size for path in written.folder.glob("*.html")) < 1_000_000


@pytest.mark.usefixtures("plain_site")
def test_a_board_without_a_row_says_so(tmp_path):
    put_board(tmp_path / "mine", tasks=[], split=None)
    pages = read(publish(tmp_path / "mine").folder)
    assert "This board holds no figure." in pages["index.html"].said("p")
    assert "This board has no entry." in pages["matchers.html"].said("li")
    assert pages.keys() & {"rejection.html", "figures.html", "failures.html"} == set()


@pytest.mark.usefixtures("plain_site")
def test_a_failed_control_is_told_where_it_cannot_be_overlooked(tmp_path):
    def box_of(name, tested):
        put_board(
            tmp_path / name,
            table=many_rows(2),
            entries=[entry_of("graph")],
            verdicts=[replace(verdict(holds=False), matcher=tested)],
        )
        page = read(publish(tmp_path / name).folder)["index.html"]
        parts = zip(page.found, page.texts, strict=True)
        kinds = ((each.get("class"), text) for (_, each), (_, text) in parts)
        return next((kind, text) for kind, text in kinds if kind in {"held", "doubtful", "failed"})

    kind, text = box_of("mine", "random")
    assert kind == "failed"
    assert "CONTROLS FAILED, 1 of 1: do not trust this board." in text
    kind, text = box_of("yours", "graph")  # a rival's failure is of its own rows
    assert kind == "doubtful"
    assert "Controls: 0 of 1 held. Do not trust the rows of graph:" in text


@pytest.mark.usefixtures("plain_site")
def test_a_suite_and_a_region_that_nobody_knows_are_named_all_the_same(tmp_path):
    table = many_rows(2).assign(suite="nobodys-suite", prior_group="my-group")
    tasks = [{"suite": "nobodys-suite", "region": "my-town"}]
    made_by = {"pipeline": {"id": "x", "sha256": "y"}, "title": "A title of mine"}
    put_board(tmp_path / "mine", table=table, tasks=tasks, entries=[entry_of("unasked")], **made_by)
    lines = []
    with reporting(lines.append):
        pages = read(publish(tmp_path / "mine").folder)
    assert lines == ["not on the map of places, for no region of that name ships or is built in out: my-town"]
    assert "No suite of this version has that name" in " ".join(pages["suite-nobodys-suite.html"].said("p"))
    assert "nobodys-suite: localization, my-group" in pages["index.html"].said("h3")
    assert "It has no figure on this board." in pages["matcher-unasked.html"].said("p")
    assert pages["index.html"].said("h1") == ["mine: A title of mine"]


@pytest.mark.usefixtures("plain_site")
def test_a_region_of_ones_own_is_on_the_map_with_its_scenes_where_it_is_built(tmp_path, towns):
    built = tmp_path / "out" / "regions" / "my-place"
    built.mkdir(parents=True)
    shutil.copy(towns / "regions" / "town-riverside" / "region.json", built)
    scenes = json.loads((built / "region.json").read_text(encoding="utf-8"))["scenes"]
    tasks = [{"suite": "photos", "region": "my-place"}]
    put_board(tmp_path / "mine", table=many_rows(2).assign(suite="photos"), tasks=tasks, entries=[entry_of("unasked")])
    lines = []
    with reporting(lines.append):
        site = publish(tmp_path / "mine", root=tmp_path / "out").folder
    assert lines == []
    text = (site / "regions.html").read_text(encoding="utf-8")
    assert "is not known" not in text
    assert ", ".join(scenes) in text
    assert "made from them. Code: Apache-2.0." in text


# Bad input


@pytest.mark.slow
@pytest.mark.usefixtures("plain_site")
def test_interrupted_the_old_site_stays_whole_and_the_next_takes_its_place(few):
    publish(few)
    before = contents(few / "site")
    changed = json.loads((few / "board.json").read_text(encoding="utf-8")) | {"draws": 4321}
    (few / "board.json").write_text(json.dumps(changed), encoding="utf-8")
    root = Path(__file__).parents[2]
    killed = subprocess.run([sys.executable, "-c", KILLED, str(few)], cwd=root, check=False)  # noqa: S603 - our own
    assert killed.returncode == -signal.SIGKILL
    assert contents(few / "site") == before
    assert (few / ".site.partial").is_dir()
    check_board(few, scorer_version=changed["scorer_version"])
    publish(few)
    assert b"4321 draws" in contents(few / "site")["index.html"]
    assert not (few / ".site.partial").exists()


@pytest.mark.usefixtures("plain_site")
def test_a_full_disk_is_one_line_and_the_old_site_stays(few, monkeypatch):
    publish(few)
    before = contents(few / "site")

    def fill(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(site_files, "_put", fill)
    with pytest.raises(StoreError, match=r"site cannot be written \(No space left on device\): check .* as it was"):
        publish(few)
    assert contents(few / "site") == before


def test_what_is_no_site_is_not_replaced(own, tmp_path):
    thesis = tmp_path / "thesis"
    thesis.mkdir()
    (thesis / "chapter.txt").write_text("years of work", encoding="utf-8")
    with pytest.raises(StoreError, match="holds something else than a site, which would be lost: name another folder"):
        publish(own, thesis)
    with pytest.raises(StoreError, match=r"chapter\.txt is a file: move it away"):
        publish(own, thesis / "chapter.txt")
    for target in (own, own / "figures", own / "public"):
        with pytest.raises(StoreError, match="is the board itself, or would be a strange folder in it: name another"):
            publish(own, target)
    assert contents(thesis) == {"chapter.txt": b"years of work"}


def test_a_folder_without_a_board_is_one_line(mistake, tmp_path):
    assert "holds no board (board.json): name the folder of one" in mistake("publish", "--board", tmp_path / "none")
    there = tmp_path / "out" / "boards" / "demo" / "board.json"
    there.parent.mkdir(parents=True)
    there.touch()
    for name, hint in (("demo", "did you mean out/boards/demo?"), ("none", "name the folder of one, as out/boards/d")):
        assert f"{name} holds no board (board.json): {hint}" in mistake("publish", "--board", name)


def about(**changes):
    return json.dumps({"scorer_version": 4, "entries": [], "tasks": []} | changes)


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("board.json", "{", "holds a damaged board"),
        ("board.json", "{}", "holds a damaged board (scorer_version: Field required): score it again"),
        ("board.json", '{"scorer_version": 4, "tasks": []}', "holds a damaged board (entries: Field required)"),
        ("board.json", about(entries=[1]), "holds a damaged board (entries.0 is 1: Input should be an object)"),
        ("leaderboard.parquet", "half", "leaderboard.parquet cannot be read ("),
        ("scores.parquet", "half", "scores.parquet cannot be read ("),
        ("figures/age.svg.gz", "half", "holds a damaged board"),
        ("pictures/pictures.json", "[]", "pictures.json is damaged"),
        ("pictures/pictures.json", '{"regions": [{"file": "../board.json"}]}', "which is no picture"),
        ("pictures/pictures.json", '{"cases": [{"file": "lost.png"}]}', "names 'lost.png', which is no picture"),
        ("pictures/pictures.json", '{"cases": [{"alt": "no file"}]}', "pictures.json is damaged"),
        ("pictures/pictures.json", "[" * 200_000, "pictures.json is damaged"),
        ("pictures/pictures.json", '{"cases": [{"file": "a.png", "facts": 5}]}', "cases.0.facts is 5"),
        ("board.json", "[" * 200_000, "holds a damaged board (it is nested too deep"),
        ("board.json", about(pipeline=5), "pipeline is 5"),
        ("board.json", about(libraries=[]), "libraries is []"),
        ("board.json", about(rejectors=[1]), "rejectors.0 is 1"),
        ("board.json", about(remarks="one"), "remarks is 'one'"),
        ("board.json", about(entries=[{"name": None}]), "entries.0.name is None"),
        ("board.json", about(entries=[{"name": "a", "card": []}]), "entries.0.card is []"),
        ("board.json", about(entries=[{"name": "a", "learned": [{}]}]), "entries.0.learned.0.file"),
        ("board.json", about(tasks=[{"region": 1}]), "tasks.0.region is 1"),
        ("board.json", about(contrasts=[{}]), "contrasts.0.name"),
    ],
)
def test_damaged_files_of_a_board_are_one_line_and_nothing_is_written(own, mistake, name, text, fault):
    (own / name).write_text(text, encoding="utf-8")
    assert fault in mistake("publish", "--board", own)
    assert not (own / "site").exists()


@pytest.mark.parametrize("value", [7.5, -0.1, float("inf")])
def test_a_share_beyond_its_range_is_one_line(own, mistake, value):
    path = own / "leaderboard.parquet"
    table = pd.read_parquet(path)
    at = table.index[table["metric"] == "success_25m"][0]
    table.loc[at, "value"] = value
    table.to_parquet(path)
    assert f"success_25m of {table.loc[at, 'matcher']} is {value}, not 0..1: score it again" in mistake(
        "publish", "--board", own
    )


def test_a_refused_board_leaves_nothing_where_its_site_was_to_go(own, mistake, tmp_path):
    (own / "board.json").write_text("{}", encoding="utf-8")
    mistake("publish", "--board", own, "--into", tmp_path / "new" / "site")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("name", "column", "value"),
    [
        ("leaderboard", "n", None),
        ("leaderboard", "n", "many"),
        ("leaderboard", "matcher", None),
        ("leaderboard", "value", "half"),
        ("leaderboard", "is_applicable", "yes"),
        ("contrasts", "verdict", 5.0),
        ("contrasts", "difference", "half"),
        ("controls", "holds", "yes"),
        ("scores", "suite", 5),
    ],
)
def test_a_column_of_another_type_is_one_line(own, mistake, name, column, value):
    path = own / f"{name}.parquet"
    table = pd.read_parquet(path)
    table.assign(**{column: [value] * len(table)}).to_parquet(path)
    assert f"{name}.parquet: {column} holds something else than it should" in mistake("publish", "--board", own)
    table.drop(columns=column).to_parquet(path)
    assert f"{name}.parquet has no column '{column}'" in mistake("publish", "--board", own)
    assert not (own / "site").exists()


@pytest.mark.parametrize("kind", ["cut off", "not packed", "too much"])
def test_a_packed_file_that_is_cut_off_or_holds_too_much_is_one_line(own, mistake, kind):
    (own / "leaderboard.csv").unlink()
    whole = gzip.compress(bytes(60_000_000 if kind == "too much" else 100_000), mtime=0)
    data = {"cut off": whole[:60], "not packed": b"half", "too much": whole}[kind]
    (own / "leaderboard.csv.gz").write_bytes(data)
    assert "holds a damaged board (leaderboard.csv.gz" in mistake("publish", "--board", own)
    damaged = bytearray(gzip.compress(bytes(range(256)) * 40, mtime=0))
    damaged[40:60] = bytes(20)
    (own / "leaderboard.csv.gz").write_bytes(damaged)
    assert "holds a damaged board (leaderboard.csv.gz" in mistake("publish", "--board", own)


def test_a_link_in_a_board_is_refused_whatever_it_leads_to(own, mistake, tmp_path):
    (tmp_path / "secret.svg").write_text("<svg/>", encoding="utf-8")
    for name in ("leaderboard.md", "figures/a.svg", "pictures/a.png", "more"):
        path = own / name
        kept = path.read_bytes() if path.is_file() else None
        path.unlink(missing_ok=True)
        path.symlink_to(tmp_path / "secret.svg")
        assert f"{path} is a link, or no file" in mistake("publish", "--board", own)
        path.unlink()
        if kept is not None:
            path.write_bytes(kept)
    (own / "site").symlink_to(tmp_path)
    assert "site is a link: name where it leads with --into" in mistake("publish", "--board", own)


@pytest.mark.parametrize(
    "inside",
    [
        "<script>alert(1)</script>",
        '<path d="M 0 0" onload="alert(1)"/>',
        '<path d="M 0 0" OnClick="alert(1)"/>',
        '<a href="javascript:alert(1)"><path d=""/></a>',
        '<use href="java&#115;cript:alert(1)"/>',
        '<image href="https://elsewhere.org/a.png"/>',
        '<image xmlns:x="http://www.w3.org/1999/xlink" x:href="//elsewhere.org/a.png"/>',
        '<image href="data:image/svg+xml;base64,PHN2Zy8+"/>',
        "<style>@import 'https://elsewhere.org/a.css';</style>",
        '<path style="fill: url(https://elsewhere.org/a)"/>',
        "<foreignObject/>",
        '<b:script xmlns:b="http://www.w3.org/1999/xhtml">alert(1)</b:script>',
        "<set/>",
    ],
)
def test_a_figure_that_acts_or_fetches_is_refused_by_its_name(own, mistake, inside):
    (own / "figures" / "bad.svg").write_text(f'<svg xmlns="http://www.w3.org/2000/svg">{inside}</svg>', "utf-8")
    line = mistake("publish", "--board", own)
    assert f"{own / 'figures' / 'bad.svg'} holds " in line
    assert "as no figure of a board does: score it again, or remove the file" in line
    assert not (own / "site").exists()


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('<!DOCTYPE svg [<!ENTITY a "b">]><svg xmlns="http://www.w3.org/2000/svg"/>', "bad.svg holds a declaration"),
        ('<?xml version="1.0" encoding="utf-7"?><svg xmlns="http://www.w3.org/2000/svg"/>', "holds a declaration"),
        ("<svg", "bad.svg: it is no XML"),
        ("<svg/>", "bad.svg holds an element 'svg'"),
    ],
)
def test_a_figure_that_is_no_plain_svg_is_refused(own, mistake, text, fault):
    (own / "figures" / "bad.svg").write_text(text, encoding="utf-8")
    assert fault in mistake("publish", "--board", own)


@pytest.mark.usefixtures("plain_site")
def test_files_of_ones_own_in_an_older_site_are_never_lost(few, mistake, tmp_path):
    target = tmp_path / "public"
    publish(few, target)
    record = json.loads((target / "site.json").read_text(encoding="utf-8"))
    assert {*record["files"], "site.json"} == contents(target).keys()
    publish(few, target)
    (target / ".git").mkdir()
    (target / ".git" / "HEAD").touch()
    (target / "CNAME").touch()
    lost = "2 files (.git/HEAD, CNAME) that would be lost and are not part of a site: move that away"
    assert lost in mistake("publish", "--board", few, "--into", target)
    del record["files"]
    (target / "site.json").write_text(json.dumps(record), encoding="utf-8")
    assert lost in mistake("publish", "--board", few, "--into", target)
    shutil.rmtree(target / ".git")
    (target / "CNAME").unlink()
    publish(few, target)
    publish(few)
    (few / "site" / "CNAME").touch()
    (few / "figures" / "notes.txt").touch()
    with pytest.raises(StoreError, match=r"1 file \(figures/notes.txt\) that would be lost"):
        check_board(few, scorer_version=json.loads((few / "board.json").read_text(encoding="utf-8"))["scorer_version"])
    (few / "figures" / "notes.txt").unlink()
    record = {"files": ["thesis.tex"]}  # a file of another program that has the name
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").touch()
    (tmp_path / "thesis" / "site.json").write_text(json.dumps(record), encoding="utf-8")
    assert "1 file (thesis.tex) that would be lost" in mistake("publish", "--board", few, "--into", tmp_path / "thesis")
    with pytest.raises(StoreError, match=r"1 file \(CNAME\) that would be lost"):
        check_board(few, scorer_version=json.loads((few / "board.json").read_text(encoding="utf-8"))["scorer_version"])


@pytest.mark.usefixtures("plain_site")
def test_a_site_is_written_where_a_link_leads(few, mistake, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    publish(few, tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "index.html").is_file()
    (tmp_path / "one").symlink_to(tmp_path / "one")
    assert "leads in a circle" in mistake("publish", "--board", few, "--into", tmp_path / "one")
    assert "is the board itself" in mistake("publish", "--board", few, "--into", few / "figures" / "deep")


def test_a_table_that_is_no_leaderboard_is_one_line(own, mistake):
    pd.DataFrame({"matcher": ["mine"]}).to_parquet(own / "leaderboard.parquet")
    assert "holds a damaged board: leaderboard.parquet has no column 'rejector': score it again" in mistake(
        "publish", "--board", own
    )


def test_the_command_ends_with_the_path_to_open(program, own):
    code, out, err = program("publish", "--board", own)
    assert code == 0, err
    assert out.strip() == str(own / "site" / "index.html")
    assert re.search(r"site: \d+ pages, 0\.\d\d MB, 0\.\d\d MB of pictures, 0\.\d\d MB of downloads", err)
