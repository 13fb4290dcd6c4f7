"""What three dimensions cost: time, memory and error by size of element, order and number of ranks.

    python demos/scaling_3d.py [--quick] [--out DIR]

Case A's problem on a quarter of billet and die (`nitsche`, elastic die), by the increments of case B: on the surface,
and up to t = 15 mm by multigrid, with up to 300k dofs. Each run is in processes of its own, by the `mpiexec` beside
this Python, with one thread a rank; it is warmed up, so that no form is compiled on the clock. Leaves `scaling.csv` and
`scaling.md`, and prints the latter: a row a run, then how time and memory grow with the dofs.

Columns: dofs; linear solves of the whole run; seconds of set-up, of the parts of the solve phase that the solver tells
apart (`Result.seconds`: factor of the bulk, condensation on the surface; pairing: the contact points and terms), of
what is left of it (linear: the linear solves), of all of it, and that for one increment; how many times quicker it is
than on one rank; peak memory of all ranks (MB); largest errors of K and of the reaction against the axisymmetric
reference (%).
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

from extrusion import cases, run
from extrusion.bench import THREADS, exponent, machine, markdown, resident_memory
from extrusion.cases import Case
from extrusion.reference import errors, problems, read

SIZES = {1: (8.0, 6.0, 4.0, 3.0), 2: (16.0, 12.0, 10.0, 8.0)}
QUICK = {1: (8.0, 6.0), 2: (16.0, 12.0)}
"""Element sizes (mm) of each order."""

MULTIGRID = (4.0, 2.5, 1.65)
"""Element sizes (mm) for the iterative solver, order 1."""

RANKS = (1, 2)
OTHER = ("setup", "solve", "output")
"""Of `Result.seconds`, those that are no part of the solve phase."""


@dataclass(frozen=True)
class Cell:
    """One run."""

    order: int
    size: float  # mm
    ranks: int = 1
    until: float = 155.0  # mm
    solver: str = "auto"

    def case(self) -> Case:
        """Its scene."""
        scene = replace(problems()["unilateral"], space="3d", increments=cases.B.increments)
        return replace(scene, order=self.order, size=self.size).with_increment(until=self.until)


def child(cell: Cell) -> None:
    """What a run's own processes do: a small run first, then the one that counts; rank 0 prints a line of JSON."""
    run(replace(cell, size=max(cell.size, 16.0), until=15.0).case(), solver=cell.solver)
    base = resident_memory("VmRSS")
    result = run(cell.case(), solver=cell.solver)
    comm = MPI.COMM_WORLD
    peak, before = (comm.allreduce(value) for value in (resident_memory("VmHWM"), base))
    found = {step.t: (step.points["K"][1], step.reaction) for step in result.steps}
    off = errors(read()["problems"]["unilateral"]["elastic"], found)
    seconds = result.seconds
    parts = {name: value for name, value in seconds.items() if name not in OTHER}
    row = {
        **{"dofs": result.dofs, "contact_points": result.contact_points, "solver": result.solver},
        **{"increments": len(result.steps), "iterations": int(result.iterations.sum()), "error": result.error},
        **{"setup": seconds["setup"], **parts, "linear": seconds["solve"] - sum(parts.values())},
        **{"solve": seconds["solve"], "increment": seconds["solve"] / max(1, len(result.steps))},
        **{"memory": peak, "memory_before": before},
        "K_error": max((one[0] for one in off.values()), default=None),
        "reaction_error": max((one[2] for one in off.values()), default=None),
    }
    if comm.rank == 0:
        print(json.dumps(row))


def measure(cell: Cell) -> dict[str, Any]:
    """Do one run in processes of its own.

    Raises:
        RuntimeError: It did not end well.
    """
    command = [sys.executable, __file__, "--cell", json.dumps(asdict(cell))]
    if cell.ranks > 1:
        command = [str(Path(sys.executable).with_name("mpiexec")), "-n", str(cell.ranks), *command]
    environment = {"UCX_TLS": "self,sm,tcp"} | os.environ | THREADS
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{cell}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return asdict(cell) | json.loads(done.stdout.strip().splitlines()[-1])


