# ---
# jupyter:
#   # SPDX-License-Identifier: Apache-2.0
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A place, from file to features
#
# This notebook builds a place, looks at what is in it, and lets eleven years pass. It takes half a minute, and nothing
# is downloaded: the place is a synthetic town. A real one differs by two lines of its file.
#
# A *region* is what a matcher searches: layers, one for each class of thing that can be seen from above; the features
# they were burned from; and a graph of landmarks.

# %% [markdown]
# ## Build it
#
# A region is one file. This one asks for more ground than its extract holds, as often happens at a border, and has two
# dates. A real place has `sha256` and `urls` of an extract where this one has `town`.

# %%
from pathlib import Path

import geopandas as gpd
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import sasgeo_bench as sgb

Path("my-town.toml").write_text(
    """
id = "my-town"
title = "My town"
scenes = ["urban", "riverside"]
center_lonlat = [12.9, 48.2]
size_m = [1200, 1024]
cell_size_m = 1.0

[[extract]]
file = "my-town-2014.osm.pbf"
date = 2014-01-01
town = { morphology = "riverside", seed = 7, size_m = 1100.0 }

[[extract]]
file = "my-town-2025.osm.pbf"
date = 2025-01-01
town = { morphology = "riverside", seed = 7, size_m = 1100.0 }
""",
    encoding="utf-8",
)
(newest,) = sgb.build_region("my-town.toml")
(oldest,) = sgb.build_region("my-town.toml", date="2014-01-01")
town = sgb.read_region(newest)
town

# %%
sgb.plot_region(town)

# %% [markdown]
# The hatched strips are ground that the extract does not cover. They are not empty. A matcher that took them for empty
# would learn that roads end there, so each cell has three states: absent (0), present (1), and outside (255).

# %%
known = town.known()
print(f"{known.mean():.1%} of {known.size:,} cells are mapped; the file says {town.manifest.coverage.share:.1%}")
print(town.manifest.coverage.to_text())

# %% [markdown]
# ## Layers
#
# `layers` is an array of shape (class, row, column). Classes overlap: a bridge and the river below it hold in one cell.

# %%
shares = pd.Series({name: (town.layer(name)[known] == sgb.PRESENT).mean() for name in town.classes})
shares[shares > 0].sort_values(ascending=False).map("{:.2%}".format).to_frame("share of the mapped cells")

# %%
bridge, water = (town.layer(name) == sgb.PRESENT for name in ("bridge", "water"))
print(f"cells with a bridge: {bridge.sum()}, of these over water: {(bridge & water).sum()}")

# %% [markdown]
# A view is a piece of the map, turned and moved: `observe` cuts what a perfect detector would see from a pose. Here is
# what lies around the longest bridge, seen while flying north-east.

# %%
features = gpd.read_parquet(newest / "features.parquet")
longest = features.loc[features[features["class"] == "bridge"].length.idxmax(), "geometry"].centroid
pose = sgb.Pose(easting_m=longest.x, northing_m=longest.y, yaw_deg=45.0)
cells = sgb.observe(sgb.LayerBits.of(town.layers), town.grid, pose, size_cells=192, cell_size_m=1.0)
_, charts = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
for chart, name in zip(charts, ("road_minor", "building", "water", "bridge"), strict=True):
    chart.imshow(cells[town.classes.index(name)], cmap="Greys", vmin=0, vmax=2)
    chart.set(title=name, xticks=[], yticks=[])

# %% [markdown]
# ## Features
#
# `features.parquet` is GeoParquet: geopandas, QGIS or DuckDB read it without this package. Each row is an object of the
# map with its class; `osm_id` leads back to it.

# %%
sizes = features.assign(length_m=features.length, area_m2=features.area).groupby("class")
sizes.agg(objects=("class", "size"), length_m=("length_m", "sum"), area_m2=("area_m2", "sum")).round().astype(int)

# %%
buildings = features[features["class"] == "building"]
_, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
buildings.plot(column=buildings.area, ax=left, cmap="viridis", legend=True, legend_kwds={"label": "area (m2)"})
features[features["class"].isin(["road_major", "road_minor"])].plot(ax=left, color="#999999", linewidth=0.6)
left.set(title="buildings by area", xticks=[], yticks=[])
right.hist(np.sqrt(buildings.area), bins=30, color="#5f6b80")
_ = right.set(title="how large they are", xlabel="side of a square of that area (m)", ylabel="buildings")

# %% [markdown]
# ## Graph
#
# The graph holds what stays recognizable when a raster is blurred: junctions, crossings, bridges, buildings, and how
# they are connected.

# %%
nodes, edges = town.graph.nodes, town.graph.edges
print(nodes["kind"].value_counts().to_string(), "\n")
print(edges["relation"].value_counts().to_string())

# %%
_, chart = plt.subplots(figsize=(8, 6.5), layout="constrained")
at = nodes.geometry.get_coordinates().to_numpy()
ends = edges.loc[edges["relation"] == "connectivity", ["source", "target"]].to_numpy()
chart.plot(*at[ends].transpose(2, 1, 0), color="#bbbbbb", lw=0.8)
some = {
    "intersection": "#d55e00",
    "road_water_crossing": "#0072b2",
    "dead_end": "#555555",
    "building_cluster": "#009e73",
}
for kind, colour in some.items():
    chart.plot(*at[nodes["kind"] == kind].T, "o", ms=4, color=colour, label=kind)
chart.set(aspect="equal", xticks=[], yticks=[], title="landmarks, and what connects them")
_ = chart.legend()

# %% [markdown]
# ## Eleven years
#
# The same place, from the extract of 2014. How many of its buildings are gone? Ids are a poor guide: who draws a house
# anew gives it a new id. Ground is a better one: a house is still there if its middle lies in a house of today.

# %%
older = gpd.read_parquet(oldest / "features.parquet")
houses = older[older["class"] == "building"]
middles = houses.set_geometry(houses.centroid)[["osm_id", "geometry"]]
is_there = middles.index.isin(middles.sjoin(buildings[["geometry"]], predicate="within").index)
pd.DataFrame(
    {
        "by id": ~houses["osm_id"].isin(buildings["osm_id"]),
        "by ground": ~is_there,
    }
).mean().map("{:.0%}".format).to_frame(f"gone, of {len(houses)} buildings of 2014")

# %%
past = sgb.read_region(oldest)
was, now = (one.layer("building") == sgb.PRESENT for one in (past, town))
picture = np.full((*was.shape, 3), 1.0)
for mask, colour in ((was & now, (0.8, 0.8, 0.8)), (was & ~now, (0.08, 0.4, 0.75)), (now & ~was, (0.76, 0.1, 0.36))):
    picture[mask] = colour
_, chart = plt.subplots(figsize=(7, 6), layout="constrained")
chart.imshow(picture)
chart.set(title="buildings: grey in both years, blue gone, pink new", xticks=[], yticks=[])
print(f"of the built ground of 2014, {(was & ~now).sum() / was.sum():.0%} is no longer built")

# %% [markdown]
# A view of today on a map of 2014 disagrees in the coloured places. That is the stress of the suite `real-age`; what
# real places lose in a year is measured in [ageing](../ageing/README.md).
#
# ## Where to go on
#
# - [Add a region](../howto/region.md): a real place, by its extract.
# - [Reading a board](reading-a-board.py): who still finds the place on an old map.
