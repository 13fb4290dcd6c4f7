"""Speed against error: the front, the fits, one run in a process of its own, and what is written."""

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrusion import bench, cli
from extrusion.errors import InputError

CELL = bench.Cell("front", "nitsche", 2, 4.0, "rigid", "surface", 50.0)
QUICK = bench.cells(quick=True)


def row(solve: float, error: float, bar: float = 0.0) -> dict[str, Any]:
    return {"solve": solve, "K_error": error, "K_bar": bar}


def made_up(cell: bench.Cell, mesh: Path | None = None) -> bench.Outcome:
    """What no solver gave: the full solver takes 3 times as long, phases are powers of the dofs."""
    if cell.method == "nodal":
        return bench.Outcome("failed", "step to t = 25 mm not solved")
    dofs = round(1e4 / (cell.size or 3.0))
    steps = 1e-4 * dofs * (3.0 if cell.solver == "full" else 1.0) * (1 + 0.1 * cell.turn)
    return bench.Outcome(
        "converged", "", dofs, 31, 100, 1e-5 * dofs, 1e-9 * dofs**1.5, 0.0, steps, 0.1, 1.0, 100.0, 110.0, 200.0, 5.0,
        1 / dofs, 1e-5, 10 / dofs, 3e-3, math.nan, math.nan,
    )  # fmt: skip


def test_front() -> None:
    """A row beaten in both, or that only gains below the reference's error bar, is on the front."""
    rows = [row(4, 1e-6, 1e-4), row(1, 1e-2), row(2, 2e-2), row(3, 1e-5, 1e-4), row(2.5, 8e-3), row(3, 2e-4)]
    assert [(r["solve"], r["K_error"]) for r in bench.front(rows, "K")] == [(1, 1e-2), (2.5, 8e-3), (3, 1e-5)]
    assert [(r["solve"], r["K_error"]) for r in bench.front(rows, "K", gain=2.0)] == [(1, 1e-2), (3, 1e-5)]
    assert bench.front([], "K") == []


def test_exponent() -> None:
    """The fit of an exact power law is its power; what is zero does not count."""
    dofs = np.array([2e3, 1e4, 7e4, 5e5])
    assert bench.exponent(dofs.tolist(), (3e-7 * dofs**1.37).tolist()) == pytest.approx(1.37, abs=1e-12)
    assert bench.exponent([1, *dofs], [0.0, *dofs]) == pytest.approx(1.0, abs=1e-12)
    assert math.isnan(bench.exponent([1e3, 1e4], [0.0, 1.0]))


