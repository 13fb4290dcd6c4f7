"""The tangent's linear systems by a Krylov method, for bulks too large to factor again and again.

The bulk K stays as it is; contact is a few sparse rows D beside it, on every rank whole::

    (K + D) (u, p) = r          p: the multipliers, if the method has any

The preconditioner is algebraic multigrid (PETSc's GAMG with the rigid body modes as near-nullspace) on the symmetric
matrix ``P = K + B^T kappa B``, B being the gap's rows of what is closed and kappa their contact stiffness. P knows the
contact, so that iterations grow neither with the mesh nor with the stiffness, and for penalty and Nitsche's method it
is the tangent but for small terms. Multipliers p, of which the closed rows read ``s B u = r_p``, take the augmented
Lagrangian's Schur complement ``1 / kappa`` (Benzi, Olshanskii 2006, doi:10.1137/050646421)::

    u = P^-1 (r_u + B^T (kappa / s) r_p),   p = kappa (B u - r_p / s)

The lower half of a block factorisation; the other half, one more multigrid cycle, saved a seventh of the iterations.
"""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

from mpi4py import MPI  # noqa: F401  the wheel's PETSc needs the MPI that it loads
from petsc4py import PETSc

import numpy as np
import scipy.sparse

from extrusion.gap import Array, Index

if TYPE_CHECKING:
    from extrusion.problem import Problem

Triplets = tuple[Index, Index, Array]

RTOL = 1e-9
"""Relative tolerance of a linear solve: small enough for passes of nodal contact to end as with a direct solver."""

MOST = 1e-2
"""The largest one for methods that follow the geometry, whose next iterate mends what is left."""


