"""The contact term of one zone: points of the slave surface, a gap, a law and a closure.

A term works on the *contact vector* z: the displacements of all nodes that contact can touch, then the multipliers.
It adds to the residual ``G^T (w sigma_n)`` and what the law asks for, and gives the exact derivative. Two states:
`accept` moves the accepted one (the bilateral memory); residuals and tangents only read it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from mpi4py import MPI

import numpy as np

from extrusion.contact import project
from extrusion.elasticity import Elastic
from extrusion.gap import Array, Index, Points
from extrusion.integrand import Integrand
from extrusion.pairs import ContactState, Pair, closed_at_start, take

Triplets = tuple[Index, Index, Array]


class ContactTerm(Protocol):
    """What the problem asks of a zone."""

    pair: Pair
    multipliers: int
    forced: Index  # displacements (and pressures) in z that the term can put a force on, in order along slave and die
    caught: float  # mm: how far from the die the farthest point was that the last `start` or `accept` closed for good

    @property
    def divided(self) -> bool:
        """Whether each rank evaluates a part of the slave's facets."""

    def divide(self, comm: MPI.Intracomm) -> bool:
        """From now on add to residual and tangent what this rank's part of the slave's facets does, and say if so.

        What looks at contact points is collective then. On one rank, or if it cannot: what all facets do.
        """

    def start(self, z: Array) -> None:
        """Set the accepted state at t = 0 from the gap there."""

    def pair_up(self, z: Array, settle: bool = False, before: Array | None = None) -> None:
        """Freeze what the term freezes of the geometry (nothing, for terms that follow it).

        ``settle``: let points that rest on a die vertex stay with the facet they had, or between two; ``before``: pair
        halfway between z and this.
        """

    def settled(self, z: Array) -> bool:
        """Whether what `pair_up` settled still holds at z."""

    def add_residual(self, z: Array, R: Array) -> None:
        """Add the term's forces (N) to R."""

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        """Derivative of the residual as (rows, columns, values); ``geometric`` adds the second variation of the gap."""

    def hold(self, z: Array | None) -> None:
        """Near the solution: stay with the die facets that are faced at z, where they are not split; None: let go."""

    def soften(self, share: float) -> None:
        """Take this part of the contact stiffness from now on (nothing, where the constraint is exact)."""

    def stiff(self, z: Array, body: np.ndarray) -> tuple[Triplets, Array]:
        """What the closed gap's penalty would add to one body's tangent, and that penalty of each multiplier.

        ``body``: which entries of z are of that body.
        """

    def accept(self, z: Array) -> None:
        """Make z the accepted state."""

    def expect(self, ahead: float | None) -> bool:
        """Take the contact set that is expected for given (`Expected.expect`), and say if there is one.

        ``ahead``: this increment over the last; 0: it goes on, with another pairing; None: expect nothing any more.
        """

    def follow(self, found: ContactSet) -> None:
        """Take this contact set for given, until the next `expect`; nodal contact does not."""

    def contact_set(self, z: Array) -> ContactSet:
        """What is closed at z; nothing, of nodal contact."""

    def state(self, z: Array) -> ContactState:
        """Report at z."""

    def stiffness_norm(self) -> float:
        """Norm of force over gap, N/mm: how much round-off in a position weighs in the residual."""


