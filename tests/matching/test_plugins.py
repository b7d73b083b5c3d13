# SPDX-License-Identifier: Apache-2.0
"""Plugins are found by name or by module:Class; a clash is told, and whatever is wrong with one fits in a line."""

import importlib
import sys
import warnings
from importlib.metadata import distribution

import pytest

from sasgeo_bench.core import plugins
from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.plugins import (
    MATCHERS,
    SHIPPED,
    check_card_name,
    check_names,
    find_module,
    home_of,
    list_entry_points,
)
from sasgeo_bench.matching.matcher import MatcherCard
from sasgeo_bench.matching.plugins import load_matcher
from sasgeo_bench.matching.submission import example_card

SOUND = """
from sasgeo_bench.matching.matcher import WITHHELD, MatcherCard

SAID = {"version": "1", "title": "T", "source": "original", "ours": "all", "licence": "MIT"}


class Sound:
    card = MatcherCard(name="sound", tracks=("localization",), **SAID)

    def prepare(self, region, learned):
        pass

    def match(self, query, *, top_k):
        return WITHHELD
"""
FAULTY = f"""{SOUND}

class Raises(Sound):
    def __init__(self):
        raise RuntimeError("no weights here:\\n  fetch them first")


class WantsMore(Sound):
    def __init__(self, weights):
        self.weights = weights


class Leaves(Sound):
    def __init__(self):
        raise SystemExit(0)


class CannotTell(Sound):
    def __init__(self):
        class Mute(Exception):
            def __str__(self):
                raise RuntimeError

        raise Mute


class CardRaises(Sound):
    @property
    def card(self):
        raise SystemExit(0)


class NoVerbs:
    card = Sound.card


class NoMatch:
    card = Sound.card
    prepare = Sound.prepare


class MatchIsNoVerb(Sound):
    match = "here"


class NoCard:
    prepare = Sound.prepare
    match = Sound.match


class CardIsADict(Sound):
    card = {{"name": "sound"}}


class NoLicence(Sound):
    def __init__(self):
        self.card = MatcherCard(name="mine", tracks=("localization",), **(SAID | {{"licence": ""}}))


a_number = 3
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Put a distribution with entry points and modules on the import path, in front of all others.

    With a name of ours it is installed as they are, unless it is but called so (`is_installed`).
    """
    modules, bases = set(sys.modules), plugins._bases()

    def put(name: str, points: dict[str, str], *, is_installed: bool = True, **sources: str) -> None:
        folder = tmp_path / name
        if name in SHIPPED and is_installed:
            monkeypatch.setattr(plugins, "_bases", lambda: (*bases, folder))
        about = folder / f"{name.replace('-', '_')}-1.0.dist-info"
        about.mkdir(parents=True)
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [f"[{MATCHERS}]", *(f"{point} = {value}" for point, value in points.items())]
        (about / "entry_points.txt").write_text("\n".join(lines) + "\n")
        for module, text in sources.items():
            (folder / f"{module}.py").write_text(text)
        monkeypatch.syspath_prepend(str(folder))
        assert distribution(name).metadata["Name"] == name

    yield put
    for module in set(sys.modules) - modules:
        del sys.modules[module]
    importlib.invalidate_caches()


@pytest.fixture
def own(install):
    """A package of faulty matchers, in module `mine`; the baselines, whatever is installed, are one sound matcher."""
    install(SHIPPED[1], {"raster_uniform": "built_in:Sound"}, built_in=SOUND)
    return lambda **points: install("x-own", points, mine=FAULTY)


def refusal(spec: str) -> str:
    """The one line that a matcher is refused with."""
    with pytest.raises(MatchError) as refused:
        load_matcher(spec)
    text = str(refused.value)
    assert "\n" not in text
    return text


# --- by name --------------------------------------------------------------------------------------------------------


