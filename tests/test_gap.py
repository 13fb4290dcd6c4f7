"""Gaps between curves: at the die's corners by hand, elsewhere by a slow and readable second route."""

from dataclasses import replace
from itertools import pairwise

from mpi4py import MPI

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scenes import curve
from scipy.optimize import brentq

import ufl
from dolfinx import fem

from extrusion.cases import STEEL, A
from extrusion.elasticity import epsilon, sigma
from extrusion.gap import (
    Points,
    Surface,
    closest_points,
    closest_rows,
    invert,
    polyline,
    ray_gap,
    ray_points,
    shape,
    stress_rows,
)
from extrusion.mesh import case_mesh, distribute
from extrusion.profile import SSNV504, Profile
from extrusion.surfaces import gather_trace

BORE, SIDE = SSNV504.curve(SSNV504.bore), -1.0  # A to F, with the die to the right of it
FACETS = polyline(BORE, 0, SIDE).X
NORMALS = SSNV504.normals(SSNV504.bore)
THROAT = replace(SSNV504, bore=("B", "C", "D", "E"))  # its end lines, extended, are inclined
HEIGHTS = np.array([-7.0, 0, 35, 70, 77.5, 85, 100, 115, 125, 135, 170, 205, 212])  # corners, between, past the ends


# -- closest point ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 1e-12, -1e-12])
@pytest.mark.parametrize(("i", "corner"), [*enumerate("ABCDEF")])
def test_a_point_on_a_corner_belongs_to_the_segment_ahead(i: int, corner: str, offset: float) -> None:
    """Left to round-off, the normal at M would depend on the machine, or on the number of ranks."""
    x = SSNV504.points[corner] + np.array([0.0, offset])
    found = closest_points(x[None], FACETS, SIDE)
    ahead = min(i, 4)
    assert found.facet == ahead
    assert not found.past
    assert_allclose(found.normal[0], NORMALS[ahead], atol=1e-15)
    assert_allclose(found.k, 1.0 if corner == "F" else 0.0, atol=1e-9)


@pytest.mark.parametrize(("corner", "segment"), [("B", 1), ("E", 4)])
def test_a_tie_between_the_sides_of_a_hollow_corner_goes_ahead(corner: str, segment: int) -> None:
    """On the bisector of B or E both sides are equally near."""
    bisector = NORMALS[segment - 1] + NORMALS[segment]
    x = SSNV504.points[corner] + 2 * bisector / np.linalg.norm(bisector)
    found = closest_points(x[None], FACETS, SIDE)
    assert found.facet == segment
    assert found.k > 0.001  # on the side, not at the corner


@pytest.mark.parametrize(("corner", "segment"), [("C", 2), ("D", 3)])
def test_in_the_fan_of_a_protruding_corner(corner: str, segment: int) -> None:
    """Between the two normals of C or D the closest point is the corner, its normal that of the segment ahead."""
    between = NORMALS[segment - 1] + NORMALS[segment]
    x = SSNV504.points[corner] + between / np.linalg.norm(between)
    found = closest_points(x[None], FACETS, SIDE)
    assert (found.facet, found.k) == (segment, 0.0)
    assert_allclose(found.normal[0], NORMALS[segment])


@pytest.mark.parametrize("order", [1, 2])
def test_past_the_ends_the_line_goes_on(order: int) -> None:
    """7 mm before B and beyond E the gap is that to the lines B-C and D-E, and the point is said to be past."""
    x = np.array([[50.0, 63.0], [46.0, 142.0], [44.0, 100.0]])
    throat = curve(THROAT.curve(THROAT.bore), order, side=SIDE)
    found, gap, _, _ = closest_rows(np.zeros((3, 1), int), np.ones((3, 1)), x, throat, np.zeros(14))
    assert_allclose(found.facet, [0, 2, 1])
    assert_allclose(found.past, [True, True, False])
    cos = np.array([3 / np.sqrt(10), 20 / np.sqrt(409), 1])
    assert_allclose(gap, (THROAT.bore_radius(x[:, 1]) - x[:, 0]) * cos)


