# SPDX-License-Identifier: Apache-2.0

"""A picture, or the head of a page as Chromium shows it, small enough for the README."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

QUALITY = 75
WINDOW = (1280, 1066)  # as high for its width as the picture beside it
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def shot_of(page: Path, folder: Path) -> Path:
    """What a reader sees of a page without scrolling."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"no Chromium shows {page}: .ci/install-chromium installs one")
    target = folder / "shot.png"
    flags = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={WINDOW[0]},{WINDOW[1]}"]
    subprocess.run(  # noqa: S603 - the browser that is installed, on our own page
        [browser, *flags, f"--screenshot={target}", page.resolve().as_uri()], check=True, capture_output=True
    )
    return target


def main() -> None:
    """Write the second file, of the first."""
    source, target = map(Path, sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        picture = shot_of(source, Path(folder)) if source.suffix == ".html" else source
        pixels = cv2.imread(str(picture))
    cv2.imwrite(str(target), pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
