# SPDX-License-Identifier: Apache-2.0
"""Hold our reader of OSM files against GDAL's OSM driver and `osmium export`, object for object.

    .venv/bin/python -m benchmarks.cross_check_osm --extracts ../shared/data/osm --out out/cross-check

Every extract of a folder is read whole by all three. The area (holes taken out) or length of each object and class is
compared in one UTM zone. A difference of more than 1 m2 (or m) and 0.01 % of an object must be what a rule of
`map_rules.py` says: the rule works out the size of that object by itself, and our reader must have come to it. What no
rule explains may be 0.2 % of a class of a file, and what one rule explains against GDAL 2 % of a class of all files;
else a line says so, with some ids, and the exit status is 1. Relations whose tags stand on outer ways are held against
GDAL alone: osmium makes no areas of them.

A result is kept in OUT by the hash of the file and of the code, so that a second run does what has changed.
"""

import argparse
import datetime as dt
import hashlib
import json
import os
import re
import shutil
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pyogrio
import shapely

from benchmarks import map_rules, other_readings
from benchmarks.map_rules import GDAL_RULES, OSMIUM_RULES, Case, Facts, explain, is_near
from benchmarks.other_readings import (
    HISTORY,
    KEY,
    Frame,
    Plain,
    Tags,
    gathered,
    make_plain,
    measured,
    read_gdal,
    read_osmium,
    sizes,
)
from sasgeo_bench.geometry.grid import Grid
from sasgeo_bench.osm import read as our_reader
from sasgeo_bench.osm.read import read_extract
from sasgeo_bench.osm.snapshot import SUFFIXES

MOST_SHARE: Final = 0.002  # of a class of a file, without a rule
MOST_RULE: Final = 0.02  # of a class of all files, by one rule
LEAST: Final = 1.0  # m2 or m: less is rounding
CLASS: Final = ["class", "form"]
IDS: Final = 5


def read_ours(path: Path, frame: Frame, *, at: str) -> pd.DataFrame:
    """Read a whole file as the package does: one row an object, class and form."""
    grid = Grid.from_bounds(*frame.bounds_m, cell_size_m=1000.0, epsg=frame.epsg)
    day = dt.date.fromisoformat(at) if path.name.endswith(HISTORY) else None
    features = read_extract(path, grid, at=day).features
    features = features[features["osm_type"].isin(["way", "relation"])]  # the sea comes from the coast, not from a tag
    geometry = features.geometry.to_numpy()
    is_area = shapely.get_dimensions(geometry) == 2  # polygons
    size, holes, _ = sizes(geometry, is_area, frame)
    table = {"kind": features["osm_type"].str[0], "id": features["osm_id"], "class": features["class"]}
    form = np.where(is_area, "area", "line")
    return gathered([pd.DataFrame({**table, "form": form, "size": size, "holes": holes})])


def check(path: Path, *, at: str) -> dict[str, Any]:
    """Read one file in all ways; sums by class, and every object that differs, with the rule that explains it."""
    tags, start = Tags.load(), time.time()
    with tempfile.TemporaryDirectory(prefix="sasgeo-") as folder:
        scratch = Path(folder)
        plain = make_plain(path, tags, scratch, at=at)
        objects = read_gdal(plain.path, tags, scratch)
        frame = Frame.around(np.concatenate([shapely.get_coordinates(each.geometry) for each in objects]))
        readings = {"gdal": measured(objects, tags, frame, plain.copies)}
        if shutil.which("osmium"):
            readings["osmium"] = measured(read_osmium(plain.path, tags, scratch), tags, frame, {})
        readings["ours"] = read_ours(path, frame, at=at)
        found = compare(readings, plain)
        explained = with_rules(found, plain, frame)
    sums = found.groupby(CLASS, as_index=False)[
        [name for name in found if str(name).startswith(("size", "holes"))]
    ].sum()
    return {
        "seconds": round(time.time() - start, 1),
        "sums": sums.round(2).to_dict("records"),
        "differences": explained,
    }


def compare(readings: dict[str, pd.DataFrame], plain: Plain) -> pd.DataFrame:
    """Join readings by object, class and form; outer ways of a bare relation count as the relation."""
    found: pd.DataFrame | None = None
    for name, table in readings.items():
        is_part = (table["kind"] == "w") & table["id"].isin(plain.owners)
        owner = table["id"].map(plain.owners).where(is_part, table["id"]).astype(np.int64)
        owned = gathered([table.assign(id=owner, kind=table["kind"].mask(is_part, "r"))])
        owned = owned.rename(columns={"size": f"size_{name}", "holes": f"holes_{name}"})
        found = owned if found is None else found.merge(owned, on=KEY, how="outer")
    assert found is not None  # noqa: S101 - there is a reading
    return found.fillna(0.0)


