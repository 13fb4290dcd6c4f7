"""The contact term of one zone: points of the slave surface, a gap, a law and a closure.

A term works on the *contact vector* z: the displacements of all nodes that contact can touch, then the multipliers.
It adds to the residual ``G^T (w sigma_n)`` and what the law asks for, and gives the exact derivative. Two states:
`accept` moves the accepted one (the bilateral memory); residuals and tangents only read it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from extrusion.contact import CLOSED_GAP, Closure, project
from extrusion.elasticity import Elastic
from extrusion.gap import (
    Array,
    Index,
    Points,
    Surface,
    closest_rows,
    gauss,
    least_gap,
    polyline_points,
    ray_gap,
    ray_points,
    shape,
    stress_rows,
)

Triplets = tuple[Index, Index, Array]


@dataclass(frozen=True)
class Pair:
    """Two surfaces that face each other, as a zone sees them."""

    name: str
    slave: Surface
    die: Surface  # the master; the die unless the zone's roles are exchanged
    axis: int  # component along which the ray runs
    sign: float  # +1 if the master lies towards larger values of it
    closure: Closure
    ray: bool  # gap along the ray (else to the closest point)
    smooth: bool  # averaged normals (closest point)
    extended: bool  # the master's end lines go on past its ends; else a point there is let go
    axisymmetric: bool = True

    @property
    def direction(self) -> Array:
        """Unit vector along the ray, towards the master."""
        return self.sign * np.eye(2)[self.axis]


@dataclass(frozen=True)
class ContactState:
    """What a zone reports; row i is a contact point, in order along the slave."""

    x: Array  # (n, 2) current position, mm
    s: Array  # (n,) reference arc length along the slave surface, mm
    gap: Array  # (n,) mm, positive when open
    pressure: Array  # (n,) normal to the die, MPa, positive when pressed
    ray_pressure: Array  # (n,) its component along the ray per reference area, MPa
    weight: Array  # (n,) integration weight, mm^2
    closed: np.ndarray = field(repr=False)  # (n,) bool


class ContactTerm(Protocol):
    """What the problem asks of a zone."""

    pair: Pair
    multipliers: int
    forced: Index  # displacements (and pressures) in z that the term can put a force on, in order along slave and die
    caught: float  # mm: how far from the die the farthest point was that the last `start` or `accept` closed for good

    def start(self, z: Array) -> None:
        """Set the accepted state at t = 0 from the gap there."""

    def pair_up(self, z: Array, settle: bool = False) -> None:
        """Freeze what the term freezes of the geometry (nothing, for terms that follow it).

        ``settle``: let points that rest on a die vertex stay with the facet they had.
        """

    def settled(self, z: Array) -> bool:
        """Whether what `pair_up` settled still holds at z."""

    def add_residual(self, z: Array, R: Array) -> None:
        """Add the term's forces (N) to R."""

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        """Derivative of the residual as (rows, columns, values); ``geometric`` adds the second variation of the gap."""

    def accept(self, z: Array) -> None:
        """Make z the accepted state."""

    def expect(self, on: bool) -> bool:
        """Take the accepted contact set, where it stood in the die, for the one that will be; say if there is one."""

    def state(self, z: Array) -> ContactState:
        """Report at z."""

    def stiffness_norm(self) -> float:
        """Norm of force over gap, N/mm: how much round-off in a position weighs in the residual."""


def closed_at_start(gap: Array, radius: float, interpenetrating: bool) -> np.ndarray:
    """Points that a bilateral zone holds from t = 0: gap zero, or also negative where the start may interpenetrate."""
    touching = np.abs(gap) < CLOSED_GAP * radius
    return touching | (gap < 0) if interpenetrating else touching


@dataclass(frozen=True)
class ContactSet:
    """Which of some positions along the die (sorted, mm) are closed."""

    at: Array
    closed: np.ndarray

    @classmethod
    def of(cls, at: Array, closed: np.ndarray) -> ContactSet:
        """From positions in any order."""
        order = np.argsort(at, axis=None)
        return cls(at.ravel()[order], closed.ravel()[order])

    def __call__(self, at: Array) -> np.ndarray:
        """Whether positions are closed: as the next known one is."""
        return np.asarray(self.closed[np.minimum(np.searchsorted(self.at, at), len(self.at) - 1)])


