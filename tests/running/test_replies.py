# SPDX-License-Identifier: Apache-2.0
"""Whatever a matcher's process sends is a reply or one line that says why it is none; never anything else."""

import json
import math
import socket
import threading
import time
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sasgeo_bench.core.errors import MatchError
from sasgeo_bench.core.texts import MOST_MESSAGE
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.matcher import Match, Prediction, check_match
from sasgeo_bench.matching.tracker import ROW as ANSWER_ROW
from sasgeo_bench.running import wire
from sasgeo_bench.running.worker import Limits, Reach, Worker
from sasgeo_bench.tasks.query import Head

CARD = {
    **dict.fromkeys(("name", "version", "title", "source", "ours", "licence"), "mine"),
    "tracks": ["localization"],
    "needs": [],
    "limits": "",
    "trained_on": [],
    "uses": [],
    "authors": [],
    "contact": "",
    "code": "",
}
SOUND = {
    "load": {"status": "ok", "card": CARD, "learns": False},
    "learn": {"status": "ok", "seconds": 1.0},
    "prepare": {"status": "ok", "seconds": 1.0, "grown_bytes": 5},
    "match": {"status": "ok", "seconds": 0.5, "cpu_s": 0.25},
}
POSE = {"easting_m": 1, "northing_m": 2.0, "yaw_deg": 3.0, "scale": 1.0}
ROW = {"query_id": "a", "candidates": [[POSE, 7.0]], "confidence": None, "diagnostics": {"margin": 1.0}}
KINDS = tuple(SOUND)


def put(channel, data):
    with suppress(OSError):  # nobody reads what is too long
        channel.sendall(data)


def received(text, kind="match", data=None, length=None):
    """What comes of the bytes of a message, as a runner reads them."""
    ours, theirs = socket.socketpair()
    with theirs, ours:
        threading.Thread(target=put, args=(theirs, (length or len(text)).to_bytes(4, "big") + bytes(4) + text)).start()
        result, _ = wire.receive(ours, deadline=time.monotonic() + 60, most_bytes=wire.MOST_BYTES)
    data = data if data is not None else json.dumps(ROW).encode() if kind == "match" else b"text"
    return Worker(spec="", reach=Reach(readable=[], hidden=[]), limits=Limits())._read(kind, result, data, nonce="7")


def sound(kind, **changes):
    return json.dumps({**SOUND[kind], "nonce": "7", **changes}).encode()


def test_who_goes_without_an_answer_is_told_apart_from_who_sends_too_much():
    ours, theirs = socket.socketpair()
    with ours:
        theirs.close()
        with pytest.raises(wire.Closed, match="closed its connection to the runner without an answer"):
            wire.receive(ours)
    with pytest.raises(wire.TooLong, match="an answer of 2147483647 bytes, at most"):
        received(b"x" * 10, length=2**31 - 1)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sound_answer_is_read(kind):
    reply = received(sound(kind), kind)
    assert reply.status == "ok"
    assert reply.seconds is None, "the runner's clock alone says how long it took"
    failed = received(json.dumps({"nonce": "7", "status": "refused", "message": "why"}).encode(), kind)
    assert (failed.status, failed.message) == ("refused", "why")


@pytest.mark.parametrize("data", [b"", b"\xff", b"x" * (2**20 + 1)])
def test_a_learned_text_that_cannot_be_stored_is_one_line(data):
    worker = Worker(spec="", reach=Reach(readable=[], hidden=[]), limits=Limits())
    with pytest.raises(MatchError) as refused:
        worker._read("learn", {"nonce": "7", "status": "ok", "seconds": 1.0}, data, nonce="7")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("change", [{"seconds": None, "learns": True}, {"cpu_s": 0.1, "grown_bytes": 1}])
def test_an_answer_to_another_question_is_refused(kind, change):
    with pytest.raises(MatchError, match="is missing, or no part of an answer to"):
        received(sound(kind, **change), kind)


def row(**changes):
    return {"query_id": "a", **changes}


def at(place=0, score=1, **changes):
    return [{"easting_m": place, "northing_m": 0, "yaw_deg": 0, "scale": 1, **changes}, score]


