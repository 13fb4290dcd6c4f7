"""Files from accepted steps: tables, fields for ParaView, and the data of pictures.

What is here observes a run (`extrusion.result.run`): it is called on every rank, and rank 0 writes. A table is flushed
after each step, so a run that fails, or is stopped, leaves its accepted steps behind.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

from mpi4py import MPI

import numpy as np

from dolfinx.io import VTXMeshPolicy, VTXWriter

import extrusion
from extrusion import plots
from extrusion.cases import Case, to_toml
from extrusion.errors import InputError
from extrusion.mesh import on_root
from extrusion.problem import Problem
from extrusion.result import Array, Observer, Result, Snapshots
from extrusion.stepping import Step

log = logging.getLogger(__name__)


def write_on_root[T](comm: MPI.Intracomm, path: Path, write: Callable[[], T]) -> T | None:
    """What `write` gives on rank 0, None elsewhere. Collective.

    Raises:
        InputError: On every rank, if the system refuses.
    """

    def attempt() -> T:
        try:
            return write()
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError("out", str(path), f"cannot be written ({reason}); give another folder") from None

    return on_root(comm, attempt)


class Folder:
    """The folder of a run: ``history.csv``, ``contact.csv``, ``fields.bp``, ``snapshots.npz``, ``run.json``, pictures.

    To be made when the input is known to be good. A folder that is there is used again. Collective.

    Args:
        path: Where; parents are made too.
        comm: The ranks of the run.

    Raises:
        InputError: On every rank, if the folder cannot be written.
    """

    def __init__(self, path: str | Path, comm: MPI.Intracomm) -> None:
        self.path, self._comm = Path(path), comm
        self.observers: list[Observer] = [History(path), Contact(path), Fields(path)]

        def make() -> None:
            self.path.mkdir(parents=True, exist_ok=True)
            (self.path / "history.csv").touch()
            for name in ("run.json", "snapshots.npz", *(f"{kind}.png" for kind in plots.KINDS)):
                (self.path / name).unlink(missing_ok=True)  # an earlier run's

        write_on_root(comm, self.path, make)

    def finish(self, result: Result, options: dict[str, Any]) -> None:
        """Write the result, and draw it if matplotlib is there. Collective."""
        began = time.perf_counter()

        def draw() -> None:
            if result.snapshots is not None:
                np.savez_compressed(self.path / "snapshots.npz", **vars(result.snapshots))
            if importlib.util.find_spec("matplotlib") is None:
                log.warning('pictures skipped: matplotlib is not installed (pip install "extrusion[plot]")')
            elif result.steps:
                plots.write(plots.Record.of(result), self.path)

        def write() -> None:
            text = json.dumps(run_record(result, options), indent=1, allow_nan=False)
            (self.path / "run.json").write_text(text + "\n", encoding="utf-8")

        write_on_root(self._comm, self.path, draw)
        result.seconds["output"] += time.perf_counter() - began
        write_on_root(self._comm, self.path, write)


def run_record(result: Result, options: dict[str, Any]) -> dict[str, Any]:
    """``run.json``: the result, why it stopped, and what it takes to repeat it (the case as it was run, as TOML)."""
    given = {name: value for name, value in options.items() if value is not None}
    return {
        **result.to_dict(),
        "error": result.error,
        "version": extrusion.__version__,
        "options": given,
        "toml": to_toml(result.case),
    }


class _Table:
    """A CSV file in a folder, opened at the first rows."""

    name: str

    def __init__(self, folder: str | Path) -> None:
        self._path = Path(folder) / self.name
        self._file: TextIO | None = None

    def _write(self, comm: MPI.Intracomm, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Append rows; floats are written so that they read back the same. Collective."""

        def write() -> None:
            if self._file is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open("w", encoding="utf-8")
                self._file.write(",".join(header) + "\n")
            self._file.writelines(",".join(map(str, row)) + "\n" for row in rows)
            self._file.flush()

        write_on_root(comm, self._path, write)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class History(_Table):
    """``history.csv``: one line a step. mm, N, N mm; ``u_r_K``, ``gap_L`` and the like at named points."""

    name = "history.csv"

    def __call__(self, problem: Problem, step: Step) -> None:
        """Write a step."""
        row: dict[str, object] = {"t": step.t}
        for name, (u_r, u_y) in step.points.items():
            row |= {f"u_r_{name}": u_r, f"u_y_{name}": u_y}
        for key in ("reaction", "die_reaction", "energy", "iterations", "passes", "cuts", "residual"):
            row[key] = getattr(step, key)
        row |= {f"gap_{name}": gap for name, gap in step.gap.items()}
        self._write(problem.comm, list(row), [list(row.values())])


