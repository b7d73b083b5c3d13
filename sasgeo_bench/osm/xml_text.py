# SPDX-License-Identifier: Apache-2.0
"""What OSM XML may hold besides the objects of a state: marks of editors, places inside members, several boxes."""

import bz2
import gzip
import mmap
import re
import zlib
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import IO, Final, cast
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from sasgeo_bench.core.paths import plain_file

Box = tuple[float, float, float, float]

NEW_IDS: Final = 2**40  # objects that have no id of OpenStreetMap yet are numbered from here, above all of its ids
_DESCRIBED_IDS: Final = 2 * NEW_IDS  # of places inside members, which have no node
_CHUNK: Final = 1 << 20
_OVERLAP: Final = 1 << 12  # no start tag of interest is longer
# What osmium passes over or refuses: objects deleted in an editor, and what Overpass adds.
_MARKS: Final = re.compile(rb"""\baction\s*=\s*["']delete|<(center|area|remark)\b|<member\b[^<>]*[^/<>]>\s*<nd\b""")
_STREAM: Final = re.compile(rb"BZh[1-9]1AY&SY")  # how the packed text of a stream of bzip2 begins
_OBJECT: Final = re.compile(rb"<(node|way|relation|changeset)\b")
_BOX: Final = re.compile(rb"<(bounds?)\s([^<>]*)>")
_VALUE: Final = re.compile(rb"""(\w+)\s*=\s*["']([^"']*)["']""")
_OBJECTS: Final = ("node", "way", "relation")
_PARTS: Final = {"node": ("tag",), "way": ("tag", "nd"), "relation": ("tag", "member")}


def open_text(path: Path) -> IO[bytes]:
    """Open an XML file, unpacked if it is packed by gzip or bzip2."""
    with plain_file(path).open("rb") as source:
        start = source.read(3)
    if start.startswith(b"\x1f\x8b"):
        return cast("IO[bytes]", gzip.open(plain_file(path), "rb"))
    return bz2.open(plain_file(path), "rb") if start == b"BZh" else plain_file(path).open("rb")


def chunks(path: Path) -> Iterator[bytes]:
    """Yield the text of a file in pieces; raise `RuntimeError` if it is packed and damaged."""
    try:
        with open_text(path) as source:
            while data := source.read(_CHUNK):
                yield data
    except (EOFError, OSError, zlib.error) as error:
        raise RuntimeError(str(error)) from error


