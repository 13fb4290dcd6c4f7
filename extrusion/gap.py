"""Gap between two tagged surfaces in their current position, and its first and second derivative.

A surface is small beside the volume, so it is held whole, as plain arrays, on every rank, in a numbering of its own:
the *contact vector* ``z`` lists the displacements (c0, c1) of all nodes that contact can touch, node by node. All
results below are rows over *local columns*: the nodes of one slave facet (or of its cell, for the stress) followed by
the nodes of one die facet, two components each; ``cols`` says where these stand in ``z``.

Two ways to measure the gap (DESIGN section 1, CONTACT section 1), positive when open:

- `ray_points`: along a fixed coordinate direction, at quadrature points split at every vertex of the deformed die;
- `closest_points`: to the closest point of the die, along the die's normal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from extrusion.compiled import pointer, ray

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Surface:
    """Facets of a boundary curve, in order along it.

    ``nodes[i]`` are the nodes of facet i: start, end and, for order 2, middle. ``cell_nodes[i]`` are the nodes of the
    cell behind it (only those of the facet where no stress is asked), and ``local[i]`` finds the first in the second.
    """

    X: Array  # (m, k, 2) reference coordinates of the facet's nodes, mm
    nodes: Index  # (m, k) node numbers in z (displacement dofs 2 n, 2 n + 1)
    cell_nodes: Index  # (m, K)
    local: Index  # (m, k)
    cell_X: Array  # (m, 3, 2) vertices of the cell behind the facet, mm
    facet_vertices: Index  # (m, 2) which of those are the facet's start and end
    side: float = 1.0  # +1 if the body lies to the left of the facets, -1 if to the right
    tabulate: Callable[[int, Array], Array] | None = None  # basix tabulate of the cell's element
    pressure_cols: Index | None = None  # (m, 3) where z holds the cell's pressures (displacement-pressure form)

    @cached_property
    def length(self) -> Array:
        """Facet lengths, mm, ``shape=(m,)``."""
        return np.asarray(np.linalg.norm(self.X[:, 1] - self.X[:, 0], axis=1))

    @cached_property
    def normal(self) -> Array:
        """Outward unit normals in the reference position, ``shape=(m, 2)``."""
        t = (self.X[:, 1] - self.X[:, 0]) / self.length[:, None]
        return self.side * np.stack([t[:, 1], -t[:, 0]], axis=1)

    @cached_property
    def node_numbers(self) -> Index:
        """Distinct nodes in order along the curve."""
        along = np.column_stack([self.nodes[:, 0], *self.nodes[:, 2:].T, self.nodes[:, 1]]).ravel()
        first = np.sort(np.unique(along, return_index=True)[1])
        return np.asarray(along[first])

    @cached_property
    def node_positions(self) -> Array:
        """Reference positions of `node_numbers`, ``shape=(n, 2)``, mm."""
        number, first = np.unique(self.nodes, return_index=True)
        return np.asarray(self.X.reshape(-1, 2)[first[np.searchsorted(number, self.node_numbers)]])

    @cached_property
    def gradients(self) -> Array:
        """Gradients of the cell's functions along the facet, by powers of xi, 1/mm: ``shape=(m, k - 1, K, 2)``."""
        assert self.tabulate is not None
        m, k = self.nodes.shape
        ends = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[self.facet_vertices]
        at = shape(np.array([0.0, 1.0, 0.5][:k]), 2) @ ends
        table = self.tabulate(1, at.reshape(-1, 2))[1:].reshape(2, m, k, -1)
        K = np.linalg.inv(np.swapaxes(self.cell_X[:, 1:] - self.cell_X[:, :1], 1, 2))  # K[m, i, j] = d X_i(ref) / d x_j
        return np.einsum("ak,imkl,mij->malj", SHAPES[k][:-1, 0], table, K)

    def least(self, z: Array, axis: int, sign: float) -> float:
        """Smallest value of ``sign`` times a component of the current position of nodes, mm."""
        X, entries = self._along[axis]
        return float((sign * (X + z[entries])).min())

    @cached_property
    def _along(self) -> list[tuple[Array, Index]]:
        """Each component of the nodes' positions, and where z holds its displacement."""
        X, nodes = self.node_positions, self.node_numbers
        return [(np.ascontiguousarray(X[:, axis]), 2 * nodes + axis) for axis in (0, 1)]

    @cached_property
    def _last_node(self) -> int:
        return int(max(self.nodes.max(), self.cell_nodes.max()))

    @cached_property
    def _compiled(self) -> tuple[Any, list[Any]]:
        """The ``surface`` of ``ray.h``, and what it points to."""
        (m, k), K = self.nodes.shape, self.cell_nodes.shape[1]
        arrays: dict[str, Any] = {"X": self.X, "normal": self.normal, "length": self.length}
        arrays |= {"nodes": self.nodes, "cells": self.cell_nodes, "local": self.local, "ends": self.facet_vertices}
        if self.tabulate is not None:
            arrays["gradients"] = self.gradients
        out, held = ray().ffi.new("surface *", {"m": m, "k": k, "K": K}), []
        for name, array in arrays.items():
            held.append(np.ascontiguousarray(array, dtype=np.float64 if array.dtype.kind == "f" else np.int64))
            setattr(out, name, pointer(held[-1]))
        return out, held

    def reversed(self) -> Surface:
        """The same facets in the opposite order, each with start and end exchanged."""
        swap = [1, 0, *range(2, self.nodes.shape[1])]
        return Surface(
            self.X[::-1, swap],
            self.nodes[::-1, swap],
            self.cell_nodes[::-1],
            self.local[::-1, swap],
            self.cell_X[::-1],
            self.facet_vertices[::-1, ::-1],
            -self.side,
            self.tabulate,
            None if self.pressure_cols is None else self.pressure_cols[::-1],
        )