@dataclass(frozen=True)
class ContactSet:
    """The closed stretches of a zone, by where along the die they begin and end."""

    first: bool  # whether what lies before all edges is closed
    edges: Array  # in order, mm

    @classmethod
    def of(cls, at: Array, trial: Array, closed: np.ndarray) -> ContactSet:
        """From positions in any order, their trial stress and whether they are closed.

        An edge stands where the trial stress, linear between the two points beside it, vanishes.
        """
        order = np.argsort(at, axis=None, kind="stable")
        at, closed, size = (a.ravel()[order] for a in (at, closed, np.abs(trial)))
        i = np.flatnonzero(closed[1:] != closed[:-1])
        share = size[i] / np.maximum(size[i] + size[i + 1], np.finfo(float).tiny)
        return cls(bool(closed[0]), at[i] + share * (at[i + 1] - at[i]))

    @property
    def empty(self) -> bool:
        """Whether nothing is closed."""
        return not self.first and not len(self.edges)

    def __call__(self, at: Array) -> np.ndarray:
        """Whether positions are closed."""
        return np.asarray((np.searchsorted(self.edges, at) % 2 == 1) != self.first)

    def partners(self, other: ContactSet) -> Array:
        """For each edge of another set the nearest one here of the same kind, to which it is the nearest; or NaN."""
        out = np.full(len(other.edges), np.nan)
        for closes in (True, False):
            here, there = (np.flatnonzero((np.arange(len(of.edges)) % 2 == of.first) == closes) for of in (self, other))
            if len(here) and len(there):
                apart = np.abs(self.edges[here, None] - other.edges[there])
                nearest = np.argmin(apart, axis=0)
                mutual = np.argmin(apart, axis=1)[nearest] == np.arange(len(there))
                out[there[mutual]] = self.edges[here[nearest[mutual]]]
        return out


MOST_AHEAD = 4.0
"""How many times their last change edges are moved on at most."""


class Expected:
    """The contact set that an increment is expected to end with: the accepted one, its edges moved on as they did last.

    Where an edge is new, or edges would pass each other, the accepted set only keeps closed what it holds; else the set
    keeps the rest open, too.
    """

    def __init__(self) -> None:
        self._accepted: ContactSet | None = None
        self._before: ContactSet | None = None
        self._now: ContactSet | None = None
        self._known = False

    def accept(self, found: ContactSet) -> None:
        """Take the set of an accepted step."""
        self._before, self._accepted = self._accepted, None if found.empty else found

    def follow(self, found: ContactSet) -> None:
        """Expect this set."""
        self._now, self._known = found, True

    def expect(self, ahead: float | None) -> bool:
        """Expect a set, its edges moved on by so many times their last change, and say if there is one.

        None: expect nothing any more.
        """
        now, before, self._known = self._accepted if ahead is not None else None, self._before, False
        # the start has an edge at every other point that rests on the die
        if now is not None and before is not None and len(before.edges) <= len(now.edges) + 2:
            change = now.edges - before.partners(now)
            edges = now.edges + min(ahead or 0.0, MOST_AHEAD) * change
            self._known = bool(np.all(np.diff(edges) >= 0)) and not np.isnan(edges).any()
            if self._known:
                now = ContactSet(now.first, edges)
        self._now = now
        return now is not None

    @property
    def on(self) -> bool:
        """Whether a set is expected."""
        return self._now is not None

    def law(self, trial: Array, at: Array, held: np.ndarray | None) -> tuple[Array, Array]:
        """As `extrusion.contact.project`, of points at these places along the die, with the set that is expected.

        ``held``: points that a bilateral closure holds, a shape that broadcasts to that of the trial stress.
        """
        assert self._now is not None
        closed = self._now(at)
        if held is not None:
            closed |= held
        if not self._known:
            closed |= trial < 0.0
        return np.where(closed, trial, 0.0), closed.astype(float)


@dataclass(frozen=True)
class _Frozen:
    """A pairing of nodes: the gap and its derivative, linear in z."""

    facet: Index
    cols: Index  # (n, L)
    G: Array  # (n, L)
    g0: Array  # (n,) mm
    z: Array  # where it was made: the solution with the pairing before

    def gap(self, z: Array, which: Index | slice = slice(None)) -> Array:
        """Of all nodes, or of some, mm."""
        return np.asarray(self.g0[which] + np.einsum("nl,nl->n", self.G[which], z[self.cols[which]]))


RESTING = 1e-12
"""Gap (of the billet's radius) up to which a node without force is open, whatever round-off makes of the gap's sign."""