def has_several_streams(path: Path) -> bool:
    """Return whether a file is packed by bzip2 in several streams, as pbzip2 does: osmium reads the first alone."""
    with plain_file(path).open("rb") as source, mmap.mmap(source.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content[:3] == b"BZh" and _STREAM.search(content, 1) is not None


def read_boxes(path: Path) -> tuple[Box, ...]:
    """Return the boxes (west, south, east, north) that stand before the first object; JOSM writes one per download.

    `<bound box="south,west,north,east">` is the older form, which Osmosis still writes.
    """
    head = b""
    for data in chunks(path):
        head += data
        if _OBJECT.search(data) or len(head) > 4 * _CHUNK:
            break
    before, *comments = head.split(b"<!--")
    head = before + b"".join(comment.partition(b"-->")[2] for comment in comments)
    first = _OBJECT.search(head)
    found = []
    for kind, text in _BOX.findall(head[: first.start()] if first else head):
        values = {name.decode(): value for name, value in _VALUE.findall(text)}
        if kind == b"bounds":
            sides = [values.get(name, b"") for name in ("minlat", "minlon", "maxlat", "maxlon")]
        else:
            sides = values.get("box", b"").split(b",")
        try:
            south, west, north, east = map(float, sides)
        except ValueError:
            continue
        if west < east and south < north:
            found.append((west, south, east, north))
    return tuple(found)


def needs_cleaning(path: Path) -> bool:
    """Return whether a text holds marks that osmium does not read as they are meant."""
    tail = b""
    for data in chunks(path):
        if _MARKS.search(tail + data):
            return True
        tail = data[-_OVERLAP:]
    return False


def clean(path: Path, target: Path) -> None:
    """Write the objects of a file alone: without those deleted in an editor, and with the ways that members describe.

    Overpass (`out geom`) writes the places of a member way inside the member; a way that does not stand in the file
    itself is made of them. Raise `RuntimeError` if the file is no XML, or Overpass remarks that it is not whole.
    """
    with target.open("w", encoding="utf-8") as out:
        _Cleaner(out).run(path)


class _Cleaner:
    """Copies objects with their tags, nodes and members; leaves out what was deleted."""

    def __init__(self, out: IO[str]) -> None:
        self._out = out
        self._open: list[str] = []
        self._is_deleted = False
        self._ways: set[str] = set()
        self._members: dict[str, list[tuple[str, str] | None]] = {}
        self._member: list[tuple[str, str] | None] | None = None

    def run(self, path: Path) -> None:
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler, parser.EndElementHandler = self._begin, self._end
        parser.EntityDeclHandler, parser.CharacterDataHandler = _refuse_entities, self._read_remark
        try:
            for data in chunks(path):
                parser.Parse(data, False)  # noqa: FBT003 - expat knows no keywords
            parser.Parse(b"", True)  # noqa: FBT003
        except expat.ExpatError as error:
            raise RuntimeError(str(error)) from error

    def _begin(self, name: str, values: dict[str, str]) -> None:
        self._open.append(name)
        depth = len(self._open)
        if depth == 1:
            self._out.write(f"<{name}{_attributes(values)}>\n")
        elif depth == 2 and name in _OBJECTS:  # below the root
            self._is_deleted = values.get("action") == "delete"
            if not self._is_deleted:
                self._out.write(f"<{name}{_attributes(values)}>")
                if name == "way":
                    self._ways.add(values.get("id", ""))
        elif self._is_deleted:
            return
        elif depth == 3 and name in _PARTS.get(self._open[1], ()):  # of an object
            self._out.write(f"<{name}{_attributes(values)}/>")
            is_way = name == "member" and values.get("type") == "way"
            self._member = self._members.setdefault(values.get("ref", ""), []) if is_way else None
            if self._member:
                self._member = None  # another relation has described this way already
        elif depth == 4 and name == "nd" and self._member is not None:  # of a member
            is_placed = "lat" in values and "lon" in values
            self._member.append((values["lat"], values["lon"]) if is_placed else None)

    def _end(self, name: str) -> None:
        self._open.pop()
        depth = len(self._open)
        if depth == 1 and name in _OBJECTS:
            if not self._is_deleted:
                self._out.write(f"</{name}>\n")
            self._is_deleted = False
        elif depth == 0:
            self._write_described()
            self._out.write(f"</{name}>\n")

    def _read_remark(self, text: str) -> None:
        # In a remark of Overpass: what came until then stands before it
        if self._open[-1:] == ["remark"] and any(word in text for word in ("error", "timed out")):
            raise RuntimeError(f"its last line says: {text.strip()}")

    def _write_described(self) -> None:
        """Write the ways that only members describe; a place is one node, and each that was cut off one of its own."""
        numbers: dict[tuple[str, str], int] = {}
        following = count(_DESCRIBED_IDS)
        for ref, places in self._members.items():
            if ref in self._ways or not any(places):
                continue
            nodes = []
            for place in places:
                number = numbers.setdefault(place, next(following)) if place else next(following)
                at = "" if place is None else f" lat={quoteattr(place[0])} lon={quoteattr(place[1])}"
                nodes.append(f'<nd ref="{number}"{at}/>')
            self._out.write(f"<way id={quoteattr(ref)}>{''.join(nodes)}</way>\n")


def _attributes(values: dict[str, str]) -> str:
    return "".join(f" {name}={quoteattr(value)}" for name, value in values.items())


def _refuse_entities(*_: object) -> None:
    raise RuntimeError("XML entities are not supported")
