# SPDX-License-Identifier: Apache-2.0
"""Queries and regions as figures and as tables of HTML."""

from dataclasses import replace
from io import BytesIO

import pytest
from matplotlib import image
from matplotlib.legend import Legend
from matplotlib.lines import Line2D

import sasgeo_bench as sgb
from sasgeo_bench.boards.cases import TRUE
from sasgeo_bench.core.errors import ConfigError


def first_of(tiny, track):
    at = next(at for at, query in enumerate(tiny.queries) if query.track == track)
    return tiny.queries[at], tiny.truths[at]


def titles(figure):
    return [chart.get_title(loc="left").partition(",")[0] for chart in figure.axes]


def lines_of_truth(chart):
    return [line for line in chart.findobj(Line2D) if line.get_color() == TRUE]


def test_the_truth_is_drawn_only_where_it_is_given(tiny):
    query, truth = first_of(tiny, "localization")
    without, given = (sgb.plot_query(query, tiny.region, one) for one in (None, truth))
    assert titles(without) == ["view", "map"]
    assert titles(given) == ["view", "map at the true place", "map"]
    assert len(lines_of_truth(given.axes[-1])) > len(lines_of_truth(without.axes[-1]))


def test_the_disc_of_the_prior_lies_on_the_map_around_its_middle(tiny):
    query, _ = first_of(tiny, "localization")
    figure = sgb.plot_query(query, tiny.region)
    (disc,) = [patch for patch in figure.axes[-1].patches if hasattr(patch, "get_radius")]
    assert disc.get_radius() == query.prior.radius_m


def test_every_candidate_of_a_retrieval_query_is_marked(tiny):
    query, truth = first_of(tiny, "retrieval")
    chart = sgb.plot_query(query, tiny.region, truth).axes[-1]
    (marks,) = [line for line in chart.lines if line.get_marker() == "x"]
    assert len(marks.get_xdata()) == len(query.candidates)


def test_a_map_or_a_truth_of_another_query_is_refused(tiny):
    query, truth = first_of(tiny, "localization")
    with pytest.raises(ConfigError, match="searches the map 'elsewhere'"):
        sgb.plot_query(replace(query, region="elsewhere"), tiny.region)
    with pytest.raises(ConfigError, match="the truth is of query 'another'"):
        sgb.plot_query(query, tiny.region, replace(truth, query_id="another"))


def test_a_notebook_shows_a_figure_without_pyplot(tiny):
    figure = sgb.plot_region(tiny.region)
    assert image.imread(BytesIO(figure._repr_png_()), format="png").shape[2] == 4
    assert sgb.plot_query(tiny.queries[0], tiny.region)._repr_png_().startswith(b"\x89PNG")


def test_texts_of_a_region_and_a_query_are_escaped_for_a_notebook(tiny):
    evil = "<script>alert(1)</script>"
    region = replace(tiny.region, manifest=tiny.region.manifest.model_copy(update={"title": evil, "attribution": evil}))
    query = replace(tiny.queries[0], query_id=evil, season=evil)
    for shown in (region._repr_html_(), query._repr_html_()):
        assert "<script" not in shown
        assert shown.count("&lt;script&gt;") == 2


def test_a_query_and_its_region_name_classes_alike_and_every_colour_has_a_name(tiny):
    query, truth = first_of(tiny, "localization")
    of_query, of_region = (
        {label.get_text() for one in figure.findobj(Legend) for label in one.get_texts()}
        for figure in (sgb.plot_query(query, tiny.region, truth), sgb.plot_region(tiny.region))
    )
    classes = {text.partition("  (")[0] for text in of_region if "  (" in text}
    assert {"major road", "building"} <= classes
    assert classes <= of_query
    assert {"none of these classes", "unknown"} <= of_query
