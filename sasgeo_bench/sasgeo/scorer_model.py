# SPDX-License-Identifier: Apache-2.0
"""Model of the scorer: rates, likeness and scales of evidence of each class, fitted and stored as JSON."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from sasgeo_bench.core.errors import ConfigError
from sasgeo_bench.sasgeo.graph import GraphRules
from sasgeo_bench.sasgeo.joint import Blend
from sasgeo_bench.sasgeo.raster import likeness_by_hand
from sasgeo_bench.sasgeo.rates import FAR, ClassRates, Tally, fit_rates, hand_rates, likeness, missed_share
from sasgeo_bench.sasgeo.weights import SEASONS, STRATA, by_hand, fit_season

START: Final = 0.01  # default: one cell in a hundred is independent
_WIDTH: Final = 0.25  # of the prior of an exponent around the common one, in logarithms


def fit_scaling(
    choices: Sequence[NDArray[np.float64]], *, start: float | Sequence[float] = START, common_width: float = 3.0
) -> NDArray[np.float64]:
    """Fit one exponent for each class, so that the softmax over modes is a calibrated probability.

    Scores sum over cells as if these were independent. The score of each class is multiplied by an exponent of its own,
    fitted by conditional logit (McFadden 1974): the probability of the right mode among those of its search is the
    softmax of the sums. Exponents are positive, with a log-normal prior around `start`, times a common factor that is
    fitted, too, with a prior of `common_width` in logarithms: it says how sure the scores are, the rest which classes
    to trust.

    `choices` are the scores by class, shape (M, C), of the modes of each search, the right one first. The result has
    shape (C,).

    Raises
    ------
    ConfigError
        If there is no search, or classes differ.

    Examples
    --------
    The first of two classes finds the place, the second is random:

    >>> rng = np.random.default_rng(0)
    >>> wrong = rng.normal(0, 100, (300, 9, 2))
    >>> right = rng.normal((200, 0), 100, (300, 1, 2))
    >>> first, second = fit_scaling(list(np.concatenate((right, wrong), axis=1)))
    >>> bool(first > 5 * second)
    True
    """
    if not choices:
        raise ConfigError("no searches to fit exponents to: the training part is empty; choose another split")
    if len({one.shape[1] for one in choices}) > 1:
        raise ConfigError("searches to fit exponents to have different classes: build their regions with one taxonomy")
    rows = np.concatenate([one - one[:1] for one in choices])
    starts = np.cumsum([0, *(len(one) for one in choices[:-1])])
    owner = np.repeat(np.arange(len(choices)), [len(one) for one in choices])

    def loss(vector: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the negative log posterior of logarithms of exponents and of the common factor, and its gradient."""
        logs, common = vector[:-1], vector[-1]
        off, exponents = (logs - begin - common) / _WIDTH**2, np.exp(logs)
        sums = rows @ exponents
        highest = np.maximum.reduceat(sums, starts)
        mass = np.exp(sums - highest[owner])
        total = np.add.reduceat(mass, starts)
        prior = (_WIDTH * off) @ (_WIDTH * off) + (common / common_width) ** 2
        value = float((np.log(total) + highest).sum() + 0.5 * prior)
        slope = ((mass / total[owner]) @ rows) * exponents + off
        return value, np.append(slope, common / common_width**2 - off.sum())

    begin = np.log(np.broadcast_to(np.asarray(start, dtype=np.float64), rows.shape[1:]))
    found = scipy.optimize.minimize(loss, np.append(begin, 0.0), jac=True, method="L-BFGS-B")
    return np.asarray(np.exp(found.x[:-1]))


VERSION: Final = 3  # of the text
_DIGITS: Final = 6
# Arrays of one class in the file, with their shapes.
_ARRAYS: Final[Mapping[str, tuple[int, ...]]] = {
    "likeness": (FAR + 1,),
    "missed_share": (),
    "temper": (),
    "seasons": (len(SEASONS),),
    "trust": (STRATA,),
}


@dataclass(frozen=True, kw_only=True)
class ScorerModel:
    """Fitted numbers of each class.

    `likeness`, shape (C, FAR + 1), is that of cells near a class on the map to cells on it; `missed_share`, shape (C,),
    the share of `Gains.missed` for one degree of it. `scaling`, shape (C,), scales the score of each class, since
    neighbouring cells are not independent (`temper` in the file). `trust`, shape (C, STRATA), is that in features by
    edit age (`weights.fit_trust`); `seasons` the visible share of a mapped class, shape (C,), by season; `blend`
    weighs the joint score, and `rules` are those of the graph of vectors. `views` and `blocks` are the size of the
    training data, 0 for a model set by hand.
    """

    classes: tuple[str, ...]
    rates: tuple[ClassRates, ...]
    likeness: NDArray[np.float64]
    missed_share: NDArray[np.float64]
    scaling: NDArray[np.float64]
    trust: NDArray[np.float64]
    seasons: Mapping[str, NDArray[np.float64]]
    blend: Blend = Blend()  # noqa: RUF009 - frozen
    rules: GraphRules = GraphRules()  # noqa: RUF009 - frozen
    views: int = 0
    blocks: int = 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ScorerModel) and self.to_text() == other.to_text()

    def __hash__(self) -> int:
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

        Tallies are by season; rates and likeness are fitted to views without one, "".

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
        """Return the model as JSON, one class a line."""
        rows = [
            f" {json.dumps(name)}: {json.dumps(_rounded(asdict(self.rates[at]) | self._shape(at)))}"
            for at, name in enumerate(self.classes)
        ]
        blend, rules = (json.dumps(_rounded(stored)) for stored in (asdict(self.blend), self.rules.to_stored()))
        counts = f'"views": {self.views}, "blocks": {self.blocks}'
        head = f'{{"version": {VERSION}, {counts}, "blend": {blend},\n "graph": {rules}, "classes": {{'
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
                raise ConfigError(f"it is of version {stored['version']}, this program reads {VERSION}")
            rows: dict[str, dict[str, Any]] = stored["classes"]
            arrays = {
                name: np.array([row.pop(name) for row in rows.values()], dtype=np.float64).reshape(-1, *shape)
                for name, shape in _ARRAYS.items()
            }
            scaling, seasons = arrays.pop("temper"), arrays.pop("seasons")
            _check(scaling, arrays | {"a season": seasons})
            return cls(
                classes=tuple(rows),
                rates=tuple(ClassRates(**row) for row in rows.values()),
                scaling=scaling,
                seasons=dict(zip(SEASONS, seasons.T, strict=True)),
                **arrays,
                blend=Blend(**stored["blend"]),
                rules=GraphRules.from_stored(stored["graph"]),
                views=int(stored["views"]),
                blocks=int(stored["blocks"]),
            )
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            raise ConfigError(f"the trained model cannot be read ({error}): train it again") from error


def _check(scaling: NDArray[np.float64], shares: Mapping[str, NDArray[np.float64]]) -> None:
    if not (np.isfinite(scaling).all() and (scaling >= 0).all()):
        raise ValueError("an exponent is negative or not finite")
    for name, values in shares.items():
        if not ((values >= 0) & (values <= 1)).all():
            raise ValueError(f"{name} is not within 0..1")


def _rounded(values: dict[str, Any]) -> dict[str, Any]:
    return {name: _short(value) for name, value in values.items()}


def _short(value: float | Mapping[str, float] | Iterable[float]) -> Any:  # noqa: ANN401 - whatever JSON holds
    if isinstance(value, float):
        return float(f"{value:.{_DIGITS}g}")
    return _rounded(dict(value)) if isinstance(value, Mapping) else [_short(one) for one in value]
