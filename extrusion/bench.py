"""Speed against error: what each way to solve case A costs, and how far it is from the converged reference.

Three parts (``extrusion bench``; runs that are done are not done again), all by increments of 5 mm:

- ``front``: method x order x size x die to the end, in `FRONT_TURNS` turns;
- ``pairs``: the surface solver against the full one, one after the other, in `PAIR_TURNS` turns;
- ``growth``: one method on finer and finer meshes.

Each run is a process of its own with one thread, warmed up by a small run, so that peak memory is its own and no form
is compiled on the clock. Seconds are CPU seconds; gmsh's work is not among them.
"""

from __future__ import annotations

import csv
import importlib.metadata
import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import date
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import extrusion
from extrusion.cases import Case
from extrusion.errors import InputError, StepError
from extrusion.reference import STATIONS, errors, pressure_at_stations, problems, read

FRONT_TURNS, PAIR_TURNS = 3, 5
PAIRS = ((4.0, 155.0), (1.0, 155.0), (0.6, 155.0), (0.2, 50.0))
"""Sizes (mm) at which the two solvers are compared, and until which t (mm)."""

GROWTH_SIZES, GROWTH_UNTIL = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125, 0.0625), 30.0
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
PHASES = ("setup", "factor", "condensation", "steps", "output")
PRESSURE_AT = 50.0
"""t (mm) at which the pressure along the side is compared."""


@dataclass(frozen=True)
class Cell:
    """One run."""

    part: str  # front, pairs or growth
    method: str
    order: int
    size: float | None  # mm; None: the sheet's divisions
    die: str
    solver: str
    until: float = 155.0  # mm
    guide: str = "auto"
    turn: int = 0

    def case(self) -> Case:
        """The scene of this run."""
        changes: dict[str, Any] = {name: getattr(self, name) for name in ("method", "order", "size", "die")}
        return replace(problems()["unilateral"], **changes).with_increment(5.0, self.until)

    def __str__(self) -> str:
        mesh = "sheet" if self.size is None else f"{self.size:g} mm"
        guide = "" if self.guide == "auto" else f" guide {self.guide}"
        return f"{self.part} {self.method} P{self.order} {mesh} {self.die} {self.solver}{guide} to {self.until:g}"


@dataclass(frozen=True)
class Outcome:
    """What a run took, and how right it is; errors are relative, each beside the reference's error bar."""

    status: str  # converged or failed
    note: str = ""
    dofs: int = 0
    increments: int = 0
    iterations: int = 0
    setup: float = math.nan  # CPU s, as are the next four
    factor: float = math.nan  # of the bulk, once (surface solver; the full one factors in its steps)
    condensation: float = math.nan
    steps: float = math.nan  # with the guide, if there is one
    output: float = math.nan  # displacements and stresses at all dofs at three t
    wall: float = math.nan  # s, of all five
    base: float = math.nan  # MB, before
    memory_factor: float = math.nan  # MB, peak until the bulk is factored
    memory: float = math.nan  # MB, peak
    compliance: float = math.nan  # MB
    K_error: float = math.nan  # largest over the reference's t
    K_bar: float = math.nan
    reaction_error: float = math.nan  # the same, of max(7.8e5 N, its size)
    reaction_bar: float = math.nan
    pressure_error: float = math.nan  # L2 along the side at t = 50
    pressure_bar: float = math.nan


def cells(*, quick: bool = False) -> list[Cell]:
    """All runs, in order: turn by turn, so that what is compared is run one after the other."""
    front: list[Cell] = []
    for die in ("elastic", "rigid"):
        front += [Cell("front", "nodal", order, size, die, "surface") for order in (1, 2) for size in (None, 4.0, 2.0)]
        for method in ("penalty", "nitsche", "mortar"):
            front += [Cell("front", method, 1, size, die, "surface") for size in (None, 4.0, 2.0)]
            front += [Cell("front", method, 2, size, die, "surface") for size in (None, 4.0, 2.0, 1.0, 0.5)]
    if quick:
        few = [cell for cell in front if cell.die == "elastic" and (cell.size or 4.0) >= 2]
        few += [cell for cell in front if cell.die == "rigid" and cell.order == 2 and cell.size == 4]
        return [*few, *_pairs(4.0, 50.0)]
    growth = [Cell("growth", "nitsche", 2, size, "elastic", "surface", GROWTH_UNTIL) for size in GROWTH_SIZES]
    turns = [replace(cell, turn=turn) for turn in range(FRONT_TURNS) for cell in front]
    return [*turns, *(cell for pair in PAIRS for cell in _pairs(*pair)), *growth]


