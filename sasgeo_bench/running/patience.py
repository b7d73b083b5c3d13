# SPDX-License-Identifier: Apache-2.0
"""Give up a plugin that hangs on question after question: each costs the whole time limit."""

import threading
from typing import Final

from sasgeo_bench.matching.results import Status
from sasgeo_bench.texts import one_line

GIVEN_UP: Final = "given up after"  # begins the message of those that are not asked any more


class Patience:
    """Counts questions in a row that a plugin did not answer in time, over all its processes.

    >>> patience = Patience(most_late=2)
    >>> for status in ("timeout", "ok", "timeout", "timeout"):
    ...     patience.note(status, "no answer within 30 s")
    >>> patience.given_up
    'given up after 2 queries in a row without an answer in time (no answer within 30 s)'
    """

    def __init__(self, what: str = "queries", *, most_late: int = 10) -> None:  # questions in a row
        self._what, self._most_late = what, most_late
        self._lock = threading.Lock()
        self._late = 0
        self._given_up: str | None = None

    def note(self, status: Status, message: str) -> None:
        """Record the outcome of a question."""
        with self._lock:
            self._late = self._late + 1 if status == "timeout" else 0
            if self._late == self._most_late and self._given_up is None:
                ended = f"{GIVEN_UP} {self._late} {self._what} in a row without an answer in time"
                self._given_up = one_line(f"{ended} ({message})")

    @property
    def given_up(self) -> str | None:
        """Return the message of the questions that are not asked any more, None before that."""
        with self._lock:
            return self._given_up
