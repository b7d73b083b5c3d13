# SPDX-License-Identifier: Apache-2.0
"""Poses of reconstructions and trajectories: COLMAP, OpenDroneMap, Metashape's XML, TUM."""

import math
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyproj
from defusedxml import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]
from scipy.spatial.transform import Rotation

from sasgeo_bench.core.errors import CameraError, FlightError, PoseError, counted, named
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import message_of, plain
from sasgeo_bench.flights.trajectory import read_tum
from sasgeo_bench.geometry.grid import utm_epsg
from sasgeo_bench.geometry.projection import WGS84, from_lonlat
from sasgeo_bench.observing.picture_poses import (
    Floats,
    ModelFrame,
    PicturePose,
    PoseFacts,
    attitude_of,
    check_crs,
    convergence_deg,
    enu_of_ecef,
    is_rotation,
    turn_about_up,
)
from sasgeo_bench.observing.pose_columns import (
    KNOWN,
    NO_NUMBER,
    Read,
    Sheet,
    bytes_of,
    crs_of_wkt,
    epsg_of_crs,
    epsg_of_wkt,
    name_of,
    number_in,
    poses_of_sheet,
    turned,
)
from sasgeo_bench.sensing.camera import Intrinsics

_GAP_S: Final = 2.0  # between poses of a trajectory, beyond which no picture's place is taken from between them
_ROTATION_FAULT: Final = "whose rotation is none"


@dataclass(kw_only=True)
class _Model:
    """Cameras of a reconstruction as they are read: names, places, rotations (frame to camera), lenses."""

    names: list[str] = field(default_factory=list)
    places: list[Floats] = field(default_factory=list)
    turns: list[Floats] = field(default_factory=list)
    lenses: list[Intrinsics | None] = field(default_factory=list)
    left_out: "defaultdict[str, list[str]]" = field(default_factory=lambda: defaultdict(list))

    def add(self, name: str, place: Floats, turn: Floats, lens: Intrinsics | None) -> None:
        if not np.isfinite(place).all():
            self.left_out[NO_NUMBER].append(name)
        elif not (np.isfinite(turn).all() and is_rotation(turn)):
            self.left_out[_ROTATION_FAULT].append(name)
        else:
            self.names.append(name)
            self.places.append(place)
            self.turns.append(turn)
            self.lenses.append(lens)

    def poses(self, frame: ModelFrame) -> list[PicturePose]:
        return frame.poses(
            self.names, np.reshape(self.places, (-1, 3)), np.reshape(self.turns, (-1, 3, 3)), self.lenses
        )


def _frame_of(path: Path, facts: PoseFacts, kind: str) -> ModelFrame:
    """Return the frame that the user states; raise `PoseError` if he states none."""
    if facts.epsg is not None and not check_crs(facts.epsg):
        return ModelFrame(epsg=facts.epsg)
    if facts.origin is not None:
        return ModelFrame(origin=facts.origin, has_height=facts.origin[2] != 0)
    raise PoseError(
        f"{plain(path.name)} ({kind}) has positions in a frame that it does not state: say --epsg of its projected "
        "CRS, or --origin LON,LAT,HEIGHT if it has metres to the east, to the north and up"
    )


def _lens(
    width: float,
    height: float,
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    more: Sequence[float] = (),
) -> Intrinsics | None:
    """Return a pinhole with Brown distortion (k1, k2, p1, p2, k3); None if the numbers are no lens."""
    k1, k2, p1, p2, k3 = (*more, *[0.0] * 5)[:5]
    try:
        return Intrinsics(
            width_px=int(width),
            height_px=int(height),
            focal_px=focal_px,
            centre_px=centre_px,
            distortion=(k1, k2, p1, p2, k3),
        )
    except CameraError:
        return None


# COLMAP's models of cameras by their number: name, count of parameters.
_COLMAP: Final = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
_COLMAP_FIELDS: Final = 10  # of the first line of an image: number, quaternion, translation, camera, name