def parts_of(rows: list[dict[str, Any]]) -> list[str]:
    """What the runs' solvers tell apart in the solve phase, and the rest."""
    names = [name for row in rows for name in row]
    start, end = names.index("setup") + 1, names.index("linear")
    return [*dict.fromkeys([*names[start:end], "linear"])]


def report(rows: list[dict[str, Any]]) -> str:
    """The runs, and how time and memory grow, in Markdown."""
    parts = parts_of(rows)
    alone = {(row["order"], row["size"], row["solver"]): row["solve"] for row in rows if row["ranks"] == 1}

    def cells(row: dict[str, Any]) -> Iterator[str]:
        yield from (f"Q{row['order']}", f"{row['size']:g} mm", row["solver"], f"{row['until']:g}", str(row["ranks"]))
        yield from (str(row["dofs"]), str(row["iterations"]), f"{row['setup']:.2f}")
        yield from (f"{row.get(name, 0.0):.2f}" for name in (*parts, "solve", "increment"))
        before = alone.get((row["order"], row["size"], row["solver"]))
        yield "" if row["ranks"] == 1 or before is None else f"{before / row['solve']:.2f}"
        yield f"{row['memory']:.0f}"
        for name in ("K_error", "reaction_error"):
            yield "" if row[name] is None else f"{100 * row[name]:.2g}"

    told = " ".join(parts)
    head = f"order size solver to_t ranks dofs iterations set-up {told} solve an_increment speed-up MB K_% R_%"
    out = [markdown(head, map(list, map(cells, rows)), left=4)]
    growth = []
    for order, solver, ranks in sorted({(row["order"], row["solver"], row["ranks"]) for row in rows}):
        mine = [row for row in rows if (row["order"], row["solver"], row["ranks"]) == (order, solver, ranks)]
        dofs = [row["dofs"] for row in mine]
        series = [[row.get(name, 0.0) for row in mine] for name in ("setup", *parts, "solve", "iterations")]
        series.append([row["memory"] - row["memory_before"] for row in mine])
        exponents = (f"{exponent(dofs, values):.2f}" for values in series)
        growth.append([f"Q{order}", solver, str(ranks), f"{dofs[0]} to {dofs[-1]}", *exponents])
    out.append("p of dofs^p by least squares (MB: beyond that of the small run before):\n")
    out.append(markdown(f"order solver ranks dofs set-up {told} solve iterations MB", growth))
    failed = [
        f"Q{row['order']}, {row['size']:g} mm, ranks {row['ranks']}: {row['error']}\n" for row in rows if row["error"]
    ]
    about = ", ".join(f"{name} {value}" for name, value in machine().items())
    return "\n".join([*out, *failed, about, ""])


def write(folder: Path, rows: list[dict[str, Any]]) -> str:
    """Write ``scaling.csv`` and ``scaling.md``; returns the text of the latter."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "scaling.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
    text = report(rows)
    (folder / "scaling.md").write_text(text, encoding="utf-8")
    return text


def main() -> None:
    """All runs, from the cheapest on; the files are written anew after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="only the coarse meshes")
    parser.add_argument("--out", type=Path, default=Path("results/scaling_3d"), help="folder of the tables")
    parser.add_argument("--cell", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cell:
        child(Cell(**json.loads(options.cell)))
        return
    rows: list[dict[str, Any]] = []
    cores = os.cpu_count() or 1
    sizes = QUICK if options.quick else SIZES
    cells = [Cell(order, size) for order in sizes for size in sizes[order]]
    cells += [Cell(1, size, until=15.0, solver="iterative") for size in MULTIGRID[: 1 if options.quick else None]]
    for cell in cells:
        for ranks in (n for n in RANKS if n <= cores):
            rows.append(measure(replace(cell, ranks=ranks)))
            text = write(options.out, rows)
            print(f"Q{cell.order}, {cell.size:g} mm, ranks {ranks}: {rows[-1]['solve']:.1f} s", file=sys.stderr)
    print(text)


if __name__ == "__main__":
    main()
