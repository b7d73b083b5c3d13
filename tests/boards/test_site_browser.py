# SPDX-License-Identifier: Apache-2.0
"""A published site in a real browser: sorting, filtering, keys, narrow screens, and nothing asked of another host."""

import gzip
import json
import re
import shutil
import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

import cv2
import pytest

from sasgeo_bench.boards.publish import publish
from tests.browser import PATIENCE_S, browser, find_chromium
from tests.handmade import HOSTILE, MARKUP, SHARES, card_of, full_board, put_pictures
from tests.slow import rest_slow

CHROMIUM = find_chromium()
AXE = gzip.decompress((Path(__file__).parents[1] / "data" / "axe" / "axe.min.js.gz").read_bytes()).decode()  # MPL-2.0
WIDE = 1280  # px: no table is cut off on a screen of this width
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine (.ci/install-chromium installs Debian's)"
)
FIRST = "document.querySelector('section.group:not([hidden]) tbody tr th').innerText"
NAMES = (
    "[...document.querySelector('section.group table').querySelectorAll('tbody th a')].map((one) => one.textContent)"
)
SHOWN = "[...document.querySelectorAll('section.group:not([hidden])')].map((one) => one.dataset.suite)"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A site with everything, under a sub-path with a space in it."""
    folder = tmp_path_factory.mktemp("browser")
    shares = SHARES | {HOSTILE: 0.5}
    cards = {HOSTILE: {"card": card_of(HOSTILE, title=MARKUP, limits=MARKUP)}, "far": {"set_apart": "a reason"}}
    full_board(folder / "mine", shares=shares, changes=cards)
    put_pictures(folder / "mine", failures=("aliased", "aliased", "occluded"))
    return publish(folder / "mine", folder / "a host" / "site").folder


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    with browser(CHROMIUM, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def page(tab):
    """The tab as it is at first: wide, light, scripts on."""
    tab.width(1280)
    tab.prefer("light")
    tab.scripts(are_on=True)
    return tab


def address(site, name="index.html"):
    return (site / name).as_uri()


def until(page, script):
    """Wait for something that a script or a key brings about."""
    end = time.monotonic() + PATIENCE_S
    while not page.value(script):
        assert time.monotonic() < end, script
        time.sleep(0.05)


@pytest.mark.parametrize("width", rest_slow([320, WIDE]))
def test_no_page_asks_another_host_nor_the_console_nor_scrolls_sideways(page, site, width):
    page.width(width)
    for path in sorted(site.glob("*.html")):
        page.open(address(site, path.name))
        assert page.faults == [], path.name
        assert all(url.startswith((f"{site.as_uri()}/", "data:,")) for url in page.asked), page.asked
        assert page.value("document.documentElement.scrollWidth") <= width, path.name
        cut = "[...document.querySelectorAll('.tablebox')].filter((one) => one.scrollWidth > one.clientWidth).length"
        assert width < WIDE or page.value(cut) == 0, path.name
        assert page.value("document.title").endswith("mine")


def test_what_a_page_is_made_to_hold_by_a_stranger_is_not_run_nor_asked_of_another_host(page, site, tmp_path):
    spoilt = shutil.copytree(site, tmp_path / "site")
    text = (spoilt / "index.html").read_text(encoding="utf-8")
    planted = "<script>window.planted = 1</script><img src='x' onerror='window.planted = 2'>"
    planted += "<img src='http://other.example/a.png'><style>main { display: none }</style>"
    (spoilt / "index.html").write_text(text.replace("<h1>", f"{planted}<h1>"), encoding="utf-8")
    page.open(address(spoilt))
    assert page.value("window.planted") is None
    assert page.value("getComputedStyle(document.querySelector('main')).display") == "block"
    assert sum("Content Security Policy" in fault for fault in page.faults) == 4, page.faults


def test_pictures_are_there(page, site):
    for name in ("figures.html", "failures.html", "regions.html", "suite-real-age.html", "ageing.html"):
        page.open(address(site, name))
        page.value("document.querySelectorAll('img').forEach((one) => { one.loading = 'eager'; })")
        until(page, "[...document.images].every((one) => one.complete)")
        assert (
            page.value("[...document.images].filter((one) => !one.closest('[hidden]') && !one.naturalWidth).length")
            == 0
        )


def test_a_press_on_a_column_sorts_by_it_and_says_so(page, site):
    page.open(address(site))
    best_first = page.value(NAMES)
    assert best_first[:2] == ["graph", "raster"]
    head = "document.querySelectorAll('section.group')[0].querySelectorAll('thead th')"
    page.value(f"{head}[1].querySelector('button').click()")
    assert page.value(NAMES) == best_first[::-1]
    assert page.value(f"[...{head}].map((one) => one.getAttribute('aria-sort'))")[:3] == ["none", "ascending", "none"]
    page.value(f"{head}[0].querySelector('button').click()")
    assert page.value(NAMES) == sorted(best_first)
    # Who has no rank stays last, whichever way is sorted.
    for _ in range(2):
        page.value(f"{head}[2].querySelector('button').click()")
        assert page.value(NAMES)[-1] == "random"


def test_filters_show_what_was_asked_for_and_a_link_to_what_is_hidden_shows_it(page, site):
    page.open(address(site))
    assert page.value(SHOWN) == ["occlusion", "occlusion", "real-age", "real-age"]
    choose = "((name, value) => {{ const one = document.querySelector(`select[name=${{name}}]`); one.value = value;"
    choose = choose.replace("{{", "{").replace("}}", "}")
    choose += " one.dispatchEvent(new Event('change', {bubbles: true})); })"
    page.value(f"{choose}('suite', 'occlusion')")
    page.value(f"{choose}('track', 'retrieval')")
    assert page.value(SHOWN) == ["occlusion"]
    assert page.value("document.querySelector('output').textContent") == "1 of 4 tables shown"
    page.value(f"{choose}('prior', 'rnone-unknown-s15')")
    assert page.value(SHOWN) == []
    page.value("location.hash = document.querySelector('section.group h3').id")
    until(page, f"{SHOWN}.length === 4")


def test_what_is_filtered_and_sorted_stands_in_the_address_and_is_shown_again_from_it(page, site):
    page.open(address(site))
    page.value(
        "((one) => { one.value = 'occlusion'; one.dispatchEvent(new Event('change', {bubbles: true})); })"
        "(document.querySelector('select[name=suite]'))"
    )
    page.value("document.querySelector('section.group:not([hidden]) thead button').click()")
    linked = page.value("location.href")
    names = page.value(NAMES)
    page.open(address(site))
    assert page.value(SHOWN) != ["occlusion", "occlusion"]
    page.open(linked)
    assert page.value(SHOWN) == ["occlusion", "occlusion"]
    assert page.value(NAMES) == names
    page.open(f"{address(site)}?suite=%3Cscript%3E&sort=no-table!5!ascending&sort=x")
    assert page.faults == []
    assert page.value(SHOWN) == ["occlusion", "occlusion", "real-age", "real-age"]


def test_lines_of_rejectors_are_filtered_by_matcher_and_the_address_keeps_it(page, site):
    page.open(address(site, "rejection.html"))
    names = "[...document.querySelectorAll('tbody tr:not([hidden]) th')].map((one) => one.textContent)"
    assert page.value(names) == ["graph", "raster"] * 3  # what is answered at a risk, by suite, and all metrics
    page.value(
        "((one) => { one.value = 'raster'; one.dispatchEvent(new Event('change', {bubbles: true})); })"
        "(document.querySelector('select[name=matcher]'))"
    )
    assert page.value(names) == ["raster"] * 3
    assert page.value("document.querySelector('output').textContent") == "3 of 6 lines shown"
    page.open(page.value("location.href"))
    assert page.value(names) == ["raster"] * 3


def test_ties_are_told_beside_the_ranks_and_below_the_table(page, site):
    page.open(address(site))
    rows = page.value(
        "[...document.querySelectorAll('section.group')[0].querySelectorAll('tr.tied')].map((one) => one.innerText)"
    )
    assert len(rows) == 2
    assert all("1-2" in row and "tie" in row for row in rows)
    notes = page.value(
        "[...document.querySelectorAll('section.group')[0].querySelectorAll('.note')].map((one) => one.innerText)"
    )
    assert "Tied: graph, raster share ranks 1 to 2." in notes


def test_the_keyboard_alone_reads_sorts_and_turns(page, site):
    page.open(address(site))
    page.press("Tab")
    assert page.value("document.activeElement.className") == "skip"
    page.press("Enter")
    until(page, "document.activeElement.id === 'main'")
    for _ in range(200):
        page.press("Tab")
        if page.value("document.activeElement.textContent") == "success_25m":
            break
    assert page.value("getComputedStyle(document.activeElement.nextElementSibling).visibility") == "visible"
    assert page.value(
        "document.activeElement.getAttribute('aria-describedby') === document.activeElement.nextElementSibling.id"
    )
    page.press("Escape")
    assert page.value("getComputedStyle(document.activeElement.nextElementSibling).visibility") == "hidden"
    page.press("Enter")
    until(page, "document.activeElement.closest('th').getAttribute('aria-sort') === 'ascending'")


@pytest.mark.parametrize("width", rest_slow([WIDE, 390]))
def test_sentences_plot_and_table_are_on_the_first_screen(page, site, width):
    page.width(width, height=800)
    page.open(address(site))
    parts = "['.says', '.plot img', '.matrix tbody + tbody tr']"
    ends = page.value(f"{parts}.map((one) => document.querySelector(one).getBoundingClientRect().bottom)")
    assert max(ends) <= 800


def test_intervals_of_the_first_table_are_shown_on_request_without_a_script(page, site):
    page.scripts(are_on=False)
    page.open(address(site))
    shown = "getComputedStyle(document.querySelector('.matrix td .ends')).display"
    assert page.value(shown) == "none"
    page.value("document.querySelector('.with-ends').click()")
    assert page.value(shown) == "block"


def test_a_word_of_the_trade_is_explained_where_it_has_the_focus(page, site):
    page.open(address(site))
    page.value("document.querySelector('.term').focus()")
    assert page.value("getComputedStyle(document.querySelector('.term + .tip')).visibility") == "visible"
    assert page.value("document.documentElement.scrollWidth") <= WIDE


def test_a_tip_is_shown_whole_under_the_pointer(page, site):
    page.open(address(site))
    page.hover("section.group thead th:nth-child(3) button")
    tip = "document.querySelector('section.group thead th:nth-child(3) .tip')"
    until(page, f"getComputedStyle({tip}).visibility === 'visible'")
    box = page.value(
        f"(() => {{ const box = {tip}.getBoundingClientRect(); return [box.left, box.right, box.top, innerWidth]; }})()"
    )
    assert 0 <= box[0] < box[1] <= box[3]
    # Nothing lies over it, and no box that scrolls cuts it off.
    assert page.value(
        f"(() => {{ const box = {tip}.getBoundingClientRect();"
        f" return {tip}.contains(document.elementFromPoint(box.left + 12, box.top + 8)); }})()"
    )


def test_a_shadow_shows_where_a_narrow_table_goes_on_and_keys_scroll_it(page, site, tmp_path):
    page.width(320)
    page.open(address(site))
    box = "document.querySelector('.tablebox')"
    page.value(f"{box}.focus()")
    assert page.value(f"{box}.scrollWidth > {box}.clientWidth && document.activeElement === {box}")

    def edges(name):
        """Mean brightness of a strip at the left and at the right edge of the table, inside its outline."""
        page.shoot(tmp_path / name)
        at = f"{box}.getBoundingClientRect()"
        sides = f"[{at}.left, {at}.right, {at}.top + scrollY, {at}.bottom + scrollY]"
        left, right, top, bottom = map(round, page.value(sides))
        pixels = cv2.imread(str(tmp_path / name), cv2.IMREAD_GRAYSCALE)[top:bottom]
        return pixels[:, left : left + 6].mean(), pixels[:, right - 6 : right].mean()

    left, right = edges("begin.png")
    page.press("ArrowRight")
    until(page, f"{box}.scrollLeft > 0")
    page.value(f"{box}.scrollLeft = 9999")
    left_then, right_then = edges("end.png")
    assert left_then < left - 10
    assert right < right_then - 10


def test_failures_turn_by_key_and_by_link(page, site):
    page.open(address(site, "failures.html"))
    shown = "[...document.querySelectorAll('article.case:not([hidden])')].map((one) => one.id)"
    assert page.value(shown) == ["case-1"]
    page.press("ArrowRight")
    until(page, f"{shown}[0] === 'case-2'")
    assert page.value("document.activeElement.id") == "case-2"
    page.value("document.querySelector('#case-2 a[rel=next]').click()")
    until(page, f"{shown}[0] === 'case-3'")
    page.press("ArrowRight")  # the last one stays
    page.press("ArrowLeft")
    until(page, f"{shown}[0] === 'case-2'")
    assert page.value(
        "[...document.querySelectorAll('main > section:not([hidden]) h2')].map((one) => one.textContent)"
    ) == ["aliased"]


def test_failures_are_filtered_and_turn_among_those_left(page, site):
    page.open(f"{address(site, 'failures.html')}?class=aliased")
    shown = "[...document.querySelectorAll('article.case:not([hidden])')].map((one) => one.id)"
    assert page.value("document.querySelector('output').textContent") == "2 of 3 cases shown"
    page.press("ArrowRight")
    until(page, f"{shown}[0] === 'case-2'")
    page.press("ArrowRight")  # the third is of another class
    assert page.value(shown) == ["case-2"]
    assert page.value("document.querySelector('#case-2 a[rel=next]').hidden")
    page.value("location.hash = 'case-3'")  # a link to what is filtered away shows it all the same
    until(page, f"{shown}[0] === 'case-3'")
    assert page.value("document.querySelector('output').textContent") == "3 of 3 cases shown"


def test_without_scripts_everything_can_be_read_and_nothing_pretends_to_work(page, site):
    page.scripts(are_on=False)
    page.open(address(site))
    # The protocol still evaluates; the page's own script has not run.
    assert page.value("document.documentElement.className") == ""
    assert page.value("getComputedStyle(document.querySelector('form.filter')).display") == "none"
    assert page.value("document.querySelectorAll('section.group').length") == 4
    page.open(address(site, "failures.html"))
    assert page.value("[...document.querySelectorAll('article.case')].every((one) => one.offsetHeight > 0)")
    page.scripts(are_on=True)


TOLD = "document.getElementById('told').textContent"


def test_the_map_turns_through_the_queries_and_the_address_keeps_which(page, site):
    page.open(address(site, "map.html") + "?outcome=&matcher=raster")
    until(page, f"{TOLD} === '1 of 3 queries'")
    assert page.value("document.getElementById('which').textContent") == "as it should be"
    assert page.value("document.querySelectorAll('#map path.leaflet-interactive').length") >= 3
    page.value("document.getElementById('next').focus(), 0")
    page.press("Enter")
    until(page, f"{TOLD} === '2 of 3 queries'")
    assert page.value("document.getElementById('which').textContent") == "aliased"
    assert "300.0 m from where the view was taken" in page.value("document.getElementById('facts').textContent")
    assert page.value("document.querySelectorAll('.crop').length") == 3  # the place, the answer, a rival's
    assert page.value("location.search") == "?place=vaduz&matcher=raster&outcome=&query=q1"
    page.reload()
    until(page, f"{TOLD} === '2 of 3 queries'")
    page.value("(document.getElementById('next').click(), 0)")
    assert page.value("document.getElementById('which').textContent") == "unknown"  # a class of another version
    facts = page.value("document.getElementById('facts').textContent")
    assert "Answernone" in facts
    assert "the right answer is none" in facts
    assert page.faults == []


def test_the_map_begins_with_all_queries_where_none_failed(page, site, tmp_path):
    page.open(address(site, "map.html") + "?matcher=graph")
    until(page, f"{TOLD}.endsWith('queries')")
    assert page.value("document.getElementById('choice').elements.outcome.value") == "failures"
    copied = shutil.copytree(site, tmp_path / "copy")
    script = copied / "maps" / "vaduz-0.js"
    held = script.read_text(encoding="utf-8")
    script.write_text(re.sub(r"\[(\d+), ?-?\d+", r"[\1,0", held), encoding="utf-8")  # all as it should be
    page.open(address(copied, "map.html") + "?matcher=graph")
    until(page, f"{TOLD}.endsWith('queries')")
    assert page.value("document.getElementById('choice').elements.outcome.value") == ""
    page.open(address(copied, "map.html") + "?matcher=graph&outcome=failures")  # unless these are asked for
    until(page, f"{TOLD} === 'no such query here'")


def test_a_map_that_is_lost_is_told(page, site, tmp_path):
    less = shutil.copytree(site, tmp_path / "less")
    for path in (less / "maps").iterdir():
        path.unlink()
    page.open(address(less, "map.html"))
    until(page, f"{TOLD}.startsWith('The map')")
    assert page.value(TOLD) == "The map of this place cannot be loaded (maps/vaduz-0.js)."


def test_names_with_markup_on_the_map_are_text(page, site):
    page.open(address(site, "map.html") + f"?outcome=1&matcher={quote(HOSTILE)}")
    until(page, f"{TOLD} === '1 of 1 queries'")
    assert page.value("document.getElementById('choice').elements.matcher.value") == HOSTILE
    assert "__proto__" in page.value("document.getElementById('facts').textContent")
    assert page.value("document.querySelectorAll('main img:not(.leaflet-image-layer), main b b').length") == 0
    assert page.faults == []


def test_names_with_markup_are_text_in_the_browser_too(page, site):
    page.open(address(site))
    assert HOSTILE in page.value(NAMES)
    assert page.value("document.scripts.length") == 1
    page.open(address(site, "matcher-script-alert-1-script.html"))
    assert HOSTILE in page.value("document.querySelector('h1').innerText")
    assert MARKUP in page.value("document.querySelector('dl').innerText")
    assert page.value("document.images.length") == 0


FINDINGS = """
axe.run(document, {resultTypes: ["violations"]}).then((found) => found.violations.map((one) =>
  `${one.id} (${one.impact}): ${one.nodes[0].html}`))
