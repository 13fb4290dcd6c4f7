"""Contact with a rigid die in plain UFL: the page of mechanics that the operator route (`zones`) is tested against.

The die is a graph, piecewise linear and straight on past its ends: ``r = R(y)`` in zone 1, ``y = Y(r)`` in zone 2.
The billet stands at x = X + u, and N is its reference normal::

    gap       g     = R(y + u_y) - (r + u_r)             ray d = e_r  (zone 1)
              g     = Y(r + u_r) - (y + u_y)             ray d = e_y  (zone 2)
    trial     tau   = S u + k g,  S u = d . sigma(u) N   k = gamma E / h; penalty: S = 0
    stress    sigma_n = min(tau, 0)

    0 = int sigma(u) : epsilon(v) dx + int [ sigma_n dg(u)[v] + theta/k (sigma_n - S u) S v ] ds

all times 2 pi r. Facets are not split where they straddle a kink of the die, as `zones` does: the two routes agree
wherever no facet does, and with finer quadrature elsewhere.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import ufl
from dolfinx import fem

from extrusion.cases import Case
from extrusion.contact import stiffness
from extrusion.elasticity import epsilon, measure_weight, quadrature_degree, sigma, virtual_work
from extrusion.errors import InputError
from extrusion.gap import Array
from extrusion.mesh import TaggedMesh


def graph(curve: Array, p: Any) -> Any:
    """Piecewise-linear function of p through the rows (p, c) of ``curve``, its end lines extended."""
    *lines, value = (c0 + (c1 - c0) / (p1 - p0) * (p - p0) for (p0, c0), (p1, c1) in pairwise(curve))
    for line, (end, _) in zip(reversed(lines), curve[-2:0:-1], strict=True):
        value = ufl.conditional(ufl.lt(p, end), line, value)
    return value


def residual(case: Case, u: fem.Function, tagged: TaggedMesh, facet_degree: int = 7) -> Any:
    """Residual form F(u; v) of a case with a rigid die; its tangent is ``ufl.derivative(F, u)``.

    Args:
        case: Rigid die, penalty or Nitsche, unilateral contact along a ray.
        u: Displacement of the billet, mm, in a vector Lagrange space of the case's order.
        tagged: The billet's mesh.
        facet_degree: Quadrature degree on contact facets; 7 takes the four Gauss points that `zones` takes in a piece.

    Raises:
        InputError: The case has an elastic die, nodal contact, or a zone that is not unilateral along a ray.
    """
    if case.die != "rigid":
        raise InputError("die", case.die, "the UFL form is for a rigid die")
    if case.method == "nodal":
        raise InputError("method", case.method, "the UFL form is for penalty or nitsche")
    msh, v = tagged.msh, ufl.TestFunction(u.function_space)
    x = ufl.SpatialCoordinate(msh)
    weight, h, N = measure_weight(x, axisymmetric=True), ufl.FacetArea(msh), ufl.FacetNormal(msh)
    billet = case.billet
    gamma_E = float(stiffness(case.contact_gamma, billet.E, billet.nu, h=1.0))
    constants = (billet.lmbda, billet.mu, float(case.theta), gamma_E)
    lmbda, mu, theta, k_h = (fem.Constant(msh, value) for value in constants)
    k = k_h / h
    dx = ufl.Measure("dx", msh, metadata={"quadrature_degree": quadrature_degree(case.order, axisymmetric=True)})
    ds = ufl.Measure("ds", msh, subdomain_data=tagged.facet_tags, metadata={"quadrature_degree": facet_degree})

    F = virtual_work(u, v, lmbda, mu, dx, axisymmetric=True)
    for zone in case.zones:
        if zone.contact != "unilateral" or zone.gap == "closest":
            raise InputError(f"zones.{zone.name}", (zone.contact, zone.gap), "the UFL form is unilateral, along a ray")
        c = ("r", "y").index(zone.ray)
        names = case.profile.bore if zone.die == "bore" else case.profile.cone
        curve = case.profile.curve(names)[:, [1 - c, c]]
        gap = graph(curve[curve[:, 0].argsort()], (x + u)[1 - c]) - (x + u)[c]

        def S(w: Any, c: int = c) -> Any:
            if case.method == "penalty":
                return 0.0 * w[c]
            traction = ufl.dot(sigma(epsilon(w, x, axisymmetric=True), lmbda, mu), ufl.as_vector([N[0], N[1], 0]))
            return traction[c]

        sigma_n = ufl.min_value(S(u) + k * gap, 0)
        terms = sigma_n * ufl.derivative(gap, u, v) + theta / k * (sigma_n - S(u)) * S(v)
        F += terms * weight * ds(tagged.groups[zone.billet])
    return F
