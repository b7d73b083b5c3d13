# SPDX-License-Identifier: Apache-2.0
"""Docstrings as pages show them: an example without a heading gets one, or it would be read as a quotation."""

import re
from typing import Any, Final

import griffe

_BARE: Final = re.compile(r"(?<=\n\n)(?=>>> )")


class Examples(griffe.Extension):
    """Put the heading of numpydoc above examples that have none."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:  # noqa: ANN401 - whatever griffe hands over
        """Change the docstring of one object."""
        if obj.docstring and "\nExamples\n" not in obj.docstring.value:
            obj.docstring.value = _BARE.sub("Examples\n--------\n", obj.docstring.value, count=1)
