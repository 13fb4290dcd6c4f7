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

import numpy as np
from numpy.typing import NDArray

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


def shape(xi: Array, k: int, derivative: int = 0) -> Array:
    """Lagrange functions on [0, 1] for nodes start, end(, middle): values or a derivative, ``shape=(*xi.shape, k)``."""
    one, zero = np.ones_like(xi), np.zeros_like(xi)
    if k == 2:
        table = [(1 - xi, xi), (-one, one), (zero, zero)]
        return np.stack(table[derivative], axis=-1)
    table3 = [
        ((1 - xi) * (1 - 2 * xi), xi * (2 * xi - 1), 4 * xi * (1 - xi)),
        (4 * xi - 3, 4 * xi - 1, 4 - 8 * xi),
        (4 * one, 4 * one, -8 * one),
    ]
    return np.stack(table3[derivative], axis=-1)


@cache
def gauss(order: int) -> tuple[Array, Array]:
    """Points and weights of Gauss's rule on [0, 1]."""
    s, omega = np.polynomial.legendre.leggauss(order)
    return (s + 1) / 2, omega / 2


def invert(values: Array, target: Array) -> Array:
    """The xi in [0, 1] at which the curve with nodal ``values`` (n, k) passes ``target`` (n,), which its ends enclose.

    The root nearest the middle where the target is not enclosed (an iterate gone astray).
    """
    start, end = values[:, 0], values[:, 1]
    if values.shape[1] == 2:
        return np.asarray((target - start) / (end - start))
    middle = values[:, 2]
    a, b, c = 2 * (start + end - 2 * middle), 4 * middle - 3 * start - end, start - target
    q = -0.5 * (b + np.copysign(np.sqrt(np.maximum(b * b - 4 * a * c, 0.0)), b))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.nan_to_num(np.stack([c / q, q / a]), nan=np.inf, posinf=np.inf, neginf=np.inf)
    return np.asarray(np.where(np.abs(roots[0] - 0.5) <= np.abs(roots[1] - 0.5), roots[0], roots[1]))


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
    variation: bool = False,
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
        variation: Compute the second-order terms.

    Raises:
        ArithmeticError: The deformed die is no graph over p (an iterate gone astray).
    """
    p, c = 1 - axis, axis
    u = z.reshape(-1, 2)
    xs, xd = slave.X + u[slave.nodes], die.X + u[die.nodes]
    vertex_p = np.append(xd[:, 0, p], xd[-1, 1, p])
    if not (np.all(np.diff(vertex_p) > 0) and np.all(np.isfinite(xs))):
        raise ArithmeticError("the deformed die is no graph over the ray's base line")

    # 1. pieces: each slave facet, cut where it passes a die vertex (a facet that has turned over passes them backwards)
    ends = xs[:, :2, p]
    forward = ends[:, 0] <= ends[:, 1]
    resting = 1e-12 * np.abs(vertex_p).max()  # a vertex this close to a facet's end is there, and cuts no sliver off
    low = np.searchsorted(vertex_p, ends.min(axis=1) + resting, side="right")
    high = np.searchsorted(vertex_p, ends.max(axis=1) - resting, side="left")
    cuts = np.maximum(high - low, 0)
    facet = np.repeat(np.arange(len(xs)), cuts + 1)
    nth = np.arange(len(facet)) - np.repeat(np.cumsum(cuts + 1) - (cuts + 1), cuts + 1)
    # die facet opposite the piece (-1 and m: the extensions), and the vertices at its two ends
    opposite = np.where(forward[facet], low[facet] + nth - 1, high[facet] - nth - 1)
    vertex0 = np.where(forward[facet], opposite, opposite + 1)
    vertex1 = np.where(forward[facet], opposite + 1, opposite)
    cut_left, cut_right = nth > 0, nth < cuts[facet]
    xi0, xi1 = np.zeros(len(facet)), np.ones(len(facet))
    xi0[cut_left] = invert(xs[facet[cut_left], :, p], vertex_p[vertex0[cut_left]])
    xi1[:-1][cut_right[:-1]] = xi0[1:][cut_right[:-1]]
    m = len(xd)
    e = np.clip(opposite, 0, m - 1)
    after = opposite >= m
    outside = (after | (opposite < 0))[:, None]

    # 2. points and weights on the reference slave facet
    s, omega = gauss(order)
    width = xi1 - xi0
    xi = xi0[:, None] + width[:, None] * s
    X, t = slave.X[facet], slave.X[facet, 1] - slave.X[facet, 0]
    length = slave.length[facet][:, None]
    radius = X[:, :1, 0] + xi * t[:, :1]
    jacobian = 2 * np.pi * radius * length if axisymmetric else np.broadcast_to(length, xi.shape)
    weight = width[:, None] * omega * jacobian

    # 3. the gap and its derivative at fixed xi
    k_s, k_d = slave.nodes.shape[1], die.nodes.shape[1]
    xs, xd = xs[facet], xd[e]
    N, dN = shape(xi, k_s), shape(xi, k_s, 1)
    x_s, dx_s = N @ xs, dN @ xs
    if k_d == 2:
        k = (x_s[..., p] - xd[:, :1, p]) / (xd[:, 1, p] - xd[:, 0, p])[:, None]
    else:
        repeated = np.repeat(xd[:, :, p], order, axis=0)
        k = invert(repeated, x_s[..., p].ravel()).reshape(xi.shape)
    k = np.where(outside, np.where(after, 1.0, 0.0)[:, None], k)
    M, dM, ddM = (shape(k, k_d, i) for i in range(3))
    x_d, dx_d, ddx_d = M @ xd, dM @ xd, ddM @ xd
    slope = np.where(outside, _reference_slope(die, axis)[e][:, None], dx_d[..., c] / dx_d[..., p])
    excess = np.where(outside, x_s[..., p] - x_d[..., p], 0.0)
    gap = sign * (x_d[..., c] + slope * excess - x_s[..., c])

    n_cell = slave.cell_nodes.shape[1]
    n_local = 2 * (n_cell + k_d)
    cols = np.concatenate([_dofs(slave.cell_nodes[facet]), _dofs(die.nodes[e])], axis=1)
    where = slave.local[facet][:, None, :]

    def rows(slave_values: Array | None, die_values: Array | None, component: int) -> Array:
        out = np.zeros((*xi.shape, n_local))
        if slave_values is not None:
            np.put_along_axis(out, np.broadcast_to(2 * where + component, slave_values.shape), slave_values, axis=2)
        if die_values is not None:
            out[..., 2 * n_cell + component :: 2] = die_values
        return out

    dp = dx_d[..., p, None]
    s_ = slope[..., None]
    a = rows(N, -M, p)
    G = sign * (rows(-N, M, c) + s_ * a)
    points = dict(
        facet=facet, die=e, cols=cols, xi=xi, weight=weight, gap=gap, G=G, slope=slope,
        past=np.broadcast_to(outside, xi.shape),
    )  # fmt: skip
    if not variation:
        return Points(**points)

    # 4. second variation at fixed xi, variation of the split points, and of the points and weights they carry
    kappa = np.where(outside, 0.0, (ddx_d[..., c] - slope * ddx_d[..., p]) / dx_d[..., p] ** 2)[..., None]
    turning = np.where(outside[..., None], 0.0, dM / dp)
    b = rows(None, turning, c) + rows(None, -s_ * turning, p)
    dxs_p = dx_s[..., p, None]
    G_xi = sign * (rows(-dN, None, c) + s_ * rows(dN, None, p) + dxs_p * (b + kappa * a))
    gap_xi = sign * (slope * dx_s[..., p] - dx_s[..., c])

    def split_row(xi_end: Array, cut: NDArray[np.bool_], vertex: Index) -> Array:
        N_end = shape(xi_end, k_s)
        speed = np.where(cut, np.einsum("ni,ni->n", shape(xi_end, k_s, 1), xs[:, :, p]), 1.0)
        out = np.zeros((len(xi_end), n_local))
        np.put_along_axis(out, 2 * where[:, 0] + p, -N_end, axis=1)
        die_node = np.clip(vertex - e, 0, 1)
        np.put_along_axis(out, (2 * (n_cell + die_node) + p)[:, None], 1.0, axis=1)
        return np.where(cut[:, None], out / speed[:, None], 0.0)

    d0, d1 = split_row(xi0, cut_left, vertex0), split_row(xi1, cut_right, vertex1)
    dxi = d0[:, None, :] * (1 - s)[:, None] + d1[:, None, :] * s[:, None]
    dweight = (omega * jacobian)[..., None] * (d1 - d0)[:, None, :]
    if axisymmetric:
        dweight = dweight + (width[:, None] * omega * 2 * np.pi * t[:, :1] * length)[..., None] * dxi
    return Points(
        **points,
        gap_xi=gap_xi,
        G_xi=G_xi,
        curvature=((sign * a, b), (sign * b, a), (sign * kappa * a, a)),
        dxi=dxi,
        dweight=dweight,
    )


def least_gap(slave: Surface, die: Surface, z: Array, axis: int, sign: float) -> float:
    """A lower bound of the ray gap anywhere, from the extent of both surfaces along the ray, mm (nodes)."""
    u = z.reshape(-1, 2)
    x_s = slave.X[..., axis] + u[slave.nodes, axis]
    x_d = die.X[..., axis] + u[die.nodes, axis]
    return float(np.min(sign * x_d) - np.max(sign * x_s))


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
    variation: bool = False,
) -> tuple[Array, Array | None]:
    """Component ``direction . sigma(u) N`` of the slave's traction, as rows over its cell's displacements.

    Args:
        slave: Slave surface with cells.
        facet: Facet of each piece, ``shape=(n,)``.
        xi: Places on it, ``shape=(n, q)``.
        direction: Unit vectors, broadcastable to ``shape=(n, q, 2)``.
        lmbda: First Lamé parameter of the slave body, MPa; not used where the surface has pressures, ``mu p`` each.
        mu: Its shear modulus, MPa.
        axisymmetric: Add the hoop strain.
        variation: Return the derivative with respect to xi too (at a fixed direction).

    Returns:
        Rows ``shape=(n, q, 2 K)`` in MPa/mm (and 3 more, over the pressures, if the surface has them), and their
        derivative or None.
    """
    assert slave.tabulate is not None
    reference = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    ends = reference[slave.facet_vertices[facet]]  # (n, 2, 2)
    tangent = ends[:, 1] - ends[:, 0]
    at = ends[:, None, 0] + xi[..., None] * tangent[:, None]
    table = slave.tabulate(2 if variation else 1, at.reshape(-1, 2)).reshape(-1, *xi.shape, slave.cell_nodes.shape[1])
    vertices = slave.cell_X[facet]
    J = np.stack([vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]], axis=2)
    K = np.linalg.inv(J)  # K[n, i, j] = d X_i(ref) / d x_j
    phi = table[0]
    grad = np.einsum("inqk,nij->nqkj", table[1:3], K)
    N = slave.normal[facet][:, None]
    d = np.broadcast_to(direction, (*xi.shape, 2))

    mixed = slave.pressure_cols is not None
    along_N = np.einsum("nqi,nqi->nq", d, np.broadcast_to(N, d.shape))[..., None]
    bulk = 0.0 if mixed else lmbda

    def combine(value: Array | None, gradient: Array, pressure: Array) -> Array:
        divergence = gradient.copy()
        if value is not None:
            divergence[..., 0] += value
        along_d = np.einsum("nqkj,nqj->nqk", gradient, d)[..., None]
        along_n = np.einsum("nqkj,nqj->nqk", gradient, np.broadcast_to(N, d.shape))[..., None]
        S = bulk * along_N[..., None] * divergence + mu * (along_d * N[:, :, None] + along_n * d[:, :, None])
        S = S.reshape(*xi.shape, -1)
        return np.concatenate([S, -mu * along_N * pressure], axis=2) if mixed else np.asarray(S)

    start, t = slave.X[facet, 0], slave.X[facet, 1] - slave.X[facet, 0]
    r = (start[:, :1] + xi * t[:, :1])[..., None]
    barycentric = np.stack([1 - at[..., 0] - at[..., 1], at[..., 0], at[..., 1]], axis=-1)
    rows = combine(phi / r if axisymmetric else None, grad, barycentric)
    if not variation:
        return rows, None
    # second derivatives along the facet: table[3:6] are xx, xy, yy in reference coordinates
    along = np.stack(
        [
            table[3] * tangent[:, None, None, 0] + table[4] * tangent[:, None, None, 1],
            table[4] * tangent[:, None, None, 0] + table[5] * tangent[:, None, None, 1],
        ]
    )
    grad_xi = np.einsum("inqk,nij->nqkj", along, K)
    phi_xi = np.einsum("inqk,ni->nqk", table[1:3], tangent)
    hoop_xi = phi_xi / r - phi * t[:, None, :1] / r**2 if axisymmetric else None
    barycentric_xi = np.stack([-tangent.sum(axis=1), tangent[:, 0], tangent[:, 1]], axis=-1)
    return rows, combine(hoop_xi, grad_xi, np.broadcast_to(barycentric_xi[:, None], barycentric.shape))


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


def polyline_points(die: Surface) -> Array:
    """Reference positions of `Surface.node_numbers`, ``shape=(m + 1, 2)``, mm."""
    number, first = np.unique(die.nodes, return_index=True)
    return np.asarray(die.X.reshape(-1, 2)[first[np.searchsorted(number, die.node_numbers)]])


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
