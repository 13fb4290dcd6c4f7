"""The tangent's linear systems by a Krylov method, for bulks too large to factor again and again.

The bulk stays as it is; contact is a few sparse rows D beside it::

    [ K_b + D_bb   D_bd         D_bp ] [ u_b ]
    [ D_db         K_d + D_dd   D_dp ] [ u_d ] = r          b: billet, d: die, p: the multipliers, if there are any
    [ D_pb         D_pd         D_pp ] [ p   ]

The preconditioner takes the billet first, as against a rigid die, and then the die, under the forces that this gives
(Dirichlet and Neumann conditions of a domain decomposition: Quarteroni, Valli, Domain Decomposition Methods for Partial
Differential Equations, 1999). What is left of the die is K_d and the billet's stiffness in series with the contact's:
about as stiff as the die, whatever the mesh and the contact stiffness. Each body has an algebraic multigrid (PETSc's
GAMG with the rigid body modes as near-nullspace). The die's is made once, of K_d. The billet's is of the symmetric
``P = K_b + B^T kappa B``, B being the gap's rows of what is closed and kappa their contact stiffness; as contact
changes the aggregates stay, and only the coarse matrices are made anew. Multipliers p, of which the closed rows read
``s B u = r_p``, take the augmented Lagrangian's Schur complement ``1 / kappa`` (Benzi, Olshanskii 2006,
doi:10.1137/050646421)::

    u_b = P^-1 (r_b + B^T (kappa / s) r_p),   p = kappa (B u_b - r_p / s)
"""

from __future__ import annotations

import weakref
from functools import cached_property
from typing import TYPE_CHECKING

from mpi4py import MPI  # noqa: F401  the wheel's PETSc needs the MPI that it loads
from petsc4py import PETSc

import numpy as np
import scipy.sparse

from extrusion.gap import Array, Index
from extrusion.matrix import TangentMatrix
from extrusion.zones import Triplets

if TYPE_CHECKING:
    from extrusion.problem import Problem

RTOL = 1e-9
"""Relative tolerance of a linear solve: small enough for passes of nodal contact to end as with a direct solver."""

MOST = 1e-2
"""The largest one for methods that follow the geometry, whose next iterate mends what is left."""


class Krylov:
    """What PETSc's matrix of the tangent does, and its preconditioner.

    It holds neither that matrix nor the problem: PETSc holds it in C, where no garbage collector looks.

    Args:
        problem: Whose bulk it is. Displacements and multipliers only, no pressures.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = weakref.proxy(problem)
        x = problem.x
        self._bodies = [_Multigrid(problem, A, rows) for A, rows in problem.bulk()]
        self._z = x.duplicate()
        self._of_billet = np.isin(problem.x_rows, self._bodies[0].rows)
        self._stiff: Triplets | None = None
        self._fresh = False  # the billet's multigrid knows the contact of now

    def set(self, D: Triplets, stiff: Triplets, kappa: Array) -> None:
        """Take contact's derivative, its symmetric stiffness of the billet and kappa of each multiplier. Collective.

        The derivative in this rank's rows, or in all if there are multipliers.
        """
        problem, n = self._problem, self._problem.n_z
        first = n - problem.n_multipliers
        rows, cols, values = D
        whole = scipy.sparse.coo_array((values, (rows, cols)), shape=(n, n)).tocsr()
        self._D = whole[problem.z_rows]
        if problem.n_multipliers:
            self._Bt = whole[:first, first:]
            s_B = whole[first:, :first]
            held = np.asarray(abs(whole[first:, first:]).sum(axis=1)).ravel() == 0.0  # closed rows have no diagonal
            self._closed, self._kappa = held, kappa
            self._B = self._Bt.T.tocsr()
            norm = np.asarray(self._B.multiply(self._B).sum(axis=1)).ravel()
            s = np.asarray(s_B.multiply(self._B).sum(axis=1)).ravel() / np.where(norm > 0, norm, 1.0)
            self._s = np.where(held & (s != 0.0), s, 1.0)
            diagonal = whole[first:, first:].diagonal()
            self._diagonal = np.where(diagonal != 0.0, diagonal, 1.0)
        rows, cols, values = stiff
        keep = problem.z_free[rows] & problem.z_free[cols]
        stiff = rows[keep], cols[keep], values[keep]
        known, self._stiff = self._stiff, stiff
        same = known is not None and all(np.array_equal(a, b) for a, b in zip(stiff, known, strict=True))
        self._fresh &= problem.agreed(same)

    def mult(self, A: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The tangent by a vector that is zero at the supports."""
        problem = self._problem
        problem.bulk_times(x, y)
        z = problem.gather(x)
        y.array[problem.x_rows] += self._D @ z

    def apply(self, pc: PETSc.PC, b: PETSc.Vec, y: PETSc.Vec) -> None:
        """Solve nearly."""
        problem, billet = self._problem, self._bodies[0]
        first = problem.n_z - problem.n_multipliers
        f, u = np.array(b.array_r), self._z.array
        u[:] = 0.0
        p = np.zeros(0)
        if problem.n_multipliers:
            r = problem.gather(b)[first:]
            p = np.where(self._closed, 0.0, r / self._diagonal)
            onto = self._Bt @ (np.where(self._closed, self._kappa / self._s * r, 0.0) - p)
            f[problem.x_rows[self._of_billet]] += onto[problem.z_rows[self._of_billet]]
        if not self._fresh:
            billet.make(self._stiff)
            self._fresh = True
        u[billet.rows] = billet.solve(f[billet.rows])
        if problem.n_multipliers or len(self._bodies) > 1:
            z = problem.gather(self._z)
            if problem.n_multipliers:
                p += np.where(self._closed, self._kappa * (self._B @ z[:first] - r / self._s), 0.0)
                z[first:] = p
            for die in self._bodies[1:]:
                f[problem.x_rows] -= self._D @ z
                u[die.rows] = die.solve(f[die.rows])
        if len(p) and problem.comm.rank == problem.comm.size - 1:
            u[-len(p) :] = p
        y.array[:] = u


