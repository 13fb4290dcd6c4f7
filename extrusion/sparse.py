"""Small sparse matrices by rows, in C (``blocks.c``): SciPy's take longer to be made than to be used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from extrusion.compiled import blocks, pointer
from extrusion.gap import Array, Index

Small = NDArray[np.int32]


@dataclass(frozen=True)
class Triplets:
    """Entries of a sparse matrix."""

    rows: Small
    cols: Small
    values: Array

    @classmethod
    def placed(cls, rows: Index, cols: Index, values: Array, row_of: Index, col_of: Index) -> Triplets:
        """By where rows and columns stand: negative ones, and values of 0, are left out."""
        at, on, out = np.empty(len(values), np.int32), np.empty(len(values), np.int32), np.empty(len(values))
        given = rows, cols, values, row_of, col_of
        pointers = (pointer(np.ascontiguousarray(array)) for array in (*given, at, on, out))
        n = blocks().lib.placed(len(values), *pointers)
        return cls(at[:n], on[:n], out[:n])

    def assembled(self, row_of: Small, col_of: Small, shape: tuple[int, int], dtype: Any) -> Sparse:
        """The matrix, in a precision; rows and columns by where they stand, negative ones are left out."""
        add = blocks().lib.csr_float if dtype == np.float32 else blocks().lib.csr_double
        count = len(self.values)
        start, columns, out = np.empty(shape[0] + 1, np.int32), np.empty(count, np.int32), np.empty(count, dtype)
        scratch = np.empty(count + sum(shape), np.int32)
        given = (pointer(array) for array in (self.rows, self.cols, self.values, row_of, col_of))
        n = add(count, *given, *shape, *(pointer(array) for array in (start, columns, out, scratch)))
        return Sparse(start, columns[:n], out[:n], shape[1])


@dataclass(frozen=True)
class Sparse:
    """A matrix by compressed rows, whose columns are in any order."""

    start: Small  # (rows + 1,)
    columns: Small
    values: Array  # in either precision
    width: int

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def row(self) -> Index:
        """Of each entry."""
        return np.repeat(np.arange(len(self)), np.diff(self.start))

    def rows(self, which: Index) -> Sparse:
        """Some rows, in this order."""
        count = np.diff(self.start)[which]
        start = np.append(0, np.cumsum(count))
        of = np.repeat(self.start[which] - start[:-1], count) + np.arange(start[-1])
        return Sparse(start.astype(np.int32), self.columns[of], self.values[of], self.width)

    def first(self, rows: int, columns: slice) -> Array:
        """The first rows' part in some columns, dense."""
        out = np.zeros((rows, columns.stop - columns.start), dtype=self.values.dtype)
        end = self.start[rows]
        on = (self.columns[:end] >= columns.start) & (self.columns[:end] < columns.stop)
        out[self.row[:end][on], self.columns[:end][on] - columns.start] = self.values[:end][on]
        return out

    def times(self, vector: Array) -> Array:
        """By a vector of the same precision."""
        out = np.empty(len(self), dtype=self.values.dtype)
        self._c("csr_times", len(self), self.start, self.columns, self.values, self._same(vector), out)
        return out

    def add_times(self, columns: slice, matrix: Array, out: Array) -> None:
        """Add the first rows' part in some columns, times a matrix with a row for each of these, to as many rows."""
        rows, n = out.shape
        if (out.size and out.strides[1] != out.itemsize) or matrix.shape != (columns.stop - columns.start, n):
            raise ValueError(f"{matrix.shape} times {columns} into {out.shape}")
        to = blocks().ffi.cast(f"{'float' if out.itemsize == 4 else 'double'} *", out.ctypes.data)
        given = (self.start, self.columns, self.values, columns.start, columns.stop, self._same(matrix))
        self._c("csr_matrix", rows, *given, n, to, out.strides[0] // out.itemsize)

    def products(self, one: Index, other: Index) -> Array:
        """Of pairs of rows."""
        out, scratch = np.empty(len(one)), np.zeros(self.width, dtype=self.values.dtype)
        self._c("csr_products", len(one), one, other, self.start, self.columns, self.values, scratch, out)
        return out

    def _same(self, array: Array) -> Array:
        return np.ascontiguousarray(array, dtype=self.values.dtype)

    def _c(self, name: str, *given: Any) -> None:
        function = getattr(blocks().lib, f"{name}_{'float' if self.values.itemsize == 4 else 'double'}")
        function(*(pointer(value) if isinstance(value, np.ndarray) else value for value in given))
