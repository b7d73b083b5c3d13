# SPDX-License-Identifier: Apache-2.0
"""The one kind of figure: its texts are data, and nothing in them is mathematics."""

from typing import Any

from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.text import Text

from sasgeo_bench.texts import plain, plain_lines


class PlainFigure(Figure):
    r"""A figure that shows each text letter by letter, dollar signs included, and writes no control characters.

    >>> figure = PlainFigure(figsize=(1, 1))
    >>> text = figure.text(0, 0, r"cost $\nosuchthing$")
    >>> figure.draw_without_rendering()
    >>> text.get_text(), text.get_parse_math()
    ('cost $\\nosuchthing$', False)
    """

    def draw(self, renderer: RendererBase) -> None:
        """Draw the figure with every text of it, ticks and legends included, as plain text."""
        for item in self.findobj(Text):
            if isinstance(item, Text):
                item.set_parse_math(False)
                item.set_text(plain_lines(item.get_text()))
        super().draw(renderer)

    def savefig(self, fname: Any, **options: Any) -> None:  # noqa: ANN401 - as the figure's own
        """Write the figure; each entry of its metadata is one line."""
        given = options.pop("metadata", None) or {}
        kept = {name: plain(value) if isinstance(value, str) else value for name, value in given.items()}
        super().savefig(fname, metadata=kept, **options)
