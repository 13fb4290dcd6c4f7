"""What load stepping and Newton's method ask of a scene, in whichever unknowns it is solved."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from extrusion.cases import Case
from extrusion.gap import Array, Index
from extrusion.pairs import ContactState
from extrusion.zones import ContactSet, ContactTerm, MortarContact, Triplets


@dataclass(frozen=True)
class Forecast:
    """What is known beforehand of the end of an increment (`extrusion.guide`)."""

    entries: Index  # of the contact vector, displacements
    values: Array  # these, mm
    closed: list[ContactSet]  # of each zone
    ahead: float = 1.0  # the increment over the last one, if it cannot be had


class System(ABC):
    """Two bodies and their contact zones; the unknown x is a vector of which every system has its own kind.

    All methods are collective. The contact vector z (displacements of all nodes that contact can touch, pressures
    and multipliers there) is the same for all systems.
    """

    case: Case
    comm: MPI.Intracomm
    terms: list[ContactTerm]
    x: PETSc.Vec
    n_z: int
    n_multipliers: int
    pairing = 0.0  # s, spent so far in finding contact points and evaluating the terms

    # -- unknowns --------------------------------------------------------------------------------------------

    @abstractmethod
    def gather(self, x: PETSc.Vec) -> Array:
        """The contact vector z of x, on every rank."""

    @abstractmethod
    def drive(self, x: PETSc.Vec, t: float) -> None:
        """Set the supports' values at rear displacement t, mm."""

    @abstractmethod
    def shift_billet(self, x: PETSc.Vec, dt: float) -> None:
        """Move the whole billet along y by dt, mm."""

    @abstractmethod
    def place_billet(self, x: PETSc.Vec) -> None:
        """Move the billet to where it stands at the start (`Case.off_symmetry`)."""

    @abstractmethod
    def largest_displacement(self, x: PETSc.Vec) -> float:
        """Largest displacement component in x on any rank, multipliers left out."""

    @abstractmethod
    def recover(self, x: PETSc.Vec) -> PETSc.Vec:
        """All displacements of both bodies (as `Problem.x` holds them)."""

    # -- equations -------------------------------------------------------------------------------------------

    @abstractmethod
    def residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """Residual into f, N; NaN where the surfaces have lost each other."""

    @abstractmethod
    def tangent(self, x: PETSc.Vec, geometric: bool) -> PETSc.Mat:
        """Derivative of the residual; ``geometric`` adds the second variation of the gap."""

    @abstractmethod
    def linearised(self, x: PETSc.Vec, f: PETSc.Vec, at: Array) -> PETSc.Mat:
        """Residual into f, and the tangent, with contact linearised at another contact vector than that of x.

        ``at``: equal to it wherever the supports, or nothing, say what z is. NaN into f where the surfaces have lost
        each other there.
        """

    @abstractmethod
    def set_solver(self, ksp: PETSc.KSP) -> None:
        """Say how the tangent's linear systems are solved."""

    def set_accuracy(self, ksp: PETSc.KSP, tolerance: float, share: float) -> None:  # noqa: B027
        """Solve the next linear system no closer than Newton's method needs, which ends at this residual, N.

        ``share``: of the right-hand side, what may be left so that Newton's method goes on as it does.
        """

    @abstractmethod
    def tangent_without_contact(self) -> PETSc.Mat:
        """A matrix of the tangent's kind, before there is a tangent."""

    @property
    def solves_closely(self) -> bool:
        """Whether linear systems are always solved most closely.

        For passes, whose end hangs on all digits, and for theta, whose forces on the billet's inside outweigh what the
        gap says.
        """
        case = self.case
        return case.method == "nodal" or (case.method == "nitsche" and case.theta != 0)

    @property
    def keeps_tangents(self) -> bool:
        """Whether Newton's method may solve with a tangent again."""
        return True

    def forget_pattern(self) -> None:  # noqa: B027
        """Let go of the contact pairs met so far, if they cost anything."""

    @abstractmethod
    def round_off(self, x: PETSc.Vec) -> float:
        """Norm of the round-off in the residual at x, N."""

    @property
    def divided(self) -> bool:
        """Whether each rank evaluates the terms on a part of the slave's facets (all of them, or none)."""
        return any(term.divided for term in self.terms)

    def contact_forces(self, z: Array) -> Array:
        """Contact's part of the residual over z, N (and multiplier rows)."""
        R = np.zeros(self.n_z)
        with self._pairs():
            for term in self.terms:
                term.add_residual(z, R)
            if self.divided:
                self.comm.Allreduce(MPI.IN_PLACE, R)
        return R

    def contact_tangent(
        self, z: Array, geometric: bool, rows: np.ndarray | None = None, cols: np.ndarray | None = None
    ) -> Triplets:
        """Its derivative as (rows, columns, values).

        Args:
            z: Where.
            geometric: Whether to add the second variation of the gap.
            rows: Which rows to give, ``shape=(n_z,)``; by default, where terms are not divided, all.
            cols: And which columns.
        """
        with self._pairs():
            parts = [term.tangent(z, geometric) for term in self.terms]
            return joined(parts) if rows is None or cols is None else self.of_all(parts, rows, cols)

    def linear_forces(self, z: Array, at: Array, tangent: Triplets) -> Array:
        """Contact's forces at z as its forces and tangent at another contact vector have them."""
        rows, cols, values = tangent
        return self.contact_forces(at) + np.bincount(rows, values * (z - at)[cols], self.n_z)

    def of_all(self, parts: list[Triplets], rows: np.ndarray, cols: np.ndarray) -> Triplets:
        """Some rows and columns of all zones' triplets, and of all ranks' where terms are divided (collective then)."""
        wanted = np.ones_like(rows) if self.divided else rows
        kept = []
        for i, j, values in parts:
            keep = wanted[i] & cols[j]
            kept.append((i[keep], j[keep], values[keep]))
        mine = joined(kept)
        if not self.divided:
            return mine
        import scipy.sparse  # a tenth of a second, which one rank does not need

        i, j, values = mine
        A = scipy.sparse.coo_array((values, (i, j)), shape=(self.n_z, self.n_z)).tocsr()
        at = np.flatnonzero(rows)
        from_ranks = self.comm.alltoall([A[of] for of in self.comm.allgather(at)])
        whole = sum(from_ranks[1:], start=from_ranks[0]).tocoo()
        return at[whole.row], whole.col.astype(np.int64), whole.data

    @contextmanager
    def _pairs(self) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.pairing += time.perf_counter() - began

    # -- contact state ---------------------------------------------------------------------------------------

    def start(self, x: PETSc.Vec) -> None:
        """Accepted contact state at t = 0; from here on ranks evaluate the terms together, if these can be divided."""
        z = self.gather(x)
        if not all([term.divide(self.comm) for term in self.terms]):
            for term in self.terms:
                term.divide(MPI.COMM_SELF)
        for term in self.terms:
            term.start(z)

    def pair_up(self, x: PETSc.Vec, settle: bool = False, before: PETSc.Vec | None = None) -> None:
        """Pair billet and die anew at x, for terms that freeze their pairing (`ContactTerm.pair_up`)."""
        z = self.gather(x)
        earlier = None if before is None else self.gather(before)
        with self._pairs():
            for term in self.terms:
                term.pair_up(z, settle, earlier)

    @property
    def may_settle(self) -> bool:
        """Whether a solve that failed is worth another try with `pair_up` settling what may have flipped in it."""
        return any(isinstance(term, MortarContact) and not term.pair.extended for term in self.terms)

    def settled(self, x: PETSc.Vec) -> bool:
        """Whether what zones settled in `pair_up` still holds at x."""
        z = self.gather(x)
        return all(term.settled(z) for term in self.terms)

    def accept(self, x: PETSc.Vec) -> dict[str, ContactState]:
        """Make x the accepted state of every zone, and report it.

        Raises:
            ArithmeticError: Surfaces of a zone, which may have been too far away to act, have lost each other; nothing
                has been accepted.
        """
        z = self.gather(x)
        with self._pairs():
            states = {term.pair.name: term.state(z) for term in self.terms}
            for term in self.terms:
                term.accept(z)
        return states

    def hold(self, x: PETSc.Vec | None) -> None:
        """Stay with the die facets that are faced at x where a change of facet has a kink; None: let go."""
        z = None if x is None else self.gather(x)
        for term in self.terms:
            term.hold(z)

    def soften(self, gamma: float | None) -> None:
        """Take at most this contact stiffness (`Case.gamma_of`) from now on; None: what the case says."""
        for term, zone in zip(self.terms, self.case.zones, strict=True):
            term.soften(1.0 if gamma is None else min(1.0, gamma / self.case.gamma_of(zone)))

    def expect(self, ahead: float | None) -> bool:
        """Take the contact set that is expected as given (`ContactTerm.expect`); say if any zone has one."""
        return any([term.expect(ahead) for term in self.terms])

    def foresee(self, forecast: Forecast, z: Array) -> Array:
        """Take a forecast's contact set as given; returns the contact vector z with the forecast's displacements."""
        for term, found in zip(self.terms, forecast.closed, strict=True):
            term.follow(found)
        at = z.copy()
        at[forecast.entries] = forecast.values
        return at

    # -- reports ---------------------------------------------------------------------------------------------

    @abstractmethod
    def balance(self, x: PETSc.Vec) -> tuple[float, float, float]:
        """Axial force of the rear face on the billet, that of the die's supports on the die, N, and the energy, N mm.

        Of the whole revolution. The forces are positive in +y; they balance. A rigid die is its own support. The energy
        is the elastic one of both bodies.
        """

    @abstractmethod
    def named_points(self) -> dict[str, tuple[int, int]]:
        """Where `point_displacements` finds each named point of the profile that is a node of the mesh."""

    @abstractmethod
    def point_displacements(self, x: PETSc.Vec, points: dict[str, tuple[int, int]]) -> dict[str, tuple[float, float]]:
        """Displacement (u_r, u_y) of named points, mm."""

    @abstractmethod
    def worst(self, x: PETSc.Vec) -> str:
        """Where the residual is largest: zone and current place, in words."""

    def point_gaps(self, x: PETSc.Vec) -> dict[str, float]:
        """Gap at the billet's corners K, L, M as the first zone that holds them measures it, mm."""
        z = self.gather(x)
        out: dict[str, float] = {}
        for term, corners in zip(self.terms, self._corners, strict=True):
            if corners:
                gaps = term.pair.gaps(z, np.array([*corners.values()]))
                out.update(zip(corners, gaps.tolist(), strict=True))
        return out

    @cached_property
    def _corners(self) -> list[dict[str, int]]:
        """For each zone, which of its nodes are corners of the billet that no zone before it has."""
        known: set[str] = set()
        out = []
        for term in self.terms:
            X = term.pair.X
            here = {}
            for name in ("K", "L", "M"):
                corner = np.append(self.case.profile.points[name], 0.0)[: X.shape[1]]
                near = np.linalg.norm(X - corner, axis=1) < 1e-6 * self.case.profile.radius
                if near.any() and name not in known:
                    here[name] = int(np.argmax(near))
            known |= here.keys()
            out.append(here)
        return out

    def zones_of(self, node: int) -> str:
        """The zones that a node of z belongs to, in words."""
        zones = [t.pair.name for t in self.terms if node in t.pair.slave.nodes or node in t.pair.die.nodes]
        return f"zone {' and '.join(zones)}" if zones else "away from the zones"


def node_positions(surface: Any, nodes: Index) -> Array:
    """Reference positions of some nodes of a surface, ``shape=(n, dim)``, mm."""
    number, first = np.unique(surface.nodes, return_index=True)
    return np.asarray(surface.X.reshape(-1, surface.X.shape[-1])[first[np.searchsorted(number, nodes)]])


def in_words(place: Array) -> str:
    """A place in the (r, y) half-plane or in space."""
    axes = "(r, y)" if len(place) == 2 else "(x, y, z)"
    return f"{axes} = ({', '.join(f'{value:.3f}' for value in place)}) mm"


def joined(parts: list[Triplets]) -> Triplets:
    """All triplets of some zones."""
    some = [part for part in parts if len(part[2])] or parts[:1]  # mostly one zone, whose arrays are large
    if len(some) == 1:
        return some[0]
    rows, cols, values = (np.concatenate(part) for part in zip(*some, strict=True))
    return rows, cols, values
