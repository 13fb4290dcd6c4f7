"""Ctrl-C where it may not strike at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def interrupted_after() -> Iterator[list[int]]:
    """Ctrl-C takes effect at the end; until then it is listed.

    In gmsh's callback it would be taken for any element size; while compiled modules are loaded they may crash.
    """
    before, heard = signal.getsignal(signal.SIGINT), list[int]()
    listens = threading.current_thread() is threading.main_thread() and callable(before)
    if listens:
        signal.signal(signal.SIGINT, lambda number, _: heard.append(number))
    try:
        yield heard
    finally:
        if listens:
            signal.signal(signal.SIGINT, before)
        if heard and callable(before):
            before(signal.SIGINT, None)
