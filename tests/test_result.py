"""A run from Python: arrays, JSON, tables, and what a mesh or an observer does to it."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from extrusion import cases, run
from extrusion.elasticity import Elastic
from extrusion.errors import InputError
from extrusion.mesh import PlainMesh, bundled, write_mesh
from extrusion.mesh3d import hex_mesh
from extrusion.problem import Problem
from extrusion.result import Result, changed, refuse_unverifiable, verify
from extrusion.stepping import Step

SHORT = cases.A.with_increment(10, 30)


@pytest.fixture(scope="module")
def result() -> Result:
    return run(SHORT)


def test_importing_is_light() -> None:
    """``import extrusion`` and its cases load neither DOLFINx nor PETSc nor matplotlib."""
    heavy = "[m for m in ('dolfinx', 'petsc4py', 'mpi4py', 'matplotlib', 'gmsh') if m in sys.modules]"
    code = f"import sys, extrusion, extrusion.cli; from extrusion import run, cases; print({heavy})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_arrays(result: Result) -> None:
    """Every array has a row a step, in order."""
    assert result.converged
    assert result.error is None
    np.testing.assert_array_equal(result.t, [10, 20, 30])
    np.testing.assert_array_equal(result.point("M")[:, 1], result.t)  # on the driven face
    assert result.reaction.tolist() == [step.reaction for step in result.steps]
    assert result.energy[-1] > result.energy[0] > 0
    assert result.iterations.sum() > 0
    assert result.gap("L").shape == (3,)
    with pytest.raises(RuntimeError, match="observer"):
        _ = result.steps[0].x


def test_one_line(result: Result) -> None:
    """What a prompt shows."""
    told = "<Result of A: nodal, P1, elastic die, 686 dofs, 1 rank: 3 steps to t = 30 mm, converged>"
    assert repr(result) == told
    failed = replace(result, steps=[], converged=False, error="out of reach")
    assert repr(failed).endswith("no step, out of reach>")


def test_json(result: Result) -> None:
    """The object of ``--json``: these keys in this order, values unrounded, all of it strict JSON."""
    text = json.dumps(result.to_dict(), allow_nan=False)
    data = json.loads(text)
    keys = "case method order die dofs contact_points ranks solver guide converged error seconds estimate steps"
    assert " ".join(data) == keys
    assert list(data["seconds"]) == ["setup", "solve", "output", "factor", "condensation", "pairing"]
    step, last = data["steps"][-1], result.steps[-1]
    assert " ".join(step) == "t points reaction energy iterations tangents cuts gap"
    assert step["points"]["K"] == list(last.points["K"])
    assert {"K", "L", "M"} <= set(step["points"])
    assert {"L", "M"} <= set(step["gap"])
    assert (step["t"], step["reaction"], step["energy"]) == (30, last.reaction, last.energy)
    # 333 nodes of two displacements; a multiplier a node of the side (11) and of the front (9)
    assert (data["dofs"], data["contact_points"]) == (666 + 20, 20)


def test_json_without_nan(result: Result) -> None:
    """A number that is none becomes null: NaN is not JSON."""
    step = replace(result.steps[0], reaction=math.nan, gap={"L": math.inf})
    data = replace(result, steps=[step]).to_dict()["steps"][0]
    assert (data["reaction"], data["gap"]) == (None, {"L": None})


def test_tables(result: Result) -> None:
    """The sheet's figure stands beside the step that it is about; the notebook's table has all steps."""
    table = result.table()
    assert table.row_count == 3
    page = result._repr_html_()
    assert page.count("<tr>") == 4
    assert "<td>20.825</td>" in page
    assert [c.figure.t for c in result.figures() if not math.isnan(c.computed)] == [20]


def test_figure_out_of_tolerance(result: Result) -> None:
    """Off by more than the tolerance, and not reached: neither is ok."""
    by_t = {c.figure.t: c for c in result.figures()}
    off = replace(by_t[20], computed=20.825 * 1.0021)
    assert not off.ok
    assert off.difference == pytest.approx(0.0021)
    assert replace(off, computed=20.825 * 0.9981).ok
    assert not by_t[155].ok


def test_verify_runs_contact_as_the_figures_ask() -> None:
    """One run with contact, one with contact only checked, each with its own figures."""
    gap = cases.Figure(t=10, value=-1.581139, tolerance=1e-6, point="L", quantity="gap", contact="check")
    figures = (*(f for f in cases.A.figures if f.t <= 20), gap)
    solved, checked = verify(replace(cases.A.with_increment(5, 20), figures=figures))
    assert [zone.contact for zone in checked.case.zones] == ["check", "check"]
    assert [c.figure.t for c in solved.figures()] == [5, 20]
    (row,) = checked.figures()  # L is 5 mm past B, where the bore narrows by 5 in 15 mm: 5/3 mm, times the cosine
    assert row.ok, row
    np.testing.assert_allclose(checked.point("K")[:, 1], checked.t)
    with pytest.raises(InputError, match="has none to verify"):
        verify(replace(cases.A, figures=()))


def test_changes() -> None:
    """Options change what they name; a size and a mesh file exclude each other."""
    case = changed(cases.A, order=2, method=None, contact="check", until=20, increment=20)
    assert (case.order, case.method, case.times()) == (2, "nodal", [20])
    assert {zone.contact for zone in case.zones} == {"check"}
    assert changed(replace(cases.A, mesh="a.msh"), size=2.0).mesh is None
    assert changed(replace(cases.A, size=2.0), mesh="a.msh").size is None
    with pytest.raises(InputError, match="one or the other"):
        changed(cases.A, size=2.0, mesh="a.msh")


def test_observers() -> None:
    """Called once a step, in order, with the live state; closed at the end."""

    class Watcher:
        def __init__(self) -> None:
            self.seen: list[float] = []

        def __call__(self, problem: Problem, step: Step) -> None:
            self.seen.append(problem.largest_displacement(step.x))

        def close(self) -> None:
            self.seen.append(math.inf)

    watcher = Watcher()
    run(SHORT, contact="check", observers=[watcher])
    assert watcher.seen == [10, 20, 30, math.inf]


def test_mesh_in_hand_or_in_a_file(result: Result, tmp_path: Path) -> None:
    """The same mesh by either way gives the same answer; without its clamped edges it is refused."""
    plain = bundled(SHORT.profile)
    assert plain is not None
    write_mesh(tmp_path / "mine.msh", plain)
    by_hand, by_file = run(SHORT, mesh=plain), run(SHORT, mesh=tmp_path / "mine.msh")
    np.testing.assert_array_equal(by_hand.point("K"), by_file.point("K"))
    np.testing.assert_allclose(by_hand.point("K"), result.point("K"), atol=1e-9)
    loose = PlainMesh(plain.points, plain.cells, {k: f for k, f in plain.facets.items() if k != "fixed"})
    with pytest.raises(InputError, match=r"'fixed': no such group; groups present: .*side"):
        run(SHORT, mesh=loose)


@pytest.mark.mpi
def test_ranks_do_not_matter() -> None:
    """All ranks together find what each finds alone, and every rank holds the result."""
    alone, shared = run(SHORT, comm=MPI.COMM_SELF).to_dict(), run(SHORT).to_dict()
    assert (alone["ranks"], shared["ranks"]) == (1, MPI.COMM_WORLD.size)
    assert {k: alone[k] for k in ("dofs", "contact_points")} == {k: shared[k] for k in ("dofs", "contact_points")}
    for one, other in zip(alone["steps"], shared["steps"], strict=True):
        for name, u in one["points"].items():
            assert u == pytest.approx(other["points"][name], rel=0, abs=1e-8)
        assert one["gap"] == pytest.approx(other["gap"], rel=0, abs=1e-8)
        assert one["reaction"] == pytest.approx(other["reaction"], rel=1e-6)
        assert one["iterations"] == other["iterations"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"mehtod": "nodal"}, "mehtod = 'nodal': no such option; choose from name, title"),
        ({"goal": "foo"}, "goal = 'foo': choose one of K, reaction"),
        ({"mesh": hex_mesh(cases.A.profile, 16.0, 4)}, "mesh = '3-dimensional points': give a PlainMesh"),
        ({"mesh": bundled(cases.A.profile), "space": "3d"}, "mesh = '2-dimensional points': give a HexMesh"),
        ({"zones": ("x",)}, "zones = 'x': give each as"),
        ({"order": 2, "form": "mixed", "billet": Elastic(5000, 0.0)}, "form = 'mixed': the pressure is divided by nu"),
        ({"until": 240.0, "increment": 60.0}, "until = 240.0: end before the rear face leaves the die"),
        ({"mesh": 3}, "mesh = 3: give a mesh file"),
        ({"out": 3}, "out = 3: give a folder"),
    ],
)
def test_bad_options(options: dict[str, Any], told: str) -> None:
    """What the command line cannot be asked, too, is one line."""
    with pytest.raises(InputError) as error:
        run(cases.A, **options)
    assert str(error.value).startswith(told)


@pytest.mark.parametrize("call", [run, verify])
def test_a_name_is_no_case(call: Any) -> None:
    with pytest.raises(InputError, match="case = 'A': give a Case"):
        call("A")


def test_figures_of_an_increment_of_ones_own() -> None:
    """They are looked for among the steps that are run; one of 0 is compared as it is."""
    figures = tuple(replace(cases.A.figures[0], t=5.0, value=value, tolerance=1e-6) for value in (5.0, 0.0))
    case = replace(cases.A, increments=((10.0, 10.0),), figures=figures)
    with pytest.raises(InputError, match=r"figures.t = 5.0"):
        verify(case)
    (result,) = verify(case, increment=5.0)
    exact, off = result.figures()
    assert exact.ok
    assert off.difference == pytest.approx(5.0)


def test_forces_of_a_slab_are_told_by_its_thickness() -> None:
    header = run(cases.A, space="plane strain", until=5).table().columns
    assert "reaction\nkN/mm" in [column.header for column in header]


def test_points_that_are_not_there(result: Result) -> None:
    with pytest.raises(InputError, match=r"point = 'Z': choose one of .*K"):
        result.point("Z")
    with pytest.raises(InputError, match="gap = 'N': choose one of L, M, K"):
        result.gap("N")


def test_what_another_method_or_space_leaves_behind() -> None:
    """theta is a variant of Nitsche's method alone; the sheet's figures are of the whole revolution."""
    with pytest.raises(InputError, match="theta = -1: leave it out"):
        changed(cases.A, theta=-1)
    assert changed(cases.A, method="nitsche", theta=-1).theta == -1
    slab = changed(cases.A, space="plane strain")
    assert slab.figures == ()
    own = replace(slab, figures=cases.A.figures[:1])
    assert changed(own, space="plane strain").figures == own.figures
    assert changed(cases.A, space="3d").figures == cases.A.figures


def test_a_result_is_equal_to_itself(result: Result) -> None:
    """Its steps hold arrays, which have no one truth value."""
    assert result == result
    assert result != replace(result)


def test_a_gap_needs_a_zone_there() -> None:
    """It was compared as nan."""
    gap = cases.Figure(t=5.0, value=1.0, tolerance=0.1, point="K", quantity="gap", contact="check")
    refuse_unverifiable(replace(cases.A, figures=(gap,)))
    with pytest.raises(InputError, match=r"figures\.point = 'K': no zone of case A has it"):
        verify(replace(cases.A, figures=(gap,), zones=cases.A.zones[:1]))
