# SPDX-License-Identifier: Apache-2.0
"""Six kinds of place: each draws streets, water, buildings and land on a sketch."""

from collections.abc import Callable
from itertools import pairwise
from typing import Final, Literal

import numpy as np
import shapely
from shapely import affinity

from sasgeo_bench.osm.synthetic.sketch import Area, Line, Sketch, curve, house, split_at, wobble

Morphology = Literal["grid", "old_town", "suburb", "industrial", "riverside", "agricultural"]


def draw(morphology: Morphology, sketch: Sketch) -> None:
    """Draw one kind of place on a sketch."""
    _DRAWINGS[morphology](sketch)


def _grid(sketch: Sketch) -> None:
    """Draw avenues and streets at right angles, perimeter blocks, a square, a railway below the avenues."""
    half, rng = sketch.half_m, sketch.rng
    rail_y = -0.62 * half
    _railway(sketch, [(-half, rail_y), (half, rail_y)], tunnel_from_m=1.55 * half)
    xs = np.arange(-half + 40, half, 96.0).round(1)
    ys = np.arange(-half + 60, half, 118.0).round(1)
    for number, x in enumerate(xs):
        is_avenue = number % 4 == 1
        tags = {"highway": "primary", "lanes": "4"} if is_avenue else {"highway": "residential"}
        if is_avenue:
            _bridged(sketch, np.array([(x, -half), (x, half)]), [(rail_y + half, 24.0)], **tags)
        else:
            sketch.street([(x, -half), (x, rail_y - 14)], **tags)
            sketch.street([(x, rail_y + 14), (x, half)], **tags)
    for number, y in enumerate(ys):
        if abs(y - rail_y) > 20:
            sketch.street([(-half, y), (half, y)], highway="secondary" if number % 3 == 0 else "residential")
    park = (
        shapely.box(xs[6] + 8, ys[5] + 8, xs[7] - 8, ys[6] - 8)
        if len(xs) > 7 and len(ys) > 6
        else shapely.box(9, 9, 70, 80)
    )
    pond = affinity.scale(park.centroid.buffer(14), 1.4, 0.8)
    sketch.ground(park.difference(pond), leisure="park")
    sketch.ground(pond, is_free=False, natural="water")
    sketch.keep_free(park)
    for west, east in pairwise(xs):
        for south, north in pairwise(ys):
            _city_block(sketch, shapely.box(west + 8, south + 8, east - 8, north - 8), rng)


def _city_block(sketch: Sketch, block: shapely.Polygon, rng: np.random.Generator) -> None:
    """Draw a block of a grid city: one perimeter building with a courtyard, a row of lots, or a car park."""
    kind = rng.random()
    if kind < 0.3:
        sketch.build(block.difference(block.buffer(-15, join_style="mitre")), building="apartments")
        return
    if kind < 0.4:
        if sketch.ground(block, amenity="parking"):
            sketch.keep_free(block)
        return
    west, south, east, north = block.bounds
    for x in np.arange(west, east - 10, 20.0):
        for y0, y1 in ((south, south + 24), (north - 24, north)):
            width = 18.5 if rng.random() < 0.7 else 14.0
            depth = rng.uniform(0, 6)
            sketch.build(
                shapely.box(x, y0 + (depth if y0 > south else 0), x + width, y1 - (depth if y0 == south else 0)),
                building="commercial",
            )
    sketch.ground(shapely.box(west + 10, south + 32, east - 10, north - 32), amenity="parking", parking="underground")


