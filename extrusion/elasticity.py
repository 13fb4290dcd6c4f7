"""Isotropic small-strain elasticity in UFL: axisymmetric, plane strain and 3D from the same functions.

In axisymmetry the plane is (r, y), volumes are ``2 pi r dr dy`` and the hoop strain is ``u_r / r``;
r and y are the first two of three orthogonal directions, so strain and stress are always 3 x 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import basix.ufl
import ufl

from extrusion.errors import InputError


@dataclass(frozen=True)
class Elastic:
    """Isotropic linear elastic material."""

    E: float  # Young's modulus, MPa
    nu: float  # Poisson's ratio, in (-1, 0.5)

    def __post_init__(self) -> None:
        for name in ("E", "nu"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError(name, value, "give a finite number")
            object.__setattr__(self, name, float(value))
        if self.E <= 0:
            raise InputError("E", self.E, "Young's modulus must be positive (MPa)")
        if not -1 < self.nu < 0.5:
            raise InputError("nu", self.nu, "Poisson's ratio must lie strictly between -1 and 0.5")

    @property
    def mu(self) -> float:
        """Shear modulus, MPa."""
        return self.E / (2 * (1 + self.nu))

    @property
    def lmbda(self) -> float:
        """First Lamé parameter, MPa."""
        return self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))


def measure_weight(x: Any, axisymmetric: bool) -> Any:
    """``2 pi r`` in axisymmetry (whole revolution), 1 otherwise."""
    return 2 * ufl.pi * x[0] if axisymmetric else 1.0


def epsilon(u: Any, x: Any, axisymmetric: bool = False) -> Any:
    """Small strain, 3 x 3: sym grad u, and the hoop strain ``u_r / r`` in the third direction if axisymmetric."""
    grad_u = ufl.sym(ufl.grad(u))
    if len(u) == 3:
        return grad_u
    hoop = u[0] / x[0] if axisymmetric else 0.0
    return ufl.as_tensor([[grad_u[0, 0], grad_u[0, 1], 0.0], [grad_u[1, 0], grad_u[1, 1], 0.0], [0.0, 0.0, hoop]])


def sigma(eps: Any, lmbda: Any, mu: Any) -> Any:
    """Cauchy stress ``lambda tr(eps) I + 2 mu eps``, MPa."""
    return lmbda * ufl.tr(eps) * ufl.Identity(3) + 2 * mu * eps


def virtual_work(u: Any, v: Any, lmbda: Any, mu: Any, dx: Any, axisymmetric: bool = False) -> Any:
    """Bilinear form ``int sigma(u) : eps(v)``, N mm; over the whole revolution in axisymmetry."""
    x = ufl.SpatialCoordinate(ufl.domain.extract_unique_domain(u))
    stress = sigma(epsilon(u, x, axisymmetric), lmbda, mu)
    return ufl.inner(stress, epsilon(v, x, axisymmetric)) * measure_weight(x, axisymmetric) * dx


def mixed_virtual_work(
    u: Any, p: Any, v: Any, q: Any, lmbda: Any, mu: Any, dx: Any, axisymmetric: bool = False
) -> list[list[Any]]:
    """Blocks of the displacement-pressure form, symmetric and regular up to nu = 1/2.

    The pressure is mu p, so that p has no unit and both rows are energies::

        int 2 mu eps(u) : eps(v) - mu p div v = ...,    -int mu q (div u + mu / lambda p) = 0

    With u quadratic and p linear and continuous this is the Taylor-Hood pair. div is the trace of the strain, the hoop
    strain included.
    """
    x = ufl.SpatialCoordinate(ufl.domain.extract_unique_domain(u))
    strain_u, strain_v = epsilon(u, x, axisymmetric), epsilon(v, x, axisymmetric)
    weight = measure_weight(x, axisymmetric)
    return [
        [2 * mu * ufl.inner(strain_u, strain_v) * weight * dx, -mu * p * ufl.tr(strain_v) * weight * dx],
        [-mu * q * ufl.tr(strain_u) * weight * dx, -(mu**2) / lmbda * p * q * weight * dx],
    ]


def von_mises(stress: Any) -> Any:
    """Von Mises equivalent of a 3 x 3 stress, MPa."""
    deviator = stress - ufl.tr(stress) / 3 * ufl.Identity(3)
    return ufl.sqrt(1.5 * ufl.inner(deviator, deviator))


def quadrature_degree(order: int, axisymmetric: bool, dim: int = 2) -> int:
    """Degree for the bulk form.

    One point in the P1 triangle, as the published SSNV504 results have it; degree 4 for P2, since the hoop
    term is rational (and a one-point P2 triangle is singular). On hexahedra ``order + 1`` Gauss points a direction.
    """
    if dim == 3:
        return 2 * order
    return 1 if order == 1 else 4 if axisymmetric else 2 * (order - 1)


@cache
def serendipity() -> Any:
    """Element of the 20-node hexahedron, whose dofs are the values at its vertices and at the middles of its edges.

    The space is that of Arnold, Awanou, Found. Comput. Math. 11 (2011) 337, doi:10.1007/s10208-011-9087-3, degree 2;
    basix has it with moments along the edges for dofs, which contact at nodes cannot use.
    """
    cell = basix.CellType.hexahedron
    points, weights = basix.make_quadrature(cell, 6)
    powers = [p for p in np.ndindex(3, 3, 3) if sum(e for e in p if e > 1) <= 2]
    monomials = np.array([np.prod(points**p, axis=1) for p in powers])
    orthonormal = basix.tabulate_polynomials(basix.PolynomialType.legendre, cell, 2, points)
    span = np.linalg.qr(((monomials * weights) @ orthonormal.T).T)[0].T
    vertices, topology = np.array(basix.geometry(cell)), basix.topology(cell)
    none = np.zeros((0, 3)), np.zeros((0, 1, 0, 1))
    nodes = [[(vertices[v].mean(axis=0)[None], np.ones((1, 1, 1, 1))) for v in topology[d]] for d in (0, 1)]
    nodes += [[none for _ in topology[d]] for d in (2, 3)]
    x, M = ([[entity[i] for entity in entities] for entities in nodes] for i in (0, 1))
    return basix.ufl.custom_element(
        cell, [], np.ascontiguousarray(span), x, M, 0, basix.MapType.identity, basix.SobolevSpace.H1, False, 1, 2
    )
