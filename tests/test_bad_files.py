# SPDX-License-Identifier: Apache-2.0
"""Every kind of file the program reads, damaged: it is read, or refused in one line, and nothing is written.

`FORMATS` holds a row for each file: how its folder is made, and how it is read. What vouches for a damaged file, the
hash in a manifest, is made true again, so that readers meet what somebody could have written on purpose.
"""

import datetime as dt
import hashlib
import io
import json
import resource
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import osmium
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sasgeo_bench.ageing.files import read_ageing
from sasgeo_bench.ageing.measure import DTYPES
from sasgeo_bench.boards.archive_file import StoredRun, unpack, write_pack
from sasgeo_bench.boards.manifests import PackManifest
from sasgeo_bench.boards.pipeline_spec import read_pipeline_file
from sasgeo_bench.boards.site_files import read_board_files
from sasgeo_bench.core.config import parse_toml, shipped_dir
from sasgeo_bench.core.errors import MOST_MESSAGE, SasgeoError
from sasgeo_bench.core.folders import check_site, sha256_of
from sasgeo_bench.core.parquet import write_frame
from sasgeo_bench.exchange.importers.kinds import read_dataset
from sasgeo_bench.exchange.importers.reports import score_ranking
from sasgeo_bench.exchange.importers.retrieval import read_ranking
from sasgeo_bench.exchange.release_files import check_target
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.geometry.pose import Pose
from sasgeo_bench.matching.cards import read_card_file, read_learned
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.matching.submission import AnsweredTask, Card, Submission, example_card
from sasgeo_bench.osm.history import DatedExtract, read_history
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.taxonomy import load_taxonomy
from sasgeo_bench.regions.region_files import read_region
from sasgeo_bench.regions.region_spec import read_region_file
from sasgeo_bench.running import prediction_files
from sasgeo_bench.running.prediction_files import PREDICTION_SCHEMA, RunManifest, prediction_row
from sasgeo_bench.running.testing import TinyPlace
from sasgeo_bench.sasgeo.scorer_model import ScorerModel as Learnt
from sasgeo_bench.scoring.entries import find_entries
from sasgeo_bench.scoring.submission_files import read_submission, write_submission
from sasgeo_bench.tasks import task_files
from sasgeo_bench.tasks.split import read_split_file
from tests.exchange.importers import writers
from tests.handmade import card_of, full_board, put_board, put_pictures