def _pairs(size: float, until: float) -> list[Cell]:
    one = Cell("pairs", "nitsche", 2, size, "elastic", "surface", until, guide="off")  # of the two, one might take it
    return [replace(one, solver=solver, turn=turn) for turn in range(PAIR_TURNS) for solver in ("surface", "full")]


# -- one run -------------------------------------------------------------------------------------------------


def solve(cell: Cell, mesh: str | None = None) -> Outcome:
    """Run one cell in this process, on a mesh file or on the mesh that is shipped."""
    from mpi4py import MPI

    from extrusion.condensed import Condensed, choose
    from extrusion.guide import choose_guide
    from extrusion.mesh import case_mesh, read_mesh
    from extrusion.newton import Newton
    from extrusion.problem import Problem
    from extrusion.result import PICTURED
    from extrusion.stepping import Step, steps

    case, started, base = cell.case(), time.monotonic(), resident_memory("VmRSS")
    clock = [time.perf_counter()]
    plain = case_mesh(case.profile, case.size) if mesh is None else read_mesh(mesh)
    problem = Problem(case, plain, MPI.COMM_SELF)
    clock.append(time.perf_counter())
    system = choose(problem, cell.solver)
    newton = Newton(system)
    clock.append(time.perf_counter())
    memory_factor, output, found, note = resident_memory("VmHWM"), 0.0, list[Step](), ""
    try:
        for step in steps(system, newton, case.times(), choose_guide(problem, system, cell.guide)):
            found.append(step)
            began = time.perf_counter()
            if step.t in PICTURED:
                problem.stress_fields(step.x)
            output += time.perf_counter() - began
    except StepError as error:
        note = str(error)
    clock.append(time.perf_counter())
    setup, factor, rest = np.diff(clock).tolist()
    condensation = getattr(system, "seconds", {}).get("condensation", 0.0)
    return Outcome(
        status="failed" if note else "converged",
        note=note,
        dofs=problem.dofs,
        increments=len(found),
        iterations=sum(step.iterations for step in found),
        setup=setup,
        factor=factor,
        condensation=condensation,
        steps=rest - condensation - output,
        output=output,
        wall=time.monotonic() - started,
        base=base,
        memory_factor=memory_factor,
        memory=resident_memory("VmHWM"),
        compliance=system.compliance_memory / 1e6 if isinstance(system, Condensed) else 0.0,
        **({} if note else _errors(case, found)),
    )


def _errors(case: Case, found: Sequence[Any]) -> dict[str, float]:
    """Errors of the accepted steps, and the reference's bars."""
    reference = read()["problems"]["unilateral"][case.die]
    against = errors(reference, {step.t: (step.points["K"][1], step.reaction) for step in found})
    names = ("K_error", "K_bar", "reaction_error", "reaction_bar")
    out = dict(zip(names, np.max([*against.values()], axis=0).tolist(), strict=True)) if against else {}
    for step in found:
        if step.t == PRESSURE_AT:
            side, (row,) = step.zones["1"], [row for row in reference if row["t"] == PRESSURE_AT]
            exact, bar = np.array(row["pressure"]), np.array(row["pressure_error"])
            nodal = case.method == "nodal"  # no weights to average with
            p = np.interp(STATIONS, side.s, side.ray_pressure) if nodal else pressure_at_stations(side)
            size = np.linalg.norm(exact)
            out["pressure_error"] = float(np.linalg.norm(p - exact) / size)
            out["pressure_bar"] = float(np.linalg.norm(bar) / size)
    return out


def resident_memory(name: str) -> float:
    """This process's resident size (``VmRSS``), or its peak (``VmHWM``), MB; NaN where there is no ``/proc``.

    Not `resource.getrusage`, whose peak has that of the parent in it.
    """
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(f"{name}:")), math.nan)


def measure(cell: Cell, mesh: Path | None = None) -> Outcome:
    """Run one cell in a process of its own."""
    done = _python("extrusion.bench", json.dumps(asdict(cell)), *([] if mesh is None else [str(mesh)]))
    if done.returncode == 0:
        return Outcome(**json.loads(done.stdout))
    return Outcome("failed", f"process ended with {done.returncode}: {_last_line(done.stderr)}")


