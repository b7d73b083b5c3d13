# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and the signals of a system that stops, also while libraries are imported; this file imports none of ours."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread, get_ident
from time import sleep
from traceback import walk_stack
from types import FrameType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

EXIT_INTERRUPTED: Final = 128 + signal.SIGINT
# Which else end a program without a word, and leave what it began; Windows has no SIGHUP
_OTHERS: Final = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
_PAUSE_S: Final = 0.01  # after which an interrupt that Python dropped comes again
_received: list[int] = []  # of these, in this process: a KeyboardInterrupt does not state which it was


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Let the signals of a system that stops end the program as Ctrl-C does; one that is ignored (`nohup`) stays so.

    An interrupt that comes in a destructor or in a callback of a weak reference is dropped by Python: it is sent again.
    """

    def stop(number: int, _: FrameType | None) -> None:
        """Do as Ctrl-C does, and remember who asked."""
        _received.append(number)
        raise KeyboardInterrupt

    def send_again(dropped: "UnraisableHookArgs") -> None:
        """Send an interrupt again that Python dropped, a little later; everything else is printed as before."""
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            print_dropped(dropped)
            return
        number = _received[-1] if _received else signal.SIGINT
        Thread(target=send, args=(number, get_ident()), daemon=True).start()

    def send(number: int, thread: int) -> None:
        """Send a signal once the hook has returned, however busy the machine is: what is raised in it is lost."""
        is_inside = True
        while is_inside:
            sleep(_PAUSE_S)
            frame = sys._current_frames().get(thread)  # noqa: SLF001 - documented
            stack = [] if frame is None else [each.f_code for each, _ in walk_stack(frame)]
            is_inside = send_again.__code__ in stack
        if sys.platform == "win32":  # where `os.kill` ends the process
            signal.raise_signal(number)
        else:
            os.kill(os.getpid(), number)

    print_dropped = sys.unraisablehook
    sys.unraisablehook = send_again
    taken = [number for number in _OTHERS if signal.getsignal(number) is signal.SIG_DFL]
    for number in taken:
        signal.signal(number, stop)
    try:
        yield
    finally:
        sys.unraisablehook = print_dropped
        _received.clear()
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def exit_interrupted() -> int:
    """Return the exit status of an interrupted program: 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP."""
    return 128 + _received[-1] if _received else EXIT_INTERRUPTED


def is_interrupt(error: BaseException | None) -> bool:
    """Return whether an error is Ctrl-C, or what a library made of it while it was being imported.

    >>> error = RuntimeError("cannot be imported")
    >>> error.__cause__ = KeyboardInterrupt()
    >>> is_interrupt(error)
    True
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
