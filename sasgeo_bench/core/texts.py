# SPDX-License-Identifier: Apache-2.0
"""Escape untrusted text, one function for each format it is written to; bounds of numbers and texts in an answer.

Figures, the terminal and pages have their own: `canvas.py`, `cli/console.py`, `publishing/site.py`.
"""

import html
import json
import re
from collections.abc import Mapping
from typing import Any, Final

# Names of folders and keys: of methods, their versions, maps and tasks. None can begin a flag, a formula, a hidden file
# or a list.
NAME: Final = r"^[a-z0-9][a-z0-9_-]{0,59}$"
VERSION: Final = r"^[A-Za-z0-9][A-Za-z0-9._+-]{0,59}$"
FOLDER: Final = r"^[A-Za-z0-9][A-Za-z0-9+@._-]{0,199}$"

_NUMBER: Final = re.compile(r"[+-]?\d+(\.\d*)?([eE][+-]?\d+)?")
_FORMULA: Final = tuple("=+-@'\uff1d\uff0b\uff0d\uff20")  # wide forms too; the apostrophe, so that it can be removed
_PLAIN_NAME: Final = re.compile(r"[A-Za-z0-9@+./][A-Za-z0-9@+._/-]*")
_INLINE: Final = re.compile(  # marks of emphasis, code, tables, tags and mathematics; links
    r"[\\`*|~$]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])|\](?=[(\[:])|(?<=:)//|(?i:(?<=www)\.)|#(?=#*$)"
)
_BLOCK: Final = re.compile(r"\d{0,9}(?P<mark>[-+.)](?=\s|$)|#(?=#{0,5}(?:\s|$))|>|(?:[-=]\s*){3,}$|\[(?=[ xX]\]))")
_TEX: Final = {
    **{letter: rf"\{letter}" for letter in "_%&#${}"},
    "<": "$<$",
    ">": "$>$",
    "|": "$|$",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
    '"': r"{\char34}",  # some languages of LaTeX make it a command
    "†": r"$^\dagger$",
}
_LIGATURE: Final = re.compile(r"(?<=[-`'?!,])(?=[-`',])")
_NO_GLYPH: Final = frozenset("«»ÐÞðþĄąĐđĘęĦħĮįĸĿŀŉŊŋŦŧŲųſ")  # before it, which pdfTeX stops at as well