def _python(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", *args], env=os.environ | THREADS, capture_output=True, text=True)


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[-1]


def _child(text: str, mesh: str | None = None) -> None:
    """What a process of `measure` does: a small run first, for its imports and compiled forms."""
    cell = Cell(**json.loads(text))
    time.perf_counter = time.process_time  # the solver's own clock, too, counts CPU seconds here
    solve(replace(cell, size=4.0, until=20.0))
    print(json.dumps(asdict(solve(cell, mesh))))


# -- all runs ------------------------------------------------------------------------------------------------


def machine() -> dict[str, Any]:
    """What the figures were measured on, and when."""
    from mpi4py import MPI  # noqa: F401  the wheel's PETSc needs the MPI that it loads
    from petsc4py import PETSc

    import dolfinx

    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "date": date.today().isoformat(),
        "platform": f"{platform.system()} {platform.machine()}",
        "processor": models[0] if models else platform.processor(),
        "cores": os.cpu_count(),
        "memory_GB": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1),
        "python": platform.python_version(),
        "numpy": importlib.metadata.version("numpy"),
        "dolfinx": dolfinx.__version__,
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "extrusion": extrusion.__version__,
        **THREADS,
    }


def run(
    folder: Path, *, quick: bool = False, progress: Callable[[int, int, Cell, Outcome], None] | None = None
) -> tuple[dict[str, Any], list[tuple[Cell, Outcome]]]:
    """Do the runs that ``runs.jsonl`` in the folder lacks, a line each; returns the machine and all runs asked for.

    Raises:
        InputError: The file is of another machine or version, or a mesh cannot be made.
    """
    path, here, todo = folder / "runs.jsonl", machine(), cells(quick=quick)
    done: dict[Cell, Outcome] = {}
    if path.exists():
        try:
            here_before, *before = map(json.loads, path.read_text().splitlines())
            done = {Cell(**row["cell"]): Outcome(**row["outcome"]) for row in before}
        except (ValueError, TypeError, KeyError):
            raise InputError("out", str(path), "is no file of extrusion bench; give another folder") from None
        if here | {"date": ""} != here_before | {"date": ""}:
            raise InputError("out", str(path), "holds runs of another machine or version; give another folder")
        here = here_before
    left = [cell for cell in todo if cell not in done]
    meshes = {size: _mesh(size, folder) for size in {cell.size for cell in left}}
    folder.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        if not path.stat().st_size:
            file.write(json.dumps(here) + "\n")
        for number, cell in enumerate(todo, start=1):
            if cell in done:
                continue
            done[cell] = measure(cell, meshes[cell.size])
            file.write(json.dumps({"cell": asdict(cell), "outcome": asdict(done[cell])}) + "\n")
            file.flush()
            if progress is not None:
                progress(number, len(todo), cell, done[cell])
    return here, [(cell, done[cell]) for cell in todo]


def _mesh(size: float | None, folder: Path) -> Path | None:
    """The mesh of a size, made if it is neither shipped nor there; None if it is shipped."""
    from extrusion.mesh import BUNDLED_SIZES

    if size is None or size in BUNDLED_SIZES:
        return None
    path = folder / "meshes" / f"{size:g}.msh"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        made = _python("extrusion", "mesh", "A", "--size", f"{size:g}", "--out", str(path))
        if made.returncode:
            raise InputError("size", size, f"cannot be meshed ({_last_line(made.stderr)}); --quick needs no gmsh")
    return path


# -- what they say -------------------------------------------------------------------------------------------


def table(runs: Iterable[tuple[Cell, Outcome]]) -> list[dict[str, Any]]:
    """A row for each cell, turns put together: their number, and the medians of what varies between them."""
    turns: dict[Cell, list[Outcome]] = {}
    for cell, outcome in runs:
        turns.setdefault(replace(cell, turn=0), []).append(outcome)
    rows = []
    for cell, outcomes in turns.items():
        first = next((o for o in outcomes if o.status != "converged"), outcomes[0])
        row = asdict(cell) | {"runs": len(outcomes)} | asdict(first)
        for name in (*PHASES, "wall", "base", "memory_factor", "memory"):
            row[name] = median(getattr(outcome, name) for outcome in outcomes)
        del row["turn"]
        row["solve"] = row["factor"] + row["condensation"] + row["steps"]
        rows.append(row)
    return rows


def front(rows: Sequence[dict[str, Any]], name: str, gain: float = 1.0) -> list[dict[str, Any]]:
    """Rows that no other one beats both in seconds and in an error (K, reaction or pressure), quickest first.

    An error counts as its bar at least. Each row's is less than that of the one before by more than the factor `gain`.
    """
    out, best = [], math.inf
    for row in sorted(rows, key=lambda row: row["solve"]):
        error = max(row[f"{name}_error"], row[f"{name}_bar"])
        if gain * error < best:
            out.append(row)
            best = error
    return out


