# SPDX-License-Identifier: Apache-2.0
"""P(false fix) of a user's pictures: fitted on answers to real pictures that taught the segmenter nothing."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Annotated, Final, Self

import numpy as np
from pydantic import Field

from sasgeo_bench.core.config import JsonDocument, check_document
from sasgeo_bench.core.json import parse_json
from sasgeo_bench.geometry.pose import Pose, Prior
from sasgeo_bench.matching.matcher import Prediction
from sasgeo_bench.observing.pictures import OwnPicture, Sight
from sasgeo_bench.sasgeo.rejectors import FittedModel, Frame, Linear, SasgeoLogistic

FILE: Final = "chances.json"
_AWAY_M: Final = 1000.0  # where the rival of a stored answer stands: outside any tolerance


class StoredFit(JsonDocument):
    """The fit of `sasgeo_logistic` on all rows of `Answers`, so that `locate` fits nothing; a spread of None: no end.

    `benchmarks/own_pictures.py --write` stores it.
    """

    medians: tuple[float, ...]
    is_flagged: tuple[bool, ...]
    means: tuple[float, ...]
    spreads: tuple[float | None, ...]
    weights: tuple[float, ...]
    intercept: float
    answers: int

    @classmethod
    def of(cls, model: FittedModel) -> Self:
        """Return a fit as it is stored."""
        frame, line = model.frame, model.log_odds
        if not isinstance(line, Linear):
            raise TypeError(f"no logistic fit: {line!r}")
        return cls(
            medians=tuple(frame.medians.tolist()),
            is_flagged=tuple(frame.is_flagged.tolist()),
            means=tuple(frame.means.tolist()),
            spreads=tuple(value if math.isfinite(value) else None for value in frame.spreads.tolist()),
            weights=tuple(line.weights.tolist()),
            intercept=line.intercept,
            answers=model.answers,
        )

    def model(self) -> FittedModel:
        """Return the fit."""
        frame = Frame(
            medians=np.array(self.medians),
            is_flagged=np.array(self.is_flagged, dtype=bool),
            means=np.array(self.means),
            spreads=np.array([math.inf if value is None else value for value in self.spreads]),
        )
        return FittedModel(
            frame=frame,
            log_odds=Linear(weights=np.array(self.weights), intercept=self.intercept),
            answers=self.answers,
        )


class Answers(JsonDocument):
    """Answers of one matcher to pictures seen by one segmenter, as far as P(false fix) is fitted on them.

    A row of `rows` holds the place's number in `places`, whether the answer was false (1) or right (0), its lead over
    the best rival, its confidence and its diagnostics in the order of `diagnostics`; None where there is none.
    `segmenters` share the recipe of the one that was asked. `sides_m`, `gsd_m`, `radius_m`, `yaw_sigma_deg` and
    `scale_sigma` are least and most of the views and priors.
    """

    matcher: str
    version: str
    segmenters: tuple[str, ...]
    asked: str
    places: tuple[str, ...]
    sides_m: tuple[float, float]
    most_gsd_m: float
    most_radius_m: float
    most_yaw_sigma_deg: float
    most_scale_sigma: float
    diagnostics: tuple[str, ...]
    rows: Annotated[tuple[tuple[float | None, ...], ...], Field(min_length=1)]
    fit: StoredFit | None = None

    def predictions(self) -> list[Prediction]:
        """Return the answers as a rejector reads them: a first pose, and a rival by its lead."""
        here, away = (Pose(easting_m=east_m, northing_m=0.0, yaw_deg=0.0) for east_m in (0.0, _AWAY_M))
        found = []
        for _, _, lead, confidence, *numbers in self.rows:
            pairs = zip(self.diagnostics, numbers, strict=True)
            found.append(
                Prediction(
                    query_id="",
                    candidates=((here, lead or 0.0), (away, 0.0)),
                    confidence=confidence,
                    diagnostics={name: number for name, number in pairs if number is not None},
                )
            )
        return found

    @property
    def is_false(self) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
        """Return which answers were false, shape (N,)."""
        return np.array([row[1] == 1 for row in self.rows], dtype=bool)

    @property
    def text(self) -> str:
        """Return on what P(false fix) was calibrated, in a line."""
        places = ", ".join(self.places)
        return (
            f"calibrated on {len(self.rows)} answers of {self.matcher} to real pictures of {places}, places from which "
            f"{self.asked} had not learned"
        )

    def unlike(self, picture: OwnPicture, sight: Sight, prior: Prior) -> str:
        """Return in what a picture differs from those that P(false fix) was calibrated on; empty where in nothing."""
        least_m, most_m = self.sides_m
        gsd_m = sight.side_m / min(sight.image.shape) if sight.image.shape else 0.0
        faults = [
            (not least_m <= sight.side_m <= most_m, f"a view of {sight.side_m:.0f} m, not {least_m:g} to {most_m:g}"),
            (gsd_m > 1.2 * self.most_gsd_m, f"pixels of {gsd_m:.1f} m, more than {self.most_gsd_m:.1f}"),
            (prior.radius_m is None, "a whole map searched"),
            ((prior.radius_m or 0) > self.most_radius_m, f"a disc of more than {self.most_radius_m:g} m"),
            (prior.yaw_deg is None, "an unknown heading"),
            ((prior.yaw_sigma_deg or 0) > self.most_yaw_sigma_deg, "a vague heading"),
            (prior.scale_sigma > self.most_scale_sigma, f"a size known to {100 * prior.scale_sigma:.0f} % only"),
            (picture.tilt_deg > 10, f"a camera tilted by {picture.tilt_deg:.0f} degrees"),
        ]
        found = [words for is_fault, words in faults if is_fault]
        return f"not calibrated on pictures like yours: {', '.join(found)}" if found else ""


@cache
def shipped_answers() -> tuple[Answers, ...]:
    """Return the answers that ship, one for each matcher and segmenter."""
    data = resources.files("sasgeo_bench.observing").joinpath(FILE).read_bytes()
    return tuple(check_document(item, Answers, source=FILE) for item in parse_json(data))


@cache
def stored_sha256() -> str:
    """Return the hash of the file of answers that ships."""
    return hashlib.sha256(resources.files("sasgeo_bench.observing").joinpath(FILE).read_bytes()).hexdigest()


def answers_for(matcher: str, version: str, segmenter: str) -> Answers | None:
    """Return the answers that fit a matcher of a version and a segmenter; None where none ship."""
    for one in shipped_answers():
        if (one.matcher, one.version) == (matcher, version) and segmenter in one.segmenters:
            return one
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Chances:
    """A rejector that was fitted on stored answers."""

    answers: Answers
    rejector: SasgeoLogistic

    @classmethod
    def of(cls, answers: Answers) -> "Chances":
        """Return `sasgeo_logistic` as its fit is stored, or fitted where none is."""
        if answers.fit is None:
            return cls.fitted(answers)
        return cls(answers=answers, rejector=SasgeoLogistic(answers.fit.model()))

    @classmethod
    def fitted(cls, answers: Answers, *, without: Sequence[str] = ()) -> "Chances":
        """Fit `sasgeo_logistic`, without the answers of some places if these are named."""
        kept = [answers.places[int(row[0] or 0)] not in without for row in answers.rows]
        items = [item for item, is_kept in zip(answers.predictions(), kept, strict=True) if is_kept]
        rejector = SasgeoLogistic()
        rejector.fit(items, answers.is_false[np.array(kept)])
        return cls(answers=answers, rejector=rejector)

    def p_false(self, answer: Prediction) -> float:
        """Return the probability that an answer is a false fix."""
        return float(self.rejector.p_false([answer])[0])
