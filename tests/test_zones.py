"""Contact terms: forces by hand on one facet, tangents by central differences, and what they may not write."""

from dataclasses import replace
from functools import cache
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scenes import curve
from scipy.sparse import coo_matrix

from dolfinx import fem

from extrusion.cases import A, Case
from extrusion.contact import CLOSURES, Closure
from extrusion.gap import Surface, polyline
from extrusion.mesh import case_mesh
from extrusion.pairs import CurvePair, closed_at_start
from extrusion.problem import Problem
from extrusion.profile import SSNV504
from extrusion.zones import (
    ContactSet,
    ContactTerm,
    Expected,
    IntegratedContact,
    NodalContact,
)

LAWS = [("nodal", 0), ("mortar", 0), ("penalty", 0), ("nitsche", -1), ("nitsche", 0), ("nitsche", 1)]


# -- one facet before a slope of 3 to 4, in the plane ----------------------------------------------------------
#
#   slave from (0, 0) to (1.5, 2), 2.5 mm long; die r = 0.75 y + gap, parallel to it; k = 100 MPa/mm


def between(slave: Surface, die: Surface, **changes: Any) -> CurvePair:
    """A pair with a radial ray."""
    options: dict[str, Any] = dict(closure="unilateral", ray=True, smooth=False, extended=True, axisymmetric=False)
    return CurvePair(name="1", slave=slave, die=die, axis=0, sign=1.0, **{**options, **changes})


def facet(
    method: str, ray: bool, closure: Closure = "unilateral", end: float = 9.0, extended: bool = True
) -> ContactTerm:
    """The facet's nodes are 0 and 1, the die's 2 and 3, the multipliers stand at 8 and 9."""
    slave = curve(np.array([[0.0, 0.0], [1.5, 2.0]]))
    die = polyline(np.array([[-6.75, -9.0], [0.75 * end, end]]), 2, -1.0)
    pair = between(slave, die, closure=closure, ray=ray, extended=extended)
    k = np.array([100.0])
    return NodalContact(pair, 8, k, 50.0) if method == "nodal" else IntegratedContact(pair, k, None, 0, 50.0)


def displaced(gap: float, multipliers: int = 0) -> np.ndarray:
    """z with the facet moved along r so that its ray gap is this, and multipliers of -5 N."""
    z = np.zeros(8 + multipliers)
    z[[0, 2]] = -gap
    z[8:] = -5.0
    return z


def residual(term: ContactTerm, z: np.ndarray) -> np.ndarray:
    R = np.zeros_like(z)
    term.add_residual(z, R)
    return R


def tangent(term: ContactTerm, z: np.ndarray, geometric: bool = True) -> np.ndarray:
    rows, cols, values = term.tangent(z, geometric)
    return coo_matrix((values, (rows, cols)), shape=(len(z), len(z))).toarray()


@pytest.mark.parametrize(
    ("ray", "stress", "direction"), [(True, -10.0, [-1.0, 0.75]), (False, -8.0, [-0.8, 0.6])], ids=["ray", "closest"]
)
def test_penalty_on_one_facet(ray: bool, stress: float, direction: list[float]) -> None:
    """Pressed in by 0.1 mm along r, 0.08 mm along the normal: half the force and stiffness at either node."""
    term, z = facet("penalty", ray), displaced(-0.1)
    R = residual(term, z)
    half = 1.25 * stress * np.array(direction)
    assert_allclose(R[:4], [*half, *half])
    assert_allclose(R[4::2].sum() + R[:4:2].sum(), 0, atol=1e-12)  # what the slave feels the die feels
    assert_allclose(R[5::2].sum() + R[1:4:2].sum(), 0, atol=1e-12)
    mass = 2.5 * np.array([[1 / 3, 1 / 6], [1 / 6, 1 / 3]])
    for geometric in (False, True):
        J = tangent(term, z, geometric)
        assert_allclose(J[:4, :4], 100 * np.kron(mass, np.outer(direction, direction)), atol=1e-9)
    state = term.state(z)
    assert_allclose(state.gap, -0.1 if ray else -0.08)
    assert_allclose(state.pressure, 12.5 if ray else 8.0)
    assert_allclose(state.ray_pressure, 10.0 if ray else 6.4)
    assert_allclose(state.weight.sum(), 2.5)
    assert state.closed.all()
    assert_array_equal(residual(term, displaced(0.1)), 0)


@pytest.mark.parametrize("ray", [True, False])
def test_a_node_at_rest_is_open(ray: bool) -> None:
    """Whatever the sign that round-off gives a gap of zero without force: or two ranks part here from one."""
    for gap in (1e-14, -1e-14, 0.0):
        term, z = facet("nodal", ray), displaced(gap, 2)
        z[8:] = 1e-12 * np.sign(gap)
        term.start(z)
        assert not term.state(z).closed.any()
    pressed = displaced(-1e-14, 2)
    assert term.state(pressed).closed.all()
    assert term.state(displaced(-1e-9, 2)).closed.all()