class _Resting:
    """Nodes at a vertex of the die that either facet there would push over to the other one.

    What keeps such a node at the vertex is a force between the facets' normals: it takes both facets' rows, in a
    proportion that is found pass by pass, by false position.

    Args:
        node: The nodes.
        first: The pairing with one facet.
        second: That with the other, made at the solution with the first.
        z: The solution with the second.
    """

    def __init__(self, node: Index, first: _Frozen, second: _Frozen, z: Array) -> None:
        # the gaps' difference vanishes at the vertex, and has a sign for either side of it
        ends = np.array([second.gap(at, node) - first.gap(at, node) for at in (second.z, z)])
        between = ends[0] * ends[1] < 0.0
        self.node = node[between]
        self._both = [(of.cols[self.node], of.G[self.node], of.g0[self.node]) for of in (first, second)]
        self._share, self._off = np.zeros((2, len(self.node))), ends[:, between]
        self._share[1] = 1.0

    def tell(self, z: Array) -> None:
        """Take a solution with the rows."""
        gap = [g0 + np.einsum("nl,nl->n", G, z[cols]) for cols, G, g0 in self._both]
        off = gap[1] - gap[0]
        end = np.where(off * self._off[0] > 0, 0, 1), np.arange(len(off))
        self._share[end], self._off[end] = self.share, off

    @property
    def share(self) -> Array:
        """Part of the second facet."""
        (a, b), (u, v) = self._share, self._off
        return np.asarray(a + (b - a) * u / (u - v))

    def rows(self) -> tuple[Index, Array, Array]:
        """Columns, derivative and gap at z = 0."""
        (cols, G, g0), (more_cols, more_G, more_g0) = self._both
        part = self.share
        both = np.concatenate([(1 - part)[:, None] * G, part[:, None] * more_G], axis=1)
        return np.concatenate([cols, more_cols], axis=1), both, (1 - part) * g0 + part * more_g0


