"""Laws and closures of frictionless contact, on arrays.

Every law has one trial value and one projection (DESIGN, Alart & Curnier 1991, doi:10.1016/0045-7825(91)90022-X;
Chouly & Hild 2013, doi:10.1137/12088344X)::

    trial   = base + k * gap          base: 0 (penalty), sigma_n(u) (Nitsche), the multiplier (active set, mortar)
    sigma_n = min(trial, 0)           unilateral
    sigma_n = trial where closed      bilateral (glissière)
    sigma_n = 0                       check: the gap is reported, contact is not enforced

``gap > 0`` when open, ``sigma_n < 0`` when pressed, ``k > 0``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Closure = Literal["unilateral", "bilateral", "check"]
CLOSURES: tuple[Closure, ...] = ("unilateral", "bilateral", "check")

REFERENCE_NU = 0.45
"""Poisson's ratio at which the dimensionless gamma is stated: that of the billet of SSNV504."""

CLOSED_GAP = 1e-9
"""A point closer than this (relative to the billet's radius) when first paired is closed from the start."""


def project(trial: Array, closure: Closure, closed: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Contact stress from its trial value, and the derivative.

    Args:
        trial: Trial stress base + k gap, any shape, MPa.
        closure: ``unilateral``, ``bilateral`` or ``check``.
        closed: Points a bilateral closure holds, a shape that broadcasts to that; what is not held acts unilaterally.

    Returns:
        ``sigma_n`` and ``d sigma_n / d trial`` (0 or 1), same shape as ``trial``.
    """
    if closure == "check":
        return np.zeros_like(trial), np.zeros_like(trial)
    held = trial < 0.0
    if closure == "bilateral":
        held |= closed
    return np.where(held, trial, 0.0), held.astype(float)


def stiffness(gamma: float, E: float, nu: float, h: Array | float) -> Array:
    """Contact stiffness ``k = gamma E / h``, MPa/mm, scaled with the oedometric modulus.

    ``gamma`` means the same at every nu: it is multiplied by M(nu)/E over its value at nu = 0.45, the billet of
    SSNV504, with M = E (1-nu) / ((1+nu)(1-2nu)), since the trace inequality behind Nitsche's method scales with M.

    Args:
        gamma: Dimensionless.
        E: Young's modulus of the slave body, MPa.
        nu: Its Poisson ratio.
        h: Length of the slave facet, mm.
    """
    return np.asarray(gamma * E / h * oedometric_ratio(nu) / oedometric_ratio(REFERENCE_NU))


def oedometric_ratio(nu: float) -> float:
    """``M / E`` of a laterally confined bar."""
    return (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