@pytest.mark.parametrize(
    ("ray", "gap", "direction"), [(True, -0.1, [-1.0, 0.75]), (False, -0.08, [-0.8, 0.6])], ids=["ray", "closest"]
)
def test_nodal_on_one_facet(ray: bool, gap: float, direction: list[float]) -> None:
    """A multiplier of -5 N acts along the gap; its own row asks for gap 0 when closed, for no force when open."""
    term, z = facet("nodal", ray), displaced(-0.1, 2)
    term.start(z)
    R = residual(term, z)
    assert_allclose(R[:4], -5 * np.array([*direction, *direction]))
    kappa = 100 * 1.25  # k and half the facet
    assert_allclose(R[8:], kappa * gap)
    J = tangent(term, z)
    assert_allclose(J[:2, 8], direction)
    assert_allclose(J[8, :2], kappa * np.array(direction))
    assert J[8, 8] == 0
    assert_allclose(term.state(z).gap, gap)
    touching = displaced(0.0, 2)
    assert_allclose(term.state(touching).ray_pressure, [4.0 if ray else 4 * 0.8] * 2)  # 5 N on 1.25 mm
    assert_allclose(term.state(touching).pressure, [4 / 0.8 if ray else 4.0] * 2)
    z = displaced(0.2, 2)
    term.pair_up(z)
    assert_allclose(residual(term, z)[8:], 5.0)  # lambda is to vanish
    assert_allclose(tangent(term, z)[8:, 8:], -np.eye(2))
    assert_array_equal(tangent(term, z)[8:, :8], 0)


@pytest.mark.parametrize("method", ["nodal", "penalty"])
@pytest.mark.parametrize(
    ("closure", "start", "pulled"),
    [("bilateral", 0.0, True), ("bilateral", -0.1, True), ("bilateral", 0.1, False), ("unilateral", 0.0, False)],
)
def test_a_closed_point_stays_closed_in_a_sliding_channel(
    method: str, closure: Closure, start: float, pulled: bool
) -> None:
    """Closed at the start or in an accepted state, a bilateral zone pulls from then on, and only then."""
    n = 2 if method == "nodal" else 0
    term, pressed, away = facet(method, True, closure), displaced(start, n), displaced(0.2, n)
    term.start(pressed)
    term.accept(pressed)

    def pulls() -> bool:
        term.pair_up(away)
        if method == "penalty":
            return bool(np.any(residual(term, away)))
        return bool(np.any(residual(term, away)[8:] != 5.0))

    assert pulls() is pulled
    term.pair_up(away)
    term.accept(away)
    assert pulls() is pulled


def test_what_is_closed_at_the_start() -> None:
    """What touches to 1e-9 of the radius; an overlap only where the start may interpenetrate."""
    gap = np.array([0.0, 4e-8, -4e-8, 6e-8, 0.1, -0.1])
    touching = [True, True, True, False, False, False]
    assert_array_equal(closed_at_start(gap, 50.0, interpenetrating=False), touching)
    assert_array_equal(closed_at_start(gap, 50.0, interpenetrating=True), [*touching[:5], True])


@pytest.mark.parametrize("method", ["nodal", "penalty"])
@pytest.mark.parametrize("extended", [True, False])
@pytest.mark.parametrize("ray", [True, False])
def test_past_the_end_of_the_die(method: str, ray: bool, extended: bool) -> None:
    """The die ends below the facet: its line goes on, or the facet is let go."""
    n = 2 if method == "nodal" else 0
    z = displaced(-0.1, n)
    if ray:
        z[4:8] = 0.0
    term = facet(method, ray, "bilateral", end=-1.0, extended=extended)
    term.start(z)
    J = tangent(term, z)
    assert np.any(J[8:, :4] if n else J[:4, :4]) == extended


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("method", ["nodal", "penalty"])
def test_checked_contact_reports_and_does_nothing(method: str, order: int) -> None:
    """The overlap is there to read; there is no force, no stiffness and no multiplier."""
    term = facet(method, True, "check")
    z = displaced(-0.1)
    term.start(z)
    assert term.multipliers == 0
    assert_array_equal(residual(term, z), 0)
    assert_array_equal(tangent(term, z), 0)
    state = term.state(z)
    assert_allclose(state.gap, -0.1)
    assert_allclose(state.pressure, 0)
    assert state.closed.all()
    assert_allclose(term.pair.at_nodes(z).gap, -0.1)


