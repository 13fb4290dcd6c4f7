"""A problem condensed to the forces of contact: the bulk is factored once, and Newton's method runs on the surface.

The bulk is linear. With E the entries that contact can put forces f on, the displacements are::

    u = t d - K^-1 E^T f        t: displacement of the rear face, d: the billet moved as a whole by 1

so what contact reads of them is ``u_c = t d_c - C f`` with the compliance C, of which one column is one solve with the
factor of K (`extrusion.compliance`). The unknown is x = (t, f, multipliers) and the residual, in newtons, is::

    R(z) - f        R: contact's forces at the contact vector z = (u_c, multipliers)

It equals the residual of the full problem with all of its other dofs in balance, and so do Newton's iterates. Columns
of C are made when a force first needs them. Everything dense is on rank 0; the factor is shared by all ranks.
"""

from __future__ import annotations

import ctypes
import logging
import math
import os
import time
import weakref
from dataclasses import dataclass
from functools import cache
from typing import Any

from mpi4py import MPI  # noqa: F401  the wheel's PETSc needs the MPI that it loads
from petsc4py import PETSc

import numpy as np

from dolfinx.fem.petsc import get_petsc_lib

from extrusion.compiled import blocks, pointer
from extrusion.compliance import Blocks, Compliance
from extrusion.errors import InputError
from extrusion.gap import Array, Index
from extrusion.mesh import on_root
from extrusion.problem import BILLET_POINTS, Problem
from extrusion.sparse import Small, Sparse, Triplets
from extrusion.system import System, in_words, node_positions

log = logging.getLogger(__name__)

SOLVERS = ("auto", "surface", "full", "iterative")


def choose(problem: Problem, solver: str = "auto") -> System:
    """The system to solve: on the surface, on all unknowns, or the one of these that is estimated to be cheaper.

    The estimate takes `ITERATIONS` of Newton's method an increment, and the rates below; what is chosen, and why, is
    logged. Collective.

    Raises:
        InputError: There is no such solver.
    """
    if solver not in SOLVERS:
        raise InputError("solver", solver, f"choose one of {', '.join(SOLVERS)}")
    if solver == "full":
        return problem
    if solver == "iterative":
        problem.iterate()
        return problem
    fits = surface_memory(problem) <= MEMORY_SHARE * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    iterates = problem.dim == 3 and not problem.case.mixed
    iterations = ITERATIONS * len(problem.case.times())
    seconds = {"iterative": iterations * ITERATIVE_RATE * problem.dofs / problem.comm.size} if iterates else {}
    condensed = None
    if fits or not iterates or solver == "surface":  # what would not fit is not factored to know it
        condensed = Condensed(problem)
        cost = condensed.cost
        seconds["surface"] = cost.condensation + iterations * cost.surface
        seconds["full"] = iterations * cost.full
    allowed = {name: s for name, s in seconds.items() if name != "surface" or fits}
    chosen = "surface" if solver == "surface" else min(allowed, key=allowed.__getitem__)
    if problem.comm.rank == 0:
        log.info(
            "solver %s: the forces of contact take up to %.3g MB on the surface%s; estimated %s",
            chosen,
            surface_memory(problem) / 1e6,
            "" if fits else ", too many here",
            ", ".join(f"{name} {value:.2g} s" for name, value in sorted(seconds.items(), key=lambda item: item[1])),
        )
    if chosen == "iterative":
        problem.iterate()
    return condensed if condensed is not None and chosen == "surface" else problem


def seconds_an_iteration(problem: Problem, system: System) -> float:
    """Estimated, of Newton's method, at the rates of `Cost`."""
    if isinstance(system, Condensed):
        return system.cost.surface
    return ITERATIVE_RATE * problem.dofs / problem.comm.size if problem.iterates else FULL_RATE * problem.dofs


def surface_memory(problem: Problem) -> float:
    """Bytes that the compliance takes at most: with all of its columns, and a copy in single precision, if any."""
    full = np.zeros(problem.n_z, dtype=bool)
    full[np.concatenate([term.forced for term in problem.terms])] = True
    n_u = problem.dim * len(problem.z_in_billet)
    in_billet = np.ones(problem.n_z, dtype=bool)
    in_billet[:n_u] = np.repeat(problem.z_in_billet, problem.dim)
    free = problem.z_free & (np.arange(problem.n_z) < problem.n_z - problem.n_multipliers)
    sizes = [(int((full & free & body).sum()), int((free & body).sum())) for body in (in_billet, ~in_billet)]
    copied = _precision(problem.case.method, sum(n for n, _ in sizes)) == np.float32
    return (12.0 if copied else 8.0) * sum(n * m for n, m in sizes)


ITERATIVE_RATE = 3e-5
"""Seconds an unknown that an iteration of Newton's method takes with multigrid, on one core (EPYC, 2026).

1.6e-5 to 1.9e-5 were measured at order 1, and 2.3e-5 to 6e-5 at order 2.
"""

FULL_RATE = 6e-6
"""And with all factored anew, in the plane; in space it is more."""

ITERATIONS = 5
"""Newton iterations an increment that the choice of a solver counts with."""

MEMORY_SHARE = 0.25
"""Part of the machine's memory that the surface's matrices may take when the solver is chosen by itself."""


