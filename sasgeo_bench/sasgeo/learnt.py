# SPDX-License-Identifier: Apache-2.0
"""What the scorer has learnt of classes: rates, likeness, exponents; from train places, as text that can be read."""

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
class Learnt:
    """What is known of each class, shape (C, ...) where an array.

    Parameters
    ----------
    classes : tuple of str
        The classes.
    rates : tuple of ClassRates
        How each is seen, mapped and outlived.
    likeness : ndarray of float, shape (C, FAR + 1)
        How much being near a class on the map is like being on it.
    missed_share : ndarray of float, shape (C,)
        How much of `Gains.missed` one degree of that likeness is worth.
    temper : ndarray of float, shape (C,)
        What the score of each is multiplied with: neighbouring cells say the same.
    trust : ndarray of float, shape (C, STRATA)
        How much a feature is worth by its own age: see `edit_age.fit_trust`.
    seasons : mapping of str to ndarray of float, shape (C,)
        By season, what share of a mapped class can still be seen.
    blend : Blend
        Weights of raster, graph and contradiction in the joint score.
    views, blocks : int
        How much it was learnt from; 0 for what was set by hand.

    Examples
    --------
    >>> said = Learnt.by_hand(["railway", "water"])
    >>> Learnt.from_text(said.to_text()) == said
    True
    """

    classes: tuple[str, ...]
    rates: tuple[ClassRates, ...]
    likeness: NDArray[np.float64]
    missed_share: NDArray[np.float64]
    temper: NDArray[np.float64]
    trust: NDArray[np.float64]
    seasons: Mapping[str, NDArray[np.float64]]
    blend: Blend = DEFAULT_BLEND
    views: int = 0
    blocks: int = 0

    def __eq__(self, other: object) -> bool:
        """Whether both say the same, number for number."""
        return isinstance(other, Learnt) and self.to_text() == other.to_text()

    def __hash__(self) -> int:
        """Hash of what it says."""
        return hash(self.to_text())

    @classmethod
    def by_hand(cls, classes: Sequence[str]) -> Self:
        """What is set where nothing was measured."""
        return cls(
            classes=tuple(classes),
            rates=tuple(hand_rates(name) for name in classes),
            likeness=likeness_by_hand(classes),
            missed_share=np.ones(len(classes)),
            temper=np.full(len(classes), START),
            trust=np.ones((len(classes), STRATA)),
            seasons={season: by_hand(season, classes) for season in SEASONS},
        )

    @classmethod
    def of(cls, tallies: Mapping[str, Sequence[Tally]]) -> Self:
        """Learn rates, likeness and seasons; exponents are learnt afterwards, from searches made with these.

        Parameters
        ----------
        tallies : mapping of str to sequence of Tally
            By season; "" for views that tell none, from which rates and likeness come.

        Raises
        ------
        ConfigError
            If there is no tally without a season, or classes differ.
        """
        plain = tallies.get("", ())
        fitted = fit_rates(plain)
        near, rates = likeness(plain), tuple(one.best for one in fitted.values())
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
            temper=np.full(len(near), START),
            trust=np.ones((len(near), STRATA)),
            seasons=seasons,
            views=len(plain),
            blocks=len({one.block for one in plain}),
        )

    def persists(self, season: str) -> NDArray[np.float64]:
        """Factors of a season, shape (C,); all 1 where a view tells none."""
        return self.seasons.get(season, np.ones(len(self.classes)))

    def of_classes(self, classes: Sequence[str]) -> Self:
        """The same for other classes in another order; what was not learnt is as by hand."""
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
            temper=np.concatenate((self.temper, hand.temper))[at],
            trust=np.concatenate((self.trust, hand.trust))[at],
            seasons={name: np.concatenate((self.seasons[name], hand.seasons[name]))[at] for name in SEASONS},
        )

    def to_text(self) -> str:
        """As JSON, a class a line.

        Examples
        --------
        >>> Learnt.by_hand(["water"]).to_text().splitlines()[0]
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
            "temper": float(self.temper[at]),
            "trust": self.trust[at].tolist(),
            "seasons": [float(self.seasons[season][at]) for season in SEASONS],
        }

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Read it back.

        Raises
        ------
        ConfigError
            If it is not what `to_text` gives.
        """
        try:
            said = json.loads(text)
            if said["version"] != VERSION:
                message = f"it is of version {said['version']}, this program reads {VERSION}"
                raise ConfigError(message)
            rows: dict[str, dict[str, Any]] = said["classes"]
            shapes = [
                [row.pop(name) for name in ("likeness", "missed_share", "temper", "seasons", "trust")]
                for row in rows.values()
            ]
            near = np.array([shape[0] for shape in shapes], dtype=np.float64).reshape(-1, FAR + 1)
            shares, temper = (np.array([shape[at] for shape in shapes], dtype=np.float64) for at in (1, 2))
            seasons = np.array([shape[3] for shape in shapes], dtype=np.float64).reshape(-1, len(SEASONS))
            trust = np.array([shape[4] for shape in shapes], dtype=np.float64).reshape(-1, STRATA)
            _check(near, shares, temper, seasons, trust)
            return cls(
                classes=tuple(rows),
                rates=tuple(ClassRates(**row) for row in rows.values()),
                likeness=near,
                missed_share=shares,
                temper=temper,
                trust=trust,
                seasons=dict(zip(SEASONS, seasons.T, strict=True)),
                blend=Blend(**said["blend"]),
                views=int(said["views"]),
                blocks=int(said["blocks"]),
            )
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            message = f"what was learnt cannot be read ({error}): learn it again"
            raise ConfigError(message) from error


def _check(
    near: NDArray[np.float64],
    shares: NDArray[np.float64],
    temper: NDArray[np.float64],
    seasons: NDArray[np.float64],
    trust: NDArray[np.float64],
) -> None:
    """Refuse numbers that no class can have."""
    if not (np.isfinite(temper).all() and (temper >= 0).all()):
        message = "an exponent is negative or not finite"
        raise ValueError(message)
    for name, values in (("likeness", near), ("missed_share", shares), ("a season", seasons), ("trust", trust)):
        if not ((values >= 0) & (values <= 1)).all():
            message = f"{name} is not within 0..1"
            raise ValueError(message)


def _rounded(values: dict[str, Any]) -> dict[str, Any]:
    """Six significant digits: more would say more than was measured."""
    return {name: _short(value) for name, value in values.items()}


def _short(value: float | Iterable[float]) -> Any:  # noqa: ANN401 - whatever JSON holds
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else [_short(one) for one in value]