class NodalContact:
    """Exact constraint at the slave nodes by an active set, one multiplier (N, whole revolution) a node.

    The pairing (die facet, place and normal) is frozen by `pair_up`; between two of these the problem is a linear
    complementarity problem, and its semismooth Newton iteration a primal-dual active set (Hintermüller, Ito,
    Kunisch 2002, doi:10.1137/S1052623401383558)::

        trial = lambda + kappa g;  residual  K u - f + G^T lambda,  min(trial, 0) - lambda
    """

    def __init__(self, pair: Pair, first: int, stiffness: Array, radius: float, interpenetrating: bool = False) -> None:
        slave = pair.slave
        self.pair = pair
        self.nodes = slave.node_numbers
        self.X = polyline_points(slave)
        self.weight = nodal_weights(slave, pair.axisymmetric)
        self.multipliers = 0 if pair.closure == "check" else len(self.nodes)
        self.forced = _forced(pair)
        self.at = first + np.arange(self.multipliers)
        self._kappa = np.full(len(self.nodes), float(np.mean(stiffness) * np.mean(np.abs(self.weight))))
        self._radius, self._interpenetrating = radius, interpenetrating
        self.closed, self.caught = np.zeros(len(self.nodes), dtype=bool), 0.0
        self._facet: Index | None = None

    def start(self, z: Array) -> None:
        self.pair_up(z)
        gap = self._g0 + self._apply(z)
        self.closed = closed_at_start(gap, self._radius, self._interpenetrating)
        self.caught = _farthest(gap, self.closed)

    def pair_up(self, z: Array, settle: bool = False) -> None:
        pair = self.pair
        x = self.X + _displacement(z, self.nodes)
        if pair.ray:
            g, slope, self._G, self._cols, self._past = _ray_rows(pair, self.nodes, x, z)
            self._cos = 1 / np.sqrt(1 + slope**2)
        else:
            ones, keep = np.ones((len(x), 1)), self._facet if settle else None
            found, g, self._G, self._cols = closest_rows(
                self.nodes[:, None], ones, x, pair.die, _even(z), pair.smooth, keep
            )
            self._facet = found.facet
            self._past, self._cos = found.past, np.abs(found.normal @ pair.direction)
        self._g0 = g - self._apply(z)

    def settled(self, z: Array) -> bool:
        return True

    def expect(self, on: bool) -> bool:
        return False

    def stiffness_norm(self) -> float:
        return float(np.linalg.norm(self._kappa)) if self.multipliers else 0.0

    def _apply(self, z: Array) -> Array:
        return np.einsum("nl,nl->n", self._G, z[self._cols])

    def _law(self, z: Array) -> tuple[Array, Array, Array]:
        lam = z[self.at]
        gap = self._g0 + self._apply(z)
        sc, dsc = project(lam + self._kappa * gap, self.pair.closure, self.closed)
        if not self.pair.extended:
            sc, dsc = np.where(self._past, 0.0, sc), np.where(self._past, 0.0, dsc)
        return gap, sc, dsc

    def add_residual(self, z: Array, R: Array) -> None:
        if self.multipliers:
            _, sc, _ = self._law(z)
            lam = z[self.at]
            np.add.at(R, self._cols, lam[:, None] * self._G)
            R[self.at] += sc - lam

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        if not self.multipliers:
            return _none()
        _, _, dsc = self._law(z)
        at = np.broadcast_to(self.at[:, None], self._cols.shape)
        constraint = (dsc * self._kappa)[:, None] * self._G
        return (
            np.concatenate([self._cols.ravel(), at.ravel(), self.at]),
            np.concatenate([at.ravel(), self._cols.ravel(), self.at]),
            np.concatenate([self._G.ravel(), constraint.ravel(), dsc - 1.0]),
        )

    def accept(self, z: Array) -> None:
        if not self.multipliers:
            return
        gap, _, dsc = self._law(z)
        if self.pair.closure != "bilateral":
            self.closed = dsc > 0
            return
        before = self.closed
        self.closed = before | (dsc > 0)
        if not self.pair.extended:
            self.closed &= ~self._past
        self.caught = _farthest(gap, self.closed & ~before)

    def state(self, z: Array) -> ContactState:
        x = self.X + _displacement(z, self.nodes)
        gap = self._g0 + self._apply(z)
        if self.multipliers:
            gap, sc, dsc = self._law(z)
            closed = dsc > 0
        else:
            sc, closed = np.zeros(len(x)), gap < 0
        with np.errstate(divide="ignore", invalid="ignore"):
            stress = np.where(np.abs(self.weight) > 1e-9 * np.max(self.weight), -sc / self.weight, np.nan)
        normal = stress / self._cos if self.pair.ray else stress
        s = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.X, axis=0), axis=1)))
        return ContactState(x, s, gap, normal, normal * self._cos, self.weight, closed)


