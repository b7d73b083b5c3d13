# SPDX-License-Identifier: Apache-2.0
"""Time and memory of `import-photos` on a large folder of a drone's photos.

    .venv/bin/python benchmarks/many_photos.py out chateaugiron-ortho --count 10000

Pictures are smooth noise of 800 x 600 pixels with a drone's EXIF and XMP, at places drawn on the region, in a temporary
folder. Memory is as in `benchmarks/locate.py`. Goal: 10,000 photos in 1 GB.
"""

import argparse
import datetime as dt
import math
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from locate import watched
from PIL import ExifTags, Image

from sasgeo_bench.regions.region_files import read_manifest

XMP = (
    '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:GimbalPitchDegree="-90.00" '
    'drone-dji:GimbalYawDegree="+33.00" drone-dji:GimbalRollDegree="+0.00" drone-dji:RelativeAltitude="+100.00"/>'
    '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
)


def degrees(value: float) -> tuple[float, float, float]:
    """Return degrees, minutes and seconds of an angle's size."""
    minutes, whole = math.modf(abs(value))
    seconds, minutes = math.modf(minutes * 60)
    return whole, minutes, round(seconds * 60, 4)


def write_photos(folder: Path, region: Path, count: int) -> None:
    """Write photos at places within the middle of a region, 3 s after each other."""
    west, south, east, north = read_manifest(region).bounds_lonlat
    rng = np.random.default_rng(1)
    noise = [cv2.GaussianBlur(rng.integers(0, 255, (600, 800, 3), dtype=np.uint8), (0, 0), 5) for _ in range(4)]
    pictures = [Image.fromarray(cv2.normalize(item, None, 0, 255, cv2.NORM_MINMAX)) for item in noise]
    for number in range(count):
        lon_deg, lat_deg = (low + (high - low) * rng.uniform(0.3, 0.7) for low, high in ((west, east), (south, north)))
        exif = Image.Exif()
        exif[ExifTags.Base.Model] = "FC6310"
        place, inner = exif.get_ifd(ExifTags.IFD.GPSInfo), exif.get_ifd(ExifTags.IFD.Exif)
        place[ExifTags.GPS.GPSLatitudeRef], place[ExifTags.GPS.GPSLatitude] = "SN"[lat_deg > 0], degrees(lat_deg)
        place[ExifTags.GPS.GPSLongitudeRef], place[ExifTags.GPS.GPSLongitude] = "WE"[lon_deg > 0], degrees(lon_deg)
        at = f"{dt.datetime(2024, 5, 1) + dt.timedelta(seconds=3 * number):%Y:%m:%d %H:%M:%S}"  # noqa: DTZ001 - EXIF's
        inner[ExifTags.Base.DateTimeOriginal], inner[ExifTags.Base.FocalLengthIn35mmFilm] = at, 24
        pictures[number % 4].save(folder / f"p{number:06d}.jpg", quality=70, exif=exif, xmp=XMP.encode())


def main() -> None:
    """Print seconds and megabytes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="root of built regions")
    parser.add_argument("region")
    parser.add_argument("--count", type=int, default=10_000)
    given = parser.parse_args()
    region = (given.out / "regions" / given.region).resolve()
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder, "photos")
        photos.mkdir()
        write_photos(photos, region, given.count)
        words = ["import-photos", str(photos), "--region", str(region), "--out", f"{folder}/out"]
        seconds, megabytes = watched([sys.executable, "-m", "sasgeo_bench", *words])
    print(f"{given.count} photos: {seconds:.0f} s, {megabytes:.0f} MB at most")


if __name__ == "__main__":
    main()
