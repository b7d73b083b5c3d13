# SPDX-License-Identifier: Apache-2.0
"""Figures of a board that anybody may have made: SVG that draws, and neither acts nor fetches."""

import re
from typing import Final
from xml.etree import ElementTree as ET

_TAGS: Final = frozenset(  # of SVG: what shapes and texts are made of
    {
        *("svg", "g", "defs", "title", "desc", "metadata", "style", "path", "use", "rect", "circle", "ellipse", "line"),
        *("polyline", "polygon", "text", "tspan", "image", "symbol", "marker", "clipPath", "mask", "pattern"),
        *("linearGradient", "radialGradient", "stop"),
    }
)
_SVG: Final = "{http://www.w3.org/2000/svg}"
_INERT: Final = f"{_SVG}metadata"  # says whose data it is, in words of other vocabularies; nobody follows its links
_ENTITY: Final = re.compile(
    r"<!(ENTITY|ATTLIST|ELEMENT)|<!DOCTYPE[^>]*\[|<\?xml-stylesheet|<\?xml[^>]*encoding\s*=\s*(?![\"']utf-8[\"'])",
    re.IGNORECASE,
)
_ACTS: Final = re.compile(r"javascript:|@import|expression\(|url\(\s*['\"]?(?!#)", re.IGNORECASE)
_WITHIN: Final = re.compile(r"#|data:image/(png|jpeg|webp);base64,")


def svg_fault(text: str) -> str | None:
    """Return what an SVG holds that a figure does not need: scripts, event handlers, links; None if nothing.

    Raises
    ------
    ValueError
        If it is no XML.

    Examples
    --------
    >>> svg_fault('<svg xmlns="http://www.w3.org/2000/svg"><path d="M 0 0"/></svg>')
    >>> svg_fault('<svg xmlns="http://www.w3.org/2000/svg" onload="alert(1)"/>')
    'an attribute onload'
    """
    found = _ENTITY.search(text)
    if found:
        return f"a declaration {found[0]!r}"
    try:
        root = ET.fromstring(text)  # noqa: S314 - what could grow without end is refused above
    except ET.ParseError as error:
        message = f"it is no XML: {error}"
        raise ValueError(message) from error
    inert = {id(item) for told in root.iter(_INERT) for item in told.iter()}
    drawn = (item for item in root.iter() if id(item) not in inert or item.tag == _INERT)
    return next((fault for item in drawn if (fault := _fault_of(item))), None)


def _fault_of(item: ET.Element) -> str | None:
    if not isinstance(item.tag, str) or not item.tag.startswith(_SVG) or item.tag.removeprefix(_SVG) not in _TAGS:
        return f"an element {str(item.tag).removeprefix(_SVG)[:60]!r}"
    for name, value in item.attrib.items():
        short = name.rpartition("}")[2].lower()
        if short.startswith("on"):
            return f"an attribute {short[:60]}"
        if (short in {"href", "src", "base"} and not _WITHIN.match(value.strip())) or _ACTS.search(value):
            return f"a link {value[:60]!r}"
    if item.tag == f"{_SVG}style" and (found := _ACTS.search(item.text or "")):
        return f"a style with {found[0]!r}"
    return None
