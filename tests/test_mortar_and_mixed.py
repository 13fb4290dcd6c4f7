"""Mortar contact, the displacement-pressure form, the least gamma, and what a glissière takes hold of."""

import gc
import logging
import weakref
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from scipy.sparse import coo_array

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix
from dolfinx.mesh import create_unit_cube, create_unit_square

from extrusion.cases import BILLET, SIDE, Case
from extrusion.elasticity import Elastic, mixed_virtual_work
from extrusion.errors import InputError
from extrusion.mesh import case_mesh
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.reference import problems
from extrusion.stepping import steps


def solved(case: Case, times: list[float]) -> Problem:
    problem = Problem(case, case_mesh(case.profile, case.size), MPI.COMM_SELF)
    for _ in steps(problem, Newton(problem), times):
        pass
    return problem


@pytest.mark.parametrize("die", ["rigid", "elastic"])
@pytest.mark.parametrize("form", ["displacement", "mixed"])
@pytest.mark.parametrize("method", ["mortar", "nitsche"])
def test_tangent_by_central_differences(method: str, form: str, die: str) -> None:
    """A term missing from the second variation, the moving split points, or the rows of multiplier and pressure."""
    case = replace(problems()["unilateral"], method=method, form=form, die=die, size=4.0)
    problem = solved(case, [20.0, 70.0])
    rng = np.random.default_rng(1)
    free = problem.z_to_x >= 0
    z = problem.gather(problem.x)
    z[free] += 1e-3 * rng.standard_normal(free.sum())
    direction = np.where(free, rng.standard_normal(z.shape), 0.0)
    rows, cols, values = (np.concatenate(p) for p in zip(*(t.tangent(z, True) for t in problem.terms), strict=True))
    product = coo_array((values, (rows, cols)), shape=(len(z), len(z))) @ direction
    h = 1e-6
    slope = (problem.contact_forces(z + h * direction) - problem.contact_forces(z - h * direction)) / (2 * h)
    assert np.linalg.norm(product) > 1e5
    np.testing.assert_allclose(product[free], slope[free], atol=1e-7 * np.linalg.norm(product))


@pytest.mark.parametrize("form", ["displacement", "mixed"])
def test_uniform_state_between_E_and_F(form: str) -> None:
    """p = E d / ((1 - nu) R), K - t = 65 * 2 nu d / ((1 - nu) R), no reaction (d = 2, R = 50), in either form."""
    case = replace(problems()["bilateral"], die="rigid", form=form, size=4.0, method="mortar")
    problem = solved(case, [135.2])
    ((_, K),) = [problem.point_displacements(problem.x, {"K": problem.named_points()["K"]})["K"]]
    state = problem.terms[0].state(problem.gather(problem.x))
    np.testing.assert_allclose(state.ray_pressure, 5000 * 2 / (0.55 * 50), rtol=1e-8)
    assert pytest.approx(65 * 0.9 * 2 / (0.55 * 50), abs=1e-9) == K - 135.2
    assert abs(problem.balance(problem.x)[0]) < 1e-3


def test_forms_agree_at_moderate_nu() -> None:
    """At nu = 0.3 both forms are right: K differs by less than the mesh's own error."""
    found = []
    for form in ("displacement", "mixed"):
        case = replace(problems()["unilateral"], billet=Elastic(5000, 0.3), form=form, size=2.0, die="rigid")
        problem = solved(case, [50.0])
        found.append(problem.point_displacements(problem.x, problem.named_points())["K"][1])
    assert found[0] == pytest.approx(found[1], rel=2e-5)


def test_nearly_incompressible_takes_the_mixed_form_and_keeps_its_volume() -> None:
    """nu = 0.4999 in one increment: the front comes forward by the volume that the radius loses (locking: less)."""
    case = replace(problems()["bilateral"], billet=Elastic(5000, 0.4999), die="rigid", size=4.0)
    assert case.mixed
    assert not replace(case, billet=BILLET).mixed
    problem = solved(case, [135.2])
    K = problem.point_displacements(problem.x, problem.named_points())["K"][1]
    # uniform state, axial strain 2 nu d / ((1 - nu) R), but for the last 0.4 mm at L, which is past F
    assert pytest.approx(65 * 2 * 0.4999 * 2 / (0.5001 * 50), abs=1e-4) == K - 135.2


def test_nitsche_without_a_pressure_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    """At nu = 0.4999 the force of the displacement form is 69 % off in 3D; the mixed form is taken unless told."""
    case = replace(problems()["unilateral"], order=2, size=8.0, die="rigid", billet=Elastic(5000, 0.4999), theta=-1)
    mesh = case_mesh(case.profile, 8.0)
    Problem(case, mesh, MPI.COMM_SELF)
    Problem(replace(case, form="displacement", method="mortar", theta=0), mesh, MPI.COMM_SELF)
    assert "displacement form" not in caplog.text
    Problem(replace(case, form="displacement"), mesh, MPI.COMM_SELF)
    assert "nitsche in the displacement form at nu = 0.4999" in caplog.text