def polyline(points: Array, first_node: int, side: float) -> Surface:
    """A rigid curve of straight facets, whose nodes are numbered from ``first_node`` on.

    Args:
        points: Vertices, ``shape=(m + 1, 2)``, mm.
        first_node: Number in ``z`` of the first vertex; the displacements there stay zero.
        side: +1 if the rigid body lies to the left of the curve, -1 if to the right.
    """
    start = np.arange(len(points) - 1)
    pair = np.stack([start, start + 1], axis=1)
    nodes = first_node + pair
    return Surface(points[pair], nodes, nodes, np.broadcast_to([0, 1], nodes.shape), points[pair], pair * 0, side)


SHAPES = {
    2: np.array([[[1.0, 0], [-1, 1], [0, 0]], [[-1, 1], [0, 0], [0, 0]]]),
    3: np.array(
        [
            [[1.0, 0, 0], [-3, -1, 4], [4, 4, -8]],
            [[-3, -1, 4], [4, 4, -8], [0, 0, 0]],
            [[2, 2, -4], [0, 0, 0], [0, 0, 0]],
        ]
    ),
}
"""Lagrange functions on [0, 1] for nodes start, end(, middle): by powers of xi, then values and two derivatives."""


def polynomial(xi: Array, rows: Array) -> Array:
    """Sum of ``xi ** j rows[..., j, :]``, ``shape=(*xi.shape, n)``; rows may have xi's axes in front, too."""
    out = rows[..., -1, :]
    for j in range(rows.shape[-2] - 2, -1, -1):
        out = rows[..., j, :] + xi[..., None] * out
    return np.asarray(out)


def shape(xi: Array, k: int, derivative: int = 0) -> Array:
    """Lagrange functions on [0, 1] for nodes start, end(, middle): values or a derivative, ``shape=(*xi.shape, k)``."""
    return polynomial(xi, SHAPES[k][:, derivative])


@cache
def gauss(order: int) -> tuple[Array, Array]:
    """Points and weights of Gauss's rule on [0, 1]."""
    s, omega = np.polynomial.legendre.leggauss(order)
    return (s + 1) / 2, omega / 2


