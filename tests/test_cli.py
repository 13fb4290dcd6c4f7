"""The command line: exit codes, one line for bad input, and what is printed where."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import extrusion
from extrusion import cases, cli
from extrusion.errors import InputError
from extrusion.mesh import read_mesh
from extrusion.mesh3d import read_hex
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.stepping import Step

Capture = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def command(*args: str) -> int:
    """Exit code of ``extrusion ARGS``."""
    with pytest.raises(SystemExit) as end:
        cli.main(args)
    assert isinstance(end.value.code, int)
    return end.value.code


def msh(kind: tuple[int, int]) -> str:
    """A mesh file of one cell, of gmsh's type and number of nodes."""
    name, (number, nodes) = 2 if kind[0] == 2 else 3, kind
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)][:nodes]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "1", f'{name} 1 "billet"']
    lines += [
        "$EndPhysicalNames",
        "$Nodes",
        str(nodes),
        *(f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(corners, 1)),
    ]
    lines += ["$EndNodes", "$Elements", "1", f"1 {number} 2 1 1 " + " ".join(map(str, range(1, nodes + 1)))]
    return "\n".join([*lines, "$EndElements", ""])


BROKEN = {
    "no.toml": "name = ",
    "short.toml": 'name = "short"\n',
    "nu.toml": cases.to_toml(cases.A).replace("nu = 0.45", "nu = 0.5"),
    "key.toml": "metod = 1\n" + cases.to_toml(cases.A),
    "between.toml": cases.to_toml(replace(cases.A, figures=(replace(cases.A.figures[0], t=7.0),))),
    "place.toml": cases.to_toml(cases.A).replace('name = "A"', 'name = "../place"', 1),
    "mesh.msh": "no mesh",
    "flat.msh": msh((2, 3)),
    "solid.msh": msh((5, 8)),
    "mesh.txt": "",
    "bare.toml": cases.to_toml(replace(cases.A, figures=())),
    "slab.toml": cases.to_toml(replace(cases.A, space="plane strain")),
}