@pytest.mark.parametrize(("order", "theta", "gamma"), [(2, 1, 10.0), (1, 1, 3.0), (1, 0, 0.1), (2, 0, 0.1)])
def test_a_gamma_too_small_is_refused(order: int, theta: int, gamma: float) -> None:
    """Linear elements, theta = 0, gamma = 0.1 once converged to a K wrong by 222 mm without a sign."""
    case = replace(problems()["unilateral"], order=order, theta=theta, gamma=gamma, size=4.0, die="rigid")
    with pytest.raises(InputError, match="is not safe on this mesh below gamma = ") as caught:
        Problem(case, case_mesh(case.profile, 4.0), MPI.COMM_SELF)
    least = float(caught.value.remedy.split("gamma = ")[1].split(":")[0])
    Problem(replace(case, gamma=1.05 * least), case_mesh(case.profile, 4.0), MPI.COMM_SELF)
    with pytest.raises(InputError):
        Problem(replace(case, gamma=0.9 * least), case_mesh(case.profile, 4.0), MPI.COMM_SELF)


@pytest.mark.parametrize("method", ["nodal", "nitsche", "mortar"])
def test_a_glissiere_tells_what_it_takes_hold_of(method: str, caplog: pytest.LogCaptureFixture) -> None:
    """A side that starts 0.5 mm inside the die is held, and said to have been 0.5 mm away."""
    base = problems()["bilateral"]
    inside = replace(base.profile, radius=50.5)
    for initial, held in (("touching", False), ("interpenetrating", True)):
        zone = replace(SIDE, contact="bilateral", initial=initial)
        case = replace(base, profile=inside, zones=(zone,), method=method, die="rigid", size=4.0)
        pytest.importorskip("gmsh", exc_type=ImportError)
        problem = Problem(case, case_mesh(case.profile, 4.0), MPI.COMM_SELF)
        problem.start(problem.x)
        assert problem.terms[0].closed.all() == held
        assert problem.terms[0].caught == (pytest.approx(0.5) if held else 0.0)
    caplog.set_level(logging.WARNING)
    next(steps(problem, Newton(problem), [1.0]))
    assert "up to 0.5 mm from the die" in caplog.text


@pytest.mark.parametrize("method", ["nodal", "nitsche", "mortar"])
def test_a_glissiere_lets_go_past_F(method: str) -> None:
    """Without a second zone what has left the die past F is free; what still faces it is held."""
    problem = solved(replace(problems()["bilateral"], method=method, die="rigid", size=4.0), [140.0, 152.0])
    state = problem.terms[0].state(problem.gather(problem.x))
    past = state.x[:, 1] > 205 + 2.0  # a mortar row that half faces the die is held whole
    assert past.any()
    assert not state.closed[past].any()
    assert state.closed[state.x[:, 1] < 203.0].all()


def test_linear_triangles_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    """A run of a locking element that says nothing."""
    case = replace(problems()["unilateral"], order=1, die="rigid", size=4.0)
    Problem(case, case_mesh(case.profile, 4.0), MPI.COMM_SELF)
    assert "lock" in caplog.text


def test_a_problem_goes_when_it_is_let_go() -> None:
    """A cycle through PETSc keeps every problem, and a notebook or study runs out of communicators."""
    problem = solved(replace(problems()["unilateral"], die="rigid", size=4.0), [10.0])
    alive = weakref.ref(problem)
    del problem
    gc.collect()
    assert alive() is None


@pytest.mark.parametrize("space", ["axisymmetric", "plane strain", "3D"])
def test_mixed_form_holds_a_uniform_state(space: str) -> None:
    """u linear and mu p = -lambda div u leave a row of the pressure, or an inner one of the displacement off."""
    material = Elastic(5000.0, 0.4999)
    msh = create_unit_cube(MPI.COMM_SELF, 2, 2, 2) if space == "3D" else create_unit_square(MPI.COMM_SELF, 3, 3)
    d, axisymmetric = msh.geometry.dim, space == "axisymmetric"
    V, Q = fem.functionspace(msh, ("Lagrange", 2, (d,))), fem.functionspace(msh, ("Lagrange", 1))
    (u, v), (p, q) = ((ufl.TrialFunction(W), ufl.TestFunction(W)) for W in (V, Q))
    dx = ufl.dx(metadata={"quadrature_degree": 6})
    blocks = mixed_virtual_work(u, p, v, q, material.lmbda, material.mu, dx, axisymmetric)
    strain = np.array([0.01, -0.03, 0.02])[:d]
    hoop = strain[0] if axisymmetric else 0.0
    uniform, pressure = fem.Function(V), fem.Function(Q)
    uniform.interpolate(lambda x: strain[:, None] * x[:d])
    pressure.x.array[:] = -material.lmbda / material.mu * (strain.sum() + hoop)
    A = assemble_matrix(fem.form(blocks), kind="mpi")
    A.assemble()
    matrix, n = A.convert("dense").getDenseArray(), len(uniform.x.array)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9)
    forces = np.split(matrix @ np.concatenate([uniform.x.array, pressure.x.array]), [n])
    x = V.tabulate_dof_coordinates()[:, :d]
    inner = np.repeat(((x > 1e-9) & (x < 1 - 1e-9)).all(axis=1), d)
    assert inner.any()
    np.testing.assert_allclose(forces[1], 0.0, atol=1e-9 * material.lmbda)
    np.testing.assert_allclose(forces[0][inner], 0.0, atol=1e-9 * material.lmbda)
    assert np.abs(forces[0]).max() > 1.0