def with_rules(found: pd.DataFrame, plain: Plain, frame: Frame) -> list[dict[str, Any]]:
    """List the objects that differ, for each other reader, with the rule that comes to our size, or none."""
    listed = []
    owned = set(plain.owners.values())
    there = found[(found["kind"] == "r") & (found["size_ours"] > 0)]
    told = set(zip(there["id"], there["class"], strict=True))
    for reader, rules in (("gdal", GDAL_RULES), ("osmium", OSMIUM_RULES)):
        if f"size_{reader}" not in found:
            continue
        pairs = zip(found["size_ours"], found[f"size_{reader}"], strict=True)
        differ = found[[not is_near(*pair) for pair in pairs]]
        if reader == "osmium":
            differ = differ[~((differ["kind"] == "r") & differ["id"].isin(owned))]
        is_way = differ["kind"] == "w"
        ways = differ["id"][is_way].tolist()
        around = [relation for way in ways for relation in plain.around.get(way, ())]
        facts = Facts.read(plain.source, frame, ways=ways, relations=[*differ["id"][~is_way], *around])
        for row in differ.to_dict("records"):
            above = plain.above.get(row["id"], ()) if row["kind"] == "w" else ()
            is_reported = any((owner, row["class"]) in told for owner in above)
            kept = {name: row[name] for name in KEY}
            told_sizes = (row["size_ours"], row["size_gdal"])
            case = Case(
                row["kind"], row["id"], row["class"], row["form"], *told_sizes, is_reported=is_reported, facts=facts
            )
            other = row[f"size_{reader}"]
            rule = explain(case, rules)
            listed.append({"reader": reader, **kept, "ours": row["size_ours"], "other": other, "rule": rule})
    return listed


def code_hash() -> str:
    """Hash of all that a result depends on: our reader, this program, and the versions of the others."""
    folder = Path(our_reader.__file__).parent
    files = [*sorted(folder.glob("*.py")), folder / "taxonomy.toml"]
    files += [Path(module.__file__ or "") for module in (map_rules, other_readings)] + [Path(__file__)]
    texts = [path.read_bytes() for path in files] + [repr(pyogrio.__gdal_version__).encode()]
    return hashlib.sha256(b"\0".join(texts)).hexdigest()[:16]


def checked(path: Path, *, out: Path, code: str) -> dict[str, Any]:
    """Return the result of a file: from OUT if it is of this file and code, else made and kept."""
    mark = [hashlib.sha256(path.read_bytes()).hexdigest(), code]
    kept = out / f"{path.name}.json"
    if kept.exists():
        result: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
        if result["mark"] == mark:
            return result
    day = re.search(r"\d{4}-\d\d-\d\d", path.name)
    try:
        result = check(path, at=day[0] if day else "")
    except Exception as error:  # noqa: BLE001 - a file that fails is a fault, and the others are read all the same
        result = {"seconds": 0.0, "sums": [], "differences": [], "refused": f"{type(error).__name__}: {error}"[:300]}
    result |= {"file": path.name, "mark": mark}
    written = kept.with_suffix(".part")
    written.write_text(json.dumps(result), encoding="utf-8")
    written.replace(kept)
    return result


