"""The surface solve gives what the full one does, and makes no more right-hand sides than contact reaches."""

import logging
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scenes import straight_die

from extrusion import cases
from extrusion.cases import Case
from extrusion.condensed import Condensed, choose
from extrusion.errors import InputError
from extrusion.mesh import case_mesh, on_root
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.reference import problems
from extrusion.stepping import Step, steps
from extrusion.system import System

UNILATERAL, MIXED = problems()["unilateral"], problems()["mixed"]
SCENES = {
    "nodal, P1": cases.A,
    "nodal, die slave": cases.H,
    **{f"{m}, {d}": replace(MIXED, method=m, die=d) for m in ("nitsche", "mortar") for d in ("elastic", "rigid")},
    "penalty, P1": replace(UNILATERAL, method="penalty", order=1),
    "theta 1": replace(UNILATERAL, theta=1, gamma=100.0),
    "theta -1": replace(UNILATERAL, theta=-1),
    "mixed": replace(MIXED, form="mixed", billet=replace(cases.BILLET, nu=0.499)),
    "plane strain": replace(UNILATERAL, space="plane strain"),
    "checked": UNILATERAL.with_contact("check"),
}


def scene(case: Case, comm: MPI.Intracomm = MPI.COMM_SELF) -> Problem:
    """On the sheet's divisions."""
    return Problem(case, on_root(comm, lambda: case_mesh(case.profile, case.mesh_size)), comm)


def reported(system: System, times: list[float]) -> tuple[list[list[float]], Step]:
    """What each step reports (mm, MN, kJ), and the last step."""
    rows = []
    for step in steps(system, Newton(system), times):
        points = [u for name in sorted(step.points) for u in step.points[name]]
        forces = [step.reaction / 1e6, step.die_reaction / 1e6, step.energy / 1e6]
        rows.append([*points, *forces, *step.gap.values()])
    return rows, step


@pytest.mark.parametrize("name", SCENES)
def test_surface_is_full(name: str) -> None:
    """A force on the wrong body, a column of the compliance in the wrong place, a pairing that is never renewed."""
    case = SCENES[name]
    if case.method != "nodal":
        case = replace(case, size=None)
    problem, times = scene(case), [5.0, 10.0, 15.0, 20.0, 30.0, 40.0]
    expected, last = reported(problem, times)
    full = np.array(problem.x.array_r)
    system = Condensed(problem)
    found, last = reported(system, times)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    u = len(full) - problem.n_multipliers  # then multipliers (N), which Newton's method solves to 1e-6
    np.testing.assert_allclose(last.x.array_r[:u], full[:u], rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(last.x.array_r[u : len(full)], full[u:], rtol=1e-9, atol=1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["nodal, die slave", "nitsche, elastic", "mortar, rigid", "mixed"])
def test_two_ranks_are_one(name: str) -> None:
    """Columns gathered in another order than they were asked for; a rank that waits for another."""
    ends = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        problem = scene(SCENES[name], comm)
        rows, _ = reported(Condensed(problem), [5.0, 20.0, 40.0])
        ends.append((rows, problem.balance(problem.x) if comm is MPI.COMM_SELF else None))
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=0, atol=1e-9)


@pytest.mark.mpi
def test_all_unknowns_on_two_ranks() -> None:
    """Each rank finds all points of a curve: none is reported twice."""
    found = []
    for system in (scene(UNILATERAL, MPI.COMM_WORLD), Condensed(scene(UNILATERAL))):
        *_, step = steps(system, Newton(system), [5.0, 20.0])
        found.append(step.zones["1"])
    np.testing.assert_allclose(found[0].pressure, found[1].pressure, rtol=0, atol=1e-6)
    assert found[1].closed.any()