def is_colmap(line: str) -> bool:
    """Return whether a line is that of an image in COLMAP's images.txt."""
    words = line.split(maxsplit=_COLMAP_FIELDS - 1)
    if len(words) < _COLMAP_FIELDS or "," in line:
        return False
    is_counted = words[0].isdigit() and words[8].isdigit()
    has_name = number_in(words[9].split()[-1]) is None  # a line of points has a number there
    return is_counted and has_name and all(number_in(word) is not None for word in words[1:8])


def read_colmap(folder: Path, path: Path, facts: PoseFacts) -> Read:
    """Return the poses of a COLMAP model, a folder or a list of images; of text and binary in one folder the latter."""
    notes = []
    if folder.is_dir():
        binary, text = folder / "images.bin", folder / "images.txt"
        if not (binary.is_file() or text.is_file()):
            raise PoseError(f"{folder} holds no images.bin or images.txt of a COLMAP model: name a table of poses")
        images = binary if binary.is_file() else text
        if images == binary and text.is_file():
            notes.append("images.bin is read, and images.txt beside it is not")
    else:
        images, folder = path, path.parent
    is_binary = images.suffix == ".bin"
    frame = _frame_of(path, facts, "COLMAP")
    cameras = folder / ("cameras.bin" if is_binary else "cameras.txt")
    lenses: dict[int, Intrinsics | None] = {}
    if cameras.is_file():
        data = bytes_of(cameras)
        lenses = _binary_lenses(cameras, data) if is_binary else _text_lenses(cameras, data)
    else:
        notes.append(f"no {cameras.name} beside it: lenses are not known")
    model = _Model()
    rows = _binary_images(images, bytes_of(images)) if is_binary else _text_images(images)
    counts: Counter[str] = Counter()
    for name, (w, x, y, z), shift, camera in rows:
        counts[name] += 1
        turn = (
            Rotation.from_quat([x, y, z, w]).as_matrix() if abs(math.hypot(w, x, y, z) - 1) < 1e-3 else np.zeros((3, 3))
        )
        model.add(name_of(name), -turn.T @ shift, turn, lenses.get(camera))
    repeated = [plain(name) for name, count in counts.items() if count > 1]
    if repeated:
        raise PoseError(
            f"{images.name} has {named(repeated, 'name')} more than once: names of pictures that a tool cut at a space "
            "look so; export the model anew, or rename them"
        )
    if lenses and None in lenses.values():
        notes.append("lenses that are no pinhole with Brown distortion are left out")
    poses = model.poses(frame)
    return Read(kind="COLMAP", poses=poses, left_out=model.left_out, notes=tuple(notes))


_Image = tuple[str, tuple[float, float, float, float], Floats, int]


def _text_images(path: Path) -> Iterator[_Image]:
    """Yield name, quaternion (w x y z), translation and camera of each image; a second line holds its points."""
    try:
        with plain_file(path).open(encoding="utf-8-sig") as file:
            lines = enumerate(file, start=1)
            for number, line in lines:
                if not line.strip() or line.startswith("#"):
                    continue
                words = line.rstrip("\r\n").split(maxsplit=_COLMAP_FIELDS - 1)  # the rest is the name, with its spaces
                values = [number_in(word) for word in words[1:8]]
                if len(words) < _COLMAP_FIELDS or None in values or not words[8].isdigit():
                    raise PoseError(
                        f"{path.name}, line {number}: no image, which has ten fields (IMAGE_ID QW QX QY QZ TX TY TZ "
                        "CAMERA_ID NAME): export the model anew"
                    )
                w, x, y, z, *shift = values
                yield words[9].strip(), (w, x, y, z), np.array(shift), int(words[8])  # type: ignore[misc]
                points = next(lines, (0, ""))[1]
                if is_colmap(points):
                    raise PoseError(
                        f"{path.name}, line {number + 1}: an image where the points of the one before belong: write "
                        "two lines for each image, the second may be empty"
                    )
    except (OSError, UnicodeDecodeError) as error:
        raise PoseError(f"{path} cannot be read ({message_of(error)}): export the model anew") from error


