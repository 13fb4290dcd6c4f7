"""A pair of surfaces that face each other, as the contact terms see it: points, gaps, stresses, columns of z.

`Pair` says what a term asks, in whichever dimension; `CurvePair` is that of two curves in a plane. A term knows
nothing of curves or surfaces, and a pair knows no law.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from extrusion.contact import CLOSED_GAP, Closure
from extrusion.elasticity import Elastic
from extrusion.gap import (
    Array,
    Index,
    Points,
    Surface,
    closest_rows,
    gauss,
    least_gap,
    ray_gap,
    ray_points,
    shape,
    stress_rows,
)

FAR = 0.1
"""A unilateral zone whose gap is nowhere below this (of the billet's radius) is left out until it closes."""


@dataclass(frozen=True)
class ContactState:
    """What a zone reports; row i is a contact point, in order along the slave."""

    x: Array  # (n, dim) current position, mm
    s: Array  # (n,) reference arc length along the slave surface (in 3D: of its meridian), mm
    gap: Array  # (n,) mm, positive when open
    pressure: Array  # (n,) normal to the die, MPa, positive when pressed
    ray_pressure: Array  # (n,) its component along the ray per reference area, MPa
    weight: Array  # (n,) integration weight, mm^2
    closed: np.ndarray = field(repr=False)  # (n,) bool


def closed_at_start(gap: Array, radius: float, interpenetrating: bool) -> np.ndarray:
    """Points that a bilateral zone holds from t = 0: gap zero, or also negative where the start may interpenetrate."""
    touching = np.abs(gap) < CLOSED_GAP * radius
    return touching | (gap < 0) if interpenetrating else touching


@dataclass(frozen=True)
class NodeRows:
    """The gap at the slave's nodes with the pairing held."""

    gap: Array  # (n,) mm
    G: Array  # (n, L) its derivative
    cols: Index  # (n, L) over these entries of z
    past: np.ndarray  # (n,) bool: faces the die's extension
    cos: Array  # (n,) of the angle between the die's normal and the ray
    facet: Index  # (n,) of the die


@dataclass(frozen=True, kw_only=True)
class Pair(ABC):
    """Two surfaces that face each other."""

    name: str
    slave: Any
    die: Any  # the master; the die unless the zone's roles are exchanged
    axis: int  # component along which the ray runs
    sign: float  # +1 if the master lies towards larger values of it
    closure: Closure
    ray: bool  # gap along the ray (else to the closest point)
    smooth: bool  # averaged normals (closest point)
    extended: bool  # the master's end lines go on past its ends; else a point there is let go

    dim = 2
    copies = 1  # of what is solved in the whole revolution

    # -- nodes -----------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def nodes(self) -> Index:
        """The slave's nodes, in order."""

    @property
    @abstractmethod
    def X(self) -> Array:
        """Their reference positions, ``shape=(n, dim)``, mm."""

    @abstractmethod
    def at_nodes(self, z: Array, keep: Index | None = None, which: Index | slice = slice(None)) -> NodeRows:
        """The gap at the slave's nodes, or which of these.

        ``keep`` are facets of an earlier pairing to stay with (`closest_points`).
        """

    def gaps(self, z: Array, which: Index) -> Array:
        """The gap at some of the slave's nodes, mm."""
        return self.at_nodes(z, which=which).gap

    @abstractmethod
    def nodal_weights(self) -> Array:
        """Integral of each node's shape function over the reference surface, mm^2 (or mm), in the nodes' order."""

    @abstractmethod
    def arc(self, X: Array) -> Array:
        """Arc length along the slave of points of it in order (`ContactState.s`), mm."""

    # -- points ----------------------------------------------------------------------------------------------

    @abstractmethod
    def points(
        self, z: Array, order: int, variation: bool, material: Elastic | None = None, keep: Index | None = None
    ) -> tuple[Points, Array | None, Callable[[], Array] | None]:
        """Integration points, rows of the slave's own stress there, and what gives their derivative along the facet.

        ``keep``: die facets to stay with, from `facing`, where points are not split at the facets' edges.
        """

    def part(self, facets: Index) -> Pair | None:
        """The same pair with the `points` of these slave facets alone; None if it gives only those of all."""
        return None

    def touches(self, z: Array, points: Points, radius: float, interpenetrating: bool) -> np.ndarray:
        """Which of points at the start a bilateral zone holds from then on."""
        return closed_at_start(points.gap, radius, interpenetrating)

    def facing(self, points: Points) -> Index | None:
        """The die facets that points face, if a gap that passes from one to the next has a kink there."""
        return None

    @abstractmethod
    def closed_rows(self, order: int, material: Elastic) -> tuple[Array, Array, Array, Index]:
        """Rows of the gap to a plane die, those of the stress, weights, and columns: ``(m, q, L)``, .., ``(m, L)``."""

    @abstractmethod
    def report(self, z: Array, points: Points, stress: Array, closed: np.ndarray) -> ContactState:
        """Report at integration points; ``stress`` is that conjugate to the gap, MPa."""

    @abstractmethod
    def along(self, z: Array, points: Points) -> Array:
        """Positions of the points along the die, by which a contact set is in order, mm."""

    # -- facets ----------------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def lengths(self) -> Array:
        """Size of each slave facet, ``shape=(m,)``, mm."""

    @abstractmethod
    def areas(self) -> Array:
        """Area of each slave facet (2 pi r ds in axisymmetry), mm^2, or its length, mm."""

    @property
    @abstractmethod
    def corners(self) -> Index:
        """Vertices of each slave facet, numbered among all of them: ``shape=(m, 2)``, in 3D ``(m, 4)``."""

    @abstractmethod
    def hats(self, points: Points) -> tuple[Array, Array]:
        """Linear functions of the facet's vertices at points, ``shape=(n, q, corners)``, and their xi derivatives."""

    @abstractmethod
    def corner_weights(self) -> Array:
        """Integral of each vertex's linear function over the reference surface, mm^2 or mm."""

    @abstractmethod
    def along_corners(self, z: Array) -> Array:
        """Positions of the vertices along the die, mm."""

    # -- common ----------------------------------------------------------------------------------------------

    @abstractmethod
    def least_gap(self, z: Array) -> float:
        """A lower bound of the ray gap, mm."""

    def is_far(self, z: Array, radius: float) -> bool:
        """Whether the surfaces are too far apart for contact, or for Nitsche's trial stress, whose k gap outweighs."""
        return self.ray and self.closure == "unilateral" and self.least_gap(z) > FAR * radius

    def displacement(self, z: Array, nodes: Index) -> Array:
        """Of some nodes, ``shape=(*nodes.shape, dim)``, mm."""
        return np.asarray(z[self.dim * nodes[..., None] + np.arange(self.dim)])

    @cached_property
    def tested(self) -> Index:
        """Local columns that the gap depends on, the facet's nodes and the die's, by slave facet: ``shape=(m, T)``."""
        slave, dim = self.slave, self.dim
        nodes = dim * slave.local[..., None] + np.arange(dim)
        n_u = dim * slave.cell_nodes.shape[1]
        die = np.arange(n_u, n_u + dim * self.die.nodes.shape[1] if len(self.die.nodes) else n_u)
        m = len(nodes)
        return np.concatenate([nodes.reshape(m, -1), np.broadcast_to(die, (m, len(die)))], axis=1)

    def gap_of(self, body: np.ndarray, points: Points) -> tuple[Array, Index]:
        """Derivative of the gap by one body's nodes, ``shape=(n, q, L)``, and their entries of z, ``shape=(n, L)``.

        Args:
            body: Which entries of z are of that body.
            points: At least one.
        """
        local = self.tested[points.facet]
        local = local[:, body[points.cols[0, local[0]]]]  # all points have one layout
        return np.take_along_axis(points.G, local[:, None], axis=2), np.take_along_axis(points.cols, local, axis=1)

    def forced(self, behind: bool = False) -> Index:
        """Entries of z that forces at the slave's facets (or in the cells behind them) and at the die's go to."""
        if self.closure == "check":
            return np.zeros(0, dtype=np.int64)
        slave = self.slave.cell_nodes if behind else self.slave.nodes
        nodes = np.concatenate([slave.ravel(), self.die.nodes.ravel()])
        entries = (self.dim * nodes[:, None] + np.arange(self.dim)).ravel()
        if behind and self.slave.pressure_cols is not None:
            entries = np.concatenate([entries, self.slave.pressure_cols.ravel()])
        return np.asarray(entries[np.sort(np.unique(entries, return_index=True)[1])])


@dataclass(frozen=True, kw_only=True)
class CurvePair(Pair):
    """Two curves in the plane; the gap along a ray or to the closest point (`extrusion.gap`)."""

    slave: Surface
    die: Surface
    axisymmetric: bool = True

    @property
    def direction(self) -> Array:
        """Unit vector along the ray, towards the master."""
        return self.sign * np.eye(2)[self.axis]

    @property
    def nodes(self) -> Index:
        return self.slave.node_numbers

    @property
    def X(self) -> Array:
        return self.slave.node_positions

    def at_nodes(self, z: Array, keep: Index | None = None, which: Index | slice = slice(None)) -> NodeRows:
        nodes = self.nodes[which]
        x = self.X[which] + self.displacement(z, nodes)
        if self.ray:
            return self._ray_rows(nodes, x, z)
        ones = np.ones((len(x), 1))
        found, gap, G, cols = closest_rows(nodes[:, None], ones, x, self.die, _even(z), self.smooth, keep)
        return NodeRows(gap, G, cols, found.past, np.abs(found.normal @ self.direction), found.facet)

    def gaps(self, z: Array, which: Index) -> Array:
        if not self.ray:
            return super().gaps(z, which)
        x = self.X[which] + self.displacement(z, self.nodes[which])
        return ray_gap(x, self.die, _even(z), self.axis, self.sign)[0]

    def _ray_rows(self, nodes: Index, x: Array, z: Array) -> NodeRows:
        p, c, sign, die = 1 - self.axis, self.axis, self.sign, self.die
        gap, slope, facet, k = ray_gap(x, die, _even(z), self.axis, sign)
        past = (k < -1e-9) | (k > 1 + 1e-9)
        weights = np.concatenate([-np.ones((len(x), 1)), shape(np.clip(k, 0.0, 1.0), die.nodes.shape[1])], axis=1)
        G = np.empty((*weights.shape, 2))
        G[..., c] = sign * weights
        G[..., p] = -sign * slope[:, None] * weights
        touched = np.concatenate([nodes[:, None], die.nodes[facet]], axis=1)
        cols = (2 * touched[..., None] + np.arange(2)).reshape(len(x), -1)
        return NodeRows(gap, G.reshape(len(x), -1), cols, past, 1 / np.sqrt(1 + slope**2), facet)

    def nodal_weights(self) -> Array:
        slave, (xi, omega) = self.slave, gauss(3)
        N = shape(xi, slave.nodes.shape[1])
        measure = slave.length[:, None] * omega * self._circumference(N @ slave.X[..., 0, None])
        out = np.zeros(self.nodes.max() + 1)
        np.add.at(out, slave.nodes, measure @ N)
        return np.asarray(out[self.nodes])

    def _circumference(self, r: Array) -> Any:
        return 2 * np.pi * r[..., 0] if self.axisymmetric else 1.0

    def arc(self, X: Array) -> Array:
        return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(X, axis=0), axis=1)))

    def points(
        self, z: Array, order: int, variation: bool, material: Elastic | None = None, keep: Index | None = None
    ) -> tuple[Points, Array | None, Callable[[], Array] | None]:
        slave = self.slave
        direction: Array = self.direction
        if self.ray:
            of = slave, self.die, _even(z), self.axis, self.sign, order, self.axisymmetric
            points = ray_points(*of)
        else:
            points, direction = self._closest_integration_points(z, order)
        if material is None:
            return points, None, None
        if slave.pressure_cols is not None:
            points = widened(points, slave.pressure_cols[points.facet])
        # S stands over the cell's displacements, then (mixed form) its pressures; the points over cell and die too
        n_die = 2 * self.die.nodes.shape[1]

        def rows(derivative: int) -> Array:
            of = slave, points.facet, points.xi, direction, material.lmbda, material.mu
            return stress_rows(*of, self.axisymmetric, derivative, n_die)

        return points, rows(0), partial(rows, 1) if variation and self.ray else None

    def _closest_integration_points(self, z: Array, order: int) -> tuple[Points, Array]:
        slave = self.slave
        xi, omega = gauss(order)
        m, K = slave.cell_nodes.shape
        N = np.broadcast_to(shape(xi, slave.nodes.shape[1]), (m, order, slave.nodes.shape[1]))
        x = (N @ (slave.X + self.displacement(z, slave.nodes))).reshape(-1, 2)
        measure = slave.length[:, None] * omega * self._circumference(N @ slave.X[..., 0, None])
        full = np.zeros((m, order, K))
        np.put_along_axis(full, np.broadcast_to(slave.local[:, None], N.shape), N, axis=2)
        behind = np.repeat(slave.cell_nodes, order, axis=0)
        found, gap, G, cols = closest_rows(behind, full.reshape(-1, K), x, self.die, _even(z), self.smooth)
        # every point is a piece of its own: its die facet differs from its neighbour's
        facet = np.repeat(np.arange(m), order)
        normal = found.normal
        slope = normal[:, 1 - self.axis] / np.where(normal[:, self.axis] == 0, 1e-300, normal[:, self.axis])
        points = Points(
            facet=facet, die=found.facet, cols=cols, xi=np.tile(xi, m)[:, None], weight=measure.reshape(-1, 1),
            gap=gap[:, None], G=G[:, None], slope=slope[:, None], past=found.past[:, None],
        )  # fmt: skip
        return points, -normal[:, None]

    def closed_rows(self, order: int, material: Elastic) -> tuple[Array, Array, Array, Index]:
        slave, K = self.slave, self.slave.cell_nodes.shape[1]
        xi, omega = gauss(order)
        facet = np.arange(len(slave.nodes))
        at = np.broadcast_to(xi, (len(facet), order))
        normal = slave.normal[:, None]
        S = stress_rows(slave, facet, at, normal, material.lmbda, material.mu, self.axisymmetric)
        G = np.zeros_like(S)
        N = shape(at, slave.nodes.shape[1])
        for component in (0, 1):
            where = np.broadcast_to(2 * slave.local[:, None] + component, N.shape)
            np.put_along_axis(G, where, -normal[..., component, None] * N, axis=2)
        radius = slave.X[:, :1, 0] + at * (slave.X[:, 1:2, 0] - slave.X[:, :1, 0])
        w = slave.length[:, None] * omega * self._circumference(radius[..., None])
        cols = (2 * slave.cell_nodes[..., None] + np.arange(2)).reshape(-1, 2 * K)
        if slave.pressure_cols is not None:
            cols = np.concatenate([cols, slave.pressure_cols], axis=1)
        return G, S, w, cols

    def report(self, z: Array, points: Points, stress: Array, closed: np.ndarray) -> ContactState:
        slave = self.slave
        x = shape(points.xi, slave.nodes.shape[1]) @ (slave.X + self.displacement(z, slave.nodes))[points.facet]
        start = np.append(0.0, np.cumsum(slave.length))
        s = start[points.facet][:, None] + points.xi * slave.length[points.facet][:, None]
        cos = 1 / np.sqrt(1 + points.slope**2)
        ray, normal = (-stress, -stress / cos) if self.ray else (-stress * cos, -stress)
        return ContactState(
            x.reshape(-1, 2),
            s.ravel(),
            points.gap.ravel(),
            normal.ravel(),
            ray.ravel(),
            points.weight.ravel(),
            closed.ravel(),
        )

    def along(self, z: Array, points: Points) -> Array:
        slave, c = self.slave, 1 - self.axis
        nodal = slave.X[..., c] + z[2 * slave.nodes + c]
        return np.asarray(np.einsum("nqi,ni->nq", shape(points.xi, slave.nodes.shape[1]), nodal[points.facet]))

    @property
    def lengths(self) -> Array:
        return self.slave.length

    def areas(self) -> Array:
        radius = self.slave.X[:, :2, 0].mean(axis=1)
        return np.asarray(self.slave.length * self._circumference(radius[:, None]))

    @property
    def corners(self) -> Index:
        start = np.arange(len(self.slave.nodes))
        return np.stack([start, start + 1], axis=1)

    def hats(self, points: Points) -> tuple[Array, Array]:
        return shape(points.xi, 2), shape(points.xi, 2, 1)

    def corner_weights(self) -> Array:
        slave, (xi, omega) = self.slave, gauss(2)
        radius = slave.X[:, :1, 0] + xi * (slave.X[:, 1:2, 0] - slave.X[:, :1, 0])
        measure = slave.length[:, None] * omega * self._circumference(radius[..., None])
        out = np.zeros(len(measure) + 1)
        np.add.at(out, self.corners, measure @ shape(xi, 2))
        return out

    def along_corners(self, z: Array) -> Array:
        slave, c = self.slave, 1 - self.axis
        at = slave.X[:, :2, c] + z[2 * slave.nodes[:, :2] + c]
        return np.append(at[:, 0], at[-1:, 1])

    def least_gap(self, z: Array) -> float:
        return least_gap(self.slave, self.die, z, self.axis, self.sign)


def _even(z: Array) -> Array:
    """The contact vector cut to an even length, so that it reads as pairs (multipliers stand at its end)."""
    return z[: len(z) - len(z) % 2]


def take[P: Points](points: P, on: np.ndarray) -> P:
    """Some of the pieces."""
    values = {name: value[on] if isinstance(value, np.ndarray) else value for name, value in vars(points).items()}
    values["curvature"] = tuple((a[on], b[on]) for a, b in points.curvature)
    return type(points)(**values)


def widened[P: Points](points: P, cols: Index) -> P:
    """The points with further local columns, on which gap and weights do not depend."""

    def wide(rows: Array | None) -> Array | None:
        return None if rows is None else np.pad(rows, ((0, 0), (0, 0), (0, cols.shape[1])))

    values = vars(points) | {name: wide(getattr(points, name)) for name in ("G", "G_xi", "dxi", "dweight")}
    values["cols"] = np.concatenate([points.cols, cols], axis=1)
    values["curvature"] = tuple((wide(a), wide(b)) for a, b in points.curvature)
    return type(points)(**values)