class Krylov:
    """The tangent of a problem as PETSc's matrix, and its preconditioner.

    Args:
        problem: Whose bulk it is. Displacements and multipliers only, no pressures.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = weakref.proxy(problem)  # PETSc holds this object in C
        comm, x = problem.comm, problem.x
        self.A = PETSc.Mat().createPython((x.sizes, x.sizes), context=self, comm=comm)
        self.A.setUp()
        self._n_u = problem.n_local - (problem.n_multipliers if comm.rank == comm.size - 1 else 0)
        self._u, self._f = (PETSc.Vec().createMPI((self._n_u, PETSc.DETERMINE), comm=comm) for _ in range(2))
        self._modes = _rigid_modes(problem, self._u)
        self._pc: PETSc.PC | None = None
        self._P: PETSc.Mat | None = None
        self._stiff: Triplets | None = None
        self._fresh, self._applied = False, 0

    def set(self, D: Triplets, stiff: Triplets, kappa: Array) -> PETSc.Mat:
        """Take contact's derivative, its symmetric stiffness (over z) and kappa of each multiplier. Collective."""
        problem = self._problem
        n, first = problem.n_z, problem.n_z - problem.n_multipliers
        rows, cols, values = D
        keep = problem.z_free[rows] & problem.z_free[cols]
        whole = scipy.sparse.coo_array((values[keep], (rows[keep], cols[keep])), shape=(n, n)).tocsr()
        self._mine = problem.z_rows
        self._D = whole[self._mine]
        self._Bt = whole[:first, first:]
        s_B = whole[first:, :first]
        held = np.asarray(abs(whole[first:, first:]).sum(axis=1)).ravel() == 0.0  # closed rows have no diagonal
        self._closed, self._kappa = held, kappa
        self._B = self._Bt.T.tocsr()
        norm = np.asarray(self._B.multiply(self._B).sum(axis=1)).ravel()
        self._s = np.asarray(s_B.multiply(self._B).sum(axis=1)).ravel() / np.where(norm > 0, norm, 1.0)
        self._diagonal = whole[first:, first:].diagonal()
        rows, cols, values = stiff
        keep = problem.z_free[rows] & problem.z_free[cols] & (values != 0.0)
        stiff = rows[keep], cols[keep], values[keep]
        known, self._stiff = self._stiff, stiff
        if known is None or not all(np.array_equal(a, b) for a, b in zip(stiff, known, strict=True)):
            self._fresh = False
        self._applied = 0
        self.A.assemble()
        return self.A

    def _factor(self) -> None:
        """Multigrid for the contact of now."""
        problem = self._problem
        P = problem.stiffened(self._stiff)
        P.setNearNullSpace(self._modes)
        if self._pc is not None:
            self._pc.destroy()
        problem.let_go()
        pc = PETSc.PC().create(problem.comm)
        pc.setOptionsPrefix("extrusion_bulk_")
        pc.setType("gamg")
        options = PETSc.Options()
        for name, value in GAMG.items():
            if not options.hasName(f"extrusion_bulk_{name}"):
                options[f"extrusion_bulk_{name}"] = value
        pc.setFromOptions()
        pc.setOperators(P)
        pc.setUp()
        self._pc, self._P, self._fresh = pc, P, True

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The tangent by a vector that is zero at the supports."""
        problem = self._problem
        problem.bulk_times(x, y)
        z = problem.gather(x)
        y.array[problem.x_rows] += self._D @ z

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve nearly."""
        problem = self._problem
        first = problem.n_z - problem.n_multipliers
        self._f.array[:] = b.array_r[: self._n_u]
        if not problem.n_multipliers:
            self._solve_bulk()
            y.array[: self._n_u] = self._u.array_r
            return
        r = problem.gather(b)[first:]
        scale = np.where(self._closed & (self._s != 0.0), self._s, 1.0)
        p = np.where(self._closed, 0.0, r / np.where(self._diagonal != 0.0, self._diagonal, 1.0))
        self._add(self._Bt @ (np.where(self._closed, self._kappa / scale * r, 0.0) - p))
        self._solve_bulk()
        gap = self._B @ problem.gather_displacements(self._u)
        p += np.where(self._closed, self._kappa * (gap - r / scale), 0.0)
        y.array[: self._n_u] = self._u.array_r
        y.array[self._n_u :] = p[: len(y.array_r) - self._n_u]

    def _solve_bulk(self) -> None:
        self._applied += 1
        if self._pc is None or (self._applied == STALE and not self._fresh):
            self._factor()
        assert self._pc is not None
        self._pc.apply(self._f, self._u)
        self._u.array[self._problem.held_rows] = 0.0  # the supports do not move; multigrid lets them, a little

    def _add(self, force: Array) -> None:
        """Forces over the displacements in z onto this rank's right-hand side."""
        problem = self._problem
        mine = problem.z_rows
        mine, at = mine[mine < len(force)], problem.x_rows[mine < len(force)]
        self._f.array[at] += force[mine]


STALE = 12
"""Iterations after which the multigrid of an earlier contact is made anew."""

GAMG = {
    "pc_gamg_threshold": 0.01,
    "pc_gamg_agg_nsmooths": 1,
    "pc_gamg_coarse_eq_limit": 1000,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "sor",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_esteig_ksp_type": "cg",
    "mg_levels_esteig_ksp_max_it": 10,
}
"""Options of the multigrid, with the prefix ``extrusion_bulk_``."""


def _rigid_modes(problem: Problem, like: PETSc.Vec) -> PETSc.NullSpace:
    """The six rigid body modes, zero at the supports."""
    n = like.local_size // 3
    X = problem.V.tabulate_dof_coordinates()[:n]
    centre = problem.comm.allreduce(X.sum(axis=0)) / problem.comm.allreduce(n)
    X = (X - centre) / problem.case.profile.radius
    modes = np.zeros((6, n, 3))
    for i in range(3):
        modes[i, :, i] = 1.0
        j, k = (i + 1) % 3, (i + 2) % 3
        modes[3 + i, :, k], modes[3 + i, :, j] = X[:, j], -X[:, k]
    vectors: list[PETSc.Vec] = []
    for mode in modes:
        v = like.duplicate()
        v.array[:] = mode.ravel()
        for other in vectors:
            v.axpy(-v.dot(other), other)
        v.normalize()
        vectors.append(v)
    return PETSc.NullSpace().create(vectors=vectors, comm=problem.comm)