def _old_town(sketch: Sketch) -> None:
    """Draw crooked lanes within a wall, perimeter blocks with courtyards, a market square and a church."""
    half, rng = sketch.half_m, sketch.rng
    spokes = 16
    rings = [share * half for share in (0.14, 0.28, 0.42, 0.56, 0.7, 0.86)]
    angles = np.linspace(0, 2 * np.pi, spokes + 1)[:-1] + rng.uniform(-0.1, 0.1, spokes)
    spots = [
        [(r * np.cos(a), r * np.sin(a)) for a, r in zip(angles, radius * rng.uniform(0.92, 1.08, spokes), strict=True)]
        for radius in rings
    ]
    for ring, kind in zip(
        spots, ("pedestrian", "living_street", "residential", "residential", "residential", "secondary"), strict=True
    ):
        # Closed smooth line through corners: one turn of a longer curve, so that it closes without a kink
        line = curve([*ring[-2:], *ring, *ring[:3]])
        start, end = np.flatnonzero(np.hypot(*(line - ring[0]).T) < 0.02)[[0, -1]]
        sketch.street(np.vstack((line[start:end], line[start : start + 1])), highway=kind)
    for spoke in range(spokes):
        inner = [ring[spoke] for ring in spots[2 * (spoke % 2) :]]
        outwards = (1.19 * half * np.cos(angles[spoke]), 1.19 * half * np.sin(angles[spoke]))
        clipped = (float(np.clip(outwards[0], -half, half)), float(np.clip(outwards[1], -half, half)))
        tags = {"highway": "tertiary"} if spoke % 4 == 0 else {"highway": "residential"}
        sketch.street(wobble(curve([*inner, clipped], step_m=25.0), 2.5, rng), **tags)
    wall = affinity.scale(shapely.Point(0, 0).buffer(0.78 * half), 1.0, 1.0)
    sketch.line(shapely.get_coordinates(wall.exterior)[:52], barrier="city_wall")
    _market_square(sketch, 0.14 * half)
    streets = shapely.union_all([shapely.linestrings(way.line) for way in sketch.ways if "highway" in way.tags])
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.node(streets)).tolist()))
    for face in sorted(faces, key=lambda face: (round(face.centroid.x, 1), round(face.centroid.y, 1))):
        _perimeter_block(sketch, face.buffer(-6.5, join_style="mitre"))
    _park_ring(sketch, 0.93 * half)
    _stream(
        sketch,
        curve([(-half, -0.93 * half), (-0.3 * half, -0.9 * half), (0.4 * half, -0.96 * half), (half, -0.9 * half)]),
    )


def _market_square(sketch: Sketch, radius_m: float) -> None:
    nave = affinity.rotate(shapely.box(-0.3 * radius_m, -0.14 * radius_m, 0.3 * radius_m, 0.14 * radius_m), 20)
    choir = affinity.translate(
        shapely.Point(0, 0).buffer(0.14 * radius_m, quad_segs=4), 0.28 * radius_m, 0.1 * radius_m
    )
    sketch.ground(nave.union(choir), is_free=False, building="church")
    square = shapely.Point(0, 0).buffer(0.7 * radius_m, quad_segs=5)
    sketch.ground(square, is_free=False, highway="pedestrian", area="yes")
    sketch.keep_free(square)


def _perimeter_block(sketch: Sketch, block: shapely.Geometry) -> None:
    """Draw terraced houses around a courtyard, or one closed block with a courtyard."""
    rng = sketch.rng
    if block.geom_type != "Polygon" or block.area < 150:
        return
    court = block.buffer(-rng.uniform(11, 14), join_style="mitre")
    if court.geom_type != "Polygon" or court.area < 60:
        sketch.build(block, building="yes")
        return
    ring = block.difference(court)
    if rng.random() < 0.35:
        sketch.build(ring, building="apartments")
    else:
        _terrace(sketch, block, ring)
    sketch.ground(court.buffer(-2), is_free=False, leisure="garden")


def _terrace(sketch: Sketch, block: shapely.Polygon, ring: shapely.Polygon) -> None:
    """Cut a ring of buildings by party walls at right angles to the street: neighbours share their corners."""
    centre, edge = block.centroid, block.exterior
    cuts = []
    for along_m in np.arange(0, edge.length - 8, 16.0):
        point = edge.interpolate(along_m)
        cuts.append(
            shapely.LineString(
                [centre, affinity.scale(shapely.LineString([centre, point]), 2, 2, origin=centre).coords[1]]
            )
        )
    pieces = shapely.get_parts(
        shapely.polygonize(shapely.get_parts(shapely.node(shapely.union_all([*cuts, ring.boundary]))).tolist())
    )
    inside = [piece for piece in pieces if ring.contains(piece.representative_point()) and piece.area > 25]
    for piece in sorted(inside, key=lambda piece: (round(piece.centroid.x, 1), round(piece.centroid.y, 1))):
        if sketch.rng.random() < 0.92 and not sketch.is_taken(piece):
            sketch.ground(piece, building="house")