FEW = settings(
    max_examples=8,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
MANY = settings(FEW, max_examples=300)
PART = "part-00000000000000000001-1.parquet"
MOST_KB = 3_000_000  # of this process, at its peak
TOYTOWN = Path(__file__).parent / "data" / "toytown.osm"
TOYGRID = Grid.from_bounds(499_900, 5_205_000, 500_600, 5_205_700, cell_size_m=10, epsg=32632)
HOSTILE: list[Any] = [
    *(None, True, False, 0, -1, 1, 2**31, 2**63, -(2**63), 10**39, 0.5, -0.0, 1e308, 5e-324),
    *("", "a", "..", "../../x", "/etc/passwd", "a\nb", "\x00", "\x1b[31m", "=1+1", "$\\nosuchthing$", "x" * 5000),
    *("<script>", "\u202etxt", "2020-13-45", [], {}, [[]], [None], {"a": None}, [1e300] * 4, ["x"] * 30),
]


@dataclass(frozen=True, kw_only=True)
class Format:
    """A file by its path in a folder, what makes the folder, what reads it, and the manifest that holds its hash."""

    file: str
    make: Callable[[Path, TinyPlace], object]
    read: Callable[[Path], object]
    listed: str = ""


def copied(path: Path) -> Callable[[Path, TinyPlace], object]:
    return lambda folder, _: shutil.copy(path, folder)


def written(name: str, text: str) -> Callable[[Path, TinyPlace], object]:
    return lambda folder, _: (folder / name).write_text(text, encoding="utf-8")


# --- how folders are made ---------------------------------------------------------------------------------------------


def make_pbf(folder: Path, _: TinyPlace) -> None:
    """Unpacked: in a packed one a checksum finds nearly every damage."""
    with osmium.SimpleWriter(osmium.io.File(str(folder / "a.osm.pbf"), "pbf,pbf_compression=none")) as writer:
        for element in osmium.FileProcessor(str(TOYTOWN)):
            writer.add(element)


def make_region(folder: Path, tiny: TinyPlace) -> None:
    shutil.copytree(tiny.map_folder, folder, dirs_exist_ok=True)


def task_of(tiny: TinyPlace) -> Path:
    """The task with most tracks."""
    return max(
        (path.parent for path in (tiny.folder / "tasks").rglob(task_files.TASK)),
        key=lambda path: (len(task_files.read_task(path)["counts"]), path.name),
    )


def truth_of(task: Path, tiny: TinyPlace) -> Path:
    return tiny.folder / "truth" / task.relative_to(tiny.folder / "tasks")


def make_task(folder: Path, tiny: TinyPlace) -> None:
    task = task_of(tiny)
    shutil.copytree(task, folder, dirs_exist_ok=True)
    shutil.copytree(truth_of(task, tiny), folder, dirs_exist_ok=True)


def answers_of(task: Path) -> list[Prediction]:
    pose = Pose(easting_m=500_000.0, northing_m=5_200_000.0, yaw_deg=10.0)
    return [
        Prediction(query_id=name, candidates=((pose, 0.5),) * (at % 2), confidence=0.5, diagnostics={"margin": 1.0})
        for at, name in enumerate(task_files.Task.open(task).ids())
    ]


def about_of(task: Path) -> RunManifest:
    result = task_files.read_task(task)
    return RunManifest(
        schema_version=1,
        matcher=card_of("mine"),
        spec="mine",
        hash="0123456789ab",
        **{name: result[name] for name in ("suite", "region", "task_version", "map_fingerprint")},
        queries_sha256=result["files"][task_files.QUERIES]["sha256"],
        top_k=5,
        learned={"key": "ab", "file": None, "trained_on": ["porto"], "pairs": 3},
        cpu_s=1.5,
    )


def make_run(folder: Path, tiny: TinyPlace) -> None:
    task = task_of(tiny)
    about_of(task).save(folder)
    prediction_files.write_part(folder, answers_of(task), asked=task_files.Task.open(task).asked).rename(folder / PART)


def make_predictions(folder: Path, tiny: TinyPlace) -> None:
    """As somebody else writes them: without checksums."""
    rows = [prediction_row(item) for item in answers_of(task_of(tiny))]
    pq.write_table(pa.Table.from_pylist(rows, schema=PREDICTION_SCHEMA), folder / "mine.parquet")


def make_submission(folder: Path, tiny: TinyPlace) -> None:
    task = task_of(tiny)
    card = parse_toml(example_card("mine"), Card, source="card")
    asked = AnsweredTask(suite="clean", region="here", queries_sha256="0" * 64, queries=1, answered=1)
    result = Submission(
        schema_version=1,
        card=card,
        board="demo",
        split="crossfit",
        task_version=1,
        data_version=1,
        scorer_version=1,
        made_by="a test",
        tasks=[asked],
        files={},
        licence="ODbL-1.0",
        attribution="OpenStreetMap",
    )
    write_submission(folder / "mine", result, answers_of(task), task_files.Task.open(task).asked)


def make_pack(folder: Path, tiny: TinyPlace) -> None:
    task = task_of(tiny)
    board = put_board(folder.parent / f"{folder.name}-board")
    put_pictures(board)
    settings = {"schema_version": 3, "split": None, "rejectors": [], "contrasts": [], "draws": 10, "by_region": []}
    settings |= {"pipeline": {}, "contestants": ["mine"], "dropped": ""}
    write_pack(
        folder / "pack",
        board=board,
        tasks=[task_files.Task.open(task)],
        runs={"mine": [StoredRun(manifest=about_of(task), predictions=answers_of(task))]},
        settings=PackManifest.model_validate(settings),
    )


def make_board(folder: Path, _: TinyPlace) -> None:
    full_board(folder / "board", shares={"graph": 0.9, "raster": 0.8})
    put_pictures(folder / "board")


def make_ageing(folder: Path, _: TinyPlace) -> None:
    table = pd.DataFrame({name: pd.Series([], dtype=kind) for name, kind in DTYPES.items()})
    values = {"place": "here", "country": "nowhere", "sources": ["a of 2020-01-01"], "area_km2": 1.0}
    write_frame(table, folder / "ageing.parquet", attrs=values)


def make_ranking(folder: Path, _: TinyPlace) -> None:
    writers.write_university(folder / "set")
    answers = {"test/query_drone/0001/0001.jpg": [f"test/gallery_satellite/000{at}/000{at}.jpg" for at in (1, 0, 2)]}
    writers.write_ranking(folder / "ranking.parquet", answers)


# --- how they are read ------------------------------------------------------------------------------------------------


def read_all_of_task(folder: Path) -> object:
    task_files.read_task(folder)
    replace(task_files.Task.open(folder), truth=folder).check_truths()
    rows = (task_files.read_queries(folder), task_files.Task.open(folder).heads(), task_files.read_truths(folder))
    asked = task_files.Task.open(folder).asked
    return [*map(list, rows), task_files.Task.open(folder).view_bytes(), list(task_files.Task.open(folder).some(asked))]


def read_all_of_run(folder: Path) -> object:
    asked = dict.fromkeys(("a", "b"), "ff")
    find_entries([folder])
    return (
        prediction_files.Answers.open(folder, asked),
        list(prediction_files.read_predictions(folder)),
        prediction_files.read_ties(folder),
    )


def read_pack(folder: Path) -> object:
    with tempfile.TemporaryDirectory() as into:
        return unpack(folder / "pack", Path(into))


def read_board(folder: Path) -> object:
    return read_board_files(folder / "board")


def read_scores(folder: Path) -> object:
    dataset = read_dataset(folder / "set", "university-1652")
    return score_ranking(dataset, read_ranking([folder / "ranking.parquet"], dataset.items))


def read_states(file: str) -> Callable[[Path], object]:
    return lambda folder: (
        read_extract(folder / file, TOYGRID),
        read_history([DatedExtract(path=folder / file, on=dt.date(2020, 1, 1))]),
    )


PACK = [
    *("pack.json", "board.json", "tasks.parquet", "runs.parquet", "queries.parquet", "truths.parquet"),
    "predictions.parquet",
]
FORMATS = {
    "region.toml": Format(
        file="vaduz.toml",
        make=copied(shipped_dir("regions") / "vaduz.toml"),
        read=lambda folder: read_region_file(folder / "vaduz.toml").grid(),
    ),
    "split.toml": Format(
        file="crossfit.toml",
        make=copied(shipped_dir("splits") / "crossfit.toml"),
        read=lambda folder: read_split_file(folder / "crossfit.toml"),
    ),
    "pipeline.toml": Format(
        file="demo.toml",
        make=copied(shipped_dir("pipelines") / "demo.toml"),
        read=lambda folder: read_pipeline_file(folder / "demo.toml"),
    ),
    "card.toml": Format(
        file="card.toml",
        make=written("card.toml", example_card()),
        read=lambda folder: read_card_file(folder / "card.toml"),
    ),
    "learnt.json": Format(
        file="learnt.json",
        make=written("learnt.json", Learnt.by_hand(load_taxonomy().names[:3]).to_text()),
        read=lambda folder: Learnt.from_text(read_learned(folder / "learnt.json") or ""),
    ),
    "toytown.osm": Format(file="toytown.osm", make=copied(TOYTOWN), read=read_states("toytown.osm")),
    "a.osm.pbf": Format(file="a.osm.pbf", make=make_pbf, read=read_states("a.osm.pbf")),
    **{
        f"region/{file}": Format(file=file, make=make_region, read=read_region, listed="region.json")
        for file in ("region.json", "layers.tif", "features.parquet", "nodes.parquet", "edges.parquet")
    },
    **{
        f"task/{file}": Format(file=file, make=make_task, read=read_all_of_task)
        for file in ("task.json", "queries.parquet", "truth.json", "truth.parquet")
    },
    **{f"run/{file}": Format(file=file, make=make_run, read=read_all_of_run) for file in ("run.json", PART)},
    "mine.parquet": Format(
        file="mine.parquet",
        make=make_predictions,
        read=lambda folder: (
            list(prediction_files.read_predictions(folder / "mine.parquet")),
            find_entries([folder / "mine.parquet"]),
        ),
    ),
    **{
        f"submission/{file}": Format(
            file=f"mine/{file}",
            make=make_submission,
            read=lambda folder: read_submission(folder / "mine"),
            listed="mine/submission.json",
        )
        for file in ("submission.json", "predictions/mine.parquet")
    },
    **{
        f"results/{file}": Format(file=f"pack/{file}", make=make_pack, read=read_pack, listed="pack/pack.json")
        for file in PACK
    },
    **{
        f"board/{file}": Format(file=f"board/{file}", make=make_board, read=read_board)
        for file in (
            *("board.json", "leaderboard.parquet", "scores.parquet", "contrasts.parquet", "pictures/pictures.json"),
            "figures/age-real-age-localization-r500-weak-s3.svg",
        )
    },
    "dataset/Dense_GPS_ALL.txt": Format(
        file="Dense_GPS_ALL.txt",
        make=lambda folder, _: writers.write_dense(folder, {"000000": (120.5, 30.25)}),
        read=lambda folder: read_dataset(folder, "dense-uav"),
    ),
    **{
        f"dataset/{file}": Format(
            file=file,
            make=lambda folder, _: writers.write_visloc(folder),
            read=lambda folder: read_dataset(folder, "uav-visloc"),
        )
        for file in ("satellite_coordinates_range.csv", "01/01.csv", "01/satellite01.tif")
    },
    "ranking.parquet": Format(file="ranking.parquet", make=make_ranking, read=read_scores),
    "ageing.parquet": Format(file="ageing.parquet", make=make_ageing, read=read_ageing),
    "site.json": Format(file="site.json", make=written("site.json", '{"files": ["index.html"]}'), read=check_site),
    "SHA256SUMS": Format(
        file="SHA256SUMS",
        make=lambda folder, _: [
            (folder / "release.json").write_text('{"made_by": "sasgeo-bench 0.1.0"}'),
            (folder / "SHA256SUMS").write_text(f"{sha256_of(folder / 'release.json')}  release.json\n"),
        ],
        read=check_target,
    ),
}


# --- what is done to them ---------------------------------------------------------------------------------------------


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes with a few bits flipped, cut short, exchanged, repeated or put in."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 3))):
        at, length = draw(st.integers(0, max(len(changed) - 1, 0))), draw(st.integers(1, 40))
        other = draw(st.integers(0, max(len(changed) - 1, 0)))
        part, kind = changed[at : at + length], draw(st.sampled_from("bcdsri"))
        if kind == "b" and changed:
            changed[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "c":
            del changed[at:]
        elif kind == "d":
            del changed[at : at + length]
        elif kind == "s":
            changed[at : at + length], changed[other : other + length] = changed[other : other + length], part
        elif kind == "r":
            changed[at:at] = part * 50
        else:
            changed[at:at] = draw(st.binary(max_size=20))
    return bytes(changed)


def places_in(content: Any) -> Iterator[tuple[Any, Any]]:
    """Every place in a document: what holds it, and its key or index there."""
    for key in list(content) if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], dict | list):
            yield from places_in(content[key])


