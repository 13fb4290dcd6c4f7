"""Sums over contact points: trial stress, forces and their derivative, in C (``integrand.c``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from extrusion.compiled import library, pointer
from extrusion.gap import Array, Index, Points


@dataclass(frozen=True)
class Integrand:
    """Contact points with the rows of the slave's own stress there."""

    points: Points
    S: Array | None = None  # (n, q, L), MPa/mm
    S_xi: Callable[[], Array] | None = None  # gives (n, q, L): its derivative along the facet

    @cached_property
    def _fixed(self) -> dict[str, Any]:
        """What an ``integrand`` of ``integrand.h`` has of points that do not move, as arrays and numbers."""
        points, (n, q, L) = self.points, self.points.G.shape
        if self.S is not None and self.S.shape != points.G.shape:
            raise ValueError(f"rows of the stress, {self.S.shape}, and of the gap, {points.G.shape}")
        return _contiguous(
            {
                "n": n, "q": q, "L": L, "facet": points.facet, "cols": points.cols, "weight": points.weight,
                "gap": points.gap, "G": points.G, "S": self.S,
            }
        )  # fmt: skip

    @cached_property
    def _moving(self) -> dict[str, Any]:
        """And what it has if they move."""
        points = self.points
        if points.dxi is None:
            return {}
        rows = {name: getattr(points, name) for name in ("gap_xi", "G_xi", "dxi", "dweight")}
        left, right = ([np.ascontiguousarray(pair[side]) for pair in points.curvature] for side in (0, 1))
        more = {"S_xi": self.S_xi and self.S_xi(), "pairs": len(left), "left": left, "right": right}
        return _contiguous(rows | more)

    @cached_property
    def _compiled(self) -> Any:
        return _struct(self._fixed)

    def trial(self, z: Array, k: Array) -> tuple[Array, Array]:
        """The slave's own stress and the trial stress, ``shape=(n, q)``, MPa; k by facets, MPa/mm."""
        own, trial = np.empty((2, *self.points.gap.shape))
        library("integrand").lib.trial_stress(self._compiled, *map(pointer, (z, k, own, trial)))
        return own, trial

    def add_forces(self, along_gap: Array, along_stress: Array | None, R: Array) -> None:
        """Add ``G^T along_gap + S^T along_stress`` to R; both ``shape=(n, q)``, N/mm per unit of the rows."""
        lib, ffi = library("integrand").lib, library("integrand").ffi
        other = ffi.NULL if along_stress is None else pointer(along_stress)
        lib.add_forces(self._compiled, pointer(along_gap), other, pointer(R))

    def tangent(
        self,
        z: Array,
        k: Array,
        own: Array,
        sigma: Array,
        by_trial: Array,
        theta: int,
        geometric: bool,
        tested: Index,
    ) -> tuple[Index, Index, Array]:
        """Derivative of ``sum weight (G sigma + theta / k S (sigma - own))`` as triplets.

        Args:
            z: Contact vector.
            k: Stiffness by facets, MPa/mm.
            own: From `trial`.
            sigma: Stress, ``shape=(n, q)``, MPa.
            by_trial: Its derivative by the trial stress.
            theta: Variant of Nitsche's method.
            geometric: Whether points move, and the gap has a second derivative.
            tested: For theta = 0, local columns that have a row, by facets: ``shape=(m, T)``.
        """
        n, _, L = self.points.G.shape
        lib, ffi = library("integrand").lib, library("integrand").ffi
        every = theta != 0 and self.S is not None
        which = np.arange(n) if every else np.flatnonzero(by_trial.any(axis=1))  # open pieces carry nothing
        T = L if every else tested.shape[1]
        rows, cols = np.empty((2, len(which) * T * L), dtype=np.int64)
        values = np.empty(len(which) * T * L)
        of = _struct(self._fixed | self._moving) if geometric else self._compiled
        given = map(pointer, (z, k, own, sigma, by_trial))
        mine = ffi.NULL if every else pointer(tested)
        out = map(pointer, (rows, cols, values))
        lib.stress_tangent(of, *given, theta, len(which), pointer(which), T, mine, *out)
        return rows, cols, values


def _contiguous(values: dict[str, Any]) -> dict[str, Any]:
    """Without what is None."""
    return {
        name: np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value
        for name, value in values.items()
        if value is not None
    }


def _struct(values: dict[str, Any]) -> Any:
    """The ``integrand`` of arrays, which must outlive it, and of numbers."""
    out = library("integrand").ffi.new("integrand *")
    for name, value in values.items():
        if isinstance(value, list):
            for i, array in enumerate(value):
                getattr(out, name)[i] = pointer(array)
        else:
            setattr(out, name, pointer(value) if isinstance(value, np.ndarray) else value)
    return out