def _park_ring(sketch: Sketch, radius_m: float) -> None:
    for angle in np.linspace(0.3, 2 * np.pi, 7)[:-1]:
        spot = shapely.Point(radius_m * np.cos(angle), radius_m * np.sin(angle))
        sketch.ground(affinity.scale(spot.buffer(26, quad_segs=3), 1.6, 0.8), leisure="park")


def _suburb(sketch: Sketch) -> None:
    """Draw curving streets, cul-de-sacs, detached houses with gardens and hedges, a sports field and a pond."""
    half, rng = sketch.half_m, sketch.rng
    main = curve([(-half, -0.15 * half), (-0.4 * half, 0.12 * half), (0.15 * half, -0.1 * half), (half, 0.2 * half)])
    sketch.street(main, highway="secondary", width="7.5")
    through = shapely.linestrings(main)
    park = affinity.scale(shapely.Point(-0.12 * half, 0.62 * half).buffer(0.16 * half), 1.3, 0.8)
    pond = affinity.scale(park.centroid.buffer(0.05 * half), 1.5, 0.8)
    sketch.ground(park.difference(pond), leisure="park")
    sketch.ground(pond, is_free=False, natural="water")
    sketch.keep_free(park.buffer(3))
    pitch = affinity.rotate(shapely.box(0.55 * half, -0.75 * half, 0.55 * half + 100, -0.75 * half + 64), 12)
    sketch.ground(pitch, leisure="pitch")
    sketch.keep_free(pitch.buffer(4))
    streets = [main]
    for share in np.arange(0.06, 0.98, 0.105):
        for side in (-1, 1):
            start = through.interpolate(float(share + rng.uniform(-0.02, 0.02)), normalized=True)
            reach = rng.uniform(0.55, 0.85) * half * side
            bend = rng.uniform(-0.1, 0.1) * half
            ends = [
                (start.x, start.y),
                (start.x + bend, start.y + 0.35 * reach),
                (start.x - bend, start.y + 0.7 * reach),
                (start.x + bend / 2, start.y + reach),
            ]
            line = curve([(float(np.clip(x, -half, half)), float(np.clip(y, -half, half))) for x, y in ends])
            if shapely.linestrings(line).intersects(park.buffer(8)) or shapely.linestrings(line).intersects(
                pitch.buffer(8)
            ):
                continue
            sketch.street(line, highway="residential")
            streets.append(line)
            stub = shapely.linestrings(line).interpolate(0.55, normalized=True)
            spur = curve([(stub.x, stub.y), (stub.x + 38, stub.y + 8 * side), (stub.x + 62, stub.y + 14 * side)])
            sketch.street(spur, highway="living_street")
            streets.append(spur)
    sketch.street(curve([(-half, 0.8 * half), (-0.3 * half, 0.86 * half), (half, 0.76 * half)]), highway="footway")
    for line in streets:
        sketch.houses_along(line, spacing_m=23.0, setback_m=9.0, size_m=(12.5, 10.0), kind="house")
        sketch.houses_along(line, spacing_m=31.0, setback_m=30.0, size_m=(6.0, 4.5), kind="garage", chance=0.45)
    _hedges_between(sketch, 14.0)
    _school(sketch, (0.7 * half, -0.45 * half))


def _hedges_between(sketch: Sketch, reach_m: float) -> None:
    houses = [way for way in sketch.ways if way.tags.get("building") == "house"]
    for way in houses[::5]:
        box = shapely.Polygon(way.line).minimum_rotated_rectangle
        corners = shapely.get_coordinates(affinity.scale(box, 1 + reach_m / 12, 1 + reach_m / 14))
        hedge = shapely.LineString(corners[:3])
        if not sketch.is_taken(hedge):
            sketch.line(corners[:3], barrier="hedge")


def _school(sketch: Sketch, centre: tuple[float, float]) -> None:
    """Draw a building relation: an outline without tags of its own, and its parts."""
    x, y = centre
    wing = shapely.union_all([shapely.box(x, y, x + 60, y + 16), shapely.box(x, y, x + 16, y + 46)])
    if not sketch.is_taken(wing):
        building_relation = Area(
            outer=shapely.get_coordinates(wing.exterior), inner=(), tags={"building": "school"}, kind="building"
        )
        sketch.areas.append(building_relation)
        sketch.keep_free(wing)


