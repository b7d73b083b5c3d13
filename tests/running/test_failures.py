# SPDX-License-Identifier: Apache-2.0
"""What fails costs its own name alone, whatever its error does; refusals of the disk stop everything."""

import errno

import pytest

from sasgeo_bench.core.errors import StoreError
from sasgeo_bench.core.progress import reporting
from sasgeo_bench.running.failures import LOG, Failures, is_disk_error


class UnspeakableError(RuntimeError):
    """An error of a plugin whose text cannot be made."""

    def __str__(self):
        raise RuntimeError


def test_an_error_without_a_text_is_recorded_as_any_other(tmp_path):
    lines = []
    failures = Failures(tmp_path / LOG)
    with reporting(lines.append), failures.of("mine"):
        raise UnspeakableError
    assert failures.found == {"mine": f"UnspeakableError ({LOG} says where)"}
    assert lines == [f"mine failed: UnspeakableError ({LOG} says where)"]
    assert "UnspeakableError" in (tmp_path / LOG).read_text(encoding="utf-8")


def test_a_named_fault_stands_in_its_own_words_and_once(tmp_path):
    lines = []
    failures = Failures(tmp_path / LOG)
    for _ in range(2):
        with reporting(lines.append), failures.of("mine"):
            raise StoreError("mine: no answers, run again")
    assert lines == ["mine failed: no answers, run again"] * 2
    assert not (tmp_path / LOG).exists()


def test_a_full_disk_stops_all_and_a_fault_of_one_does_not():
    full = StoreError("full")
    full.__cause__ = OSError(errno.ENOSPC, "No space left on device")
    assert is_disk_error(full)
    assert not is_disk_error(ValueError("mine"))


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_what_stops_everything_is_not_recorded(tmp_path, stop):
    failures = Failures(tmp_path / LOG)
    with pytest.raises(type(stop)), failures.of("mine"):
        raise stop
    assert failures.found == {}


def test_a_lack_of_memory_is_recorded(tmp_path):
    failures = Failures(tmp_path / LOG)
    with failures.of("mine"):
        raise MemoryError
    assert failures.found.keys() == {"mine"}
