# SPDX-License-Identifier: Apache-2.0
"""Model of the scorer: rates, likeness and scales of evidence of each class, stored as JSON."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from sasgeo_bench.errors import ConfigError
from sasgeo_bench.sasgeo.edit_age import STRATA
from sasgeo_bench.sasgeo.evidence_scaling import START
from sasgeo_bench.sasgeo.joint import Blend
from sasgeo_bench.sasgeo.raster import likeness_by_hand
from sasgeo_bench.sasgeo.rates import FAR, ClassRates, Tally, fit_rates, hand_rates, likeness, missed_share
from sasgeo_bench.sasgeo.seasons import SEASONS, by_hand, fit_season

VERSION: Final = 1  # of the text
DEFAULT_BLEND: Final = Blend()
_DIGITS: Final = 6


@dataclass(frozen=True, kw_only=True)
class ScorerModel:
    """Fitted numbers of each class, shape (C, ...) where an array.

    Parameters
    ----------
    classes : tuple of str
        The classes.
    rates : tuple of ClassRates
        Rates of seeing, mapping and ageing.
    likeness : ndarray of float, shape (C, FAR + 1)
        Likeness of cells near a class on the map to cells on it.
    missed_share : ndarray of float, shape (C,)
        Share of `Gains.missed` for one degree of that likeness.
    scaling : ndarray of float, shape (C,)
        Scale of the score of each class, since neighbouring cells are not independent; `temper` in the file.
    trust : ndarray of float, shape (C, STRATA)
        Trust in features by edit age: see `edit_age.fit_trust`.
    seasons : mapping of str to ndarray of float, shape (C,)
        Visible share of a mapped class, by season.
    blend : Blend
        Weights of raster, graph and contradiction in the joint score.
    views, blocks : int
        Size of the training data; 0 for a model set by hand.

    Examples
    --------
    >>> model = ScorerModel.by_hand(["railway", "water"])
    >>> ScorerModel.from_text(model.to_text()) == model
    True
    """

    classes: tuple[str, ...]
    rates: tuple[ClassRates, ...]
    likeness: NDArray[np.float64]
    missed_share: NDArray[np.float64]
    scaling: NDArray[np.float64]
    trust: NDArray[np.float64]
    seasons: Mapping[str, NDArray[np.float64]]
    blend: Blend = DEFAULT_BLEND
    views: int = 0
    blocks: int = 0

    def __eq__(self, other: object) -> bool:
        """Compare all numbers."""
        return isinstance(other, ScorerModel) and self.to_text() == other.to_text()

    def __hash__(self) -> int:
        """Hash all numbers."""
        return hash(self.to_text())

    @classmethod
    def by_hand(cls, classes: Sequence[str]) -> Self:
        """Return the model set by hand."""
        return cls(
            classes=tuple(classes),
            rates=tuple(hand_rates(name) for name in classes),
            likeness=likeness_by_hand(classes),
            missed_share=np.ones(len(classes)),
            scaling=np.full(len(classes), START),
            trust=np.ones((len(classes), STRATA)),
            seasons={season: by_hand(season, classes) for season in SEASONS},
        )

    @classmethod
    def of(cls, tallies: Mapping[str, Sequence[Tally]]) -> Self:
        """Fit rates, likeness and seasons; scales of evidence are fitted later, to searches with this model.

        Parameters
        ----------
        tallies : mapping of str to sequence of Tally
            By season; rates and likeness are fitted to views without one, "".

        Raises
        ------
        ConfigError
            If there is no tally without a season, or classes differ.
        """
        plain = tallies.get("", ())
        fitted = fit_rates(plain)
        near, rates = likeness(plain), tuple(fitted.values())
        classes = plain[0].classes
        seasons = {
            season: fit_season(season, tallies[season], rates) if tallies.get(season) else by_hand(season, classes)
            for season in SEASONS
        }
        return cls(
            classes=classes,
            rates=rates,
            likeness=near,
            missed_share=missed_share(plain, near),
            scaling=np.full(len(near), START),
            trust=np.ones((len(near), STRATA)),
            seasons=seasons,
            views=len(plain),
            blocks=len({one.block for one in plain}),
        )

    def persists(self, season: str) -> NDArray[np.float64]:
        """Return the factors of a season, shape (C,); 1 for an unknown season."""
        return self.seasons.get(season, np.ones(len(self.classes)))

    def of_classes(self, classes: Sequence[str]) -> Self:
        """Return the model for other classes, in their order; numbers by hand for classes that it lacks."""
        hand = self.by_hand([name for name in classes if name not in self.classes])
        both = self.classes + hand.classes
        at = [both.index(name) for name in classes]
        rates = self.rates + hand.rates
        return replace(
            self,
            classes=tuple(classes),
            rates=tuple(rates[index] for index in at),
            likeness=np.concatenate((self.likeness, hand.likeness))[at],
            missed_share=np.concatenate((self.missed_share, hand.missed_share))[at],
            scaling=np.concatenate((self.scaling, hand.scaling))[at],
            trust=np.concatenate((self.trust, hand.trust))[at],
            seasons={name: np.concatenate((self.seasons[name], hand.seasons[name]))[at] for name in SEASONS},
        )

    def to_text(self) -> str:
        """Return the model as JSON, one class a line.

        Examples
        --------
        >>> ScorerModel.by_hand(["water"]).to_text().splitlines()[0]
        '{"version": 1, "views": 0, "blocks": 0, "blend": {"alpha": 1.0, "beta": 0.5, "eta": 0.1}, "classes": {'
        """
        rows = [
            f" {json.dumps(name)}: {json.dumps(_rounded(asdict(self.rates[at]) | self._shape(at)))}"
            for at, name in enumerate(self.classes)
        ]
        blend = json.dumps(_rounded(asdict(self.blend)))
        counts = f'"views": {self.views}, "blocks": {self.blocks}'
        head = f'{{"version": {VERSION}, {counts}, "blend": {blend}, "classes": {{'
        return "\n".join((head, ",\n".join(rows), "}}"))

    def _shape(self, at: int) -> dict[str, Any]:
        return {
            "likeness": self.likeness[at].tolist(),
            "missed_share": float(self.missed_share[at]),
            "temper": float(self.scaling[at]),
            "trust": self.trust[at].tolist(),
            "seasons": [float(self.seasons[season][at]) for season in SEASONS],
        }

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Read a model from JSON, or raise ConfigError."""
        try:
            stored = json.loads(text)
            if stored["version"] != VERSION:
                message = f"it is of version {stored['version']}, this program reads {VERSION}"
                raise ConfigError(message)
            rows: dict[str, dict[str, Any]] = stored["classes"]
            shapes = [
                [row.pop(name) for name in ("likeness", "missed_share", "temper", "seasons", "trust")]
                for row in rows.values()
            ]
            near = np.array([shape[0] for shape in shapes], dtype=np.float64).reshape(-1, FAR + 1)
            shares, scaling = (np.array([shape[at] for shape in shapes], dtype=np.float64) for at in (1, 2))
            seasons = np.array([shape[3] for shape in shapes], dtype=np.float64).reshape(-1, len(SEASONS))
            trust = np.array([shape[4] for shape in shapes], dtype=np.float64).reshape(-1, STRATA)
            _check(near, shares, scaling, seasons, trust)
            return cls(
                classes=tuple(rows),
                rates=tuple(ClassRates(**row) for row in rows.values()),
                likeness=near,
                missed_share=shares,
                scaling=scaling,
                trust=trust,
                seasons=dict(zip(SEASONS, seasons.T, strict=True)),
                blend=Blend(**stored["blend"]),
                views=int(stored["views"]),
                blocks=int(stored["blocks"]),
            )
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            message = f"the trained model cannot be read ({error}): train it again"
            raise ConfigError(message) from error


def _check(
    near: NDArray[np.float64],
    shares: NDArray[np.float64],
    scaling: NDArray[np.float64],
    seasons: NDArray[np.float64],
    trust: NDArray[np.float64],
) -> None:
    """Raise ValueError for numbers out of range."""
    if not (np.isfinite(scaling).all() and (scaling >= 0).all()):
        message = "an exponent is negative or not finite"
        raise ValueError(message)
    for name, values in (("likeness", near), ("missed_share", shares), ("a season", seasons), ("trust", trust)):
        if not ((values >= 0) & (values <= 1)).all():
            message = f"{name} is not within 0..1"
            raise ValueError(message)


def _rounded(values: dict[str, Any]) -> dict[str, Any]:
    """Round to six significant digits."""
    return {name: _short(value) for name, value in values.items()}


def _short(value: float | Iterable[float]) -> Any:  # noqa: ANN401 - whatever JSON holds
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else [_short(one) for one in value]
