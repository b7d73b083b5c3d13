# SPDX-License-Identifier: Apache-2.0
"""A profile says what was measured: of answers, minute by minute, with what the sensors say where there are some."""

import base64
import hashlib
import json
import math
import os
import re
from dataclasses import replace

import pytest

from sasgeo_bench.boards.profile_page import FIGURE, PAGE, RECORD, facts, write_profile
from sasgeo_bench.core.errors import ConfigError, MatchError, StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.running import profiling, sensors
from sasgeo_bench.running.profiling import Fix, Profile, ProfileRequest, Reading, profile
from sasgeo_bench.running.sensors import EnergyMeter, hottest_celsius, processor_name
from sasgeo_bench.tasks.task_files import read_queries

BASE = {"matcher": "mine", "version": "2", "region": "vaduz", "km2": 16.0, "suites": ("clean",), "queries": 7}
MACHINE = {"processor": "X", "cores": 1, "cores_of_computer": 4, "memory_bytes": 2 * 10**9}
MACHINE |= {"memory_bytes_of_computer": 8 * 10**9, "load_before": 0.5}


def made_up(fixes, readings=(), **changes):
    costs = {"start_s": 0.5, "prepare_s": 1.5, "first_s": 0.25, "index_bytes": 10**7, "map_bytes": 3 * 10**6}
    costs |= {"peak_bytes": 2 * 10**8, "query_bytes": 37_204.5, "joules": None}
    return Profile(**{**BASE, **costs, "machine": MACHINE, "fixes": fixes, "readings": readings, **changes})


def fix(since_s, seconds, status="ok"):
    return Fix(since_s=since_s, seconds=seconds, cpu_s=seconds / 2, status=status)


@pytest.fixture
def slowing():
    """Two minutes; the second one is twice as slow and hotter, and one fix is no answer."""
    first = [fix(3.0 * at, 0.1) for at in range(20)]
    second = [fix(60.0 + 3.0 * at, 0.2) for at in range(20)]
    heat = [Reading(since_s=at, celsius=40.0 + at / 4, mhz=None) for at in (0.0, 58.0, 100.0)]
    return made_up((*first, fix(59.0, 30.0, "timeout"), *second), tuple(heat), joules=82.0)


def test_latencies_are_those_of_answers_and_each_minute_has_its_own(slowing):
    assert slowing.statuses == {"ok": 40, "timeout": 1}
    assert slowing.latency_s(0.5) == pytest.approx(0.15)
    assert slowing.latency_s(0.99) == pytest.approx(0.2)
    assert slowing.minutes() == [
        {"minute": 1, "fixes": 21, "p50_s": 0.1, "p95_s": 0.1, "celsius": 54.5},
        {"minute": 2, "fixes": 20, "p50_s": 0.2, "p95_s": 0.2, "celsius": 65.0},
    ]
    assert (
        slowing.thermal_note()
        == "the median of the last minute is 100% above that of the first; 40 to 65 degrees Celsius"
    )


def test_a_short_profile_without_sensors_says_so():
    short = made_up((fix(0.0, 0.1), fix(2.0, 0.1)))
    assert short.thermal_note() == "too short to tell whether it slows down; this computer has no sensor of heat"
    assert math.isnan(short.minutes()[0]["celsius"])
    assert math.isnan(made_up((fix(0.0, 1.0, "crash"),)).latency_s(0.5))


def test_the_facts_have_units_and_say_what_is_not_known(slowing):
    found = {name: (value, meaning) for name, value, meaning in facts(slowing)}
    assert found["latency p95"][0] == "200 ms"
    assert found["map prepared"][0] == "1.50 s"
    assert found["energy per fix"][0] == "2.00 J"
    assert found["map on disk"] == ("3.0 MB", "188 kB a km2")
    assert found["bytes per fix"][0] == "37,204"
    assert {name: value for name, value, _ in facts(replace(slowing, joules=None))}["energy per fix"] == "-"


@pytest.mark.usefixtures("in_threads")
@pytest.mark.parametrize("radius_m", [None, 1e6])
def test_a_matcher_is_asked_again_from_the_first(task, monkeypatch, radius_m):
    monkeypatch.setattr(profiling, "MOST_ASKED", 3)
    request = ProfileRequest(
        spec="hostile:Plain", tasks=(task,), out=task.parents[2], sustain_s=0.01, radius_m=radius_m
    )
    count = sum(radius_m is None or query.prior.radius_m is not None for query in read_queries(task))
    before, lines = os.sched_getaffinity(0), []
    with reporting(lines.append):
        found = profile(replace(request, radius_m=radius_m))
    assert os.sched_getaffinity(0) == before
    assert lines[-1] == f"plain: 3 queries, the first of {count}, on town-riverside, again and again for 0.01 s"
    assert len(found.fixes) >= profiling.LEAST_FIXES
    assert found.statuses == {"ok": len(found.fixes)}
    since_s = [each.since_s for each in found.fixes]
    assert since_s == sorted(since_s)
    assert 0 < found.latency_s(0.5) <= found.latency_s(0.99)
    assert found.map_bytes > 10_000
    assert found.query_bytes > 1_000
    assert found.machine["cores"] == 1
    assert (found.region, found.suites, found.km2) == (
        "town-riverside",
        ("false-unknown",),
        pytest.approx(1.0, abs=0.3),
    )


