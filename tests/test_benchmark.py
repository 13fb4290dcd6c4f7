"""Timings, as ratios of runs made side by side: ``sh tests/run -m slow -s tests/test_benchmark.py``."""

import statistics
import time
from dataclasses import replace

from mpi4py import MPI
from petsc4py import PETSc

import pytest

from dolfinx.fem.petsc import assemble_matrix

from extrusion.cases import A
from extrusion.condensed import choose
from extrusion.mesh import case_mesh
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.stepping import steps


def linear_algebra(problem: Problem) -> float:
    """Seconds of one assemble, factor and solve of the system of case A: what each iteration must cost at least."""
    seconds = []
    A = problem.tangent(problem.x, geometric=False)
    for _ in range(20):
        started = time.perf_counter()
        K = assemble_matrix(problem._bulk_form)
        K.assemble()
        b, x = problem.x.duplicate(), problem.x.duplicate()
        b.set(1.0)
        ksp = PETSc.KSP().create(problem.comm)
        ksp.setType("preonly")
        ksp.setOperators(A)
        pc = ksp.getPC()
        pc.setType("lu")
        pc.setFactorSolverType("mumps")
        ksp.solve(b, x)
        seconds.append(time.perf_counter() - started)
        ksp.destroy()
        K.destroy()
    return statistics.median(seconds)


@pytest.mark.slow
def test_case_a_costs_its_linear_algebra(capsys: pytest.CaptureFixture[str]) -> None:
    """A Python loop over contact points shows as a solve phase of many times its linear algebra (5 are allowed)."""
    problem = Problem(A, case_mesh(A.profile), MPI.COMM_SELF)
    newton = Newton(problem)
    ratios = []
    for _ in range(6):
        started = time.perf_counter()
        iterations = sum(step.iterations for step in steps(problem, newton, A.times()))
        solve = time.perf_counter() - started
        ratios.append(solve / (iterations * linear_algebra(problem)))
    ratio = statistics.median(ratios[1:])  # the first run warms up
    with capsys.disabled():
        spread = f"{min(ratios[1:]):.2f} to {max(ratios[1:]):.2f}"
        print(f"\nsolve phase of A: {ratio:.2f} times its linear algebra ({spread}; {iterations} iterations)")
    assert ratio < 5


@pytest.mark.slow
@pytest.mark.parametrize(("size", "least"), [(4.0, 1.0), (1.0, 2.0)])
def test_surface_is_quicker(size: float, least: float, capsys: pytest.CaptureFixture[str]) -> None:
    """A surface solve that factors, pairs or copies more than it saves: ratio of runs in turn, medians of five."""
    case = replace(A, method="nitsche", order=2, size=size)
    problem = Problem(case, case_mesh(case.profile, size), MPI.COMM_SELF)
    seconds: dict[str, list[float]] = {"full": [], "surface": []}
    for _ in range(5):
        for solver, spent in seconds.items():
            started = time.perf_counter()
            system = choose(problem, solver)
            for _step in steps(system, Newton(system), case.times()):
                pass
            spent.append(time.perf_counter() - started)
    ratio = statistics.median(f / s for f, s in zip(*seconds.values(), strict=True))
    with capsys.disabled():
        print(f"\nfull / surface at {problem.dofs} dofs: {ratio:.2f}")
    assert ratio >= least