def test_a_point_at_rest_on_a_corner_keeps_its_facet() -> None:
    """Within 2 % of the facet's length past its end; else M would flip between B's sides from pass to pass."""
    y, keep = np.array([70.5, 70.5, 73.0, 72.0, 35.0]), np.array([0, 1, 0, 1, 2])
    x = np.column_stack([SSNV504.bore_radius(y) - 0.1, y])
    found = closest_points(x, FACETS, SIDE, keep=keep)
    assert_allclose(found.facet, [0, 1, 1, 1, 0])  # the last was not a neighbour of the nearest
    assert found.k[0] == 1.0


def test_closest_point_of_a_curved_facet() -> None:
    """Parabola y = x^2 / 8 on (-2, 2): the point (0, -1) faces its bottom, (1, 0) the root of x^3 + 32 x = 32."""
    parabola = np.array([[[-2.0, 0.5], [2.0, 0.5], [0.0, 0.0]]])
    found = closest_points(np.array([[0.0, -1.0], [1.0, 0.0]]), parabola, 1.0)
    foot = brentq(lambda x: x**3 + 32 * x - 32, 0, 2)
    assert_allclose(found.k, [0.5, (foot + 2) / 4], atol=1e-12)
    normal = np.array([foot / 4, -1]) / np.hypot(foot / 4, 1)
    assert_allclose(found.normal, [[0, -1], normal], atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gap_to_the_closest_point_is_a_distance(sign: float) -> None:
    """Against the smallest distance to 40,000 points of the bore: positive inside it, negative within the die."""
    rng = np.random.default_rng(1)
    middle, half = (BORE[1:] + BORE[:-1]) / 2, np.diff(BORE, axis=0) / 2
    segment = np.repeat(np.arange(5), 10)
    foot = middle[segment] + rng.uniform(-0.9, 0.9, (50, 1)) * half[segment]
    x = foot + sign * rng.uniform(0.1, 0.5, (50, 1)) * NORMALS[segment]
    _, gap, _, _ = closest_rows(np.zeros((50, 1), int), np.ones((50, 1)), x, polyline(BORE, 1, SIDE), np.zeros(14))
    fine = np.vstack([a + (b - a) * np.linspace(0, 1, 8000)[:, None] for a, b in pairwise(BORE)])
    distance = np.min(np.linalg.norm(x[:, None] - fine[None], axis=2), axis=1)
    assert_allclose(gap, sign * distance, atol=2e-4)  # half a spacing of 0.009 mm, squared, over twice 0.1 mm


def test_turning_the_curve_round_changes_nothing() -> None:
    """Order of the vertices and `side` go together; alone either turns the normal into the die."""
    x = np.column_stack([SSNV504.bore_radius(HEIGHTS) - 0.3, HEIGHTS + 0.1])
    surface = polyline(BORE, 0, SIDE)
    back = surface.reversed()
    one, other = closest_points(x, surface.X, surface.side), closest_points(x, back.X, back.side)
    assert_allclose(one.normal, other.normal, atol=1e-15)
    assert_allclose(surface.normal, NORMALS, atol=1e-15)
    assert_allclose(back.normal, NORMALS[::-1], atol=1e-15)


def test_smooth_normals() -> None:
    """At a vertex the mean of both sides, halfway along a segment the mean of its two ends."""
    mean = NORMALS[0] + NORMALS[1]
    mean /= np.linalg.norm(mean)
    found = closest_points(np.array([[50.0, 70.0], [50.0, 35.0]]), FACETS, SIDE, smooth=True)
    halfway = (mean + NORMALS[0]) / np.linalg.norm(mean + NORMALS[0])
    assert_allclose(found.normal, [mean, halfway], atol=1e-15)


def test_a_segment_without_length_is_named() -> None:
    """It has no normal."""
    with pytest.raises(ValueError, match="facet 1 of the die has zero length"):
        closest_points(np.zeros((1, 2)), np.array([[[0.0, 0], [1, 0]], [[1, 0], [1, 0]]]), 1.0)


@pytest.mark.parametrize(
    ("y", "moved"), [([3.0, 40, 75, 80, 90, 110, 120, 130, 150], "both"), ([-5.0, 0.1, 70.2, 208], "slave")]
)
@pytest.mark.parametrize("order", [1, 2])
def test_derivative_of_the_closest_point_gap(order: int, y: list[float], moved: str) -> None:
    """Exact opposite a facet; where the normal is held (past the ends, at a corner) exact for the slave's motion."""
    rng = np.random.default_rng(2)
    die = curve(BORE, order, side=SIDE)
    n = die.nodes.max() + 1
    X = np.column_stack([SSNV504.bore_radius(y) - 0.2, y])
    z = 0.05 * rng.standard_normal(2 * (n + len(y)))

    def evaluate(z: np.ndarray) -> tuple:
        nodes = n + np.arange(len(y))[:, None]
        return closest_rows(nodes, np.ones((len(y), 1)), X + z.reshape(-1, 2)[n:], die, z)

    _, _, G, cols = evaluate(z)
    for _ in range(3):
        d = rng.standard_normal(z.shape)
        if moved == "slave":
            d[: 2 * n] = 0.0
        difference = (evaluate(z + 1e-6 * d)[1] - evaluate(z - 1e-6 * d)[1]) / 2e-6
        assert_allclose(np.sum(G * d[cols], axis=1), difference, atol=1e-8)


# -- ray -------------------------------------------------------------------------------------------------------


def oriented(axis: int, sign: float, xy: np.ndarray) -> np.ndarray:
    """(r, y) laid so that the ray of zone 1 runs along another axis, or backwards."""
    xy = np.array(xy, dtype=float)
    xy[..., 0] *= sign
    return xy if axis == 0 else xy[..., ::-1]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("gap", [0.25, 0.0, -0.25])
@pytest.mark.parametrize("profile", [SSNV504, THROAT], ids=["A to F", "B to E"])
def test_ray_gap_at_every_corner(profile: Profile, gap: float, axis: int, sign: float) -> None:
    """Bore radius less r, by the profile's own function; a lost sign or exchanged axis shows on B-C and D-E."""
    x = oriented(axis, sign, np.column_stack([profile.bore_radius(HEIGHTS) - gap, HEIGHTS]))
    bore = profile.curve(profile.bore)
    die = polyline(oriented(axis, sign, bore), 0, SIDE)
    found, slope, _, place = ray_gap(x, die, np.zeros(2 * len(bore)), axis, sign)
    past = (bore[0, 1] > HEIGHTS) | (bore[-1, 1] < HEIGHTS)
    assert_allclose((place < 0) | (place > 1), past)
    assert_allclose(found, gap, atol=1e-12)
    inclined = {77.5: -1 / 3, 125.0: 3 / 20, 100.0: 0.0}
    assert_allclose([slope[HEIGHTS.tolist().index(y)] for y in inclined], sign * np.array([*inclined.values()]))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ray_points_have_the_ray_gap(order: int, axis: int, sign: float) -> None:
    """One facet over the whole die and past both ends, upright and turned over."""
    die = polyline(oriented(axis, sign, THROAT.curve(THROAT.bore)), 10, SIDE)
    for ends in ([[44.0, 60.0], [47.0, 150.0]], [[44.0, 150.0], [47.0, 60.0]]):
        slave = curve(oriented(axis, sign, ends), order)
        points = ray_points(slave, die, np.zeros(28), axis, sign, 4, axisymmetric=False)
        assert points.gap.shape == (5, 4)  # B to E cut the facet four times
        r, y = np.moveaxis(oriented(axis, 1.0, shape(points.xi, order + 1) @ slave.X[points.facet]), -1, 0)
        r = sign * r
        assert_allclose(points.gap, THROAT.bore_radius(y) - r, atol=1e-12)
        assert_allclose(points.past, (y < 70) | (y > 135))


@pytest.mark.parametrize(
    ("values", "target"),
    [([0, 3], 1), ([3, 0], 1), ([0, 3, 1.5], 1), ([0, 3, 1.2], 1), ([3, 0, 1.2], 2.9), ([0, 1, 0.5 + 1e-13], 0.3),
     ([0, 3, 0.3], 1), ([0, 3, 3.2], 2)],
)  # fmt: skip
def test_invert(values: list[float], target: float) -> None:
    """The other root of the quadratic, or its division by a vanishing leading term."""
    (xi,) = invert(np.array([values]), np.array([target]))
    assert 0 <= xi <= 1
    assert shape(np.array(xi), len(values)) @ values == pytest.approx(target, abs=1e-12)


def bent(order_s: int, order_d: int, scene: str, seed: int = 3) -> tuple[Surface, Surface, np.ndarray]:
    """A slave curve before (and partly in) a deformable die, both bent at random.

    Scenes: a fine side ("along"), facets that straddle several die vertices ("straddled"), one that runs past both
    ends ("past"), one whose facets have turned over ("folded"), and one whose facets turn back within ("crushed").
    """
    rng = np.random.default_rng(seed)
    die = curve(THROAT.curve(THROAT.bore), order_d, side=SIDE)
    heights = {
        "along": np.array([72.0, 75, 83, 91, 101, 113, 122, 132]),
        "straddled": np.array([72.0, 131, 133]),
        "past": np.array([40.0, 60, 80, 130, 144, 150]),
        "folded": np.array([75.0, 87, 80, 72, 120, 110]),
        "crushed": np.array([75.0, 87, 80, 72, 120, 110]),
    }[scene]
    n_die = die.nodes.max() + 1
    slave = curve(np.column_stack([45 + 0.02 * heights, heights]), order_s, first_node=n_die)
    z = 0.3 * rng.standard_normal(2 * (slave.nodes.max() + 1))
    if scene == "crushed" and order_s == 2:  # the middle nodes go near an end, or past it
        z[2 * slave.nodes[:, 2] + 1] += np.array([-0.45, -0.7, 0.4, 0.6, -0.3]) * np.diff(heights)
    return slave, die, z


ORDERS = [(1, 1), (1, 2), (2, 1), (2, 2)]
SCENES = ["along", "straddled", "past", "folded", "crushed"]


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("order_s", "order_d"), ORDERS)
def test_ray_points_by_slow_loops(order_s: int, order_d: int, scene: str) -> None:
    """Pieces, weights and gaps found one by one with SciPy's root finder."""
    slave, die, z = bent(order_s, order_d, scene)
    u = z.reshape(-1, 2)
    points = ray_points(slave, die, z, 0, 1.0, 3)
    s, omega = (np.polynomial.legendre.leggauss(3) + np.array([[1.0], [0.0]])) / 2
    row = 0

    def on(surface: Surface, i: int, xi: float) -> np.ndarray:
        return shape(np.array(xi), surface.nodes.shape[1]) @ (surface.X[i] + u[surface.nodes[i]])

    def along(i: int, xi: float, derivative: int = 0) -> float:
        N = shape(np.array(xi), slave.nodes.shape[1], derivative)
        return float((N @ (slave.X[i] + u[slave.nodes[i]]))[1])

    first, last = on(die, 0, 0.0), on(die, 2, 1.0)
    vertices = [on(die, i, 0.0)[1] for i in range(3)] + [last[1]]
    for i in range(len(slave.X)):
        back = brentq(lambda xi, i=i: along(i, xi, 1), 0, 1, xtol=1e-15) if along(i, 0, 1) * along(i, 1, 1) < 0 else 1.0
        cuts = [back] if back < 1 else []
        for a, b in pairwise(np.unique([0.0, back, 1.0])):
            ends = along(i, a), along(i, b)
            passed = [v for v in vertices if min(ends) < v < max(ends)]
            cuts += [brentq(lambda xi, i=i, v=v: along(i, xi) - v, a, b, xtol=1e-15) for v in passed]
        for a, b in pairwise([0.0, *sorted(cuts), 1.0]):
            for q in range(3):
                xi = a + (b - a) * s[q]
                r, y = on(slave, i, xi)
                if y < first[1]:  # straight on from B, as B-C was inclined at first
                    bore = first[0] - (y - first[1]) / 3
                elif y > last[1]:
                    bore = last[0] + (y - last[1]) * 3 / 20
                else:
                    j = int(np.searchsorted(vertices, y)) - 1
                    k = brentq(lambda k, j=j, y=y: on(die, j, k)[1] - y, 0, 1, xtol=1e-15)
                    bore = on(die, j, k)[0]
                X = (1 - xi) * slave.X[i, 0] + xi * slave.X[i, 1]
                assert points.facet[row] == i
                assert_allclose(points.gap[row, q], bore - r, atol=1e-11)
                assert_allclose(ray_gap(np.array([[r, y]]), die, z, 0, 1.0)[0], bore - r, atol=1e-11)  # the reports'
                length = np.linalg.norm(slave.X[i, 1] - slave.X[i, 0])
                assert_allclose(points.weight[row, q], 2 * np.pi * X[0] * length * (b - a) * omega[q], rtol=1e-10)
            row += 1
    assert row == len(points.gap)