def test_a_matcher_is_made_by_its_name_and_listed_with_where_it_comes_from(own) -> None:
    own(sound="mine:Sound", another="mine:Sound")
    made = load_matcher("sound")
    assert (type(made).__module__, type(made).__name__) == ("mine", "Sound")
    assert isinstance(made.card, MatcherCard)
    points = list_entry_points()
    assert {"sound": "x-own", "another": "x-own", "raster_uniform": SHIPPED[1]}.items() <= {
        name: point.dist.name for name, point in points.items()
    }.items()
    assert list(points) == sorted(points)


def test_a_card_that_is_not_named_as_its_entry_point_is_refused(own) -> None:
    """Else its rows stand under a name that no command knows."""
    own(another="mine:Sound")
    fault = refusal("another")
    assert fault.startswith("another: its card is named 'sound', and rows are found by one name: give the entry point")


def test_a_fault_of_a_card_is_told_with_file_key_and_mend(own, install, tmp_path) -> None:
    own()
    text = "from sasgeo_bench import read_card\nclass Carded:\n    card = read_card(__file__)\n"
    install("a-carded", {"carded": "carded:Carded"}, carded=text)
    path = tmp_path / "a-carded" / "card.toml"
    path.write_text(example_card("carded").replace("licence", "license"), encoding="utf-8")
    for spec in ("carded", "carded:Carded"):
        fault = refusal(spec)
        assert fault.startswith(f"{spec}: {path}: unknown key 'license', did you mean 'licence'?; 'licence' is missing")
        assert fault.endswith(": correct it there (submit --example-card prints a sound one)")
    path.write_text(example_card("carded").replace("tracks =", "# tracks ="), encoding="utf-8")
    assert refusal("carded") == f"carded: {path}: tracks is empty, name retrieval, localization or both"


@pytest.mark.parametrize("ours", SHIPPED)
def test_of_two_with_one_name_the_built_in_one_wins_and_both_are_named(install, ours) -> None:
    # By name alone the outsider would come first, by the place on the import path too.
    install(ours, {"sound": "built_in:Sound"}, built_in=SOUND)
    install("an-outsider", {"sound": "outside:Sound"}, outside=SOUND)
    with pytest.warns(UserWarning, match="two plugins are named 'sound'") as caught:
        points = list_entry_points()
    assert points["sound"].value == "built_in:Sound"
    (message,) = (str(item.message) for item in caught)
    assert f"{ours} is used, an-outsider (outside:Sound) is not" in message
    with pytest.warns(UserWarning, match="two plugins"):
        assert type(load_matcher("sound")).__module__ == "built_in"


@pytest.mark.parametrize("ours", [*SHIPPED, "Sasgeo_Bench"])
def test_who_only_calls_himself_as_we_are_called_takes_no_name_of_ours(install, ours) -> None:
    install(ours, {"random": "built_in:Sound", "mine": "built_in:Sound"}, is_installed=False, built_in=SOUND)
    with pytest.warns(UserWarning, match="two plugins are named 'random'"):
        points = list_entry_points()
    assert points["random"].value == "sasgeo_bench.matching.controls.blind:RandomPlaces"
    assert points["raster_uniform"].module == "sasgeo_baselines.raster"
    with pytest.raises(MatchError, match="as a matcher that ships: rename it"):
        check_card_name("mine", "random")


def test_a_folder_named_as_our_package_takes_no_name_of_ours(tmp_path, monkeypatch) -> None:
    fake = tmp_path / "sasgeo_baselines"
    fake.mkdir()
    (fake / "__init__.py").write_text("")
    (fake / "raster.py").write_text(SOUND.replace("Sound", "RasterUniform"))
    monkeypatch.chdir(tmp_path)  # for a registered name the working folder comes last
    check_names(matchers=["raster_uniform"])
    with pytest.raises(
        MatchError, match=r"^sasgeo_baselines\.raster:RasterUniform: its card is named 'raster_uniform'"
    ):
        check_card_name("sasgeo_baselines.raster:RasterUniform", "raster_uniform")
    monkeypatch.syspath_prepend(str(tmp_path))
    words = (
        r"^raster_uniform: sasgeo_baselines\.raster would be imported from .*, and not from where sasgeo-baselines is"
    )
    with pytest.raises(MatchError, match=words) as refused:
        check_names(matchers=["raster_uniform"])
    assert str(refused.value).endswith("take that folder off PYTHONPATH")
    check_names(matchers=["random"])