@pytest.mark.parametrize(
    ("args", "told"),
    [
        ("run", "CASE|FILE.toml"),
        ("run Z", "CASE = 'Z': unknown case: give one of A"),
        ("run missing.toml", "case file = 'missing.toml': cannot be read"),
        ("run no.toml", "case file = 'no.toml': is no TOML"),
        ("run short.toml", "short.toml: increments"),
        ("run nu.toml", "nu.toml: materials.billet.nu = 0.5"),
        ("run key.toml", "key.toml: metod"),
        ("run place.toml", "can name a folder"),
        ("run A --method glue", "--method = 'glue'"),
        ("run A --order 3", "--order = 3"),
        ("run A --order two", "'--order': 'two' is not a valid integer"),
        ("run A --size=2mm", "'--size': '2mm' is not a valid float"),
        ("mesh B --sectors 2.5", "'--sectors': '2.5' is not a valid integer"),
        ("run A --until", "--until"),
        ("run A --out --quiet", "Option '--out' requires an argument, not '--quiet'"),
        ("mesh A --out -", "'-': give a name that ends in .msh"),
        ("run A --die soft", "--die = 'soft'"),
        ("run A --contact welded", "--contact = 'welded'"),
        ("run A --size -1", "--size = -1.0"),
        ("run A --size 1e9", "--size = 1000000000.0"),
        ("run A --size 2 --mesh mesh.msh", "--size = 2.0"),
        ("run A --mesh missing.msh", "--mesh = 'missing.msh': no such file"),
        ("run A --mesh mesh.msh", "--mesh = 'mesh.msh': cannot be read"),
        ("run A --mesh mesh.txt", "--mesh = 'mesh.txt': give a .msh or .med file"),
        ("run A --increment nan", "--increment = nan"),
        ("run A --increment 0", "--increment = 0.0"),
        ("run A --until 0", "--until = 0.0"),
        ("run A --until 156", "--until = 156.0"),
        ("run A --until 500 --increment 50", "--until = 500.0: end before the rear face leaves the die"),
        ("run A --increment 1e-6", "--increment = 1e-06: give a longer one: at most 100000"),
        ("run A --theta 1", "--theta = 1: leave it out: it is a variant of method = 'nitsche'"),
        ("verify between.toml", "figures.t = 7.0: no increment of case A ends there"),
        ("run A --gamma -3", "--gamma = -3.0"),
        ("run A --theta -2", "--theta = -2"),
        ("run A --out mesh.txt", "--out = 'mesh.txt': cannot be written"),
        ("run A --json mesh.txt/a.json", "--json = 'mesh.txt/a.json'"),
        ("run A --json /proc/a.json", "--json = '/proc/a.json': cannot be written"),
        ("run A --json /proc/version", "--json = '/proc/version': cannot be written"),
        ("run A --bogus", "--bogus"),
        ("verify short.toml", "short.toml: increments"),
        ("verify A Z", "CASE = 'Z'"),
        ("verify A bare.toml", "figures = []"),
        ("plot .", "no run.json there"),
        ("run A --mesh solid.msh", "--mesh = 'solid.msh': is a mesh in three dimensions"),
        ("run B --mesh flat.msh", "--mesh = 'flat.msh': has no cells in three dimensions"),
        ("run B --mesh solid.msh", "--mesh = 'solid.msh': has no group 'side'"),
        ("run B --sectors 4 --mesh solid.msh", "--sectors = 4: a mesh file has its own elements"),
        ("run B --sectors 7", "--sectors = 7: give an even integer"),
        ("run A --sectors 4", "--sectors = 4: leave it out: it is for space = '3d'"),
        ("run A --space flat", "--space = 'flat': choose one of"),
        ("run A --element serendipity", "--element = 'serendipity'"),
        ("run B --element serendipity", "needs space = '3d' and order 2"),
        ("run B --element tetra", "--element = 'tetra': choose one of"),
        ("run J --space axisymmetric", "off_symmetry = 1e-06"),
        ("run A --solver guess", "--solver = 'guess': choose one of"),
        ("run B --tolerance 1e-2 --sectors 4", "--sectors = 4: leave it out: with --tolerance"),
        ("run G --tolerance 1e-2 --element lagrange", "--element = 'lagrange': leave it out: with --tolerance"),
        ("run J --tolerance 1e-2", "off_symmetry = 1e-06: no model is chosen"),
        ("run J --tolerance 1e-2 --adapt", "off_symmetry = 1e-06: no model is chosen"),
        ("mesh A --dim 4", "--dim = 4: choose one of 2, 3"),
        ("mesh slab.toml --dim 3", "--dim = 3: the case is a slab"),
        ("mesh A --sectors 4", "--sectors = 4: leave it out, or give --dim 3"),
        ("mesh B --dim 2 --order 2", "--order = 2: leave it out, or give --dim 3"),
        ("mesh B --sectors 7", "--sectors = 7: give an even integer"),
        ("mesh B --order 3", "--order = 3: give 1 or 2"),
        ("mesh B --size 0.1", "--size = 0.1: give an element size between"),
        ("mesh B --out b.med", "'b.med': give a name that ends in .msh"),
        ("mesh A --size 0", "--size = 0.0"),
        ("mesh A --out a.med", "'a.med': give a name that ends in .msh"),
        ("weld A", "weld"),
    ],
)
def test_bad_input(here: Path, capsys: Capture, args: str, told: str) -> None:
    """Exit code 2, one line that names the culprit, no traceback, nothing written."""
    for name, text in BROKEN.items():
        Path(name).write_text(text)
    assert command(*args.split()) == 2
    out, err = capsys.readouterr()
    (line,) = err.splitlines()
    assert line.startswith("extrusion: ")
    assert told in line
    assert out == ""
    assert {path.name for path in here.iterdir()} == set(BROKEN)


