"""Gap between two tagged surfaces in space in their current position, and its first and second derivative.

As `extrusion.gap` in the plane: surfaces are held whole on every rank, ``z`` lists displacements (x, y, z) node by
node, and results are rows over local columns (the nodes of a slave facet or of its cell, then those of a die facet).
y is the axis of revolution. A facet is a quadrilateral with places (s, t) in [0, 1]^2; s runs along the meridian
(growing y, on a face across the axis growing radius) and t with the azimuth.

A facet of the slave is integrated along *lines* of constant t, one for each Gauss point across. A line is to a ring
of die nodes what a facet is to a die vertex in the plane: it is split there, and the split moves with both bodies.
The ray keeps the direction that it has at the middle of its line in the reference position.

The die is either made of facets (`Facets`), or a rigid surface of revolution (`Revolved`), which is met exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from extrusion.gap import Array, Index, Points, closest_points, gauss, invert

Tabulate = Callable[[int, Array], Array]

CANDIDATES = 12
"""Facets whose middles are nearest to a point, among which the closest one is looked for."""


def lagrange(n: int, s: Array, derivative: int = 0) -> Array:
    """Lagrange functions on [0, 1] for 2 or 3 equidistant nodes in order, ``shape=(*s.shape, n)``."""
    one = np.ones_like(s)
    if n == 2:
        table2 = [(1 - s, s), (-one, one), (0 * one, 0 * one)]
        return np.stack(table2[derivative], axis=-1)
    table3 = [
        ((1 - s) * (1 - 2 * s), 4 * s * (1 - s), s * (2 * s - 1)),
        (4 * s - 3, 4 - 8 * s, 4 * s - 1),
        (4 * one, -8 * one, 4 * one),
    ]
    return np.stack(table3[derivative], axis=-1)


def places(k: int) -> Array:
    """Where the k nodes of a facet lie, ``shape=(k, 2)``: s first; of 9 the middle one last but for its place."""
    n = 2 if k == 4 else 3
    t, s = np.divmod(np.arange(n * n), n)
    all_places = np.stack([s, t], axis=1) / (n - 1)
    return all_places if k != 8 else np.delete(all_places, 4, axis=0)


def shape2(k: int, s: Array, t: Array, ds: int = 0, dt: int = 0) -> Array:
    """Functions of a facet's nodes (4 bilinear, 9 biquadratic, 8 serendipity) or a derivative, ``(*s.shape, k)``."""
    n = 2 if k == 4 else 3
    both = lagrange(n, t, dt)[..., :, None] * lagrange(n, s, ds)[..., None, :]
    N = both.reshape(*s.shape, n * n)
    if k != 8:
        return N
    middle = np.array([-0.25, 0.5, -0.25, 0.5, 0.0, 0.5, -0.25, 0.5, -0.25])
    return np.asarray(np.delete(N + N[..., 4:5] * middle, 4, axis=-1))


@dataclass(frozen=True)
class Facets:
    """Quadrilateral facets of a boundary surface, in order along the meridian, then by azimuth.

    ``nodes[i]`` are the nodes of facet i in the order of `places`; ``cell_nodes[i]`` are those of the cell behind it
    (only the facet's where no stress is asked), and ``local[i]`` finds the first in the second.
    """

    X: Array  # (m, k, 3) reference coordinates of the facet's nodes, mm
    nodes: Index  # (m, k) node numbers in z (displacement dofs 3 n, 3 n + 1, 3 n + 2)
    cell_nodes: Index  # (m, K)
    local: Index  # (m, k)
    frame: Array  # (m, 3, 3) in the reference cell: the facet's origin, its s and its t direction
    cell_X: Array  # (m, Kg, 3) geometry nodes of the cell, mm
    side: Array  # (m,) +1 if dX/ds x dX/dt points out of the body, else -1
    tabulate: Tabulate  # of the displacement's scalar element
    tabulate_geometry: Tabulate
    pressure_cols: Index | None = None  # (m, 8) where z holds the cell's pressures (displacement-pressure form)

    @cached_property
    def length(self) -> Array:
        """Size of the facets along their shorter side, mm, ``shape=(m,)``."""
        corners = self.X[:, self._vertices]
        along = np.linalg.norm(corners[:, [1, 3]] - corners[:, [0, 2]], axis=2).mean(axis=1)
        across = np.linalg.norm(corners[:, [2, 3]] - corners[:, [0, 1]], axis=2).mean(axis=1)
        return np.asarray(np.minimum(along, across))

    @cached_property
    def mean_gradients(self) -> Array | None:
        """Mean over each cell of its shape functions' gradients, ``shape=(m, K, 3)``; None but for trilinear cells.

        Their change of volume is taken as constant in the cell (`Problem`).
        """
        if self.cell_nodes.shape[1] != 8:
            return None
        s, omega = gauss(2)
        at = np.stack(np.meshgrid(s, s, s, indexing="ij"), axis=-1).reshape(-1, 3)
        J = np.einsum("jqk,mki->mqij", self.tabulate_geometry(1, at)[1:], self.cell_X)
        w = np.abs(np.linalg.det(J)) * np.einsum("a,b,c->abc", omega, omega, omega).ravel()
        grad = np.einsum("iqk,mqij->mqkj", self.tabulate(1, at)[1:], np.linalg.inv(J))
        return np.asarray(np.einsum("mq,mqkj->mkj", w, grad) / w.sum(axis=1)[:, None, None])

    @property
    def _vertices(self) -> list[int]:
        return {4: [0, 1, 2, 3], 8: [0, 2, 5, 7], 9: [0, 2, 6, 8]}[self.nodes.shape[1]]

    @cached_property
    def vertices(self) -> Index:
        """Vertex nodes of each facet (places (0, 0), (1, 0), (0, 1), (1, 1)), ``shape=(m, 4)``."""
        return self.nodes[:, self._vertices]

    @cached_property
    def node_numbers(self) -> Index:
        """Distinct nodes in the order of the facets."""
        first = np.sort(np.unique(self.nodes, return_index=True)[1])
        return np.asarray(self.nodes.ravel()[first])

    @cached_property
    def node_X(self) -> Array:
        """Reference positions of `node_numbers`, ``shape=(n, 3)``, mm."""
        first = np.sort(np.unique(self.nodes, return_index=True)[1])
        return np.asarray(self.X.reshape(-1, 3)[first])

    @cached_property
    def grid(self) -> Index | None:
        """Facet number by row (along the meridian) and column (azimuth), or None if the surface is no such grid."""
        middle = self.X[:, self._vertices].mean(axis=1)
        y = np.round(middle[:, 1] / np.ptp(self.X[..., 1]).clip(1e-300), 7)
        angle = np.round(np.arctan2(middle[:, 2], middle[:, 0]), 7)
        (ys, row), (angles, column) = (np.unique(v, return_inverse=True) for v in (y, angle))
        if len(ys) * len(angles) != len(self.X):
            return None
        out = np.full((len(ys), len(angles)), -1)
        out[row, column] = np.arange(len(self.X))
        return out if (out >= 0).all() else None

    def take(self, on: Index) -> Facets:
        """Some of the facets."""
        pressure_cols = None if self.pressure_cols is None else self.pressure_cols[on]
        return Facets(
            self.X[on], self.nodes[on], self.cell_nodes[on], self.local[on], self.frame[on], self.cell_X[on],
            self.side[on], self.tabulate, self.tabulate_geometry, pressure_cols,
        )  # fmt: skip

    def position(self, z: Array) -> Array:
        """Current positions of the facets' nodes, ``shape=(m, k, 3)``, mm."""
        return np.asarray(self.X + z[3 * self.nodes[..., None] + np.arange(3)])