def test_the_least_that_a_row_says_is_that_the_answer_was_withheld():
    assert received(sound("match"), data=b'{"query_id": "a"}').found == Prediction(query_id="a")


@pytest.mark.parametrize(
    "data",
    [
        *(row(candidates=[one]) for one in (at(1e300), at(scale=0), at(yaw_deg=1e300), at(score=1e300), at(10**400))),
        *(row(candidates=[one]) for one in (at(place=True), at("1"), [*at(), 1], None)),
        row(candidates=[at()] * 1001),
        '{"query_id": "a", "candidates": ' + "[" * 100_000 + "]" * 100_000 + "}",
        '{"query_id": "a", "confidence": NaN}',
        row(confidence=1.5),
        '{"query_id": "a", "diagnostics": {"\\ud800": 1}}',
        *(row(diagnostics=one) for one in ({"": 1}, {"x" * 65: 1}, {str(at): 1 for at in range(65)}, {"a": "b"})),
        *(row(covariance=one) for one in ([1.0] * 8, [1.0] * 9, [1e300] * 9)),
        row(more=1),
        *({}, [], ""),
    ],
    ids=lambda data: ascii(data)[-60:],
)
def test_a_row_that_is_none_is_one_line(data):
    with pytest.raises(MatchError) as refused:
        received(sound("match"), data=(data if isinstance(data, str) else json.dumps(data)).encode())
    check_line(str(refused.value))


@pytest.mark.parametrize(
    "text",
    [
        sound("match", seconds=float("inf")),
        sound("match", seconds=-1),
        sound("match", seconds=1e9),
        sound("match").replace(b'"cpu_s"', b'"seconds": 0.1, "cpu_s"'),
        sound("match", more=0.1),
        sound("match", nonce="8"),
        sound("match", status="timeout"),
        b"",
        b'{"nonce": "7", "status": "crash", "message": "\\ud800"}',
        json.dumps({"nonce": "7", "status": "crash", "message": "x" * (MOST_MESSAGE + 1)}).encode(),
    ],
    ids=lambda text: ascii(text)[-60:],
)
def test_what_is_no_answer_is_one_line(text):
    with pytest.raises((MatchError, wire.Garbled)) as refused:
        received(text)
    check_line(str(refused.value))


@pytest.mark.parametrize(
    "card",
    [
        *([], {}, {**CARD, "more": 1}),
        *({**CARD, "name": value} for value in (None, "", "\ud800", "x" * 5000, "two\nlines")),
        *({**CARD, "tracks": value} for value in ("localization", [], ["other"])),
        *({**CARD, "trained_on": value} for value in ("munich", ["a"] * 1001)),
        *({**CARD, "uses": value} for value in ("imagery", [1], {"a": "b"})),
    ],
    ids=lambda card: ascii(card)[-40:],
)
def test_a_card_that_is_none_is_one_line(card):
    with pytest.raises(MatchError) as refused:
        received(sound("load", card=card), "load")
    assert "\n" not in str(refused.value)


def test_a_card_with_a_field_twice_and_a_message_that_is_too_long_are_refused_before_they_are_looked_at():
    with pytest.raises(wire.Garbled, match="a name is there twice"):
        received(sound("load").replace(b'"title"', b'"name": "other", "title"'), "load")
    with pytest.raises(wire.Closed, match="an answer of 2000050 bytes, at most 1048576 are read"):
        received(json.dumps({"nonce": "7", "status": "crash", "message": "x" * 2_000_000}).encode()[:-2] + b"xxxx")


# Any JSON, and JSON that is nearly an answer: one value of a sound one is replaced by whatever there is.
texts = st.text(st.characters(), max_size=8)  # with halves of pairs of surrogates
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | texts | st.just(10**400),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=12,
)


def paths(value):
    yield ()
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from ((key, *path) for path in paths(inner))


def replaced(value, path, new):
    if not path:
        return new
    copied = value.copy()
    copied[path[0]] = replaced(value[path[0]], path[1:], new)
    return copied


def check_line(text):
    assert "\n" not in text
    assert len(text) <= MOST_MESSAGE


@st.composite
def nearly_a_row(draw):
    return replaced(ROW, draw(st.sampled_from(list(paths(ROW)))), draw(values))