class NodalContact:
    """Exact constraint at the slave nodes by an active set, one multiplier (N, whole revolution) a node.

    The pairing (die facet, place and normal) is frozen by `pair_up`; between two of these the problem is a linear
    complementarity problem, and its semismooth Newton iteration a primal-dual active set (Hintermüller, Ito,
    Kunisch 2002, doi:10.1137/S1052623401383558)::

        trial = lambda + kappa g;  residual  K u - f + G^T lambda,  min(trial, 0) - lambda

    A node that flips between two facets of the die rests on the vertex between them (`_Resting`).
    """

    divided = False

    def __init__(self, pair: Pair, first: int, stiffness: Array, radius: float, interpenetrating: bool = False) -> None:
        self.pair = pair
        self.nodes, self.X, self.weight = pair.nodes, pair.X, pair.nodal_weights()
        self.multipliers = 0 if pair.closure == "check" else len(self.nodes)
        self.forced = pair.forced()
        self.at = first + np.arange(self.multipliers)
        self._kappa = np.full(len(self.nodes), float(np.mean(stiffness) * np.mean(np.abs(self.weight))))
        self._radius, self._interpenetrating = radius, interpenetrating
        self.closed, self.caught = np.zeros(len(self.nodes), dtype=bool), 0.0
        self._pairings: list[_Frozen] = []  # the last, and the one before
        self._resting: list[_Resting] = []
        self._last: np.ndarray | None = None  # nodes that the last pairing's solve left closed
        self._expects = False

    def divide(self, comm: MPI.Intracomm) -> bool:
        return False

    def start(self, z: Array) -> None:
        self.pair_up(z)
        gap = self._g0 + self._apply(z)
        self.closed = closed_at_start(gap, self._radius, self._interpenetrating)
        self.caught = _farthest(gap, self.closed)

    def pair_up(self, z: Array, settle: bool = False, before: Array | None = None) -> None:
        self._last = self._law(z)[2] > 0 if self.multipliers and self._pairings else None
        at = z if before is None else (z + before) / 2
        found = self.pair.at_nodes(at, self._pairings[-1].facet if settle else None)
        self._past, self._cos = found.past, found.cos
        self._G, self._cols = found.G, found.cols
        self._g0 = found.gap - self._apply(at)
        now = _Frozen(found.facet, found.cols, found.G, self._g0, z.copy())
        if settle:
            self._rest(now, z)
        else:
            self._resting = []
        self._pairings = [*self._pairings[-1:], now]

    def _rest(self, now: _Frozen, z: Array) -> None:
        """Keep nodes at their vertex that have flipped back and forth."""
        for resting in self._resting:
            resting.tell(z)
        if len(self._pairings) == 2:
            first, second = self._pairings
            flips = (now.facet == first.facet) & (now.facet != second.facet)
            for resting in self._resting:
                flips[resting.node] = False
            new = _Resting(np.flatnonzero(flips), first, second, z)
            self._resting += [new] if len(new.node) else []
        if self._resting:
            self._G = np.concatenate([self._G, np.zeros_like(self._G)], axis=1)
            self._cols, self._g0 = np.concatenate([self._cols, self._cols], axis=1), self._g0.copy()
        for resting in self._resting:
            self._cols[resting.node], self._G[resting.node], self._g0[resting.node] = resting.rows()

    def settled(self, z: Array) -> bool:
        return True

    def hold(self, z: Array | None) -> None:
        pass

    def soften(self, share: float) -> None:
        pass

    def expect(self, ahead: float | None) -> bool:
        # across an increment other nodes come to lie where the die is met; from pass to pass they are the same
        self._expects = ahead == 0.0 and self._last is not None
        return self._expects

    def follow(self, found: ContactSet) -> None:
        pass

    def contact_set(self, z: Array) -> ContactSet:
        return ContactSet(False, np.zeros(0))

    def stiffness_norm(self) -> float:
        return float(np.linalg.norm(self._kappa)) if self.multipliers else 0.0

    def _apply(self, z: Array) -> Array:
        return np.einsum("nl,nl->n", self._G, z[self._cols])

    def _law(self, z: Array) -> tuple[Array, Array, Array]:
        lam = z[self.at]
        gap = self._g0 + self._apply(z)
        trial = lam + self._kappa * gap
        if self.pair.closure == "unilateral":
            rest = RESTING * self._radius
            trial[(np.abs(gap) < rest) & (np.abs(lam) < 0.01 * self._kappa * rest)] = 0.0
        if self._expects and self._last is not None:
            sc, dsc = np.where(self._last, trial, 0.0), self._last.astype(float)
        else:
            sc, dsc = project(trial, self.pair.closure, self.closed)
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

    def stiff(self, z: Array, body: np.ndarray) -> tuple[Triplets, Array]:
        if not self.multipliers:
            return _none(), self._kappa[:0]
        _, _, dsc = self._law(z)
        of = body[self._cols[0]]  # all rows have one layout
        cols, G = self._cols[:, of], self._G[:, of]
        return _triplets(cols, cols, np.einsum("n,ni,nj->nij", dsc * self._kappa, G, G)), self._kappa

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
        x = self.X + self.pair.displacement(z, self.nodes)
        gap = self._g0 + self._apply(z)
        if self.multipliers:
            gap, sc, dsc = self._law(z)
            closed = dsc > 0
        else:
            sc, closed = np.zeros(len(x)), gap < 0
        with np.errstate(divide="ignore", invalid="ignore"):
            stress = np.where(np.abs(self.weight) > 1e-9 * np.max(self.weight), -sc / self.weight, np.nan)
        normal = stress / self._cos if self.pair.ray else stress
        weight = self.pair.copies * self.weight
        return ContactState(x, self.pair.arc(self.X), gap, normal, normal * self._cos, weight, closed)


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
        self.pair, self._stiffness, self._material, self._theta = pair, stiffness, material, theta
        self.soften(1.0)
        self.forced = pair.forced(behind=bool(theta) and material is not None)
        self._radius, self._interpenetrating, self._order = radius, interpenetrating, order
        self.closed, self.caught = np.zeros(len(pair.slave.nodes), dtype=bool), 0.0
        self._expected = Expected()
        self._is_far = _Latest(lambda z: pair.is_far(z, radius))
        self._held: Index | None = None
        self.divide(MPI.COMM_SELF)

    def divide(self, comm: MPI.Intracomm) -> bool:
        mine = None
        if 1 < comm.size <= len(self.closed):  # no part is empty
            mine = self.pair.part(np.arange(comm.rank, len(self.closed), comm.size))  # what is closed is in one place
        self._comm, self._mine = (MPI.COMM_SELF, self.pair) if mine is None else (comm, mine)
        self._points = _Latest(self._find)
        return self.divided

    @property
    def divided(self) -> bool:
        return self._comm.size > 1

    def _of_all(self, facet: Index, *rows: np.ndarray) -> tuple[np.ndarray, ...]:
        """Rows that belong to facets, of all ranks and in the facets' order."""
        if not self.divided:
            return rows
        facet, *rows_ = (np.concatenate(part) for part in zip(*self._comm.allgather((facet, *rows)), strict=True))
        order = np.argsort(facet, kind="stable")
        return tuple(row[order] for row in rows_)

    def hold(self, z: Array | None) -> None:
        self._held = None if z is None or self._is_far(z) else self.pair.facing(self._points(z).points)

    def soften(self, share: float) -> None:
        self._k = share * self._stiffness

    def start(self, z: Array) -> None:
        self._expected = Expected()
        points = self._points(z).points
        held = self.pair.touches(z, points, self._radius, self._interpenetrating)
        self.closed = self._whole_facets(points, held)
        self._catch(points, self.closed)

    def pair_up(self, z: Array, settle: bool = False, before: Array | None = None) -> None:
        pass

    def settled(self, z: Array) -> bool:
        return True

    def expect(self, ahead: float | None) -> bool:
        return self._expected.expect(ahead)

    def follow(self, found: ContactSet) -> None:
        self._expected.follow(found)

    def contact_set(self, z: Array) -> ContactSet:
        integrand = self._points(z)
        points, trial = integrand.points, integrand.trial(z, self._k)[1]
        closed = self._stress(z, points, trial)[1] > 0
        if not self.pair.extended:
            closed &= ~points.past
        return ContactSet.of(*self._of_all(points.facet, self.pair.along(z, points), trial, closed))

    def _catch(self, points: Points, new: np.ndarray) -> None:
        self.caught = _farthest(points.gap, new[points.facet])
        if self.divided:
            self.caught = self._comm.allreduce(self.caught, op=MPI.MAX)

    def stiffness_norm(self) -> float:
        if self.pair.closure == "check":
            return 0.0
        k, weight = self._k, self.pair.areas()
        if self._material is not None:  # the slave's own stress, M / h a displacement, stands beside k times the gap
            own = (self._material.lmbda + 2 * self._material.mu) / self.pair.lengths / k
            k = k * (1 + own + abs(self._theta) * own**2)
        return float(np.linalg.norm(k * weight))

    def _whole_facets(self, points: Points, held: np.ndarray) -> np.ndarray:
        """Facets of which all points are held; it says nothing of other ranks' facets."""
        every = np.ones(len(self.closed), dtype=bool)
        np.logical_and.at(every, points.facet, held.all(axis=1))
        return every

    def _find(self, z: Array) -> Integrand:
        found, lost = None, ""
        try:
            found = self._mine.points(z, self._order, self.pair.closure != "check", self._material, self._held)
        except ArithmeticError as error:
            lost = str(error)
        if self.divided:
            told = [message for one, message in self._comm.allgather((found is None, lost)) if one]
            found, lost = (None, told[0]) if told else (found, "")
        if found is None:
            raise ArithmeticError(lost)
        return Integrand(*found)

    def _law(self, z: Array, integrand: Integrand) -> tuple[Array, Array, Array]:
        """The slave's own stress, the contact stress, and its derivative by the trial stress."""
        points = integrand.points
        own, trial = integrand.trial(z, self._k)
        sc, dsc = self._stress(z, points, trial)
        if not self.pair.extended:
            sc, dsc = np.where(points.past, 0.0, sc), np.where(points.past, 0.0, dsc)
        return own, sc, dsc

    def _stress(self, z: Array, points: Points, trial: Array) -> tuple[Array, Array]:
        """The contact stress, and its derivative by the trial stress."""
        held = self.closed[points.facet][:, None]
        if not self._expected.on:
            return project(trial, self.pair.closure, held)
        along = self.pair.along(z, points)
        return self._expected.law(trial, along, held if self.pair.closure == "bilateral" else None)

    def add_residual(self, z: Array, R: Array) -> None:
        if self.pair.closure == "check" or (not self._theta and self._is_far(z)):
            return
        integrand = self._points(z)
        points = integrand.points
        own, sc, _ = self._law(z, integrand)
        consistent = None
        if self._theta and self._material is not None:
            consistent = points.weight * self._theta / self._k[points.facet][:, None] * (sc - own)
        integrand.add_forces(points.weight * sc, consistent, R)

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        if self.pair.closure == "check" or (not self._theta and self._is_far(z)):
            return _none()
        integrand = self._points(z)
        law = self._law(z, integrand)
        return integrand.tangent(z, self._k, *law, self._theta, geometric, self.pair.tested)

    def stiff(self, z: Array, body: np.ndarray) -> tuple[Triplets, Array]:
        if self.pair.closure == "check" or self._is_far(z):
            return _none(), np.zeros(0)
        integrand = self._points(z)
        points, dsc = integrand.points, self._law(z, integrand)[2]
        on = (dsc > 0).any(axis=1)
        if not on.any():
            return _none(), np.zeros(0)
        G, cols = self.pair.gap_of(body, take(points, on))
        w = (points.weight * dsc * self._k[points.facet][:, None])[on]
        return _triplets(cols, cols, np.swapaxes(w[..., None] * G, 1, 2) @ G), np.zeros(0)

    def closed_edge(self) -> tuple[Triplets, Array]:
        """What the symmetric method (theta = 1) adds to the bulk with every facet closed against a plane die.

        Returns:
            Triplets of ``G^T w S + S^T w G``, and the values of ``G^T w k G`` at the same places.
        """
        assert self._material is not None
        G, S, w, cols = self.pair.closed_rows(self._order, self._material)
        GS = np.einsum("nq,nqi,nqj->nij", w, G, S)
        GG = np.einsum("nq,nqi,nqj->nij", w * self._k[:, None], G, G)
        rows = np.broadcast_to(cols[:, :, None], GS.shape).ravel()
        across = np.broadcast_to(cols[:, None, :], GS.shape).ravel()
        return (rows, across, (GS + np.swapaxes(GS, 1, 2)).ravel()), GG.ravel()

    def accept(self, z: Array) -> None:
        if self.pair.closure == "check":
            return
        if self.pair.closure == "unilateral":
            self._expected.accept(self.contact_set(z))
        else:
            integrand = self._points(z)
            points, dsc = integrand.points, self._law(z, integrand)[2]
            before = self.closed
            self.closed = before | self._whole_facets(points, dsc > 0)
            self._catch(points, self.closed & ~before)

    def state(self, z: Array) -> ContactState:
        integrand = self._points(z)
        points = integrand.points
        _, sc, dsc = self._law(z, integrand)
        closed = points.gap < 0 if self.pair.closure == "check" else dsc > 0
        mine = self.pair.report(z, points, sc, closed)
        return ContactState(*self._of_all(np.repeat(points.facet, points.gap.shape[1]), *vars(mine).values()))


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
    divided = False

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
        self.forced = pair.forced()
        self._total, self._ends = pair.corner_weights(), pair.corners
        n = len(self._total)
        sharing = np.bincount(self._ends.ravel(), minlength=n)
        k = np.broadcast_to(stiffness[:, None], self._ends.shape).ravel()
        self._k = np.bincount(self._ends.ravel(), k, n) / sharing  # mean of the facets at a vertex
        self.multipliers = 0 if pair.closure == "check" else n
        self.at = first + np.arange(self.multipliers)
        self._radius, self._interpenetrating = radius, interpenetrating
        self.closed, self.caught = np.zeros(n, dtype=bool), 0.0
        self._settled: np.ndarray | None = None  # rows let go, where that is not left to each iterate
        self._expected = Expected()
        self._is_far = _Latest(lambda z: pair.is_far(z, radius))
        self._points = _Latest(self._find)
        self._held: Index | None = None

    def divide(self, comm: MPI.Intracomm) -> bool:
        return False

    def hold(self, z: Array | None) -> None:
        self._held = None if z is None or self._is_far(z) else self.pair.facing(self._points(z))

    def soften(self, share: float) -> None:
        pass

    def start(self, z: Array) -> None:
        self._expected = Expected()
        points = self._points(z)
        held = self.pair.touches(z, points, self._radius, self._interpenetrating)
        self.closed[:] = True
        ends = self._ends[points.facet]
        np.logical_and.at(self.closed, ends, held.all(axis=1)[:, None])
        self.caught = _farthest(points.gap, self.closed[ends].all(axis=1))

    def pair_up(self, z: Array, settle: bool = False, before: Array | None = None) -> None:
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

    def _find(self, z: Array) -> Points:
        return self.pair.points(z, self._order, self.pair.closure != "check", keep=self._held)[0]

    def stiffness_norm(self) -> float:
        return float(np.linalg.norm(self._k * self._total)) if self.multipliers else 0.0

    def _rows(self, points: Points) -> tuple[Array, Array, Array]:
        """Weak gap (mm^3) of each row, the share of its weight that faces the die, and the point weights that count."""
        w = points.weight if self.pair.extended else np.where(points.past, 0.0, points.weight)
        weak, facing = np.zeros(len(self.closed)), np.zeros(len(self.closed))
        psi, ends = self.pair.hats(points)[0], self._ends[points.facet]
        np.add.at(weak, ends, np.einsum("nq,nqk->nk", w * points.gap, psi))
        np.add.at(facing, ends, np.einsum("nq,nqk->nk", w, psi))
        return weak, facing / self._total, w

    def _pressure(self, points: Points, lam: Array) -> Array:
        """The multiplier at points, MPa."""
        return np.asarray(np.einsum("nqk,nk->nq", self.pair.hats(points)[0], lam[self._ends[points.facet]]))

    def _law(self, z: Array, points: Points) -> tuple[Array, Array, Array]:
        weak, share, w = self._rows(points)
        trial = self._total * z[self.at] + self._k * weak
        if self._expected.on:
            held = self.closed if self.pair.closure == "bilateral" else None
            sc, dsc = self._expected.law(trial, self.pair.along_corners(z), held)
        else:
            sc, dsc = project(trial, self.pair.closure, self.closed)
        free = self._free(share)
        return np.where(free, 0.0, sc), np.where(free, 0.0, dsc), w

    def add_residual(self, z: Array, R: Array) -> None:
        if not self.multipliers:
            return
        if self._is_far(z):
            R[self.at] -= self._total * z[self.at]
            return
        points = self._points(z)
        sc, _, w = self._law(z, points)
        lam = z[self.at]
        p = self._pressure(points, lam)
        np.add.at(R, points.cols, np.einsum("nq,nql->nl", w * p, points.G))
        R[self.at] += sc - self._total * lam

    def tangent(self, z: Array, geometric: bool) -> Triplets:
        if not self.multipliers:
            return _none()
        if self._is_far(z):
            return self.at, self.at, -self._total
        points = self._points(z)
        _, dsc, w = self._law(z, points)
        lam = z[self.at]
        ends = self._ends[points.facet]
        on = ((dsc > 0) | (lam != 0))[ends].any(axis=1)
        points, w, ends = take(points, on), w[on], ends[on]
        psi, psi_xi = self.pair.hats(points)
        n, q, n_u = points.G.shape
        p = (psi * lam[ends][:, None]).sum(axis=-1)
        row = (self._k * dsc)[ends][:, None]

        def pad(u: Array | None, multiplier: Array | None) -> Array:
            out = np.zeros((n, q, n_u + ends.shape[1]))
            if u is not None:
                out[..., :n_u] = u
            if multiplier is not None:
                out[..., n_u:] = multiplier
            return out

        d_gap, weighted_row = points.G, w[..., None] * psi * row
        exact = geometric and points.dxi is not None
        if points.dxi is not None and points.gap_xi is not None and exact:
            d_gap = points.G + points.gap_xi[..., None] * points.dxi
        left = [pad(w[..., None] * points.G, None), pad(None, weighted_row)]
        right = [pad(None, psi), pad(d_gap, None)]
        if exact and points.dxi is not None and points.G_xi is not None and points.dweight is not None:
            counts = (w != 0)[..., None] * points.dweight
            wp = (w * p)[..., None]
            p_xi = (psi_xi * lam[ends][:, None]).sum(axis=-1)[..., None]
            slope = psi_xi * row * (w * points.gap)[..., None]
            left += [
                pad(p[..., None] * points.G, psi * row * points.gap[..., None]),
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

    def expect(self, ahead: float | None) -> bool:
        return self._expected.expect(ahead)

    def follow(self, found: ContactSet) -> None:
        self._expected.follow(found)

    def contact_set(self, z: Array) -> ContactSet:
        points = self._points(z)
        trial = self._total * z[self.at] + self._k * self._rows(points)[0]
        return ContactSet.of(self.pair.along_corners(z), trial, self._law(z, points)[1] > 0)

    def stiff(self, z: Array, body: np.ndarray) -> tuple[Triplets, Array]:
        import scipy.sparse

        kappa = self._k / self._total
        if not self.multipliers or self._is_far(z):
            return _none(), kappa[: self.multipliers]
        points = self._points(z)
        _, dsc, w = self._law(z, points)
        psi = self.pair.hats(points)[0] * (w[..., None] * (dsc > 0)[self._ends[points.facet]][:, None])
        G, cols = self.pair.gap_of(body, points)
        weak = np.swapaxes(psi, 1, 2) @ G  # rows of the weak gap, piece by piece
        rows = np.broadcast_to(self._ends[points.facet][..., None], weak.shape)
        shape = len(self.closed), int(cols.max()) + 1
        cols = np.broadcast_to(cols[:, None], weak.shape)
        B = scipy.sparse.coo_array((weak.ravel(), (rows.ravel(), cols.ravel())), shape=shape).tocsr()
        J = (B.T @ scipy.sparse.diags_array(kappa) @ B).tocoo()
        return (J.row.astype(np.int64), J.col.astype(np.int64), J.data), kappa

    def accept(self, z: Array) -> None:
        if self.multipliers and self.pair.closure == "unilateral":
            self._expected.accept(self.contact_set(z))
        if self.multipliers and self.pair.closure == "bilateral":
            points, before = self._points(z), self.closed
            self.closed = (before | (self._law(z, points)[1] > 0)) & ~self._free(self._rows(points)[1])
            new = self.closed & ~before
            self.caught = _farthest(points.gap, new[self._ends[points.facet]].all(axis=1))

    def state(self, z: Array) -> ContactState:
        points = self._points(z)
        stress, closed = np.zeros_like(points.gap), points.gap < 0
        if self.multipliers:
            lam, dsc = z[self.at], self._law(z, points)[1]
            stress = self._pressure(points, lam)
            if not self.pair.extended:
                stress = np.where(points.past, 0.0, stress)  # as `_rows` weighs it
            nearest = np.argmax(self.pair.hats(points)[0], axis=-1)
            closed = np.take_along_axis(dsc[self._ends[points.facet]], nearest, axis=1) > 0
        return self.pair.report(z, points, stress, closed)


class _Latest[T]:
    """A function of z that remembers its last value: a residual is mostly followed by the tangent at the same z."""

    def __init__(self, function: Callable[[Array], T]) -> None:
        self._function = function
        self._last: tuple[bytes, T] | None = None

    def __call__(self, z: Array) -> T:
        at = z.tobytes()
        if self._last is None or self._last[0] != at:
            self._last = at, self._function(z)
        return self._last[1]


def _farthest(gap: Array, of: np.ndarray) -> float:
    """Largest distance from the die among some points, mm."""
    return float(np.max(np.abs(gap[of]), initial=0.0))


def _triplets(rows: Index, cols: Index, J: Array) -> Triplets:
    """Blocks over some rows and columns as (rows, columns, values)."""
    return (
        np.broadcast_to(rows[:, :, None], J.shape).ravel(),
        np.broadcast_to(cols[:, None, :], J.shape).ravel(),
        J.ravel(),
    )


def _none() -> Triplets:
    return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
