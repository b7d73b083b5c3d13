# SPDX-License-Identifier: Apache-2.0
"""Queries and regions as figures and as tables of HTML."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from matplotlib import image
from matplotlib.colors import to_rgb
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


def test_each_is_drawn_in_one_call(tiny):
    query, truth = first_of(tiny, "localization")
    assert titles(query.plot(tiny.region)) == titles(sgb.plot_query(query, tiny.region))
    assert titles(query.plot(tiny.region, truth)) == titles(sgb.plot_query(query, tiny.region, truth))
    drawn, expected = tiny.region.plot(), sgb.plot_region(tiny.region)
    assert [text.get_text() for text in drawn.texts] == [text.get_text() for text in expected.texts]
    assert (drawn.axes[0].images[0].get_array() == expected.axes[0].images[0].get_array()).all()


def test_evidence_is_drawn_in_the_colours_of_its_classes_with_its_confidence_beside_it():
    chance = np.full((2, 10, 20), 0.1)
    chance[0, :5], chance[1, :, :4] = 0.9, 0.6
    chance[:, 9] = np.nan
    seen = sgb.Evidence.of_probabilities(("building", "water"), chance, cell_size_m=2.0)
    figure = sgb.plot_evidence(seen, title="seen", data="a drone")
    view, confidence = figure.axes
    colours = view.images[0].get_array()
    taxonomy = sgb.load_taxonomy()
    assert tuple(colours[0, 10]) == pytest.approx(to_rgb(taxonomy["building"].colour))
    assert tuple(colours[7, 0]) == pytest.approx(to_rgb(taxonomy["water"].colour))
    shown = confidence.images[0].get_array()
    assert shown.mask[9].all()
    assert not shown.mask[:9].any()
    assert shown[0, 10] == pytest.approx((0.8 + 0.8) / 2, abs=0.01)
    assert shown[7, 0] == pytest.approx((0.8 + 0.2) / 2, abs=0.01)
    assert view.images[0].get_extent() == [0, 40, 0, 20]
    texts = {text.get_text() for legend in figure.findobj(Legend) for text in legend.get_texts()}
    assert texts == {"building", "water", "none of these classes", "unknown"}
    certain = sgb.Evidence(classes=("water",), cells=np.zeros((1, 4, 4), dtype=np.uint8), cell_size_m=1.0)
    assert len(sgb.plot_evidence(certain).axes) == 1
    again = seen.plot(title="seen", data="a drone")
    assert [text.get_text() for text in again.texts] == [text.get_text() for text in figure.texts]
    with pytest.raises(ConfigError, match="expected a Evidence"):
        sgb.plot_evidence(chance)


def test_a_flight_is_drawn_where_it_was_flown_with_its_height_and_speed(tiny):
    west, south, _, _ = tiny.region.manifest.bounds_m
    places = np.array([[west + 10, south + 20, 80.0], [west + 40, south + 60, 90.0], [west + 40, south + 160, 90.0]])
    flown = sgb.Trajectory.of_angles(time_s=[0.0, 10.0, 20.0], position_m=places, yaw_deg=np.zeros(3))
    chart, height, speed = flown.plot(tiny.region).axes
    drawn = np.column_stack(chart.lines[1].get_data())
    np.testing.assert_allclose(np.diff(drawn, axis=0), np.diff(places[:, :2], axis=0))
    # below it the map: the corner of the panel is that of the region, for the flight begins near it
    np.testing.assert_allclose(drawn[0], [10, 20], atol=tiny.region.manifest.cell_size_m)
    assert height.lines[0].get_ydata().tolist() == [80, 90, 90]
    assert speed.lines[0].get_ydata().tolist() == [5, 10]
    far = sgb.Trajectory.of_angles(time_s=[0.0, 1.0], position_m=places[:2] + 1e5, yaw_deg=np.zeros(2))
    with pytest.raises(ConfigError, match="the flight lies beside the map"):
        far.plot(tiny.region)


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