def invert(values: Array, target: Array) -> Array:
    """The xi in [0, 1] at which curves with nodal ``values`` (.., k) pass ``target`` (..), which their ends enclose.

    The root nearest the middle where the target is not enclosed (an iterate gone astray).
    """
    return _root(np.moveaxis(values @ SHAPES[values.shape[-1]][:, 0].T, -1, 0), target)


def _root(powers: Array, target: Array) -> Array:
    """The same from the factors of xi's powers, ``shape=(k, ..)``."""
    b, c = powers[1], powers[0] - target
    if len(powers) == 2:
        return np.asarray(-c / b)
    a = powers[2]
    q = -0.5 * (b + np.copysign(np.sqrt(np.maximum(b * b - 4 * a * c, 0.0)), b))
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = c / q, q / a
    return np.asarray(np.where(np.abs(one - 0.5) <= np.abs(other - 0.5), one, other))


@dataclass(frozen=True)
class Points:
    """Contact points; arrays are (n pieces, q points) or have further axes behind these two.

    ``variation`` rows are derivatives over the local columns: of the weight, the place xi on the slave facet, and what
    the second derivative of the gap is made of (`curvature`).
    """

    facet: Index  # (n,) slave facet
    die: Index  # (n,) die facet
    cols: Index  # (n, L) columns of z
    xi: Array  # place on the slave facet, in [0, 1]
    weight: Array  # integration weight on the reference slave surface, mm^2 (2 pi r ds) or mm
    gap: Array  # mm
    G: Array  # (n, q, L) d gap / d z at fixed xi
    slope: Array  # tangent of the die's angle to the bore line
    past: NDArray[np.bool_]  # faces the die's extension past its ends, not the die
    gap_xi: Array | None = None
    G_xi: Array | None = None  # (n, q, L)
    curvature: tuple[tuple[Array, Array], ...] = ()  # pairs (l, r): d2 gap = sum l (x) r at fixed xi
    dxi: Array | None = None  # (n, q, L)
    dweight: Array | None = None  # (n, q, L)


def ray_points(
    slave: Surface,
    die: Surface,
    z: Array,
    axis: int,
    sign: float,
    order: int,
    axisymmetric: bool = True,
) -> Points:
    """Quadrature points of the slave facets, split at every deformed die vertex, with the gap along a fixed ray.

    The ray runs along coordinate ``axis`` (c) with ``sign`` from the slave to the die; the die is a graph over the
    other coordinate (p). Past its ends it goes on straight from the end vertex, at the end facet's reference slope
    (turning with the end facet it would hang on a lever as long as that facet, however small the mesh makes it)::

        gap = sign (x_c(k) + s e - x_s,c)    x_p(k) = x_s,p and e = 0 inside;  e = x_s,p - x_p(k) past an end
        dgap = sign (M.dd_c - N.du_c + s a)  a = N.du_p - M.dd_p;  ds = b = (M'.dd_c - s M'.dd_p) / x_p'

    and the second variation as CONTACT section 1 has it. The split points move with both bodies:
    ``dz = (dd_v,p - N.du_p) / x_s,p'``; with them move the points and weights of the pieces they bound, so that the
    derivatives are those of the integral that is summed.

    Args:
        slave: Slave surface, ordered with p increasing. It need not stay a graph: past L's turn onto the cone the side
            of the billet folds back.
        die: Die surface, ordered with p increasing.
        z: Contact vector, mm.
        axis: Component of the ray, 0 or 1.
        sign: +1 if the die lies towards larger c.
        order: Gauss points in a piece.
        axisymmetric: Weights ``2 pi r ds`` (else ds).

    Raises:
        ArithmeticError: The deformed die is no graph over p, or the slave is nowhere (an iterate gone astray).
    """
    library = ray()
    vertex = np.empty(len(die.X) + 1)
    s, omega = gauss(order)
    z = np.ascontiguousarray(z, dtype=np.float64)
    if len(z) < 2 * max(slave._last_node, die._last_node) + 2:
        raise IndexError(f"z holds {len(z)} entries, the surfaces' nodes go to {max(slave._last_node, die._last_node)}")

    of = slave._compiled[0], die._compiled[0], pointer(z), axis, sign, order
    into = *of, pointer(s), pointer(omega), axisymmetric, pointer(vertex)
    n = library.lib.ray_points(*into, library.ffi.NULL)
    if n < 0:
        raise ArithmeticError("the deformed die is no graph over the ray's base line")
    L = 2 * (slave.cell_nodes.shape[1] + die.nodes.shape[1])
    facet, on, cols = (np.empty(shape, dtype=np.int64) for shape in (n, n, (n, L)))
    xi, weight, gap, slope, gap_xi = np.empty((5, n, order))
    G, G_xi, a, b, dxi, dweight = np.empty((6, n, order, L))
    past = np.empty((n, order), dtype=np.bool_)
    out = library.ffi.new("points *")
    (
        out.facet, out.die, out.cols, out.xi, out.weight, out.gap, out.slope, out.gap_xi, out.past,
        out.G, out.G_xi, out.left, out.right, out.dxi, out.dweight,
    ) = map(pointer, (facet, on, cols, xi, weight, gap, slope, gap_xi, past, G, G_xi, a, b, dxi, dweight))  # fmt: skip
    filled = library.lib.ray_points(*into, out)
    assert filled == n
    return Points(facet, on, cols, xi, weight, gap, G, slope, past, gap_xi, G_xi, ((a, b), (b, a)), dxi, dweight)


