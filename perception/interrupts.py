"""Handlers of the signals that end a program, for the length of a block."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def handled(handler: Callable[[int, Any], object], *numbers: int) -> Iterator[None]:
    """`handler` gets these signals inside the block. Threads other than the main get none, so nothing is done there."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old if old is not None else signal.SIG_DFL)


def ends_as_ctrl_c() -> AbstractContextManager[None]:
    """Inside the block SIGTERM, and SIGHUP where it is not ignored, as by nohup, raise KeyboardInterrupt."""
    hang_up = () if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else (signal.SIGHUP,)
    return handled(signal.default_int_handler, signal.SIGTERM, *hang_up)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Holds SIGINT and SIGTERM back until the block has ended, where a state is between two valid ones."""
    held: list[int] = []
    try:
        with handled(lambda number, _: held.append(number), *ENDING):
            yield
    finally:
        for caught in held[:1]:
            signal.raise_signal(caught)
