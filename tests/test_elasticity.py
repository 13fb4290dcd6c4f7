"""Bulk elasticity: states that are exact, and a tube whose solution is known."""

from collections.abc import Callable

from mpi4py import MPI

import numpy as np
import pytest

import dolfinx.fem.petsc
import ufl
from dolfinx import fem, mesh

from extrusion.elasticity import Elastic, epsilon, measure_weight, quadrature_degree, sigma, virtual_work, von_mises
from extrusion.errors import InputError

STEEL = Elastic(200_000.0, 0.3)
KINDS = ("axisymmetric", "plane strain", "3D")


def scene(kind: str, n: int) -> mesh.Mesh:
    """Rectangle 1 < r < 2, 0 < y < 1, or the unit cube, with its inner nodes moved off the grid."""
    if kind == "3D":
        msh = mesh.create_unit_cube(MPI.COMM_SELF, n, n, n)
    else:
        msh = mesh.create_rectangle(MPI.COMM_SELF, [[1.0, 0.0], [2.0, 1.0]], [n, n])
    x = msh.geometry.x
    low, high = x.min(axis=0), x.max(axis=0)
    inside = np.all((x > low + 1e-9) & (x < high - 1e-9) | (low == high), axis=1)
    x[inside, :2] += 0.1 / n * np.sin(37 * x[inside, 1::-1] + 1)
    return msh


def solve(msh: mesh.Mesh, order: int, kind: str, u_exact: Callable, held: Callable, traction: float = 0.0) -> tuple:
    """Displacement with ``u_exact`` where each component is ``held``, and a pressure on r = 1; and what it solves."""
    axisymmetric, dim = kind == "axisymmetric", msh.geometry.dim
    V = fem.functionspace(msh, ("Lagrange", order, (dim,)))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    dx = ufl.Measure("dx", msh, metadata={"quadrature_degree": quadrature_degree(order, axisymmetric)})
    a = virtual_work(u, v, STEEL.lmbda, STEEL.mu, dx, axisymmetric)
    x = ufl.SpatialCoordinate(msh)
    on_bore = ufl.conditional(ufl.lt(x[0], 1 + 1e-9), 1.0, 0.0)
    load = fem.Constant(msh, traction) * on_bore * v[0] * measure_weight(x, axisymmetric) * ufl.ds
    exact = fem.Function(V)
    exact.interpolate(u_exact)
    bcs = []
    for component in range(dim):
        value = exact.sub(component).collapse()
        dofs = fem.locate_dofs_geometrical((V.sub(component), value.function_space), held(component))
        bcs.append(fem.dirichletbc(value, dofs, V.sub(component)))
    options = {"ksp_type": "preonly", "pc_type": "lu"}
    prefix = "elasticity_"
    u = dolfinx.fem.petsc.LinearProblem(a, load, bcs=bcs, petsc_options_prefix=prefix, petsc_options=options).solve()
    return u, exact, a, x


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_uniform_strain_is_exact(kind: str, order: int) -> None:
    """Held to it at the boundary, the inside follows; stress and energy are those of Hooke's law by hand.

    A lost hoop strain, 2 pi r or factor of lambda changes stress or energy.
    """
    E, nu, (a, b) = STEEL.E, STEEL.nu, (1e-3, -2e-3)
    lmbda, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
    if kind == "axisymmetric":  # hoop strain = radial strain; volume of the tube 1 < r < 2 of height 1
        strain, volume = np.diag([a, b, a]), np.pi * (4 - 1)
    elif kind == "plane strain":
        strain, volume = np.array([[a, 5e-4, 0], [5e-4, b, 0], [0, 0, 0]]), 1.0
    else:
        strain, volume = np.array([[a, 5e-4, 0], [5e-4, b, -1e-3], [0, -1e-3, 3e-3]]), 1.0
    stress = lmbda * np.trace(strain) * np.eye(3) + 2 * mu * strain

    msh = scene(kind, 3)
    dim = msh.geometry.dim
    low, high = msh.geometry.x.min(axis=0)[:dim], msh.geometry.x.max(axis=0)[:dim]

    def held(_: int) -> Callable:  # the whole boundary
        return lambda x: np.any(np.minimum(x[:dim].T - low, high - x[:dim].T) < 1e-9, axis=1)

    u, exact, form, x = solve(msh, order, kind, lambda x: strain[:dim, :dim] @ x[:dim], held)
    np.testing.assert_allclose(u.x.array, exact.x.array, atol=1e-15)
    energy = fem.assemble_scalar(fem.form(ufl.replace(0.5 * form, dict.fromkeys(form.arguments(), u))))
    assert energy == pytest.approx(0.5 * np.sum(stress * strain) * volume, rel=1e-12)
    found = sigma(epsilon(u, x, kind == "axisymmetric"), STEEL.lmbda, STEEL.mu)
    middle = np.full((1, dim), 0.25)
    at_cells = fem.Expression(found, middle).eval(msh, np.arange(6, dtype=np.int32)).reshape(-1, 3, 3)
    np.testing.assert_allclose(at_cells, np.broadcast_to(stress, (6, 3, 3)), atol=1e-10 * E)


