"""The compliance of a body's surface, in blocks whose far parts are products of low rank.

What a force does is smooth far from it. So neighbouring forces have few different effects there, along a curve some 20
to the last digit, however many forces there are: their rows of the matrix are a few columns around the forces, and on
either side of these a product of low rank. Bebendorf, Hierarchical Matrices (2008), doi:10.1007/978-3-540-77147-0, has
blocks of blocks; for some thousand forces one level does. Where nothing is gained a block stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from extrusion.compiled import blocks, pointer
from extrusion.gap import Array, Index

WHOLE = 400
"""Forces up to which a body's matrix is one block."""

FORCES = 128
"""Forces of a block where there are more."""

TRIED = 48
"""Singular vectors of a far part that are looked for (`blocks.c` has room for twice as many, and more); a block one of
whose far parts has more is kept as it is."""

WORTH = 0.7
"""Part of its entries that a block may keep as products."""

LEFT_OUT = {np.dtype(np.float64): 1e-14, np.dtype(np.float32): 1e-7}
"""What far parts are off by, relative to their block's largest entry, in each precision."""


@dataclass(frozen=True)
class Block:
    """Rows of the matrix: the columns of ``near`` as they are, those before and after it as products."""

    near: slice
    D: Array  # (n, width of near)
    U: Array  # (n, ranks before and after)
    before: Array  # (rank, near.start)
    after: Array  # (rank, columns from near.stop on)

    @classmethod
    def of(cls, rows: Array, near: slice, dtypes: list[Any]) -> list[Block]:
        """From whole rows, in some precisions."""
        n, columns = rows.shape
        far = [rows[:, : near.start], rows[:, near.stop :]]
        largest = float(np.max(np.abs(rows), initial=0.0))
        small = min(n, columns - near.stop + near.start) <= TRIED
        found = [] if small else [_product(part, largest) for part in far]
        out = []
        for dtype in dtypes:
            ranks = [int(np.count_nonzero(size > LEFT_OUT[np.dtype(dtype)])) for _, _, size in found]
            entries = sum(r * (n + part.shape[1]) for r, part in zip(ranks, far, strict=False))
            if small or max(ranks) == TRIED or entries + n * (near.stop - near.start) >= WORTH * rows.size:
                nothing = np.zeros((0, 0), dtype=dtype)
                out.append(cls(slice(0, columns), rows.astype(dtype), np.zeros((n, 0), dtype=dtype), nothing, nothing))
                continue
            U = np.concatenate([u[:, :r] for (u, _, _), r in zip(found, ranks, strict=True)], axis=1)
            V = [v[:r].astype(dtype) for (_, v, _), r in zip(found, ranks, strict=True)]
            out.append(cls(near, rows[:, near].astype(dtype), U.astype(dtype), *V))
        return out

    @property
    def nbytes(self) -> int:
        """Memory."""
        return self.D.nbytes + self.U.nbytes + self.before.nbytes + self.after.nbytes

    def whole(self) -> Array:
        """The rows, all columns."""
        r = len(self.before)
        return np.concatenate([self.U[:, :r] @ self.before, self.D, self.U[:, r:] @ self.after], axis=1)

    def part(self, rows: Index, columns: slice, links: tuple[Index, Index, Array] | None = None) -> Block:
        """Some rows, over a range of columns.

        ``links``: to which of them to add which other rows, times what.
        """
        width = columns.stop - columns.start
        start, stop = (min(max(at - columns.start, 0), width) for at in (self.near.start, self.near.stop))
        first = columns.start + start - self.near.start
        D, r = self.D[:, first : first + stop - start], len(self.before)
        before = self.before[:, columns.start : columns.start + start]
        after = self.after[:, columns.start + stop - self.near.stop : columns.stop - self.near.stop]
        U = self.U[:, (0 if start else r) : (self.U.shape[1] if stop < width else r)]
        if not start:
            before = before[:0]
        if stop == width:
            after = after[:0]
        D, U = (_linked(a, rows, links) for a in (D, U))
        return Block(slice(start, stop), D, U, before, after)


