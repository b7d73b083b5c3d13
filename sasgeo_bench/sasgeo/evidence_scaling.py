# SPDX-License-Identifier: Apache-2.0
"""How much of a class's score is news: neighbouring cells repeat each other, those of a meadow more than a road's."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from sasgeo_bench.errors import ConfigError

START: Final = 0.01  # one cell in a hundred is news: what a class is worth that no view tells of
_WIDTH: Final = 1.0  # of the prior around it, in logarithms


def fit_temper(
    choices: Sequence[NDArray[np.float64]], *, start: float | Sequence[float] = START
) -> NDArray[np.float64]:
    """Estimate one exponent for each class, so that the right mode of a search has the probability it deserves.

    Scores add cells up as if they were independent. Here the score of each class is multiplied by an exponent of its
    own, found by conditional logit (McFadden 1974): the chance of the right place among the modes of its search is the
    softmax of the sums. Exponents are positive, with a log-normal prior around `start`.

    Parameters
    ----------
    choices : sequence of ndarray of float, shape (M, C) each
        Scores by class of the modes of one search, the first of them the right one; M may differ.
    start : float or sequence of float
        What they are where no search tells, shape (C,) or for all.

    Returns
    -------
    ndarray of float, shape (C,)
        The exponents.

    Raises
    ------
    ConfigError
        If there is none, or they differ in their classes.

    Examples
    --------
    Of two classes the first tells the place, the second misleads as often as not:

    >>> rng = np.random.default_rng(0)
    >>> wrong = rng.normal(0, 100, (300, 9, 2))
    >>> right = rng.normal((200, 0), 100, (300, 1, 2))
    >>> first, second = fit_temper(list(np.concatenate((right, wrong), axis=1)))
    >>> bool(first > 5 * second)
    True
    """
    if not choices:
        message = "no searches to learn exponents from: the train part is empty; choose another split"
        raise ConfigError(message)
    if len({one.shape[1] for one in choices}) > 1:
        message = "searches to learn exponents from have different classes: build their regions with one taxonomy"
        raise ConfigError(message)
    rows = np.concatenate([one - one[:1] for one in choices])
    starts = np.cumsum([0, *(len(one) for one in choices[:-1])])
    owner = np.repeat(np.arange(len(choices)), [len(one) for one in choices])

    def loss(logs: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Negative log posterior and its slope."""
        exponents = np.exp(logs)
        sums = rows @ exponents
        highest = np.maximum.reduceat(sums, starts)
        mass = np.exp(sums - highest[owner])
        total = np.add.reduceat(mass, starts)
        value = float((np.log(total) + highest).sum() + 0.5 * (((logs - begin) / _WIDTH) ** 2).sum())
        slope = ((mass / total[owner]) @ rows) * exponents + (logs - begin) / _WIDTH**2
        return value, slope

    begin = np.log(np.broadcast_to(np.asarray(start, dtype=np.float64), rows.shape[1:]))
    found = optimize.minimize(loss, begin, jac=True, method="L-BFGS-B")
    return np.asarray(np.exp(found.x))


def choice_probability(scores: NDArray[np.float64], temper: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probability of each mode, given that it is one of them; shape (M,) from scores by class of shape (M, C).

    Examples
    --------
    >>> choice_probability(np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, 1.0])).tolist()
    [0.5, 0.5]
    """
    return np.asarray(special.softmax(scores @ temper))
