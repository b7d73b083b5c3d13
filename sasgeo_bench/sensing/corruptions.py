# SPDX-License-Identifier: Apache-2.0
"""Corruptions of aerial pictures: 19 single ones of four families, and 8 that compound families; the ground stays."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ImageError
from sasgeo_bench.sensing.image import Picture

Family = Literal["weather", "motion", "sensor", "compression"]
Rgb = NDArray[np.float32]  # 0 to 1, shape (H, W, 3), as a display shows it
SEVERITIES: Final = (1, 2, 3)

_BLOCK_PX: Final = 16  # of a macroblock of video
_GRAINS: Final = 384  # of noise along a large picture


@dataclass(frozen=True, slots=True, kw_only=True)
class Corruption:
    """A single corruption: `levels` are what `change` gets at severities 1, 2 and 3, in the unit of `what`.

    `change` takes a picture, float32 of shape (H, W, 3) from 0 to 1, a level and a generator; values beyond 0 and 1 are
    cut off behind it.
    """

    family: Family
    what: str
    levels: tuple[float, float, float]
    change: Callable[[Rgb, float, np.random.Generator], Rgb]


def corrupt(picture: Picture, name: str, *, severity: int, rng: np.random.Generator) -> Picture:
    """Return a picture under a corruption: a single one, or a compound of single ones, one after another.

    Lengths are fractions of the picture's width, so that pictures of one place lose the same ground whatever their
    resolution; blocks and lines are of pixels, as codecs and sensors make them. What the picture shows stays in
    its place on average: blurs are symmetric, and the rows that a rolling shutter moves are moved by 0 on average.

    Parameters
    ----------
    picture : ndarray of uint8, shape (H, W, 3)
        Red, green, blue; its top is where the drone flies to.
    name : str
        Of `CORRUPTIONS` or `COMPOUNDS`.
    severity : int
        1, 2 or 3; 0 leaves the picture as it is.
    rng : Generator
        Where drops, clouds, lost blocks and the like are; from the same state, a higher severity has more of the same.

    Returns
    -------
    ndarray of uint8, shape (H, W, 3)
        A new picture.

    Raises
    ------
    ImageError
        If there is no such corruption or severity.

    Notes
    -----
    Single corruptions and severities in the manner of ImageNet-C (Hendrycks and Dietterich, ICLR 2019); families,
    numbers and compounds in that of UAVSat-Deg (Jiang, Liu and Gu, github.com/JHC626/ReLATE), whose pictures are of
    drones. The formulae and the levels are our own, so that figures are not comparable with theirs.

    Examples
    --------
    Fog takes contrast away, more at each severity:

    >>> roofs = np.zeros((64, 64, 3), dtype=np.uint8)
    >>> roofs[:, ::8] = 200
    >>> [int(np.ptp(corrupt(roofs, "fog", severity=s, rng=np.random.default_rng(1)))) for s in (0, 1, 2, 3)]
    [200, 159, 126, 89]
    """
    if severity not in (0, *SEVERITIES):
        raise ImageError(f"a severity is 0, 1, 2 or 3, got {severity!r}")
    if name not in CORRUPTIONS and name not in COMPOUNDS:
        raise ImageError(f"there is no corruption {name!r}: choose one of {', '.join((*CORRUPTIONS, *COMPOUNDS))}")
    changed = picture.copy()
    if severity == 0:
        return changed
    for part in COMPOUNDS.get(name, (name,)):
        one = CORRUPTIONS[part]
        changed = _bytes(one.change(_floats(changed), one.levels[severity - 1], rng))
    return changed


def _floats(picture: Picture) -> Rgb:
    return np.asarray(picture, dtype=np.float32) / np.float32(255)


def _bytes(rgb: Rgb) -> Picture:
    return np.asarray(np.clip(np.rint(rgb * 255), 0, 255), dtype=np.uint8)


# --- weather


def _fog(rgb: Rgb, density: float, rng: np.random.Generator) -> Rgb:
    """Mix with the light of the air, more where the fog is thick; `density` is its mean optical depth."""
    through = np.exp(-np.float32(density) * (0.6 + 0.8 * _cloudy(rgb, rng, width=0.6)))
    return np.asarray(rgb * through + np.float32(0.82) * (1 - through), dtype=np.float32)


def _rain(rgb: Rgb, share: float, rng: np.random.Generator) -> Rgb:
    """Draw bright streaks of drops, which begin at a share of all pixels, over a greyer picture."""
    width_px = rgb.shape[1]
    starts = (rng.random(rgb.shape[:2], dtype=np.float32) < share).astype(np.float32)
    slant, length_px = rng.uniform(-0.4, 0.4), 0.03 * width_px
    along = np.linspace(-0.5, 0.5, 400) * length_px
    streaks = _blur(starts, np.column_stack((slant * along, along))) * np.float32(0.6 * length_px)
    grey = rgb.mean(axis=2, keepdims=True)
    veil = np.float32(share / (share + 0.008))
    wet = (1 - 0.3 * veil) * ((1 - veil) * rgb + veil * (0.6 * grey + 0.15))
    return np.asarray(wet + 0.55 * np.minimum(streaks, 1)[..., None] * (1 - wet), dtype=np.float32)


def _snow(rgb: Rgb, share: float, rng: np.random.Generator) -> Rgb:
    """Draw white flakes, near ones larger, whose middles take a share of all pixels, in whitish air."""
    width_px = rgb.shape[1]
    drawn = rng.random((3, *rgb.shape[:2]), dtype=np.float32)
    flakes = np.zeros(rgb.shape[:2], dtype=np.float32)
    # Radii in widths: few large flakes near the lens, many small ones
    for middle, radius, part in zip(drawn, (0.0012, 0.0025, 0.006), (0.8, 0.17, 0.03), strict=True):
        radius_px = max(radius * width_px, 0.7)
        spots = cv2.GaussianBlur((middle < part * share).astype(np.float32), (0, 0), radius_px)
        flakes += np.asarray(spots, dtype=np.float32) * np.float32(2.5 * np.pi * radius_px**2)
    veil = np.float32(min(25 * share, 0.5))
    air = (1 - veil) * rgb + veil * np.float32(0.8)
    return np.asarray(air + np.minimum(flakes, 1)[..., None] * (1 - air), dtype=np.float32)


def _cloud_shadow(rgb: Rgb, darkness: float, rng: np.random.Generator) -> Rgb:
    """Take a share of the light away under clouds, which cover about half; the light of the sky that stays is blue."""
    cover = np.clip(6 * (_cloudy(rgb, rng, width=0.5) - 0.42), 0, 1)
    return np.asarray(rgb * (1 - darkness * cover * np.array((1.0, 0.97, 0.9))), dtype=np.float32)


# --- motion and focus


def _motion_blur(rgb: Rgb, length: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Smear along the flight, up the picture, over a fraction of its width."""
    along = np.linspace(-0.5, 0.5, 400) * length * rgb.shape[1]
    return _blur(rgb, np.column_stack((np.zeros_like(along), along)))