@dataclass(frozen=True)
class Revolved:
    """A rigid surface of revolution about y, of straight meridian pieces, that goes on straight past its ends."""

    points: Array  # (m + 1, 2) (r, y) in the order of growing y (radial rays) or r (axial rays), mm
    side: float  # +1 if the die lies to the left of the meridian, -1 if to the right

    nodes = np.zeros((0, 1), dtype=np.int64)


def radial(X: Array) -> Array:
    """Unit vectors from the axis to points, ``shape=(..., 3)``."""
    out = X * np.array([1.0, 0.0, 1.0])
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-300))


@dataclass(frozen=True)
class SurfacePoints(Points):
    """Contact points in space: those of a piece lie on one line of a slave facet."""

    t: Array | None = None  # (n, q) place across the slave facet
    direction: Array | None = None  # (n, q, 3) of the traction that is conjugate to the gap
    cosine: Array | None = None  # (n, q) of the angle between the die's normal and that direction


@dataclass(frozen=True)
class _Met:
    """Where rays meet the die; with ``dg = alpha . (du - sum M dd)``."""

    gap: Array  # (n, q)
    alpha: Array  # (n, q, 3)
    M: Array | None = None  # (n, q, k) shape functions of the die facet's nodes
    kappa: Array | None = None  # (n, q, 3): dk = kappa . (du - M dd), the place along the meridian
    lam: Array | None = None  # (n, q, 3): dl, the place across
    M_k: Array | None = None
    M_l: Array | None = None
    second: tuple[Array, Array, Array] | None = None  # (n, q): alpha . (x_kk, x_kl, x_ll)
    pairs: tuple[tuple[float | Array, Array, Array], ...] = ()  # rigid: d2g = sum c (a . du) (b . du)


def _meet_revolved(die: Revolved, piece: Index, x: Array, N: Array, axis: int) -> _Met:
    """Gap along N to the straight meridian pieces; x, N: ``shape=(n, q, 3)``; piece ``(n,)``."""
    start, chord = die.points[piece], die.points[piece + 1] - die.points[piece]
    e_y = np.broadcast_to([0.0, 1.0, 0.0], x.shape)
    if axis == 0:  # |x + g N| = R(y) in the plane across the axis
        slope = (chord[:, 0] / chord[:, 1])[:, None]
        R = start[:, :1] + slope * (x[..., 1] - start[:, 1:])
        T = np.stack([-N[..., 2], 0 * R, N[..., 0]], axis=-1)
        a, b = np.einsum("nqi,nqi->nq", x, N), np.einsum("nqi,nqi->nq", x, T)
        if np.any(np.abs(b) >= R):
            raise ArithmeticError("a ray does not meet the die")
        rho = np.sqrt(R * R - b * b)
        q = (R * slope)[..., None] * e_y - b[..., None] * T
        return _Met(
            rho - a, q / rho[..., None] - N, pairs=((slope**2 / rho, e_y, e_y), (-1 / rho, T, T), (-1 / rho**3, q, q))
        )
    slope = (chord[:, 1] / chord[:, 0])[:, None]
    r = np.linalg.norm(x[..., [0, 2]], axis=-1)
    e_r = radial(x)
    T = np.stack([-e_r[..., 2], 0 * r, e_r[..., 0]], axis=-1)
    gap = start[:, 1:] + slope * (r - start[:, :1]) - x[..., 1]
    return _Met(gap, slope[..., None] * e_r - e_y, pairs=((slope / np.maximum(r, 1e-300), T, T),))


