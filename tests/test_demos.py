"""The demos and the README's first screen do what they say."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

from mpi4py import MPI

import jupytext
import numpy as np
import pytest
from nbclient import NotebookClient

from extrusion import cases
from extrusion.result import verify

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
README_PYTHON = re.findall(r"^```python\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "pictures"), [("case_a", 3), ("rigid_die_ufl", 0), ("patch_test", 2), ("hertz", 1), ("shrink_fit", 1)]
)
@pytest.mark.timeout(240)
def test_notebook(name: str, pictures: int, tmp_path: Path) -> None:
    """A percent script runs as a notebook, its asserts hold, and its pictures are there to see."""
    notebook = jupytext.read(ROOT / "demos" / f"{name}.py")
    place = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=120, kernel_name="python3", resources=place).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == pictures
    for before, cell in zip(notebook.cells, notebook.cells[1:], strict=False):
        assert "markdown" in (before.cell_type, cell.cell_type), f"no sentence before {cell.source!r}"


def test_two_ranks() -> None:
    """The command in the script's first line gives one table."""
    launcher = Path(sys.executable).with_name("mpiexec")
    if not launcher.exists() or (os.cpu_count() or 1) < 2 or MPI.COMM_WORLD.size > 1:
        pytest.skip("no mpiexec beside this Python, or one core, or already under a launcher")
    script = ROOT / "demos" / "case_a_mpi.py"
    command = script.read_text().splitlines()[0].removeprefix("# ").split()
    assert command == ["mpiexec", "-n", "2", "python", "demos/case_a_mpi.py"]
    done = subprocess.run(
        [launcher, "-n", "2", sys.executable, script], capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("2 ranks") == 1


def in_process(code: str, *args: str) -> subprocess.CompletedProcess[str]:
    """Python of its own, in the project's folder."""
    return subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, timeout=120, cwd=ROOT)


DRAW = """
import runpy, sys
from pathlib import Path
runpy.run_path("demos/billet_in_3d.py")["main"](Path(sys.argv[1]), order=1, size=16, sectors=4, until=20)
"""


def test_billet_in_3d(tmp_path: Path) -> None:
    """A picture without a display: white around, coloured in it."""
    pytest.importorskip("pyvista")
    done = in_process(DRAW, str(tmp_path / "billet.png"))
    assert done.returncode == 0, done.stderr
    from matplotlib.image import imread

    drawn = imread(tmp_path / "billet.png")[..., :3]
    assert (drawn[[0, -1]] == 1).all()
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 1000
    assert (np.ptp(drawn, axis=2) > 0.5).mean() > 0.02


def test_billet_in_3d_without_pyvista(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One line says what to install."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / "demos" / "billet_in_3d.py"), run_name="__main__")
    assert end.value.code == 2
    assert capsys.readouterr().err == 'pyvista is not installed: pip install ".[view]"\n'


def test_scaling_3d(tmp_path: Path) -> None:
    """A run's phases add up, and two of them make a table."""
    demo = runpy.run_path(str(ROOT / "demos" / "scaling_3d.py"))
    row = demo["measure"](demo["Cell"](1, 16.0, until=20.0))
    assert row["error"] is None
    parts = demo["parts_of"]([row])
    assert {"factor", "pairing", "linear"} <= set(parts)
    assert sum(row[name] for name in parts) == pytest.approx(row["solve"])
    assert min(row[name] for name in ("setup", "memory", "K_error", "reaction_error", *parts)) > 0
    text = demo["write"](tmp_path, [row, row | {"ranks": 2, "solve": row["solve"] / 2}])
    assert "| 2.00 |" in text
    assert (tmp_path / "scaling.csv").read_text().count("\n") == 3


def test_readme_lines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The README's Python runs as it stands."""
    monkeypatch.chdir(tmp_path)
    first, _ = README_PYTHON
    assert len(first.splitlines()) <= 6
    exec(first, {})
    assert (tmp_path / "billet.png").stat().st_size > 10_000


def test_readme_scene(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its file and its Python are one case; in the narrow bore the side is pressed as Lamé has it, held outside."""
    monkeypatch.chdir(tmp_path)
    _, code = README_PYTHON
    (file,) = re.findall(r"^```toml\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)
    (tmp_path / "wire.toml").write_text(file, encoding="utf-8")
    scope: dict[str, Any] = {}
    exec(code.split("result =")[0], scope)
    assert cases.read_toml(tmp_path / "wire.toml") == scope["wire"]
    pytest.importorskip("gmsh", exc_type=ImportError)
    exec(code, scope)
    inner, outer = 7.8, 20.0
    billet = 8 * 0.67 / 70e3  # mm a MPa, free along the axis
    die = inner * 1.3 * 0.4 * (outer**2 - inner**2) / (200e3 * (0.4 * outer**2 + inner**2))  # not free
    side = scope["side"]
    middle = side.pressure[np.abs(side.x[:, 1] - 40.0) < 2]
    np.testing.assert_allclose(middle, 0.2 / (billet + die), rtol=0.06)


def test_readme_figures() -> None:
    """The README's table holds every figure of every case, as computed now to 0.001 mm, and within its tolerance."""
    told = {}
    for names, contact, row in re.findall(r"^\| ([A-Z, ]+) \| (solved|check) \| (.*) \|$", README, flags=re.MULTILINE):
        t, quantity, sheet, computed, _, tolerance = row.split(" | ")
        for case in names.split(", "):
            told[case, contact, float(t), quantity] = float(sheet), float(computed), float(tolerance)
    found = {}
    for case in cases.CASES.values():
        for comparison in (one for result in verify(case) for one in result.figures()):
            figure = comparison.figure
            assert comparison.ok
            key = case.name, figure.contact, figure.t, f"{figure.quantity}({figure.point})"
            found[key] = figure.value, comparison.computed, 100 * figure.tolerance
    assert told.keys() == found.keys()
    for key, values in found.items():
        assert told[key] == pytest.approx(values, rel=1e-12, abs=1e-3), key


@pytest.mark.slow
def test_readme_accuracy(capsys: pytest.CaptureFixture[str]) -> None:
    """Every run of the README's other table gets to its end, with the K (to 0.001 mm) and the reaction (1 kN) there."""
    runpy.run_path(str(ROOT / "demos" / "accuracy_table.py"), run_name="__main__")
    tables = []
    for text in (README, capsys.readouterr().out):
        _, elastic, rigid = re.split(r"^(?:Elastic|Rigid) die:$", text, flags=re.MULTILINE)
        rows = [re.findall(r"^\| (n|p|m)(.*) \|$", table, flags=re.MULTILINE) for table in (elastic, rigid)]
        tables.append([[cell.strip() for cell in "".join(row).split("|")] for table in rows for row in table])
    told, found = tables
    assert len(found) == 2 * 19
    assert [row[:4] for row in told] == [row[:4] for row in found]
    for old, new in zip(told, found, strict=True):
        for column in range(5, 11):
            values = [float(row[column].split()[0]) for row in (old, new) if row[0] != "method"]
            assert values == [] or values[0] == pytest.approx(values[1], abs=1e-3 if column < 8 else 1), new
