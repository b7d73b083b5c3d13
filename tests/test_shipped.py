# SPDX-License-Identifier: Apache-2.0
"""The shipped region files, and finding own ones beside them."""

import shutil
import tarfile
from pathlib import Path

import pytest

from sasgeo_bench.core.config import shipped_dir
from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.regions.region_spec import find_region_file, list_region_files, read_region_file
from sasgeo_bench.running.plan import RunRequest, plan_run
from sasgeo_bench.running.prediction_files import RUN, RunManifest
from sasgeo_bench.running.worker import Limits


def test_at_least_200_real_regions_from_at_least_150_places_ship_with_the_package():
    specs = [read_region_file(path) for path in list_region_files().values()]
    real = [spec for spec in specs if all(extract.town is None for extract in spec.extract)]
    places = {spec.extract[-1].file.split("-")[0] for spec in real}
    assert len(real) >= 200
    assert len(places) >= 150


@pytest.mark.parametrize(("region", "dates"), [("vaduz", 9), ("andorra-la-vella", 5), ("monaco", 4), ("dreieich", 2)])
def test_every_date_of_the_places_with_several_is_listed(region, dates):
    assert len(read_region_file(list_region_files()[region]).extract) >= dates


def test_every_shipped_region_has_a_grid_and_lies_apart_from_others_of_its_id():
    for name, path in list_region_files().items():
        spec = read_region_file(path)
        assert path.stem == name
        assert spec.grid().rows > 100
        files = [extract for extract in spec.extract if extract.town is None and extract.format == "osm"]
        assert spec.provenance.source or all(extract.urls for extract in files)


def test_own_regions_are_found_beside_the_shipped_ones(tmp_path):
    own = (shipped_dir("regions") / "vaduz.toml").read_text().replace('id = "vaduz"', 'id = "mine"')
    (tmp_path / "mine.toml").write_text(own)
    assert list_region_files(folders=[tmp_path])["mine"] == tmp_path / "mine.toml"
    assert find_region_file("mine", folders=[tmp_path]) == tmp_path / "mine.toml"
    assert find_region_file(str(tmp_path / "mine.toml")) == tmp_path / "mine.toml"


def test_two_regions_with_one_id_are_refused_and_both_named(tmp_path):
    shutil.copy(shipped_dir("regions") / "vaduz.toml", tmp_path / "other.toml")
    with pytest.raises(ConfigError, match=r"'vaduz'.*other\.toml.*vaduz\.toml"):
        list_region_files(folders=[tmp_path])


def test_a_misspelt_id_suggests_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'monaco'"):
        find_region_file("monacco")


def test_a_missing_file_or_folder_is_told(tmp_path):
    with pytest.raises(ConfigError, match="there is no region file"):
        find_region_file(str(tmp_path / "none.toml"))
    with pytest.raises(ConfigError, match="no folder"):
        list_region_files(folders=[tmp_path / "none"])


@pytest.mark.parametrize("change", [lambda data: b"\xef\xbb\xbf" + data, lambda data: data.replace(b"\n", b"\r\n")])
def test_a_mark_of_the_byte_order_and_other_line_ends_do_no_harm(tmp_path, change):
    shipped = shipped_dir("regions") / "vaduz.toml"
    (tmp_path / "mine.toml").write_bytes(change(shipped.read_bytes()))
    assert read_region_file(tmp_path / "mine.toml") == read_region_file(shipped)


def test_the_answers_that_come_packed_with_the_demo_are_those_of_the_code_of_today(tmp_path):
    """Else a first `make demo` asks all again, without a word: `make head-start` packs them anew."""
    with tarfile.open(shipped_dir("pipelines") / "demo.tar.xz") as packed:
        names = {Path(name).parts[2]: name for name in packed.getnames() if name.endswith(RUN)}
        texts = {found: packed.extractfile(name).read() for found, name in names.items()}
    assert len(texts) > 5
    for found, text in texts.items():
        run = RunManifest.model_validate_json(text)
        request = RunRequest(spec=run.spec, tasks=(), out=tmp_path, top_k=run.top_k, limits=Limits(**run.limits))
        assert plan_run(request).hash == found, run.spec
