"""A coarser model that goes ahead: what it foresees, and that the answer is the fine model's."""

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose

from extrusion import adapt, cases, guide, result
from extrusion.cases import Case, Elastic
from extrusion.cli import app
from extrusion.condensed import Condensed
from extrusion.errors import InputError, StepError
from extrusion.guide import Guide, choose_guide, guide_size, guiding
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.result import _mesh, changed, run
from extrusion.stepping import Step, steps
from extrusion.system import Forecast, System
from extrusion.zones import ContactSet

A = changed(cases.A, method="nitsche", order=2, size=2.0, increment=5.0, until=60.0)


def scene(case: Case, comm: MPI.Intracomm = MPI.COMM_SELF) -> Problem:
    return Problem(case, _mesh(comm, case, None), comm)


def taken(system: System, foreseen: Callable[[float], Forecast | None] | None = None) -> list[Step]:
    return list(steps(system, Newton(system), system.case.times(), foreseen))


@pytest.mark.parametrize(
    ("changes", "most"),
    [
        ({}, 0.75),
        ({"method": "mortar"}, 0.85),
        ({"method": "penalty"}, 0.75),
        ({"die": "rigid", "increment": 20.0}, 0.7),
        ({"theta": 1, "gamma": 40.0}, 0.65),
        ({"space": "plane strain"}, 0.75),
        ({"billet": Elastic(5000.0, 0.4999)}, 0.85),
    ],
    ids=str,
)
def test_the_same_answer_sooner(changes: dict[str, Any], most: float) -> None:
    problem = scene(changed(A, **changes))
    plain, guided = taken(Condensed(problem)), taken(Condensed(problem), Guide(problem, 4.0))
    for one, other in zip(plain, guided, strict=True):
        assert other.points["K"] == pytest.approx(one.points["K"], abs=1e-7)
        assert other.reaction == pytest.approx(one.reaction, abs=1e-2)
    assert sum(step.iterations for step in guided) <= most * sum(step.iterations for step in plain)


@pytest.mark.parametrize("method", ["nitsche", "mortar"])
def test_a_zone_that_is_held(method: str) -> None:
    """Glissière: points that are held stay so, wherever the guide's contact ends."""
    problem = scene(changed(cases.C, method=method, order=2, size=2.0, increment=5.0, until=60.0, figures=()))
    plain, system = taken(Condensed(problem)), Condensed(problem)
    guided = taken(system, Guide(problem, 4.0))
    for one, other in zip(plain, guided, strict=True):
        assert other.points["K"] == pytest.approx(one.points["K"], abs=1e-7)
    assert sum(step.iterations for step in guided) <= 0.85 * sum(step.iterations for step in plain)
    z = system.gather(system.x)
    forces = system.contact_forces(z)
    assert np.abs(forces).max() > 1e4
    for term in system.terms:
        term.follow(ContactSet(False, np.zeros(0)))
    assert_allclose(system.contact_forces(z), forces, rtol=0, atol=1e-6)


def test_most_steps_take_one_or_two_iterations() -> None:
    """After the solve that the guide predicts, on a mesh half as coarse."""
    problem = scene(replace(A, size=1.0).with_increment(5.0, 100.0))
    guided = taken(Condensed(problem), Guide(problem, 2.0))[1:]  # the first one has nothing to solve
    assert sum(step.iterations <= 3 for step in guided) > len(guided) / 2
    assert sum(step.tangents <= 3 for step in guided) > 0.9 * len(guided)


@pytest.mark.mpi
@pytest.mark.parametrize(("solver", "method"), [("surface", "nitsche"), ("full", "mortar")])
def test_on_two_ranks(solver: str, method: str) -> None:
    problem = scene(changed(A, method=method, size=4.0, until=30.0), MPI.COMM_WORLD)
    system = Condensed(problem) if solver == "surface" else problem
    plain, guided = taken(system), taken(system, Guide(problem, 8.0))
    assert guided[-1].reaction == pytest.approx(plain[-1].reaction, abs=1e-3)
    counts = MPI.COMM_WORLD.allgather([step.iterations for step in guided])
    assert all(count == counts[0] for count in counts)
    assert sum(counts[0]) < sum(step.iterations for step in plain)