@pytest.mark.parametrize("axisymmetric", [True, False])
@pytest.mark.parametrize("scene", SCENES)
def test_weights_sum_to_the_area(scene: str, axisymmetric: bool) -> None:
    """Of the reference surface, however the facets are split: a piece lost or counted twice changes the force."""
    slave, die, z = bent(2, 2, scene)
    points = ray_points(slave, die, z, 0, 1.0, 2, axisymmetric)
    r = (slave.X[:, 0, 0] + slave.X[:, 1, 0]) / 2
    assert len(points.gap) > len(slave.X)
    assert points.weight.sum() == pytest.approx(np.sum(slave.length * (2 * np.pi * r if axisymmetric else 1)))


def test_a_die_that_is_no_graph_is_refused() -> None:
    """Its vertices pass one another: the ray would hit it twice."""
    slave, die, z = bent(1, 1, "along")
    z[1] = 20.0  # B beyond C
    with pytest.raises(ArithmeticError, match="no graph"):
        ray_points(slave, die, z, 0, 1.0, 2)


@pytest.mark.parametrize(("axis", "sign"), [(0, 1.0), (1, -1.0)])
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("order_s", "order_d"), ORDERS)
def test_variations_of_the_ray_gap(order_s: int, order_d: int, scene: str, axis: int, sign: float) -> None:
    """First and second derivative, and those of the moving points and weights, by central differences.

    Each is what Newton's method converges by: with one of them wrong it still converges, slowly.
    """
    slave, die, z = bent(order_s, order_d, scene)
    slave, die = (replace(body, X=oriented(axis, sign, body.X)) for body in (slave, die))
    z = oriented(axis, sign, z.reshape(-1, 2)).ravel()

    def at(z: np.ndarray) -> Points:
        return ray_points(slave, die, z, axis, sign, 3, axis == 0)

    points = at(z)
    cols = points.cols
    rng = np.random.default_rng(4)
    for _ in range(2):
        d = rng.standard_normal(z.shape)
        up, down = at(z + 1e-6 * d), at(z - 1e-6 * d)
        assert np.array_equal(up.cols, cols)
        assert np.array_equal(down.cols, cols)

        def difference(name: str, up: Points = up, down: Points = down) -> np.ndarray:
            return (getattr(up, name) - getattr(down, name)) / 2e-6

        along = d[cols]
        dxi = np.einsum("nql,nl->nq", points.dxi, along)
        assert np.max(np.abs(dxi)) > 1e-3 or scene == "past"
        assert_allclose(dxi, difference("xi"), atol=1e-7)
        assert_allclose(np.einsum("nql,nl->nq", points.dweight, along), difference("weight"), rtol=1e-6, atol=1e-3)
        dgap = np.einsum("nql,nl->nq", points.G, along) + points.gap_xi * dxi
        assert_allclose(dgap, difference("gap"), atol=1e-6)
        dG = points.G_xi * dxi[..., None]
        for left, right in points.curvature:
            dG = dG + left * np.einsum("nql,nl->nq", right, along)[..., None]
        assert_allclose(dG, difference("G"), atol=1e-6)