@pytest.mark.parametrize(
    ("ends", "order", "weights"),
    [
        ([[3.0, 0], [3, 2]], 1, [6, 6]),
        ([[3.0, 0], [3, 2]], 2, [2, 8, 2]),
        ([[0.0, 0], [3, 0]], 1, [3, 6]),
        ([[0.0, 0], [3, 0]], 2, [0, 6, 3]),
    ],
)
def test_nodal_weights(ends: list, order: int, weights: list[float]) -> None:
    """Integral of N 2 pi r ds along a cylinder and over a disc, by hand, in units of pi, in order along the curve."""
    slave = curve(np.array(ends), order)
    assert_allclose(between(slave, slave, axisymmetric=True).nodal_weights() / np.pi, weights, atol=1e-12)
    flat = np.array([0.5, 0.5] if order == 1 else [1 / 6, 2 / 3, 1 / 6]) * np.linalg.norm(np.diff(ends, axis=0))
    assert_allclose(between(slave, slave).nodal_weights(), flat)


# -- the billet in the die -------------------------------------------------------------------------------------


@cache
def scene(
    method: str, theta: int, closure: Closure, gap: str, order: int, die: str, t: float
) -> tuple[list[ContactTerm], np.ndarray, np.ndarray]:
    """Terms of both zones, a contact vector at which some points are closed and some open, and which of it is live.

    At t = 22 the side straddles B and C; at t = 143 the front rides on the cone and L is past F.
    """
    zones = tuple(replace(zone, gap=gap) for zone in A.zones)
    gamma = 40.0 if theta == 1 else None
    case: Case = replace(A, method=method, theta=theta, gamma=gamma, order=order, die=die, zones=zones)
    problem = Problem(case.with_contact(closure), case_mesh(A.profile), MPI.COMM_SELF)

    def follow_the_bore(x: np.ndarray) -> np.ndarray:
        r = SSNV504.bore_radius(x[1] + t) + 0.05 * np.sin(2 * x[1])
        return np.stack([x[0] / 50 * (r - 50), np.full_like(x[0], t)])

    rng = np.random.default_rng(6)
    u = fem.Function(problem.V)
    u.interpolate(follow_the_bore, cells0=problem.tagged.cell_tags.find(problem.tagged.groups["billet"]))
    u.x.array[:] += 2e-3 * rng.standard_normal(len(u.x.array))
    x = problem.x
    x.array[: len(u.x.array)] = u.x.array
    x.array[len(u.x.array) :] = 1e4 * rng.standard_normal(problem.n_multipliers)
    z = problem.gather(x)
    for term in problem.terms:
        term.pair_up(z)
        term.closed = rng.random(len(term.closed)) < 0.3
    return problem.terms, z, problem.z_to_x >= 0


@pytest.mark.parametrize("t", [22.0, 143.0])
@pytest.mark.parametrize("closure", ["unilateral", "bilateral"])
@pytest.mark.parametrize(
    ("method", "theta", "gap", "order", "die"),
    [(*law, "ray", order, die) for law in LAWS for order in (1, 2) for die in ("rigid", "elastic")]
    + [(*law, "closest", *die) for law in LAWS if law[0] != "mortar" for die in ((2, "rigid"), (1, "elastic"))],
)
def test_tangent_by_central_differences(
    method: str, theta: int, closure: Closure, gap: str, order: int, die: str, t: float
) -> None:
    """Of a residual that is not zero, with points closed and open.

    Integrated to the closest point the normal and its foot are held: then exact for the slave's forces and motion.
    """
    terms, z, live = scene(method, theta, closure, gap, order, die, t)
    rng = np.random.default_rng(7)
    closed = np.concatenate([term.state(z).closed for term in terms])
    assert 0.1 < closed.mean() < 0.9
    for term in terms:
        J = tangent(term, z)
        assert np.any(residual(term, z)) or (t == 22 and term.pair.name == "2")
        compared = live.copy()
        if gap == "closest" and method != "nodal":
            compared[(2 * term.pair.die.nodes[..., None] + [0, 1]).ravel()] = False
        for _ in range(2):
            d = rng.standard_normal(len(z)) * compared
            found = (J @ d)[compared]
            difference = (residual(term, z + 1e-6 * d) - residual(term, z - 1e-6 * d))[compared] / 2e-6
            assert np.linalg.norm(found - difference) <= 1e-6 * np.linalg.norm(found)


