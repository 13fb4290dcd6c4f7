"""The six axisymmetric cases against the sheet, and the default method against the converged reference."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from extrusion.cases import CASES
from extrusion.mesh import case_mesh, on_root
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.reference import errors, problems, read, solve
from extrusion.result import verify
from extrusion.stepping import steps

SOLVES = {"B": (2, 2, 2, 2, 2, 2), "F": (2, 4, 4, 4, 3, 3), "G": (2, 4, 4, 4, 3, 4), "J": (1, 1, 1, 1, 1)}
"""Newton iterations that the sheet prints for its figures in three dimensions, in their order."""


@pytest.mark.parametrize("name", sorted(CASES))
def test_every_figure_of_the_sheet(name: str) -> None:
    """A figure out of its tolerance, an increment of the sheet's table that had to be cut, or a slow one in 3D."""
    for result in verify(CASES[name]):
        assert result.converged
        assert sum(step.cuts for step in result.steps) == 0
        for row in result.figures():
            assert row.ok, f"t = {row.figure.t}: {row.computed} for {row.figure.value}"
        if name in SOLVES:
            took = {step.t: step.iterations for step in result.steps}
            tested = [took[t] for t in sorted({row.figure.t for row in result.figures()})]
            assert [n for n, allowed in zip(tested, SOLVES[name], strict=True) if n > allowed + 4] == []


@pytest.mark.parametrize("method", ["nitsche", "mortar"])
@pytest.mark.parametrize("die", ["rigid", "elastic"])
def test_coarse_mesh_against_the_reference(method: str, die: str) -> None:
    """At 4 mm: K within 5e-4 and the reaction within 4 %, beyond the reference's own error bar, at all eight t."""
    case = replace(problems()["unilateral"], method=method, die=die, size=4.0)
    rows = solve(case)
    assert rows[0]["dofs"] <= 2500
    found = {row["t"]: (row["K"], row["reaction"]) for row in rows}
    table = errors(read()["problems"]["unilateral"][die], found)
    assert len(table) == 8
    for t, (K, K_bar, reaction, reaction_bar) in table.items():
        assert 5e-4 + K_bar >= K, f"t = {t}: K off by {K:.1e}"
        assert reaction <= 0.04 + reaction_bar, f"t = {t}: reaction off by {reaction:.1%}"


@pytest.mark.parametrize("method", ["nitsche", "mortar"])
@pytest.mark.parametrize("problem", ["unilateral", "bilateral"])
def test_increments_do_not_matter_with_an_elastic_die(method: str, problem: str) -> None:
    """One increment for the whole way ends elsewhere than increments of 50 mm, or is cut."""
    ends = []
    for increment in (50.0, 155.0):
        base = problems()[problem]
        case = replace(base, method=method, size=4.0).with_increment(increment, base.end)
        scene = Problem(case, case_mesh(case.profile, 4.0), MPI.COMM_SELF)
        *_, last = steps(scene, Newton(scene), case.times())
        assert last.cuts == 0
        ends.append(last.points["K"] + last.points["L"])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-8)


def test_error_bars_cover_the_levels() -> None:
    """A reference whose finest level differs from the one before by more than it admits.

    Its bars of K are below 6e-5, but where L is held on the cone (t = 10), at a singular point of the pressure.
    """
    data = read()
    for problem, dies in data["problems"].items():
        for rows in dies.values():
            for row in rows:
                assert len(row["levels"]) >= 4
                assert abs(row["levels"][-1][1] - row["levels"][-2][1]) <= row["K_error"] * (1 + 1e-9)
                assert abs(row["mortar"][2] - row["reaction"]) <= row["reaction_error"] * (1 + 1e-9)
                singular = problem != "unilateral" and row["t"] == 10
                assert row["K_error"] < (1.2e-4 if singular else 6e-5) * row["K"]


@pytest.mark.mpi
@pytest.mark.parametrize("form", ["displacement", "mixed"])
@pytest.mark.parametrize("method", ["nitsche", "mortar"])
def test_two_ranks_give_the_answer_of_one(method: str, form: str) -> None:
    """Pressures or multipliers numbered wrongly across ranks."""
    case = replace(problems()["mixed"], method=method, form=form, size=4.0).with_increment(50.0, 155.0)
    ends = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        mesh = on_root(comm, lambda: case_mesh(case.profile, case.size))
        scene = Problem(case, mesh, comm)
        *_, last = steps(scene, Newton(scene), case.times())
        ends.append([u for name in ("K", "L", "M", "F", "G") for u in last.points[name]])
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-8)