def test_its_own_process_has_the_cores_and_the_memory_of_the_request(task):
    request = ProfileRequest(spec="hostile:Plain", tasks=(task,), out=task.parents[2], sustain_s=0.01)
    found = profile(replace(request, memory_bytes=700 * 10**6))
    assert found.isolation["memory"].startswith("700 MB at most")
    assert 20e6 < found.peak_bytes < 700e6
    assert len(found.fixes) >= profiling.LEAST_FIXES
    assert found.start_s > 0


@pytest.mark.usefixtures("in_threads")
def test_who_answers_nothing_has_no_profile(task):
    request = ProfileRequest(spec="hostile:Raises", tasks=(task,), out=task.parents[2], sustain_s=60.0)
    with pytest.raises(MatchError, match=r"none of the first 20 fixes is an answer \(crash: ValueError: no idea"):
        profile(request)
    with pytest.raises(MatchError, match="cannot prepare town-riverside: crash: ValueError: no index today"):
        profile(replace(request, spec="hostile:RaisesInPrepare"))


@pytest.mark.usefixtures("in_threads")
def test_what_cannot_be_asked_is_told_before(task, tasks):
    request = ProfileRequest(spec="hostile:Plain", tasks=(task,), out=task.parents[2])
    more = os.cpu_count() + 1
    for changed, words in (
        ({"spec": "oracle_pose"}, "oracle_pose has no process that could be measured"),
        ({"cores": 0}, "core.*, not 0"),
        ({"cores": more}, f"core.*, not {more}"),
        ({"sustain_s": math.nan}, "the time must be positive seconds, got nan"),
        ({"radius_m": -3.0}, "the radius must be positive metres, got -3.0"),
        ({"radius_m": math.nan}, "the radius must be positive metres, got nan"),
        ({"radius_m": 0.5}, r"can be asked none of the \d+ queries: no prior within 0.5 m"),
        (
            {"tasks": (tasks / "tasks" / "clean" / "town-riverside", tasks / "tasks" / "alias" / "town-grid+alias")},
            r"the tasks are of 2 maps \(town-.*, town-.*\): profile one map at a time",
        ),
    ):
        with pytest.raises(ConfigError, match=words):
            profile(replace(request, **changed))


def test_a_page_is_written_whole_and_replaces_none_but_a_profile(slowing, tmp_path):
    hostile = replace(slowing, matcher="<script>alert(1)</script>")
    write_profile(hostile, tmp_path / "mine")
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {RECORD, PAGE, FIGURE}
    text = (tmp_path / "mine" / PAGE).read_text(encoding="utf-8")
    assert "<script>" not in text
    style = re.search(r"<style>(.*)</style>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = f"""<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'sha256-{digest}';"""
    assert policy in text  # else a browser leaves out its style
    assert "1 timeout" in text
    assert "OpenStreetMap contributors" in text
    record = json.loads((tmp_path / "mine" / RECORD).read_text(encoding="utf-8"))
    assert len(record["fixes"]) == 41
    assert "OpenStreetMap" in record["attribution"]
    write_profile(slowing, tmp_path / "mine")
    (tmp_path / "mine" / "notes.txt").touch()
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / RECORD).write_text('{"made_by": "another program"}', encoding="utf-8")
    for name in ("mine", "file", "other"):
        with pytest.raises(StoreError, match=r"notes\.txt|is no folder|profile\.json"):
            write_profile(slowing, tmp_path / name)
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"
    assert "mine" in (tmp_path / "mine" / PAGE).read_text(encoding="utf-8")


def test_the_command_prints_the_facts_and_where_the_page_is(program, tasks, tmp_path):
    task = tasks / "tasks" / "clean" / "town-riverside"
    words = ("profile", "--matcher", "random", "--tasks", task, "--seconds", "0.1", "--out", tmp_path / "out")
    code, out, err = program(*words)
    assert code == 0, err
    lines = out.strip().splitlines()
    assert lines[0].startswith("latency p50: ")
    assert lines[-1] == str(tmp_path / "out" / "profiles" / "random" / PAGE)
    assert not (tmp_path / "out" / "runs").exists()


def test_the_kernel_is_read_where_it_tells_something(tmp_path):
    assert hottest_celsius(tmp_path) is None
    for at, text in enumerate(("41250", "-274000", "words", "55000")):
        (tmp_path / "class/thermal" / f"thermal_zone{at}").mkdir(parents=True)
        (tmp_path / "class/thermal" / f"thermal_zone{at}" / "temp").write_text(text)
    assert hottest_celsius(tmp_path) == 55.0
    package = tmp_path / "class/powercap/intel-rapl:0"
    for folder, value in ((package, 900), (package.with_name("intel-rapl:0:0"), 7)):
        folder.mkdir(parents=True)
        (folder / "energy_uj").write_text(str(value))
        (folder / "max_energy_range_uj").write_text("1000")
    meter = EnergyMeter(tmp_path)
    (package / "energy_uj").write_text("100")  # it began again from 0
    assert meter.joules() == pytest.approx(200e-6)
    (package / "energy_uj").write_text("150")
    assert meter.joules() == pytest.approx(250e-6)
    (tmp_path / "cpuinfo").write_text("processor : 0\nmodel name\t: A Small One\n")
    assert processor_name(tmp_path / "cpuinfo") == "A Small One"
    assert processor_name(tmp_path / "none")
    assert sensors.clock_mhz() is None or sensors.clock_mhz() > 0