@pytest.mark.parametrize("closure", CLOSURES)
@pytest.mark.parametrize(("method", "theta"), [("nodal", 0), ("mortar", 0), ("penalty", 0), ("nitsche", 1)])
def test_evaluations_write_nothing(method: str, theta: int, closure: Closure) -> None:
    """Residual, tangent and report read the accepted state and the pairing; twice the same, to the last bit."""
    terms, z, _ = scene(method, theta, closure, "ray", 1, "elastic", 22.0)
    for term in terms:
        before = {name: value.copy() for name, value in vars(term).items() if isinstance(value, np.ndarray)}
        known = z.copy()
        first = residual(term, z), tangent(term, z), term.state(z).pressure
        moved = z + 0.1
        residual(term, moved), tangent(term, moved), term.state(moved)
        for a, b in zip(first, (residual(term, z), tangent(term, z), term.state(z).pressure), strict=True):
            assert_array_equal(a, b)
        assert_array_equal(z, known)
        assert before
        for name, value in before.items():
            assert_array_equal(getattr(term, name), value, err_msg=name)


@pytest.mark.parametrize(
    ("method", "theta", "symmetric"), [("penalty", 0, True), ("nitsche", 1, True), ("nitsche", 0, False)]
)
@pytest.mark.parametrize(("order", "die"), [(1, "rigid"), (2, "rigid"), (1, "elastic")])
def test_penalty_and_theta_1_derive_from_an_energy(
    method: str, theta: int, symmetric: bool, order: int, die: str
) -> None:
    """Their tangent is symmetric, second variation and moving split points included; that of theta = 0 is not.

    The side held everywhere, so that the quadrature of the energy is exact, and with it the derivative.
    """
    terms, z, _ = scene(method, theta, "bilateral", "ray", order, die, 22.0)
    side, held = terms[0], terms[0].closed
    side.closed = np.ones_like(held)
    J = tangent(side, z)
    side.closed = held
    asymmetry = np.linalg.norm(J - J.T) / np.linalg.norm(J)
    assert (asymmetry < 1e-11) == symmetric, asymmetry


def test_contact_set_finds_its_edges_between_points() -> None:
    at = np.array([[3.0, 1.0], [0.0, 2.0]])  # in any order
    trial = np.array([[3.0, -1.0], [2.0, -1.0]])
    found = ContactSet.of(at, trial, trial < 0)
    assert not found.first
    assert not found.empty
    assert_allclose(found.edges, [2 / 3, 2.25])
    assert_array_equal(found(np.array([0.0, 1.0, 2.0, 2.5])), [False, True, True, False])
    for closed in (False, True):
        all_alike = ContactSet.of(at, trial, np.full_like(trial, closed, dtype=bool))
        assert all_alike.empty is not closed
        assert_array_equal(all_alike(at), np.full_like(trial, closed, dtype=bool))


def test_edges_of_two_sets_pair_with_the_nearest_of_their_kind() -> None:
    before = ContactSet(True, np.array([10.0, 20.0, 30.0]))  # closed to 10, from 20 to 30
    after = ContactSet(False, np.array([19.0, 29.0]))  # the first stretch is gone
    assert_array_equal(before.partners(after), [20.0, 30.0])
    assert_array_equal(after.partners(before), [np.nan, 19.0, 29.0])
    assert_array_equal(after.partners(ContactSet(True, np.array([18.0]))), [29.0])


def test_expected_set_goes_on_as_it_did() -> None:
    expected, at, pulled = Expected(), np.array([0.5, 1.4, 1.6, 3.0]), np.ones(4)
    assert not expected.expect(1.0)
    expected.accept(ContactSet(True, np.array([1.0])))
    assert expected.expect(1.0)  # all that is known is what was closed: points may close beside it
    assert_array_equal(expected.law(pulled, at, None)[1], [1, 0, 0, 0])
    assert_array_equal(expected.law(-pulled, at, None)[1], [1, 1, 1, 1])
    expected.accept(ContactSet(True, np.array([1.2])))
    for ahead, closed in ((1.0, [1, 1, 0, 0]), (1.9, [1, 1, 0, 0]), (2.1, [1, 1, 1, 0])):  # 1.2 + ahead * 0.2
        assert expected.expect(ahead)
        for trial in (pulled, -pulled):
            stress, slope = expected.law(trial, at, None)
            assert_array_equal(slope, closed)
            assert_array_equal(stress, trial * closed)
    expected.accept(ContactSet(True, np.array([1.0, 2.0, 2.5])))  # edges that were not there before
    assert expected.expect(1.0)
    assert_array_equal(expected.law(-pulled, at, None)[1], [1, 1, 1, 1])
    expected.follow(ContactSet(True, np.array([1.5])))  # what another model has found is the whole set
    held = np.array([False, False, False, True])
    assert_array_equal(expected.law(-pulled, at, None)[1], [1, 1, 0, 0])
    assert_array_equal(expected.law(pulled, at, held)[1], [1, 1, 0, 1])
    assert not expected.expect(None)
    assert not expected.on
    expected.accept(ContactSet(False, np.zeros(0)))
    assert not expected.expect(1.0)