@st.composite
def nearly(draw):
    kind = draw(st.sampled_from(KINDS))
    path = draw(st.sampled_from(list(paths(SOUND[kind]))))
    changed = replaced(SOUND[kind], path, draw(values))
    return kind, {**changed, "nonce": "7"} if isinstance(changed, dict) else changed


@given(nearly(), nearly_a_row())
def test_any_json_is_a_reply_or_one_line(case, row):
    kind, result = case
    try:
        data = json.dumps(row).encode() if kind == "match" else None
        reply = received(json.dumps(result).encode(), kind, data=data)
    except (MatchError, wire.Garbled) as refused:
        check_line(str(refused))
        return
    assert reply.status in {"ok", "crash", "invalid", "refused"}
    assert reply.message.isprintable()
    for found in [reply.found] if reply.found is not None else []:
        assert all(abs(pose.easting_m) <= 1e8 for pose, _ in found.candidates)
        assert all(name.isprintable() for name in found.diagnostics)


@given(st.lists(st.floats(-1e8, 1e8), min_size=5, max_size=5))
def test_numbers_come_as_they_were_sent(numbers):
    x, y, yaw, score, margin = numbers
    pose = Pose(easting_m=x, northing_m=y, yaw_deg=yaw % 360)
    sent = Prediction(query_id="a", candidates=((pose, score),), diagnostics={"margin": margin})
    found = received(sound("match"), data=ANSWER_ROW.dump_json(sent)).found
    assert found == sent
    assert math.copysign(1, found.candidates[0][1]) == math.copysign(1, score)


@given(st.binary(max_size=60))
def test_any_bytes_are_refused_in_one_line(data):
    with pytest.raises((MatchError, wire.Garbled)):
        received(data)


# --- the same bounds in the matcher's own process ---------------------------------------------------------------------

HEAD = Head(
    **dict.fromkeys(("query_id", "suite", "part", "region"), "a"),
    track="localization",
    suite_version=1,
    view_cells=64,
    cell_size_m=1.0,
    prior_group="none",
    candidates=(),
)
HERE = Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0)


class Endless:
    """Is longer than it says."""

    def __len__(self):
        return 1

    def __iter__(self):
        while True:
            yield 1.0


class Unsteady(dict):
    """Gives a name twice."""

    def items(self):
        return [("a", 1.0), ("a", 2.0)]


@pytest.mark.parametrize(
    ("match", "words"),
    [
        (Match(poses=[Pose(easting_m=1e300, northing_m=0.0, yaw_deg=0.0)], scores=[1.0]), "easting_m is 1e.300"),
        (Match(poses=[Pose(easting_m=0.0, northing_m=0.0, yaw_deg=0.0, scale=1e9)], scores=[1.0]), "scale is 1e.09"),
        (Match(poses=[HERE], scores=[1e300]), r"score is 1e.300, expected a finite number within -3\.4"),
        (Match(poses=[HERE], scores=Endless()), "1001 scores for 1 poses"),
        (Match(poses=Endless(), scores=[1.0]), "a pose is a float"),
        (Match(poses=[HERE], scores=[10**400]), r"score is too large, expected a number within -3\.4"),
        (Match(poses=[3], scores=[1.0]), "a pose is an int, expected"),
        (Match(poses=None, scores=()), "poses is a NoneType, expected a sequence"),
        (Match(poses=(), scores=None), "scores is a NoneType, expected a sequence"),
        (Match(poses=(), scores=(), diagnostics={"\ud800": 1.0}), "the name .*expected 1..64 printable characters"),
        (Match(poses=(), scores=(), diagnostics={"x" * 65: 1.0}), "expected 1..64 printable characters"),
        (Match(poses=(), scores=(), diagnostics={1: 1.0, "1": 2.0}), "2 entries under 1 names"),
        (Match(poses=(), scores=(), diagnostics=Unsteady(a=1, b=2)), "2 entries under 1 names"),
        (Match(poses=(), scores=(), diagnostics={"a": 1e300}), r"diagnostics\['a'\] is 1e.300"),
    ],
)
def test_a_matchers_own_process_keeps_to_the_same_bounds(match, words):
    with pytest.raises(MatchError, match=words):
        check_match(match, HEAD, top_k=5)