def test_run(here: Path, capsys: Capture) -> None:
    """Files in results/CASE, a table on stdout, progress on stderr, the JSON of the issue."""
    assert command("run", "A", "--until", "20", "--json", "sub/a.json", "--method", "nitsche", "--theta", "-1") == 0
    out, err = capsys.readouterr()
    assert "20.892" in out
    assert "results/A" in out
    assert "u_y(K) = 20.892" in err
    assert {"history.csv", "contact.csv", "fields.bp", "run.json"} <= {p.name for p in (here / "results/A").iterdir()}
    data = json.loads((here / "sub/a.json").read_text())
    assert [step["t"] for step in data["steps"]] == [5, 10, 15, 20]
    # a second run takes the folder again, and --quiet says nothing
    assert command("run", "A", "--until", "5", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert len((here / "results/A/history.csv").read_text().splitlines()) == 2


def test_json_on_stdout(capsys: Capture) -> None:
    """Then stdout is JSON and nothing else."""
    assert command("run", "A", "--until", "10", "--increment", "7", "--contact", "check", "--json", "-") == 0
    data = json.loads(capsys.readouterr().out)
    assert [step["t"] for step in data["steps"]] == [7, 10]
    assert [step["points"]["K"] for step in data["steps"]] == [[0, 7], [0, 10]]


def test_run_of_a_file(here: Path) -> None:
    """A case from TOML goes to a folder of its name; options override it."""
    case = replace(cases.A.with_increment(10, 20), name="mine", die="rigid")
    (here / "case.toml").write_text(cases.to_toml(case))
    assert command("run", "case.toml", "--method", "penalty", "--until", "10", "--quiet") == 0
    data = json.loads((here / "results/mine/run.json").read_text())
    assert (data["case"], data["die"], data["method"], len(data["steps"])) == ("mine", "rigid", "penalty", 1)


def test_failed_step(here: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit code 1, where and what to do on stderr; accepted steps are in the files and in the JSON."""
    monkeypatch.setattr("extrusion.newton.Newton", partial(Newton, max_iterations=0))
    assert command("run", "A", "--until", "20", "--json", "a.json") == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert "zone 1" in last
    assert "Try" in last
    data = json.loads((here / "a.json").read_text())
    assert (data["converged"], [step["t"] for step in data["steps"]]) == (False, [5])
    assert len((here / "results/A/history.csv").read_text().splitlines()) == 2


@pytest.mark.parametrize("ranks", [1, 2])
def test_interrupted(here: Path, ranks: int) -> None:
    """Ctrl-C: the step in hand is the last one; all files are written, and all ranks end, if one alone is told."""
    start = [sys.executable, "-m", "extrusion", "run", "A", "--increment", "0.05", "--json", "a.json", "--out"]
    start.append(str(here / "out"))
    if ranks > 1:
        launcher = Path(sys.executable).with_name("mpiexec")
        if not launcher.exists() or (os.cpu_count() or 1) < ranks:
            pytest.skip("no mpiexec beside this Python, or one core")
        start = [str(launcher), "-n", str(ranks), *start]
    running = subprocess.Popen(start, stderr=subprocess.PIPE, text=True, start_new_session=True)
    history = here / "out/history.csv"
    for _ in range(600):
        if history.exists() and len(history.read_text().splitlines()) > 2:
            break
        time.sleep(0.1)
    to = running.pid
    if ranks > 1:
        began = f"{sys.executable}\0-m\0extrusion".encode()
        lines = {int(path.parent.name): path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")}
        ours = [pid for pid, line in lines.items() if line.startswith(began) and start[-1].encode() in line]
        assert len(ours) == ranks
        to = max(ours)
    os.kill(to, signal.SIGINT)
    told = running.communicate(timeout=60)[1].splitlines()
    assert running.returncode == 130, told
    assert sum("stops after this step" in line for line in told) == (ranks == 1)  # rank 0 speaks
    assert sum("interrupted after t" in line for line in told) == 1
    data = json.loads((here / "a.json").read_text())
    assert data["error"] == f"interrupted after t = {data['steps'][-1]['t']:g} mm"
    assert len(history.read_text().splitlines()) == len(data["steps"]) + 1 > 2
    assert command("plot", "out") == 0


def test_interrupted_before_the_first_step(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """There is nothing to keep; in a callback of PETSc, too, it is one line."""

    def press(self: Newton, *_: object) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)

    monkeypatch.setattr(Newton, "_residual", press)
    assert command("run", "A", "--until", "5", "--quiet") == 130
    assert capsys.readouterr().err == "extrusion: interrupted\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_interrupted_anywhere(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """Where no step is watched it is one line, too."""

    def press(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("extrusion.cli._load", press)
    assert command("mesh", "A") == 130
    assert capsys.readouterr().err == "extrusion: interrupted\n"


def test_interrupted_while_drawing(here: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """All steps are solved: nothing is left to stop after, and what has been written stays."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("extrusion.plots.write", lambda *_: os.kill(os.getpid(), signal.SIGINT) or time.sleep(1))
    monkeypatch.setattr("extrusion.painter.cores", lambda: 1)
    assert command("run", "A", "--until", "10", "--quiet") == 130
    assert capsys.readouterr().err == "extrusion: interrupted\n"
    assert len(json.loads((here / "results/A/run.json").read_text())["steps"]) == 2


def test_interrupted_verify(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """It ends with the step in hand, and goes on to no other case."""
    steps: list[float] = []

    def press(problem: Problem, step: Step) -> None:
        steps.append(step.t)
        if len(steps) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    @contextmanager
    def progress(*_: object) -> Iterator[list[Any]]:
        yield [press]

    monkeypatch.setattr(cli, "_progress", progress)
    assert command("verify", "A", "C") == 130
    told = capsys.readouterr().err.splitlines()
    assert told == ["extrusion: interrupted: stops after this step (again: at once)", "extrusion: interrupted"]
    assert steps == [5.0, 10.0, 5.0]  # the last of the same case, only checked


def test_matplotlib_that_does_not_load(here: Path) -> None:
    """One line; the run is kept."""
    pytest.importorskip("matplotlib")
    start = [sys.executable, "-m", "extrusion", "run", "A", "--until", "5", "--quiet"]
    done = subprocess.run(start, env={**os.environ, "MPLBACKEND": "paper"}, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("extrusion: matplotlib = 'does not load': ")
    assert len(done.stderr.splitlines()) == 1
    assert (here / "results/A/run.json").exists()


def test_out_of_memory(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    """PETSc's own words are a page."""

    def fail(self: Newton, *_: object) -> None:
        raise RuntimeError("Failed to call PETSc function 'X'. PETSc error code is: 55, Out of memory")

    monkeypatch.setattr(Newton, "__init__", fail)
    assert command("run", "A", "--until", "5", "--quiet") == 1
    assert capsys.readouterr().err.startswith("extrusion: out of memory: take a coarser mesh")


def test_in_a_thread() -> None:
    """Where no signal can be caught."""
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(command("run", "A", "--until", "5", "--quiet")))
    thread.start()
    thread.join()
    assert codes == [0]


@pytest.mark.parametrize(("value", "code"), [(20.825, 0), (20.9, 1)])
def test_verify(here: Path, capsys: Capture, value: float, code: int) -> None:
    """Exit code 1 as soon as one figure is out."""
    figures = (cases.A.figures[0], cases.Figure(t=20, value=value, tolerance=2e-3))
    (here / "case.toml").write_text(cases.to_toml(replace(cases.A.with_increment(5, 20), figures=figures)))
    assert command("verify", "case.toml") == code
    out = capsys.readouterr().out
    assert ("out" in out) is bool(code)
    assert f"{value:.3f}" in out
    assert [path.name for path in here.iterdir()] == ["case.toml"]


def test_verify_of_a_figure_not_reached(here: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that stops early has not met its figures."""
    monkeypatch.setattr("extrusion.newton.Newton", partial(Newton, max_iterations=0))
    figures = tuple(f for f in cases.A.figures if f.t <= 20)
    (here / "case.toml").write_text(cases.to_toml(replace(cases.A.with_increment(5, 20), figures=figures)))
    assert command("verify", "case.toml", "--quiet") == 1
    assert "zone 1" in capsys.readouterr().err


def test_help(capsys: Capture) -> None:
    """Which arguments may be left out, with the help that a command without any gives; and a reader that has gone."""
    assert command() == 2
    assert "Usage: extrusion [OPTIONS] COMMAND" in capsys.readouterr().out
    for name, argument in (("mesh", "[CASE|FILE.toml]"), ("study", "[hard-cases]"), ("run", "CASE|FILE.toml")):
        assert command(name, "-h") == 0
        assert f"extrusion {name} [OPTIONS] {argument}\n" in capsys.readouterr().out
    start = [sys.executable, "-m", "extrusion", "-h"]
    asked = subprocess.Popen(start, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert asked.stdout is not None
    asked.stdout.close()
    assert asked.stderr is not None
    assert asked.stderr.read() == b""
    assert asked.wait() == 1
    asked.stderr.close()


def test_plot(here: Path, capsys: Capture) -> None:
    """Pictures can be drawn from the files, if they were not wanted before."""
    pytest.importorskip("matplotlib")
    assert command("run", "A", "--until", "20", "--out", "here", "--quiet", "--no-pictures") == 0
    assert not list(Path("here").glob("*.png"))
    assert command("plot", "here") == 0
    assert capsys.readouterr().out.split() == ["here/billet.png", "here/history.png", "here/pressure.png"]
    assert all(path.stat().st_size > 10_000 for path in Path("here").glob("*.png"))


def test_no_pictures_without_matplotlib(
    here: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told, and is no error."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert command("run", "A", "--until", "5") == 0
    assert "pictures skipped" in caplog.text
    assert not list(here.rglob("*.png"))


def test_mesh(here: Path, capsys: Capture) -> None:
    """The mesh it writes is one that `run` takes."""
    pytest.importorskip("gmsh", exc_type=ImportError)
    assert command("mesh", "--size", "8", "--out", "coarse.msh") == 0
    assert f"{len(read_mesh('coarse.msh').points)} nodes" in capsys.readouterr().out
    assert command("run", "A", "--mesh", "coarse.msh", "--until", "5", "--quiet") == 0


def test_mesh_in_space(here: Path, capsys: Capture) -> None:
    """Hexahedra by --dim 3, for a case in three dimensions by themselves; `run` takes them, without gmsh."""
    assert command("mesh", "A", "--dim", "3", "--size", "16", "--sectors", "4", "--order", "2", "--out", "a.msh") == 0
    assert command("mesh", "B", "--size", "16") == 0
    told = capsys.readouterr().out.splitlines()
    for path, line, order in (("a.msh", told[0], 2), ("B.msh", told[1], 1)):
        made = read_hex(path)
        assert made.order == order
        assert line == f"{path}: {len(made.points)} nodes, {sum(map(len, made.cells.values()))} hexahedra"
    given = ("--space", "3d", "--order", "2", "--mesh", "a.msh", "--until", "5")
    assert command("run", "A", *given) == 0
    assert "Q2" in capsys.readouterr().out
    assert command("run", "B", "--mesh", "B.msh", "--until", "5", "--quiet") == 0
    dofs = [json.loads((here / f"results/{case}/run.json").read_text())["dofs"] for case in "AB"]
    assert dofs[0] > 5 * dofs[1]


def test_run_in_space(here: Path) -> None:
    """--space, --sectors and --element make another case, which run.json has; 20 nodes are fewer than 27."""
    dofs = []
    for element in ("lagrange", "serendipity"):
        given = ("--order", "2", "--size", "16", "--sectors", "6", "--element", element)
        assert command("run", "A", "--space", "3d", *given, "--until", "5", "--out", element, "--quiet") == 0
        data = json.loads((here / element / "run.json").read_text())
        assert {'space = "3d"', "sectors = 6", f'element = "{element}"'} <= set(data["toml"].splitlines())
        dofs.append(data["dofs"])
    assert 1.4 < dofs[0] / dofs[1] < 2.0
    assert command("run", "G", "--space", "axisymmetric", "--until", "5", "--quiet") == 0


def test_tolerance_in_space(here: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A case with an axis of symmetry is solved as axisymmetric, and that is said."""
    assert command("run", "B", "--tolerance", "1e-2", "--until", "15", "--json", "b.json") == 0
    assert "case B have an axis of symmetry: solved as axisymmetric" in caplog.text
    data = json.loads((here / "b.json").read_text())
    assert data["estimate"]["parts"][0]["name"] == "axisymmetry instead of three dimensions"
    assert 'space = "axisymmetric"' in json.loads((here / "results/B/run.json").read_text())["toml"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("args", ["", "list", "--version", "run --help"])
def test_full_output(args: str, unbuffered: str) -> None:
    """One line, whether it is told when it is written or when all is flushed."""
    start = [sys.executable, "-m", "extrusion", *args.split()]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            start, stdout=full, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": unbuffered}
        )
    told = "extrusion: No space left on device for the output, or for compiled forms\n"
    assert (done.returncode, done.stderr) == (1, told)


def test_no_output() -> None:
    """Of a job that was started without one."""
    done = subprocess.run(f"'{sys.executable}' -m extrusion list >&-", shell=True, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_pipe_that_may_be_written(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not opened beforehand, which would wait for its reader, or end it; refused if it may not be written."""
    os.mkfifo("pipe")
    cli._check_writable("json", Path("pipe"))
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match="Permission denied"):
        cli._check_writable("json", Path("pipe"))


def test_list_and_version(capsys: Capture) -> None:
    assert command("list") == 0
    listed = capsys.readouterr().out
    for name, case in cases.CASES.items():
        (line,) = (line for line in listed.splitlines() if line.split()[:1] == [name])
        assert line.split()[1] == case.space
    assert "P1, discrete contact" in listed
    assert command("--version") == 0
    assert capsys.readouterr().out.strip() == extrusion.__version__


def test_two_ranks(here: Path) -> None:
    """Under a launcher, K is where one rank puts it, and what is said is said once."""
    launcher = Path(sys.executable).with_name("mpiexec")
    if not launcher.exists() or (os.cpu_count() or 1) < 2:
        pytest.skip("no mpiexec beside this Python, or one core")
    start = [str(launcher), "-n", "2", sys.executable, "-m", "extrusion", "run", "A"]
    quiet = partial(subprocess.run, capture_output=True, text=True, timeout=120)
    bad = quiet([*start, "--out", __file__])
    assert bad.returncode == 2, bad.stderr
    assert len(bad.stderr.splitlines()) == 1
    good = quiet([*start, "--until", "20", "--json", "two.json", "--quiet"])
    assert (good.returncode, good.stdout, good.stderr) == (0, "", "")
    assert command("run", "A", "--until", "20", "--json", "one.json", "--quiet") == 0
    one, two = (json.loads(Path(name).read_text()) for name in ("one.json", "two.json"))
    assert two["ranks"] == 2
    K = [[step["points"]["K"] for step in data["steps"]] for data in (one, two)]
    np.testing.assert_allclose(*K, rtol=0, atol=1e-8)