class Contact(_Table):
    """``contact.csv``: one line a step and contact point, along the slave surface of each zone.

    mm and MPa; `pressure` is normal to the die, `ray_pressure` its part along the zone's ray, per reference area;
    `weight` (mm^2) is the area that the point stands for; `closed` is 1 where contact acts (or, if it is only checked,
    where the bodies interpenetrate).
    """

    name = "contact.csv"

    def __call__(self, problem: Problem, step: Step) -> None:
        """Write a step."""
        header = ("t", "zone", "s", "r", "y", "gap", "pressure", "ray_pressure", "weight", "closed")
        rows = [
            (step.t, zone, *values)
            for zone, state in step.zones.items()
            for values in zip(
                *(
                    a.tolist()
                    for a in (
                        state.s,
                        *state.x.T,
                        state.gap,
                        state.pressure,
                        state.ray_pressure,
                        state.weight,
                    )
                ),
                state.closed.astype(int).tolist(),
                strict=True,
            )
        ]
        self._write(problem.comm, header, rows)


class Fields:
    """``fields.bp`` for ParaView: displacement (mm) and von Mises stress (MPa, cell means) of both bodies."""

    def __init__(self, folder: str | Path) -> None:
        self._path = Path(folder) / "fields.bp"
        self._writer: VTXWriter | None = None

    def __call__(self, problem: Problem, step: Step) -> None:
        """Write a step. Collective."""
        fields = problem.stress_fields(step.x)
        if self._writer is None:
            write_on_root(problem.comm, self._path, lambda: self._path.parent.mkdir(parents=True, exist_ok=True))
            self._writer = VTXWriter(problem.comm, self._path, [*fields.values()], mesh_policy=VTXMeshPolicy.reuse)
        self._writer.write(step.t)

    def close(self) -> None:
        """Close the file. Collective."""
        if self._writer is not None:
            self._writer.close()


class Camera:
    """Takes the steps nearest to some t, and the last one, as `Snapshots` on rank 0.

    Args:
        case: Its increments say which steps are nearest.
        wanted: t, mm.
    """

    def __init__(self, case: Case, wanted: Sequence[float]) -> None:
        times = case.times()
        self._wanted = {min(times, key=lambda t: abs(t - target)) for target in wanted}
        self._taken: dict[float, tuple[Array, Array]] = {}
        self._last: tuple[Problem, Step] | None = None  # not taken yet
        self._vertices: np.ndarray | None = None  # this rank's vertex dofs

    def __call__(self, problem: Problem, step: Step) -> None:
        """Take a step if it is wanted. Collective."""
        self._last = problem, step
        if step.t in self._wanted:
            self._take(problem, step)

    def close(self) -> None:
        """Take the last step. Collective."""
        if self._last is not None:
            self._take(*self._last)

    def _take(self, problem: Problem, step: Step) -> None:
        self._last = None
        if self._vertices is None:
            self._survey(problem)
        fields = problem.stress_fields(step.x)
        u = problem.comm.gather(fields["displacement"].x.array.reshape(-1, 2)[self._vertices])
        mises = problem.comm.gather(fields["von_mises"].x.array[: self._cells])
        if u is not None:
            self._taken[step.t] = np.concatenate(u)[self._first], np.concatenate(mises)

    def _survey(self, problem: Problem) -> None:
        """Vertices and triangles of all ranks, each vertex once."""
        V, msh, comm = problem.V, problem.tagged.msh, problem.comm
        self._cells = msh.topology.index_map(2).size_local
        corners = V.dofmap.list[: self._cells, :3]
        self._vertices, local = np.unique(corners, return_inverse=True)
        number = V.dofmap.index_map.local_to_global(self._vertices.astype(np.int32))
        billet = np.zeros(self._cells, dtype=bool)
        cells = problem.tagged.cell_tags.find(problem.tagged.groups["billet"])
        billet[cells[cells < self._cells]] = True
        points = V.tabulate_dof_coordinates()[self._vertices, :2]
        parts = comm.gather((number, points, number[local.reshape(-1, 3)], billet))
        if parts is None:
            return
        numbers, X, triangles, is_billet = (np.concatenate(part) for part in zip(*parts, strict=True))
        numbers, self._first = np.unique(numbers, return_index=True)
        self._scene = X[self._first], np.searchsorted(numbers, triangles), is_billet

    def snapshots(self) -> Snapshots | None:
        """What has been taken."""
        if not self._taken:
            return None
        u, mises = (np.stack(values) for values in zip(*self._taken.values(), strict=True))
        return Snapshots(*self._scene, np.array(list(self._taken)), u, mises)
