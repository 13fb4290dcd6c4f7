"""PETSc matrices of a bulk that stays and a contact that changes."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from extrusion.gap import Array, Index


class TangentMatrix:
    """Constant bulk plus changing contact entries in one PETSc matrix, held by rows.

    The pattern grows when contact meets a new pair of nodes; as long as it does not, the matrix is the same object, and
    what was found out of its pattern (symbolic factorisation, aggregates) is kept. `reset` lets go of what the billet
    has left behind. Held rows and columns are those of the identity.
    """

    def __init__(
        self,
        comm: MPI.Intracomm,
        n_local: int,
        n: int,
        row0: int,
        indptr: Index,
        indices: Index,
        data: Array,
        held: Index,
        block: int = 1,
    ) -> None:
        self._block = block
        self._comm, self._n_local, self._n, self._row0 = comm, n_local, n, row0
        self._A: PETSc.Mat | None = None
        rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        is_held = np.zeros(n, dtype=bool)
        is_held[held] = True
        off = is_held[rows + row0] | is_held[indices]
        data = np.where(off, 0.0, data)
        keys = rows * np.int64(n) + indices
        own = np.arange(n_local, dtype=np.int64)
        own = own * np.int64(n) + own + row0  # every diagonal entry, the multipliers' too
        self._held_keys, self._held_value = (
            own[is_held[row0 : row0 + n_local]],
            float(np.max(np.abs(data), initial=1.0)),
        )
        self._bulk_keys, self._bulk = keys, data
        self._least_keys = _sorted_distinct(np.concatenate([keys, own]))
        self.reset()

    def _set_pattern(self, keys: Index) -> None:
        self._keys = keys
        self._base = np.zeros(len(keys))
        self._base[np.searchsorted(keys, self._bulk_keys)] = self._bulk
        self._base[np.searchsorted(keys, self._held_keys)] = self._held_value

    def reset(self) -> None:
        """Back to the bulk's pattern and every diagonal entry."""
        self._set_pattern(self._least_keys)
        self._A = None

    def _create(self) -> PETSc.Mat:
        rows, cols = self._keys // self._n + self._row0, self._keys % self._n
        A = PETSc.Mat().create(self._comm)
        A.setSizes(((self._n_local, self._n), (self._n_local, self._n)), bsize=self._block)
        A.setType("aij")
        A.setPreallocationCOO(rows.astype(PETSc.IntType), cols.astype(PETSc.IntType))
        return A

    def fill(self, rows: Index, cols: Index, values: Array) -> PETSc.Mat:
        """Bulk + triplets (local rows, global columns; repeated entries add up); a new matrix if the pattern grew."""
        keys = rows * np.int64(self._n) + cols
        slots = np.searchsorted(self._keys, keys)
        known = slots < len(self._keys)
        known[known] = self._keys[slots[known]] == keys[known]
        grows = not known.all()
        if self._comm.size > 1:
            grows = self._comm.allreduce(grows, op=MPI.LOR)
        if grows:
            new = _sorted_distinct(keys[~known])
            self._set_pattern(np.insert(self._keys, np.searchsorted(self._keys, new), new))
            slots = np.searchsorted(self._keys, keys)
        data = self._base.copy()
        np.add.at(data, slots, values)
        if grows or self._A is None:
            self._A = self._create()
        self._A.setValuesCOO(data)
        return self._A


def widened(comm: MPI.Intracomm, n_local: int, n: int, indptr: Index, indices: Index, data: Array) -> PETSc.Mat:
    """The bulk matrix with empty rows and columns for the multipliers."""
    indptr = np.append(indptr, np.full(n_local + 1 - len(indptr), indptr[-1])).astype(PETSc.IntType)
    return PETSc.Mat().createAIJ(((n_local, n), (n_local, n)), csr=(indptr, indices, data), comm=comm)


def _sorted_distinct(keys: Index) -> Index:
    """`numpy.unique` by sorting: the hashed one is a hundred times slower on such keys (NumPy 2.5)."""
    keys = np.sort(keys)
    return keys[np.append(True, keys[1:] != keys[:-1])] if len(keys) else keys
