# SPDX-License-Identifier: Apache-2.0
"""A small U-Net as named arrays: their shapes, the passes that torch carries out, and texts and files of weights."""

import base64
import binascii
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.features import ColourBalance, Plane, lab_planes

if TYPE_CHECKING:
    from torch import Tensor

Weights = dict[str, NDArray[np.float32]]
Card = TypeVar("Card", sgb.SegmenterCard, sgb.MatcherCard)

FORMAT: Final = "unet 1"
BANDS: Final = 6  # Lab relative to the picture, and Lab as it is
WIDTHS: Final = (32, 64, 96, 128, 128)  # channels at cells of 2, 4, 8, 16 and 32 pixels
MULTIPLE: Final = 2 ** len(WIDTHS)  # rows and columns that the network sees are multiples of this
_FOLD: Final = 2  # pixels a side of a cell of the first level: half the rows and columns, four times the bands
_ENCODER: Final = "encoder."
_RELATIVE: Final = np.array([80.0, 20.0, 20.0])  # usual spreads of bands, which become 1
_PLAIN: Final = np.array([60.0, 20.0, 20.0])
_GREY: Final = 128.0
_HASHED: Final = 8  # digits of a file's SHA-256 on a card
_MOST_BYTES: Final = 64 * 2**20  # of a file of weights


def input_planes(rgb: NDArray[np.uint8], balance: ColourBalance | None = None) -> Plane:
    """Return what the network sees of a picture, shape (BANDS, H, W).

    `balance` is that of the whole picture if `rgb` is a part of it.
    """
    lab = lab_planes(rgb)
    relative = (balance or ColourBalance.of(lab)).balanced(lab) / _RELATIVE[:, None, None]
    plain = (lab - np.array([_GREY, 0.0, 0.0])[:, None, None]) / _PLAIN[:, None, None]
    return np.concatenate([relative, plain]).astype(np.float32)


def torch_module(name: str) -> Any:  # noqa: ANN401 - a module
    """Import PyTorch for the plugin `name`, with one thread unless OMP_NUM_THREADS says otherwise.

    Raise `RuntimeError`, in one line, where it is missing: everything else works without it.
    """
    try:
        import torch  # noqa: PLC0415 - an extra; a second to import
    except (ImportError, OSError) as error:
        raise RuntimeError(
            f"{name} needs PyTorch, which cannot be imported ({error}): pip install 'sasgeo-baselines[torch]'"
        ) from error
    threads = os.environ.get("OMP_NUM_THREADS", "")
    torch.set_num_threads(int(threads) if threads.isdecimal() and int(threads) else 1)
    return torch


def encoder_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of the encoder.

    >>> encoder_shapes()["encoder.0.0.kernel"]
    (32, 24, 3, 3)
    """
    found: dict[str, tuple[int, ...]] = {}
    above = BANDS * _FOLD**2
    for level, width in enumerate(WIDTHS):
        found |= _block_shapes(f"{_ENCODER}{level}", above, width)
        above = width
    return found


def unet_shapes(classes: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of the whole network, which tells so many classes.

    >>> sum(int(np.prod(shape)) for shape in unet_shapes(12).values())
    1652016
    """
    found, below = encoder_shapes(), WIDTHS[-1]
    for level, width in reversed(list(enumerate(WIDTHS[:-1]))):
        found |= _block_shapes(f"decoder.{level}", below + width, width)
        below = width
    outputs = classes * _FOLD**2
    return found | {"head.kernel": (outputs, WIDTHS[0], 1, 1), "head.shift": (outputs,)}


def _block_shapes(name: str, given: int, width: int) -> dict[str, tuple[int, ...]]:
    found: dict[str, tuple[int, ...]] = {}
    for at, channels in enumerate((given, width)):
        found[f"{name}.{at}.kernel"] = (width, channels, 3, 3)
        found |= {f"{name}.{at}.{part}": (width,) for part in ("scale", "shift")}
    return found


def drawn_weights(classes: int, rng: np.random.Generator) -> Weights:
    """Draw weights to begin with: normal ones that keep variances (He et al., ICCV 2015)."""
    found = {}
    for name, shape in unet_shapes(classes).items():
        if name.endswith(".kernel"):
            values = rng.normal(0, np.sqrt(2 / np.prod(shape[1:])), shape)
        else:
            values = np.full(shape, float(name.endswith(".scale")))
        found[name] = values.astype(np.float32)
    return found


def encoded(torch: Any, arrays: Mapping[str, "Tensor"], planes: "Tensor") -> list["Tensor"]:  # noqa: ANN401 - a module
    """Return the channels of every level of pictures, tensors of shape (N, WIDTHS[level], rows, columns)."""
    functional = torch.nn.functional
    at = functional.pixel_unshuffle(planes, _FOLD)
    levels = []
    for level in range(len(WIDTHS)):
        at = _block(functional, arrays, f"{_ENCODER}{level}", functional.max_pool2d(at, 2) if level else at)
        levels.append(at)
    return levels


