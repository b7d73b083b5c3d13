# SPDX-License-Identifier: Apache-2.0
"""Random numbers by name, so that what is drawn for one class depends on no other class."""

import hashlib

import numpy as np
from numpy.typing import NDArray


class Streams:
    """Generators by name, all seeded by one draw from a given generator.

    A name always gets the same generator, which goes on where it was left. So a class more or less, or another order
    of the classes, leaves the draws of every other class as they are.

    Examples
    --------
    >>> def drawn(*names):
    ...     streams = Streams(np.random.default_rng(1))
    ...     return {name: streams.of(name).random() for name in names}
    >>> drawn("road", "water", "tree")["tree"] == drawn("tree")["tree"]
    True
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._root = rng.integers(0, 2**32, size=4, dtype=np.uint32).tolist()
        self._made: dict[str, np.random.Generator] = {}

    def of(self, name: str) -> np.random.Generator:
        """Return the generator of a name."""
        if name not in self._made:
            digest = hashlib.sha256(name.encode()).digest()
            self._made[name] = np.random.default_rng((*self._root, int.from_bytes(digest[:16], "big")))
        return self._made[name]

    def chances(self, names: NDArray[np.object_], count: int) -> NDArray[np.float64]:
        """Return `count` numbers in [0, 1) for each thing from the stream of its class, shape (count, len(names))."""
        found = np.empty((count, len(names)))
        for name in dict.fromkeys(names.tolist()):
            own = names == name
            found[:, own] = self.of(name).random((int(own.sum()), count)).T
        return found

    @property
    def view(self) -> np.random.Generator:
        """Return the generator of what all classes share."""
        # The name of what is drawn once for all classes; no class has spaces in its name
        return self.of("the whole view")