@st.composite
def odd_json(draw: st.DrawFn, data: bytes) -> bytes:
    """A document with a value of another kind, one left out, or one more."""
    content = json.loads(data)
    held, key = draw(st.sampled_from(list(places_in(content))))
    kind, value = draw(st.sampled_from(("set", "set", "set", "drop", "add"))), draw(st.sampled_from(HOSTILE))
    if kind == "drop":
        del held[key]
    elif kind == "add" and isinstance(held, dict):
        held["odd"] = value
    else:
        held[key] = value
    return json.dumps(content).encode()


@st.composite
def odd_toml(draw: st.DrawFn, data: bytes) -> bytes:
    """A text with one line changed, left out or put in."""
    lines = data.decode().splitlines()
    at = draw(st.sampled_from([at for at, line in enumerate(lines) if "=" in line]))
    value = draw(st.sampled_from([value for value in HOSTILE if value is not None and not isinstance(value, dict)]))
    text = str(value) if isinstance(value, float) else json.dumps(value)
    key = lines[at].split("=")[0]
    lines[at] = draw(st.sampled_from((f"{key}= {text}", "", f"{lines[at]}\n{lines[at]}", f"odd = {text}\n{lines[at]}")))
    return "\n".join(lines).encode()


@st.composite
def odd_table(draw: st.DrawFn, data: bytes) -> bytes:
    """A table with a column of nulls, of another type, with a hostile value, twice, renamed or left out."""
    table = pq.read_table(pa.BufferReader(data))
    at, kind = (
        draw(st.integers(0, table.num_columns - 1)),
        draw(st.sampled_from(("null", "set", "type", "drop", "name", "rows"))),
    )
    name, column = table.column_names[at], table.column(at)
    if kind == "null":
        table = table.set_column(at, name, pa.nulls(len(table), column.type))
    elif kind == "drop":
        table = table.drop_columns([name])
    elif kind == "name":
        table = table.rename_columns(
            [
                draw(st.sampled_from((table.column_names[0], "odd", ""))) if one == at else text
                for one, text in enumerate(table.column_names)
            ]
        )
    elif kind == "rows":
        table = draw(st.sampled_from((table.slice(0, 0), table.slice(1), pa.concat_tables([table, table]))))
    else:
        value = draw(st.sampled_from([value for value in HOSTILE if value != {}]))  # no parquet holds an empty struct
        if value == [None] and pa.types.is_map(column.type):
            value = None  # pyarrow ends the process that makes such a map; a file that holds one it refuses to read
        try:
            odd = pa.array([value] * len(table), column.type if kind == "set" else None)
        except (pa.ArrowException, TypeError, ValueError, OverflowError):
            odd = pa.array(["odd"] * len(table))
        table = table.set_column(at, name, odd)
    sink = io.BytesIO()
    pq.write_table(table, sink)
    return sink.getvalue()