def _defocus_blur(rgb: Rgb, radius: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Spread each point over a disc of a radius in widths of the picture."""
    reach = np.sqrt((np.arange(4000) + 0.5) / 4000) * radius * rgb.shape[1]
    turn = np.arange(4000) * np.pi * (3 - 5**0.5)  # the golden angle: evenly over the disc
    return _blur(rgb, np.column_stack((reach * np.cos(turn), reach * np.sin(turn))))


def _shake(rgb: Rgb, spread: float, rng: np.random.Generator) -> Rgb:
    """Smear along a bent path of an exposure, whose standard deviation is a fraction of the width."""
    time, orders = np.linspace(0, 1, 2000)[:, None], np.arange(1, 4)
    phases, sizes = rng.uniform(0, 2 * np.pi, (2, 3)), rng.standard_normal((2, 3)) / orders
    path = np.stack(
        [(np.sin(np.pi * time * orders + phase) * size).sum(axis=1) for phase, size in zip(phases, sizes, strict=True)],
        axis=1,
    )
    path -= path.mean(axis=0)
    return _blur(rgb, path * (spread * rgb.shape[1] / np.sqrt((path**2).sum(axis=1).mean())))


def _rolling_shutter(rgb: Rgb, amplitude: float, rng: np.random.Generator) -> Rgb:
    """Move rows sideways in waves, as a shutter that opens row by row sees vibration; `amplitude` in widths."""
    height_px, width_px = rgb.shape[:2]
    down = np.arange(height_px) / height_px
    wave = np.sin(2 * np.pi * (rng.uniform(2, 4) * down + rng.random()))
    wave += 0.5 * np.sin(2 * np.pi * (rng.uniform(6, 10) * down + rng.random()))
    off_px = (wave - wave.mean()) * amplitude * width_px
    across = (np.arange(width_px)[None, :] + off_px[:, None]).astype(np.float32)
    rows = np.repeat(np.arange(height_px, dtype=np.float32)[:, None], width_px, axis=1)
    return np.asarray(cv2.remap(rgb, across, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101))


# --- sensor


def _gaussian_noise(rgb: Rgb, sigma: float, rng: np.random.Generator) -> Rgb:
    """Add noise of the electronics, of a standard deviation of full scale."""
    return _grainy(rgb, lambda cells: np.float32(sigma) * rng.standard_normal(cells.shape, dtype=np.float32))


def _shot_noise(rgb: Rgb, photons: float, rng: np.random.Generator) -> Rgb:
    """Count photons, so many at white in a band."""
    return _grainy(rgb, lambda cells: np.asarray(rng.poisson(cells * photons) / photons - cells, dtype=np.float32))


def _impulse_noise(rgb: Rgb, share: float, rng: np.random.Generator) -> Rgb:
    """Make a share of the picture black or white, pixel by pixel."""

    def hits(cells: Rgb) -> Rgb:
        drawn: Rgb = rng.random((*cells.shape[:2], 1), dtype=np.float32)
        coin: Rgb = rng.random((*cells.shape[:2], 1), dtype=np.float32)
        return np.where(drawn < share, np.where(coin < 0.5, -2, 2), 0).astype(np.float32)  # cut off behind it

    return _grainy(rgb, hits)


def _dead_lines(rgb: Rgb, share: float, rng: np.random.Generator) -> Rgb:
    """Make a share of all columns, and of all rows, black or white, each between two ends."""
    found = rgb.copy()
    for lines in (found, found.transpose(1, 0, 2)):  # views of one picture
        count, length = lines.shape[:2]
        (drawn, coin), ends = rng.random((2, count)), np.sort(rng.random((count, 2)), axis=1)
        for at in np.flatnonzero(drawn < share).tolist():
            first, last = (ends[at] / 2 + (0, 0.5)).tolist()
            lines[at, int(first * length) : int(last * length)] = float(coin[at] < 0.3)
    return found


def _overexposure(rgb: Rgb, stops: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Expose by stops more: bright ground is white."""
    return np.asarray(rgb * 2 ** np.float32(stops / 2), dtype=np.float32)  # values are square roots of the light


def _underexposure(rgb: Rgb, stops: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Expose by stops less: few of the 256 levels are left."""
    return np.asarray(rgb * 2 ** np.float32(-stops / 2), dtype=np.float32)


def _white_balance(rgb: Rgb, shift: float, rng: np.random.Generator) -> Rgb:
    """Make red brighter and blue darker by a share, or red darker and blue brighter."""
    sign = 1 if rng.random() < 0.5 else -1
    return np.asarray(rgb * np.array((1 + sign * shift, 1.0, 1 - sign * shift)), dtype=np.float32)


# --- compression


def _jpeg(rgb: Rgb, quality: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Encode as JPEG of a quality, and decode."""
    bgr = cv2.cvtColor(_bytes(rgb), cv2.COLOR_RGB2BGR)
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    return _floats(np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8))


def _video_blocks(rgb: Rgb, kept: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Keep so many of the 16 lowest frequencies of each macroblock, along each side, as a codec short of bits does."""
    height_px, width_px = rgb.shape[:2]
    padded = np.pad(rgb, ((0, -height_px % _BLOCK_PX), (0, -width_px % _BLOCK_PX), (0, 0)), mode="edge")
    rows, cols = padded.shape[0] // _BLOCK_PX, padded.shape[1] // _BLOCK_PX
    blocks = padded.reshape(rows, _BLOCK_PX, cols, _BLOCK_PX, 3)
    waves = scipy.fft.dctn(blocks, axes=(1, 3), norm="ortho")
    waves[:, int(kept) :] = 0
    waves[:, :, :, int(kept) :] = 0
    back = scipy.fft.idctn(waves, axes=(1, 3), norm="ortho").reshape(padded.shape)
    return np.asarray(back[:height_px, :width_px], dtype=np.float32)


def _low_bit_depth(rgb: Rgb, levels: float, rng: np.random.Generator) -> Rgb:  # noqa: ARG001 - as all do
    """Round each band to so many levels: smooth ground falls into bands."""
    return np.asarray(np.rint(rgb * (levels - 1)) / (levels - 1), dtype=np.float32)


def _packet_loss(rgb: Rgb, share: float, rng: np.random.Generator) -> Rgb:
    """Lose packets: in a share of all rows of macroblocks what follows one of them is taken from ground nearby."""
    height_px, width_px = rgb.shape[:2]
    found = rgb.copy()
    for top in range(0, height_px, _BLOCK_PX):
        is_lost, start = rng.random() < share, int(rng.uniform(0, 0.6) * width_px) // _BLOCK_PX * _BLOCK_PX
        right, down = (rng.choice((-1, 1), 2) * rng.integers(2, 6, 2) * _BLOCK_PX).tolist()
        if is_lost:  # concealed by what the picture shows two to five macroblocks away
            rows = (np.arange(top, min(top + _BLOCK_PX, height_px)) + down) % height_px
            cols = (np.arange(start, width_px) + right) % width_px
            found[top : top + _BLOCK_PX, start:] = rgb[rows[:, None], cols]
    return found


# --- what they share


def _cloudy(rgb: Rgb, rng: np.random.Generator, *, width: float) -> Rgb:
    """Return smooth noise from 0 to 1, shape (H, W, 1), whose bumps are a fraction of the picture wide, with detail."""
    height_px, width_px = rgb.shape[:2]
    total = np.zeros((height_px, width_px), dtype=np.float32)
    for octave in range(5):
        side = round(2**octave / width) + 3
        bumps = rng.standard_normal((side, side), dtype=np.float32)
        wide = cv2.resize(bumps, (width_px, height_px), interpolation=cv2.INTER_CUBIC)
        total += np.asarray(wide, dtype=np.float32) * np.float32(0.5**octave)
    low, high = float(total.min()), float(total.max())
    return np.asarray((total - low) / max(high - low, 1e-6), dtype=np.float32)[..., None]


def _grainy(rgb: Rgb, noise: Callable[[Rgb], Rgb]) -> Rgb:
    """Add noise that is drawn in square cells of a pixel, or of two where a picture is 768 wide.

    Lenses and colour filters spread noise over neighbours, too; and finer noise of so large a picture would be lost
    when it is stored (`frames.encode_webp`).
    """
    height_px, width_px = rgb.shape[:2]
    side_px = max(1, round(width_px / _GRAINS))
    rows, cols = -(-height_px // side_px), -(-width_px // side_px)
    cells = np.asarray(cv2.resize(rgb, (cols, rows), interpolation=cv2.INTER_AREA), dtype=np.float32)
    wide = noise(cells).repeat(side_px, axis=0).repeat(side_px, axis=1)
    return np.asarray(rgb + wide[:height_px, :width_px], dtype=np.float32)


def _blur(values: Rgb, path_px: NDArray[np.float64]) -> Rgb:
    """Return the mean of a picture over a path of offsets (right, down), shape (N, 2); beyond its rim it is mirrored.

    The middle of the path is where the picture stays.
    """
    reach = int(np.ceil(np.abs(path_px).max() - 0.5))
    edges = np.arange(2 * reach + 2) - reach - 0.5
    kernel, _, _ = np.histogram2d(path_px[:, 1], path_px[:, 0], bins=(edges, edges))
    kernel = (kernel / kernel.sum()).astype(np.float32)
    return np.asarray(cv2.filter2D(values, -1, kernel, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


def _of(
    family: Family,
    what: str,
    levels: tuple[float, float, float],
    change: Callable[[Rgb, float, np.random.Generator], Rgb],
) -> Corruption:
    return Corruption(family=family, what=what, levels=levels, change=change)


CORRUPTIONS: Final[Mapping[str, Corruption]] = {
    "fog": _of("weather", "mean optical depth", (0.4, 0.8, 1.4), _fog),
    "rain": _of("weather", "share of pixels where a streak begins", (0.003, 0.008, 0.02), _rain),
    "snow": _of("weather", "share of pixels in the middle of a flake", (0.003, 0.007, 0.014), _snow),
    "cloud shadow": _of("weather", "share of the light that is lost", (0.35, 0.6, 0.8), _cloud_shadow),
    "motion blur": _of("motion", "widths of the picture", (0.012, 0.025, 0.05), _motion_blur),
    "defocus blur": _of("motion", "widths of the picture", (0.004, 0.008, 0.016), _defocus_blur),
    "camera shake": _of("motion", "widths of the picture", (0.004, 0.008, 0.016), _shake),
    "rolling shutter": _of("motion", "widths of the picture", (0.004, 0.008, 0.016), _rolling_shutter),
    "gaussian noise": _of("sensor", "of full scale", (0.05, 0.1, 0.16), _gaussian_noise),
    "shot noise": _of("sensor", "photons at white", (60, 25, 12), _shot_noise),
    "impulse noise": _of("sensor", "share of pixels", (0.02, 0.06, 0.14), _impulse_noise),
    "dead lines": _of("sensor", "share of columns and of rows", (0.01, 0.03, 0.08), _dead_lines),
    "overexposure": _of("sensor", "stops", (0.8, 1.4, 2.0), _overexposure),
    "underexposure": _of("sensor", "stops", (1.5, 3.0, 4.5), _underexposure),
    "white balance": _of("sensor", "share of red and blue", (0.12, 0.24, 0.4), _white_balance),
    "jpeg": _of("compression", "quality", (20, 10, 5), _jpeg),
    "video blocks": _of("compression", "frequencies kept of 16", (5, 3, 2), _video_blocks),
    "low bit depth": _of("compression", "levels of a band", (12, 7, 4), _low_bit_depth),
    "packet loss": _of("compression", "share of rows of macroblocks", (0.1, 0.25, 0.5), _packet_loss),
}
# Parts of two or three families at one severity, in the order in which light, camera and link make them.
COMPOUNDS: Final[Mapping[str, tuple[str, ...]]] = {
    " + ".join(parts): parts
    for parts in (
        ("fog", "camera shake"),
        ("rain", "motion blur"),
        ("snow", "overexposure"),
        ("cloud shadow", "white balance"),
        ("motion blur", "jpeg"),
        ("rolling shutter", "video blocks"),
        ("fog", "shot noise", "jpeg"),
        ("motion blur", "underexposure", "packet loss"),
    )
}