def tables(results: list[dict[str, Any]]) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Sums by file, class and form; and every object that differs."""
    sums = pd.DataFrame([{"file": each["file"], **row} for each in results for row in each["sums"]])
    differ = pd.DataFrame(
        [{"file": each["file"], **row} for each in results for row in each["differences"]],
        columns=["file", "reader", *KEY, "ours", "other", "rule"],
    )
    return sums, differ.assign(by=(differ["ours"] - differ["other"]).abs())


def file_rows(sums: pd.DataFrame, differ: pd.DataFrame) -> pd.DataFrame:
    """One row for each file, class, form and other reader: sizes, and what rules explain and what none does."""
    rows = []
    place = ["file", *CLASS]
    for reader in ("gdal", "osmium"):
        if f"size_{reader}" not in sums:
            continue
        part = differ[differ["reader"] == reader]
        total = sums.set_index(place)[["size_ours", f"size_{reader}", "holes_ours", f"holes_{reader}"]]
        total.columns = pd.Index(["ours", "other", "holes", "other_holes"])
        for name, told in (("explained", part["rule"].notna()), ("unexplained", part["rule"].isna())):
            total[name] = part[told].groupby(place)["by"].sum()
        rows.append(total.fillna(0.0).reset_index().assign(reader=reader))
    table = pd.concat(rows)
    whole = table[["ours", "other"]].max(axis=1)
    return table.assign(share=table["unexplained"] / whole.where(whole > 0, 1.0))


def faults(rows: pd.DataFrame, differ: pd.DataFrame, rules: pd.DataFrame) -> list[str]:
    """Lines that name what no rule explains, and rules that explain too much."""
    lines = []
    bad = rows[(rows["share"] > MOST_SHARE) & (rows["unexplained"] > LEAST)]
    for row in bad.sort_values("unexplained", ascending=False).to_dict("records"):
        of_class = (differ["class"] == row["class"]) & (differ["form"] == row["form"]) & differ["rule"].isna()
        found = differ[(differ["file"] == row["file"]) & (differ["reader"] == row["reader"]) & of_class]
        worst = found.sort_values("by", ascending=False).head(IDS)
        ids = ", ".join(
            f"{each['kind']}{each['id']} ({each['ours']:.0f} for {each['other']:.0f})"
            for each in worst.to_dict("records")
        )
        unit = "m2" if row["form"] == "area" else "m"
        lines.append(
            f"{row['file']}: {row['class']} ({row['form']}) differs from {row['reader']} by {row['unexplained']:.0f} "
            f"{unit} without a rule, {100 * row['share']:.2f} %: {ids}"
        )
    broad = rules[(rules["reader"] == "gdal") & (rules["share"] > MOST_RULE)].to_dict("records")
    said = "rule {rule} explains {share:.2%} of {class} ({form}) of all files"
    return [*lines, *(said.format_map(row) for row in broad)]


def rule_rows(sums: pd.DataFrame, differ: pd.DataFrame) -> pd.DataFrame:
    """For each rule, other reader, class and form: objects, what the rule explains, and its share of all files."""
    total = sums.groupby(CLASS)["size_ours"].sum()
    told = differ[differ["rule"].notna()].groupby(["reader", "rule", *CLASS], as_index=False)
    table = told.agg(objects=("by", "size"), explained=("by", "sum"))
    whole = [max(float(total.get(place, 0.0)), 1.0) for place in zip(table["class"], table["form"], strict=True)]
    return table.assign(share=table["explained"] / np.array(whole))


def report(results: list[dict[str, Any]], out: Path, *, is_full: bool) -> int:
    """Write the tables into OUT, print them, and return how many faults there are."""
    sums, differ = tables(results)
    refused = [f"{each['file']}: {each['refused']}" for each in results if "refused" in each]
    lines: list[str] = []
    if len(sums):
        rows = file_rows(sums, differ)
        rules = rule_rows(sums, differ)
        for name, table in (("classes", rows), ("objects", differ), ("rules", rules)):
            table.to_csv(out / f"{name}.csv", index=False, float_format="%.6g")
        shown = rows if is_full else rows[rows["explained"] + rows["unexplained"] > 0]
        _show("By file and class", shown.assign(share=100 * shown["share"]).rename(columns={"share": "%"}))
        _show("By rule, of all files", rules.assign(share=100 * rules["share"]).rename(columns={"share": "%"}))
        whole = rows.groupby(["reader", *CLASS], as_index=False)[["ours", "other", "explained", "unexplained"]].sum()
        _show("By class, of all files", whole.assign(**{"%": 100 * whole["unexplained"] / whole["ours"]}))
        lines = faults(rows, differ, rules)
    lines += refused
    print("\n".join(["", *lines]))
    minutes = sum(each["seconds"] for each in results) / 60
    print(f"{len(results)} files, {len(lines)} faults, {minutes:.1f} minutes of work")
    return len(lines)


def _show(title: str, table: pd.DataFrame) -> None:
    print(f"\n{title}\n{table.to_string(index=False, float_format=lambda value: f'{value:.2f}')}" if len(table) else "")


def main(words: list[str] | None = None) -> None:
    """Check every file of a folder; `words` stand in for those of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extracts", type=Path, default=os.environ.get("SASGEO_EXTRACTS"), help="folder of OSM files")
    parser.add_argument("--out", type=Path, default=Path("out/cross-check"), help="results of files, and tables")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default 1)")
    parser.add_argument("--only", nargs="+", default=[""], help="files whose names begin so")
    parser.add_argument("--full", action="store_true", help="print classes without a difference too")
    how = parser.parse_args(words)
    if how.extracts is None or not Path(how.extracts).is_dir():
        parser.error("name the folder of the extracts: --extracts DIR or SASGEO_EXTRACTS")
    names = [path for path in Path(how.extracts).iterdir() if path.name.endswith(SUFFIXES)]
    paths = [path for path in names if path.name.startswith(tuple(how.only))]
    if not paths:
        parser.error(f"{how.extracts} holds no OSM file that begins with {', '.join(how.only)}")
    how.out.mkdir(parents=True, exist_ok=True)
    paths.sort(key=lambda path: (-path.stat().st_size, path.name))  # the longest first
    results = []
    each_file = partial(checked, out=how.out, code=code_hash())
    with ProcessPoolExecutor(how.jobs) if how.jobs > 1 else nullcontext() as pool:
        for result in pool.map(each_file, paths) if pool else map(each_file, paths):
            results.append(result)
            print(f"{len(results)} of {len(paths)}: {result['file']}, {result['seconds']:.0f} s", file=sys.stderr)
    sys.exit(min(report(sorted(results, key=lambda each: each["file"]), how.out, is_full=how.full), 1))


if __name__ == "__main__":
    main()