def _meet_facets(
    die: Facets,
    xd: Array,
    facet: Index,
    x: Array,
    N: Array,
    k: Array,
    l: Array,  # noqa: E741
    past: tuple[Array, Array] | None = None,
) -> tuple[_Met, Array, Array]:
    """Gap along N to given facets, by Newton's method from places (k, l); what it needs is ``shape=(n, q, ...)``.

    Args:
        die: The die.
        xd: Current positions of its facets' nodes.
        facet: One a piece, ``shape=(n,)``.
        x: Points, mm.
        N: Unit vectors.
        k: Place along the meridian to begin with; in (-inf, 0) or (1, inf) it is a distance past the edge there.
        l: Place across.
        past: Which pieces face the die's extension past an edge (bool), and its direction there, ``shape=(n, 3)``.
    """
    n_nodes = die.nodes.shape[1]
    nodes = xd[facet]
    beyond = np.zeros(len(facet), dtype=bool) if past is None else past[0]
    edge: Array = np.where(k > 0.5, 1.0, 0.0)
    reach = np.where(beyond[:, None], 0.0, k)  # along the extension
    gap = np.zeros_like(k)
    for _ in range(12):
        at = np.where(beyond[:, None], edge, k)
        M, M_k, M_l = (shape2(n_nodes, at, l, *d) for d in ((0, 0), (1, 0), (0, 1)))
        x_m, x_k, x_l = M @ nodes, M_k @ nodes, M_l @ nodes
        if past is not None:
            x_m = np.where(beyond[:, None, None], x_m + reach[..., None] * past[1][:, None], x_m)
            x_k = np.where(beyond[:, None, None], past[1][:, None], x_k)
        out = x_m - x - gap[..., None] * N
        A = np.stack([x_k, x_l, -N], axis=-1)
        if not np.isfinite(A).all():
            break
        inverse = _inverse(A)
        step = np.einsum("nqij,nqj->nqi", inverse, out)
        k = np.where(beyond[:, None], k, k - step[..., 0])
        reach = np.where(beyond[:, None], reach - step[..., 0], reach)
        l, gap = l - step[..., 1], gap - step[..., 2]  # noqa: E741
        size = float(np.max(np.abs(step), initial=0.0))
        if size < 1e-13 * max(1.0, float(np.abs(x).max(initial=1.0))):
            break
        if size > 1e6:
            raise ArithmeticError("a ray does not meet the die")
    else:
        if size > 1e-8:
            raise ArithmeticError("a ray does not meet the die")
    alpha = inverse[..., 2, :]
    M_kk, M_kl, M_ll = (shape2(n_nodes, at, l, *d) for d in ((2, 0), (1, 1), (0, 2)))
    inside = np.logical_not(beyond)[:, None]
    c_kk, c_kl = (np.where(inside, np.einsum("nqi,nqi->nq", alpha, D @ nodes), 0.0) for D in (M_kk, M_kl))
    c_ll = np.einsum("nqi,nqi->nq", alpha, M_ll @ nodes)
    met = _Met(
        gap, alpha, M, inverse[..., 0, :], inverse[..., 1, :], np.where(inside[..., None], M_k, 0.0), M_l,
        (c_kk, c_kl, c_ll),
    )  # fmt: skip
    return met, np.where(beyond[:, None], edge + np.where(edge > 0.5, 1, -1) * np.abs(reach), k), l


def _inverse(A: Array) -> Array:
    try:
        return np.linalg.inv(A)
    except np.linalg.LinAlgError:
        raise ArithmeticError("a ray does not meet the die") from None


class _Rows:
    """Rows over local columns: the nodes of the slave's cell, then those of the die facet, three components each."""

    def __init__(self, slave: Facets, facet: Index, die_nodes: Index) -> None:
        self._where, self._K, self._d = slave.local[facet], slave.cell_nodes.shape[1], die_nodes.shape[1]
        nodes = np.concatenate([slave.cell_nodes[facet], die_nodes], axis=1)
        self.cols: Index = (3 * nodes[..., None] + np.arange(3)).reshape(len(facet), -1)

    def __call__(self, N: Array | None, v: Array | None, M: Array | None, w: Array | None) -> Array:
        """``v . sum N du + w . sum M dd`` for functions ``(n, q, k)`` and vectors ``(n, q, 3)``."""
        some = N if N is not None else M
        assert some is not None
        n, q = some.shape[:2]
        out = np.zeros((n, q, self._K + self._d, 3))
        if N is not None and v is not None:
            out[np.arange(n)[:, None, None], np.arange(q)[:, None], self._where[:, None]] = N[..., None] * v[:, :, None]
        if M is not None and w is not None and self._d:
            out[:, :, self._K :] = M[..., None] * w[:, :, None]
        return out.reshape(n, q, -1)


