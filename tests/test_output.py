"""Files of a run against its result, and pictures drawn from either."""

import csv
import json
import pickle
import signal
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest

from extrusion import cases, plots, run
from extrusion.errors import InputError
from extrusion.newton import Newton
from extrusion.painter import Painter
from extrusion.result import Result, Snapshots, element_name

COMM = MPI.COMM_WORLD
CASE = replace(cases.A.with_increment(10, 30), order=2, method="nitsche")
QUARTER = replace(cases.G, size=13.0, sectors=4, increments=((15.0, 15.0), (5.0, 20.0)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same on every rank."""
    return Path(COMM.bcast(str(tmp_path_factory.mktemp("run") / "deep" / "out")))


@pytest.fixture(scope="module")
def result(folder: Path) -> Result:
    result = run(CASE, out=folder)
    COMM.barrier()
    return result


def table(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


@pytest.mark.mpi
def test_history(result: Result, folder: Path) -> None:
    """What is in the file is what is in the result, to the last digit."""
    history = table(folder / "history.csv")
    for name in ("K", "L", "M"):
        np.testing.assert_array_equal(np.stack([history[f"u_r_{name}"], history[f"u_y_{name}"]], 1), result.point(name))
    for name in ("t", "reaction", "energy", "iterations"):
        np.testing.assert_array_equal(history[name], getattr(result, name))
    np.testing.assert_array_equal(history["gap_L"], result.gap("L"))
    for name in ("die_reaction", "tangents", "passes", "cuts", "residual"):
        np.testing.assert_array_equal(history[name], [getattr(step, name) for step in result.steps])


@pytest.mark.mpi
def test_contact(result: Result, folder: Path) -> None:
    """All points of all zones; the pressure's axial part holds the reaction on the rear face in balance."""
    contact = table(folder / "contact.csv")
    assert len(contact["t"]) == sum(len(state.s) for step in result.steps for state in step.zones.values())
    now = (contact["t"] == 30) & (contact["zone"] == 1)
    state = result.steps[-1].zones["1"]
    np.testing.assert_array_equal(contact["pressure"][now], state.pressure)
    np.testing.assert_array_equal(np.stack([contact["r"][now], contact["y"][now]], 1), state.x)
    np.testing.assert_array_equal(contact["closed"][now], state.closed)
    cos = contact["ray_pressure"][now] / np.where(contact["pressure"][now] == 0, 1, contact["pressure"][now])
    slope = np.sqrt(
        np.maximum(1 / np.where(cos == 0, 1, cos) ** 2 - 1, 0)
    )  # B-C narrows; the elastic A-B hardly slopes
    axial = np.sum(contact["ray_pressure"][now] * contact["weight"][now] * slope)
    assert axial == pytest.approx(result.reaction[-1], rel=1e-3)


@pytest.mark.mpi
def test_fields_are_written(result: Result, folder: Path) -> None:
    assert sum(file.stat().st_size for file in (folder / "fields.bp").iterdir()) > 10_000


@pytest.mark.mpi
def test_record(result: Result, folder: Path) -> None:
    """run.json is the JSON of the result, and repeats it: the case as it was run is in it."""
    data = json.loads((folder / "run.json").read_text())
    assert {key: data[key] for key in result.to_dict()} == result.to_dict() | {"seconds": data["seconds"]}
    assert data["error"] is None
    assert cases.from_dict(tomllib.loads(data["toml"])) == CASE


@pytest.mark.mpi
def test_snapshots(result: Result) -> None:
    """The steps nearest to t = 20, 70 and 155, and the last: here 20 and 30. Each vertex once, whatever the ranks."""
    if COMM.rank != 0:
        assert result.snapshots is None
        return
    shots = result.snapshots
    assert shots is not None
    np.testing.assert_array_equal(shots.t, [20, 30])
    assert (len(shots.points), len(shots.triangles)) == (333, 510)
    a, b, c = (shots.points[shots.triangles[:, i]] for i in range(3))
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert area[shots.billet].sum() == pytest.approx(50 * 65)
    k = np.flatnonzero(np.linalg.norm(shots.points - CASE.profile.points["K"], axis=1) < 1e-9)
    np.testing.assert_allclose(shots.displacement[:, k[0]], result.point("K")[1:])
    assert shots.von_mises.shape == (2, 510)


@pytest.fixture(scope="module")
def quarter(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """A run in three dimensions on all ranks, on 20-node hexahedra."""
    folder = Path(COMM.bcast(str(tmp_path_factory.mktemp("quarter"))))
    result = run(QUARTER, out=folder)
    COMM.barrier()
    return folder, result


@pytest.mark.mpi
def test_files_in_space(quarter: tuple[Path, Result]) -> None:
    """Tables with x, y, z, fields, and the same pictures as of a half-plane; K is that of the result."""
    folder, result = quarter
    assert result.converged, result.error
    contact = table(folder / "contact.csv")
    now, state = contact["t"] == 20, result.steps[-1].zones["1"]
    np.testing.assert_array_equal(np.stack([contact[axis][now] for axis in "xyz"], axis=1), state.x)
    np.testing.assert_array_equal(contact["pressure"][now], state.pressure)
    assert np.ptp(contact["z"]) > 45
    history = table(folder / "history.csv")
    np.testing.assert_array_equal(np.stack([history["u_r_K"], history["u_y_K"]], axis=1), result.point("K"))
    assert sum(file.stat().st_size for file in (folder / "fields.bp").iterdir()) > 100_000
    pytest.importorskip("matplotlib")
    if COMM.rank == 0:
        before = [(folder / f"{kind}.png").read_bytes() for kind in plots.KINDS]
        assert min(map(len, before)) > 20_000
        assert [path.read_bytes() for path in plots.write(plots.Record.read(folder), folder)] == before


def by_place(shots: Snapshots) -> np.ndarray:
    """A row a triangle: body, places, displacements and stresses at all t; in the order of body and places."""
    u = shots.displacement[:, shots.triangles].transpose(1, 0, 2, 3).reshape(len(shots.triangles), -1)
    places = np.round(shots.points[shots.triangles].reshape(-1, 6), 6)
    rows = np.column_stack([shots.billet, places, u, shots.von_mises.T])
    return np.asarray(rows[np.lexsort(rows[:, :7].T)])


@pytest.mark.mpi
def test_snapshots_in_space(quarter: tuple[Path, Result]) -> None:
    """The plane z = 0, each of its vertices once, and the same on any number of ranks."""
    _, result = quarter
    if COMM.rank != 0:
        assert result.snapshots is None
        return
    shots = result.snapshots
    assert shots is not None
    np.testing.assert_array_equal(shots.t, [20])
    a, b, c = (shots.points[shots.triangles[:, i]] for i in range(3))
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert area[shots.billet].sum() == pytest.approx(50 * 65)
    profile = QUARTER.profile
    outline = np.array([vertex[1:] for vertex in profile.die])
    turned = np.roll(outline, -1, axis=0)
    whole = 0.5 * abs(np.sum(outline[:, 0] * turned[:, 1] - outline[:, 1] * turned[:, 0]))
    assert area[~shots.billet].sum() == pytest.approx(whole)
    assert len(np.unique(np.column_stack([shots.points, _in_billet(shots)]), axis=0)) == len(shots.points)
    alone = run(QUARTER, comm=MPI.COMM_SELF).snapshots
    assert alone is not None
    np.testing.assert_allclose(by_place(shots), by_place(alone), rtol=1e-6, atol=1e-6)


def _in_billet(shots: Snapshots) -> np.ndarray:
    return np.isin(np.arange(len(shots.points)), shots.triangles[shots.billet])


def test_rings() -> None:
    """Points at about the same y make one ring; points farther off the next one."""
    y, p = np.array([5.1, 1.0, 5.0, 1.05, 5.15]), np.array([3.0, 1.0, 6.0, 2.0, 3.0])
    np.testing.assert_allclose(plots.rings(y, p, 0.2), [[1.025, 5.25 - 1 / 6], [1.5, 4], [1, 3], [2, 6]])


@pytest.mark.parametrize(
    ("case", "name"),
    [(cases.A, "P1"), (cases.E, "P2"), (cases.B, "Q1"), (replace(cases.B, order=2), "Q2"), (cases.G, "20-node")],
)
def test_element_names(case: cases.Case, name: str) -> None:
    assert element_name(case) == name


def test_von_mises_of_a_free_billet() -> None:
    """Contact only checked: the billet moves rigidly, without stress."""
    shots = run(cases.A, increment=20, until=20, contact="check").snapshots
    assert shots is not None
    np.testing.assert_allclose(shots.von_mises, 0, atol=1e-8)
    billet = np.unique(shots.triangles[shots.billet])
    np.testing.assert_allclose(shots.displacement[0, billet], np.tile([0, 20], (len(billet), 1)), atol=1e-12)


def test_pictures(result: Result, folder: Path) -> None:
    """Drawn from the result or from its files, a picture is the same, and shows something."""
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    for kind in plots.KINDS:
        drawn = imread(folder / f"{kind}.png")
        assert min(drawn.shape[:2]) > 400
        assert len(np.unique(drawn.reshape(-1, drawn.shape[2]), axis=0)) > 50
    before = [(folder / f"{kind}.png").read_bytes() for kind in plots.KINDS]
    plots.write(plots.Record.read(folder), folder)
    assert [(folder / f"{kind}.png").read_bytes() for kind in plots.KINDS] == before
    with pytest.raises(InputError, match="choose one of billet, history, pressure"):
        result.plot("billets")  # type: ignore[arg-type]


@pytest.mark.parametrize("executable", [sys.executable, "/bin/false", "/nowhere", None])
@pytest.mark.parametrize("pickles", [True, False])
def test_painter(
    result: Result,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    executable: str | None,
    pickles: bool,
) -> None:
    """Another process draws the same pictures; where it fails, or cannot begin, they are drawn here."""
    pytest.importorskip("matplotlib")
    record, here = plots.Record.of(result), []
    if not pickles:
        record = replace(record, pressure=type("Mine", (dict,), {})(record.pressure))
    draw = plots.write
    (tmp_path / "matplotlib.py").write_text("raise SystemExit(3)")  # not what this process would import
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "matplotlib")
        patch.setattr("extrusion.painter.cores", lambda: 2)
        patch.setattr("sys.executable", executable)
        painter = Painter(1)
    monkeypatch.setattr(plots, "write", lambda *args: here.append(args) or draw(*args))
    painter.write(record, tmp_path)
    assert bool(here) is not (pickles and executable == sys.executable)
    for kind in plots.KINDS:
        assert (tmp_path / f"{kind}.png").read_bytes() == (folder / f"{kind}.png").read_bytes()


def test_painter_that_has_gone(result: Result, tmp_path: Path) -> None:
    """Writing to it is a signal, by which PETSc would end this process."""
    pytest.importorskip("matplotlib")
    (tmp_path / "record").write_bytes(pickle.dumps(plots.Record.of(result)))
    code = """
import pickle, sys, time
from mpi4py import MPI
from petsc4py import PETSc
from extrusion import painter
painter.cores = lambda: 2
python, sys.executable = sys.executable, "/bin/false"
one = painter.Painter(1)
sys.executable = python
time.sleep(0.5)
one.write(pickle.load(open("record", "rb")), painter.Path.cwd())
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert {path.name for path in tmp_path.glob("*.png")} == {f"{kind}.png" for kind in plots.KINDS}


def test_no_half_pictures(result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is interrupted leaves the picture that was there."""
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    def fail(self: Figure, path: Path, **_: object) -> None:
        path.write_text("half")
        raise KeyboardInterrupt

    (tmp_path / "billet.png").write_text("whole")
    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(KeyboardInterrupt):
        plots.write(plots.Record.of(result), tmp_path)
    assert (tmp_path / "billet.png").read_text() == "whole"


def test_painter_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """No process is begun where there is no core for it, and none outlives a run that comes to nothing."""
    pytest.importorskip("matplotlib")
    monkeypatch.delitem(sys.modules, "matplotlib")
    monkeypatch.setattr("extrusion.painter.cores", lambda: 2)
    begun = []
    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *args, **kw: begun.append(popen(*args, **kw)) or begun[-1])
    Painter(2)
    assert not begun
    Painter(1)  # and goes
    assert [process.returncode for process in begun] == [-signal.SIGKILL]


@pytest.mark.parametrize(
    ("reaction", "unit", "labels"),
    [
        ([0.0, 2e5, 8e5], "[kN]", None),
        ([0.0, -3e5, 7e5, 8e5, 3e7], "[MN], logarithmic from 1 on", ["0", "0.5", "1", "2", "5", "10", "20"]),
        ([0.0, 1e-20], "[N]", None),
        ([0.0, 6.3], "[N]", None),
        ([1e-25, 2e-24, 0.0, 1e-24, 3e-25, 1e-24, 0.0, 2e3], "[kN]", None),  # free until the last step
    ],
)
def test_axis_of_the_reaction(reaction: list[float], unit: str, labels: list[str] | None) -> None:
    """In a unit of its size; logarithmic, and said to be, where a few values are far larger than the rest."""
    pytest.importorskip("matplotlib")
    t = np.arange(1.0, len(reaction) + 1)
    axes = plots.history(plots.Record(cases.C, t, t, np.array(reaction), {}, None)).axes[0]
    assert axes.get_ylabel() == f"reaction on the rear face\n{unit}"
    shown = [label.get_text() for label in axes.get_yticklabels()]
    if labels is None:
        assert axes.get_yscale() == "linear"
        assert len(shown) > 3
        low, high = axes.get_ylim()
        assert low <= 0 < max(force / (1e3 if "k" in unit else 1) for force in reaction) <= high
    else:
        assert [text for text in shown if not text.startswith("-")] == labels


def test_a_billet_turned_inside_out_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    """Case A without the step's limit goes on past t = 200 with rows of cells pushed through each other."""
    assert run(cases.A, increment=10, until=220).converged
    (record,) = (record for record in caplog.records if record.name == "extrusion.output")
    assert "of the billet's section is turned inside out" in record.message
    caplog.clear()
    run(cases.A, increment=10, until=155)
    assert "inside out" not in caplog.text


@pytest.mark.parametrize("name", ["history.csv", "contact.csv"])
def test_a_file_that_cannot_be_written_leaves_the_others(name: str, tmp_path: Path) -> None:
    """What an earlier run left is removed only when all can be written anew."""
    (tmp_path / "run.json").write_text("an earlier run")
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        run(cases.A, until=5, out=tmp_path)
    assert (tmp_path / "run.json").read_text() == "an earlier run"


def test_failed_run_keeps_its_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a single iteration the first increment goes, the billet being free; the next, on B-C, fails."""
    monkeypatch.setattr("extrusion.newton.Newton", partial(Newton, max_iterations=0))
    (tmp_path / "run.json").write_text("an earlier run")
    on_disk = []
    watch = [lambda problem, step: on_disk.append(len((tmp_path / "history.csv").read_text().splitlines()))]
    result = run(cases.A, until=20, out=tmp_path, observers=watch)
    assert on_disk == [2]  # header and step, while the run goes on
    assert not result.converged
    assert result.error is not None
    assert "zone 1" in result.error
    np.testing.assert_array_equal(result.t, [5])
    np.testing.assert_array_equal(table(tmp_path / "history.csv")["t"], [5])
    data = json.loads((tmp_path / "run.json").read_text())
    assert (data["converged"], data["error"], len(data["steps"])) == (False, result.error, 1)


@pytest.mark.mpi
def test_unwritable(tmp_path: Path) -> None:
    """A file where the folder should be: every rank is told, before anything is solved."""
    blocked = Path(COMM.bcast(str(tmp_path / "file")))
    if COMM.rank == 0:
        blocked.touch()
    COMM.barrier()
    with pytest.raises(InputError, match="cannot be written"):
        run(CASE, out=blocked / "out", observers=[lambda problem, step: pytest.fail("solved")])


def test_what_leaves_the_die_is_pictured(result: Result) -> None:
    """The panel ended at the die's top, and was empty once the billet was past it."""
    record = plots.Record.of(result)
    assert record.snapshots is not None
    moved = replace(record.snapshots, displacement=record.snapshots.displacement + np.array([0.0, 300.0]))
    axes = plots.draw(replace(record, snapshots=moved), "billet").axes[0]
    assert axes.get_ylim()[1] > 300


@pytest.mark.parametrize("space", ["axisymmetric", "3d"])
def test_pressure_on_the_front(space: str, tmp_path: Path) -> None:
    """Without a zone on the side it stands over r; from the files as from the run."""
    case = replace(cases.A, zones=cases.A.zones[1:], figures=(), method="penalty", order=1, size=12.0, space=space)
    ran = run(case, out=tmp_path, increment=70.0, until=140.0, comm=MPI.COMM_SELF, pictures=False)
    for record in (plots.Record.of(ran), plots.Record.read(tmp_path)):
        axes = plots.draw(record, "pressure").axes[0]
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("r [mm]", "contact pressure on the front [MPa]")
        r, _ = record.pressure[140.0]
        assert 0 <= r.min() < r.max() < 55  # y is 205