def _industrial(sketch: Sketch) -> None:
    """Draw halls, sidings, car parks, a canal and wide roads."""
    half, rng = sketch.half_m, sketch.rng
    canal = curve([(-half, 0.72 * half), (0.0, 0.76 * half), (half, 0.7 * half)])
    sketch.line(canal, waterway="canal", width="22")
    basin = shapely.linestrings(canal).buffer(11, cap_style="flat")
    sketch.ground(basin, is_free=False, natural="water", water="canal")
    sketch.keep_free(basin.buffer(5))
    rail = [(-half, -0.08 * half), (half, 0.02 * half)]
    _railway(sketch, rail, tunnel_from_m=None)
    for offset in (12.0, 24.0):
        ends = [(-0.7 * half, -0.05 * half), (-0.55 * half, -0.05 * half + offset), (0.5 * half, offset)]
        siding = curve([*ends, (0.8 * half, 0.012 * half)], step_m=30)
        sketch.line(siding, railway="rail", service="siding")
    sketch.keep_free(shapely.linestrings(rail).buffer(34))
    through = shapely.linestrings([(-half, -0.42 * half), (half, -0.42 * half + 10)])
    for number, x in enumerate(np.linspace(-0.85, 0.85, 6) * half):
        line = np.array([(x, -half), (x + 20, half)])
        if number % 2 == 0:
            path = shapely.linestrings(line)
            over_canal = float(path.project(path.intersection(shapely.linestrings(canal))))
            over_road = float(path.project(path.intersection(through)))
            # The last one meets the road through the estate at grade, the others pass over it.
            spans = [(over_road, 28.0)] if number < 4 else []
            _bridged(sketch, line, [*spans, (over_canal, 36.0)], highway="secondary", lanes="2")
        else:
            sketch.street([(x, -half), (x + 16, 0.62 * half)], highway="service", width="6")
    for y in (-0.75, -0.42, 0.32, 0.58):
        sketch.street([(-half, y * half), (half, y * half + 10)], highway="tertiary" if y == -0.42 else "unclassified")
    for _ in range(260):
        centre = (float(rng.uniform(-half, half)), float(rng.uniform(-half, half)))
        width, depth = rng.uniform(24, 90), rng.uniform(18, 60)
        hall = affinity.rotate(shapely.box(-width / 2, -depth / 2, width / 2, depth / 2), float(rng.choice([0.0, 1.5])))
        hall = affinity.translate(hall, *centre)
        if rng.random() < 0.22:
            if not sketch.is_taken(hall) and sketch.ground(hall, amenity="parking"):
                sketch.keep_free(hall.buffer(4))
        elif not sketch.is_taken(hall.buffer(6)) and sketch.build(hall, building="industrial"):
            sketch.keep_free(hall.buffer(5))
    for _ in range(90):
        centre = (float(rng.uniform(-half, half)), float(rng.uniform(-half, half)))
        sketch.build(house(centre, 14.0, 10.0, 0.0, rng), building="warehouse")
    fence = shapely.box(-0.84 * half, -0.72 * half, -0.5 * half, -0.45 * half)
    sketch.line(shapely.get_coordinates(fence.exterior), barrier="fence")