def plain(text: str) -> str:
    r"""Return one line of printable characters: breaks become spaces, controls and bidirectional marks "?".

    >>> plain("red: \x1b[31m\nnext \u202egpj.exe")
    'red: ?[31m next ?gpj.exe'
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else " " if letter.isspace() else "?" for letter in text)


def plain_lines(text: str) -> str:
    """Return lines of printable characters; only a line feed ends a line."""
    return "\n".join(map(plain, text.split("\n")))


def html_facts(title: str, facts: Mapping[str, object]) -> str:
    """Return a title and named facts as a table of HTML, all texts escaped: how a notebook shows a thing.

    >>> html_facts("town", {"map of": "<b>2025</b>"})
    '<table><caption>town</caption><tr><th>map of</th><td>&lt;b&gt;2025&lt;/b&gt;</td></tr></table>'
    """
    rows = "".join(f"<tr><th>{_html(name)}</th><td>{_html(value)}</td></tr>" for name, value in facts.items())
    return f"<table><caption>{_html(title)}</caption>{rows}</table>"


def _html(text: object) -> str:
    return html.escape(plain(str(text)))


def markdown(text: object) -> str:
    r"""Escape text within a line or a table cell of Markdown.

    >>> markdown("a|b <i> [x](https://x.org) success_25m")
    'a\\|b &lt;i> [x\\](https:\\//x.org) success_25m'
    """
    line = plain(str(text)).strip()
    return _INLINE.sub(lambda mark: f"\\{mark[0]}", line).replace("&", "&amp;").replace("<", "&lt;")


def markdown_item(text: object) -> str:
    r"""Escape text of a list item of Markdown, so that it begins no other block there.

    >>> markdown_item("1. first"), markdown_item("# second")
    ('1\\. first', '\\# second')
    """
    found = markdown(text)
    head = _BLOCK.match(found)
    at = 0 if head is None else head.start("mark")
    return found if head is None else f"{found[:at]}\\{found[at:]}"


def markdown_code(name: str) -> str:
    r"""Format a name as Markdown code; escape anything else as `markdown` does.

    >>> markdown_code("vaduz@2021-10-28"), markdown_code("a`b")
    ('`vaduz@2021-10-28`', 'a\\`b')
    """
    return f"`{name}`" if _PLAIN_NAME.fullmatch(name) else markdown(name)


def tex(text: object) -> str:
    r"""Escape text for LaTeX; letters without a glyph in pdfTeX become their code point, for it stops at them.

    >>> tex(r"100 % of a_b, \input{x}")
    '100 \\% of a\\_b, \\textbackslash{}input\\{x\\}'
    """
    letters = _LIGATURE.sub("\0", plain(str(text)))
    escaped = "".join("{}" if letter == "\0" else _tex_letter(letter) for letter in letters)
    # At the start of a row "[" and "*" would belong to the end of the previous one.
    return "{}" + escaped if escaped.startswith(("[", "*")) else escaped


def _tex_letter(letter: str) -> str:
    is_known = ord(letter) <= 0x17F and letter not in _NO_GLYPH  # the last of Latin Extended-A
    return _TEX.get(letter) or (letter if is_known else f"[U+{ord(letter):04X}]")


def csv_cell(value: object) -> object:
    """Return a cell that a spreadsheet reads as text: text that would begin a formula gets an apostrophe.

    >>> csv_cell("=1+1"), csv_cell("-0.5"), csv_cell(-0.5)
    ("'=1+1", '-0.5', -0.5)
    """
    if not isinstance(value, str):
        return value
    line = plain(value)
    is_formula = line.lstrip().startswith(_FORMULA) and not _NUMBER.fullmatch(line)
    return f"'{line}" if is_formula else line


def quoted(text: str) -> str:
    r"""Return text in double quotes as TOML and YAML read them.

    >>> quoted('a: "b"')
    '"a: \\"b\\""'
    """
    return json.dumps(plain(text), ensure_ascii=False)


def json_text(content: Any) -> str:  # noqa: ANN401 - whatever JSON can say
    r"""Return a JSON document of printable characters and line feeds, with the same data.

    >>> json_text({"name": "\x9b31m"})
    '{\n  "name": "\\u009b31m"\n}\n'
    """
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    if not text.replace("\n", "").isprintable():
        text = "".join(letter if letter.isprintable() or letter == "\n" else _json_letter(letter) for letter in text)
    return f"{text}\n"


def _json_letter(letter: str) -> str:
    """Escape a letter for JSON; half of a surrogate pair becomes "?", since readers refuse it."""
    return "?" if "\ud800" <= letter <= "\udfff" else json.dumps(letter)[1:-1]


MOST_CANDIDATES: Final = 1000  # of one answer
MOST_DIAGNOSTICS: Final = 64
MOST_NAME: Final = 64  # characters of the name of a diagnostic
MOST_MESSAGE: Final = 300  # characters
MOST_S: Final = 7 * 86_400.0  # of one answer: no run allows more
_MOST_M: Final = 1e8  # farther than any projected coordinate on Earth
_MOST_TURN_DEG: Final = 1e6  # far beyond it a number has too few digits for a heading
_MOST: Final = 3.4028234663852886e38  # largest single-precision number: squares and differences stay finite

# Least and most of each number; none may be NaN or infinite.
BOUNDS: Final[Mapping[str, tuple[float, float]]] = {
    "easting_m": (-_MOST_M, _MOST_M),
    "northing_m": (-_MOST_M, _MOST_M),
    "yaw_deg": (-_MOST_TURN_DEG, _MOST_TURN_DEG),
    "scale": (1e-3, 1e3),
    "score": (-_MOST, _MOST),
    "confidence": (0.0, 1.0),
    "diagnostics": (-_MOST, _MOST),
    "latency_s": (0.0, MOST_S),
    "matcher_s": (0.0, MOST_S),
}


def is_line(text: str, most: int) -> bool:
    """Return whether a text is one line of printable characters, at most `most` of them; it may be empty."""
    return len(text) <= most and text.isprintable()


def bounds_text(name: str) -> str:
    """Format the bounds of a number for an error."""
    least, most = BOUNDS[name]
    return f"{least:g}..{most:g}"


def one_line(text: str) -> str:
    """Return any text in one line of at most `MOST_MESSAGE` printable characters."""
    line = plain(" ".join(text.split()))
    return line if len(line) <= MOST_MESSAGE else line[: MOST_MESSAGE - 3] + "..."


def typed(value: object) -> str:
    """Return the name of the type of a value with its article.

    >>> typed(3), typed("3")
    ('an int', 'a str')
    """
    name = one_line(type(value).__name__)
    return f"{'an' if name[:1].lower() in 'aeiou' else 'a'} {name}"


def message_of(error: BaseException) -> str:
    """Return class and text of an error in one line; only the class if its text cannot be made.

    >>> message_of(ValueError("no index today"))
    'ValueError: no index today'
    """
    try:
        return one_line(f"{type(error).__name__}: {error}")
    except Exception:  # noqa: BLE001 - a plugin's own errors may fail at telling of themselves
        return type(error).__name__