class Blocks:
    """Blocks that are multiplied at one go.

    Args:
        parts: Blocks of one precision, each with the entry of the vector that its first row belongs to, and the entry
            of the result that its first column does.
    """

    def __init__(self, parts: Sequence[tuple[int, int, Block]]) -> None:
        parts = [part for part in parts if len(part[2].D)]
        ffi, self.dtype = blocks().ffi, parts[0][2].D.dtype if parts else None
        self._held: list[Array] = []  # C has their addresses
        self._add = blocks().lib.add_float if self.dtype == np.float32 else blocks().lib.add_double
        self.of = ffi.new("block[]", len(parts))
        for to, (first, column, part) in zip(self.of, parts, strict=True):
            to.rows, to.first, to.to, to.start, to.stop = len(part.D), first, column, part.near.start, part.near.stop
            to.width = part.near.stop + part.after.shape[1]
            to.before, to.after = len(part.before), len(part.after)
            for name, given in zip("DUVW", (part.D, part.U, part.before, part.after), strict=True):
                if not given.size:
                    continue
                # some run down their columns
                array = given if given.strides[1] == given.itemsize else np.ascontiguousarray(given)
                self._held.append(array)
                setattr(to, name, ffi.cast("void *", array.ctypes.data))
                setattr(to, name.lower(), array.strides[0] // array.itemsize)

    def add(self, f: Array, out: Array) -> None:
        """Add f times the rows to ``out``; both contiguous and of the blocks' precision."""
        if len(self.of):
            if not f.dtype == out.dtype == self.dtype:
                raise TypeError(f"{f.dtype} and {out.dtype} for blocks of {self.dtype}")
            self._add(len(self.of), self.of, pointer(f), pointer(out))


def _product(A: Array, largest: float) -> tuple[Array, Array, Array]:
    """``A = U V`` with `TRIED` orthonormal columns U, and how much each of them adds, relative to ``largest``.

    By random products. Halko, Martinsson, Tropp, SIAM Review 53 (2011) 217, doi:10.1137/090771806.
    """
    if not A.shape[1]:
        return A, A[:0], np.zeros(0)
    at_random = np.random.default_rng(0).standard_normal((A.shape[1], TRIED))
    Q, R = np.linalg.qr(A @ at_random)
    V, size, _ = np.linalg.svd(R)
    U = Q @ V
    return U, U.T @ A, size / (max(largest, 1e-300) * np.sqrt(A.shape[1]))


class Compliance:
    """The matrix of a body, a row for each force; made a block at a time.

    Args:
        own: Where each force's own displacement stands among the columns, increasing.
        node: Of each force; those of one node share a block.
        columns: Displacements that are read.
        single: Keep the blocks in single precision, too.
    """

    def __init__(self, own: Index, node: Index, columns: int, single: bool) -> None:
        n = len(own)
        self.shape, self._own = (n, columns), own
        new = np.append(np.flatnonzero(np.diff(node, prepend=-1)), n)
        at = np.arange(0, n if n > WHOLE else min(n, 1), FORCES)
        cuts = np.unique([*new[np.searchsorted(new, at)], n])
        self.blocks = [slice(int(a), int(b)) for a, b in pairwise(cuts)]
        self._number = np.repeat(np.arange(len(self.blocks)), np.diff(cuts))
        self._dtypes: list[Any] = [np.float64, np.float32] if single else [np.float64]
        self._made: list[list[Block] | None] = [None] * len(self.blocks)
        self._all: Blocks | None = None  # of what has been made

    def missing(self, forces: Index) -> list[int]:
        """The blocks of some forces that have not been made."""
        wanted = np.zeros(len(self.blocks), dtype=bool)
        wanted[self._number[forces]] = True
        return [number for number in np.flatnonzero(wanted).tolist() if self._made[number] is None]

    def make(self, number: int, rows: Array) -> None:
        """Take the rows of a block."""
        own = self._own[self.blocks[number]]
        half = (int(own[-1]) - int(own[0]) + 1) // 2
        near = slice(max(int(own[0]) - half, 0), min(int(own[-1]) + 1 + half, self.shape[1]))
        self._made[number], self._all = Block.of(rows, near, self._dtypes), None

    @property
    def made(self) -> int:
        """How many rows have been made."""
        return sum(block.stop - block.start for block, made in zip(self.blocks, self._made, strict=True) if made)

    @property
    def nbytes(self) -> int:
        """Memory of what has been made."""
        return sum(block.nbytes for made in self._made if made for block in made)

    def displacements(self, f: Array) -> Array:
        """What forces cause, f times the matrix; forces without rows cause none."""
        if self._all is None:
            made = zip(self.blocks, self._made, strict=True)
            self._all = Blocks([(rows.start, 0, of[0]) for rows, of in made if of is not None])
        out = np.zeros(self.shape[1])
        self._all.add(f, out)
        return out

    def parts(
        self, kept: Index, others: Index, links: tuple[Index, Index, Array], columns: slice
    ) -> Iterator[tuple[int, int, Block, Block]]:
        """Rows of kept forces, to which those of others are added, and rows of the others, over some columns.

        In the lower precision, block by block: the first of the kept, the first of the others, and their rows. Both
        are in order; ``links`` say to which of the kept to add which of the others (in order, of the same node), times
        what.
        """
        ends = [np.searchsorted(forces, [rows.stop for rows in self.blocks]).tolist() for forces in (kept, others)]
        to, linked, slope = links
        last = [0, 0]
        for number, (rows, a, b) in enumerate(zip(self.blocks, *ends, strict=True)):
            (k, o), last = (slice(last[0], a), slice(last[1], b)), [a, b]
            made = self._made[number]
            if made is None or (k.start == k.stop and o.start == o.stop):
                continue
            of_k, of_o = kept[k] - rows.start, others[o] - rows.start
            here = slice(*np.searchsorted(linked, [o.start, o.stop]).tolist())
            mine = to[here] - k.start, of_o[linked[here] - o.start], slope[here]
            yield k.start, o.start, made[-1].part(of_k, columns, mine), made[-1].part(of_o, columns)


def _linked(A: Array, rows: Index, links: tuple[Index, Index, Array] | None) -> Array:
    """Rows of a matrix; see `Block.part`."""
    out = A[rows]
    to, of, slope = links or (rows[:0], rows[:0], A[0, :0])
    while len(to) and A.shape[1]:  # one at each row at a time: three forces of a node may be two links
        if (to[1:] > to[:-1]).all():
            out[to] += slope[:, None] * A[of]
            break
        first = np.unique(to, return_index=True)[1]
        out[to[first]] += slope[first, None] * A[of[first]]
        rest = np.delete(np.arange(len(to)), first)
        to, of, slope = to[rest], of[rest], slope[rest]
    return out
