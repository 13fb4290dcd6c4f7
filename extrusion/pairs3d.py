"""Two surfaces in space that face each other, as the contact terms see them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from extrusion.elasticity import Elastic
from extrusion.gap import Array, Index, Points, gauss
from extrusion.gap3d import (
    Facets,
    Revolved,
    SurfacePoints,
    closest,
    line_points,
    meet,
    radial,
    scattered_points,
    shape2,
    stress_rows,
)
from extrusion.pairs import ContactState, NodeRows, Pair, closed_at_start, widened

COPIES = 4
"""A quarter is solved, and what is reported is of the whole revolution."""

STEP = 1e-5
"""Central difference of the stress rows along a line, relative to the facet; their error is its square."""


@dataclass(frozen=True, kw_only=True)
class SurfacePair(Pair):
    """Two surfaces in space; the gap along a ray or to the closest point (`extrusion.gap3d`)."""

    slave: Facets
    die: Facets | Revolved
    facets: Index | None = None  # `points` are those of these slave facets; None: of all

    dim = 3
    copies = COPIES

    # -- nodes -----------------------------------------------------------------------------------------------

    @property
    def nodes(self) -> Index:
        return self.slave.node_numbers

    @property
    def X(self) -> Array:
        return self.slave.node_X

    def _rays(self, X: Array) -> Array:
        return self.sign * (radial(X) if self.axis == 0 else np.broadcast_to([0.0, 1.0, 0.0], X.shape))

    def at_nodes(self, z: Array, keep: Index | None = None, which: Index | slice = slice(None)) -> NodeRows:
        nodes, X = self.nodes[which], self.X[which]
        x = X + self.displacement(z, nodes)
        N = self._rays(X)
        if self.ray:
            facet, met, past = meet(self.die, z, x, X, N, self.axis)
            gap, own, M = met.gap[:, 0], met.alpha, None if met.M is None else met.M[:, 0]
        else:
            found = closest(self.die, z, x, self.smooth, keep)
            facet, past, gap, own, M = found.facet, found.past, found.gap, found.normal[:, None], found.M
        touched, G = nodes[:, None], own
        if isinstance(self.die, Facets) and M is not None:
            touched = np.concatenate([touched, self.die.nodes[facet]], axis=1)
            G = np.concatenate([own, -M[..., None] * own], axis=1)
        cols = (3 * touched[..., None] + np.arange(3)).reshape(len(x), -1)
        cos = np.abs(np.einsum("ni,ni->n", own[:, 0], N)) / np.linalg.norm(own[:, 0], axis=1)
        return NodeRows(gap, G.reshape(len(x), -1), cols, past, cos, facet)

    def nodal_weights(self) -> Array:
        slave, k = self.slave, self.slave.nodes.shape[1]
        s, t, omega = _square(3)
        N = shape2(k, s, t)
        out = np.zeros(int(self.nodes.max()) + 1)
        np.add.at(out, slave.nodes, (self._measure(s, t) * omega) @ N)
        return np.asarray(out[self.nodes])

    def _measure(self, s: Array, t: Array) -> Array:
        """``|dX/ds x dX/dt|`` of every facet at places, ``shape=(m, q)``, mm^2."""
        X, k = self.slave.X, self.slave.nodes.shape[1]
        return np.asarray(np.linalg.norm(np.cross(shape2(k, s, t, 1, 0) @ X, shape2(k, s, t, 0, 1) @ X), axis=-1))

    def arc(self, X: Array) -> Array:
        if self.axis == 0:
            return np.asarray(X[:, 1] - self.slave.X[..., 1].min())
        return np.asarray(np.linalg.norm(X[:, [0, 2]], axis=1))

    # -- points ----------------------------------------------------------------------------------------------

    def points(
        self, z: Array, order: int, variation: bool, material: Elastic | None = None, keep: Index | None = None
    ) -> tuple[Points, Array | None, Callable[[], Array] | None]:
        slave, some = self.slave, self._some
        if self.ray and self.axis == 0:
            points = line_points(some, self.die, z, self.sign, order, variation)
        else:
            points = scattered_points(some, self.die, z, self.axis, self.sign, order, self.ray, self.smooth, keep)
        if self.facets is not None:
            points = replace(points, facet=self.facets[points.facet])
        if material is None:
            return points, None, None
        n_u, n_points = 3 * slave.cell_nodes.shape[1], points.G.shape[2]

        def rows(pieces: np.ndarray, xi: Array) -> Array:
            """Over the points' columns: the cell's displacements, the die's, then (mixed form) the pressures."""
            assert points.t is not None
            assert points.direction is not None
            direction = np.broadcast_to(points.direction, (*points.xi.shape, 3))[pieces]
            S = stress_rows(
                slave, points.facet[pieces], xi, points.t[pieces], direction, material.lmbda, material.mu
            )  # fmt: skip
            between = np.zeros((*S.shape[:2], n_points - n_u))
            return np.concatenate([S[..., :n_u], between, S[..., n_u:]], axis=2)

        S = rows(np.ones(len(points.xi), dtype=bool), points.xi)

        def S_xi() -> Array:
            assert points.dxi is not None
            out = np.zeros_like(S)
            moving = np.abs(points.dxi).max(axis=(1, 2)) > 0
            if moving.any():
                xi = points.xi[moving]
                out[moving] = (rows(moving, xi + STEP) - rows(moving, xi - STEP)) / (2 * STEP)
            return out

        given = points
        if slave.pressure_cols is not None:
            given = widened(points, slave.pressure_cols[points.facet])
        return given, S, S_xi if variation and points.dxi is not None else None

    def part(self, facets: Index) -> SurfacePair:
        return replace(self, facets=facets)

    @cached_property
    def _some(self) -> Facets:
        return self.slave if self.facets is None else self.slave.take(self.facets)

    def touches(self, z: Array, points: Points, radius: float, interpenetrating: bool) -> np.ndarray:
        # between its nodes a facet that touches is off the circle by a little: what counts are the nodes
        nodes, held = self.nodes, closed_at_start(self.at_nodes(z).gap, radius, interpenetrating)
        of_node = np.zeros(int(nodes.max()) + 1, dtype=bool)
        of_node[nodes] = held
        whole = of_node[self.slave.nodes].all(axis=1)
        return np.broadcast_to(whole[points.facet][:, None], points.gap.shape)

    def facing(self, points: Points) -> Index | None:
        unsplit = self.ray and self.axis == 1 and isinstance(self.die, Facets)
        return points.die if unsplit else None

    def closed_rows(self, order: int, material: Elastic) -> tuple[Array, Array, Array, Index]:
        slave = self.slave
        k, K, m = slave.nodes.shape[1], slave.cell_nodes.shape[1], len(slave.nodes)
        s, t, omega = _square(order)
        xi, across = (np.broadcast_to(v, (m, len(s))) for v in (s, t))
        X_s, X_t = shape2(k, s, t, 1, 0) @ slave.X, shape2(k, s, t, 0, 1) @ slave.X
        c = np.cross(X_s, X_t)
        measure = np.linalg.norm(c, axis=-1)
        normal = slave.side[:, None, None] * c / measure[..., None]
        S = stress_rows(slave, np.arange(m), xi, across, normal, material.lmbda, material.mu)
        G = np.zeros((m, len(s), K, 3))
        G[np.arange(m)[:, None, None], np.arange(len(s))[:, None], slave.local[:, None]] = (
            -shape2(k, s, t)[None, ..., None] * normal[:, :, None]
        )
        G = np.concatenate([G.reshape(m, len(s), -1), np.zeros((m, len(s), S.shape[2] - 3 * K))], axis=2)
        cols = (3 * slave.cell_nodes[..., None] + np.arange(3)).reshape(m, -1)
        if slave.pressure_cols is not None:
            cols = np.concatenate([cols, slave.pressure_cols], axis=1)
        return G, S, measure * omega, cols

    def report(self, z: Array, points: Points, stress: Array, closed: np.ndarray) -> ContactState:
        assert isinstance(points, SurfacePoints)
        assert points.t is not None
        assert points.cosine is not None
        slave, k = self.slave, self.slave.nodes.shape[1]
        N = shape2(k, points.xi, points.t)
        x = (N @ slave.position(z)[points.facet]).reshape(-1, 3)
        X = (N @ slave.X[points.facet]).reshape(-1, 3)
        cos = points.cosine
        ray, normal = (-stress, -stress / cos) if self.ray else (-stress * cos, -stress)
        weight = self.copies * points.weight
        return ContactState(
            x, self.arc(X), points.gap.ravel(), normal.ravel(), ray.ravel(), weight.ravel(), closed.ravel()
        )

    def along(self, z: Array, points: Points) -> Array:
        assert isinstance(points, SurfacePoints)
        assert points.t is not None
        N = shape2(self.slave.nodes.shape[1], points.xi, points.t)
        return self._base(N @ self.slave.position(z)[points.facet])

    # -- facets ----------------------------------------------------------------------------------------------

    @property
    def lengths(self) -> Array:
        return self.slave.length

    def areas(self) -> Array:
        s, t, omega = _square(2)
        return np.asarray((self._measure(s, t) * omega).sum(axis=1))

    @cached_property
    def corners(self) -> Index:
        local = np.unique(self.slave.vertices, return_inverse=True)[1]
        return np.asarray(local.reshape(-1, 4), dtype=np.int64)

    def hats(self, points: Points) -> tuple[Array, Array]:
        assert isinstance(points, SurfacePoints)
        assert points.t is not None
        return shape2(4, points.xi, points.t), shape2(4, points.xi, points.t, 1, 0)

    def corner_weights(self) -> Array:
        s, t, omega = _square(3)
        out = np.zeros(int(self.corners.max()) + 1)
        np.add.at(out, self.corners, (self._measure(s, t) * omega) @ shape2(4, s, t))
        return out

    def along_corners(self, z: Array) -> Array:
        slave = self.slave
        x = np.empty((int(slave.nodes.max()) + 1, 3))
        x[slave.nodes] = slave.position(z)
        return self._base(x[np.unique(slave.vertices)])

    def _base(self, x: Array) -> Array:
        """The coordinate that the ray does not run along."""
        return np.asarray(x[..., 1] if self.axis == 0 else np.linalg.norm(x[..., [0, 2]], axis=-1))

    def least_gap(self, z: Array) -> float:
        x = self._distance(self.slave.position(z))
        die = self.die.points[:, self.axis] if isinstance(self.die, Revolved) else self._distance(self.die.position(z))
        return float(np.min(self.sign * die) - np.max(self.sign * x))

    def _distance(self, x: Array) -> Array:
        return np.asarray(np.linalg.norm(x[..., [0, 2]], axis=-1) if self.axis == 0 else x[..., 1])


def _square(order: int) -> tuple[Array, Array, Array]:
    """Gauss points and weights on the unit square."""
    s, omega = gauss(order)
    t, along = np.meshgrid(s, s, indexing="ij")
    return along.ravel(), t.ravel(), np.outer(omega, omega).ravel()