def line_points(
    slave: Facets, die: Facets | Revolved, z: Array, sign: float, order: int, variation: bool = False
) -> SurfacePoints:
    """Integration points of the slave's facets with the gap along radial rays, lines split at every ring of die nodes.

    Args:
        slave: Slave surface.
        die: Die: facets that form a grid of rings and columns, or a rigid surface of revolution.
        z: Contact vector, mm.
        sign: +1 if the die lies towards larger radius.
        order: Gauss points along a piece of a line, and lines across a facet.
        variation: Compute the second-order terms.

    Raises:
        ArithmeticError: A ray does not meet the die, or the deformed die is no graph (an iterate gone astray).
        ValueError: The die's facets form no grid.
    """
    k_s = slave.nodes.shape[1]
    n_s = 2 if k_s == 4 else 3
    omega_t: Array
    t_line, omega_t = gauss(min(order, n_s))
    m, q_t = len(slave.X), len(t_line)
    xs = slave.position(z)
    if not np.isfinite(xs).all():
        raise ArithmeticError("the slave's position is not finite")
    # 1. lines, as curves of n_s nodes; the direction of their rays
    owner = np.repeat(np.arange(m), q_t)
    across = np.tile(t_line, m)
    at = np.linspace(0.0, 1.0, n_s)
    onto = shape2(k_s, np.broadcast_to(at, (q_t, n_s)), np.broadcast_to(t_line[:, None], (q_t, n_s)))
    line = np.einsum("qjk,mki->mqji", onto, xs).reshape(-1, n_s, 3)
    middle = np.einsum("qk,mki->mqi", shape2(k_s, np.full(q_t, 0.5), t_line), slave.X).reshape(-1, 3)
    N_line = sign * radial(middle)
    # 2. pieces, cut where the line passes a ring, each way if it turns back (crushed at the billet's edge)
    p = line[..., 1]
    rings = _Rings(die, z, middle)
    of, begin, end = _one_way(p)
    ends = np.stack([(lagrange(n_s, xi) * p[of]).sum(axis=1) for xi in (begin, end)], axis=1)
    forward = ends[:, 0] <= ends[:, 1]
    rest = 1e-12 * np.abs(rings.p).max(initial=1.0)
    low = (rings.p[of] <= ends.min(axis=1)[:, None] + rest).sum(axis=1)
    high = (rings.p[of] < ends.max(axis=1)[:, None] - rest).sum(axis=1)
    cuts = np.maximum(high - low, 0)
    part = np.repeat(np.arange(len(of)), cuts + 1)  # of each piece
    on = of[part]  # its line
    nth = np.arange(len(on)) - np.repeat(np.cumsum(cuts + 1) - (cuts + 1), cuts + 1)
    opposite = np.where(forward[part], low[part] + nth - 1, high[part] - nth - 1)
    vertex0 = np.where(forward[part], opposite, opposite + 1)
    vertex1 = np.where(forward[part], opposite + 1, opposite)
    xi0, xi1 = begin[part], end[part]
    where = np.flatnonzero(nth > 0)  # pieces that begin at a split
    order_of_invert = [0, 1] if n_s == 2 else [0, 2, 1]
    found = invert(p[on[where]][:, order_of_invert], rings.p[on[where], vertex0[where]])
    # of the two places of a line that turns back the one in this part
    turn = np.where(begin > 0, begin, end)[part[where]]
    elsewhere = (turn < 1) & ((found < begin[part[where]]) | (found > end[part[where]]))
    xi0[where] = np.where(elsewhere, 2 * turn - found, found)
    splits = rings.split(where, on, vertex0, line, N_line, xi0)
    xi0[where] = splits.xi
    xi1[where - 1] = xi0[where]
    # 3. points and weights on the reference facet
    facet, N, tq = owner[on], N_line[on], across[on]
    s, omega = gauss(order)
    width = xi1 - xi0
    xi = xi0[:, None] + width[:, None] * s
    t = np.broadcast_to(tq[:, None], xi.shape)
    jacobian, jacobian_xi = _area(slave.X[facet], k_s, xi, t, variation)
    factor = omega_t[np.arange(len(line)) % q_t][on][:, None] * omega
    weight = width[:, None] * factor * jacobian
    # 4. gap
    curve = line[on]
    x_s, dx_s = (lagrange(n_s, xi, d) @ curve for d in (0, 1))
    Ns, dNs = (shape2(k_s, xi, t, d, 0) for d in (0, 1))
    directions = np.broadcast_to(N[:, None], x_s.shape)
    met, die_facet, past = rings.meet(on, opposite, x_s, directions)
    die_nodes = die.nodes[die_facet] if isinstance(die, Facets) else np.zeros((len(on), 0), dtype=np.int64)
    rows = _Rows(slave, facet, die_nodes)
    G = rows(Ns, met.alpha, met.M, -met.alpha)
    cosine = 1 / np.linalg.norm(met.alpha, axis=-1)
    base: dict[str, Any] = dict(
        facet=facet, die=die_facet, cols=rows.cols, xi=xi, weight=weight, gap=met.gap, G=G,
        slope=np.sqrt(np.maximum(1 / cosine**2 - 1, 0.0)), past=np.broadcast_to(past[:, None], xi.shape),
        t=t, direction=directions, cosine=cosine,
    )  # fmt: skip
    if not variation:
        return SurfacePoints(**base)
    # 5. second variation, and what moves with the splits
    curvature, cross = _second(rows, met, Ns, dx_s)
    G_xi = rows(dNs, met.alpha, None, None) + cross
    row = np.clip(opposite, 0, rings.p.shape[1] - 2)
    d0, d1 = np.zeros((2, len(on), G.shape[2]))
    for d, pieces, vertex in ((d0, where, vertex0), (d1, where - 1, vertex1)):  # a split bounds two pieces
        if len(where):
            d[pieces] = splits.rows(pieces, slave, facet, tq, die, die_facet, vertex - row)
    dxi = d0[:, None, :] * (1 - s)[:, None] + d1[:, None, :] * s[:, None]
    dweight = (factor * jacobian)[..., None] * (d1 - d0)[:, None, :]
    dweight += (width[:, None] * factor * jacobian_xi)[..., None] * dxi
    gap_xi = np.einsum("nqi,nqi->nq", met.alpha, dx_s)
    return SurfacePoints(**base, gap_xi=gap_xi, G_xi=G_xi, curvature=curvature, dxi=dxi, dweight=dweight)


