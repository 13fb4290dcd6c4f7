"""The command ``extrusion``.

Exit codes: 0 done, 1 a step could not be solved, a figure is out or a disk is full, 2 bad input, 130 interrupted.
DOLFINx is imported by the commands that need it, so that help and lists are quick.
"""

from __future__ import annotations

import atexit
import errno
import gc
import json
import logging
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

import click
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import extrusion
from extrusion.cases import CASES, METHODS, Case, read_toml
from extrusion.contact import CLOSURES
from extrusion.errors import InputError, StepError
from extrusion.interrupt import interrupted_after

if TYPE_CHECKING:
    from extrusion.estimate import Goal
    from extrusion.problem import Problem
    from extrusion.result import Observer, Result
    from extrusion.stepping import Step

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


class _Path(click.Path):
    """A path: not nothing, nor the option after one that lacks its value."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "" or (isinstance(value, str) and value.startswith("-") and value != "-"):
            name = param.opts[0] if param else ""
            raise click.BadOptionUsage(name, f"Option {name!r} requires an argument, not {value!r}.")
        return super().convert(value, param, ctx)


PATH = _Path(path_type=Path)


def _folder[F: Callable[..., None]](default: str) -> Callable[[F], F]:
    """The option of a command that writes tables and a picture."""
    told = "Folder of its tables and picture."
    return click.option("--out", type=PATH, default=Path(default), show_default=True, metavar="DIR", help=told)


@click.group(context_settings={"help_option_names": ["-h", "--help"]}, no_args_is_help=True)
@click.version_option(extrusion.__version__, message="%(version)s", help="Print the version.")
def app() -> None:
    """An elastic billet pushed through a die: large-sliding contact on FEniCSx."""


@app.command("list")
def list_cases() -> None:
    """List the built-in cases."""
    table = Table(box=SIMPLE_HEAD, padding=0)
    for name in ("case", "space", "title", "t up to\nmm", "figures"):
        table.add_column(name)
    for case in CASES.values():
        title = case.title[len(case.space) :].lstrip() if case.title.lower().startswith(case.space) else case.title
        table.add_row(case.name, case.space, title, f"{case.end:g}", str(len(case.figures)))
    Console().print(table)


@app.command()
@click.argument("case", metavar="CASE|FILE.toml")
@click.option("--method", metavar="|".join(METHODS), help="How contact is written.")
@click.option("--order", type=int, metavar="1|2", help="Order of the displacements.")
@click.option("--die", metavar="elastic|rigid")
@click.option("--contact", metavar="|".join(CLOSURES), help="Contact in every zone; check only reports it.")
@click.option("--size", type=float, metavar="MM", help="Element size on the billet's side of a graded mesh.")
@click.option("--mesh", type=PATH, metavar="FILE", help="Mesh (.msh, .med) in place of the case's.")
@click.option(
    "--space", metavar="axisymmetric|3d|plane strain", help="The half-plane, a quarter in three dimensions, or a slab."
)
@click.option("--sectors", type=int, metavar="N", help="In 3d: elements over the quarter turn.")
@click.option("--element", metavar="lagrange|serendipity", help="In 3d with order 2: 27 or 20 nodes a hexahedron.")
@click.option("--increment", type=float, metavar="MM", help="Uniform increment, in place of the case's table.")
@click.option("--until", type=float, metavar="MM", help="Last t; by default the case's.")
@click.option("--form", metavar="displacement|mixed", help="The billet's bulk; by default mixed above nu 0.49.")
@click.option("--gamma", type=float, help="Dimensionless contact stiffness.")
@click.option("--theta", type=int, metavar="-1|0|1", help="Variant of Nitsche's method.")
@click.option(
    "--solver",
    default="auto",
    show_default=True,
    metavar="auto|surface|full|iterative",
    help="Newton's method on contact's forces, or on all unknowns; iterative: these by multigrid, in 3d.",
)
@click.option(
    "--guide",
    default="auto",
    show_default=True,
    metavar="auto|on|off",
    help="A coarser model that goes ahead, from which each increment starts.",
)
@click.option(
    "--tolerance", type=float, metavar="X", help="Relative error of the goal, for which the cheapest model is chosen."
)
@click.option("--goal", metavar="K|reaction", help="What the tolerance is of; by default K.")
@click.option("--adapt", is_flag=True, help="Refine a mesh where the goal needs it, until it has the tolerance.")
@click.option("--out", type=PATH, metavar="DIR", help="Folder for files; by default results/CASE.")
@click.option(
    "--pictures/--no-pictures", default=True, help="Draw pictures; else `extrusion plot` does, from the files."
)
@click.option(
    "--json", "json_file", type=PATH, metavar="FILE", help="Write the result as one JSON object; - is stdout."
)
@click.option("--quiet", is_flag=True, help="Print errors only.")
def run(
    case: str,
    method: str | None,
    order: int | None,
    die: str | None,
    contact: str | None,
    size: float | None,
    mesh: Path | None,
    space: str | None,
    sectors: int | None,
    element: str | None,
    increment: float | None,
    until: float | None,
    form: str | None,
    gamma: float | None,
    theta: int | None,
    solver: str,
    guide: str,
    tolerance: float | None,
    goal: str | None,
    adapt: bool,
    out: Path | None,
    pictures: bool,
    json_file: Path | None,
    quiet: bool,
) -> None:
    """Run a case of `extrusion list`, or of a file; write tables, fields and pictures."""
    changes = dict(
        method=method, order=order, die=die, contact=contact, size=size, mesh=mesh, space=space, sectors=sectors,
        element=element, increment=increment, until=until, form=form, gamma=gamma, theta=theta,
    )  # fmt: skip
    given = {name for name, value in changes.items() if value is not None}
    logging.basicConfig(level=logging.ERROR if quiet else logging.WARNING, format="extrusion: %(message)s")
    if not quiet:
        for name in ("condensed", "guide", "estimate", "adapt"):
            logging.getLogger(f"extrusion.{name}").setLevel(logging.INFO)
    with _as_options(given | {"out", "json", "solver", "guide", "tolerance", "goal", "adapt"}):
        from extrusion.result import CHOSEN, changed
        from extrusion.result import run as solve

        if goal is not None and tolerance is None:
            raise InputError("goal", goal, "it is what a tolerance is of: give --tolerance too")
        if tolerance is not None:
            for name in CHOSEN:
                if name in given:
                    raise InputError(name, changes[name], "leave it out: with --tolerance the model is chosen")
        scene = changed(_load(case), **{**changes, "mesh": str(mesh) if mesh else None})
        out = _default_folder(scene) if out is None else out
        to_stdout = json_file == Path("-")
        if json_file and not to_stdout:
            _check_writable("json", json_file)
        _start()
        with _progress(scene, quiet) as observers, _Interrupt() as interrupt:
            result = solve(
                scene,
                out=out,
                pictures=pictures,
                observers=[*observers, interrupt],
                solver=solver,
                guide=guide,
                tolerance=tolerance,
                goal=cast("Goal", goal or "K"),
                adapt=adapt,
            )
        if json_file and _rank() == 0:
            _write_json(result, None if to_stdout else json_file)
    if not quiet and _rank() == 0:
        console = Console(stderr=to_stdout)
        console.print(result.table())
        if result.estimate is not None:
            console.print("\n".join(result.estimate.lines()), soft_wrap=True, highlight=False)
        console.print(f"Files are in {out}", soft_wrap=True, highlight=False)
    if not result.converged:
        _say(f"{result.error} (accepted steps are kept in {out})")
        sys.exit(INTERRUPTED if interrupt.stopped else 1)


@app.command()
@click.argument("cases", metavar="[CASE|FILE.toml]...", nargs=-1)
@click.option("--estimates", is_flag=True, help="Compare estimated errors with actual ones instead (a minute).")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def verify(cases: tuple[str, ...], estimates: bool, quiet: bool) -> None:
    """Run cases (all by default) as the sheet states them, and compare with its figures."""
    if estimates:
        if cases:
            raise InputError("CASE", " ".join(cases), "leave it out: --estimates takes all cases")
        _verify_estimates(quiet)
        return
    from extrusion import result

    table = Table(box=SIMPLE_HEAD, padding=0)
    for name in (
        "case",
        "contact",
        "t\nmm",
        "figure",
        "sheet\nmm",
        "computed\nmm",
        "difference\n%",
        "tolerance\n%",
        "",
    ):
        table.add_column(name, justify="left" if name in ("case", "contact", "figure", "") else "right")
    chosen = [_load(name) for name in cases] if cases else [*CASES.values()]
    for case in chosen:
        result.refuse_unverifiable(case)
    _start()
    errors, ok = [], True
    for case in chosen:
        with _progress(case, quiet) as observers, _Interrupt() as interrupt:
            results = result.verify(case, observers=[*observers, interrupt])
        if interrupt.stopped:
            _say("interrupted")
            sys.exit(INTERRUPTED)
        for one in results:
            if one.error:
                errors.append(f"{case.name}: {one.error}")
            for row in one.figures():
                ok &= row.ok
                figure = row.figure
                table.add_row(
                    *(case.name, figure.contact, f"{figure.t:g}", f"{figure.quantity}({figure.point})"),
                    *(
                        f"{figure.value:.3f}",
                        f"{row.computed:.4f}",
                        f"{100 * row.difference:+.3f}",
                        f"{100 * figure.tolerance:g}",
                    ),
                    "[green]ok[/]" if row.ok else "[red]out[/]",
                )
    if _rank() == 0:
        Console().print(table)
    for error in errors:
        _say(error)
    if errors or not ok:
        sys.exit(1)


@app.command()
@click.argument("folder", type=PATH, metavar="DIR")
def plot(folder: Path) -> None:
    """Draw the pictures of the run in a folder anew, from its files."""
    from extrusion import plots

    if _rank() == 0:
        for path in plots.write(plots.Record.read(folder), folder):
            print(path)


@app.command()
@click.argument("name", metavar="[hard-cases]", default="hard-cases")
@_folder("results/study")
def study(name: str, out: Path) -> None:
    """Run a study, or what is left of it (a quarter of an hour); writes a table as it goes, and a picture."""
    if name != "hard-cases":
        raise InputError("study", name, "the only study is hard-cases")
    _require()
    from extrusion import study as hard_cases

    if _rank() != 0:
        return
    path = out / "hard-cases.csv"
    _check_writable("--out", path)

    def tell(number: int, of: int, cell: hard_cases.Cell, outcome: hard_cases.Outcome) -> None:
        which = f"{cell.problem} {cell.die} {cell.method} P{cell.order} nu {cell.nu:g} {cell.increment:g} mm"
        print(f"{number} of {of}: {which}: {outcome.status} {outcome.note}", file=sys.stderr)

    with _writing("--out", out):
        rows = hard_cases.run(path, tell)
    table = Table(box=SIMPLE_HEAD, padding=0)
    for column in ("part, method", "cells", "converged", "excluded", "failed"):
        table.add_column(column, justify="right")
    for row in hard_cases.summary(rows):
        table.add_row(*map(str, row))
    Console().print(table)
    with _writing("--out", out):
        hard_cases.draw(rows, path.with_suffix(".png"))


def _verify_estimates(quiet: bool) -> None:
    _require()
    from mpi4py import MPI

    from extrusion.estimate import checks

    table = Table(box=SIMPLE_HEAD, padding=0)
    for name in ("case", "model", "error of", "estimated", "actual", "reference", "ratio"):
        table.add_column(name, justify="left" if name in ("case", "model", "error of") else "right")
    found = []
    for check in checks(MPI.COMM_WORLD):
        found.append(check)
        figures = (f"{check.estimated:.1e}", f"{check.actual:.1e}", f"± {check.bar:.0e}", f"{check.ratio:.2f}")
        table.add_row(check.name, check.model, check.goal, *figures, style="" if check.ok else "red")
        if not quiet:
            _say(f"{check.name}: {check.goal} estimated {check.estimated:.1e}, actual {check.actual:.1e}")
    if _rank() == 0:
        Console().print(table)
    out = [check for check in found if not check.ok]
    if out:
        _say(f"{len(out)} of {len(found)} estimates are more than 2 times too small or 10 times too large")
        sys.exit(1)


@app.command()
@click.option("--quick", is_flag=True, help="A small part of it, on shipped meshes: two minutes.")
@_folder("results/bench")
def bench(quick: bool, out: Path) -> None:
    """Measure speed against error, or what is left to measure (a quarter of an hour); writes tables, a picture."""
    _require()
    from extrusion import bench as speed
    from extrusion.painter import available

    if not available():
        raise InputError("matplotlib", "not installed", 'pip install "extrusion[plot]"')
    if _rank() != 0:
        return
    _check_writable("--out", out / "runs.jsonl")

    def tell(number: int, of: int, cell: speed.Cell, outcome: speed.Outcome) -> None:
        told = outcome.note or f"{outcome.wall:.2f} s, {outcome.iterations} iterations"
        _say(f"{number} of {of}: {cell}: {outcome.status}, {told}")

    with _as_options({"out"}), _writing("--out", out):
        here, runs = speed.run(out, quick=quick, progress=tell)
        print(speed.write(out, here, runs))


@app.command()
@click.argument("case", metavar="[CASE|FILE.toml]", default="A")
@click.option("--dim", type=int, metavar="2|3", help="Triangles or hexahedra; by default what the case needs.")
@click.option("--size", type=float, metavar="MM", help="Element size on the billet's side; else the case's divisions.")
@click.option(
    "--sectors", type=int, metavar="N", help="Hexahedra over the quarter turn; by default 10, or by the size."
)
@click.option("--order", type=int, metavar="1|2", help="Order of the hexahedra's shape; by default the case's.")
@click.option("--out", type=PATH, metavar="FILE.msh", help="By default CASE.msh.")
def mesh(
    case: str,
    dim: int | None,
    size: float | None,
    sectors: int | None,
    order: int | None,
    out: Path | None,
) -> None:
    """Mesh a case (A by default): triangles by gmsh, hexahedra without."""
    with _as_options({"dim", "size", "sectors", "order"}):
        from extrusion.result import changed

        scene = _load(case)
        dim = (3 if scene.space == "3d" else 2) if dim is None else dim
        if dim not in (2, 3):
            raise InputError("dim", dim, "choose one of 2, 3")
        if dim == 3 and scene.space == "plane strain":
            raise InputError("dim", dim, "the case is a slab in plane strain: leave it out")
        for name, value in (("sectors", sectors), ("order", order)):
            if dim == 2 and value is not None:
                raise InputError(name, value, "leave it out, or give --dim 3 too: it is of hexahedra")
        scene = changed(scene, space="3d" if dim == 3 else None, size=size, sectors=sectors)
    _require()
    from extrusion.mesh import graded_mesh, sheet_mesh, write_mesh
    from extrusion.mesh3d import hex_mesh, write_hex

    path = Path(f"{_default_folder(scene).name}.msh") if out is None else out
    if _rank() != 0:
        return
    if dim == 3:
        with _as_options({"size", "sectors", "order"}):
            solid = hex_mesh(scene.profile, scene.mesh_size, scene.sectors, scene.order if order is None else order)
        write_hex(path, solid)
        print(f"{path}: {len(solid.points)} nodes, {sum(map(len, solid.cells.values()))} hexahedra")
        return
    made = sheet_mesh(scene.profile) if scene.size is None else graded_mesh(scene.profile, scene.size)
    write_mesh(path, made)
    print(f"{path}: {len(made.points)} nodes, {sum(map(len, made.cells.values()))} triangles")


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and exit; on several ranks, an unexpected error of one ends all.

    Args:
        args: What follows the command's name; by default what the shell gave.
    """
    atexit.register(gc.freeze)  # the interpreter would look for cycles in all that is left, for a third of a second
    try:
        code = _invoke([*(sys.argv[1:] if args is None else args)])
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        full = error.errno == errno.ENOSPC and _ranks() == 1
        if not (full or isinstance(error, BrokenPipeError)):  # who read the output has left
            _unexpected(error)
        code = 1
        if full:
            _say(f"{error.strerror} for {error.filename or 'the output, or for compiled forms'}")
        if sys.stdout is not None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # it is flushed at the end
    except Exception as error:
        _unexpected(error)
    sys.exit(code)