class IntegratedContact:
    """Penalty or Nitsche's method at quadrature points of the slave facets, split at the die's kinks (ray gap).

    ::

        trial = S u + k g;  sc = project(trial);  residual  w [ G^T sc + theta / k S^T (sc - S u) ]

    with S u = 0 for the penalty. Chouly, Hild, Renard 2015, doi:10.1090/S0025-5718-2014-02913-X; large sliding:
    Mlika, Renard, Chouly 2017, doi:10.1016/j.cma.2017.06.034. With a ray gap the tangent is the exact derivative of
    the residual, moving split points included.
    """

    multipliers = 0

    def __init__(
        self,
        pair: Pair,
        stiffness: Array,
        material: Elastic | None,
        theta: int,
        radius: float,
        interpenetrating: bool = False,
        order: int = 4,
    ) -> None:
        self.pair, self._k, self._material, self._theta = pair, stiffness, material, theta
        self.forced = _forced(pair, behind=bool(theta) and material is not None)
        self._radius, self._interpenetrating, self._order = radius, interpenetrating, order
        self.closed, self.caught = np.zeros(len(pair.slave.nodes), dtype=bool), 0.0
        self._accepted: ContactSet | None = None
        self._expects = False
        self._known: tuple[Array, tuple[Points, Array | None, Array | None]] | None = None

    def start(self, z: Array) -> None:
        points = self._points(z)[0]
        self.closed = self._whole_facets(points, closed_at_start(points.gap, self._radius, self._interpenetrating))
        self.caught = _farthest(points.gap, self.closed[points.facet])

    def pair_up(self, z: Array, settle: bool = False) -> None:
        pass

    def settled(self, z: Array) -> bool:
        return True

    def expect(self, on: bool) -> bool:
        self._expects = on and self._accepted is not None
        return self._expects

    def _along(self, z: Array, points: Points) -> Array:
        """Positions of the points along the die, mm."""
        slave, c = self.pair.slave, 1 - self.pair.axis
        nodal = slave.X[..., c] + z[2 * slave.nodes + c]
        return np.einsum("nqi,ni->nq", shape(points.xi, slave.nodes.shape[1]), nodal[points.facet])

    def stiffness_norm(self) -> float:
        if self.pair.closure == "check":
            return 0.0
        k, weight = self._k, facet_weights(self.pair.slave, self.pair.axisymmetric)
        if self._material is not None:  # the slave's own stress, M / h a displacement, stands beside k times the gap
            own = (self._material.lmbda + 2 * self._material.mu) / self.pair.slave.length / k
            k = k * (1 + own + abs(self._theta) * own**2)
        return float(np.linalg.norm(k * weight))

    def _whole_facets(self, points: Points, held: np.ndarray) -> np.ndarray:
        every = np.ones(len(self.closed), dtype=bool)
        np.logical_and.at(every, points.facet, held.all(axis=1))
        return every

    def _points(self, z: Array) -> tuple[Points, Array | None, Array | None]:
        """Contact points with the rows of the slave's own stress and their derivative, over the points' columns.

        With their variation, since a residual is mostly followed by the tangent at the same z; the last are remembered.
        """
        if self._known is None or not np.array_equal(self._known[0], z):
            self._known = z.copy(), self._points_at(z)
        return self._known[1]

    def _points_at(self, z: Array) -> tuple[Points, Array | None, Array | None]:
        pair, variation = self.pair, self.pair.closure != "check"
        if pair.ray:
            points = ray_points(
                pair.slave,
                pair.die,
                _even(z),
                pair.axis,
                pair.sign,
                self._order,
                pair.axisymmetric,
                variation,
            )
            direction: Array = pair.direction
        else:
            points, direction = _closest_integration_points(pair, z, self._order)
        if self._material is None:
            return points, None, None
        S, S_xi = stress_rows(
            pair.slave, points.facet, points.xi, direction, self._material.lmbda, self._material.mu,
            pair.axisymmetric, variation and pair.ray,
        )  # fmt: skip
        # S stands over the cell's displacements, then (mixed form) its pressures; the points over cell and die
        n_u, n_points = 2 * pair.slave.cell_nodes.shape[1], points.G.shape[2]

        def over_all(rows: Array) -> Array:
            between = np.zeros((*rows.shape[:2], n_points - n_u))
            return np.concatenate([rows[..., :n_u], between, rows[..., n_u:]], axis=2)

        if pair.slave.pressure_cols is not None:
            points = _widened(points, pair.slave.pressure_cols[points.facet])
        return points, over_all(S), None if S_xi is None else over_all(S_xi)

    def _law(self, z: Array, points: Points, S: Array | None) -> tuple[Array, Array, Array, Array]:
        k = self._k[points.facet][:, None]
        own = np.einsum("nql,nl->nq", S, z[points.cols]) if S is not None else np.zeros_like(points.gap)
        held = np.broadcast_to(self.closed[points.facet][:, None], own.shape)
        closure = self.pair.closure
        if self._expects and self._accepted is not None:
            held, closure = self._accepted(self._along(z, points)), "bilateral"
        sc, dsc = project(own + k * points.gap, closure, held)
        if not self.pair.extended:
            sc, dsc = np.where(points.past, 0.0, sc), np.where(points.past, 0.0, dsc)
        return own, sc, dsc, k

    def add_residual(self, z: Array, R: Array) -> None:
        if self.pair.closure == "check" or (not self._theta and is_far(self.pair, z, self._radius)):
            return
        points, S, _ = self._points(z)
        own, sc, _, k = self._law(z, points, S)
        force = np.einsum("nq,nql->nl", points.weight * sc, points.G)
        if S is not None and self._theta:
            force += np.einsum("nq,nql->nl", points.weight * self._theta / k * (sc - own), S)
        np.add.at(R, points.cols, force)

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        if self.pair.closure == "check" or (not self._theta and is_far(self.pair, z, self._radius)):
            return _none()
        points, S, S_xi = self._points(z)
        own, sc, dsc, k = self._law(z, points, S)
        theta = self._theta if S is not None else 0
        if not theta:  # open pieces carry nothing
            on = (dsc > 0).any(axis=1)
            points, own, sc, dsc, k = _take(points, on), own[on], sc[on], dsc[on], k[on]
            S, S_xi = (None if a is None else a[on] for a in (S, S_xi))
        z_local = z[points.cols]
        w, G = points.weight[..., None], points.G
        d_own = S if S is not None else np.zeros_like(G)
        d_gap = G
        if geometric and points.dxi is not None and points.gap_xi is not None:
            d_gap = G + points.gap_xi[..., None] * points.dxi
            if S is not None and S_xi is not None:
                d_own = S + np.einsum("nql,nl->nq", S_xi, z_local)[..., None] * points.dxi
        d_sc = dsc[..., None] * (d_own + k[..., None] * d_gap)
        test = G + theta / k[..., None] * S if S is not None and theta else G
        left, right = [w * test], [d_sc]
        if S is not None and theta:
            left.append(-w * theta / k[..., None] * S)
            right.append(d_own)
        if geometric and points.dxi is not None and points.G_xi is not None and points.dweight is not None:
            w_sc = w * sc[..., None]
            force, along = G * sc[..., None], w_sc * points.G_xi
            if S is not None and S_xi is not None and theta:
                rest = (theta / k * (sc - own))[..., None]
                force, along = force + rest * S, along + w * rest * S_xi
            left += [force, along]
            right += [points.dweight, points.dxi]
            for a, b in points.curvature:
                left.append(w_sc * a)
                right.append(b)
        J = np.swapaxes(np.concatenate(left, axis=1), 1, 2) @ np.concatenate(right, axis=1)
        rows = np.broadcast_to(points.cols[:, :, None], J.shape)
        cols = np.broadcast_to(points.cols[:, None, :], J.shape)
        return rows.ravel(), cols.ravel(), J.ravel()

    def closed_edge(self) -> tuple[Triplets, Array]:
        """What the symmetric method (theta = 1) adds to the bulk with every facet closed against a plane die.

        Returns:
            Triplets of ``G^T w S + S^T w G``, and the values of ``G^T w k G`` at the same places.
        """
        slave, K = self.pair.slave, self.pair.slave.cell_nodes.shape[1]
        xi, omega = gauss(self._order)
        facet = np.arange(len(slave.nodes))
        at = np.broadcast_to(xi, (len(facet), self._order))
        assert self._material is not None
        normal = slave.normal[:, None]
        S, _ = stress_rows(slave, facet, at, normal, self._material.lmbda, self._material.mu, self.pair.axisymmetric)
        G = np.zeros_like(S)
        N = shape(at, slave.nodes.shape[1])
        for component in (0, 1):
            where = np.broadcast_to(2 * slave.local[:, None] + component, N.shape)
            np.put_along_axis(G, where, -normal[..., component, None] * N, axis=2)
        radius = slave.X[:, :1, 0] + at * (slave.X[:, 1:2, 0] - slave.X[:, :1, 0])
        w = slave.length[:, None] * omega * (2 * np.pi * radius if self.pair.axisymmetric else 1.0)
        cols = (2 * slave.cell_nodes[..., None] + np.arange(2)).reshape(-1, 2 * K)
        if slave.pressure_cols is not None:
            cols = np.concatenate([cols, slave.pressure_cols], axis=1)
        GS = np.einsum("nq,nqi,nqj->nij", w, G, S)
        GG = np.einsum("nq,nqi,nqj->nij", w * self._k[:, None], G, G)
        rows = np.broadcast_to(cols[:, :, None], GS.shape).ravel()
        across = np.broadcast_to(cols[:, None, :], GS.shape).ravel()
        return (rows, across, (GS + np.swapaxes(GS, 1, 2)).ravel()), GG.ravel()

    def accept(self, z: Array) -> None:
        if self.pair.closure == "check":
            return
        points, S, _ = self._points(z)
        _, _, dsc, _ = self._law(z, points, S)
        if self.pair.closure == "unilateral":
            self._accepted = ContactSet.of(self._along(z, points), dsc > 0) if np.any(dsc > 0) else None
        else:
            before = self.closed
            self.closed = before | self._whole_facets(points, dsc > 0)
            self.caught = _farthest(points.gap, (self.closed & ~before)[points.facet])

    def state(self, z: Array) -> ContactState:
        points, S, _ = self._points(z)
        _, sc, dsc, _ = self._law(z, points, S)
        closed = points.gap < 0 if self.pair.closure == "check" else dsc > 0
        return _state_at(self.pair, z, points, sc, closed)