def _one_way(p: Array) -> tuple[Index, Array, Array]:
    """The parts of lines with these coordinates of their nodes that do not turn back: line, beginning and end."""
    n = len(p)
    back = np.ones(n)
    if p.shape[1] == 3:
        slope, bend = -3 * p[:, 0] + 4 * p[:, 1] - p[:, 2], 4 * (p[:, 0] - 2 * p[:, 1] + p[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            back = -slope / bend
        back = np.where((back > 1e-9) & (back < 1 - 1e-9), back, 1.0)
    parts = 1 + (back < 1)
    of = np.repeat(np.arange(n), parts)
    second = np.append(False, of[1:] == of[:-1])
    return of, np.where(second, back[of], 0.0), np.where(second, 1.0, back[of])


def _area(X: Array, k: int, s: Array, t: Array, variation: bool) -> tuple[Array, Array]:
    """``|dX/ds x dX/dt|`` of facets' reference nodes ``(n, k, 3)`` at places ``(n, q)``, and its derivative by s."""
    X_s, X_t = shape2(k, s, t, 1, 0) @ X, shape2(k, s, t, 0, 1) @ X
    c = np.cross(X_s, X_t)
    J = np.linalg.norm(c, axis=-1)
    if not variation:
        return J, J
    X_ss, X_st = shape2(k, s, t, 2, 0) @ X, shape2(k, s, t, 1, 1) @ X
    c_s = np.cross(X_ss, X_t) + np.cross(X_s, X_st)
    return J, np.einsum("nqi,nqi->nq", c, c_s) / J


def _second(rows: _Rows, met: _Met, Ns: Array, dx_s: Array) -> tuple[tuple[tuple[Array, Array], ...], Array]:
    """The gap's second derivative at a fixed place as pairs of rows, and the part of dG/dxi that it makes."""
    if met.M is None:
        pairs, cross = [], 0.0
        for c, a, b in met.pairs:
            left, right = rows(Ns, np.asarray(c)[..., None] * a, None, None), rows(Ns, b, None, None)
            pairs.append((left, right))
            cross = cross + left * np.einsum("nqi,nqi->nq", b, dx_s)[..., None]
        return tuple(pairs), np.asarray(cross)
    assert met.kappa is not None
    assert met.lam is not None
    assert met.second is not None
    k, l = rows(Ns, met.kappa, met.M, -met.kappa), rows(Ns, met.lam, met.M, -met.lam)  # noqa: E741
    b_k, b_l = rows(None, None, met.M_k, met.alpha), rows(None, None, met.M_l, met.alpha)
    c_kk, c_kl, c_ll = (c[..., None] for c in met.second)
    m_k = b_k + 0.5 * (c_kk * k + c_kl * l)
    m_l = b_l + 0.5 * (c_ll * l + c_kl * k)
    k2 = np.einsum("nqi,nqi->nq", met.kappa, dx_s)[..., None]
    l2 = np.einsum("nqi,nqi->nq", met.lam, dx_s)[..., None]
    cross = -(b_k * k2 + b_l * l2 + c_kk * k * k2 + c_kl * (k * l2 + l * k2) + c_ll * l * l2)
    return ((-m_k, k), (-k, m_k), (-m_l, l), (-l, m_l)), cross


@dataclass(frozen=True)
class _Splits:
    """Where lines pass rings."""

    xi: Array  # (n,)
    speed: Array  # (n, 3): dxi = speed . (sum L dd - sum N du) at the split
    L: Array  # (n, e) functions of the ring's nodes

    def rows(
        self, pieces: Index, slave: Facets, facet: Index, t: Array, die: Facets | Revolved, die_facet: Index, far: Array
    ) -> Array:
        """Variation of the splits over the columns of some pieces that they bound, ``shape=(n, L)``.

        Args:
            pieces: One a split.
            slave: Slave surface.
            facet: Of each piece on it.
            t: Of each piece's line.
            die: Die.
            die_facet: Of each piece on it.
            far: Whether a piece's split is at the far edge of its die facet (k = 1).
        """
        on_die = die.nodes[die_facet[pieces]] if isinstance(die, Facets) else _none(pieces)
        Ns = shape2(slave.nodes.shape[1], self.xi[:, None], t[pieces][:, None])
        M = None
        if isinstance(die, Facets):
            k = die.nodes.shape[1]
            M = np.zeros((len(pieces), k))
            M[np.abs(places(k)[:, 0] - far[pieces][:, None]) < 1e-9] = self.L.ravel()
            M = M[:, None]
        v = self.speed[:, None]
        return _Rows(slave, facet[pieces], on_die)(Ns, -v, M, v)[:, 0]


def _none(of: Index) -> Index:
    return np.zeros((len(of), 0), dtype=np.int64)


class _Rings:
    """What lines can pass on the die: its rings of nodes, each at the azimuth of the line."""

    def __init__(self, die: Facets | Revolved, z: Array, middle: Array) -> None:
        self._die = die
        if isinstance(die, Revolved):
            self.p: Array = np.broadcast_to(die.points[:, 1], (len(middle), len(die.points)))
            return
        grid = die.grid
        if grid is None:
            raise ValueError("its facets form no rings about the axis")
        self._xd, self._grid = die.position(z), grid
        k = die.nodes.shape[1]
        n = 2 if k == 4 else 3
        self._edge = [np.flatnonzero(np.abs(places(k)[:, 0] - end) < 1e-9) for end in (0.0, 1.0)]
        first = die.X[grid[0]][:, self._edge[0]]  # (columns, n, 3): the first ring, for the azimuths
        angle = np.arctan2(first[..., 2], first[..., 0])
        bounds = np.append(angle[:, 0], angle[-1, -1])
        of_line = np.arctan2(middle[:, 2], middle[:, 0])
        self._column = np.clip(np.searchsorted(bounds, of_line, side="right") - 1, 0, len(angle) - 1)
        a = angle[self._column]
        self._l = (of_line - a[:, 0]) / (a[:, -1] - a[:, 0])
        L = lagrange(n, self._l)
        nodes = np.concatenate([self._xd[grid][:, :, self._edge[0]], self._xd[grid[-1:]][:, :, self._edge[1]]])
        self._nodes = nodes  # (rings, columns, n, 3)
        ring = np.einsum("rlni,ln->lri", nodes[:, self._column], L)
        self.p = ring[..., 1]
        if not np.all(np.diff(self.p, axis=1) > 0):
            raise ArithmeticError("the deformed die is no graph over the axis")
        # the reference direction in which the die goes on past its ends, per line
        X = die.X[grid[[0, -1]]]
        steps = X[:, :, self._edge[1]] - X[:, :, self._edge[0]]
        onward = np.einsum("elni,ln->eli", steps[:, self._column], L)
        self._onward = onward / onward[..., 1:2]

    def split(self, where: Index, on: Index, vertex: Index, line: Array, N_line: Array, xi: Array) -> _Splits:
        """Exact places of the splits at the left ends of some pieces, from estimates."""
        N, curve, xi = N_line[on[where]], line[on[where]], xi[where]
        n_s = curve.shape[1]
        tangent = np.einsum("nk,nki->ni", lagrange(n_s, xi, 1), curve)
        if isinstance(self._die, Revolved):
            speed = np.zeros_like(tangent)
            speed[:, 1] = 1 / tangent[:, 1]
            return _Splits(xi, speed, np.zeros((len(xi), 0)))
        at = on[where]
        nodes = self._nodes[vertex[where], self._column[at]]
        n, l, gap = nodes.shape[1], self._l[at].copy(), np.zeros(len(xi))  # noqa: E741
        inverse = np.zeros((len(xi), 3, 3))
        for _ in range(8):
            if not len(xi):
                break
            L, L_l = lagrange(n, l), lagrange(n, l, 1)
            x, tangent = (np.einsum("nk,nki->ni", lagrange(n_s, xi, d), curve) for d in (0, 1))
            out = np.einsum("nk,nki->ni", L, nodes) - x - gap[:, None] * N
            B = np.stack([np.einsum("nk,nki->ni", L_l, nodes), -tangent, -N], axis=-1)
            inverse = _inverse(B)
            step = np.einsum("nij,nj->ni", inverse, out)
            l, xi, gap = l - step[:, 0], xi - step[:, 1], gap - step[:, 2]  # noqa: E741
            if np.max(np.abs(step)) < 1e-13 * max(1.0, float(np.abs(x).max())):
                break
        xi = np.clip(xi, 0.0, 1.0)
        return _Splits(xi, -inverse[:, 1], lagrange(n, l))

    def meet(self, on: Index, opposite: Index, x: Array, N: Array) -> tuple[_Met, Index, np.ndarray]:
        """Where the points of pieces meet the die, its facets there, and which pieces face its extension."""
        die = self._die
        m = self.p.shape[1] - 1
        row = np.clip(opposite, 0, m - 1)
        past = (opposite < 0) | (opposite >= m)
        if isinstance(die, Revolved):
            return _meet_revolved(die, row, x, N, 0), row, past
        facet = self._grid[row, self._column[on]]
        p = x[..., 1]
        p0, p1 = self.p[on, row], self.p[on, row + 1]
        k = (p - p0[:, None]) / (p1 - p0)[:, None]
        k = np.where(past[:, None], np.where(opposite >= m, 1.0, 0.0)[:, None], np.clip(k, 0.0, 1.0))
        l = np.broadcast_to(self._l[on][:, None], k.shape)  # noqa: E741
        end = np.where(opposite >= m, 1, 0)
        met, _, _ = _meet_facets(die, self._xd, facet, x, N, k, l, (past, self._onward[end, on]))
        return met, facet, past


def scattered_points(
    slave: Facets,
    die: Facets | Revolved,
    z: Array,
    axis: int,
    sign: float,
    order: int,
    ray: bool,
    smooth: bool,
    keep: Index | None = None,
) -> SurfacePoints:
    """Integration points at fixed places of the slave's facets, each a piece of its own, with what they face.

    For surfaces that are no grid of rings, and for gaps to the closest point (then the normal is held).
    """
    k_s = slave.nodes.shape[1]
    s, omega = gauss(order)
    m, q = len(slave.X), order * order
    across, along = (v.ravel() for v in np.meshgrid(s, s, indexing="ij"))
    shape_st = shape2(k_s, along, across)
    facet = np.repeat(np.arange(m), q)
    x: Array = np.einsum("qk,mki->mqi", shape_st, slave.position(z)).reshape(-1, 3)
    if not np.isfinite(x).all():
        raise ArithmeticError("the slave's position is not finite")
    xi, t = (np.broadcast_to(v, (m, q)).reshape(-1, 1) for v in (along, across))
    jacobian, _ = _area(slave.X[facet], k_s, xi, t, False)
    weight = np.tile(np.outer(omega, omega).ravel(), m)[:, None] * jacobian
    Ns = np.tile(shape_st, (m, 1))[:, None]
    curvature: tuple[tuple[Array, Array], ...] = ()
    if ray:
        middle = np.einsum("qk,mki->mqi", shape_st, slave.X).reshape(-1, 3)
        N = sign * (radial(middle) if axis == 0 else np.broadcast_to([0.0, 1.0, 0.0], middle.shape))
        direction = N[:, None]
        number, met, past = meet(die, z, x, middle, N, axis, keep)
        alpha, M, gap = met.alpha, met.M, met.gap
        die_nodes = die.nodes[number] if isinstance(die, Facets) else _none(number)
        rows = _Rows(slave, facet, die_nodes)
        curvature, _ = _second(rows, met, Ns, np.zeros_like(alpha))
    else:
        found = closest(die, z, x, smooth)
        number, past, gap = found.facet, found.past, found.gap[:, None]
        alpha = found.normal[:, None]
        M = found.M[:, None] if found.M is not None else None
        direction = -alpha
        die_nodes = die.nodes[number] if isinstance(die, Facets) else _none(number)
        rows = _Rows(slave, facet, die_nodes)
    G = rows(Ns, alpha, M, -alpha)
    cosine = 1 / np.linalg.norm(alpha, axis=-1)
    none = np.zeros((len(facet), 1, G.shape[2]))
    extra = dict(gap_xi=np.zeros_like(gap), G_xi=none, dxi=none, dweight=none) if curvature else {}
    return SurfacePoints(
        facet=facet, die=number, cols=rows.cols, xi=xi, weight=weight, gap=gap, G=G,
        slope=np.sqrt(np.maximum(1 / cosine**2 - 1, 0.0)), past=past[:, None], curvature=curvature,
        t=t, direction=direction, cosine=cosine, **extra,
    )  # fmt: skip


def meet(
    die: Facets | Revolved, z: Array, x: Array, X: Array, N: Array, axis: int, keep: Index | None = None
) -> tuple[Index, _Met, np.ndarray]:
    """Where rays from points x (at X in the reference position) meet the die, on which facet, and which its extension.

    Axial rays stay with the facets ``keep`` as long as they pass these by less than `HELD`.

    Raises:
        ArithmeticError: A ray does not meet it.
    """
    p = x[:, 1 - axis] if axis == 0 else np.linalg.norm(x[:, [0, 2]], axis=1)
    if isinstance(die, Revolved):
        base = die.points[:, 1 - axis]
        number = np.clip(np.searchsorted(base, p, side="right") - 1, 0, len(base) - 2)
        past = (p < base[0]) | (p > base[-1])
        return number, _meet_revolved(die, number, x[:, None], N[:, None], axis), past
    if axis == 1:
        return _seek(die, z, x, N, keep)
    rings = _Rings(die, z, X)
    rest = 1e-12 * np.abs(rings.p).max(initial=1.0)
    opposite = (rings.p <= p[:, None] + rest).sum(axis=1) - 1
    opposite -= (opposite == rings.p.shape[1] - 1) & (p <= rings.p[:, -1] + rest)  # on the last ring it is not past
    met, number, past = rings.meet(np.arange(len(x)), opposite, x[:, None], N[:, None])
    return number, met, past


HELD = 0.02
"""How far past its facet, relative to it, a ray may meet the die and stay with that facet (the facet goes on)."""


def _near(die: Facets, xd: Array, x: Array, across: Array | None = None) -> Index:
    """Candidate facets of points, nearest middle first, ``shape=(n, c)``; seen along an axis if ``across`` is given."""
    middle = xd[:, die._vertices].mean(axis=1)
    if across is not None:
        middle, x = middle[:, across], x[:, across]
    c = min(CANDIDATES, len(middle))
    from scipy.spatial import cKDTree  # a tenth of a second, which a scene in the plane does not need

    return np.asarray(cKDTree(middle).query(x, k=c)[1], dtype=np.int64).reshape(len(x), c)


def _seek(die: Facets, z: Array, x: Array, N: Array, keep: Index | None = None) -> tuple[Index, _Met, np.ndarray]:
    """Facet that the ray along the axis from each point meets; past the surface's rim that of the nearest facet."""
    xd = die.position(z)
    candidates = _near(die, xd, x, np.array([0, 2]))
    n, c = candidates.shape
    many = np.repeat(x, c, axis=0)[:, None], np.repeat(N, c, axis=0)[:, None]
    half = np.full((n * c, 1), 0.5)
    flat = candidates.ravel()
    k, l = _flat_places(xd[flat], many[0][:, 0], half, half, die.nodes.shape[1])  # noqa: E741
    outside = (np.maximum(np.abs(k - 0.5), 0.5) + np.maximum(np.abs(l - 0.5), 0.5) - 1.0).reshape(n, c)
    outside = np.where(np.isfinite(outside), outside, np.inf)
    near = outside <= outside.min(axis=1, keepdims=True) + 1e-7  # on an edge: the later facet, whatever the rounding
    best = np.argmax(np.where(near, candidates, -1), axis=1)
    row = np.arange(n)
    facet = candidates[row, best]
    k, l = (v.reshape(n, c)[row, best][:, None] for v in (k, l))  # noqa: E741
    past = ~(outside[row, best] <= 1e-9)
    k, l = (np.where(np.isnan(v), 0.5, v) for v in (k, l))  # noqa: E741
    if keep is not None:
        half = np.full((n, 1), 0.5)
        kept_k, kept_l = _flat_places(xd[keep], x, half, half, die.nodes.shape[1])
        stays = np.maximum(np.abs(kept_k - 0.5), np.abs(kept_l - 0.5)) < 0.5 + HELD
        k, l = np.where(stays, kept_k, k), np.where(stays, kept_l, l)  # noqa: E741
        facet = np.where(stays[:, 0], keep, facet)
    met, _, _ = _meet_facets(die, xd, facet, x[:, None], N[:, None], k, l)
    return facet, met, past


def _flat_places(nodes: Array, x: Array, k: Array, l: Array, n: int) -> tuple[Array, Array]:  # noqa: E741
    """Places (k, l) of facets where they have the (x, z) of points; nan where none is found (far outside)."""
    across = [0, 2]
    for _ in range(8):
        M, M_k, M_l = (shape2(n, k, l, *d) for d in ((0, 0), (1, 0), (0, 1)))
        out = (M @ nodes)[:, 0][:, across] - x[:, across]
        a, b = (M_k @ nodes)[:, 0][:, across], (M_l @ nodes)[:, 0][:, across]
        det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        det = np.where(np.abs(det) > 1e-300, det, np.inf)
        dk = (out[:, 0] * b[:, 1] - out[:, 1] * b[:, 0]) / det
        dl = (a[:, 0] * out[:, 1] - a[:, 1] * out[:, 0]) / det
        k, l = np.clip(k - dk[:, None], -2.0, 3.0), np.clip(l - dl[:, None], -2.0, 3.0)  # noqa: E741
    miss = np.linalg.norm((shape2(n, k, l) @ nodes)[:, 0][:, across] - x[:, across], axis=1)
    lost = ~(miss <= 1e-6 * np.ptp(nodes[:, :, across], axis=1).max(axis=1))[:, None]
    return np.where(lost, np.nan, k), np.where(lost, np.nan, l)


@dataclass(frozen=True)
class Closest:
    """Closest points on the die; the gap is ``n . (x - x_m)`` with the normal held."""

    facet: Index  # (n,) of the die, or its meridian piece
    gap: Array  # (n,) mm
    normal: Array  # (n, 3) unit normal of the die, into the bore
    M: Array | None  # (n, k) functions of the die facet's nodes
    past: np.ndarray  # (n,) bool: past an end of the meridian


def closest(die: Facets | Revolved, z: Array, x: Array, smooth: bool = False, keep: Index | None = None) -> Closest:
    """Closest points on the die of points ``(n, 3)``; exactly opposite a ring a point belongs to the facet ahead.

    Args:
        die: The die.
        z: Contact vector, mm.
        x: Points, mm.
        smooth: Normals averaged at the die's nodes and interpolated, instead of the facet's own.
        keep: Facets of an earlier pairing: a point stays with its own if that is as near, but for rounding.
    """
    if isinstance(die, Revolved):
        r, e = np.linalg.norm(x[:, [0, 2]], axis=1), radial(x)
        pair = np.stack([die.points[:-1], die.points[1:]], axis=1)
        flat = np.stack([r, x[:, 1]], axis=1)
        found = closest_points(flat, pair, die.side, smooth, keep)
        ends = pair[found.facet]
        at = ends[:, 0] + found.k[:, None] * (ends[:, 1] - ends[:, 0])
        normal = found.normal[:, :1] * e
        normal[:, 1] = found.normal[:, 1]
        gap = np.einsum("ni,ni->n", found.normal, flat - at)
        return Closest(found.facet, gap, normal, None, found.past)
    xd, kd = die.position(z), die.nodes.shape[1]
    candidates: Any = _near(die, xd, x)
    n, c = candidates.shape
    flat_c = candidates.ravel()
    nodes, many = xd[flat_c], np.repeat(x, c, axis=0)
    k, l = _project(nodes, many, kd)  # noqa: E741
    foot = np.einsum("nk,nki->ni", shape2(kd, k, l), nodes)
    distance = np.linalg.norm(many - foot, axis=1).reshape(n, c)
    scale = float(np.median(die.length))
    near = distance <= distance.min(axis=1, keepdims=True) + 1e-9 * scale
    facet = np.where(near, candidates, -1).max(axis=1)
    if keep is not None:
        reach = np.where(candidates == keep[:, None], distance, np.inf).min(axis=1)
        facet = np.where(reach <= distance.min(axis=1) + KEPT * scale, keep, facet)
    row = np.arange(n)
    which = np.argmax(candidates == facet[:, None], axis=1)
    k, l = (v.reshape(n, c)[row, which] for v in (k, l))  # noqa: E741
    M = shape2(kd, k, l)
    mine = xd[facet]
    normals = die.side[facet][:, None] * np.cross(
        np.einsum("nk,nki->ni", shape2(kd, k, l, 1, 0), mine), np.einsum("nk,nki->ni", shape2(kd, k, l, 0, 1), mine)
    )
    if smooth:
        normals = np.einsum("nk,nki->ni", M, _nodal_normals(die, xd)[die.nodes[facet]])
    normal = normals / np.linalg.norm(normals, axis=1)[:, None]
    foot = np.einsum("nk,nki->ni", M, mine)
    # past the meridian's end: the point projects out of the last row's far edge
    y, ends = x[:, 1], xd[..., 1]
    past = ((y > ends.max() + 1e-9 * scale) & (k > 1 - 1e-9)) | ((y < ends.min() - 1e-9 * scale) & (k < 1e-9))
    return Closest(facet, np.einsum("ni,ni->n", normal, x - foot), normal, M, past)


KEPT = 0.02
"""How much farther than the nearest facet a kept one may be, relative to the facets' size."""


def _project(nodes: Array, x: Array, kd: int) -> tuple[Array, Array]:
    """Places (k, l) in [0, 1]^2 of the points of facets that are closest to x, by projected Newton's method."""
    k, l = np.full(len(x), 0.5), np.full(len(x), 0.5)  # noqa: E741
    for _ in range(14):
        M = {d: np.einsum("nk,nki->ni", shape2(kd, k, l, *d), nodes) for d in ((0, 0), (1, 0), (0, 1), (1, 1))}
        r = M[0, 0] - x
        g_k, g_l = _dot(r, M[1, 0]), _dot(r, M[0, 1])
        h_kk, h_ll, h_kl = _dot(M[1, 0], M[1, 0]), _dot(M[0, 1], M[0, 1]), _dot(M[1, 0], M[0, 1]) + _dot(r, M[1, 1])
        if kd > 4:
            h_kk = h_kk + _dot(r, np.einsum("nk,nki->ni", shape2(kd, k, l, 2, 0), nodes))
            h_ll = h_ll + _dot(r, np.einsum("nk,nki->ni", shape2(kd, k, l, 0, 2), nodes))
        held_k = ((k <= 0) & (g_k > 0)) | ((k >= 1) & (g_k < 0))
        held_l = ((l <= 0) & (g_l > 0)) | ((l >= 1) & (g_l < 0))
        free = ~(held_k | held_l)
        det = h_kk * h_ll - h_kl**2
        safe = free & (det > 1e-12 * h_kk * h_ll) & (h_kk > 0) & (h_ll > 0)
        det = np.where(safe, det, 1.0)
        dk = np.where(safe, (h_ll * g_k - h_kl * g_l) / det, g_k / np.where(h_kk > 0, h_kk, np.inf))
        dl = np.where(safe, (h_kk * g_l - h_kl * g_k) / det, g_l / np.where(h_ll > 0, h_ll, np.inf))
        new_k = np.clip(k - np.where(held_k, 0.0, dk), 0.0, 1.0)
        new_l = np.clip(l - np.where(held_l, 0.0, dl), 0.0, 1.0)
        moved = max(float(np.abs(new_k - k).max(initial=0.0)), float(np.abs(new_l - l).max(initial=0.0)))
        k, l = new_k, new_l  # noqa: E741
        if moved < 1e-14:
            break
    return k, l


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _nodal_normals(die: Facets, xd: Array) -> Array:
    """Outward normals of the die averaged at its nodes, by node number; on a plane of symmetry they lie in it."""
    kd = die.nodes.shape[1]
    s, t = (np.broadcast_to(v, die.nodes.shape) for v in places(kd).T)
    n = np.cross(shape2(kd, s, t, 1, 0) @ xd, shape2(kd, s, t, 0, 1) @ xd) * die.side[:, None, None]
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-300)
    out = np.zeros((int(die.nodes.max()) + 1, 3))
    np.add.at(out, die.nodes, n)
    scale = np.abs(die.X).max()
    for component in (0, 2):
        on_plane = np.abs(die.X[..., component]) < 1e-9 * scale
        out[die.nodes[on_plane], component] = 0.0
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300))