"""


@pytest.mark.parametrize(
    ("scheme", "width"),
    [("light", WIDE), *(pytest.param(*one, marks=pytest.mark.slow) for one in (("dark", WIDE), ("light", 390)))],
)
def test_axe_finds_no_barrier_on_any_page(page, site, scheme, width):
    page.prefer(scheme)
    page.width(width)
    for path in sorted(site.glob("*.html")):
        page.open(address(site, path.name))
        page.value(f"{AXE}; 0")
        assert page.settled(FINDINGS) == [], path.name
    ground = "rgb(255, 255, 255)" if scheme == "light" else "rgb(21, 24, 28)"
    assert page.value("getComputedStyle(document.body).backgroundColor") == ground


def test_axe_finds_what_is_hard_to_read(page, site):
    page.open(address(site))
    page.value(f"{AXE}; document.querySelector('h1').style.color = '#e8e8e8'; 0")
    assert [text.partition(" ")[0] for text in page.settled(FINDINGS)] == ["color-contrast"]


@pytest.fixture
def host(site):
    """Address of the site on a plain host, under a sub-path."""

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=site.parents[1]))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/{quote(site.relative_to(site.parents[1]).as_posix())}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_on_a_host_under_a_sub_path_pages_open_and_files_are_downloaded_whole(page, site, host, tmp_path):
    page.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.open(f"{host}/index.html")
    assert page.faults == []
    assert all(url.startswith((f"{host}/", "data:,")) for url in page.asked), page.asked
    names = ("leaderboard.parquet", "leaderboard.csv", "leaderboard.tex")
    for name in names:
        selector = f'a[href="files/{name}"]'
        page.value(f"document.querySelector({json.dumps(selector)}).click()")
        want = (site / "files" / name).read_bytes()
        end = time.monotonic() + PATIENCE_S
        while not (tmp_path / name).is_file() or (tmp_path / name).read_bytes() != want:
            assert time.monotonic() < end, name
            time.sleep(0.05)
    assert {path.name for path in tmp_path.iterdir()} == set(names)