GAMG = {
    "pc_gamg_threshold": 0.01,
    "pc_gamg_agg_nsmooths": 1,
    "pc_gamg_coarse_eq_limit": 1000,
    "pc_gamg_reuse_interpolation": True,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_pc_type": "sor",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_esteig_ksp_type": "cg",
    "mg_levels_esteig_ksp_max_it": 10,
}
"""Options of the multigrid, with the prefix ``extrusion_bulk_``."""


class _Multigrid:
    """Multigrid of one body.

    Args:
        problem: Whose body it is.
        A: Its bulk matrix, identity-like at the supports.
        entries: Which entries of the full x its rows are (all ranks'), increasing.
    """

    def __init__(self, problem: Problem, A: PETSc.Mat, entries: Index) -> None:
        self._A, self._P, self._dim = A, None, problem.dim
        self._first, end = A.owner_range
        self.rows = entries[self._first : end] - problem.x.owner_range[0]
        self._held = np.isin(self.rows, problem.held_rows)
        self._row_of_z = np.searchsorted(entries, problem.z_to_x)
        self._f, self._u = A.createVecs()
        self._modes = _rigid_modes(problem, self._u, self.rows)
        self._pc: PETSc.PC | None = None

    @cached_property
    def _stiffened(self) -> TangentMatrix:
        A, none = self._A, np.zeros(0, dtype=np.int64)  # the supports' rows are as they should be
        indptr, indices, data = A.getValuesCSR()
        sizes = A.local_size[0], A.size[0], self._first
        return TangentMatrix(A.comm.tompi4py(), *sizes, indptr, indices, data, none, self._dim)

    def make(self, stiff: Triplets | None = None) -> None:
        """Make it, or make it anew, of the bulk and symmetric triplets over the displacements in z. Collective."""
        P = self._A
        if stiff is not None:
            rows, cols, values = self._row_of_z[stiff[0]] - self._first, self._row_of_z[stiff[1]], stiff[2]
            mine = (rows >= 0) & (rows < self._A.local_size[0])
            P = self._stiffened.fill(rows[mine], cols[mine], values[mine])
        if self._pc is None or P != self._P:
            P.setNearNullSpace(self._modes)
            if self._pc is not None:
                self._pc.destroy()
            self._pc = PETSc.PC().create(P.comm)
            self._pc.setOptionsPrefix("extrusion_bulk_")
            self._pc.setType("gamg")
            options = PETSc.Options()
            for name, value in GAMG.items():
                if not options.hasName(f"extrusion_bulk_{name}"):
                    options[f"extrusion_bulk_{name}"] = value
            self._pc.setFromOptions()
            self._P = P
        self._pc.setOperators(P)
        self._pc.setUp()

    def solve(self, f: Array) -> Array:
        """Solve nearly, of this rank's rows; of the bulk alone if it has not been made of more. Collective."""
        if self._pc is None:
            self.make()
        assert self._pc is not None
        self._f.array[:] = f
        self._pc.apply(self._f, self._u)
        u = np.array(self._u.array_r)
        u[self._held] = 0.0  # the supports do not move; multigrid lets them, a little
        return u


def _rigid_modes(problem: Problem, like: PETSc.Vec, rows: Index) -> PETSc.NullSpace:
    """The six rigid body modes of the nodes at some rows."""
    comm = problem.comm
    X = problem.V.tabulate_dof_coordinates()[rows[::3] // 3]
    n = len(X)
    centre = comm.allreduce(X.sum(axis=0)) / comm.allreduce(n)
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
    return PETSc.NullSpace().create(vectors=vectors, comm=comm)