class MortarContact:
    """Weak gap against a P1 multiplier on the slave side (MPa, along the ray), an active set on its nodes.

    ::

        G_i = sum_q w psi_i gap;  p = sum_i psi_i lambda_i
        residual  K u - f + sum_q w p G^T,   project(D_i lambda_i + k G_i) - D_i lambda_i,   D_i = sum_q w psi_i

    with the integrals split at the die's kinks and their exact derivative, as in `IntegratedContact`. A bilateral
    row of which less than `FACING` of the weight still faces the die is let go. Popp, Gitterle, Gee, Wall 2010,
    doi:10.1002/nme.2866, with a standard instead of a dual basis.
    """

    FACING = 0.3

    def __init__(
        self,
        pair: Pair,
        first: int,
        stiffness: Array,
        radius: float,
        interpenetrating: bool = False,
        order: int = 4,
    ) -> None:
        self.pair, self._order = pair, order
        self.forced = _forced(pair)
        m = len(pair.slave.nodes)
        facets = np.broadcast_to(stiffness, m)
        self._k = 0.5 * (np.append(facets[:1], facets) + np.append(facets, facets[-1:]))  # at the vertices
        self.multipliers = 0 if pair.closure == "check" else m + 1
        self.at = first + np.arange(self.multipliers)
        self._radius, self._interpenetrating = radius, interpenetrating
        self._total = vertex_weights(pair.slave, pair.axisymmetric)
        self.closed, self.caught = np.zeros(m + 1, dtype=bool), 0.0
        self._settled: np.ndarray | None = None  # rows let go, where that is not left to each iterate
        self._accepted: ContactSet | None = None
        self._expects = False
        self._known: tuple[Array, Points] | None = None

    def start(self, z: Array) -> None:
        points = self._points(z)
        held = closed_at_start(points.gap, self._radius, self._interpenetrating)
        self.closed[:] = True
        np.logical_and.at(self.closed, points.facet, held.all(axis=1))
        np.logical_and.at(self.closed, points.facet + 1, held.all(axis=1))
        self.caught = _farthest(points.gap, self.closed[points.facet] & self.closed[points.facet + 1])

    def pair_up(self, z: Array, settle: bool = False) -> None:
        if not settle or self.pair.extended:
            self._settled = None
            return
        lost = self._rows(self._points(z))[1] < self.FACING
        self._settled = lost if self._settled is None else lost | self._settled

    def settled(self, z: Array) -> bool:
        if self._settled is None:
            return True
        lost = self._rows(self._points(z))[1] < self.FACING
        return bool(np.all(self._settled[lost]))

    def _free(self, share: Array) -> np.ndarray:
        """Rows let go: those of which too little faces the die, or those settled beforehand."""
        if self.pair.extended:
            return np.zeros(len(share), dtype=bool)
        return share < self.FACING if self._settled is None else self._settled

    def _points(self, z: Array) -> Points:
        """Contact points with their variation, as those of `IntegratedContact`."""
        if self._known is None or not np.array_equal(self._known[0], z):
            pair = self.pair
            of = pair.slave, pair.die, _even(z), pair.axis, pair.sign, self._order, pair.axisymmetric
            self._known = z.copy(), ray_points(*of, pair.closure != "check")
        return self._known[1]

    def stiffness_norm(self) -> float:
        return float(np.linalg.norm(self._k * self._total)) if self.multipliers else 0.0

    def _rows(self, points: Points) -> tuple[Array, Array, Array]:
        """Weak gap (mm^3) of each row, the share of its weight that faces the die, and the point weights that count."""
        w = points.weight if self.pair.extended else np.where(points.past, 0.0, points.weight)
        weak, facing = np.zeros(len(self.closed)), np.zeros(len(self.closed))
        for node, psi in ((points.facet, 1 - points.xi), (points.facet + 1, points.xi)):
            np.add.at(weak, node, (w * psi * points.gap).sum(axis=1))
            np.add.at(facing, node, (w * psi).sum(axis=1))
        return weak, facing / self._total, w

    def _law(self, z: Array, points: Points) -> tuple[Array, Array, Array]:
        weak, share, w = self._rows(points)
        held, closure = self.closed, self.pair.closure
        if self._expects and self._accepted is not None:
            held, closure = self._accepted(self._along(z)), "bilateral"
        sc, dsc = project(self._total * z[self.at] + self._k * weak, closure, held)
        free = self._free(share)
        return np.where(free, 0.0, sc), np.where(free, 0.0, dsc), w

    def add_residual(self, z: Array, R: Array) -> None:
        if not self.multipliers:
            return
        if is_far(self.pair, z, self._radius):
            R[self.at] -= self._total * z[self.at]
            return
        points = self._points(z)
        sc, _, w = self._law(z, points)
        lam = z[self.at]
        p = (1 - points.xi) * lam[points.facet, None] + points.xi * lam[points.facet + 1, None]
        np.add.at(R, points.cols, np.einsum("nq,nql->nl", w * p, points.G))
        R[self.at] += sc - self._total * lam

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        if not self.multipliers:
            return _none()
        if is_far(self.pair, z, self._radius):
            return self.at, self.at, -self._total
        points = self._points(z)
        _, dsc, w = self._law(z, points)
        lam = z[self.at]
        f = points.facet
        on = (dsc[f] > 0) | (dsc[f + 1] > 0) | (lam[f] != 0) | (lam[f + 1] != 0)
        points, w, f = _take(points, on), w[on], f[on]
        psi = np.stack([1 - points.xi, points.xi], axis=-1)
        ends = np.stack([f, f + 1], axis=-1)
        n, q, n_u = points.G.shape
        p = (psi * lam[ends][:, None]).sum(axis=-1)
        row = (self._k * dsc)[ends]

        def pad(u: Array | None, multiplier: Array | None) -> Array:
            out = np.zeros((n, q, n_u + 2))
            if u is not None:
                out[..., :n_u] = u
            if multiplier is not None:
                out[..., n_u:] = multiplier
            return out

        d_gap, weighted_row = points.G, w[..., None] * psi * row[:, None]
        exact = geometric and points.dxi is not None
        if points.dxi is not None and points.gap_xi is not None and exact:
            d_gap = points.G + points.gap_xi[..., None] * points.dxi
        left = [pad(w[..., None] * points.G, None), pad(None, weighted_row)]
        right = [pad(None, psi), pad(d_gap, None)]
        if exact and points.dxi is not None and points.G_xi is not None and points.dweight is not None:
            counts = (w != 0)[..., None] * points.dweight
            wp = (w * p)[..., None]
            p_xi = (lam[f + 1] - lam[f])[:, None, None]
            slope = np.array([-1.0, 1.0]) * row[:, None] * (w * points.gap)[..., None]
            left += [
                pad(p[..., None] * points.G, psi * row[:, None] * points.gap[..., None]),
                pad(wp * points.G_xi + w[..., None] * p_xi * points.G, slope),
            ]
            right += [pad(counts, None), pad(points.dxi, None)]
            for a, b in points.curvature:
                left.append(pad(wp * a, None))
                right.append(pad(b, None))
        J = np.swapaxes(np.concatenate(left, axis=1), 1, 2) @ np.concatenate(right, axis=1)
        cols = np.concatenate([points.cols, self.at[ends]], axis=1)
        rows = np.broadcast_to(cols[:, :, None], J.shape)
        across = np.broadcast_to(cols[:, None, :], J.shape)
        return (
            np.concatenate([rows.ravel(), self.at]),
            np.concatenate([across.ravel(), self.at]),
            np.concatenate([J.ravel(), (dsc - 1.0) * self._total]),
        )

    def expect(self, on: bool) -> bool:
        self._expects = on and self._accepted is not None
        return self._expects

    def _along(self, z: Array) -> Array:
        """Positions of the multipliers' nodes along the die, mm."""
        slave, c = self.pair.slave, 1 - self.pair.axis
        at = slave.X[:, :2, c] + z[2 * slave.nodes[:, :2] + c]
        return np.append(at[:, 0], at[-1:, 1])

    def accept(self, z: Array) -> None:
        if self.multipliers and self.pair.closure == "unilateral":
            dsc = self._law(z, self._points(z))[1]
            self._accepted = ContactSet.of(self._along(z), dsc > 0) if np.any(dsc > 0) else None
        if self.multipliers and self.pair.closure == "bilateral":
            points, before = self._points(z), self.closed
            self.closed = (before | (self._law(z, points)[1] > 0)) & ~self._free(self._rows(points)[1])
            new = self.closed & ~before
            self.caught = _farthest(points.gap, new[points.facet] & new[points.facet + 1])

    def state(self, z: Array) -> ContactState:
        points = self._points(z)
        stress, closed = np.zeros_like(points.gap), points.gap < 0
        if self.multipliers:
            lam, dsc = z[self.at], self._law(z, points)[1]
            stress = (1 - points.xi) * lam[points.facet, None] + points.xi * lam[points.facet + 1, None]
            closed = np.where(points.xi < 0.5, dsc[points.facet, None], dsc[points.facet + 1, None]) > 0
        return _state_at(self.pair, z, points, stress, closed)


