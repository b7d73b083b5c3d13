# SPDX-License-Identifier: Apache-2.0
"""Rows of a table of a flight log: separators, units below the header, decimals; position files of RTKLIB."""

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

from sasgeo_bench.flights.log_formats import key_of
from sasgeo_bench.flights.log_points import LogSource
from sasgeo_bench.flights.log_units import WORDS
from sasgeo_bench.texts import message_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Lines:
    """Header of a table, and number and cells of each line below."""

    header: list[str]
    rows: Iterable[tuple[int, list[str]]]


def read_lines(source: LogSource) -> Lines:
    """Return the lines of a table that have any cells."""
    rows = _rows(source)
    _, header = next(rows, (0, []))
    while header and not header[-1].strip():
        header = header[:-1]
    first = next(rows, None)
    if first is None:
        return Lines(header=header, rows=())
    if _is_units(header, first[1]):
        cells = [*first[1], *[""] * len(header)]
        header = [
            f"{name} [{unit.strip(' []()')}]" if unit.strip() else name
            for name, unit in zip(header, cells, strict=False)
        ]
        first = next(rows, None)
    return Lines(header=header, rows=chain([first] if first else [], rows))


def _is_units(header: Sequence[str], cells: Sequence[str]) -> bool:
    """Return whether the cells below a header are units: one at least is, and none is a number."""
    units = {word for known in WORDS.values() for word in known}
    others = [cell for cell in cells if key_of(cell) not in units]
    return bool(header) and len(others) < len(cells) and not any(re.match(r"\s*[-+.]?\d", cell) for cell in others)


def _is_head(comment: Sequence[str], cells: Sequence[str]) -> bool:
    """Return whether a comment has the names of the cells below, as `numpy.savetxt` writes them."""
    starts = [re.match(r"\s*[-+.]?\d", cell) for cell in (*comment, *cells)]
    return len(comment) == len(cells) and not any(starts[: len(comment)]) and any(starts[len(comment) :])


def _rows(source: LogSource) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each line that has any; the first is the header."""
    source.check_size()
    line = 0
    try:
        with source.path.open(encoding="utf-8-sig", newline="") as file:
            head = next((text for text in file if text.strip() and not text.startswith("#")), "")
            separator = re.fullmatch(r'"?sep=(.)"?\s*', head, flags=re.IGNORECASE)
            if separator:
                head = next((text for text in file if text.strip()), "")
            file.seek(0)
            if source.path.suffix.lower() == ".pos" or re.match(r"%\s", head):
                yield from _position_rows(file)
                return
            delimiter = separator[1] if separator else max(",;\t", key=head.count)
            reader = csv.reader(file, delimiter=delimiter, strict=True, skipinitialspace=True)
            skip = separator is not None
            comment, is_begun = (0, [""]), False
            for row in reader:
                line = reader.line_num
                if not any(cell.strip() for cell in row):
                    continue
                if row[0].startswith("#"):
                    comment = (line, [row[0].lstrip("# "), *row[1:]])
                    continue
                if skip:
                    skip = False
                    continue
                if not is_begun and _is_head(comment[1], row):
                    yield comment
                is_begun = True
                yield line, row
    except (OSError, UnicodeDecodeError) as error:
        raise source.fault(f"no text in UTF-8 ({message_of(error)}): export it anew") from error
    except csv.Error as error:
        message = f"no sound CSV ({message_of(error)}): mend the line"
        raise source.fault(message, line + 1) from error


def _position_rows(lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a position file: the last line with "%" before the data has the names."""
    names: list[str] = []
    is_begun = False
    for number, text in enumerate(lines, start=1):
        if text.startswith("%"):
            names = names if is_begun else _words(text[1:])
        elif text.strip():
            if not is_begun:
                is_begun = True
                yield number - 1, names
            cells = _words(text)
            if len(cells) == len(names) + 1:  # date and time of day, or week and seconds of the week
                cells = [f"{cells[0]} {cells[1]}", *cells[2:]]
            yield number, cells


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")] if "," in text else text.split()
