"""Files from accepted steps: tables, fields for ParaView, and the data of pictures.

What is here observes a run (`extrusion.result.run`): it is called on every rank, and rank 0 writes. A table is flushed
after each step, so a run that fails, or is stopped, leaves its accepted steps behind.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

from mpi4py import MPI

import numpy as np

from dolfinx import fem
from dolfinx.io import VTXMeshPolicy, VTXWriter

import extrusion
from extrusion import plots
from extrusion.cases import Case, to_toml
from extrusion.errors import InputError
from extrusion.mesh import on_root
from extrusion.mesh3d import FACES
from extrusion.painter import Painter, available
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
        painter: What draws pictures, on rank 0; without it none are drawn.

    Raises:
        InputError: On every rank, if the folder cannot be written.
    """

    def __init__(self, path: str | Path, comm: MPI.Intracomm, painter: Painter | None = None) -> None:
        self.path, self._comm, self._painter = Path(path), comm, painter
        self.observers: list[Observer] = [History(path), Contact(path), Fields(path)]

        def make() -> None:
            self.path.mkdir(parents=True, exist_ok=True)
            (self.path / "history.csv").open("a", encoding="utf-8").close()  # refused before anything is removed
            for name in ("contact.csv", "run.json", "snapshots.npz", *(f"{kind}.png" for kind in plots.KINDS)):
                (self.path / name).unlink(missing_ok=True)  # an earlier run's

        write_on_root(comm, self.path, make)

    def finish(self, result: Result, options: dict[str, Any]) -> None:
        """Write the result, and draw it if matplotlib is there. Collective."""
        began = time.perf_counter()

        def keep() -> None:
            if result.snapshots is not None:
                np.savez_compressed(self.path / "snapshots.npz", **vars(result.snapshots))
            write()

        def draw() -> None:
            if self._painter is None:
                return
            if not available():
                log.warning('pictures skipped: matplotlib is not installed (pip install "extrusion[plot]")')
            elif result.steps:
                self._painter.write(plots.Record.of(result), self.path)

        def write() -> None:
            text = json.dumps(run_record(result, options), indent=1, allow_nan=False)
            (self.path / "run.json").write_text(text + "\n", encoding="utf-8")

        write_on_root(self._comm, self.path, keep)  # whatever becomes of the pictures
        write_on_root(self._comm, self.path, draw)
        result.seconds["output"] += time.perf_counter() - began
        write_on_root(self._comm, self.path, write)