def _state_at(pair: Pair, z: Array, points: Points, stress: Array, closed: np.ndarray) -> ContactState:
    """Report at quadrature points; ``stress`` is that conjugate to the gap, MPa."""
    slave = pair.slave
    x = shape(points.xi, slave.nodes.shape[1]) @ (slave.X + _displacement(z, slave.nodes))[points.facet]
    start = np.append(0.0, np.cumsum(slave.length))
    s = start[points.facet][:, None] + points.xi * slave.length[points.facet][:, None]
    cos = 1 / np.sqrt(1 + points.slope**2)
    ray, normal = (-stress, -stress / cos) if pair.ray else (-stress * cos, -stress)
    return ContactState(
        x.reshape(-1, 2),
        s.ravel(),
        points.gap.ravel(),
        normal.ravel(),
        ray.ravel(),
        points.weight.ravel(),
        closed.ravel(),
    )


def _farthest(gap: Array, of: np.ndarray) -> float:
    """Largest distance from the die among some points, mm."""
    return float(np.max(np.abs(gap[of]), initial=0.0))


def nodal_weights(surface: Surface, axisymmetric: bool) -> Array:
    """Integral of each node's shape function over the reference surface (2 pi r ds, or ds), mm^2 or mm."""
    xi, omega = gauss(3)
    N = shape(xi, surface.nodes.shape[1])
    r = N @ surface.X[..., 0, None]
    measure = surface.length[:, None] * omega * (2 * np.pi * r[..., 0] if axisymmetric else 1.0)
    nodes = surface.node_numbers
    out = np.zeros(nodes.max() + 1)
    np.add.at(out, surface.nodes, measure @ N)
    return np.asarray(out[nodes])


