"""Laws and closures, by arithmetic that can be done in the head."""

import numpy as np
import pytest

from extrusion.contact import CLOSURES, oedometric_ratio, project, stiffness

TRIAL = np.array([-2.0, 0.0, 3.0])


@pytest.mark.parametrize(
    ("closure", "closed", "stress", "derivative"),
    [
        ("unilateral", [False, False, False], [-2, 0, 0], [1, 0, 0]),
        ("unilateral", [True, True, True], [-2, 0, 0], [1, 0, 0]),
        ("bilateral", [True, True, True], [-2, 0, 3], [1, 1, 1]),
        ("bilateral", [False, False, True], [-2, 0, 3], [1, 0, 1]),
        ("bilateral", [False, False, False], [-2, 0, 0], [1, 0, 0]),
        ("check", [True, True, True], [0, 0, 0], [0, 0, 0]),
    ],
)
def test_projection(closure: str, closed: list[bool], stress: list[float], derivative: list[float]) -> None:
    """A wall that pulls, a channel that lets go of what it holds, or checked contact that pushes."""
    held = np.array(closed)
    found, slope = project(TRIAL, closure, held)
    np.testing.assert_array_equal(found, stress)
    np.testing.assert_array_equal(slope, derivative)
    np.testing.assert_array_equal(held, closed)  # history is read, not written


@pytest.mark.parametrize("closure", CLOSURES)
def test_derivative_of_the_projection(closure: str) -> None:
    """Newton's method would take a tangent of another law."""
    trial, closed, step = np.array([-2.0, -0.5, 0.5, 3.0]), np.array([True, False, True, False]), 1e-6
    up, down = (project(trial + d, closure, closed)[0] for d in (step, -step))
    np.testing.assert_allclose((up - down) / (2 * step), project(trial, closure, closed)[1], atol=1e-9)


def test_stiffness_is_gamma_E_over_h_at_the_billets_nu() -> None:
    """k = 10 * 5000 / 2.5; it grows with the modulus of a confined bar, that the trace inequality scales with."""
    assert stiffness(10, 5000, 0.45, 2.5) == pytest.approx(20_000)
    np.testing.assert_allclose(stiffness(10, 5000, 0.45, np.array([2.5, 5])), [20_000, 10_000])
    confined = (1 - 0.45) / (1.45 * 0.1)
    assert stiffness(10, 5000, 0.0, 2.5) == pytest.approx(20_000 / confined)
    assert stiffness(10, 5000, 0.25, 2.5) == pytest.approx(20_000 * 1.2 / confined)


@pytest.mark.parametrize(("nu", "ratio"), [(0.0, 1.0), (0.25, 1.2), (-0.5, 1.5), (0.499, 167.1)])
def test_oedometric_ratio(nu: float, ratio: float) -> None:
    """0.75 / (1.25 * 0.5), 1.5 / (0.5 * 2), 0.501 / (1.499 * 0.002)."""
    assert oedometric_ratio(nu) == pytest.approx(ratio, rel=1e-3)
