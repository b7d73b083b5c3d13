# SPDX-License-Identifier: Apache-2.0
"""Tables of poses in any known format, told by the content, each to one `PoseTable`.

Angles that formats count in their own ways become one `Attitude`, of the camera against true north, by way of matrices.
"""

from pathlib import Path
from typing import Final

from sasgeo_bench.core.errors import PoseError, named
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.core.paths import plain_file
from sasgeo_bench.core.texts import plain
from sasgeo_bench.observing.picture_poses import PoseFacts, PoseTable, checked
from sasgeo_bench.observing.pose_columns import (
    KNOWN,
    Read,
    Sheet,
    bytes_of,
    cell_of,
    number_in,
    poses_of_sheet,
    read_geojson,
    read_sheet,
)
from sasgeo_bench.observing.pose_models import (
    is_colmap,
    read_colmap,
    read_metashape,
    read_opensfm,
    read_shots,
    read_tum_poses,
)

_HEAD_BYTES: Final = 65_536


def read_pose_table(path: str | Path, facts: PoseFacts | None = None) -> PoseTable:
    r"""Read the poses of pictures out of a table, or the folder of a COLMAP model.

    Parameters
    ----------
    path : str or Path
        Of a file in a format of `KNOWN`, which its content tells, or a folder that holds images.bin or images.txt.
    facts : PoseFacts, optional
        What the file does not say: its CRS or origin, where its pitch counts from, the pictures of a TUM file.

    Returns
    -------
    PoseTable
        Poses in the order of the file, and by reason the rows that are none. Nothing is repaired.

    Raises
    ------
    PoseError
        If the file is of no known format, damaged, or no row of it is a pose; or if it leaves open what `facts` lack.

    Notes
    -----
    Angles called yaw, pitch and roll count from straight down in tables of Pix4D and Metashape, from the horizon in
    those of DJI's gimbal; in others `facts.pitch_zero` says it. Omega, phi, kappa are against the grid's north, and so
    are models in a projected CRS: they are turned to true north. Quaternions are w x y z in COLMAP, x y z w in TUM.

    Examples
    --------
    >>> import tempfile
    >>> rows = "file,lat,lon,gimbal_yaw,gimbal_pitch,gimbal_roll\na.jpg,\"8 deg 17' 26.74\"\" S\",115.46,90,-80,0\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     table = read_pose_table(Path(folder, "poses.csv")) if Path(folder, "poses.csv").write_text(rows) else None
    >>> table.poses[0].place, round(table.poses[0].tilt_deg)
    ((115.46, -8.290761111111111), 10)
    """
    path, facts = Path(path), facts or PoseFacts()
    found = _read(path, facts)
    poses, left_out = checked(found.poses, found.left_out)
    if not poses:
        reasons = "; ".join(f"{named([plain(name) for name in names], 'row')} {why}" for why, names in left_out.items())
        raise PoseError(f"no row of {path.name} ({found.kind}) is a pose: {reasons or 'it has no rows'}")
    notes = found.notes
    if any(pose.height_m is not None and pose.height_of == "origin" for pose in poses):
        notes += ("heights count from the origin, as if it were on the ground: give its own height with --dem",)
    return PoseTable(path=path, kind=found.kind, poses=poses, left_out=left_out, notes=notes)


def _read(path: Path, facts: PoseFacts) -> Read:
    if path.is_dir() or path.name in ("images.txt", "images.bin"):
        return read_colmap(path if path.is_dir() else path.parent, path, facts)
    try:
        with plain_file(path).open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise PoseError(f"{path} cannot be read ({error.strerror or error}): name a table of poses") from error
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if start[:2] in (b"PK", b"\x1f\x8b", b"7z"):
        raise PoseError(f"{path.name} is an archive or a workbook: unpack it, or save it as CSV")
    if start[:1] == b"<":
        return read_metashape(path, facts)
    if start[:1] in (b"{", b"["):
        return _read_json(path, facts)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise PoseError(f"{path.name} is no text in UTF-8: save it as CSV in UTF-8")
    if b"\0" in head:
        raise PoseError(f"{path.name} is no table of poses: name one ({KNOWN})")
    lines = start.decode("utf-8", errors="replace").splitlines()
    line = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    if is_colmap(line) or any(one.startswith("# Image list with two lines of data") for one in lines[:20]):
        return read_colmap(path, path, facts)
    if len(line.split()) == 8 and all(number_in(word) is not None for word in line.split()):
        return read_tum_poses(path, facts)
    return poses_of_sheet(path, read_sheet(path, facts), facts)


def _read_json(path: Path, facts: PoseFacts) -> Read:
    try:
        found = parse_json(bytes_of(path).removeprefix(b"\xef\xbb\xbf"))
    except ValueError as error:
        raise PoseError(f"{path.name} is no sound JSON ({plain(str(error))[:200]}): export it anew") from error
    if isinstance(found, dict) and isinstance(found.get("features"), list):
        features = [one for one in found["features"] if isinstance(one, dict)]
        told = [one["properties"] for one in features if isinstance(one.get("properties"), dict)]
        if told and all({"filename", "rotation", "translation"} <= set(one) for one in told):
            return read_shots(path, features)
        return read_geojson(path, found, features, facts)
    if isinstance(found, list) and found and all(isinstance(one, dict) for one in found):
        if all("SourceFile" in one for one in found):
            header = tuple(dict.fromkeys(key for one in found for key in one))
            rows = [(f"entry {n}", [cell_of(one.get(key)) for key in header]) for n, one in enumerate(found, 1)]
            return poses_of_sheet(path, Sheet(kind="exiftool JSON", header=header, rows=rows), facts)
        if all(isinstance(one.get("shots"), dict) for one in found):
            return read_opensfm(path, found, facts)
    raise PoseError(f"{path.name} is no table of poses that is known ({KNOWN}): export it in one of these")