def test_modules_are_found_as_python_would_and_nothing_of_them_runs(tmp_path) -> None:
    for name in ("whole/__init__.py", "whole/deep/__init__.py", "whole/deep/code.py", "bare/inner/code.py", "one.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("raise SystemExit")
    paths = [str(tmp_path)]
    places = {"whole.deep.code": "whole", "bare.inner.code": "bare/inner/code.py", "one": "one.py"}
    for name, place in places.items():
        assert home_of(name, paths).path == tmp_path / place
    for name in ("one.inner", "whole.none", "none", "", ".", "..a", "whole..deep", "a/b", "one\0"):
        assert find_module(name, paths) is None, name


@pytest.mark.parametrize("order", [("b-second", "a-first"), ("a-first", "b-second")])
def test_of_two_outsiders_with_one_name_neither_is_used_and_one_line_names_both(install, order) -> None:
    for name in order:
        module = name.replace("-", "_")
        install(name, {"mine": f"{module}:Sound"}, **{module: SOUND})
    install("x-own", {"sound": "other:Sound"}, other=SOUND)
    words = "two plugins are named 'mine': a-first (a_first:Sound) and b-second (b_second:Sound), so neither is used"
    warnings.simplefilter("ignore")
    assert refusal("mine").startswith(words)
    with pytest.raises(MatchError, match="two plugins are named 'mine'"):
        check_names(matchers=["mine"])
    assert type(load_matcher("sound")).__module__ == "other"  # which costs nobody else
    assert type(load_matcher("b_second:Sound")).__module__ == "b_second"


@pytest.mark.parametrize("name", ["fft_vote", "oracle_pose", "sasgeo"])
def test_a_matcher_of_others_whose_card_bears_a_shipped_name_is_refused(name) -> None:
    for spec in ("mine:Matcher", "sasgeo_bench_mine:Matcher", "mine"):
        with pytest.raises(
            MatchError, match=f"^{spec}: its card is named '{name}', as a matcher that ships: rename it$"
        ):
            check_card_name(spec, name)
    check_card_name("mine:Matcher", "mine")
    check_card_name("sasgeo_bench.matching.controls.fft_vote:FftVote", "fft_vote")
    check_card_name("fft_vote", "fft_vote")


def test_the_name_of_an_oracle_is_kept_for_those_that_a_pipeline_names() -> None:
    with pytest.raises(MatchError, match=r"^mine:Matcher: its card is named 'oracle_mine', and names that begin with "):
        check_card_name("mine:Matcher", "oracle_mine")
    check_card_name("mine:Matcher", "oracle_mine", is_oracle=True)
    check_card_name("sasgeo_baselines.ablations:Oracle", "oracle_sasgeo")
    with pytest.raises(MatchError, match="as a matcher that ships"):
        check_card_name("mine:Matcher", "oracle_pose", is_oracle=True)


def test_one_matcher_that_two_packages_name_alike_is_no_clash(install) -> None:
    install("a-first", {"mine": "shared:Sound"}, shared=SOUND)
    install("b-second", {"mine": "shared:Sound"})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list_entry_points()["mine"].dist.name == "a-first"


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("no_such_module:Sound", "cannot be imported (ModuleNotFoundError: No module named 'no_such_module')"),
        ("mine:NoSuchClass", "cannot be imported (AttributeError: module 'mine' has no attribute 'NoSuchClass')"),
        ("broken:Sound", "cannot be imported (SyntaxError: "),
        ("raises:Sound", "cannot be imported (OSError: weights.bin is missing)"),
        ("this is : no value!", "cannot be imported ("),
        ("mine", "cannot be made (TypeError: 'module' object is not callable)"),
        ("mine:a_number", "cannot be made (TypeError: 'int' object is not callable)"),
        ("mine:Raises", "cannot be made (RuntimeError: no weights here: fetch them first)"),
        ("leaves:Sound", "cannot be imported (SystemExit: 0)"),
        ("mine:Leaves", "cannot be made (SystemExit: 0)"),
        ("mine:CannotTell", "cannot be made (Mute)"),
        ("mine:CardRaises", "its card and verbs cannot be read (SystemExit: 0)"),
        ("mine:WantsMore", "cannot be made (TypeError: "),
        ("mine:NoVerbs", "NoVerbs is not a matcher, it has no prepare and no match"),
        ("mine:NoMatch", "NoMatch is not a matcher, it has no match"),
        ("mine:MatchIsNoVerb", "MatchIsNoVerb is not a matcher, it has no match"),
        ("mine:NoCard", "card is a NoneType, expected a sasgeo_bench.matching.matcher.MatcherCard"),
        ("mine:CardIsADict", "card is a dict, expected a sasgeo_bench.matching.matcher.MatcherCard"),
        ("mine:NoLicence", "wrong: card: licence is empty, say it in one line"),
    ],
)
def test_what_is_wrong_with_a_plugin_is_reported_in_one_line(own, install, value, words) -> None:
    own(wrong=value, sound="mine:Sound")
    install(
        "z-broken",
        {},
        broken="def (",
        raises='raise OSError("weights.bin is\\n missing")',
        leaves="raise SystemExit(0)",
    )
    message = refusal("wrong")
    assert message.startswith("wrong: ")
    assert words in message
    if "imported" in words:
        assert f"{value} of x-own" in message
    # One that is broken costs the others nothing.
    assert load_matcher("sound").card.name == "sound"
    assert "wrong" in list_entry_points()