@pytest.mark.mpi
@pytest.mark.parametrize("iterates", [False, True])
def test_in_space(iterates: bool) -> None:
    """Guided in the meridian plane; glissière; with multigrid the terms may be divided among ranks."""
    case = changed(cases.B, method="nitsche", order=1, size=8.0, increment=5.0, until=15.0, figures=())
    problem = scene(case, MPI.COMM_WORLD)
    if iterates:
        problem.iterate()
    system: System = problem if iterates else Condensed(problem)
    plain, guided = taken(system), taken(system, Guide(problem, 4.0))
    assert guided[-1].points["K"] == pytest.approx(plain[-1].points["K"], abs=1e-7)
    assert sum(step.iterations for step in guided) < sum(step.iterations for step in plain)


@pytest.mark.parametrize("surface", [True, False])
def test_linearised_elsewhere(surface: bool) -> None:
    """At x itself it is residual and tangent; at a distance d it is off by what the gap's second variation, which is
    left out, makes of d, and some part of d squared."""
    problem = scene(replace(A, size=4.0).with_increment(5.0, 20.0))
    system: System = Condensed(problem) if surface else problem
    *_, _last = taken(system)
    x, z = system.x, system.gather(system.x)
    f, g, image = (x.duplicate() for _ in range(3))
    system.residual(x, g)
    system.tangent(x, False).mult(x, image)
    size = image.norm()
    A_ = system.linearised(x, f, z)
    assert_allclose(f.array_r, g.array_r, rtol=0, atol=1e-4)
    A_.mult(x, g)
    assert_allclose(g.array_r, image.array_r, rtol=0, atol=1e-9 * size)
    direction = np.where(problem.z_free, np.cos(np.arange(len(z))), 0.0)
    closed = [term.contact_set(z) for term in system.terms]
    none = np.zeros(0, dtype=np.int64)
    system.foresee(Forecast(none, np.zeros(0), closed), z)
    (rows, cols, plain), (more_rows, more_cols, whole) = (system.contact_tangent(z, which) for which in (False, True))
    turned = np.bincount(more_rows, whole * direction[more_cols], len(z))
    turned -= np.bincount(rows, plain * direction[cols], len(z))
    off = []
    for d in (2e-4, 1e-4):
        D = system.contact_tangent(z + d * direction, False)
        off.append(
            np.linalg.norm(system.linear_forces(z, z + d * direction, D) - system.contact_forces(z) - d * turned)
        )
    assert off[0] > 1e-3
    assert 3.0 < off[0] / off[1] < 5.0  # 4
    system.linearised(x, f, z + d * direction)
    system.expect(None)
    system.residual(x, g)
    f.axpy(-1.0, g)
    assert f.norm() < 2 * d * np.linalg.norm(turned)


def test_nothing_is_linearised_where_surfaces_are_lost() -> None:
    problem = scene(replace(A, size=4.0))
    for system in (Condensed(problem), problem):
        list(steps(system, Newton(system), [5.0]))
        f, lost = system.x.duplicate(), system.gather(system.x)
        lost[1::2] = -1e3 * np.sign(np.cos(np.arange(len(lost[1::2]))))  # facets turned round
        lost[::2] = np.nan
        system.linearised(system.x, f, lost)
        assert not np.isfinite(f.norm())


def test_displacements_are_carried_over() -> None:
    """A quadratic displacement of the guide's nodes along each straight piece is that of the finer mesh's nodes."""
    problem = scene(replace(A, size=1.5))
    ahead = guide._Ahead(problem, 4.0)

    def field(X: np.ndarray) -> np.ndarray:
        r, y = X[..., 0] / 50, X[..., 1] / 65
        return np.stack([1 + r - 2 * y + 3 * y * y, 2 - y + r * y - r * r], axis=-1)

    z = np.zeros(ahead._system.n_z)
    for term in ahead._system.terms:
        for surface in (term.pair.slave, term.pair.die):
            z[2 * surface.nodes[..., None] + np.arange(2)] = field(surface.X)
    found = np.full(problem.n_z, np.nan)
    found[ahead._entries] = np.concatenate([link(z) for link in ahead._links])
    assert problem.z_free[ahead._entries].all()
    for term in problem.terms:
        for surface in (term.pair.slave, term.pair.die):
            entries = 2 * surface.nodes[..., None] + np.arange(2)
            free = problem.z_free[entries]
            assert free.mean() > 0.9
            assert_allclose(found[entries][free], field(surface.X)[free], rtol=0, atol=1e-9)


