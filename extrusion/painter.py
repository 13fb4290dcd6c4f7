"""Pictures from a process of their own, which loads matplotlib on a core that the run leaves free.

Neither MPI nor PETSc is loaded there: a rank's child must not start MPI.
"""

from __future__ import annotations

import importlib.util
import os
import pickle
import signal
import subprocess
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from extrusion import plots
from extrusion.plots import Record


class Painter:
    """Draws the pictures of a run.

    By another process, begun here, which is ready when the run is; or by this one, where no core is free or matplotlib
    has been loaded, and wherever the other process does not manage.

    Args:
        ranks: Processes that the run keeps busy.
    """

    def __init__(self, ranks: int) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if "matplotlib" in sys.modules or not available() or not sys.executable or ranks >= cores():
            return
        # with the modules of this process, not those of the folder it is in
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C ends the run, which still has its pictures drawn
            )
        except OSError:
            return
        weakref.finalize(self, _end, self._process)

    def write(self, record: Record, folder: Path) -> None:
        """Draw every kind of picture there is data for.

        Raises:
            InputError: As `extrusion.plots.write`.
        """
        process, self._process = self._process, None
        if process is not None:
            with suppress(pickle.PicklingError, AttributeError, TypeError), _no_broken_pipe():
                # not a case of the user's own kind
                process.communicate(pickle.dumps((record, str(folder.absolute()))))
            if process.returncode == 0:
                return
            _kill(process)
        plots.write(record, folder)


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available() -> bool:
    """Whether matplotlib is installed."""
    return importlib.util.find_spec("matplotlib") is not None


def _end(process: subprocess.Popen[bytes]) -> None:
    """The run has come to nothing, or its pictures are drawn."""
    if process.poll() is None:
        _kill(process)
        process.wait()
    if process.stdin is not None:
        process.stdin.close()


@contextmanager
def _no_broken_pipe() -> Iterator[None]:
    """Writing to a process that has gone is no signal, by which PETSc would end this one."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGPIPE})
    try:
        yield
    finally:
        if signal.SIGPIPE in signal.sigpending():
            signal.sigwait({signal.SIGPIPE})
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """And the one that it has begun."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def main() -> None:
    """Draw the record that comes through standard input, billet.png by one process and the rest by another."""
    from matplotlib import collections, figure  # noqa: F401  while the run is solved
    from matplotlib.backends import backend_agg  # noqa: F401

    given = sys.stdin.buffer.read()
    if not given:
        return
    record, folder = pickle.loads(given)
    first, *rest = plots.KINDS
    child = os.fork()
    plots.write(record, folder, [first] if child == 0 else rest)
    status = 0 if child == 0 else os.waitpid(child, 0)[1]
    os._exit(int(status != 0))  # the interpreter would take as long to tidy up as to draw
