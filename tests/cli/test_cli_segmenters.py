# SPDX-License-Identifier: Apache-2.0
"""Commands for authors of segmenters: a package, a table, a list; mistakes on one line."""

import pytest

from sasgeo_bench.matching.scaffold import package_files, write_plugin


def test_segmenters_are_listed_with_the_control(program) -> None:
    code, out, err = program("list", "segmenters")
    assert (code, err) == (0, "")
    head, *rows = (line.split() for line in out.splitlines() if line)
    assert head == ["segmenter", "package", "class"]
    assert "oracle_segmenter" in {row[0] for row in rows}


def test_a_new_segmenter_is_written_and_the_next_step_is_told(program, tmp_path) -> None:
    code, out, err = program("new", "segmenter", "my-segmenter", "--into", "deep/er")
    assert (code, err) == (0, "")
    assert out.startswith("deep/er: 5 files; next: ")
    assert out.endswith(" install -e deep/er && sasgeo-bench check my-segmenter\n")
    assert (tmp_path / "deep" / "er" / "src" / "my_segmenter" / "segmenter.py").is_file()


@pytest.mark.usefixtures("in_threads")
def test_a_check_prints_every_row_and_a_failed_one_is_the_users(program, tmp_path, monkeypatch) -> None:
    files = package_files("segmenter", "my-checked")
    write_plugin(tmp_path / "plugin", files)
    monkeypatch.syspath_prepend(str(tmp_path / "plugin" / "src"))
    code, out, err = program("check", "--kind", "segmenter", "my_checked.segmenter:MyChecked")
    assert (code, err) == (0, "")
    assert "the same answer twice" in out
    code, out, err = program("check", "--kind", "segmenter", "no_such_segmenter")
    assert code == 2
    assert "there is no segmenter 'no_such_segmenter'" in out
    assert err == "no_such_segmenter: 1 check failed\n"
