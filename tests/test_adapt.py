"""Dual-weighted estimates, and meshes made from them."""

from collections.abc import Sequence
from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from extrusion import cases, cli, reference, run
from extrusion.adapt import adapt, derivative, duals, estimated, indicators, refined
from extrusion.cases import Case
from extrusion.errors import InputError
from extrusion.estimate import GOALS, Goal, continuous
from extrusion.mesh import PlainMesh, case_mesh, check_profile, sized_mesh
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.profile import SSNV504
from extrusion.stepping import Step, steps

pytest.importorskip("gmsh", exc_type=ImportError)

SELF = MPI.COMM_SELF
COARSE = case_mesh(SSNV504, 8.0)
N = len(COARSE.cells["billet"])


def scene(die: str = "rigid", until: float = 50.0) -> Case:
    return replace(continuous(reference.problems()["unilateral"]), die=die).with_increment(10.0, until)  # type: ignore[arg-type]


def uniform(size: float) -> PlainMesh:
    return sized_mesh(SSNV504, lambda r, y: size, lambda r, y: size)


def last(case: Case, mesh: PlainMesh) -> tuple[Problem, Step]:
    problem = Problem(case, mesh, SELF)
    *_, step = steps(problem, Newton(problem), case.times())
    return problem, step


def centers(mesh: PlainMesh) -> np.ndarray:
    return mesh.points[mesh.cells["billet"]].mean(axis=1)


@pytest.mark.parametrize("die", ["rigid", "elastic"])
def test_dual_against_central_differences(die: str) -> None:
    """A tangent that is not transposed, supports that move, a force of contact that is left out of the reaction."""
    problem, step = last(scene(die), COARSE)
    x = step.x.copy()
    free = np.setdiff1d(np.arange(problem.n), problem.held)
    v = np.zeros(problem.n)
    v[free] = np.random.default_rng(1).standard_normal(len(free))
    axial = np.zeros(problem.n_z, dtype=bool)
    axial[1 : 2 * len(problem.z_in_billet) : 2] = problem.z_in_billet
    K = problem.places_of(problem.named_points())["K"][1]

    def at(h: float) -> tuple[np.ndarray, dict[Goal, float]]:
        y, f = x.duplicate(), x.duplicate()
        y.array[:] = x.array_r + h * v
        problem.residual(y, f)
        return f.array_r.copy(), {"K": y.array_r[K], "reaction": problem.contact_forces(problem.gather(y))[axial].sum()}

    h = 1e-6
    (ahead, more), (behind, less) = at(h), at(-h)
    for goal, w in duals(problem, x).items():
        change = (more[goal] - less[goal]) / (2 * h)
        assert abs(change) > 0.1
        assert w.array_r @ (ahead - behind) / (2 * h) == pytest.approx(change, rel=1e-4)
        assert derivative(problem, x, goal) @ v == pytest.approx(change, rel=1e-4)
        assert not w.array_r[problem.held].any()


def errors(case: Case, mesh: PlainMesh) -> tuple[float, float]:
    """Actual errors of K and the reaction."""
    done = run(case, mesh=mesh, comm=SELF)
    found = {s.t: (s.points["K"][1], s.reaction) for s in done.steps}
    rows = np.array([*reference.errors(reference.read()["problems"]["unilateral"][case.die], found).values()])
    return float(rows[:, 0].max()), float(rows[:, 2].max())


@pytest.mark.parametrize("mesh", [COARSE, case_mesh(SSNV504, 4.0)], ids=["8 mm", "4 mm"])
def test_the_sum_is_about_the_error(mesh: PlainMesh) -> None:
    """A norm with the wrong weight or compliance, a recovered stress that is none."""
    case = scene(until=70.0)
    error, eta, _ = estimated(case, mesh, "K")
    assert eta.shape == (len(mesh.cells["billet"]),)
    K, reaction = errors(case, mesh)
    assert 1 < error.K / K < 10
    assert 1 < error.reaction / reaction < 10


@pytest.mark.parametrize("goal", GOALS)
def test_a_uniform_mesh_is_poor_where_the_die_bends(goal: Goal) -> None:
    """Estimates that belong to other triangles than those they are said to."""
    mesh = uniform(4.0)
    problem, step = last(scene(until=30.0), mesh)  # L is past C
    eta = indicators(problem, step.x, [goal])[goal]
    points = [SSNV504.points["L"], (50.0, 85.0 - 30.0)]  # C, about where it meets the billet
    near = np.min([np.hypot(*(centers(mesh) - p).T) for p in points], axis=0) < 6.0
    assert eta[near].mean() > 5 * eta[~near].mean()


def test_a_refined_mesh_is_finer_where_asked() -> None:
    """Corners cut, sizes that go to other triangles, a mesh out of proportion."""
    wish = np.where(np.hypot(*(centers(COARSE) - SSNV504.points["K"]).T) < 15.0, 1.0, 1e-3)
    fine = refined(SSNV504, COARSE, wish, growth=2.0)
    check_profile(fine, SSNV504)

    def around(mesh: PlainMesh, point: Sequence[float]) -> int:
        return int(np.sum(np.hypot(*(centers(mesh) - np.array(point)).T) < 15.0))

    assert around(fine, SSNV504.points["K"]) > 4 * around(COARSE, SSNV504.points["K"])
    assert around(fine, SSNV504.points["M"]) < 1.3 * around(COARSE, SSNV504.points["M"])
    assert 1.5 * N < len(fine.cells["billet"]) < 4 * N
    assert 0.7 < len(fine.cells["die"]) / len(COARSE.cells["die"]) < 1.7


def test_adapted_from_a_poor_mesh() -> None:
    """A mesh that is returned before it is good enough, or not refined where it must be."""
    case, poor = scene(until=70.0), uniform(12.0)
    mesh, estimate = adapt(case, 1e-3, "K", SELF, start=poor)
    assert mesh is not None
    assert estimate.error.K <= 1e-3
    assert [part.taken for part in estimate.parts] == [*[False] * (len(estimate.parts) - 1), True]
    assert errors(case, poor)[0] > 2e-3
    assert errors(case, mesh)[0] < 5e-4


def test_run_adapts() -> None:
    """A mesh, or an estimate, that is lost on the way."""
    done = run(cases.A, tolerance=2e-4, adapt=True, die="rigid", increment=10, until=20)
    assert done.estimate is not None
    assert done.estimate.error.K <= 2e-4
    assert done.case.method == "nitsche"
    assert done.dofs > 690  # more than on the first mesh


def test_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    """A crash, or a silent answer, in place of one line."""
    with pytest.raises(InputError, match="goal"):
        adapt(cases.A, 1e-3, "L", SELF)  # type: ignore[arg-type]
    for tolerance in (0.0, 1.0, float("nan"), "x"):
        with pytest.raises(InputError, match="tolerance"):
            adapt(cases.A, tolerance, "K", SELF)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="would not do"):
        adapt(scene(until=10.0), 1e-12, "K", SELF)
    for eta in (np.ones(3), -np.ones(N), np.zeros(N), np.full(N, np.nan)):
        with pytest.raises(InputError, match="eta"):
            refined(SSNV504, COARSE, eta)
    with pytest.raises(InputError, match="adapt"):
        run(cases.A, adapt=True)
    with pytest.raises(SystemExit) as stop:
        cli.main(["run", "A", "--adapt"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
