"""Case A: the sheet's figures, and every method through to the end."""

import math
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from extrusion import run
from extrusion.cases import A
from extrusion.mesh import on_root

PUBLISHED = Path(__file__).parents[2] / "shared" / "ssnv504" / "ssnv504a.med"
T_K, T_R = (20, 50, 70, 100, 140, 155), (15, 35, 100)
CONVERGED = {  # u_y of K at T_K (mm), and reaction at T_R (kN): nitsche, P2, h = 1 mm
    "elastic": ((20.768, 55.740, 78.696, 106.771, 144.984, 155.015), (607, 721, -506)),
    "rigid": ((20.782, 55.805, 78.778, 106.823, 145.060, 154.947), (616, 728, -510)),
}
NEAR = {  # how near coarse meshes come: K, relative; reaction, relative to its largest value up to t = 135, 780 kN
    ("penalty", 1): (0.012, 0.20),
    ("penalty", 2): (0.004, 0.05),
    ("nitsche", 1): (0.012, 0.10),
    ("nitsche", 2): (0.001, 0.02),
}
comm = MPI.COMM_WORLD


@pytest.mark.parametrize("mesh", [None, PUBLISHED], ids=["bundled", "published"])
def test_figures_of_the_sheet(mesh: Path | None) -> None:
    """The six u_y of K, each within its tolerance, by increments of 5 mm that are never cut."""
    if mesh is not None and not mesh.exists():
        pytest.skip(f"the published mesh {mesh.name} is not at hand")
    result = run(A, mesh=mesh)
    assert result.converged
    assert [step.cuts for step in result.steps] == [0] * 31
    assert min(step.passes for step in result.steps) == 2  # of the geometry, at least two, as in the sheet
    np.testing.assert_allclose(result.t, np.arange(5, 156, 5))
    figures = result.figures()
    assert [row.figure.t for row in figures] == [5, 20, 50, 70, 140, 155]
    for row in figures:
        assert row.ok, f"t = {row.figure.t}: {row.computed:.4f} mm, sheet {row.figure.value} mm ({row.difference:+.2%})"


def test_figures_of_checked_contact() -> None:
    """K moves with the ram; M overlaps by 5 mm in the throat and by 2 mm past E."""
    figures = run(A, contact="check").figures()
    assert [(row.figure.point, row.figure.t) for row in figures] == [("K", 155), ("M", 100), ("M", 155)]
    assert all(row.ok for row in figures), figures


@pytest.mark.parametrize("size", [None, 4.0], ids=["sheet", "graded"])
@pytest.mark.parametrize("die", ["elastic", "rigid"])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("method", ["penalty", "nitsche"])
def test_methods_run_through(method: str, order: int, die: str, size: float | None) -> None:
    """With their defaults, by increments of 5 mm, as near a fine mesh's K and reaction as their order allows."""
    result = run(A, method=method, order=order, die=die, size=size)
    assert result.converged, result.error
    assert len(result.steps) == 31
    steps = {step.t: step for step in result.steps}
    (K, R), (near_K, near_R) = CONVERGED[die], NEAR[method, order]
    np.testing.assert_allclose([steps[t].points["K"][1] for t in T_K], K, rtol=near_K)
    np.testing.assert_allclose([steps[t].reaction / 1e3 for t in T_R], R, atol=near_R * 780)
    for step in result.steps:
        assert step.die_reaction == pytest.approx(-step.reaction, abs=1e-3)


@pytest.mark.mpi
@pytest.mark.parametrize(("method", "order"), [("nodal", 1), ("nitsche", 2)])
def test_two_ranks_give_the_answer_of_one(method: str, order: int) -> None:
    """Every named point to 1e-8 mm: a row kept twice, or lost at the border of two ranks, would move them."""
    case = replace(A, method=method, order=order)
    shared = run(case, comm=comm)
    alone = on_root(comm, lambda: run(case, comm=MPI.COMM_SELF))
    assert shared.converged
    assert shared.ranks == comm.size
    if comm.rank == 0:
        assert len(shared.steps) == len(alone.steps) == 31
        for one, other in zip(alone.steps, shared.steps, strict=True):
            assert one.points.keys() == other.points.keys() == A.profile.points.keys()
            for name, u in one.points.items():
                assert math.dist(u, other.points[name]) < 1e-8, (one.t, name)
            assert other.reaction == pytest.approx(one.reaction, abs=1e-3)
            assert other.energy == pytest.approx(one.energy, rel=1e-9)
