# SPDX-License-Identifier: Apache-2.0
"""Scales of the evidence of each class, since neighbouring cells of a view are not independent."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from sasgeo_bench.errors import ConfigError

START: Final = 0.01  # default: one cell in a hundred is independent
_WIDTH: Final = 1.0  # of the prior, in logarithms


def fit_scaling(
    choices: Sequence[NDArray[np.float64]], *, start: float | Sequence[float] = START
) -> NDArray[np.float64]:
    """Fit one exponent for each class, so that the softmax over modes is a calibrated probability.

    Scores sum over cells as if these were independent. The score of each class is multiplied by an exponent of its own,
    fitted by conditional logit (McFadden 1974): the probability of the right mode among those of its search is the
    softmax of the sums. Exponents are positive, with a log-normal prior around `start`.

    Parameters
    ----------
    choices : sequence of ndarray of float, shape (M, C) each
        Scores by class of the modes of one search, the first of them the right one; M may differ.
    start : float or sequence of float
        Medians of the prior, shape (C,) or one for all.

    Returns
    -------
    ndarray of float, shape (C,)
        The exponents.

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
        message = "no searches to fit exponents to: the training part is empty; choose another split"
        raise ConfigError(message)
    if len({one.shape[1] for one in choices}) > 1:
        message = "searches to fit exponents to have different classes: build their regions with one taxonomy"
        raise ConfigError(message)
    rows = np.concatenate([one - one[:1] for one in choices])
    starts = np.cumsum([0, *(len(one) for one in choices[:-1])])
    owner = np.repeat(np.arange(len(choices)), [len(one) for one in choices])

    def loss(logs: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the negative log posterior and its gradient."""
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