FAR = 0.1
"""A unilateral zone whose gap is nowhere below this (of the billet's radius) is left out until it closes."""


def is_far(pair: Pair, z: Array, radius: float) -> bool:
    """Whether the surfaces are too far apart for contact, or for Nitsche's trial stress, whose k gap outweighs all."""
    return (
        pair.ray
        and pair.closure == "unilateral"
        and least_gap(pair.slave, pair.die, _even(z), pair.axis, pair.sign) > FAR * radius
    )


def vertex_weights(surface: Surface, axisymmetric: bool) -> Array:
    """Integral of each vertex's linear function over the reference surface, in order, mm^2 or mm."""
    xi, omega = gauss(2)
    radius = surface.X[:, :1, 0] + xi * (surface.X[:, 1:2, 0] - surface.X[:, :1, 0])
    measure = surface.length[:, None] * omega * (2 * np.pi * radius if axisymmetric else 1.0)
    out = np.zeros(len(measure) + 1)
    out[:-1] += measure @ (1 - xi)
    out[1:] += measure @ xi
    return out


def facet_weights(surface: Surface, axisymmetric: bool) -> Array:
    """Area of each reference facet (2 pi r ds), mm^2, or its length, mm."""
    radius = surface.X[:, :2, 0].mean(axis=1)
    return np.asarray(surface.length * (2 * np.pi * radius if axisymmetric else 1.0))


