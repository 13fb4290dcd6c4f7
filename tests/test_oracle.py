"""The operator route against the same mechanics in plain UFL: rigid die, penalty and Nitsche."""

from dataclasses import replace
from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from scenes import FRONT, SIDE, billet_mesh, solve, straight_die
from scipy.sparse import csr_matrix

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import NonlinearProblem, assemble_matrix, assemble_vector

from extrusion import oracle
from extrusion.cases import A, Case
from extrusion.elasticity import Elastic
from extrusion.errors import InputError
from extrusion.mesh import case_mesh
from extrusion.problem import Problem
from extrusion.profile import SSNV504

LAWS = [("penalty", 0), ("nitsche", -1), ("nitsche", 0), ("nitsche", 1)]
STRETCHES = {  # current y of the billet's rear, and its stretch: wholly within, and past F
    "A-B": (3.0, 1.0), "B-C": (71.0, 0.2), "C-D": (86.0, 0.4), "D-E": (116.0, 0.28), "E-F": (136.0, 1.0),
    "past F": (206.0, 1.0),
}  # fmt: skip


@cache
def routes(
    method: str, theta: int, order: int, facet_degree: int = 7
) -> tuple[Problem, fem.Function, fem.Form, fem.Form]:
    """The problem, the oracle's displacement, and its residual and tangent forms."""
    gamma = 60.0 if theta == 1 else None
    case = replace(A, method=method, theta=theta, gamma=gamma, order=order, die="rigid")
    problem = Problem(case, case_mesh(A.profile), MPI.COMM_SELF)
    u = fem.Function(problem.V)
    F = oracle.residual(problem.case, u, problem.tagged, facet_degree)
    return problem, u, fem.form(F), fem.form(ufl.derivative(F, u))


def lay(problem: Problem, u: fem.Function, rear: float, stretch: float = 1.0, overlap: float = 0.0) -> None:
    """Lay the billet along the bore, waving into it and out of it by 0.1 mm, with a little noise."""

    def laid(x: np.ndarray) -> np.ndarray:
        y = rear + stretch * x[1]
        r = SSNV504.bore_radius(y) + 0.1 * np.sin(x[1] / 5) + overlap
        return np.stack([x[0] / 50 * (r - 50), y - x[1]])

    u.interpolate(laid)
    noise = np.random.default_rng(8).standard_normal(len(u.x.array))
    u.x.array[:] += 1e-3 * noise * np.repeat(problem.V.tabulate_dof_coordinates()[:, 0] / 50, 2)
    problem.x.array[:] = u.x.array


@pytest.mark.parametrize("stretch", STRETCHES)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("method", "theta"), LAWS)
def test_forces_and_tangent_where_no_facet_straddles_a_kink(method: str, theta: int, order: int, stretch: str) -> None:
    """The same Gauss points, so the same numbers: a factor, a sign or a weight wrong in either route shows."""
    past = stretch == "past F"
    problem, u, F, dF = routes(method, theta, order)
    lay(problem, u, *STRETCHES[stretch], overlap=-0.2 if past else 0.0)  # else L straddles F
    side, front = (term.state(problem.gather(problem.x)).closed for term in problem.terms)
    assert front.all() if past else 0 < side.mean() < 1 or method == "nitsche"
    bulk = problem.K @ problem.x
    expected, found = assemble_vector(F) - bulk, problem.forces(problem.x) - bulk
    assert expected.norm() > 1e3
    assert (found - expected).norm() < 1e-10 * expected.norm()

    J = assemble_matrix(dF)
    J.assemble()
    free = np.setdiff1d(np.arange(problem.n), problem._held)

    def dense(matrix: object) -> np.ndarray:
        indptr, indices, data = matrix.getValuesCSR()
        return csr_matrix((data, indices, indptr)).toarray()[np.ix_(free, free)]

    K, J, tangent = (dense(matrix) for matrix in (problem.K, J, problem.tangent(problem.x, True)))
    assert np.linalg.norm(tangent - J) < 1e-10 * np.linalg.norm(J - K)