def _riverside(sketch: Sketch) -> None:
    """Draw a meandering river with an island and bridges, streets on both banks, a railway into a tunnel."""
    half, rng = sketch.half_m, sketch.rng
    river = curve(half * np.array([(-1.3, -0.35), (-0.75, 0.1), (-0.1, -0.12), (0.45, 0.18), (1.3, -0.1)]))
    bed = shapely.linestrings(river).buffer(0.085 * half, cap_style="flat")
    island = affinity.rotate(
        affinity.scale(shapely.Point(-0.42 * half, 0.012 * half).buffer(0.032 * half), 2.6, 0.9), -14
    )
    sketch.line(river, waterway="river", name="Town river")
    sketch.ground(bed.difference(island), is_free=False, natural="water", water="river")
    sketch.ground(island, is_free=False, natural="wood")
    sketch.keep_free(bed.buffer(4))
    for side, kind in ((0.145, "tertiary"), (-0.145, "residential")):
        bank = shapely.linestrings(river).offset_curve(side * half)
        line = shapely.get_coordinates(bank.simplify(1.0)).round(2)
        line = line[(np.abs(line) < half + 60).all(axis=1)]
        sketch.street(line, highway=kind)
        sketch.houses_along(line, spacing_m=19.0, setback_m=9.0, size_m=(14.0, 12.0), kind="apartments")
    for number, x in enumerate(np.linspace(-0.88, 0.88, 9) * half):
        line = wobble(np.array([(x, y) for y in np.linspace(-half, half, 9)]), 5.0, rng).round(2)
        across = shapely.linestrings(line).intersection(bed)
        middle = float(shapely.linestrings(line).project(across.centroid))
        tags = {"highway": "primary" if number == 4 else "residential"}
        if number in (1, 4, 7):
            _bridged(sketch, line, [(middle, across.length + 16.0)], **tags)
        else:
            gap = across.length + 0.13 * half
            before, _, after = split_at(line, middle - gap / 2, middle + gap / 2)
            sketch.street(before, **tags)
            sketch.street(after, **tags)
    for y in (-0.92, -0.7, -0.5, 0.45, 0.66, 0.88):
        line = curve(
            [(-half, y * half), (-0.3 * half, (y + 0.03) * half), (0.3 * half, (y - 0.03) * half), (half, y * half)]
        )
        sketch.street(line, highway="residential" if abs(y) < 0.8 else "tertiary")
        sketch.houses_along(line, spacing_m=21.0, setback_m=8.0, size_m=(14.0, 11.0), kind="residential")
    for way in [way for way in sketch.ways if way.tags.get("highway") == "residential" and len(way.line) < 9]:
        sketch.houses_along(way.line, spacing_m=24.0, setback_m=8.0, size_m=(13.0, 11.0))
    _railway(sketch, [(-half, 0.56 * half), (0.2 * half, 0.57 * half), (half, 0.55 * half)], tunnel_from_m=1.45 * half)
    sketch.line(shapely.get_coordinates(shapely.linestrings(river).offset_curve(0.1 * half)), barrier="retaining_wall")


def _agricultural(sketch: Sketch) -> None:
    """Draw parcels that share their borders, hedges, tracks, a stream, a wood with a clearing, farmsteads, a road."""
    half, rng = sketch.half_m, sketch.rng
    road = curve([(-half, -0.3 * half), (-0.2 * half, -0.2 * half), (0.3 * half, -0.34 * half), (half, -0.22 * half)])
    sketch.street(road, highway="tertiary")
    sketch.street(
        curve([(0.1 * half, -0.28 * half), (0.16 * half, 0.2 * half), (0.05 * half, half)]), highway="unclassified"
    )
    stream = curve([(-0.7 * half, half), (-0.5 * half, 0.4 * half), (-0.62 * half, 0.0), (-0.4 * half, -half)])
    stream = wobble(stream, 1.5, rng)
    _stream(sketch, stream)
    wood = affinity.scale(shapely.Point(0.62 * half, 0.55 * half).buffer(0.27 * half, quad_segs=6), 1.0, 1.1)
    clearing = shapely.Point(0.58 * half, 0.5 * half).buffer(0.07 * half, quad_segs=4)
    sketch.ground(wood.difference(clearing), is_free=False, landuse="forest")
    sketch.ground(clearing, is_free=False, landuse="meadow")
    for centre in (
        (-0.15 * half, -0.12 * half),
        (0.4 * half, -0.2 * half),
        (-0.75 * half, -0.42 * half),
        (0.2 * half, 0.6 * half),
    ):
        _farmstead(sketch, centre)
    cuts = [shapely.linestrings(way.line) for way in sketch.ways if "highway" in way.tags or "waterway" in way.tags]
    across = [
        shapely.linestrings(wobble(np.array([(x, t) for t in np.linspace(-half, half, 6)]), 14.0, rng))
        for x in np.linspace(-0.8, 0.8, 6) * half
    ]
    along = [
        shapely.linestrings(wobble(np.array([(t, y) for t in np.linspace(-half, half, 6)]), 14.0, rng))
        for y in np.linspace(-0.85, 0.85, 7) * half
    ]
    frame = shapely.box(-half, -half, half, half)
    lines = shapely.node(shapely.union_all([*cuts, *across, *along, frame.boundary, wood.boundary]))
    fields = [
        field for field in shapely.get_parts(shapely.polygonize(shapely.get_parts(lines).tolist())) if field.area > 900
    ]
    farms = shapely.union_all([shape for shape in sketch.taken if shape.area > 2500])
    for field in sorted(fields, key=lambda field: (round(field.centroid.x, 1), round(field.centroid.y, 1))):
        if not wood.contains(field.representative_point()) and not farms.intersects(field.representative_point()):
            kind = str(rng.choice(["farmland"] * 2 + ["meadow", "orchard", "vineyard"]))
            sketch.ground(field, is_free=False, landuse=kind)
    for number, line in enumerate([*across, *along]):
        cut = shapely.get_coordinates(line)
        if number % 3 == 0:
            sketch.line(cut, highway="track")
        elif number % 3 == 1:
            sketch.line(cut[:4], barrier="hedge")
    sketch.line([(-0.9 * half, 0.3 * half), (-0.7 * half, 0.32 * half), (-0.6 * half, 0.4 * half)], natural="tree_row")