def _binary_images(path: Path, data: bytes) -> Iterator[_Image]:
    damaged = f"{path.name} is damaged, or no list of images of COLMAP: export the model anew"
    try:
        (count,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(count):
            _, w, x, y, z, *shift, camera = struct.unpack_from("<I7dI", data, at)
            end = data.index(b"\0", at + 64)
            name = data[at + 64 : end].decode()
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * points
            yield name, (w, x, y, z), np.array(shift), camera
    except (struct.error, ValueError) as error:
        raise PoseError(damaged) from error
    if at != len(data):
        raise PoseError(damaged)


def _text_lenses(path: Path, data: bytes) -> dict[int, Intrinsics | None]:
    found: dict[int, Intrinsics | None] = {}
    for number, line in enumerate(data.decode("utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        values = [number_in(word) for word in words[2:]]
        if len(words) < 5 or not words[0].isdigit() or None in values:
            raise PoseError(
                f"{path.name}, line {number}: no camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMS): export it anew"
            )
        found[int(words[0])] = _colmap_lens(words[1], values)  # type: ignore[arg-type]
    return found


def _binary_lenses(path: Path, data: bytes) -> dict[int, Intrinsics | None]:
    found: dict[int, Intrinsics | None] = {}
    try:
        (count,) = struct.unpack_from("<Q", data)
        at = 8
        for _ in range(count):
            camera, model, width, height = struct.unpack_from("<IiQQ", data, at)
            name, length = _COLMAP[model] if 0 <= model < len(_COLMAP) else ("", -1)
            if length < 0:
                return found  # how long an unknown camera is cannot be known: what follows is not read
            found[camera] = _colmap_lens(name, [width, height, *struct.unpack_from(f"<{length}d", data, at + 24)])
            at += 24 + 8 * length
    except struct.error as error:
        raise PoseError(f"{path.name} is damaged: export the model anew") from error
    return found


def _colmap_lens(model: str, values: Sequence[float]) -> Intrinsics | None:
    """Return the lens of a camera; None for a fisheye or another that is no pinhole with Brown distortion."""
    width, height, *params = values
    if len(params) != dict(_COLMAP).get(model):
        return None
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        focal, x, y, *radial = params
        return _lens(width, height, (focal, focal), (x, y), radial)
    if model in ("PINHOLE", "OPENCV") or (model == "FULL_OPENCV" and not any(params[9:])):
        fx, fy, x, y, *more = params
        return _lens(width, height, (fx, fy), (x, y), more[:5])
    return None


def read_opensfm(path: Path, found: Sequence[Mapping[str, Any]], facts: PoseFacts) -> Read:
    """Return the poses of OpenDroneMap's reconstruction.json, which OpenSfM writes: metres around `reference_lla`."""
    poses: list[PicturePose] = []
    left_out: defaultdict[str, list[str]] = defaultdict(list)
    for part in found:
        model = _Model()
        try:
            lenses = {name: _opensfm_lens(one) for name, one in part.get("cameras", {}).items()}
            for name, shot in part["shots"].items():
                turn = Rotation.from_rotvec([float(value) for value in shot["rotation"]]).as_matrix()
                shift = np.array([float(value) for value in shot["translation"]])
                model.add(name_of(name), -turn.T @ shift, turn, lenses.get(shot.get("camera")))
            origin = part.get("reference_lla")
            if origin is None:
                frame = _frame_of(path, facts, "OpenDroneMap")
            else:
                place = (float(origin["longitude"]), float(origin["latitude"]), float(origin.get("altitude", 0.0)))
                frame = ModelFrame(origin=place)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise PoseError(
                f"{path.name} is no reconstruction of OpenSfM ({message_of(error)}): export it anew"
            ) from error
        times = [shot.get("capture_time") for shot in part["shots"].values()]
        seconds = dict(zip(map(name_of, part["shots"]), times, strict=True))
        for pose in model.poses(frame):
            time = seconds[pose.name]
            is_time = isinstance(time, int | float) and time > 0
            poses.append(replace(pose, time_s=float(time) if is_time else None, clock="local"))
        for why, names in model.left_out.items():
            left_out[why] += names
    notes = (f"{len(found)} reconstructions that were not joined",) if len(found) > 1 else ()
    return Read(kind="OpenDroneMap", poses=poses, left_out=left_out, notes=notes)


def _opensfm_lens(camera: Mapping[str, Any]) -> Intrinsics | None:
    """Return a lens whose lengths are in parts of the picture's longer side, from its middle."""
    width, height = float(camera.get("width", 0)), float(camera.get("height", 0))
    kind, side = camera.get("projection_type", "perspective"), max(width, height)
    if kind not in ("perspective", "simple_radial", "radial", "brown") or not side:
        return None
    both = "focal_x" in camera
    focal = [float(camera["focal_x" if both else "focal"]), float(camera["focal_y" if both else "focal"])]
    x, y, *more = (float(camera.get(key, 0.0)) for key in ("c_x", "c_y", "k1", "k2", "p1", "p2", "k3"))
    middle = (width / 2 + x * side, height / 2 + y * side)
    return _lens(width, height, (focal[0] * side, focal[1] * side), middle, more)


def read_shots(path: Path, features: Sequence[Mapping[str, Any]]) -> Read:
    """Return the poses of OpenDroneMap's shots.geojson; its rotations are in the UTM zone of its translations."""
    poses: list[PicturePose] = []
    left_out: defaultdict[str, list[str]] = defaultdict(list)
    notes = []
    for one in features:
        told = one["properties"]
        try:
            name = name_of(str(told["filename"]))
            lon, lat, *up = (float(value) for value in one["geometry"]["coordinates"])
            turn = Rotation.from_rotvec([float(value) for value in told["rotation"]]).as_matrix()
            east, north = (float(value) for value in told["translation"][:2])
            width, height = float(told.get("width") or 0), float(told.get("height") or 0)
            focal = float(told.get("focal") or 0) * max(width, height)
        except (KeyError, TypeError, ValueError) as error:
            raise PoseError(f"{path.name} has a shot that is damaged ({message_of(error)}): export it anew") from error
        pose = PicturePose(
            name=name,
            place=(lon, lat),
            altitude_m=up[0] if up else None,
            intrinsics=_lens(width, height, (focal, focal), (width / 2, height / 2)) if focal and width else None,
        )
        if not (abs(lon) <= 180 and abs(lat) <= 84):
            left_out["with a place that is nowhere on earth"].append(name)
            continue
        grid = _utm_of(lon, lat, (east, north))
        if grid is None:
            poses.append(pose)
            continue
        turn_deg = float(convergence_deg(np.array([[lon, lat]]), grid)[0])
        time = told.get("capture_time")
        is_time = isinstance(time, int | float) and time > 0
        pose = replace(pose, time_s=float(time) if is_time else None, clock="local")
        poses.append(turned(pose, attitude_of(turn @ turn_about_up(turn_deg))))
    if any(pose.attitude is None for pose in poses):
        notes.append("translations that lie in no UTM zone of their place: angles are not read")
    if any(pose.intrinsics for pose in poses):
        notes.append("lenses without their distortion, which the file does not have")
    return Read(kind="OpenDroneMap shots", poses=poses, left_out=left_out, notes=tuple(notes))


def _utm_of(lon_deg: float, lat_deg: float, place_m: tuple[float, float]) -> int | None:
    """Return the UTM zone, that of a place or one beside it, in which it has an easting and northing to 10 m."""
    here = utm_epsg(lon_deg, lat_deg)
    for epsg in (here, here - 1, here + 1):
        if (32601 <= epsg <= 32660 or 32701 <= epsg <= 32760) and math.dist(
            from_lonlat(epsg).transform(lon_deg, lat_deg), place_m
        ) < 10:
            return epsg
    return None


def read_metashape(path: Path, facts: PoseFacts) -> Read:
    """Return the poses of Metashape's XML: of aligned cameras those that it found, else those of its reference."""
    try:
        root = fromstring(bytes_of(path))
    except (DefusedXmlException, SyntaxError, ValueError) as error:
        raise PoseError(f"{path.name} is no sound XML ({message_of(error)}): export it anew") from error
    if root.tag != "document" or root.find("chunk") is None:
        raise PoseError(f"{path.name} is no table of poses that is known ({KNOWN}): export it in one of these")
    poses: list[PicturePose] = []
    left_out: defaultdict[str, list[str]] = defaultdict(list)
    notes: list[str] = []
    try:
        for chunk in root.iter("chunk"):
            cameras = [one for one in chunk.iter("camera") if one.get("label")]
            is_aligned = any(one.find("transform") is not None for one in cameras)
            read = _aligned if is_aligned else _measured
            if not is_aligned:
                notes.append("no camera is aligned: places and angles are those that were measured")
            poses += read(path, chunk, cameras, facts, left_out)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, PoseError):
            raise
        raise PoseError(f"{path.name} has a damaged camera ({message_of(error)}): export it anew") from error
    if any(pose.intrinsics is None for pose in poses):
        notes.append("lenses with more than Brown distortion, or without a calibration, are left out")
    return Read(kind="Metashape XML", poses=poses, left_out=left_out, notes=tuple(dict.fromkeys(notes)))


Element = Any  # of an XML tree: defusedxml has no types


def _numbers(text: str | None, count: int) -> Floats:
    values = np.array([float(word) for word in (text or "").split()])
    if len(values) != count:
        raise ValueError(f"{len(values)} numbers where {count} belong")
    return values


def _aligned(
    path: Path, chunk: Element, cameras: Sequence[Element], facts: PoseFacts, left_out: "defaultdict[str, list[str]]"
) -> list[PicturePose]:
    """Return the poses that Metashape found: camera to chunk, then chunk to earth-centred axes, or to local ones."""
    wkt = (chunk.findtext("reference") or "").strip()
    crs = crs_of_wkt(path, wkt)
    is_local = crs is None
    frames = {one.get("id"): _similarity(one.find("transform")) for one in chunk.iter("component")}
    frames[None] = _similarity(chunk.find("transform"))
    lenses = {one.get("id"): _metashape_lens(one) for one in chunk.iter("sensor")}
    geodetic = None if crs is None else crs.geodetic_crs
    ellipsoid = None if geodetic is None else geodetic.ellipsoid
    epsg = WGS84 if geodetic is None else epsg_of_crs(path, geodetic)
    poses: list[PicturePose] = []
    local = _Model()
    for one in cameras:
        name, transform = name_of(one.get("label")), one.findtext("transform")
        if one.get("enabled", "1").lower() in ("0", "false"):
            left_out["that are switched off"].append(name)
            continue
        frame = frames.get(one.get("component_id")) or frames[None]
        if transform is None or frame is None:
            left_out["that are not aligned"].append(name)
            continue
        scale, turn, shift = frame
        pose = _numbers(transform, 16).reshape(4, 4)
        place = scale * turn @ pose[:3, 3] + shift
        matrix = (turn @ pose[:3, :3]).T
        lens = lenses.get(one.get("sensor_id"))
        if is_local:
            local.add(name, place, matrix, lens)
            continue
        if not (np.isfinite(place).all() and is_rotation(matrix)):
            left_out[_ROTATION_FAULT].append(name)
            continue
        axes = f"+a={ellipsoid.semi_major_metre!r} +b={ellipsoid.semi_minor_metre!r}"  # type: ignore[union-attr]
        to_place = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +inv +proj=cart {axes} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        lon, lat, up = to_place.transform(place[0], place[1], place[2])
        attitude = attitude_of(matrix @ enu_of_ecef(lon, lat).T)
        pose_of = PicturePose(
            name=name, place=(lon, lat), epsg=epsg, altitude_m=up, altitude_of="ellipsoid", intrinsics=lens
        )
        poses.append(turned(pose_of, attitude))
    for why, names in local.left_out.items():
        left_out[why] += names
    return poses + (local.poses(_frame_of(path, facts, "Metashape XML")) if local.names else [])


def _similarity(transform: Element) -> tuple[float, Floats, Floats] | None:
    """Return scale, rotation and translation of a chunk or component; None if it has no place on earth."""
    if transform is None:
        return None
    if transform.find("rotation") is None:
        whole = _numbers(transform.text, 16).reshape(4, 4)
        scale = float(np.cbrt(np.linalg.det(whole[:3, :3])))
        return scale, whole[:3, :3] / scale, whole[:3, 3]
    scale = float(transform.findtext("scale") or 1.0)
    return (
        scale,
        _numbers(transform.findtext("rotation"), 9).reshape(3, 3),
        _numbers(transform.findtext("translation"), 3),
    )


def _metashape_lens(sensor: Element) -> Intrinsics | None:
    """Return a lens; its centre counts from the picture's middle, and its p1 and p2 are those of OpenCV swapped."""
    calibrations = list(sensor.iter("calibration"))
    one = next((one for one in calibrations if one.get("class") == "adjusted"), next(iter(calibrations), None))
    if one is None or one.get("type", "frame") != "frame" or one.find("f") is None:
        return None
    size = one.find("resolution")
    if size is None:
        size = sensor.find("resolution")
    width, height = float(size.get("width")), float(size.get("height"))
    f, x, y, k1, k2, k3, k4, p1, p2, b1, b2 = (
        float(one.findtext(key) or 0.0) for key in ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2")
    )
    if k4 or b2:
        return None
    return _lens(width, height, (f + b1, f), (width / 2 + x, height / 2 + y), (k1, k2, p2, p1, k3))


def _measured(
    path: Path, chunk: Element, cameras: Sequence[Element], facts: PoseFacts, left_out: "defaultdict[str, list[str]]"
) -> list[PicturePose]:
    """Return the poses that were measured, of a chunk whose cameras are not aligned."""
    epsg = facts.epsg or epsg_of_wkt(path, (chunk.findtext("reference") or "").strip())
    lenses = {one.get("id"): _metashape_lens(one) for one in chunk.iter("sensor")}
    header = ("label", "x", "y", "z", "yaw", "pitch", "roll", "sx", "sy")
    rows = []
    for one in cameras:
        told = one.find("reference")
        values = ["" if told is None else told.get(key, "") for key in header[1:]]
        rows.append((one.get("label"), [one.get("label"), *values]))
    titles = ("label", "x", "y", "z", "yaw", "pitch", "roll", "x_accuracy", "y_accuracy")
    sheet = Sheet(kind="Metashape text", header=titles, rows=rows, pitch_zero="down", epsg=epsg)
    read = poses_of_sheet(path, sheet, facts)
    for why, names in read.left_out.items():
        left_out[why] += names
    by_name = {name_of(one.get("label")): lenses.get(one.get("sensor_id")) for one in cameras}
    return [replace(pose, intrinsics=by_name.get(pose.name)) for pose in read.poses]


def read_tum_poses(path: Path, facts: PoseFacts) -> Read:
    """Return the poses of a TUM file: of the camera's (right, down, ahead) in the frame; named by order or by time."""
    frame = _frame_of(path, facts, "TUM")
    try:
        flown = read_tum(path, axes="up")
    except FlightError as error:
        raise PoseError(str(error)) from error
    left_out: dict[str, list[str]] = {}
    if facts.times_s:
        span = flown.time_s[[0, -1]]
        names, times = [], []
        for name, time_s in facts.times_s.items():
            after = int(np.searchsorted(flown.time_s, time_s))
            around = flown.time_s[max(after - 1, 0) : after + 1]
            if not span[0] <= time_s <= span[1] or np.ptp(around) > _GAP_S:
                left_out.setdefault(f"without poses within {_GAP_S:g} s", []).append(name)
            else:
                names.append(name)
                times.append(time_s)
        flown = flown.at(times) if times else flown
    elif facts.names:
        names = list(facts.names)
        if len(names) != len(flown):
            raise PoseError(
                f"{path.name} has {counted(len(flown), 'pose')} for {counted(len(names), 'picture')}: give the "
                "pictures of this file alone, or say when each was taken"
            )
    else:
        raise PoseError(f"{path.name} (TUM) names no pictures: give their names in its order, or their times")
    model = _Model()
    if names:
        for name, place, turn in zip(names, flown.position_m, flown.rotation.inv().as_matrix(), strict=True):
            model.add(name_of(name), place, turn, None)
    poses = [replace(pose, time_s=time) for pose, time in zip(model.poses(frame), flown.time_s.tolist(), strict=False)]
    return Read(kind="TUM", poses=poses, left_out={**left_out, **model.left_out})