@pytest.mark.parametrize(("method", "theta"), [("penalty", 0), ("nitsche", 0)])
def test_forces_where_facets_straddle_corners(method: str, theta: int) -> None:
    """From 22 to 87 mm the side passes B and C: unsplit it takes many points to see what four a piece see."""
    errors = []
    for degree in (7, 127):
        problem, u, F, _ = routes(method, theta, 2, degree)
        lay(problem, u, 22.0, overlap=0.5)
        bulk = problem.K @ problem.x
        expected, found = assemble_vector(F) - bulk, problem.forces(problem.x) - bulk
        errors.append((found - expected).norm() / expected.norm())
    assert errors[0] > 0.005
    assert errors[1] < 0.1 * errors[0], f"with 4 and 64 points a facet: {errors}"


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("method", "theta"), LAWS)
def test_solution_in_a_tapered_bore(method: str, theta: int, order: int) -> None:
    """Without a kink both routes solve the same equations: SNES on UFL alone finds the same displacement."""
    profile = straight_die(radius=10, length=20, bore=(10.5, 9.0), stop=40)
    gamma = 60.0 if theta == 1 else None
    case = Case(
        name="taper", profile=profile, billet=Elastic(5000, 0.45), die="rigid", zones=(SIDE, FRONT),
        method=method, theta=theta, order=order, gamma=gamma, increments=((6, 6),),
    )  # fmt: skip
    problem, step = solve(case, billet_mesh(profile, 4, 8), [6.0])
    closed = step.zones["1"].closed
    assert 0.2 < closed.mean() < 0.8

    V = problem.V
    u = fem.Function(V)
    u.interpolate(lambda x: np.stack([0 * x[0], np.full_like(x[0], 6.0)]))
    facets, groups = problem.tagged.facet_tags, problem.tagged.groups
    bcs = []
    for group, component, value in (("rear", 1, 6.0), ("axis", 0, 0.0)):
        dofs = fem.locate_dofs_topological(V.sub(component), 1, facets.find(groups[group]))
        bcs.append(fem.dirichletbc(value, dofs, V.sub(component)))
    options = {
        "snes_type": "newtonls", "snes_linesearch_type": "bt", "snes_atol": 1e-7, "snes_rtol": 0, "snes_stol": 0,
        "snes_error_if_not_converged": True, "ksp_type": "preonly", "pc_type": "lu",
    }  # fmt: skip
    F = oracle.residual(case, u, problem.tagged)
    NonlinearProblem(F, u, bcs=bcs, petsc_options_prefix="oracle_", petsc_options=options).solve()
    difference = np.max(np.abs(u.x.array - problem.x.array))
    assert difference < 1e-9, difference  # mm; the billet has moved by 6


def test_graph() -> None:
    """The profile's own bore radius at corners, between them and past the ends."""
    y = [-10.0, 0, 70, 77.5, 85, 100, 115, 125, 135, 205, 300]
    curve = SSNV504.curve(SSNV504.bore)[:, ::-1]
    found = [oracle.graph(curve, ufl.as_ufl(value))(()) for value in y]
    np.testing.assert_allclose(found, SSNV504.bore_radius(y))


@pytest.mark.parametrize(
    ("changes", "field"),
    [({"die": "elastic"}, "die"), ({"method": "nodal"}, "method"),
     ({"zones": (replace(SIDE, contact="bilateral"),)}, "zones.1"),
     ({"zones": (replace(SIDE, gap="closest"),)}, "zones.1")],
)  # fmt: skip
def test_what_the_form_does_not_say_is_refused(changes: dict, field: str) -> None:
    """It would be compared with something else."""
    case = replace(A, **{"method": "penalty", "die": "rigid"} | changes)
    problem = Problem(replace(A, method="penalty", die="rigid"), case_mesh(A.profile), MPI.COMM_SELF)
    with pytest.raises(InputError) as caught:
        oracle.residual(case, fem.Function(problem.V), problem.tagged)
    assert caught.value.field == field