def exponent(dofs: Sequence[float], values: Sequence[float]) -> float:
    """p of the least-squares fit ``values ~ dofs^p``; NaN for fewer than two positive values."""
    x, y = np.array(dofs, dtype=float), np.array(values, dtype=float)
    good = y > 0
    return float(np.polyfit(np.log(x[good]), np.log(y[good]), 1)[0]) if good.sum() > 1 else math.nan


def growth(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """How each phase and the memory grow with the dofs: over all sizes, and over the last decade of dofs."""
    mine = [row for row in rows if row["part"] == "growth" and row["status"] == "converged"]
    if len(mine) < 2:
        return []
    series = {name: [row[name] for row in mine] for name in (*PHASES[:-1], "compliance", "iterations")}
    series["steps / iterations"] = [row["steps"] / row["iterations"] for row in mine]
    series["memory - base"] = [row["memory"] - row["base"] for row in mine]
    series["memory_factor - base"] = [row["memory_factor"] - row["base"] for row in mine]
    dofs = [row["dofs"] for row in mine]
    late = [i for i, n in enumerate(dofs) if n >= max(dofs) / 10]
    return [
        {
            "quantity": name,
            "exponent": exponent(dofs, values),
            "last_decade": exponent([dofs[i] for i in late], [values[i] for i in late]),
            "first": values[0],
            "last": values[-1],
            "dofs": [dofs[0], dofs[-1]],
        }
        for name, values in series.items()
    ]


def ratios(runs: Sequence[tuple[Cell, Outcome]]) -> list[dict[str, Any]]:
    """Full over surface, seconds of the solve phase turn by turn: median, least and most, for each size."""
    pairs = {cell: outcome for cell, outcome in runs if cell.part == "pairs" and outcome.status == "converged"}
    found: dict[Cell, list[tuple[float, float]]] = {}
    for cell, outcome in pairs.items():
        other = pairs.get(replace(cell, solver="full"))
        if cell.solver == "surface" and other is not None:
            both = (_solve_seconds(outcome), _solve_seconds(other))
            found.setdefault(replace(cell, turn=0), []).append(both)
    return [
        {
            "size": cell.size,
            "until": cell.until,
            "dofs": pairs[cell].dofs,
            "pairs": len(seconds),
            "surface": median(s for s, _ in seconds),
            "full": median(f for _, f in seconds),
            "ratio": median(f / s for s, f in seconds),
            "least": min(f / s for s, f in seconds),
            "most": max(f / s for s, f in seconds),
            "surface_memory": median(o.memory for c, o in pairs.items() if replace(c, turn=0) == cell),
            "full_memory": median(
                o.memory for c, o in pairs.items() if replace(c, turn=0) == replace(cell, solver="full")
            ),
        }
        for cell, seconds in found.items()
    ]


def _solve_seconds(outcome: Outcome) -> float:
    return outcome.factor + outcome.condensation + outcome.steps


def write(folder: Path, here: dict[str, Any], runs: Sequence[tuple[Cell, Outcome]]) -> str:
    """Write ``bench.csv``, ``bench.json``, ``bench.md`` and ``bench.png``; returns the text of ``bench.md``."""
    rows = table(runs)
    with (folder / "bench.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0]])
        writer.writeheader()
        writer.writerows(rows)
    data = {"machine": here, "rows": rows, "ratios": ratios(runs), "growth": growth(rows)}
    (folder / "bench.json").write_text(json.dumps(_finite(data), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    text = report(here, runs)
    (folder / "bench.md").write_text(text, encoding="utf-8")
    draw(rows, folder / "bench.png")
    return text


def _finite(value: Any) -> Any:
    """The same with None for what is not finite."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def report(here: dict[str, Any], runs: Sequence[tuple[Cell, Outcome]]) -> str:
    """Tables in Markdown: the best front of the elastic die (each row halves an error), solvers, growth, failures."""
    rows = table(runs)
    mine = [row for row in rows if row["part"] == "front" and row["die"] == "elastic" and row["status"] == "converged"]
    on = {name: [id(row) for row in front(mine, name, gain=2.0)] for name in ("K", "reaction", "pressure")}
    best = sorted((row for row in mine if any(id(row) in of for of in on.values())), key=lambda row: row["solve"])
    parts = [", ".join(f"{name} {value}" for name, value in here.items()) + "\n"]
    parts.append(
        markdown(
            "method order mesh dofs iterations set-up factor condensation steps output s MB K_% R_% p_50_% best_in",
            [
                [
                    *(row["method"], f"P{row['order']}", "sheet" if row["size"] is None else f"{row['size']:g} mm"),
                    *(str(row["dofs"]), str(row["iterations"]), *(f"{row[name]:.2f}" for name in PHASES)),
                    *(f"{row['solve']:.2f}", f"{row['memory']:.0f}"),
                    *(
                        f"{100 * row[f'{name}_error']:.2g} ± {100 * row[f'{name}_bar']:.1g}"
                        for name in ("K", "reaction", "pressure")
                    ),
                    ", ".join(name for name, of in on.items() if id(row) in of),
                ]
                for row in best
            ],
            left=3,
        )
    )
    parts.append(
        markdown(
            "mesh dofs to_t pairs surface_s full_s full_/_surface least most surface_MB full_MB",
            [
                [
                    *(f"{row['size']:g} mm", str(row["dofs"]), f"{row['until']:g}", str(row["pairs"])),
                    *(f"{row['surface']:.2f}", f"{row['full']:.2f}"),
                    *(f"{row[name]:.1f}" for name in ("ratio", "least", "most")),
                    *(f"{row[name]:.0f}" for name in ("surface_memory", "full_memory")),
                ]
                for row in ratios(runs)
            ],
        )
    )
    found = growth(rows)
    if found:
        first, last = found[0]["dofs"]
        parts.append(
            markdown(
                f"quantity exponent last_decade at_{first}_dofs at_{last}_dofs",
                [
                    [row["quantity"], *(f"{row[name]:.2f}" for name in ("exponent", "last_decade"))]
                    + [f"{row[name]:.3g}" for name in ("first", "last")]
                    for row in found
                ],
            )
        )
    names = [field.name for field in fields(Cell) if field.name != "turn"]
    lost = [row for row in rows if row["status"] != "converged"]
    parts += [f"Did not end: {Cell(**{name: row[name] for name in names})}: {row['note']}\n" for row in lost]
    return "\n".join(parts)


def markdown(head: str, rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A table in Markdown.

    Args:
        head: The columns' names, with _ for a space within one.
        rows: Cells.
        left: How many columns are aligned to the left.
    """
    names = [name.replace("_", " ") for name in head.split()]
    rule = "|---" * left + "|---:" * (len(names) - left) + "|"
    return "\n".join([f"| {' | '.join(names)} |", rule, *(f"| {' | '.join(row)} |" for row in rows), ""])


COLOURS = {"nodal": "#56b4e9", "penalty": "#e69f00", "nitsche": "#0072b2", "mortar": "#d55e00"}
"""From Okabe and Ito's palette, which is told apart by the colour-blind too."""


def draw(rows: Iterable[dict[str, Any]], path: Path) -> None:
    """Errors of K and of the reaction against seconds of the solve phase, with the best front of each die.

    Each die is held against its own reference; an error below the reference's bar counts as the bar in the front.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import LogLocator, NullFormatter

    done = [row for row in rows if row["part"] == "front" and row["status"] == "converged"]
    figure = Figure(figsize=(11, 5), layout="constrained")
    for axis, name, label in zip(figure.subplots(1, 2), ("K", "reaction"), ("$u_y$ of K", "reaction"), strict=True):
        for die, style in (("elastic", "-"), ("rigid", ":")):
            mine = [row for row in done if row["die"] == die]
            best = front(mine, name)
            reached = [max(row[f"{name}_error"], row[f"{name}_bar"]) for row in best]
            axis.plot([row["solve"] for row in best], reached, style, color="black", lw=1.2, zorder=1)
            for row in mine:
                colour = COLOURS[row["method"]]
                face = colour if die == "elastic" else "white"
                axis.plot(
                    row["solve"], row[f"{name}_error"], "^o"[row["order"] - 1],
                    color=colour, mfc=face, ms=7, zorder=2,
                )  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel="solve phase, CPU s", ylabel=f"largest relative error of {label}")
        bar = max((row[f"{name}_bar"] for row in done), default=math.nan)
        bottom = min(axis.get_ylim()[0], 0.7 * bar)
        axis.axhspan(bottom, bar, color="0.88", zorder=0)
        axis.set_ylim(bottom=bottom)
        axis.grid(which="major", color="0.92", zorder=0)
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(
        handles=[
            *(Line2D([], [], marker="s", ls="", color=colour, label=name) for name, colour in COLOURS.items()),
            Line2D([], [], marker="^", ls="", color="0.3", label="P1"),
            Line2D([], [], marker="o", ls="", color="0.3", label="P2"),
            Line2D([], [], marker="o", ls="-", color="black", label="elastic die, best front"),
            Line2D([], [], marker="o", mfc="white", ls=":", color="black", label="rigid die, best front"),
            Patch(color="0.88", label="below the reference's error bar"),
        ],
        loc="outside upper center",
        ncols=5,
        frameon=False,
    )
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    _child(*sys.argv[1:])
