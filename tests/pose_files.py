# SPDX-License-Identifier: Apache-2.0
"""Three cameras with three different angles each, and what each format makes of them, by plain numpy."""

import json
import math
import struct

import numpy as np
import pyproj

NAMES = ("DJI 0001.JPG", "DJI 0002.JPG", "b/DJI_0003.JPG")
ANGLES = ((37.0, -63.0, 11.0), (200.0, -81.0, -7.0), (311.0, -90.0, 0.0))  # yaw, pitch, roll of the optical axis
ORIGIN = (115.46, -8.29, 120.0)
SHIFTS = np.array([[10.0, 20.0, 80.0], [-150.0, 40.0, 95.5], [300.0, -210.0, 60.25]])  # east, north, up of the origin
UTM = 32750
WIDTH, HEIGHT, FOCAL = 4000, 3000, 2900.0

A_M, E2 = 6378137.0, 0.00669437999014


def about(axis, deg):
    """A turn about x, y or z, by the right hand."""
    c, s = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    one, two = [i for i in range(3) if i != axis]
    matrix = np.eye(3)
    matrix[one, one] = matrix[two, two] = c
    matrix[one, two], matrix[two, one] = (-s, s) if axis != 1 else (s, -s)
    return matrix


def body(yaw, pitch, roll):
    """From forward, right, down to north, east, down."""
    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def camera(yaw, pitch, roll):
    """Rows: right, down, ahead of a camera in east, north, up."""
    forward, right, down = body(yaw, pitch, roll).T
    return np.array([[one[1], one[0], -one[2]] for one in (right, down, forward)])


def of_ecef(lon, lat):
    """Rows: east, north, up of a place in earth-centred axes."""
    east = np.array([-math.sin(math.radians(lon)), math.cos(math.radians(lon)), 0.0])
    up = np.array([math.cos(math.radians(lat)) * east[1], -math.cos(math.radians(lat)) * east[0], 0.0])
    up[2] = math.sin(math.radians(lat))
    return np.array([east, np.cross(up, east), up])


def ecef(lon, lat, height):
    n = A_M / math.sqrt(1 - E2 * math.sin(math.radians(lat)) ** 2)
    level = (n + height) * math.cos(math.radians(lat))
    x, y = level * math.cos(math.radians(lon)), level * math.sin(math.radians(lon))
    return np.array([x, y, (n * (1 - E2) + height) * math.sin(math.radians(lat))])


def places():
    """Longitude, latitude, height of the cameras: Newton's steps from earth-centred to geodetic."""
    found = []
    for shift in SHIFTS:
        target = ecef(*ORIGIN) + of_ecef(*ORIGIN[:2]).T @ shift
        place = np.array(ORIGIN)
        for _ in range(5):
            east, north, up = of_ecef(*place[:2]) @ (target - ecef(*place))
            metres = A_M * math.radians(1.0)
            place += [east / metres / math.cos(math.radians(place[1])), north / metres, up]
        found.append(place)
    return np.array(found)


def matrices():
    return np.array([camera(*angles) for angles in ANGLES])


def local():
    """The cameras in the axes of the origin: east is another direction some way off."""
    axes = of_ecef(*ORIGIN[:2])
    return np.array([one @ of_ecef(*at[:2]) @ axes.T for one, at in zip(matrices(), places(), strict=True)])


def utm():
    """Easting, northing and height; and the cameras in the axes of the grid, whose north true north leans from."""
    to_grid = pyproj.Transformer.from_crs(4326, UTM, always_xy=True)
    lon, lat, up = places().T
    east, north = to_grid.transform(lon, lat)
    # True north leans to the zone's meridian, 117 degrees: a transverse Mercator on a sphere.
    lean = -np.degrees(np.arctan(np.tan(np.radians(lon - 117.0)) * np.sin(np.radians(lat))))
    turned = [matrix @ about(2, angle) for matrix, angle in zip(matrices(), lean, strict=True)]
    return np.stack([east, north, up], axis=1), np.array(turned)


def quaternion(matrix):
    """w x y z of a rotation: the largest eigenvector of Bar-Itzhack's matrix."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix
    sums = [[xx - yy - zz, yx + xy, zx + xz, zy - yz], [yx + xy, yy - xx - zz, zy + yz, xz - zx]]
    sums += [[zx + xz, zy + yz, zz - xx - yy, yx - xy], [zy - yz, xz - zx, yx - xy, xx + yy + zz]]
    x, y, z, w = np.linalg.eigh(np.array(sums))[1][:, -1]
    return w, x, y, z


def rotvec(matrix):
    w, *axis = quaternion(matrix)
    length = np.linalg.norm(axis)
    return (2 * math.atan2(length, w) * np.array(axis) / length).tolist()


def from_nadir(yaw, pitch, roll):
    """Yaw, pitch, roll of the body on which a camera looks straight down."""
    matrix = body(yaw, pitch, roll) @ about(1, 90.0)
    pitch_of = -math.asin(matrix[2, 0])
    return [math.degrees(one) for one in (math.atan2(matrix[1, 0], matrix[0, 0]), pitch_of, math.atan2(*matrix[2, 1:]))]


def opk(matrix):
    """Omega, phi, kappa of a camera in a grid: the picture's right, up, back = Rx(omega) Ry(phi) Rz(kappa)."""
    turn = (np.diag([1.0, -1.0, -1.0]) @ matrix).T
    phi = math.asin(turn[0, 2])
    return [
        math.degrees(one) for one in (math.atan2(-turn[1, 2], turn[2, 2]), phi, math.atan2(-turn[0, 1], turn[0, 0]))
    ]