def test_cells() -> None:
    """None twice; solvers and turns alternate; --quick needs no gmsh; growth spans two decades."""
    cells = bench.cells()
    assert len(cells) == len(set(cells))
    pairs = [cell for cell in cells if cell.part == "pairs"]
    assert [cell.solver for cell in pairs] == ["surface", "full"] * (len(pairs) // 2)
    assert all(pairs[i] == replace(pairs[i + 1], solver="surface") for i in range(0, len(pairs), 2))
    assert {cell.guide for cell in pairs} == {"off"}
    assert {cell.guide for cell in cells if cell.part != "pairs"} == {"auto"}
    assert {cell.size for cell in QUICK} <= {None, 4.0, 2.0, 1.0}


def test_a_run_in_its_own_process() -> None:
    """The run is right, its seconds and memory are its own, and K's error stands beside its bar."""
    outcome = bench.measure(CELL)
    assert outcome.status == "converged", outcome.note
    assert (outcome.dofs, outcome.increments) == (1120, 10)
    assert outcome.iterations > 20
    assert 1e-5 < outcome.K_bar < outcome.K_error < 5e-4
    assert outcome.reaction_bar < outcome.reaction_error < 0.02
    assert outcome.pressure_bar < outcome.pressure_error < 0.05
    seconds = [getattr(outcome, phase) for phase in bench.PHASES]
    assert min(seconds) > 0
    assert sum(seconds) < 10
    assert outcome.base <= outcome.memory_factor <= outcome.memory < 1000
    assert 0.1 < outcome.compliance < 2  # MB
    full = bench.measure(replace(CELL, solver="full", until=20.0))
    assert (full.condensation, full.compliance) == (0.0, 0.0)
    plain, guided = (bench.measure(replace(CELL, guide=guide, until=20.0)) for guide in ("off", "on"))
    assert guided.iterations < plain.iterations
    assert math.isnan(full.pressure_error)


def test_a_run_that_breaks_is_named() -> None:
    """A process that ends badly says why, and does not stop the others."""
    outcome = bench.measure(replace(CELL, method="glue"))
    assert outcome.status == "failed"
    assert "glue" in outcome.note


@pytest.fixture
def imagined(monkeypatch: pytest.MonkeyPatch) -> list[bench.Cell]:
    """Measures nothing; returns what would have been measured."""
    measured: list[bench.Cell] = []

    def measure(cell: bench.Cell, mesh: Path | None = None) -> bench.Outcome:
        measured.append(cell)
        return made_up(cell)

    monkeypatch.setattr(bench, "measure", measure)
    monkeypatch.setattr(bench, "_mesh", lambda size, folder: None)
    return measured


def test_files(tmp_path: Path, imagined: list[bench.Cell]) -> None:
    """CSV and JSON read back as what was measured; runs are not done twice; failures are named; the fits are right."""
    pytest.importorskip("matplotlib")
    here, runs = bench.run(tmp_path)
    assert imagined == bench.cells()
    again = bench.run(tmp_path)
    assert len(imagined) == len(runs)
    assert again[0] == here
    assert repr(again[1]) == repr(runs)  # NaN is not NaN
    text = bench.write(tmp_path, here, runs)
    assert "Did not end: front nodal P1 sheet elastic surface to 155: step to t = 25 mm" in text
    assert "| 4 mm | 2500 | 155 | 5 |" in text

    data = json.loads((tmp_path / "bench.json").read_text())
    assert data["machine"] == here
    assert {"date", "processor", "dolfinx", "petsc", "extrusion", "OMP_NUM_THREADS"} <= here.keys()
    with (tmp_path / "bench.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(data["rows"]) == len({replace(cell, turn=0) for cell in imagined})
    for written, kept in zip(table, data["rows"], strict=True):
        for name, value in kept.items():
            read: Callable[[str], Any] = str if isinstance(value, str) else float
            assert written[name] in ("", "nan") if value is None else read(written[name]) == value
    assert [ratio["pairs"] for ratio in data["ratios"]] == [5] * 4
    expected = [(1e-9 * d**1.5 + 3e-4 * d * 1.2) / (1e-9 * d**1.5 + 1e-4 * d * 1.2) for d in (2500, 10_000)]
    assert [ratio["ratio"] for ratio in data["ratios"][:2]] == pytest.approx(expected)
    exponents = {one["quantity"]: one["exponent"] for one in data["growth"]}
    assert exponents["factor"] == pytest.approx(1.5)
    assert exponents["steps"] == pytest.approx(1.0)
    assert (tmp_path / "bench.png").stat().st_size > 10_000


def test_runs_of_elsewhere_are_refused(
    tmp_path: Path, imagined: list[bench.Cell], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seconds of two machines get into one table."""
    bench.run(tmp_path, quick=True)
    monkeypatch.setattr(bench.os, "cpu_count", lambda: 1024)
    with pytest.raises(InputError, match="another machine"):
        bench.run(tmp_path, quick=True)
    (tmp_path / "runs.jsonl").write_text("1,2\n")
    with pytest.raises(InputError, match="no file of extrusion bench"):
        bench.run(tmp_path, quick=True)


@pytest.mark.parametrize(
    ("args", "told"),
    [
        ("bench --out file.txt", "--out = 'file.txt"),
        ("bench --quick --out old", "--out = 'old/runs.jsonl': is no file of extrusion bench"),
        ("bench --quik", "--quik"),
    ],
)
def test_bad_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, args: str, told: str
) -> None:
    """Exit code 2 and one line."""
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    Path("file.txt").write_text("")
    Path("old").mkdir()
    Path("old/runs.jsonl").write_text("a,b\n")
    with pytest.raises(SystemExit) as end:
        cli.main(args.split())
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], imagined: list[bench.Cell]) -> None:
    """A line a run on stderr, the tables on stdout."""
    pytest.importorskip("matplotlib")
    with pytest.raises(SystemExit) as end:
        cli.main(["bench", "--quick", "--out", str(tmp_path / "new")])
    assert end.value.code == 0
    out, err = capsys.readouterr()
    assert len(err.splitlines()) == len(QUICK) == len(imagined)
    assert f"1 of {len(QUICK)}: front nodal P1 sheet elastic surface to 155: failed, step to t = 25 mm" in err
    assert out.startswith("date 2")
    assert {path.name for path in (tmp_path / "new").iterdir()} == {
        "runs.jsonl", "bench.csv", "bench.json", "bench.md", "bench.png"
    }  # fmt: skip