def least_gap(slave: Surface, die: Surface, z: Array, axis: int, sign: float) -> float:
    """A lower bound of the ray gap anywhere, from the extent of both surfaces along the ray, mm (nodes)."""
    return die.least(z, axis, sign) + slave.least(z, axis, -sign)


def _reference_slope(die: Surface, axis: int) -> Array:
    chord = die.X[:, 1] - die.X[:, 0]
    return np.asarray(chord[:, axis] / chord[:, 1 - axis])


def _dofs(nodes: Index) -> Index:
    return np.asarray((2 * nodes[..., None] + np.arange(2)).reshape(*nodes.shape[:-1], -1))


def stress_rows(
    slave: Surface,
    facet: Index,
    xi: Array,
    direction: Array,
    lmbda: float,
    mu: float,
    axisymmetric: bool = True,
    derivative: int = 0,
    between: int = 0,
) -> Array:
    """Component ``direction . sigma(u) N`` of the slave's traction, as rows over its cell's displacements.

    Args:
        slave: Slave surface with cells.
        facet: Facet of each piece, ``shape=(n,)``.
        xi: Places on it, ``shape=(n, q)``.
        direction: Unit vectors, broadcastable to ``shape=(n, q, 2)``.
        lmbda: First Lamé parameter of the slave body, MPa; not used where the surface has pressures, ``mu p`` each.
        mu: Its shear modulus, MPa.
        axisymmetric: Add the hoop strain.
        derivative: 1 for the rows' derivative with respect to xi (at a fixed direction).
        between: Columns of zeros behind those of the displacements.

    Returns:
        Rows ``shape=(n, q, 2 K + between)`` in MPa/mm (and 3 more, over the pressures, if the surface has them).
    """
    mixed, K = slave.pressure_cols is not None, slave.cell_nodes.shape[1]
    n, q = xi.shape
    if slave.tabulate is None:
        raise ValueError("the surface has no cells behind it")
    facet, xi = np.ascontiguousarray(facet, dtype=np.int64), np.ascontiguousarray(xi)
    d = np.asarray(direction, dtype=np.float64)
    if d.ndim > 1:
        d = np.broadcast_to(d, (n, q, 2))
    if d.strides[-1] != d.itemsize:
        d = np.ascontiguousarray(d)
    strides = [i // d.itemsize for i in d.strides[:-1]] or [0, 0]
    strided = ray().ffi.cast("double *", d.ctypes.data)
    rows = np.zeros((n, q, 2 * K + between + 3 * mixed))
    ray().lib.stress_rows(
        slave._compiled[0], n, q, pointer(facet), pointer(xi), strided, *strides,
        lmbda, mu, axisymmetric, derivative, rows.shape[2], 2 * K + between if mixed else -1, pointer(rows),
    )  # fmt: skip
    return rows


KEPT = 0.02
"""How far past the end of its facet a point may project and stay with it, relative to the facet's length."""


@dataclass(frozen=True)
class Pairing:
    """Closest points on the die: row i belongs to point i; its gap is ``n . (x_s - x_d(k))``."""

    facet: Index  # (n,) facet of the die
    k: Array  # (n,) place on it, in [0, 1]
    normal: Array  # (n, 2) unit normal of the die, into the bore
    past: NDArray[np.bool_]  # (n,) lies past an end of the die; the gap is that to the straight extension


def closest_points(x: Array, facets: Array, side: float, smooth: bool = False, keep: Index | None = None) -> Pairing:
    """Closest point of each x on a curve of linear or quadratic facets that goes on straight past its ends.

    A point exactly opposite a vertex belongs to the facet ahead (the later one along the curve).

    Args:
        x: Points, ``shape=(n, 2)``, mm.
        facets: Nodes of the facets in their current position, ``shape=(m, k, 2)``, in order, mm.
        side: +1 if the die lies to the left of the curve, -1 if to the right.
        smooth: Normals averaged at the vertices and interpolated, instead of the facet's own.
        keep: Facets of an earlier pairing, ``shape=(n,)``: a point stays with its own while it projects no farther
            past that facet's end than `KEPT` of its length, so that a point resting on a vertex does not flip.

    Raises:
        ValueError: If a facet has zero length (its index is in the message).
    """
    m, k_d = facets.shape[:2]
    # 1. nearest straight piece (a quadratic facet counts as two), ties to the later one
    line = facets if k_d == 2 else facets[:, [0, 2, 2, 1]].reshape(2 * m, 2, 2)
    start, t = line[:, 0], line[:, 1] - line[:, 0]
    length2 = np.einsum("ij,ij->i", t, t)
    if not np.all(length2 > 0):
        raise ValueError(f"facet {int(np.argmin(length2)) * m // len(line)} of the die has zero length")
    offset = x[:, None] - start
    along = np.einsum("nmj,mj->nm", offset, t) / length2
    distance = np.linalg.norm(offset - np.clip(along, 0.0, 1.0)[..., None] * t, axis=2)
    near = distance <= distance.min(axis=1, keepdims=True) + 1e-9 * np.sqrt(length2.max())
    piece = near.shape[1] - 1 - np.argmax(near[:, ::-1], axis=1)
    row = np.arange(len(x))
    tolerance = 1e-9
    past = ((piece == 0) & (along[row, 0] < -tolerance)) | ((piece == len(line) - 1) & (along[row, -1] > 1 + tolerance))
    facet, k = piece, along[row, piece]
    if k_d == 3:
        facet, k = piece // 2, (k + piece % 2) / 2
    if keep is not None:
        chord = facets[:, 1] - facets[:, 0]
        kept = np.einsum("nj,nj->n", x - facets[keep, 0], chord[keep]) / np.einsum("nj,nj->n", chord[keep], chord[keep])
        stays = (np.abs(keep - facet) == 1) & (np.abs(kept - 0.5) <= 0.5 + KEPT)
        facet, k = np.where(stays, keep, facet), np.where(stays, kept, k)
    k = np.clip(k, 0.0, 1.0)
    # 2. closest point of the facet, and its normal
    nodes = facets[facet]
    if k_d == 3:
        for _ in range(5):
            x_d, dx_d, ddx_d = (np.einsum("nk,nki->ni", shape(k, 3, i), nodes) for i in range(3))
            d = x_d - x
            slope = np.einsum("ni,ni->n", dx_d, dx_d) + np.einsum("ni,ni->n", d, ddx_d)
            step = np.einsum("ni,ni->n", d, dx_d) / np.where(slope > 0, slope, np.inf)
            k = np.clip(k - step, 0.0, 1.0)
    normal = _unit_normals(np.einsum("nk,nki->ni", shape(k, k_d, 1), nodes), side)
    if smooth:
        ends = [_unit_normals(np.einsum("k,mki->mi", shape(np.array(end), k_d, 1), facets), side) for end in (0.0, 1.0)]
        at_vertex = np.vstack([ends[0][:1], ends[1][:-1] + ends[0][1:], ends[1][-1:]])
        at_vertex /= np.linalg.norm(at_vertex, axis=1)[:, None]
        normal = (1 - k[:, None]) * at_vertex[facet] + k[:, None] * at_vertex[facet + 1]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
    return Pairing(facet, k, normal, past)


def _unit_normals(tangents: Array, side: float) -> Array:
    normals = side * np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def closest_rows(
    slave_nodes: Index,
    N: Array,
    x_s: Array,
    die: Surface,
    z: Array,
    smooth: bool = False,
    keep: Index | None = None,
) -> tuple[Pairing, Array, Array, Index]:
    """Gap to the closest point of the die, and its derivative with the normal held.

    On a flat facet that derivative is exact: what the turning of the normal adds is proportional to the distance
    along the facet between the two points, which is zero.

    Args:
        slave_nodes: Nodes behind each point, ``shape=(n, K)``.
        N: Their shape functions at the point, ``shape=(n, K)``.
        x_s: Current positions, ``shape=(n, 2)``, mm.
        die: Die surface.
        z: Contact vector, mm.
        smooth: Averaged normals.
        keep: Facets of an earlier pairing, as in `closest_points`.

    Returns:
        Pairing, gap ``(n,)``, rows ``(n, 2 (K + k))`` and their columns in z.
    """
    facets = die.X + z.reshape(-1, 2)[die.nodes]
    pair = closest_points(x_s, facets, die.side, smooth, keep)
    M = shape(pair.k, die.nodes.shape[1])
    x_m = np.einsum("nk,nki->ni", M, facets[pair.facet])
    gap = np.einsum("ni,ni->n", pair.normal, x_s - x_m)
    weights = np.concatenate([N, -M], axis=1)
    G = (weights[:, :, None] * pair.normal[:, None]).reshape(len(x_s), -1)
    return pair, gap, G, _dofs(np.concatenate([slave_nodes, die.nodes[pair.facet]], axis=1))


def ray_gap(x: Array, die: Surface, z: Array, axis: int, sign: float) -> tuple[Array, Array, Index, Array]:
    """Gap along the ray at given current positions.

    Args:
        x: Points, ``shape=(n, 2)``, mm.
        die: Die surface, ordered with the base coordinate increasing.
        z: Contact vector, mm.
        axis: Component of the ray.
        sign: +1 if the die lies towards larger values of it.

    Returns:
        Gap, the die's slope, its facet and the place on it, below 0 or above 1 past the die's ends; ``shape=(n,)``.
    """
    p, c = 1 - axis, axis
    xd = die.X + z.reshape(-1, 2)[die.nodes]
    m = len(xd)
    facet = np.clip(np.searchsorted(xd[:, 0, p], x[:, p], side="right") - 1, 0, m - 1)
    along = (x[:, p] - xd[facet, 0, p]) / (xd[facet, 1, p] - xd[facet, 0, p])
    outside = (along < 0) | (along > 1)
    target = np.where(outside, 0.5 * (xd[facet, 0, p] + xd[facet, 1, p]), x[:, p])
    k = np.clip(np.where(outside, along, invert(xd[facet][:, :, p], target)), 0.0, 1.0)
    at = np.einsum("nk,nki->ni", shape(k, xd.shape[1]), xd[facet])
    tangent = np.einsum("nk,nki->ni", shape(k, xd.shape[1], 1), xd[facet])
    slope = np.where(outside, _reference_slope(die, axis)[facet], tangent[:, c] / tangent[:, p])
    gap = sign * (at[:, c] + slope * (x[:, p] - at[:, p]) - x[:, c])
    return gap, slope, facet, np.where(outside, along, k)