ODD = {".json": odd_json, ".toml": odd_toml, ".parquet": odd_table}


def list_again(folder: Path, item: Format) -> None:
    """Let the manifest say what is there now, unless it is itself the damaged file."""
    path, manifest = folder / item.file, folder / item.listed
    if not item.listed or path == manifest:
        return
    record = json.loads(manifest.read_text(encoding="utf-8"))
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    name = path.relative_to(manifest.parent).as_posix()
    record["files"][name] = (
        digest if isinstance(record["files"][name], str) else {"sha256": digest, "bytes": path.stat().st_size}
    )
    manifest.write_text(json.dumps(record), encoding="utf-8")


def check_reading(folder: Path, item: Format, data: bytes) -> None:
    """Read a folder with other bytes in its file: well, or refused in one printable line; nothing is written."""
    (folder / item.file).write_bytes(data)
    list_again(folder, item)
    before = sorted(folder.rglob("*"))
    try:
        item.read(folder)
    except SasgeoError as error:
        text = str(error)
        assert text.isprintable(), text
        assert len(text) <= MOST_MESSAGE
    assert sorted(folder.rglob("*")) == before
    assert (folder / item.file).read_bytes() == data


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory, tiny: TinyPlace) -> dict[str, Path]:
    """A folder for each format, made once for all files that lie in it."""
    made: dict[object, Path] = {}
    found = {}
    for name, item in FORMATS.items():
        if item.make not in made:
            made[item.make] = tmp_path_factory.mktemp("format")
            item.make(made[item.make], tiny)
        found[name] = made[item.make]
    return found