def run_record(result: Result, options: dict[str, Any]) -> dict[str, Any]:
    """``run.json``: the result, why it stopped, and what it takes to repeat it (the case as it was run, as TOML)."""
    given = {name: value for name, value in options.items() if value is not None}
    return {
        **result.to_dict(),
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
        for key in ("reaction", "die_reaction", "energy", "iterations", "tangents", "passes", "cuts", "residual"):
            row[key] = getattr(step, key)
        row |= {f"gap_{name}": gap for name, gap in step.gap.items()}
        self._write(problem.comm, list(row), [list(row.values())])


class Contact(_Table):
    """``contact.csv``: one line a step and contact point, along the slave surface of each zone.

    mm and MPa; the point is at `r`, `y`, or in three dimensions at `x`, `y`, `z` in the quarter; `pressure` is normal
    to the die, `ray_pressure` its part along the zone's ray, per reference area; `weight` (mm^2) is the area that the
    point stands for; `closed` is 1 where contact acts (or, if it is only checked, where the bodies interpenetrate).
    """

    name = "contact.csv"

    def __call__(self, problem: Problem, step: Step) -> None:
        """Write a step."""
        place = ("x", "y", "z") if problem.dim == 3 else ("r", "y")
        header = ("t", "zone", "s", *place, "gap", "pressure", "ray_pressure", "weight", "closed")
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
    """``fields.bp`` for ParaView: displacement (mm) and von Mises stress (MPa, cell means) of both bodies.

    ParaView has no 20-node hexahedron of ours: its displacements are written as those of the 27-node one.
    """

    def __init__(self, folder: str | Path) -> None:
        self._path = Path(folder) / "fields.bp"
        self._writer: VTXWriter | None = None
        self._written: fem.Function | None = None  # takes the place of the displacement

    def __call__(self, problem: Problem, step: Step) -> None:
        """Write a step. Collective."""
        fields = problem.stress_fields(step.x)
        u = fields["displacement"]
        if self._writer is None:
            write_on_root(problem.comm, self._path, lambda: self._path.parent.mkdir(parents=True, exist_ok=True))
            if problem.case.element == "serendipity":
                msh, dim = problem.tagged.msh, problem.dim
                self._written = fem.Function(fem.functionspace(msh, ("Lagrange", 2, (dim,))), name=u.name)
                fields["displacement"] = self._written
            self._writer = VTXWriter(problem.comm, self._path, [*fields.values()], mesh_policy=VTXMeshPolicy.reuse)
        if self._written is not None:
            self._written.interpolate(u)
        self._writer.write(step.t)

    def close(self) -> None:
        """Close the file. Collective."""
        if self._writer is not None:
            self._writer.close()


class Faces:
    """All triangles of the plane, or in space some boundary quadrilaterals, of all ranks on rank 0. Collective.

    Args:
        problem: The scene.
        groups: Facet groups to take, in space.

    Attributes:
        points: Reference positions of the vertices, each once, ``shape=(n, dim)``, mm.
        corners: Vertices of each face, going round, ``shape=(m, 3)`` or ``(m, 4)``.
        billet: Whether it is the billet's, not the die's, ``shape=(m,)``.
    """

    def __init__(self, problem: Problem, groups: Iterable[str] = ()) -> None:
        V, msh, tagged = problem.V, problem.tagged.msh, problem.tagged
        owned, dim = msh.topology.index_map(problem.dim).size_local, problem.dim
        if dim == 2:
            self._cells = np.arange(owned)
            corners = V.dofmap.list[:owned, :3]
        else:
            for pair in ((2, 3), (3, 2)):
                msh.topology.create_connectivity(*pair)
            to_cell, to_facet = (msh.topology.connectivity(*pair) for pair in ((2, 3), (3, 2)))
            found = [tagged.facet_tags.find(tagged.groups[name]) for name in groups if name in tagged.groups]
            facets = np.concatenate([*found, np.zeros(0, dtype=np.int32)])
            cells = to_cell.array[to_cell.offsets[facets]]  # a boundary facet has one
            facets, self._cells = facets[cells < owned], cells[cells < owned]
            number = np.argmax(to_facet.array.reshape(-1, 6)[self._cells] == facets[:, None], axis=1)
            corners = np.take_along_axis(V.dofmap.list[self._cells], FACES[number], axis=1)
        self._vertices, local = np.unique(corners, return_inverse=True)
        number = V.dofmap.index_map.local_to_global(self._vertices.astype(np.int32))
        billet = np.isin(self._cells, tagged.cell_tags.find(tagged.groups["billet"]))
        points = V.tabulate_dof_coordinates()[self._vertices, :dim]
        parts = problem.comm.gather((number, points, number[local.reshape(corners.shape)], billet))
        if parts is not None:
            numbers, X, faces, self.billet = (np.concatenate(part) for part in zip(*parts, strict=True))
            numbers, self._first = np.unique(numbers, return_index=True)
            self.points, self.corners = X[self._first], np.searchsorted(numbers, faces)

    def fields(self, problem: Problem, step: Step) -> tuple[Array, Array] | None:
        """Displacements of the vertices (mm) and von Mises stress of the cells behind the faces (MPa), on rank 0."""
        fields = problem.stress_fields(step.x)
        u = problem.comm.gather(fields["displacement"].x.array.reshape(-1, problem.dim)[self._vertices])
        mises = problem.comm.gather(fields["von_mises"].x.array[self._cells])
        return None if u is None else (np.concatenate(u)[self._first], np.concatenate(mises))


INVERTED = 1e-3
"""Part of the billet's section that may be turned inside out without a warning, at the corners."""


class Camera:
    """Takes the steps nearest to some t, and the last one, as `Snapshots` on rank 0: in space those of the plane z = 0.

    Args:
        case: Its increments say which steps are nearest.
        wanted: t, mm.
    """

    def __init__(self, case: Case, wanted: Sequence[float]) -> None:
        times = case.times()
        self._wanted = {min(times, key=lambda t: abs(t - target)) for target in wanted}
        self._taken: dict[float, tuple[Array, Array]] = {}
        self._last: tuple[Problem, Step] | None = None  # not taken yet
        self._faces: Faces | None = None
        self._warned = False

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
        if self._faces is None:
            self._faces = Faces(problem, ("billet_z", "die_z"))
        found = self._faces.fields(problem, step)
        if found is None:
            return
        self._taken[step.t] = found
        share = self._inverted(found[0])
        if share > INVERTED and not self._warned:
            self._warned = True
            log.warning(
                "t = %.6g mm: %.2g %% of the billet's section is turned inside out: small strain has no more to say",
                step.t,
                100 * share,
            )

    def _inverted(self, u: Array) -> float:
        """Part of the billet's section, in the plane or in that of symmetry, whose cells have turned over."""
        faces = self._faces
        assert faces is not None
        corners = faces.corners[faces.billet]

        def areas(x: Array) -> Array:
            across, along = x[corners[:, 2]] - x[corners[:, 0]], x[corners[:, -1]] - x[corners[:, 1]]
            return np.asarray(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0])

        before, now = (areas(x[:, :2]) for x in (faces.points, faces.points + u))
        return float(np.sum(np.abs(before[before * now < 0])) / np.sum(np.abs(before)))

    def snapshots(self) -> Snapshots | None:
        """What has been taken; a quadrilateral as two triangles."""
        faces = self._faces
        if not self._taken or faces is None:
            return None
        u, mises = (np.stack(values) for values in zip(*self._taken.values(), strict=True))
        halves = [[0, i, i + 1] for i in range(1, faces.corners.shape[1] - 1)]
        triangles, n = faces.corners[:, halves].reshape(-1, 3), len(halves)
        return Snapshots(
            points=faces.points[:, :2],
            triangles=triangles,
            billet=np.repeat(faces.billet, n),
            t=np.array(list(self._taken)),
            displacement=u[..., :2],
            von_mises=np.repeat(mises, n, axis=1),
        )