def gap_at_nodes(pair: Pair, z: Array) -> tuple[Index, Array]:
    """Slave nodes in order and the zone's gap there, mm."""
    nodes = pair.slave.node_numbers
    x = polyline_points(pair.slave) + _displacement(z, nodes)
    if pair.ray:
        return nodes, ray_gap(x, pair.die, _even(z), pair.axis, pair.sign)[0]
    return nodes, closest_rows(nodes[:, None], np.ones((len(x), 1)), x, pair.die, _even(z), pair.smooth)[1]


def _even(z: Array) -> Array:
    """The contact vector cut to an even length, so that it reads as pairs (multipliers stand at its end)."""
    return z[: len(z) - len(z) % 2]


def _displacement(z: Array, nodes: Index) -> Array:
    return np.stack([z[2 * nodes], z[2 * nodes + 1]], axis=-1)


def _forced(pair: Pair, behind: bool = False) -> Index:
    """Entries of z that forces at the slave's facets (or in the cells behind them) and at the die's go to."""
    if pair.closure == "check":
        return np.zeros(0, dtype=np.int64)
    nodes = np.concatenate([(pair.slave.cell_nodes if behind else pair.slave.nodes).ravel(), pair.die.nodes.ravel()])
    entries = (2 * nodes[:, None] + np.arange(2)).ravel()
    if behind and pair.slave.pressure_cols is not None:
        entries = np.concatenate([entries, pair.slave.pressure_cols.ravel()])
    return entries[np.sort(np.unique(entries, return_index=True)[1])]