@pytest.mark.parametrize(("order", "rate"), [(1, 2), (2, 3)])
def test_lame_tube(order: int, rate: int) -> None:
    """Tube 1 < r < 2 under inner pressure 100 MPa in plane strain: u_r = A r + B / r, at the rate of the elements.

    A wrong hoop term still converges, but not to this.
    """
    p, (a, b) = 100.0, (1.0, 2.0)
    C = p * a**2 / (b**2 - a**2)
    A, B = C / (2 * (STEEL.lmbda + STEEL.mu)), C * b**2 / (2 * STEEL.mu)

    def u_exact(x: np.ndarray) -> np.ndarray:
        return np.stack([A * x[0] + B / x[0], 0 * x[0]])

    def held(component: int) -> Callable:  # u_y on the ends
        return lambda x: (component == 1) & (np.minimum(x[1], 1 - x[1]) < 1e-9)

    errors = []
    for n in (4, 8, 16):
        msh = mesh.create_rectangle(MPI.COMM_SELF, [[a, 0.0], [b, 1.0]], [n, n])
        u, *_, x = solve(msh, order, "axisymmetric", u_exact, held, traction=p)
        d = u - ufl.as_vector([A * x[0] + B / x[0], 0])
        errors.append(np.sqrt(fem.assemble_scalar(fem.form(ufl.inner(d, d) * ufl.dx(degree=8)))))
    observed = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(observed - rate) < 0.2), f"observed orders {observed}, expected {rate}; errors {errors}"
    assert errors[-1] < 0.01 * A


@pytest.mark.parametrize(
    ("stress", "equivalent"),
    [(np.diag([0, -7.0, 0]), 7.0), (7 * np.eye(3), 0.0), (np.eye(3)[[1, 0, 2]] - np.diag([0, 0, 1]), np.sqrt(3))],
)
def test_von_mises(stress: np.ndarray, equivalent: float) -> None:
    """Of uniaxial stress, of pressure, and of pure shear."""
    assert von_mises(ufl.as_matrix(stress.tolist()))(()) == pytest.approx(equivalent)


def test_lame_parameters() -> None:
    """E = 2.5, nu = 0.25: both are 1."""
    assert (Elastic(2.5, 0.25).lmbda, Elastic(2.5, 0.25).mu) == pytest.approx((1, 1))


@pytest.mark.parametrize(
    ("E", "nu", "field"),
    [(0.0, 0.3, "E"), (-1.0, 0.3, "E"), (np.nan, 0.3, "E"), (np.inf, 0.3, "E"), ("5000", 0.3, "E"), (True, 0.3, "E"),
     (1.0, 0.5, "nu"), (1.0, -1.0, "nu"), (1.0, np.nan, "nu")],
)  # fmt: skip
def test_impossible_materials_are_refused(E: float, nu: float, field: str) -> None:
    """They would make the bulk singular, or indefinite, without a word."""
    with pytest.raises(InputError) as caught:
        Elastic(E, nu)
    assert caught.value.field == field