def try_examples(
    folder: Path, item: Format, spoil: Callable[[bytes], st.SearchStrategy[bytes]], budget: settings
) -> int:
    """Hold the reader to each example of a spoilt file; -> how many there were."""
    path = folder / item.file
    manifest = folder / (item.listed or item.file)
    sound, listed = path.read_bytes(), manifest.read_bytes()
    tried = 0

    @budget
    @given(spoil(sound))
    def check(data: bytes) -> None:
        nonlocal tried
        tried += 1
        check_reading(folder, item, data)

    try:
        check()
    finally:
        path.write_bytes(sound)
        manifest.write_bytes(listed)
    return tried


@pytest.mark.parametrize("name", FORMATS)
def test_a_sound_file_is_read(folders: dict[str, Path], name: str) -> None:
    assert (folders[name] / FORMATS[name].file).is_file()
    FORMATS[name].read(folders[name])


@pytest.mark.parametrize("name", FORMATS)
def test_a_damaged_file_is_read_or_refused_in_one_line(folders: dict[str, Path], name: str) -> None:
    assert try_examples(folders[name], FORMATS[name], damaged, FEW) >= FEW.max_examples


@pytest.mark.parametrize("name", [name for name in FORMATS if Path(FORMATS[name].file).suffix in ODD])
def test_a_file_with_an_odd_value_is_read_or_refused_in_one_line(folders: dict[str, Path], name: str) -> None:
    item = FORMATS[name]
    assert try_examples(folders[name], item, ODD[Path(item.file).suffix], FEW) > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_file_damaged_in_many_ways_is_read_or_refused_in_one_line(folders: dict[str, Path], name: str) -> None:
    item = FORMATS[name]
    try_examples(folders[name], item, damaged, MANY)
    if Path(item.file).suffix in ODD:
        try_examples(folders[name], item, ODD[Path(item.file).suffix], MANY)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < MOST_KB