def _none() -> Triplets:
    return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)


def _take(points: Points, on: np.ndarray) -> Points:
    values = {name: value[on] if isinstance(value, np.ndarray) else value for name, value in vars(points).items()}
    values["curvature"] = tuple((a[on], b[on]) for a, b in points.curvature)
    return Points(**values)


def _widened(points: Points, cols: Index) -> Points:
    """The points with further local columns, on which gap and weights do not depend."""

    def wide(rows: Array | None) -> Array | None:
        return None if rows is None else np.pad(rows, ((0, 0), (0, 0), (0, cols.shape[1])))

    values = vars(points) | {name: wide(getattr(points, name)) for name in ("G", "G_xi", "dxi", "dweight")}
    values["cols"] = np.concatenate([points.cols, cols], axis=1)
    values["curvature"] = tuple((wide(a), wide(b)) for a, b in points.curvature)
    return Points(**values)


def _ray_rows(pair: Pair, nodes: Index, x: Array, z: Array) -> tuple[Array, Array, Array, Index, np.ndarray]:
    """Ray gap at nodes, the die's slope, rows and columns, and which lie past the die's ends."""
    p, c, sign, die = 1 - pair.axis, pair.axis, pair.sign, pair.die
    gap, slope, facet, k = ray_gap(x, die, _even(z), pair.axis, sign)
    past = (k < -1e-9) | (k > 1 + 1e-9)
    weights = np.concatenate([-np.ones((len(x), 1)), shape(np.clip(k, 0.0, 1.0), die.nodes.shape[1])], axis=1)
    G = np.empty((*weights.shape, 2))
    G[..., c] = sign * weights
    G[..., p] = -sign * slope[:, None] * weights
    touched = np.concatenate([nodes[:, None], die.nodes[facet]], axis=1)
    cols = (2 * touched[..., None] + np.arange(2)).reshape(len(x), -1)
    return gap, slope, G.reshape(len(x), -1), cols, past


def _closest_integration_points(pair: Pair, z: Array, order: int) -> tuple[Points, Array]:
    slave = pair.slave
    xi, omega = gauss(order)
    m, K = slave.cell_nodes.shape
    N = np.broadcast_to(shape(xi, slave.nodes.shape[1]), (m, order, slave.nodes.shape[1]))
    x = (N @ (slave.X + _displacement(z, slave.nodes))).reshape(-1, 2)
    r = N @ slave.X[..., 0, None]
    measure = slave.length[:, None] * omega * (2 * np.pi * r[..., 0] if pair.axisymmetric else 1.0)
    full = np.zeros((m, order, K))
    np.put_along_axis(full, np.broadcast_to(slave.local[:, None], N.shape), N, axis=2)
    behind = np.repeat(slave.cell_nodes, order, axis=0)
    found, gap, G, cols = closest_rows(behind, full.reshape(-1, K), x, pair.die, _even(z), pair.smooth)
    facet = np.repeat(
        np.arange(m), order
    )  # every point is a piece of its own: its die facet differs from its neighbour's
    normal = found.normal
    slope = normal[:, 1 - pair.axis] / np.where(normal[:, pair.axis] == 0, 1e-300, normal[:, pair.axis])
    points = Points(
        facet=facet, die=found.facet, cols=cols, xi=np.tile(xi, m)[:, None], weight=measure.reshape(-1, 1),
        gap=gap[:, None], G=G[:, None], slope=slope[:, None], past=found.past[:, None],
    )  # fmt: skip
    return points, -normal[:, None]