def test_a_misspelt_name_gets_a_proposal_and_one_like_no_other_none(own) -> None:
    own()
    for name in ("rastr_uniform", "raster-uniform", "raster_uniforms"):
        message = refusal(name)
        assert f"there is no matcher {name!r}, did you mean 'raster_uniform'?" in message
        assert "list matchers" in message
    for name in ("", "something-else-altogether", "../x", "two\nlines"):
        message = refusal(name)
        assert f"there is no matcher {name!r}" in message
        assert "did you mean" not in message
        assert "module:Class" in message


# --- module:Class ---------------------------------------------------------------------------------------------------


def test_a_class_of_a_module_needs_no_entry_point(own) -> None:
    own()
    assert type(load_matcher("mine:Sound")).__name__ == "Sound"


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("mine.inner:Sound", "No module named 'mine.inner'"),
        ("mine:NoSuchClass", "module 'mine' has no attribute 'NoSuchClass'"),
        (":", "cannot be imported"),
        ("mine:", "module 'mine' has no attribute ''"),
        (":Sound", "cannot be imported"),
        ("mine:Sound:Sound", "cannot be imported"),
        ("mine:Sound.inner", "cannot be imported"),
        (".mine:Sound", "cannot be imported"),
        ("../mine:Sound", "cannot be imported"),
        ("mine.py:Sound", "cannot be imported"),
        ("json:dumps", "cannot be made"),
    ],
)
def test_what_is_wrong_with_a_module_or_a_class_is_reported_in_one_line(own, spec, words) -> None:
    own()
    message = refusal(spec)
    assert message.startswith(f"{spec}: ")
    assert words in message


@pytest.mark.parametrize("kind", ["matcher", "rejector"])
def test_names_are_checked_without_an_import(kind):
    check_names(**{f"{kind}s": ["no_such_module:Class"]})
    with pytest.raises(MatchError, match=f"there is no {kind} 'nobody'"):
        check_names(**{f"{kind}s": ["nobody"]})