def test_displacements_are_carried_into_space() -> None:
    """u = (r, 2 y) in the meridian plane is (x, 2 y, z) in space."""
    case = changed(cases.B, method="nitsche", order=2, size=12.0, figures=())
    problem = scene(case)
    ahead = guide._Ahead(problem, 8.0)
    z, found = np.zeros(ahead._system.n_z), np.full(problem.n_z, np.nan)
    for term in ahead._system.terms:
        for surface in (term.pair.slave, term.pair.die):
            z[2 * surface.nodes[..., None] + np.arange(2)] = surface.X * [1, 2]
    found[ahead._entries] = np.concatenate([link(z) for link in ahead._links])
    for term in problem.terms:
        for surface in (term.pair.slave, term.pair.die):
            entries = 3 * surface.nodes[..., None] + np.arange(3)
            free = problem.z_free[entries]
            assert_allclose(found[entries][free], (surface.X * [1, 2, 1])[free], rtol=0, atol=1e-9)


def test_what_it_foresees_is_near() -> None:
    problem = scene(A)
    ahead = Guide(problem, 4.0)
    for step in steps(problem, Newton(problem), A.times()):
        forecast = ahead(step.t)
        assert forecast is not None
        z = problem.gather(step.x)
        assert np.abs(z[forecast.entries] - forecast.values).max() < 0.2
        ours, theirs = (
            found.closed for found in (replace(forecast, closed=[t.contact_set(z) for t in problem.terms]), forecast)
        )
        if step.t > 5.0:
            assert ours[0].edges[0] == pytest.approx(theirs[0].edges[0], abs=1.0)


@pytest.mark.parametrize("surface", [True, False])
@pytest.mark.parametrize("far", [5.0, 1e6, np.nan])
def test_a_forecast_that_is_wrong(surface: bool, far: float) -> None:
    """It is dropped, or the increment is solved again without: the answer is the same."""
    problem = scene(changed(A, size=4.0, until=20.0))
    system: System = Condensed(problem) if surface else problem
    true, plain = Guide(problem, 8.0), taken(system)

    def wrong(t: float) -> Forecast | None:
        found = true(t)
        assert found is not None
        shaken = found.values + far * np.cos(np.arange(len(found.values)))
        return Forecast(found.entries, shaken, [ContactSet(False, np.zeros(0)) for _ in found.closed])

    found = taken(system, wrong)
    assert [step.t for step in found] == [step.t for step in plain]
    assert found[-1].reaction == pytest.approx(plain[-1].reaction, abs=1e-3)


def test_a_forecast_that_is_no_number() -> None:
    """It is as if there were none."""
    problem = scene(changed(A, size=4.0, until=40.0))
    for system in (Condensed(problem), problem):
        times = [5.0, 10.0, 20.0, 25.0, 40.0]  # how far an edge moves hangs on the increment
        alone = list(steps(system, Newton(system), times))
        entries = Guide(problem, 8.0)(5.0).entries
        none = Forecast(entries, np.full(len(entries), np.nan), 2 * [ContactSet(True, np.zeros(0))])
        found = list(steps(system, Newton(system), times, lambda t, none=none: none))
        assert [step.iterations for step in found] == [step.iterations for step in alone]
        assert [step.tangents for step in found] == [step.tangents for step in alone]