def log_odds(torch: Any, arrays: Mapping[str, "Tensor"], planes: "Tensor") -> "Tensor":  # noqa: ANN401 - a module
    """Return the log-odds of each class at each pixel of pictures, shape (N, classes, H, W)."""
    functional = torch.nn.functional
    *levels, at = encoded(torch, arrays, planes)
    for level, beside in reversed(list(enumerate(levels))):
        wider = functional.interpolate(at, scale_factor=2, mode="nearest")
        at = _block(functional, arrays, f"decoder.{level}", torch.cat([wider, beside], dim=1))
    found = functional.conv2d(at, arrays["head.kernel"], arrays["head.shift"])
    return functional.pixel_shuffle(found, _FOLD)


def _block(functional: Any, arrays: Mapping[str, "Tensor"], name: str, at: "Tensor") -> "Tensor":  # noqa: ANN401 - a module
    for number in range(2):
        kernel, scale, shift = (arrays[f"{name}.{number}.{part}"] for part in ("kernel", "scale", "shift"))
        at = functional.conv2d(at, kernel, padding=1)
        # 8 groups of channels that are normalized together
        at = functional.relu(functional.group_norm(at, 8, scale, shift))
    return at


def weights_text(classes: tuple[str, ...], weights: Weights) -> str:
    """Return classes and weights as JSON, each array as base64 of its little-endian float16 numbers.

    >>> text = weights_text(("water",), drawn_weights(1, np.random.default_rng(0)))
    >>> classes, weights = weights_of(text)
    >>> classes, weights["head.shift"].tolist(), len(text) < 5e6
    (('water',), [0.0, 0.0, 0.0, 0.0], True)
    """
    arrays = {name: base64.b64encode(values.astype("<f2").tobytes()).decode() for name, values in weights.items()}
    return json.dumps({"format": FORMAT, "classes": classes, "arrays": arrays})


def weights_of(text: str) -> tuple[tuple[str, ...], Weights]:
    """Read the text of `weights_text`; raise `ValueError`, in one line, if it is damaged or of another network."""
    try:
        content = _content(text)
        classes = tuple(str(name) for name in content["classes"])
        given = {name: base64.b64decode(part, validate=True) for name, part in content["arrays"].items()}
        found = {name: np.frombuffer(part, dtype="<f2") for name, part in given.items()}
        return classes, _fitted(found, unet_shapes(len(classes)))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, binascii.Error) as error:
        raise ValueError(f"the learned text of a unet cannot be used ({_shown(error)}): learn again") from error


def _content(text: str) -> Any:  # noqa: ANN401 - JSON
    """Return a learned text as JSON; raise `ValueError` or another error of JSON if it is not one of ours."""
    content = json.loads(text)
    if content["format"] != FORMAT:
        raise ValueError(f"it is not of {FORMAT}")
    return content


def _fitted(found: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> Weights:
    """Return arrays in the shapes that a network needs; raise `ValueError` for a missing, misshapen or wild one."""
    fitted = {}
    for name, shape in shapes.items():
        if name not in found:
            raise ValueError(f"the array {name} is missing")
        values = np.asarray(found[name])
        if values.dtype.kind != "f" or values.size != np.prod(shape) or not np.isfinite(values).all():
            raise ValueError(f"the array {name} does not hold {np.prod(shape)} finite numbers")
        fitted[name] = values.astype(np.float32).reshape(shape)
    return fitted


def read_encoder(path: Path) -> Weights:
    """Read the weights of the encoder out of a file.

    Parameters
    ----------
    path : Path
        A learned text of `unet`, or an archive of NumPy (`.npz`) with the arrays of `encoder_shapes`.

    Raises
    ------
    ValueError
        In one line, if it cannot be read, or lacks an array.
    """
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                return _fitted({name: archive[name] for name in encoder_shapes() if name in archive}, encoder_shapes())
        _, weights = weights_of(_file_bytes(path).decode())
    except (OSError, ValueError, BadZipFile, KeyError, EOFError) as error:
        raise ValueError(
            f"{path} holds no weights of the encoder ({_shown(error)}): name a learned text of unet, or an .npz"
        ) from error
    return {name: values for name, values in weights.items() if name.startswith(_ENCODER)}


def card_with(card: Card, weights: Path | None) -> Card:
    """Return a card whose version names the file of weights, so that rows of two files are never mixed."""
    if weights is None:
        return card
    try:
        digest = hashlib.sha256(_file_bytes(weights)).hexdigest()
    except OSError as error:
        raise ValueError(f"{card.name}: the file of its weights cannot be read ({_shown(error)})") from error
    return replace(card, version=f"{card.version}+{digest[:_HASHED]}")


def _file_bytes(path: Path) -> bytes:
    """Read a file of weights; raise `ValueError` for one that is far too large."""
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise ValueError(f"{path} has {size} bytes, weights take at most {_MOST_BYTES}")
    return path.read_bytes()


def _shown(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