def _invoke(args: list[str]) -> int:
    """Run the command line; its exit code."""
    try:
        with app.make_context("extrusion", args) as context:
            app.invoke(context)
        return 0
    except click.exceptions.Exit as done:  # after help, or the version
        return done.exit_code
    except InputError as error:
        _say(str(error))
    except click.exceptions.NoArgsIsHelpError as error:
        if _rank() == 0:
            print(error.format_message())
    except click.ClickException as error:
        _say(error.format_message())
    except KeyboardInterrupt:
        _say("interrupted")
        return INTERRUPTED
    return 2


def _unexpected(error: Exception) -> NoReturn:
    """End by what no command has foreseen."""
    if _by_interrupt(error):  # in a callback of PETSc
        _say("interrupted")
        sys.exit(INTERRUPTED)
    if isinstance(error, MemoryError) or "Out of memory" in str(error):
        _say("out of memory: take a coarser mesh, order 1, or in 3D --solver iterative")
        if _ranks() == 1:
            sys.exit(1)
    elif _ranks() == 1:
        raise error
    else:
        traceback.print_exc()
    sys.stderr.flush()
    sys.modules["mpi4py.MPI"].COMM_WORLD.Abort(1)
    raise error


class _Interrupt:
    """Ctrl-C while a case runs: the first one lets the step in hand end, and its files be written; the next ends all.

    An observer. Before there is an accepted step the first one ends all. On several ranks that is by force: one that
    raised an exception would leave the others waiting for it.
    """

    def __init__(self) -> None:
        self.stopped, self._heard, self._may_stop = False, 0, False
        # a job that was started to ignore Ctrl-C, or a thread, is left as it is
        main = threading.current_thread() is threading.main_thread()
        self._hears = main and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN

    def __enter__(self) -> _Interrupt:
        if self._hears:
            self._before = signal.signal(signal.SIGINT, lambda *_: self._hear())
        return self

    def __exit__(self, *_: object) -> None:
        if self._hears:
            signal.signal(signal.SIGINT, self._before)

    def _hear(self) -> None:
        self._heard += 1
        if self._heard == 1 and self._may_stop:
            _say("interrupted: stops after this step (again: at once)")
            return
        if sys.modules["mpi4py.MPI"].COMM_WORLD.size == 1:
            raise KeyboardInterrupt
        if _rank() == 0:  # past the progress bar, which has hidden the cursor
            show = "\x1b[?25h" if os.isatty(2) else ""
            os.write(2, f"{show}extrusion: interrupted\n".encode())
        os._exit(INTERRUPTED)

    def close(self) -> None:
        """The last step has been solved: what is left are pictures."""
        self._may_stop = False

    def __call__(self, problem: Problem, step: Step) -> None:
        """Stop if any rank has been told to. Collective."""
        self._may_stop = True
        if problem.comm.allreduce(self._heard):
            self.stopped = True
            raise StepError(f"interrupted after t = {step.t:g} mm")


