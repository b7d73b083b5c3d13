# SPDX-License-Identifier: Apache-2.0
"""`pixel_forest`: boosted trees on multi-scale colour, texture and gradients of every pixel, class by class."""

import json
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

import sasgeo_bench as sgb
from sasgeo_baselines.segmenters.features import (
    Plane,
    enlarged,
    enlarged_mask,
    features,
    has_data,
    reduced_labels,
    working_picture,
)

FORMAT: Final = "pixel_forest 1"
_LEAST_PRESENT: Final = 50  # drawn pixels of a class: fewer teach nothing
_SETTINGS: Final[dict[str, Any]] = {
    "objective": "binary",
    "learning_rate": 0.1,
    "num_leaves": 31,
    "min_data_in_leaf": 100,
    "lambda_l2": 1.0,
    "max_bin": 63,
    "feature_fraction": 0.5,
    "seed": 1,
    "deterministic": True,
    "force_row_wise": True,
    "num_threads": 1,
    "verbosity": -1,
}


class PixelForest:
    """Probability of each class at a pixel, from what surrounds it within metres; learned from labelled pictures."""

    card = sgb.SegmenterCard(
        name="pixel_forest",
        version="1",
        title="Boosted trees on multi-scale pixel features",
        source="Ke et al., LightGBM, NeurIPS 2017; features as in Arganda-Carreras et al., Bioinformatics 33, 2017",
        ours=(
            "Lab colours, mostly relative to each picture; Gaussians, gradients, structure tensor, Hessian, spread, "
            "openings and closings at 0.5 to 8 m on the ground; 100 trees of 31 leaves a class on 3,000 pixels a "
            "picture, rare classes drawn more often and weighed less"
        ),
        licence="Apache-2.0",
        needs=("training",),
        limits="Sees at most some 16 m around a pixel: no houses, roads or fields as objects",
    )

    def learn(self, training: sgb.ImageTraining) -> str:
        """Return the trees of each class that the pictures show, as text."""
        drawn = [_Drawn.of(labelled, at) for at, labelled in enumerate(training.images)]
        values = np.concatenate([some.values for some in drawn])
        labels, weights = (np.concatenate([getattr(some, name) for some in drawn]) for name in ("labels", "weights"))
        models = {}
        for at, name in enumerate(training.classes):
            known = labels[:, at] != sgb.UNKNOWN
            present = labels[known, at] == sgb.PRESENT
            if min(present.sum(), (~present).sum()) >= _LEAST_PRESENT:
                # Boost the trees of one class; the same pixels give the same text
                lightgbm = _lightgbm()
                data = lightgbm.Dataset(values[known], label=present.astype(np.float32), weight=weights[known])
                models[name] = str(lightgbm.train(_SETTINGS, data, num_boost_round=100).model_to_string())
        if not models:
            raise ValueError(
                f"no class has {_LEAST_PRESENT} labelled pixels of either kind: give more pictures, or larger ones"
            )
        return json.dumps({"format": FORMAT, "features": drawn[0].names, "models": models})

    def segment(self, image: sgb.AerialImage, *, learned: str | None) -> sgb.Segmentation:
        """Return probabilities at every pixel; silent on patches of pure black or white."""
        if learned is None:
            raise ValueError(f"{self.card.name} needs training: learn from labelled pictures first")
        forest = _forest(learned)
        small, pixel_m = working_picture(image)
        names, planes = features(small, pixel_m)
        if list(names) != forest.features:
            raise ValueError(f"the learned text has other features than this version of {self.card.name}: learn again")
        table = np.ascontiguousarray(planes.reshape(len(names), -1).T)
        seen = has_data(small, pixel_m)
        found = np.empty((len(forest.models), *image.shape), dtype=np.float32)
        for plane, model in zip(found, forest.models.values(), strict=True):
            chances = np.asarray(model.predict(table, num_threads=1, **_STOPS), dtype=np.float32)
            plane[:] = enlarged(chances.reshape(seen.shape), image.shape)
        found[:, ~enlarged_mask(seen, image.shape)] = np.nan
        return sgb.Segmentation.of_probabilities(tuple(forest.models), found)


# 7: log-odds: P = 0.001 or 0.999; further trees move no byte that matters
_STOPS: Final = {"pred_early_stop": True, "pred_early_stop_freq": 20, "pred_early_stop_margin": 7.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Drawn:
    """Pixels drawn from a picture: features (N, F), labels (N, C), and how many pixels each stands for (N,)."""

    names: tuple[str, ...]
    values: Plane
    labels: NDArray[np.uint8]
    weights: NDArray[np.float64]

    @classmethod
    def of(cls, labelled: sgb.LabelledImage, seed: int) -> Self:
        """Draw half of the pixels evenly, and half evenly over the classes in the picture; weights undo the second."""
        small, pixel_m = working_picture(labelled.image)
        names, planes = features(small, pixel_m)
        labels = np.stack([reduced_labels(plane, small.shape[:2]) for plane in labelled.labels])
        usable = (labels != sgb.UNKNOWN).any(axis=0) & has_data(small, pixel_m)
        at = np.flatnonzero(usable)
        if not len(at):
            empty = np.empty((0, len(names)), dtype=np.float32)
            return cls(names=names, values=empty, labels=np.empty((0, len(labels)), np.uint8), weights=np.empty(0))
        chosen = labels.reshape(len(labels), -1)[:, at]
        present = chosen == sgb.PRESENT
        counts = present.sum(axis=1)
        even = np.full(len(at), 1 / len(at))
        by_class = (present[counts > 0] / counts[counts > 0, None]).mean(axis=0) if counts.any() else even
        chance = (even + by_class) / 2
        # 3000 are drawn from each picture
        picked = np.random.default_rng(seed).choice(len(at), size=3000, p=chance / chance.sum())
        values = planes.reshape(len(names), -1)[:, at[picked]].T
        weights = 1 / (len(at) * chance[picked])
        return cls(names=names, values=values, labels=chosen[:, picked].T, weights=weights)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Forest:
    """Trees by class, ready to answer."""

    features: list[str]
    models: dict[str, Any]


@lru_cache(maxsize=1)
def _forest(learned: str) -> _Forest:
    """Read the learned text; every call of a process gets the same."""
    content = json.loads(learned)
    if content.get("format") != FORMAT:
        raise ValueError(f"the learned text is not of {FORMAT}: learn again")
    make = _lightgbm().Booster
    return _Forest(
        features=content["features"],
        models={name: make(model_str=text) for name, text in content["models"].items()},
    )


def _lightgbm() -> Any:  # noqa: ANN401 - a module
    try:
        import lightgbm  # noqa: PLC0415 - the other segmenters work without it
    except OSError as error:
        raise RuntimeError(
            f"LightGBM cannot be loaded ({error}): install libgomp1 (Debian, Ubuntu) or libomp (macOS)"
        ) from error
    return lightgbm