def test_an_increment_that_is_led_astray(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is solved again whole, as if there were no guide, and where it is cut its parts are not guided."""
    problem = scene(changed(A, size=4.0, until=25.0))
    system, asked = Condensed(problem), []
    newton = Newton(system)
    solve, cut, starts = newton.solve, [], []

    def stuck(x: Any, at_most: int | None = None, ahead: Any = 1.0, share: float = 0.0) -> Any:
        starts.append(x.array_r.copy())
        done = solve(x, at_most, ahead, share)
        astray = isinstance(ahead, Forecast)
        if not astray and asked[-1] == 15.0 and not cut:
            astray = bool(cut.append(True)) or True
        return replace(done, converged=False, reason="led astray") if astray else done

    monkeypatch.setattr(newton, "solve", stuck)
    true = Guide(problem, 8.0)
    found = list(steps(system, newton, problem.case.times(), lambda t: asked.append(t) or true(t)))
    assert asked == [5.0, 10.0, 15.0, 20.0, 25.0]
    assert [step.cuts for step in found] == [0, 0, 1, 0, 0]
    assert_allclose(starts[3], starts[2], rtol=0, atol=0)  # of the second increment
    monkeypatch.undo()
    plain = taken(system)
    assert found[-1].reaction == pytest.approx(plain[-1].reaction, abs=1e-3)
    # what has been led astray is not counted as converged, but it is counted
    assert found[1].iterations > plain[1].iterations


def test_how_near_it_was_is_known() -> None:
    """The second variation of the gap is taken at once where the predicted solve ends near what was foreseen."""
    problem = scene(replace(A, size=1.0).with_increment(20.0, 20.0))
    system = Condensed(problem)
    newton, forecast = Newton(system), Guide(problem, 2.0)(20.0)
    *_, _last = steps(system, newton, [15.0])
    system.shift_billet(system.x, 5.0)
    newton._begin()
    newton.tolerance = 1e-3
    assert newton._predict(system.x, forecast) == 1
    missed = np.abs(system.gather(system.x)[forecast.entries] - forecast.values).max()
    assert newton._update == pytest.approx(missed)
    assert missed < newton._near


def test_from_where_surfaces_have_lost_each_other() -> None:
    """The residual of such a start is no number; with a forecast it does not matter."""
    problem = scene(changed(A, size=4.0, increment=20.0, until=20.0))
    forecast = Guide(problem, 8.0)(20.0)
    for system, astray in ((Condensed(problem), 1e9), (problem, 1e3)):
        newton = Newton(system)
        *_, _last = steps(system, newton, [20.0])
        x, found = system.x, system.x.copy()
        for ahead in (1.0, forecast):
            x.array[1:] = astray * np.cos(np.arange(x.size - 1))
            system.drive(x, 20.0)
            assert newton.solve(x, ahead=ahead).converged is (ahead is forecast)
        x.axpy(-1.0, found)
        assert x.norm() < 1e-6 * found.norm()


def test_a_guide_that_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    """The guided model goes on by itself."""
    problem = scene(changed(A, size=4.0, until=20.0))

    def stopping(*of: Any) -> Any:
        for step in steps(*of):
            if step.t > 10.0:
                raise StepError("no further")
            yield step

    monkeypatch.setattr(guide, "steps", stopping)
    ahead = Guide(problem, 8.0)
    found = taken(Condensed(problem), ahead)
    assert [step.t for step in found] == [5.0, 10.0, 15.0, 20.0]
    assert [ahead(t) for t in (15.0, 20.0)] == [None, None]


@pytest.mark.mpi
@pytest.mark.parametrize("error", [ArithmeticError, PETSc.Error])
def test_a_guide_that_fails(error: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    """On rank 0 alone, and the others are told."""

    def failing(*of: Any) -> Any:
        yield from ()
        raise error(77)

    monkeypatch.setattr(guide, "steps", failing)
    ahead = Guide(scene(changed(A, size=4.0, until=20.0), MPI.COMM_WORLD), 8.0)
    assert ahead(5.0) is None
    assert ahead(10.0) is None


def test_a_guide_that_finds_it_hard(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is given up once it has to cut an increment."""
    monkeypatch.setattr(guide, "steps", lambda *of: (replace(step, cuts=int(step.t > 7)) for step in steps(*of)))
    ahead = Guide(scene(changed(A, size=4.0, until=20.0)), 8.0)
    assert [ahead(t) is None for t in (5.0, 10.0, 15.0)] == [False, False, True]


def test_only_ends_of_increments_are_foreseen() -> None:
    ahead = Guide(scene(changed(A, size=4.0, until=20.0)), 8.0)
    assert ahead(5.0) is not None
    assert ahead(7.0) is None
    assert ahead(15.0) is not None


def test_only_the_guided_model_speaks(caplog: pytest.LogCaptureFixture) -> None:
    """The scene is warned of once, and the logger's level is what it was."""
    case = replace(changed(A, size=4.0, until=5.0), die_material=Elastic(2000.0, 0.3))
    logging.getLogger("extrusion").setLevel(logging.INFO)
    try:
        problem = scene(case)
        assert len(caplog.records) == 1
        taken(problem, Guide(problem, 8.0))
        assert len(caplog.records) == 1
        assert logging.getLogger("extrusion").level == logging.INFO
    finally:
        logging.getLogger("extrusion").setLevel(logging.NOTSET)


@pytest.mark.parametrize(
    ("size", "in_plane", "in_space"),
    [(10.0, None, 4.0), (3.87, 8.0, 4.0), (1.97, 4.0, 4.0), (0.498, 4.0, 4.0), (0.45, 2.0, 2.0), (0.01, 1.0, 1.0)],
)
def test_size(size: float, in_plane: float | None, in_space: float) -> None:
    """Two to eight times as large as the largest facet, and one that is shipped."""
    problem = scene(replace(A, size=4.0))
    object.__setattr__(problem.terms[0].pair.slave, "length", np.array([0.1 * size, size]))
    assert guide_size(problem) == in_plane
    problem.dim = 3
    assert guide_size(problem) == in_space


def test_size_is_that_of_the_billet() -> None:
    """Whichever is slave, and no larger than half its length."""
    slave = replace(A, size=4.0, zones=tuple(replace(zone, slave="die") for zone in A.zones))
    problem = scene(slave)
    object.__setattr__(problem.terms[0].pair.slave, "length", np.array([0.01]))
    assert guide_size(problem) == 8.0
    problem.case = replace(slave, profile=replace(A.profile, length=15.0))
    assert guide_size(problem) is None


def test_case() -> None:
    """Whatever is guided, its guide is P2 and Nitsche's method as it is by default, in the meridian plane."""
    case = changed(cases.J, method="penalty", order=2, figures=(), size=7.0, increment=5.0)
    plain = guiding(case, 4.0)
    assert (plain.space, plain.method, plain.order, plain.size) == ("axisymmetric", "nitsche", 2, 4.0)
    assert (plain.mesh, plain.sectors, plain.off_symmetry) == (None, None, 0.0)
    assert plain.times() == case.times()
    assert plain.zones == case.zones


def test_chosen_where_it_saves(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = scene(replace(A, size=4.0))
    system = Condensed(problem)
    assert choose_guide(problem, system) is None
    assert choose_guide(problem, system, "off") is None
    assert choose_guide(problem, problem) is not None  # where each iteration factors anew
    monkeypatch.setattr(guide, "seconds_an_iteration", lambda *of: 1.0)
    found = choose_guide(problem, system)
    assert found is not None
    assert found.size == 8.0
    assert choose_guide(problem, system, "off") is None
    problem.case = problem.case.with_contact("check")
    assert choose_guide(problem, system) is None
    problem.case = A

    def no_gmsh(*of: Any) -> Any:
        raise InputError("size", 8.0, "needs gmsh")

    monkeypatch.setattr(guide, "case_mesh", no_gmsh)
    assert choose_guide(problem, system) is None
    with pytest.raises(InputError, match=r"^guide = 'on': it has no mesh of 8 mm \(needs gmsh\): leave it out$"):
        choose_guide(problem, system, "on")


def test_a_mesh_that_is_not_shipped_takes_longer() -> None:
    other = replace(A, profile=replace(A.profile, radius=49.0))
    for size in (4.0, 2.0):
        assert guide._seconds(other, size) > guide._seconds(A, size) + 0.5
    assert guide._seconds(A.with_increment(1.0), 4.0) > guide._seconds(A, 4.0)


@pytest.mark.parametrize(
    ("changes", "choice", "message"),
    [
        ({}, "maybe", "guide = 'maybe': choose one of auto, on, off"),
        ({"method": "nodal"}, "on", "guide = 'on': nodal contact pairs its nodes anew: leave it out"),
        ({"tolerance": 0.01}, "on", "guide = 'on': leave it out: with a tolerance the model is chosen"),
        ({"contact": "check"}, "on", "guide = 'on': contact is only checked: leave it out"),
        ({"size": 10.0}, "on", "guide = 'on': there is no coarser mesh: leave it out"),
    ],
)
def test_refused(changes: dict[str, Any], choice: str, message: str, tmp_path: Path) -> None:
    scene_ = A if "tolerance" not in changes else cases.A
    with pytest.raises(InputError) as told:
        run(scene_, until=5.0, guide=choice, out=tmp_path / "a", **changes)
    assert str(told.value) == message
    assert not (tmp_path / "a").exists()


def test_what_is_only_checked_is_not_guided(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(result, "run", lambda case, **options: asked.append((case.zones[0].contact, options["guide"])))
    result.verify(cases.A, guide="on")
    assert asked == [("unilateral", "on"), ("check", "off")]


def test_adapted_meshes_are_guided_as_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(adapt, "choose_guide", lambda problem, system, guide: asked.append(guide))
    run(cases.A, tolerance=0.05, adapt=True, guide="off", until=5.0)
    assert asked
    assert set(asked) == {"off"}


def test_from_the_command_line(tmp_path: Path) -> None:
    args = ["run", "A", "--method", "nitsche", "--order", "2", "--size", "4", "--until", "10", "--no-pictures"]
    args += ["--out", str(tmp_path / "a"), "--json", "-"]
    done = CliRunner().invoke(app, [*args, "--guide", "on"])
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout)
    assert data["guide"] == 8.0
    assert data["seconds"]["guide"] > 0
    assert json.loads((tmp_path / "a" / "run.json").read_text())["options"]["guide"] == "on"
    plain = json.loads(CliRunner().invoke(app, args).stdout)
    assert plain["guide"] is None
    assert sum(s["iterations"] for s in data["steps"]) < sum(s["iterations"] for s in plain["steps"])