def _say(message: str) -> None:
    """One line on stderr, from rank 0."""
    if message and _rank() == 0:
        print("extrusion:", " ".join(message.split()), file=sys.stderr)


def _by_interrupt(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _rank() -> int:
    """This process's rank; before MPI is loaded, as its launcher says."""
    if mpi := sys.modules.get("mpi4py.MPI"):
        return int(mpi.COMM_WORLD.rank)
    launchers = ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK")
    return int(next((os.environ[name] for name in launchers if name in os.environ), 0))


def _ranks() -> int:
    """How many ranks have been seen to run; one before MPI is loaded."""
    mpi = sys.modules.get("mpi4py.MPI")
    return int(mpi.COMM_WORLD.size) if mpi else 1


def _load(name: str) -> Case:
    """A built-in case, or that of a TOML file."""
    if name in CASES:
        return CASES[name]
    if not name.endswith(".toml"):
        raise InputError("CASE", name, f"unknown case: give one of {', '.join(CASES)}, or a file that ends in .toml")
    try:
        return read_toml(name)
    except InputError as error:
        if error.field == "case file":
            raise
        raise InputError(f"{name}: {error.field}", error.value, error.remedy) from None


def _default_folder(case: Case) -> Path:
    return Path("results") / case.name


@contextmanager
def _as_options(given: set[str]) -> Iterator[None]:
    """Bad values of fields that stand on the command line are told by their options."""
    try:
        yield
    except InputError as error:
        name = "until" if error.field == "increments" and "until" in given else error.field.rsplit(".", 1)[-1]
        if name not in given or ": " in error.field:
            raise
        raise InputError(f"--{name}", error.value, error.remedy) from None


def _check_writable(field: str, path: Path) -> None:
    """Refuse, before a long run, a file that could not be written after it."""
    folder = path.parent
    try:
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        if not path.exists():
            tempfile.TemporaryFile(dir=folder).close()
        elif path.is_file() or path.is_dir():
            path.open("a").close()
        elif not os.access(path, os.W_OK):  # a pipe, whose reader would see it closed
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise InputError(field, str(path), f"cannot be written ({error.strerror}); give another file") from None


@contextmanager
def _writing(field: str, folder: Path) -> Iterator[None]:
    """A folder in which a file cannot be written after all is told as the field's."""
    try:
        yield
    except OSError as error:
        raise InputError(field, str(error.filename or folder), f"cannot be written ({error.strerror})") from None


def _write_json(result: Result, path: Path | None) -> None:
    text = json.dumps(result.to_dict(), allow_nan=False) + "\n"
    try:
        if path is None:
            sys.stdout.write(text)
            sys.stdout.flush()
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError("json", str(path or "-"), f"cannot be written ({error.strerror})") from None


def _require() -> None:
    """Load MPI and PETSc."""
    from extrusion.check import require_dolfinx

    require_dolfinx()
    from petsc4py import PETSc

    PETSc.Sys.popSignalHandler()  # which answers a closed pipe, or `kill`, with a page


def _start() -> None:
    """Load MPI and PETSc, and say so if there are more ranks on this machine than cores: MPICH busy-waits."""
    with interrupted_after():
        _require()
        from mpi4py import MPI

        from extrusion import condensed, output  # noqa: F401  and with them all that a run loads

    here, cores = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED).size, os.cpu_count() or 1
    if here > cores:
        _say(f"{here} ranks on {cores} cores wait for one another; use at most {cores}")


@contextmanager
def _progress(case: Case, quiet: bool) -> Iterator[list[Observer]]:
    """Observers that show t, iterations and K on rank 0: a bar on a terminal, else about ten lines."""
    if quiet or _rank() != 0:
        yield []
        return
    console = Console(stderr=True)
    iterations, last, told = 0, 0.0, 0.0

    def text(step: Step) -> str:
        nonlocal iterations, last, told
        if step.t <= last:  # another run of the case
            iterations, told = 0, 0.0
        iterations, last = iterations + step.iterations, step.t
        u_y = step.points["K"][1]
        return f"{case.name}: t = {step.t:g} of {case.end:g} mm, {iterations} iterations, u_y(K) = {u_y:.3f} mm"

    if not console.is_terminal:

        def log(problem: Problem, step: Step) -> None:
            nonlocal told
            line = text(step)
            if step.t >= min(told + case.end / 10, case.end):
                told = step.t
                _say(line)

        yield [log]
        return
    columns: list[Any] = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(case.name, total=case.end)
        yield [lambda problem, step: progress.update(task, completed=step.t, description=text(step))]