def _farmstead(sketch: Sketch, centre: tuple[float, float]) -> None:
    """Draw a dwelling, two barns around a yard, a wall and a garden."""
    x, y = centre
    turn = float(sketch.rng.uniform(0, np.pi))
    yard = affinity.rotate(shapely.box(x - 30, y - 26, x + 30, y + 26), turn, use_radians=True)
    for dx, dy, width, depth, kind in ((-18, 12, 16, 12, "farm"), (14, 10, 30, 14, "barn"), (-8, -16, 34, 12, "barn")):
        barn = affinity.rotate(
            shapely.box(x + dx - width / 2, y + dy - depth / 2, x + dx + width / 2, y + dy + depth / 2),
            turn,
            origin=centre,
            use_radians=True,
        )
        sketch.build(barn, building=kind)
    sketch.line(shapely.get_coordinates(yard.exterior)[:4], barrier="wall")
    sketch.keep_free(yard)


def _stream(sketch: Sketch, line: Line) -> None:
    """Draw a stream, in a culvert where it passes below a street."""
    base = shapely.linestrings(line)
    hits = [base.intersection(shapely.linestrings(way.line)) for way in sketch.ways if "highway" in way.tags]
    spots = sorted(float(base.project(point)) for hit in hits for point in shapely.get_parts(hit) if not hit.is_empty)
    rest, offset = line, 0.0
    for spot in spots:
        here = spot - offset
        if here < 12 or here + 12 > shapely.linestrings(rest).length:
            continue
        before, culvert, rest = split_at(rest, here - 6, here + 6)
        sketch.line(before, waterway="stream")
        sketch.line(culvert, waterway="stream", tunnel="culvert", layer="-1")
        offset += here + 6
    sketch.line(rest, waterway="stream", width="2")


def _railway(sketch: Sketch, points: list[tuple[float, float]], *, tunnel_from_m: float | None) -> None:
    line = curve(points, step_m=40.0)
    sketch.keep_free(shapely.linestrings(line).buffer(8))
    if tunnel_from_m is None or tunnel_from_m > shapely.linestrings(line).length - 30:
        sketch.line(line, railway="rail", gauge="1435")
        return
    length = shapely.linestrings(line).length
    open_air, tunnel, rest = split_at(line, tunnel_from_m, length - 20)
    sketch.line(open_air, railway="rail", gauge="1435")
    sketch.line(tunnel, railway="rail", gauge="1435", tunnel="yes", layer="-1")
    sketch.line(rest, railway="rail", gauge="1435")


def _bridged(sketch: Sketch, line: Line, spans: list[tuple[float, float]], **tags: str) -> None:
    """Draw a street with bridges, each given by its middle along the line and its length, metres, in this order."""
    rest, passed_m = line, 0.0
    for along_m, span_m in spans:
        before, bridge, rest = split_at(rest, along_m - passed_m - span_m / 2, along_m - passed_m + span_m / 2)
        passed_m = along_m + span_m / 2
        sketch.street(before, **tags)
        sketch.street(bridge, bridge="yes", layer="1", **tags)
    sketch.street(rest, **tags)


_DRAWINGS: Final[dict[Morphology, Callable[[Sketch], None]]] = {
    "grid": _grid,
    "old_town": _old_town,
    "suburb": _suburb,
    "industrial": _industrial,
    "riverside": _riverside,
    "agricultural": _agricultural,
}