def test_a_facet_that_begins_to_turn_back() -> None:
    """A die vertex that passes its end does not jump to where the facet passes it a second time.

    The billet's outermost facet on the cone is crushed so; forces that jump are in no balance (`mortar`, 0.25 mm).
    """
    die = curve(np.array([[45.0, 60.0], [45.0, 80.0], [40.0, 100.0]]), 1, side=SIDE)
    n = die.nodes.max() + 1
    slave = curve(np.array([[44.0, 79.0], [44.0, 81.0]]), 2, first_node=n)
    middle = np.zeros(2 * (n + 3))
    middle[2 * slave.nodes[0, 2] + 1] = -0.7  # the quarter point is passed: down from 79 before up to 81
    found = []
    for end in np.linspace(0.9, 1.1, 401):  # the facet's beginning from 79.9 to 80.1, over the vertex
        z = middle.copy()
        z[2 * slave.nodes[0] + 1] += end
        points = ray_points(slave, die, z, 0, 1.0, 4)
        found.append(np.einsum("nq,nq->", points.weight, points.slope))
    steps = np.abs(np.diff(found))
    assert np.max(steps) < 0.1 * abs(found[-1] - found[0])


# -- stress ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", ["side", "front", "bore", "cone"])
@pytest.mark.parametrize("order", [1, 2])
def test_stress_rows_are_the_stress_of_ufl(order: int, group: str) -> None:
    """d . sigma(u) N of a random displacement, cell by cell against DOLFINx; and its derivative along the facet."""
    tagged = distribute(MPI.COMM_SELF, case_mesh(A.profile))
    msh = tagged.msh
    V = fem.functionspace(msh, ("Lagrange", order, (2,)))
    trace = gather_trace(V, tagged.facet_tags.find(tagged.groups[group]), 1 if group in ("side", "bore") else 0)
    surface = trace.surface(np.arange(V.dofmap.index_map.size_local), True)
    middle = surface.X[:, :2].mean(axis=1)
    outward = {
        "side": np.array([[1.0, 0.0]]),
        "front": np.array([[0.0, 1.0]]),
        "bore": NORMALS[np.searchsorted(BORE[1:-1, 1], middle[:, 1])],
        "cone": SSNV504.normals(SSNV504.cone),
    }[group]
    assert_allclose(surface.normal, np.broadcast_to(outward, surface.normal.shape), atol=1e-12)

    u = fem.Function(V)
    rng = np.random.default_rng(5)
    u.x.array[:] = rng.standard_normal(len(u.x.array))
    stress = sigma(epsilon(u, ufl.SpatialCoordinate(msh), axisymmetric=True), STEEL.lmbda, STEEL.mu)
    xi = np.array([0.1, 0.4, 0.9])
    d = np.array([0.6, -0.8])
    facets = np.arange(len(surface.X))
    xis = np.broadcast_to(xi, (len(facets), 3))
    rows, rows_xi = (stress_rows(surface, facets, xis, d, STEEL.lmbda, STEEL.mu, derivative=i) for i in (0, 1))
    cols = (2 * surface.cell_nodes[:, :, None] + np.arange(2)).reshape(len(facets), -1)
    found = np.einsum("nql,nl->nq", rows, u.x.array[cols])

    cells = {frozenset(dofs): cell for cell, dofs in enumerate(V.dofmap.list.tolist())}
    for i in facets:
        cell = cells[frozenset(surface.cell_nodes[i].tolist())]
        corners = msh.geometry.x[msh.geometry.dofmaps[0][cell], :2]
        x = surface.X[i, 0] + xi[:, None] * (surface.X[i, 1] - surface.X[i, 0])
        reference = np.linalg.solve((corners[1:] - corners[0]).T, (x - corners[0]).T).T
        tensor = fem.Expression(stress, reference).eval(msh, np.array([cell], dtype=np.int32)).reshape(3, 3, 3)
        expected = np.einsum("i,qij,j->q", d, tensor[:, :2, :2], surface.normal[i])
        assert_allclose(found[i], expected, rtol=1e-9, atol=1e-9 * STEEL.E)

    step = 1e-5
    up, down = (stress_rows(surface, facets, xis + e, d, STEEL.lmbda, STEEL.mu) for e in (step, -step))
    assert_allclose(rows_xi, (up - down) / (2 * step), rtol=1e-5, atol=1e-5 * STEEL.E)


def test_plane_stress_rows_have_no_hoop_strain() -> None:
    """In the plane a radial shift strains nothing; in axisymmetry it strains the hoop by u / r."""
    tagged = distribute(MPI.COMM_SELF, case_mesh(A.profile))
    V = fem.functionspace(tagged.msh, ("Lagrange", 1, (2,)))
    trace = gather_trace(V, tagged.facet_tags.find(tagged.groups["side"]), 1)
    surface = trace.surface(np.arange(V.dofmap.index_map.size_local), True)
    shift = np.tile([1.0, 0.0], 3)
    facets, xi = np.arange(len(surface.X)), np.full((len(surface.X), 1), 0.3)
    for axisymmetric, expected in ((True, STEEL.lmbda / 50), (False, 0.0)):
        rows = stress_rows(surface, facets, xi, np.array([1.0, 0]), STEEL.lmbda, STEEL.mu, axisymmetric)
        assert_allclose(rows @ shift, expected, atol=1e-9)
