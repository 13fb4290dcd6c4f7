"""What a simpler model costs, estimated before it is taken."""

from dataclasses import replace
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest

from extrusion import cases, estimate, run
from extrusion.condensed import Condensed
from extrusion.errors import InputError
from extrusion.estimate import Error, Track, checks, choose_model, continuous, solve
from extrusion.mesh import case_mesh
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.reference import problems
from extrusion.stepping import steps

SELF = MPI.COMM_SELF
UNTIL_50 = problems()["unilateral"].with_increment(10.0, 50.0)


def test_distance_is_relative_and_largest() -> None:
    """The reaction's error is that of its scale where it is small."""
    better = Track((5.0, 10.0), (5.0, 10.0), (100.0, 2000.0))
    worse = Track((5.0, 10.0), (5.1, 10.1), (150.0, 1800.0))
    assert worse.distance(better, 1000.0) == Error(pytest.approx(0.02), pytest.approx(0.1))


@pytest.mark.parametrize("contact", ["unilateral", "bilateral"])
def test_die_effect_is_what_an_elastic_die_changes(contact: str) -> None:
    """Forces on the die with the wrong sign, or a gap that its displacement opens instead of closes."""
    case = replace(UNTIL_50.with_contact(contact), size=8.0, zones=UNTIL_50.with_contact(contact).zones[:1])  # type: ignore[arg-type]
    problem = Problem(case, case_mesh(case.profile, case.mesh_size), SELF)
    stiff = Condensed(problem, stiff_die=True)
    rigid = [
        (s.points["K"][1], s.reaction, *stiff.die_effect(stiff.x)) for s in steps(stiff, Newton(stiff), case.times())
    ]
    elastic = Condensed(problem)
    actual = [(s.points["K"][1], s.reaction) for s in steps(elastic, Newton(elastic), case.times())]
    K, R, dK, dR = np.array(rigid).T
    np.testing.assert_allclose(dK, np.array(actual)[:, 0] - K, rtol=0.25)
    ratio = np.max(np.abs(dR)) / np.max(np.abs(np.array(actual)[:, 1] - R))
    assert 0.8 < ratio < 2  # first order, on a coarse mesh


def test_die_effect_is_solved_closely() -> None:
    """It is one linear solve, that no step of Newton's method mends: it is asked twice, after looser ones."""
    case = replace(UNTIL_50, size=8.0)
    stiff = Condensed(Problem(case, case_mesh(case.profile, case.mesh_size), SELF), stiff_die=True)
    tangent = stiff._tangent
    for _ in steps(stiff, Newton(stiff), case.times()):
        tangent.set_accuracy(0.1, 1e3)
        effect = stiff.die_effect(stiff.x)
        tangent.set_accuracy(0.0, 0.0)
        np.testing.assert_allclose(effect, stiff.die_effect(stiff.x), rtol=1e-7, atol=1e-9)


def test_a_stiff_die_is_a_rigid_one() -> None:
    """A die that gives way a little; the two differ by where coarse facets are split alone."""
    tracks = []
    for die, stiff in (("elastic", True), ("rigid", False)):
        done, _ = solve(replace(UNTIL_50, die=die, size=8.0), SELF, stiff_die=stiff)  # type: ignore[arg-type]
        tracks.append(Track.of(done))
    error = tracks[0].distance(tracks[1], 7.8e5)
    assert error.K < 2e-4
    assert error.reaction < 8e-3


def test_the_cheapest_model_that_is_good_enough() -> None:
    """A tolerance that changes nothing, a zone left in that never touches, an elastic die where a rigid one serves."""
    chosen, estimate = choose_model(replace(cases.A, increments=UNTIL_50.increments), 5e-3, "K", SELF)
    assert (chosen.die, chosen.order, len(chosen.zones)) == ("rigid", 2, 1)
    assert estimate.error.K < 5e-3
    fine, better = choose_model(replace(cases.A, increments=UNTIL_50.increments), 5e-4, "K", SELF)
    assert fine.die == "elastic"
    assert better.error.K < 5e-4
    taken = {part.name: part.taken for part in estimate.parts}
    assert taken["rigid instead of elastic die"]
    assert not taken["linear instead of quadratic elements, 4 mm"]
    assert any("no zone 2" in name for name in taken)


def test_result_has_its_estimate() -> None:
    """An estimate that is lost on the way to the user."""
    result = run(cases.A, tolerance=5e-3, increment=10, until=20)
    assert result.estimate is not None
    assert result.estimate.error.K <= 5e-3
    assert result.to_dict()["estimate"]["tolerance"] == 5e-3
    assert "± mm" in result._repr_html_()
    assert result.case.die == "rigid"


@pytest.mark.parametrize(
    ("options", "field"),
    [({"tolerance": 0.0}, "tolerance"), ({"tolerance": 1e-9}, "tolerance"), ({"tolerance": 0.1, "goal": "L"}, "goal"),
     ({"tolerance": 0.1, "size": 4.0}, "size")],
)  # fmt: skip
def test_bad_input(options: dict[str, object], field: str) -> None:
    """A tolerance that no mesh reaches is known before the finest is run."""
    with pytest.raises(InputError, match=field):
        run(cases.A, increment=10, until=20, **options)  # type: ignore[arg-type]


def test_continuous_problem_of_a_case() -> None:
    """A discretisation of the sheet's that survives: its slave side, normals or method."""
    scene = continuous(cases.D)
    assert (scene.method, scene.order, scene.mesh) == ("nitsche", 2, None)
    assert all(zone.slave == "billet" and zone.gap is None and not zone.smooth for zone in scene.zones)


@pytest.mark.slow
def test_estimates_hold() -> None:
    """An estimate more than twice too small, or ten times too large."""
    for check in checks(SELF):
        assert check.ok, check


@pytest.mark.parametrize(("end", "kept"), [(150.0, 1), (210.0, 2)])
def test_a_zone_beyond_the_end_of_the_die_is_kept(monkeypatch: pytest.MonkeyPatch, end: float, kept: int) -> None:
    """With it the side that passes the bore's end (y = 205) is held, without it it is let go: that is another scene."""
    zones = {"1": SimpleNamespace(x=np.array([[48.0, end]])), "2": SimpleNamespace(gap=np.array([30.0]))}
    monkeypatch.setattr(estimate, "solve", lambda *_: ([SimpleNamespace(zones=zones)], []))
    scene, parts = estimate._without_open_zones(cases.A, 8.0, MPI.COMM_SELF)
    assert len(scene.zones) == kept
    assert len(parts) == 2 - kept