def colmap_text(spots, turns, names=NAMES):
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
    ]
    for number, (spot, turn, name) in enumerate(zip(spots, turns, names, strict=True), start=1):
        numbers = [*quaternion(turn), *(-turn @ spot)]
        lines += [
            f"{number} {' '.join(map(repr, map(float, numbers)))} 1 {name}",
            "" if number == 2 else "1.5 2.5 -1 3.5 4.5 7",
        ]
    return "\n".join(lines) + "\n"


def colmap_binary(spots, turns, names=NAMES):
    data = struct.pack("<Q", len(names))
    for number, (spot, turn, name) in enumerate(zip(spots, turns, names, strict=True), start=1):
        data += struct.pack("<I7dI", number, *quaternion(turn), *(-turn @ spot), 1)
        data += name.encode() + b"\0" + struct.pack("<Q", 1) + struct.pack("<ddq", 1.0, 2.0, -1)
    return data


def opensfm():
    shots = {
        name: {"rotation": rotvec(turn), "translation": (-turn @ spot).tolist(), "camera": "c", "capture_time": 1.7e9}
        for name, turn, spot in zip(NAMES, local(), SHIFTS, strict=True)
    }
    lens = {
        "projection_type": "brown",
        "width": WIDTH,
        "height": HEIGHT,
        "focal_x": FOCAL / WIDTH,
        "focal_y": FOCAL / WIDTH,
    }
    lens |= {"c_x": 0.01, "c_y": -0.02, "k1": 0.1, "k2": 0.02, "k3": 0.003, "p1": 0.004, "p2": 0.005}
    reference = dict(zip(("longitude", "latitude", "altitude"), ORIGIN, strict=True))
    return json.dumps([{"cameras": {"c": lens}, "shots": shots, "reference_lla": reference, "points": {}}])


def shots():
    spots, turns = utm()
    features = [
        {
            "type": "Feature",
            "properties": {
                "filename": name,
                "focal": FOCAL / WIDTH,
                "width": WIDTH,
                "height": HEIGHT,
                "translation": spot.tolist(),
                "rotation": rotvec(turn),
            },
            "geometry": {"type": "Point", "coordinates": place.tolist()},
        }
        for name, place, spot, turn in zip(NAMES, places(), spots, turns, strict=True)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


def metashape(
    *,
    wkt='GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.01745329251994328],AUTHORITY["EPSG","4326"]]',
    scale=2.5,
    more="",
):
    """A chunk with axes of its own, as large as `scale` says, and turned against the earth's."""
    chunk_turn, chunk_shift = body(12.0, 34.0, 56.0), ecef(*ORIGIN)
    cameras = []
    for number, (name, place, matrix) in enumerate(zip(NAMES, places(), matrices(), strict=True)):
        to_earth = (matrix @ of_ecef(*place[:2])).T  # camera to earth-centred axes
        pose = np.eye(4)
        pose[:3, :3] = chunk_turn.T @ to_earth
        pose[:3, 3] = chunk_turn.T @ (ecef(*place) - chunk_shift) / scale
        numbers = " ".join(map(repr, pose.ravel().tolist()))
        head = f'<camera id="{number}" sensor_id="0" component_id="0" label="{name}">'
        cameras.append(f"{head}<transform>{numbers}</transform></camera>")
    turn = " ".join(map(repr, chunk_turn.ravel().tolist()))
    shift = " ".join(map(repr, chunk_shift.tolist()))
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1"><sensor id="0" type="frame">
<resolution width="{WIDTH}" height="{HEIGHT}"/>
<calibration type="frame" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>
<f>{FOCAL}</f><cx>12.5</cx><cy>-7.5</cy>
<k1>0.1</k1><k2>0.02</k2><k3>0.003</k3><p1>0.004</p1><p2>0.005</p2></calibration></sensor></sensors>
<components next_id="1"><component id="0" label="Component 1"><transform><rotation locked="0">{turn}</rotation>
<translation locked="0">{shift}</translation><scale locked="0">{scale}</scale></transform></component></components>
<cameras next_id="3">{"".join(cameras)}{more}</cameras><reference>{wkt}</reference></chunk></document>"""


def rows(header, values, *, separator=","):
    """A table: names, then numbers of each camera."""
    lines = [separator.join(header)]
    lines += [separator.join([name, *map(repr, map(float, row))]) for name, row in zip(NAMES, values, strict=True)]
    return "\n".join(lines) + "\n"