def stress_rows(slave: Facets, facet: Index, xi: Array, t: Array, direction: Array, lmbda: float, mu: float) -> Array:
    """Component ``direction . sigma(u) N`` of the slave's traction, as rows over its cell's displacements.

    Args:
        slave: Slave surface with cells.
        facet: Facet of each piece, ``shape=(n,)``.
        xi: Places along it, ``shape=(n, q)``.
        t: Places across it.
        direction: Unit vectors, ``shape=(n, q, 3)``.
        lmbda: First Lamé parameter, MPa; not used where the surface has pressures, ``mu p`` each.
        mu: Shear modulus, MPa.

    Returns:
        Rows ``shape=(n, q, 3 K)`` in MPa/mm (and 8 more, over the pressures, if the surface has them).
    """
    frame = slave.frame[facet][:, None]
    at = frame[:, :, 0] + xi[..., None] * frame[:, :, 1] + t[..., None] * frame[:, :, 2]
    flat = at.reshape(-1, 3)
    shape_ = xi.shape
    table = slave.tabulate(1, flat)[1:].reshape(3, *shape_, -1)
    geometry = slave.tabulate_geometry(1, flat)
    J = np.einsum("jnqk,nki->nqij", geometry[1:].reshape(3, *shape_, -1), slave.cell_X[facet])
    K = np.linalg.inv(J)
    grad = np.einsum("inqk,nqij->nqkj", table, K)
    normal = np.cross(np.einsum("nqij,naj->nqi", J, frame[:, :, 1]), np.einsum("nqij,naj->nqi", J, frame[:, :, 2]))
    normal *= slave.side[facet][:, None, None] / np.linalg.norm(normal, axis=-1, keepdims=True)
    mixed = slave.pressure_cols is not None
    along_N = np.einsum("nqi,nqi->nq", direction, normal)[..., None]
    along_d = np.einsum("nqkj,nqj->nqk", grad, direction)[..., None]
    along_n = np.einsum("nqkj,nqj->nqk", grad, normal)[..., None]
    S = mu * (along_d * normal[:, :, None] + along_n * direction[:, :, None])
    if not mixed:
        mean = slave.mean_gradients
        S = S + lmbda * along_N[..., None] * (grad if mean is None else mean[facet][:, None])
    S = S.reshape(*shape_, -1)
    if not mixed:
        return np.asarray(S)
    linear = np.stack([(1 - c, c) for c in np.moveaxis(at, -1, 0)])  # (3, 2, n, q)
    corners = np.einsum("anq,bnq,cnq->nqcba", *linear).reshape(*shape_, 8)  # basix: the first direction runs fastest
    return np.concatenate([S, -mu * along_N * corners], axis=2)