@pytest.mark.mpi
def test_a_lost_surface_on_two_ranks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rank 0 alone knows of it: had it a norm at hand that the other asks for, they would wait for each other."""
    comm = MPI.COMM_WORLD
    system = Condensed(scene(UNILATERAL, comm))
    f = system.x.duplicate()
    system.start(system.x)
    whole = system._out_of_balance

    def lost(*of: Any) -> Any:
        if comm.rank == 0:
            raise ArithmeticError("a ray does not meet the die")
        return whole(*of)

    for evaluate, ends in ((whole, True), (lost, False), (whole, True)):
        monkeypatch.setattr(system, "_out_of_balance", evaluate)
        system.residual(system.x, f)
        assert comm.allgather(bool(np.isfinite(f.norm()))) == comm.size * [ends]


def test_only_what_is_reached_is_solved_for() -> None:
    """A right-hand side for every die point: up to t = 20 the exit and the cone are never touched."""
    system = Condensed(scene(replace(UNILATERAL, size=2.0)))
    list(steps(system, Newton(system), [5.0, 20.0]))
    assert 0 < system.right_hand_sides < 0.75 * system.n_forces


def test_choice(caplog: pytest.LogCaptureFixture) -> None:
    """A choice that says nothing, or that ignores what it is told."""
    problem = scene(UNILATERAL)
    with caplog.at_level(logging.INFO):
        assert isinstance(choose(problem), Condensed)
    assert "solver surface" in caplog.text
    assert "estimated" in caplog.text
    assert choose(problem, "full") is problem
    assert isinstance(choose(problem, "surface"), Condensed)
    with pytest.raises(InputError, match="solver"):
        choose(problem, "fast")


@pytest.mark.parametrize("method", ["penalty", "nitsche"])
def test_all_contact_opens(method: str) -> None:
    """The billet leaves what it was pressed by: forces that no longer depend on anything, in an increment by itself."""
    profile = straight_die(radius=10.0, length=10.0, bore=(9.995, 10.1), stop=60.0)
    case = replace(cases.A, profile=profile, method=method, order=2, die="rigid", size=1.0).with_increment(2.0, 20.0)
    system = Condensed(scene(case))
    found = [step.reaction for step in steps(system, Newton(system), case.times())]
    assert abs(found[0]) > 0.1
    assert found[-1] == pytest.approx(0.0, abs=1e-4)


def test_a_second_run_is_the_first() -> None:
    """Nothing is expected from the contact set that another run has ended with."""
    system = Condensed(scene(UNILATERAL))
    times = [5.0, 10.0, 20.0, 30.0]
    first, second = ([s.iterations for s in steps(system, Newton(system), times)] for _ in range(2))
    assert first == second


def test_prediction_saves_iterations() -> None:
    """A fifth and more: the ends of the contact, which go on in the die as they did, are not found facet by facet."""
    system = Condensed(scene(replace(UNILATERAL, size=2.0)))
    times = list(np.arange(5.0, 101.0, 5.0))
    with_, without = (
        sum(s.iterations for s in steps(system, Newton(system, predicts=p), times)) for p in (True, False)
    )
    assert with_ < 0.8 * without


def test_the_last_solve_needs_no_tangent(monkeypatch: pytest.MonkeyPatch) -> None:
    """One is made though another solve with the last would do; one serves where it does not, which costs solves."""
    problem = scene(replace(UNILATERAL, size=4.0))
    system, times, made = Condensed(problem), list(np.arange(5.0, 61.0, 5.0)), []
    tangent = system.tangent
    monkeypatch.setattr(system, "tangent", lambda *of: made.append(1) or tangent(*of))
    found = list(steps(system, Newton(system), times))
    assert sum(step.tangents for step in found) == len(made)
    plain = list(steps(problem, Newton(problem), times))
    assert [step.tangents for step in plain] == [step.iterations for step in plain]
    assert len(made) <= 0.95 * sum(step.tangents for step in plain)
    assert sum(step.iterations for step in found) <= 1.02 * sum(step.iterations for step in plain)


@pytest.mark.mpi
def test_a_force_that_begins_to_act() -> None:
    """A tangent serves again, where another point has closed: what its force displaces has not been asked for yet."""
    system = Condensed(scene(replace(UNILATERAL, size=1.0), MPI.COMM_WORLD))
    newton = Newton(system)
    for _ in steps(system, newton, [5.0]):
        pass
    f, y = system.x.duplicate(), system.x.duplicate()
    ksp = newton.snes.getKSP()
    ksp.setOperators(system.tangent(system.x, False))
    new = -1
    if system.on_root:
        die = system.of_body[1]
        new = die.start + next(i for i in range(die.stop - die.start) if system.C[1].missing(np.array([i])))
        f.array[1 + new] = 1.0
    f.assemble()
    ksp.solve(f, y)
    again = y.duplicate()
    ksp.solve(f, again)
    if system.on_root:
        others = np.delete(again.array_r, 1 + new)
        assert y.array_r[1 + new] == pytest.approx(-1.0)
        assert np.linalg.norm(np.delete(y.array_r, 1 + new) - others) <= 1e-3 * np.linalg.norm(others)


@pytest.mark.parametrize(("theta", "closely"), [(0, False), (-1, True)])
def test_no_closer_than_needed(theta: int, closely: bool) -> None:
    """A linear solve leaves as much as Newton's method may, but for the methods that cannot do with less."""
    case = replace(cases.A, method="nitsche", order=2, size=4.0, theta=theta).with_increment(10, 10)
    condensed = Condensed(scene(case))
    newton = Newton(condensed)
    for _ in steps(condensed, newton, case.times()):
        pass
    x, ksp = condensed.x, newton.snes.getKSP()
    f, y, image = (x.duplicate() for _ in range(3))
    x.array[1:] *= 1.01
    condensed.residual(x, f)
    ksp.setOperators(condensed.tangent(x, True))
    assert f.norm() > 1e4
    for tolerance, share in ((10.0, 0.0), (0.0, 1e-6), (0.0, 1e-2)):
        condensed.set_accuracy(ksp, tolerance, share)
        ksp.solve(f, y)
        ksp.getOperators()[0].mult(y, image)
        image.axpy(-1.0, f)
        most = 1e-10 * f.norm() if closely else max(0.3 * tolerance, min(share, 1e-4) * f.norm())
        assert (0.0 if closely else 1e-4 * most) < image.norm() <= most


@pytest.mark.parametrize("surface", [True, False])
def test_a_soft_slave_goes_through(surface: bool) -> None:
    """With linear solves to a hundredth the surface stopped at t = 15, where the solve with all unknowns goes on."""
    side = replace(cases.SIDE, slave="die")
    case = replace(cases.A, method="nitsche", order=2, size=1.0, zones=(side,), billet=cases.Elastic(5000.0, 0.3))
    problem = scene(replace(case, die_material=cases.Elastic(2000.0, 0.3)))
    system = Condensed(problem) if surface else problem
    *_, step = steps(system, Newton(system), [10.0, 15.0, 20.0, 25.0])
    assert step.cuts == 0
    assert step.reaction == pytest.approx(224.66e3, abs=10)