@dataclass(frozen=True)
class Cost:
    """Estimated seconds, from counts and the rates measured on one core (EPYC, 2026): good to a factor of two."""

    condensation: float  # once
    surface: float  # of an iteration's linear algebra there
    full: float  # of an iteration's on all unknowns

    @classmethod
    def of(cls, dofs: int, entries: float, flops: float, forces: int, read: int) -> Cost:
        """From entries of the bulk's factors times right-hand sides, the flops these took, and the surface's size."""
        active = forces / 3  # some are never reached, and of two at a node one is kept
        return cls(
            condensation=1.3e-10 * entries,
            surface=0.2 * active**3 / 6e10 + 1.1e-9 * active * read + 1e-3,
            full=4.3e-6 * dofs + 2 * flops / 5e9,
        )


class Condensed(System):
    """Contact forces as the unknowns of a problem.

    Args:
        problem: The scene. Its own x is only used by `recover`.
        stiff_die: Let the die, though it is elastic, not give way: the rigid die, on the same mesh.
    """

    def __init__(self, problem: Problem, stiff_die: bool = False) -> None:
        self.full, self._stiff_die = problem, stiff_die
        self.case, self.comm, self.terms = problem.case, problem.comm, problem.terms
        self.n_z, self.n_multipliers = problem.n_z, problem.n_multipliers
        self.on_root = self.comm.rank == 0
        on_root(self.comm, blocks)  # compiled there, if it has to be
        self._number()
        self._factor()
        size = 1 + self.n_forces + self.n_multipliers
        self.x = PETSc.Vec().createMPI((size if self.on_root else 0, size), comm=self.comm)
        self._tangent = _Tangent(self)
        self._known: list[tuple[bytes, Array, Array]] = []  # x, -C f at all rows, z
        self._placed = 0.0  # 1 once the billet is where it stands at the start
        n = self.x.local_size
        self._A = PETSc.Mat().createPython(((n, size), (n, size)), context=self._tangent, comm=self.comm)
        self._A.setUp()

    def _number(self) -> None:
        """What contact reads (rows of C, body by body), what it puts forces on (columns), and where both are in z."""
        full = self.full
        first = self.n_z - self.n_multipliers
        free = full.z_free[:first]
        read = np.flatnonzero(free)
        dim = full.dim
        n_u = dim * len(full.z_in_billet)
        in_billet = np.ones(first, dtype=bool)  # the pressures are the billet's
        in_billet[:n_u] = np.repeat(full.z_in_billet, dim)
        self._watch = full.named_points()
        places = full.places_of(self._watch)  # name -> the two global entries of the full x
        dofs, bodies = full.z_to_x[read], in_billet[read]
        free_of_held = ~np.isin([*places.values()], full.held).reshape(-1, 2)
        watched = np.array([*places.values()], dtype=np.int64).reshape(-1, 2)
        more = np.setdiff1d(watched[free_of_held], dofs)
        of_billet = {dof for name, pair in places.items() if name in BILLET_POINTS for dof in pair}
        bodies = np.concatenate([bodies, np.isin(more, [*of_billet])])
        z_of = np.concatenate([read, np.full(len(more), -1)])
        dofs = np.concatenate([dofs, more])
        # along the surface, so that what contact reads at one time stands together
        order = np.lexsort((np.append(self._along(), 0.0)[z_of], ~bodies))
        self.dofs, z_of, bodies = dofs[order], z_of[order], bodies[order]
        self.bodies = [slice(0, int(bodies.sum())), slice(int(bodies.sum()), len(bodies))]
        self.n_read = len(self.dofs)
        self._in_z = np.flatnonzero(z_of >= 0)  # rows that stand in z, and where
        self._z_of = z_of[self._in_z]
        self._row_of_z = np.full(self.n_z, -1)
        self._row_of_z[self._z_of] = self._in_z
        self._row_of_z[first:] = self.n_read + np.arange(self.n_multipliers)
        self._watched = np.where(np.isin(watched, self.dofs), _place_in(self.dofs, watched), -1)
        self._watched_drive, self._watched_start = full.drive_at(watched), full.start_at(watched)

        forced = np.concatenate([term.forced for term in self.terms])
        forced = np.unique(forced)
        forced = forced[full.z_free[forced]]
        self.z_forced = forced[np.argsort(self._row_of_z[forced])]  # body by body, along the surface
        self.n_forces = len(self.z_forced)
        self._force_of_z = np.full(self.n_z, -1)
        self._force_of_z[self.z_forced] = np.arange(self.n_forces)
        self.node = np.where(self.z_forced < n_u, self.z_forced // dim, self.z_forced)  # a pressure is one by itself
        self._force_of_z[first:] = self.n_forces + np.arange(self.n_multipliers)
        self.force_body = np.where(in_billet[self.z_forced], 0, 1)
        self._force_dofs = full.z_to_x[self.z_forced]
        self._z_drive = np.zeros(self.n_z)  # d at the entries of z
        self._z_y = [np.zeros(self.n_z, dtype=bool) for _ in range(2)]  # axial entries of billet and die
        y = np.zeros(first, dtype=bool)
        y[1:n_u:dim] = True
        self._z_y[0][:first] = y & in_billet
        self._z_y[1][:first] = y & ~in_billet
        self._z_drive[self._z_y[0]] = 1.0
        self._z_start = np.where(full.z_to_x >= 0, full.start_at(full.z_to_x), 0.0)

    def _along(self) -> Array:
        """Place of each entry of z along the profile: y, less the distance from the axis. Collective."""
        full, dim = self.full, self.full.dim
        X = full.V.tabulate_dof_coordinates()[: full.V.dofmap.index_map.size_local]
        place = full.x.duplicate()
        place.array[: dim * len(X)] = np.repeat(X[:, 1] - (X[:, 0] if dim == 2 else np.hypot(X[:, 0], X[:, 2])), dim)
        out = np.array(full.gather(place)[: self.n_z - self.n_multipliers])
        place.destroy()
        for term in self.terms:
            slave = term.pair.slave
            if slave.pressure_cols is not None:  # with their cells
                out[slave.pressure_cols] = out[dim * slave.cell_nodes[:, :1]]
        return out

    # -- bulk ------------------------------------------------------------------------------------------------

    def _factor(self) -> None:
        began = time.perf_counter()
        self._bulk = [_Factor(A, rows) for A, rows in self.full.bulk()]
        of_billet = int(np.sum(self.force_body == 0))
        self.of_body = [slice(0, of_billet), slice(of_billet, self.n_forces)]
        single = _precision(self.case.method, self.n_forces) == np.float32
        self.C = [  # of each body, a row for each of its forces
            Compliance(self._row_of_z[self.z_forced[of]] - rows.start, self.node[of], rows.stop - rows.start, single)
            for of, rows in zip(self.of_body, self.bodies, strict=True)
        ]
        self._provided = np.zeros(self.n_forces, dtype=bool)
        self._drive_norm = self.full.size_of_drive()
        self.seconds = {"factor": time.perf_counter() - began, "condensation": 0.0}
        bodies = np.bincount(self.force_body, minlength=2)
        self.cost = Cost.of(
            self.full.dofs,
            sum(factor.entries * int(n) for factor, n in zip(self._bulk, bodies, strict=False)),
            sum(factor.flops for factor in self._bulk),
            self.n_forces,
            self.n_read,
        )

    @property
    def compliance_memory(self) -> int:
        """Bytes of the compliance made so far, on rank 0."""
        return sum(C.nbytes for C in self.C)

    @property
    def right_hand_sides(self) -> int:
        """Columns of the compliance made so far, on rank 0."""
        return sum(C.made for C in self.C)

    def provide(self, wanted: Index) -> None:
        """Make the columns of C for some forces (given on rank 0), and for those beside them. Collective."""
        missing: list[tuple[int, int]] = []
        if self.on_root and not self._provided[wanted].all():
            self._provided[wanted] = True
            for body, (C, of) in enumerate(zip(self.C, self.of_body, strict=True)):
                if not (body == 1 and self._stiff_die):
                    mine = wanted[self.force_body[wanted] == body] - of.start
                    missing += [(body, number) for number in C.missing(mine)]
        if self.comm.size > 1:
            missing = self.comm.bcast(missing)
        if not missing:
            return
        began = time.perf_counter()
        for body, number in missing:
            forces = self._force_dofs[self.of_body[body]][self.C[body].blocks[number]]
            u = self._bulk[body].solve(forces, self.dofs[self.bodies[body]])
            if self.on_root:
                self.C[body].make(number, u)
        self.seconds["condensation"] += time.perf_counter() - began

    def displacements(self, f: Array) -> Array:
        """-C f at all rows; on rank 0."""
        return -np.concatenate([C.displacements(f[of]) for of, C in zip(self.of_body, self.C, strict=True)])

    def die_effect(self, x: PETSc.Vec) -> tuple[float, float]:
        """How an elastic die would move K (mm) and change the reaction (N), to first order.

        At x, solved with a stiff die. The forces on the die give its displacements by one back-substitution; what these
        do to the gap puts the billet out of balance, and one solve with the tangent brings it back. Collective.
        """
        z = self.gather(x)
        values = self.comm.bcast(np.array(x.array_r)) if self.comm.size > 1 else np.array(x.array_r)
        on = np.flatnonzero(self.force_body == 1)
        rows, u = self._bulk[1].back(self._force_dofs[on], -values[1 + on])
        parts = self.comm.allgather((rows, u))
        rows, u = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.argsort(rows)
        moved = z.copy()
        die = np.arange(self.bodies[1].start, self.bodies[1].stop)
        die = die[np.isin(die, self._in_z)]
        at = order[np.searchsorted(rows, self.dofs[die], sorter=order)]
        moved[self._z_of[np.searchsorted(self._in_z, die)]] += u[at]
        f, y = x.duplicate(), x.duplicate()
        out = f.array
        out[:1] = 0.0
        out[1:] = self._out_of_balance(x, moved)
        ksp = PETSc.KSP().create(self.comm)
        self.set_solver(ksp)
        self._tangent.forget()
        ksp.setOperators(self.tangent(x, False))
        self._tangent.set_accuracy(0.0, 0.0)  # no step of Newton's method mends what is left
        ksp.solve(f, y)
        ksp.destroy()
        y.array[:1] = 0.0
        K = self.point_displacements(y, {"K": self._watch["K"]})["K"][1]
        change = 0.0
        if self.on_root:
            axial = self._z_y[0][self.z_forced]
            change = float(y.array_r[1 : 1 + self.n_forces][axial].sum())
        change = self.comm.bcast(change) if self.comm.size > 1 else change
        f.destroy()
        y.destroy()
        return -K, -change

    # -- unknowns --------------------------------------------------------------------------------------------

    def _split(self, x: PETSc.Vec) -> tuple[float, Array, Array]:
        values = x.array_r
        return float(values[0]), values[1 : 1 + self.n_forces], values[1 + self.n_forces :]

    def _z(self, x: PETSc.Vec) -> Array:
        """The contact vector; on rank 0."""
        return self._at(x)[1]

    def _at(self, x: PETSc.Vec) -> tuple[Array, Array]:
        """-C f at all rows, and the contact vector; on rank 0. The last two are remembered."""
        at = x.array_r.tobytes()
        for known, u, z in self._known:
            if known == at:
                return u, z
        t, f, multipliers = self._split(x)
        u = self.displacements(f)
        z = t * self._z_drive + self._z_start * self._placed
        z[self._z_of] += u[self._in_z]
        z[self.n_z - self.n_multipliers :] = multipliers
        self._known = [(at, u, z), *self._known[:1]]
        return u, z

    def gather(self, x: PETSc.Vec) -> Array:
        z = self._z(x) if self.on_root else np.zeros(0)
        return self.comm.bcast(z) if self.comm.size > 1 else z

    def drive(self, x: PETSc.Vec, t: float) -> None:
        x.array[:1] = t

    def shift_billet(self, x: PETSc.Vec, dt: float) -> None:
        x.array[:1] += dt

    def place_billet(self, x: PETSc.Vec) -> None:
        self._placed, self._known = 1.0, []

    def largest_displacement(self, x: PETSc.Vec) -> float:
        largest = 0.0
        if self.on_root:
            known = [np.frombuffer(at) for at, _, _ in self._known]
            if len(known) == 2 and np.array_equal(known[1] - x.array_r, known[0]):
                u = (self._known[1][2] - self._known[0][2])[self._z_of]  # x is the step between the last two
            else:
                t, f, _ = self._split(x)
                u = t * self._z_drive[self._z_of] + self.displacements(f)[self._in_z]
            largest = float(np.max(np.abs(u)))
        return self.comm.bcast(largest) if self.comm.size > 1 else largest

    def recover(self, x: PETSc.Vec) -> PETSc.Vec:
        full = self.full
        values = np.array(x.array_r)
        if self.comm.size > 1:
            values = self.comm.bcast(values)
        out = np.zeros(full.n_local)
        first, f = full.x.owner_range[0], values[1 : 1 + self.n_forces]
        for body, factor in enumerate(self._bulk):
            on = np.flatnonzero(self.force_body == body)
            rows, u = factor.back(self._force_dofs[on], -f[on])
            out[rows - first] = u
        full.set_displacements(out, values[0], values[1 + self.n_forces :])
        return full.x

    # -- equations -------------------------------------------------------------------------------------------

    def residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        try:
            values = self._out_of_balance(x, self._evaluated(x))
        except ArithmeticError:  # on rank 0 alone, unless the terms are divided
            values = np.full(max(f.local_size - 1, 0), np.nan)
        self._put(f, values)

    def _put(self, f: PETSc.Vec, values: Array) -> None:
        """A residual's rows of forces and multipliers, on rank 0, into f."""
        out = f.array  # on every rank: PETSc counts changes, and forgets the norm
        out[1:] = values
        out[:1] = 0.0

    def _evaluated(self, x: PETSc.Vec) -> Array:
        """The contact vector, where terms are evaluated: on rank 0, or if they are divided on all."""
        return self.gather(x) if self.divided else self._z(x) if self.on_root else np.zeros(0)

    def _out_of_balance(self, x: PETSc.Vec, z: Array) -> Array:
        """The residual's rows of forces and multipliers, on rank 0; z is given where it is `_evaluated`."""
        return self._less_forces(x, self.contact_forces(z) if self.on_root or self.divided else np.zeros(0))

    def _less_forces(self, x: PETSc.Vec, R: Array) -> Array:
        """The same from contact's forces."""
        if not self.on_root:
            return np.zeros(0)
        out = np.concatenate([R[self.z_forced], R[self.n_z - self.n_multipliers :]])
        out[: self.n_forces] -= x.array_r[1 : 1 + self.n_forces]
        return out

    def tangent(self, x: PETSc.Vec, geometric: bool) -> PETSc.Mat:
        z = self._evaluated(x)
        return self._tangent_of(x, self._triplets(z, geometric) if self.on_root or self.divided else None)

    def linearised(self, x: PETSc.Vec, f: PETSc.Vec, at: Array) -> PETSc.Mat:
        D, R = None, np.full(self.n_z, np.nan)
        z = self._evaluated(x)
        try:
            if self.on_root or self.divided:
                D = self._triplets(at, False)
                R = self.linear_forces(z, at, D)
        except ArithmeticError:  # on rank 0 alone, unless the terms are divided
            D = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
        self._put(f, self._less_forces(x, R))
        return self._tangent_of(x, D)

    def _triplets(self, z: Array, geometric: bool) -> tuple[Index, Index, Array]:
        wanted = ((self._force_of_z >= 0) & self.on_root, self._row_of_z >= 0) if self.divided else ()
        return self.contact_tangent(z, geometric, *wanted)

    def _tangent_of(self, x: PETSc.Vec, contact: tuple[Index, Index, Array] | None) -> PETSc.Mat:
        """From contact's part, which rank 0 has."""
        D, f = None, np.zeros(0)
        if self.on_root and contact is not None:
            f = self._split(x)[1]
            D = Triplets.placed(*contact, self._force_of_z, self._row_of_z)
        self._tangent.set(D, f)
        return self._A

    def forget_pattern(self) -> None:
        self._tangent.forget()

    def set_solver(self, ksp: PETSc.KSP) -> None:
        """By `_Tangent`, which solves whole."""
        ksp.setType("preonly")
        pc = ksp.getPC()
        pc.setType("python")
        pc.setPythonContext(self._tangent)

    def set_accuracy(self, ksp: PETSc.KSP, tolerance: float, share: float) -> None:
        closely = self.solves_closely
        self._tangent.set_accuracy(0.0 if closely else min(share, LOOSEST), 0.0 if closely else 0.3 * tolerance)

    def tangent_without_contact(self) -> PETSc.Mat:
        return self._A

    def round_off(self, x: PETSc.Vec) -> float:
        """That of the full problem, so that both stop alike; here nothing cancels in the bulk."""
        return self.full.round_off_at(self._drive_norm * abs(self._time(x)))

    def _time(self, x: PETSc.Vec) -> float:
        """The displacement of the rear face that x holds, on every rank."""
        t = float(x.array_r[0]) if self.on_root else 0.0
        return self.comm.bcast(t) if self.comm.size > 1 else t

    # -- reports ---------------------------------------------------------------------------------------------

    def balance(self, x: PETSc.Vec) -> tuple[float, float, float]:
        z = self.gather(x)
        R = self.contact_forces(z)
        rear, die = float(R[self._z_y[0]].sum()), float(R[self._z_y[1]].sum())
        if self.case.die == "rigid":
            die = -rear
        # the energy: half of the supports' work less that of the forces on the rest, which are -R
        free = self.full.z_free.copy()
        free[self.n_z - self.n_multipliers :] = False
        at_rear = R[self._z_y[0] & free].sum()  # K u there
        at_planes = self._placed * (self._z_start[free] @ R[free])
        energy = 0.5 * float(self._time(x) * at_rear + at_planes - z[free] @ R[free])
        copies = self.full.copies
        return copies * rear, copies * die, copies * energy

    def named_points(self) -> dict[str, tuple[int, int]]:
        return self._watch

    def point_displacements(self, x: PETSc.Vec, points: dict[str, tuple[int, int]]) -> dict[str, tuple[float, float]]:
        found = None
        if self.on_root:
            u = np.append(self._at(x)[0], 0.0)
            values = self._split(x)[0] * self._watched_drive + self._placed * self._watched_start + u[self._watched]
            found = {name: (float(r), float(y)) for name, (r, y) in zip(self._watch, values, strict=True)}
        found = self.comm.bcast(found) if self.comm.size > 1 else found
        assert found is not None
        return {name: found[name] for name in points}

    def worst(self, x: PETSc.Vec) -> str:
        f = x.duplicate()
        self.residual(x, f)
        text = ""
        if self.on_root:
            size = np.nan_to_num(np.abs(f.array_r[1 : 1 + self.n_forces]), nan=np.inf)
            at = int(np.argmax(size)) if len(size) else 0
            dim = self.full.dim
            node = int(self.z_forced[at]) // dim
            place = "?"
            for term in self.terms:
                for surface in (term.pair.slave, term.pair.die):
                    if node in surface.nodes:
                        u = self._z(x)[dim * node : dim * (node + 1)]
                        place = in_words(node_positions(surface, np.array([node]))[0] + u)
            text = f"{self.zones_of(node)}, {place}, out of balance by {size[at]:.3g} N"
        f.destroy()
        return str(self.comm.bcast(text))


class _Factor:
    """The factored bulk matrix of one body.

    Args:
        A: The matrix.
        rows: Which entries of the full x its rows are (all ranks'), increasing on each rank.
    """

    def __init__(self, A: PETSc.Mat, rows: Index) -> None:
        self._A, self._rows, self._comm = A, rows, A.comm.tompi4py()
        self._order = np.argsort(rows)
        self._pc = PETSc.PC().create(A.comm)
        self._pc.setType("cholesky")
        self._pc.setFactorSolverType("mumps")
        self._pc.setOperators(A)
        self._pc.setUp()
        self._F = self._pc.getFactorMatrix()
        entries = float(self._F.getMumpsInfog(29))
        self.entries = -1e6 * entries if entries < 0 else entries  # as MUMPS counts large ones
        self.flops = float(self._F.getMumpsRinfog(3))

    def _at(self, entries: Index) -> Index:
        return np.asarray(self._order[np.searchsorted(self._rows, entries, sorter=self._order)])

    def solve(self, forces: Index, read: Index) -> Array:
        """Entries ``read`` of the solution for a unit force at each of ``forces`` (a row each); on rank 0.

        As entries of the inverse, for which MUMPS visits only the fronts between these unknowns and the tree's root.
        Amestoy, Duff, L'Excellent, Robert, Rouet, Ucar, SIAM J. Sci. Comput. 34 (2012) A1975, doi:10.1137/100799411.
        """
        comm, n = self._comm, self._A.size[0]
        at, wanted = self._at(forces), self._at(read)
        by_row, by_col = np.argsort(at), np.argsort(wanted)
        m = n if comm.rank == 0 else 0
        width = np.zeros(m + 1, dtype=PETSc.IntType)
        cols = np.zeros(0, dtype=PETSc.IntType)
        if comm.rank == 0:
            width[1 + at] = len(wanted)
            cols = np.tile(wanted[by_col], len(at)).astype(PETSc.IntType)
        csr = np.cumsum(width, dtype=PETSc.IntType), cols, np.zeros(len(cols))
        entries = PETSc.Mat().createAIJ(((m, n), (m, n)), csr=csr, comm=comm)
        self._F.setMumpsIcntl(27, -64)  # right-hand sides that it takes together
        if _petsc().MatMumpsGetInverseTranspose(self._F.handle, entries.handle):
            raise RuntimeError("MUMPS did not give entries of the inverse")
        self._F.setMumpsIcntl(30, 0)  # PETSc leaves both as they were here: entries only, all on rank 0
        self._F.setMumpsIcntl(21, int(comm.size > 1))
        out = np.zeros((len(at), len(wanted)) if comm.rank == 0 else (0, 0))
        if comm.rank == 0:
            out[np.ix_(by_row, by_col)] = entries.getValuesCSR()[2].reshape(out.shape)
        entries.destroy()
        return out

    def back(self, forces: Index, values: Array) -> tuple[Index, Array]:
        """This rank's rows, and the solution there, for these values at ``forces`` (given on every rank)."""
        b, u = self._A.createVecs()
        first, end = self._A.owner_range
        at = self._at(forces)
        mine = (at >= first) & (at < end)
        b.array[at[mine] - first] = values[mine]
        self._pc.apply(b, u)
        out = self._rows[first:end], np.array(u.array_r)
        b.destroy()
        u.destroy()
        return out


class _Tangent:
    """``-1 - D C`` over the forces, and D's columns of the multipliers: PETSc's matrix of it, and its solver.

    D is the derivative of contact's forces by what they read. Without friction the force on a node acts along a
    normal that hardly turns, so its two rows of D are nearly parallel, and the preconditioner takes one unknown w for
    both: with D = E D_B, and E as wide as the rows B that are kept, ``f = E w - h``, where ``h = F - E F_B``, and::

        (1 + D_B C E) w - D_B,p p = D_B C h - F_B        p: the multipliers, whose rows stay as they are

    is solved by a dense factorisation. Rows that are not parallel (at the die's corners, at the billet's edge) are all
    kept. The factorisation serves until the Krylov method, for which the change of D is small, takes too long with it.
    That is GCR, which wants the image of each correction f: with C h and C E w at hand, one more product with D.

    Where there are many forces all of this is in single precision, of which Newton's method, whose residual is not,
    takes no harm: it gains six digits an iteration. Passes of nodal contact would: their end hangs on all digits.
    """

    PARALLEL = 0.1
    """Part of a row that may stand out of its neighbour's direction."""

    STALE = 20
    """Krylov iterations after which a factorisation of an earlier tangent is made anew."""

    def __init__(self, system: Condensed) -> None:
        self._system = weakref.proxy(system)  # PETSc holds this object in C
        self._dtype: Any = _precision(system.case.method, system.n_forces)
        self.set_accuracy(0.0, 0.0)
        # of each body, which forces have a part in the solve, and the rows of C that are read
        self._held = [(np.zeros(C.shape[0], dtype=bool), slice(0, 0)) for C in system.C]
        self._cols: Index  # of D, what each column is, of all that is read
        self._col: Small  # and where each of these stands
        self._pressed = np.zeros(system.n_multipliers, dtype=bool)  # multipliers that have a part in the solve
        self.forget()

    def forget(self) -> None:
        """Factor the next tangent anew."""
        self._lu: Any = None

    def set_accuracy(self, share: float, rest: float) -> None:
        """Leave this part of the right-hand side, or this much of it (N), but for what the precision cannot do."""
        self._share = max(share, 1e-6 if self._dtype == np.float32 else 1e-11)
        self._rest = rest

    def set(self, D: Triplets | None, f: Array) -> None:
        """Take a derivative, and the forces it belongs to (on rank 0). Collective.

        D: contact forces and multiplier rows by displacements read and multipliers.
        """
        system = self._system
        n_f = system.n_forces
        involved = np.zeros(0, dtype=np.int64)
        if D is not None:
            self._diagonal, read = np.full(n_f + system.n_multipliers, -1.0), D.cols
            self._acts = acts = np.zeros(len(self._diagonal), dtype=bool)
            if system.n_multipliers:
                own = (D.rows >= n_f) & (D.cols - system.n_read == D.rows - n_f)  # multipliers on their own rows
                self._diagonal[n_f:] = np.bincount(D.rows[own] - n_f, D.values[own], system.n_multipliers)
                read = D.cols[~own]
                acts[D.rows[~own]] = True
                acts[n_f + read[read >= system.n_read] - system.n_read] = True
                acts |= self._diagonal == 0.0
            else:
                acts[D.rows] = True
            acts[:n_f] |= f != 0.0  # what has just been let go, too, displaces what is read
            involved = np.flatnonzero(acts[:n_f])
        system.provide(involved)
        if D is None:
            return
        self._hold(read)
        # multipliers that are not pressed have no row
        shape = len(self._entries), len(self._cols)
        self._D = D.assembled(self._row, self._col, shape, self._dtype)
        self._fresh = False  # whether it is this tangent that has been factored
        if self._lu is None:
            self._factor(self.PARALLEL)
        else:
            self._compile()

    def _hold(self, cols: Small) -> None:
        """C, and the multipliers, for all that acts and all that is read; if some has not been so, factor anew."""
        system, n_f = self._system, self._system.n_forces
        if self._lu is not None and not self._acts[self._row < 0].any() and (self._col[cols] >= 0).all():
            return
        read = np.zeros(system.n_read + system.n_multipliers, dtype=bool)
        read[cols] = True
        same = self._lu is not None  # increment: what has been involved may be so again
        pressed = self._acts[n_f:]
        changes = not (same and (pressed <= self._pressed).all())
        for body, forces in enumerate(system.of_body):
            act, (held, span) = self._acts[forces], self._held[body]
            rows = np.flatnonzero(read[system.bodies[body]])
            reach = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else span if same else slice(0, 0)
            if same:
                act = act | held
                if span.stop:
                    reach = slice(min(reach.start, span.start), max(reach.stop, span.stop))
            if np.array_equal(act, held) and reach == span:
                continue
            self._held[body], changes = (act, reach), True
        if not changes:
            return
        self.forget()
        self._pressed = pressed | self._pressed if same else pressed
        p = np.flatnonzero(self._pressed)
        held_forces = [
            of.start + np.flatnonzero(held) for of, (held, _) in zip(system.of_body, self._held, strict=True)
        ]
        held_rows = [
            body.start + np.arange(span.start, span.stop)
            for body, (_, span) in zip(system.bodies, self._held, strict=True)
        ]
        self._set_entries(np.concatenate([*held_forces, n_f + p]))
        self._from_die = len(held_rows[0])
        self._cols = np.concatenate([*held_rows, system.n_read + p])
        self._col = np.full(len(read), -1, dtype=np.int32)
        self._col[self._cols] = np.arange(len(self._cols))

    def _set_entries(self, entries: Index) -> None:
        """Which force or multiplier each row of D is of."""
        self._entries = entries
        self._row = np.full(len(self._acts), -1, dtype=np.int32)
        self._row[entries] = np.arange(len(entries))

    def _factor(self, parallel: float) -> None:
        """Factor, and put D's rows in this order: forces that are kept, by bodies; multipliers; others, by bodies."""
        system, n_u = self._system, len(self._cols) - int(np.count_nonzero(self._pressed))
        leads, follower, two, slope = self._leaders(parallel)
        body = np.append(system.force_body, np.full(system.n_multipliers, 2))[self._entries]
        part = np.where(body == 2, 2, 3 + body)
        part[leads] = body[leads]
        order = np.lexsort((self._entries, part))
        ends = [0, *np.cumsum(np.bincount(part, minlength=5)).tolist()]
        n, kept = self._n, self._kept = ends[2], ends[3]
        follower, two = self._entries[follower], self._entries[two]
        self._set_entries(self._entries[order])
        self._follower, self._two = (self._row[of].astype(np.int64) for of in (follower, two))
        self._slope = slope.astype(self._dtype)
        self._D = self._D.rows(order)
        C_E, C_h = [], []
        M = np.zeros((kept, kept), dtype=self._dtype)
        in_order = np.argsort(self._follower)
        for b, cols in enumerate((slice(0, self._from_die), slice(self._from_die, n_u))):
            lead, other = slice(ends[b], ends[b + 1]), slice(ends[b + 3], ends[b + 4])
            of = (self._entries[rows] - system.of_body[b].start for rows in (lead, other))
            here = in_order[slice(*np.searchsorted(self._follower[in_order], [other.start, other.stop]))]
            links = self._two[here] - lead.start, self._follower[here] - other.start, self._slope[here]
            for k, o, with_others, others in system.C[b].parts(*of, links, self._held[b][1]):
                first = lead.start + k
                self._D.add_times(cols, with_others.whole().T, M[:, first : first + len(with_others.D)])
                C_E.append((first, cols.start, with_others))
                C_h.append((other.start + o, cols.start, others))
        self._blocks = Blocks(C_E), Blocks(C_h)
        M[n:, :n] *= -1.0
        M[np.arange(n), np.arange(n)] += 1.0
        pressed = self._D.first(kept, slice(n_u, len(self._cols)))
        M[:n, n:] = -pressed[:n]
        M[n:, n:] = pressed[n:]
        self._lu, self._fresh = _factored(M), True
        self._compile()

    def _compile(self) -> None:
        """The ``tangent`` of ``blocks.h``, and what it points to."""
        own, others = self._blocks
        if not {own.dtype, others.dtype} <= {None, np.dtype(self._dtype)}:
            raise TypeError(f"blocks of {own.dtype} and {others.dtype} in a tangent of {self._dtype}")
        arrays = {
            "start": self._D.start, "columns": self._D.columns, "values": self._D.values,
            "follower": self._follower, "leader": self._two, "slope": self._slope, **self._lu,
        }  # fmt: skip
        numbers = {
            "rows": len(self._entries), "forces": self._n, "kept": self._kept, "width": len(self._cols),
            "displacements": len(self._cols) - int(np.count_nonzero(self._pressed)), "n_own": len(own.of),
            "n_others": len(others.of), "n_followers": len(self._follower),
        }  # fmt: skip
        pointers = {name: pointer(array) for name, array in arrays.items()}
        of = blocks().ffi.new("tangent *", {**numbers, **pointers, "own": own.of, "others": others.of})
        self._compiled = of, arrays

    def _leaders(self, parallel: float) -> tuple[Index, Index, Index, Array]:
        """Rows that are kept; others, the kept one of the same node that each goes with, and in what proportion."""
        system, D, m = self._system, self._D, np.count_nonzero(self._pressed)
        is_force = self._entries < system.n_forces
        row = D.row
        pressed, on_force = D.columns >= D.width - m, is_force[row]
        if (pressed & on_force).any() and not on_force.all():
            # by pressures as by displacements, each times a stiffness
            scale = np.max(np.abs(D.values[~on_force])) / np.max(np.abs(D.values[pressed & on_force]))
            D = Sparse(D.start, D.columns, np.where(pressed, scale, 1.0).astype(self._dtype) * D.values, D.width)
        square = np.bincount(row, D.values**2, len(is_force))
        acts = is_force & (square > 0.0)
        on = np.flatnonzero(acts)
        node = system.node[self._entries[on]]
        by_node = np.lexsort((self._entries[on], -square[on], node))  # the largest row of each first
        first = np.diff(node[by_node], prepend=-1) != 0
        largest = np.maximum.accumulate(np.where(first, np.arange(len(on)), 0))
        other, to = on[by_node[~first]], on[by_node[largest[~first]]]
        slope = D.products(other, to) / square[to]
        goes = square[other] - slope**2 * square[to] <= np.copysign(parallel**2, parallel) * square[to]
        acts[other[goes]] = False
        return np.flatnonzero(acts), other[goes], to[goes], slope[goes]

    def _improve(self, F: Array, tolerance: float) -> Array:
        """Forces and multipliers by GCR, which takes them where their image is closest to F; F becomes what is left."""
        x, spaces = np.zeros(len(F)), np.empty((2 * self.STALE, len(F)))
        scratch = np.empty(3 * len(F) + len(self._cols), self._dtype)
        improve = blocks().lib.gcr_float if self._dtype == np.float32 else blocks().lib.gcr_double
        improve(self._compiled[0], self.STALE, tolerance, *map(pointer, (F, x, spaces, scratch)))
        return x

    def _image(self, v: Array) -> Array:
        n_f = self._system.n_forces
        read = np.concatenate([self._system.displacements(v[:n_f]), v[n_f:]])
        out = self._diagonal * v
        out[n_f:][self._pressed] = 0.0  # these stand in D
        out[self._entries] += self._D.times(read[self._cols])
        return out

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The tangent by a vector."""
        into = y.array
        if self._system.on_root:
            into[0] = x.array_r[0]
            into[1:] = self._image(x.array_r[1:])

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve."""
        into, system = y.array, self._system
        F, new = b.array_r[1:], np.zeros(0, dtype=np.int64)
        if system.on_root:  # forces that have begun to act since the tangent was made
            new = np.flatnonzero((F[: system.n_forces] != 0.0) & ~self._acts[: system.n_forces])
        system.provide(new)
        if not system.on_root:
            return
        pc.setFailedReason(PETSc.PC.FailedReason.NOERROR)
        x = np.where(self._acts, 0.0, F / np.where(self._acts, 1.0, self._diagonal))  # where nothing acts
        left = F - self._image(x) if x.any() else F.copy()
        tolerance = max(self._share * math.sqrt(F @ F), self._rest)
        turn = 0
        while math.sqrt((rest := left[self._entries]) @ rest) > tolerance:
            if turn == 1 and not self._fresh:
                self._factor(self.PARALLEL)
            if turn == 3:
                self._factor(-1.0)
            if turn == 4:
                pc.setFailedReason(PETSc.PC.FailedReason.SUBPC_ERROR)
                break
            rest = left[self._entries]  # a factorisation has them in another order
            x[self._entries] += self._improve(rest, tolerance)
            left[self._entries] = rest
            turn += 1
        into[0] = b.array_r[0]
        into[1:] = x


def _factored(M: Array) -> dict[str, Any]:
    """A matrix as ``blocks.h`` takes it, factored: a small one without SciPy, which takes 0.1 s to load."""
    if len(M) <= SMALL:
        interchanged = np.empty(len(M), dtype=np.int32)
        factor = blocks().lib.factor_float if M.dtype == np.float32 else blocks().lib.factor_double
        factor(len(M), pointer(M), pointer(interchanged))
        return {"lu": M, "interchanged": interchanged}
    import scipy.linalg

    lu, interchanged = scipy.linalg.lu_factor(M.T, overwrite_a=True, check_finite=False)
    return {"lu": np.ascontiguousarray(lu.T), "interchanged": interchanged.astype(np.int32)}


SMALL = 450
"""Unknowns up to which a matrix is small: at more the fifty times that a run factors take longer than SciPy to load."""

LOOSEST = 1e-4
"""Part of the right-hand side that a solve may leave: with a hundred times more hard steps fail, and none is faster."""

MANY = 1200
"""Forces from which on single precision pays."""


def _precision(method: str, forces: int) -> Any:
    """Of the solves with the tangent."""
    return np.float32 if forces > MANY and method != "nodal" else np.float64


@cache
def _petsc() -> ctypes.CDLL:
    """PETSc's library, for what petsc4py leaves out."""
    library = ctypes.CDLL(str(get_petsc_lib()))
    library.MatMumpsGetInverseTranspose.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    return library


def _place_in(values: Index, wanted: Index) -> Index:
    """Where each wanted value stands in unsorted values that hold it (elsewhere anything)."""
    order = np.argsort(values)
    return np.asarray(order[np.minimum(np.searchsorted(values, wanted, sorter=order), len(values) - 1)])
