# SPDX-License-Identifier: Apache-2.0
"""What the columns of queries, truths and map tables mean, in the words that stand in every release."""

from typing import Final

QUERY_TEXTS: Final = {
    "query_id": "name of the query; a hash that says nothing about the answer",
    "track": "retrieval (rank the candidates) or localization (find the pose)",
    "suite": "what is done to the view, and against which control",
    "suite_version": "version of the suite",
    "part": "train, calibration or test; crossfit where every place is test once, in the fold that leaves it out",
    "region": "the map to search: a folder of regions/; no other map may be used to answer",
    "cell_size_m": "side of a cell of the view on the ground, metres, at scale 1",
    "rows": "cells of the view from top to bottom",
    "cols": "cells of the view from left to right",
    "classes": "names of the classes, in the order of the evidence",
    "evidence": "two bits a cell, four cells to a byte, the first in the lowest bits: 0 absent, 1 present, 2 unknown; "
    "class by class, row by row, top row first; the top of the view is the heading",
    "confidence": "one byte a cell, 0 to 255, in the order of the evidence; null where nothing is said",
    "observed_on": "day of the view",
    "season": "leaf_on, snow, low_water, harvest, or empty where nothing is said",
    "prior_group": "how much is known before, by name; results of two groups are never ranked together",
    "prior_easting_m": "middle of the disc that holds the place, metres in the CRS of the map; null where unknown",
    "prior_northing_m": "middle of the disc that holds the place, metres in the CRS of the map; null where unknown",
    "prior_radius_m": "radius of the disc, metres; null where nothing is known of the place",
    "prior_yaw_deg": "noisy heading, degrees clockwise from grid north; null where unknown",
    "prior_yaw_sigma_deg": "standard deviation of that heading, degrees; null where unknown",
    "prior_scale_sigma": "standard deviation of the view's scale around 1",
    "candidates": "retrieval: the poses to rank; empty for localization",
    "vectors": "perceived lines and outlines: class, level, is_bridge, and WKB in metres right and up from the middle "
    "of the view; null in most suites",
    "sequence_id": "sequence of the view; null in every suite of today",
    "frame": "number within the sequence; null in every suite of today",
    "increment": "motion since the frame before; null in every suite of today",
    "increment_covariance": "covariance of that motion; null in every suite of today",
    "image": "a picture; null in every suite of today",
    "asked_sha256": "hash of the row and its map: an answer says which query it answers by it",
}
TRUTH_TEXTS: Final = {
    "query_id": "of the query",
    "is_present": "false where the place is not in the disc, not among the candidates, or not on the map",
    "easting_m": "where the view was taken, metres in the CRS of the map; null where it was not taken on this map",
    "northing_m": "where the view was taken, metres in the CRS of the map; null where it was not taken on this map",
    "yaw_deg": "heading of the view, degrees clockwise from grid north",
    "scale": "scale of the view: metres on the ground by cell_size_m",
    "candidate": "number of the right candidate, from 0; -1 for localization, or where it is absent",
    "pair_id": "shared by all queries of one site: a control and its stresses",
    "role": "control, stress or falsifier",
    "kind": "part of the suite",
    "strength": "step of the suite's ladder, in strength_unit; 0 for controls",
    "strength_unit": "unit of the strength",
    "unknown_share": "share of unknown cells",
    "changed_share": "of what view or map show, the share that only one of them does; in real-age mostly mapping",
    "feature_density": "share of the place's map with a road, building or other drawn thing",
    "alias_index": "likeness of the likest other place, 0 to 1; null where the view was not taken at the site",
    "block": "evaluation block, region/row-column; resample by it, never by single queries",
    "scene": "tags of the region",
    "measured": "what was measured to have been done, name and value",
}
FEATURE_TEXTS: Final = {
    "osm_type": "node, way or relation; coastline for sea, which is no object but lies right of the coastlines",
    "osm_id": "id of the object in OpenStreetMap",
    "version": "version of the object",
    "timestamp": "when that version was made",
    "class": "semantic class",
    "level": "layer above or below ground",
    "is_bridge": "whether it is a bridge",
    "is_tunnel": "whether it is a tunnel",
    "geometry": "WKB, metres in the CRS of the map",
}


def shown(texts: dict[str, str]) -> str:
    """Return a table of columns in Markdown.

    Examples
    --------
    >>> print(shown({"a": "first"}))
    | Column | What |
    |---|---|
    | `a` | first |
    """
    return "\n".join(("| Column | What |", "|---|---|", *(f"| `{name}` | {text} |" for name, text in texts.items())))
