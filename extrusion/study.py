"""The study of hard cases: what converges, at what cost and how right, over everything that makes contact hard.

Three parts (``extrusion study hard-cases``; cells that are done are not done again):

1. ``nitsche`` and ``mortar``: problem x die x increment x Poisson's ratio x form x size;
2. every method and order: problem x die x increment at nu = 0.45 on one mesh;
3. penalty and Nitsche's method: gamma over six decades and theta = 1, 0, -1, for each order and die.

What cannot work is named beforehand, in `excluded`, with its reason. A cell that converges is also looked at for
contact that was lost in silence: contact must be there, in equilibrium with the ram, and not left behind by the die.
"""

from __future__ import annotations

import csv
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from extrusion.cases import MIXED_ABOVE, Case
from extrusion.elasticity import Elastic
from extrusion.errors import InputError, StepError
from extrusion.reference import REACTION_SCALE, problems, read

INCREMENTS = (5.0, 20.0, 50.0, 155.0)
RATIOS = (0.3, 0.45, 0.49, 0.499, 0.4999)
SIZES = (4.0, 2.0)
GAMMAS = tuple(10.0**e for e in range(-2, 5))
FULL_FROM = 0.49
"""Poisson's ratio from which the study ends at t = 140 mm.

By t = 142 to 147 such a billet has filled the closed die; what is pushed in further can only compress it. At K the
hoop strain then falls below -1: the surface has turned over the axis, and small strain has no more to say.
"""


@dataclass(frozen=True)
class Cell:
    """One run of the study."""

    part: int
    problem: str  # unilateral, bilateral or mixed (zone 1 bilateral, zone 2 unilateral)
    die: str
    method: str
    order: int
    form: str
    nu: float
    size: float
    increment: float
    gamma: float | None = None
    theta: int = 0

    def case(self) -> Case:
        """The scene of this cell."""
        base = problems()[self.problem]
        changes: dict[str, Any] = {
            name: getattr(self, name) for name in ("method", "order", "die", "form", "size", "gamma", "theta")
        }
        case = replace(base, **changes, billet=Elastic(base.billet.E, self.nu))
        end = min(base.end, 140.0) if self.nu >= FULL_FROM else base.end
        return case.with_increment(self.increment, end)


@dataclass(frozen=True)
class Outcome:
    """What a cell did."""

    status: str  # converged, failed, refused, excluded or lost
    note: str = ""
    dofs: int = 0
    steps: int = 0
    iterations: int = 0
    worst: int = 0  # iterations of the step that took most
    cuts: int = 0
    seconds: float = 0.0  # of the solve phase
    t: float = 0.0  # reached, mm
    K: float = float("nan")
    K_error: float = float("nan")  # largest over the reference's t, relative (nu = 0.45)
    reaction: float = float("nan")
    reaction_error: float = float("nan")  # largest, of max(7.8e5 N, its size)
    tension: float = float("nan")  # largest pull on a unilateral point, MPa
    penetration: float = float("nan")  # deepest contact point, mm
    imbalance: float = float("nan")  # |ram + die|, of max(7.8e5 N, the ram's force)


def cells() -> Iterator[Cell]:
    """All cells, in order."""
    scenes = tuple(itertools.product(problems(), ("elastic", "rigid"), INCREMENTS))
    for method, (problem, die, increment), nu, form, size in itertools.product(
        ("nitsche", "mortar"), scenes, RATIOS, ("displacement", "mixed"), SIZES
    ):
        yield Cell(1, problem, die, method, 2, form, nu, size, increment)
    for method, order, (problem, die, increment) in itertools.product(
        ("nodal", "penalty", "nitsche", "mortar"), (1, 2), scenes
    ):
        yield Cell(2, problem, die, method, order, "displacement", 0.45, SIZES[0], increment)
    for (method, theta), gamma, order, die in itertools.product(
        (("penalty", 0), ("nitsche", 1), ("nitsche", 0), ("nitsche", -1)), GAMMAS, (1, 2), ("elastic", "rigid")
    ):
        yield Cell(3, "unilateral", die, method, order, "displacement", 0.45, SIZES[0], 5.0, gamma, theta)


def excluded(cell: Cell) -> str:
    """Why a cell cannot work; empty if it should."""
    if cell.method == "nodal" and cell.increment == INCREMENTS[-1]:
        return "nodal contact pairs nodes with facets that one increment of the whole way leaves behind"
    if cell.method == "nitsche" and cell.form == "displacement" and cell.nu > MIXED_ABOVE:
        return "the displacement form's stress, and with it the least gamma, grows with lambda: over-constrained"
    if cell.method == "penalty" and cell.gamma is not None and cell.gamma <= 1:
        return "a penalty this soft lets the die in by millimetres (640 / gamma micrometres in K)"
    return ""


def solve(cell: Cell) -> Outcome:
    """Run one cell."""
    from mpi4py import MPI

    from extrusion.mesh import case_mesh
    from extrusion.newton import Newton
    from extrusion.problem import Problem
    from extrusion.stepping import steps

    reason = excluded(cell)
    if reason:
        return Outcome("excluded", reason)
    case = cell.case()
    try:
        problem = Problem(case, case_mesh(case.profile, case.size), MPI.COMM_SELF)
    except InputError as error:
        return Outcome("refused", str(error))
    newton, found, status, note = Newton(problem), [], "converged", ""
    started = time.perf_counter()
    tension = penetration = imbalance = 0.0
    try:
        for step in steps(problem, newton, case.times()):
            found.append(step)
            scale = max(REACTION_SCALE, abs(step.reaction))
            imbalance = max(imbalance, abs(step.reaction + step.die_reaction) / scale)
            for term in problem.terms:
                state = step.zones[term.pair.name]
                if term.pair.closure == "unilateral":
                    tension = max(tension, -float(np.nanmin(state.pressure, initial=0.0)))
                acting = state.closed & ~np.isnan(state.pressure)
                penetration = max(penetration, -float(np.min(state.gap[acting], initial=0.0)))
                penetration = max(penetration, -float(np.min(state.gap[~state.closed], initial=0.0)))
    except StepError as error:
        status, note = "failed", str(error)
    seconds = time.perf_counter() - started
    if status == "converged":
        touching = sum(int(state.closed.sum()) for state in found[-1].zones.values())
        if touching == 0 or penetration > 1.0 or imbalance > 1e-6:
            status, note = "lost", f"{touching} points in contact, {penetration:.3g} mm deep, imbalance {imbalance:.1e}"
    K_error = reaction_error = float("nan")
    if cell.nu == 0.45:
        rows = {row["t"]: row for row in read()["problems"][cell.problem][cell.die]}
        pairs = [(step, rows[step.t]) for step in found if step.t in rows]
        if pairs:
            K_error = max(abs(step.points["K"][1] / row["K"] - 1) for step, row in pairs)
            reaction_error = max(
                abs(step.reaction - row["reaction"]) / max(REACTION_SCALE, abs(row["reaction"])) for step, row in pairs
            )
    last = found[-1] if found else None
    return Outcome(
        status,
        note,
        problem.dofs,
        len(found),
        sum(step.iterations for step in found),
        max((step.iterations for step in found), default=0),
        sum(step.cuts for step in found),
        seconds,
        last.t if last else 0.0,
        last.points["K"][1] if last else float("nan"),
        K_error,
        last.reaction if last else float("nan"),
        reaction_error,
        tension,
        penetration,
        imbalance,
    )


def run(path: Path, progress: Callable[[int, int, Cell, Outcome], None] | None = None) -> list[dict[str, Any]]:
    """Do the cells that the table at ``path`` lacks, writing each when it is done; returns the whole table."""
    done = table(path) if path.exists() else []
    known = {_key(row) for row in done}
    todo = list(cells())
    path.parent.mkdir(parents=True, exist_ok=True)
    names = [field.name for kind in (Cell, Outcome) for field in fields(kind)]
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        if not known:
            writer.writeheader()
        for number, cell in enumerate(todo):
            if _key(asdict(cell)) in known:
                continue
            outcome = solve(cell)
            writer.writerow(asdict(cell) | asdict(outcome))
            file.flush()
            if progress is not None:
                progress(number + 1, len(todo), cell, outcome)
    return table(path)


def table(path: Path) -> list[dict[str, Any]]:
    """The rows of a study's table; numbers are read as numbers."""
    kinds = {field.name: str(field.type) for kind in (Cell, Outcome) for field in fields(kind)}

    def value(name: str, text: str) -> Any:
        kind = kinds[name]
        if kind == "str":
            return text
        if not text:
            return None
        return int(text) if kind == "int" else float(text)

    with path.open(newline="", encoding="utf-8") as file:
        return [{name: value(name, text) for name, text in row.items()} for row in csv.DictReader(file)]


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """One picture of a study's table: a square a cell, its shade the iterations a step, crosses where it failed."""
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 10), layout="constrained")
    layout = figure.subplot_mosaic([["1", "1"], ["2", "3"]], height_ratios=(1.25, 1), width_ratios=(1.6, 1))
    axes = [layout[part] for part in "123"]
    titles = (
        "1. nitsche and mortar: form, size and Poisson's ratio",
        "2. every method and order (nu = 0.45, 4 mm)",
        "3. gamma, 5 mm steps (nu = 0.45, 4 mm)",
    )
    keys: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
        (("method", "form", "size", "problem"), ("nu", "die", "increment")),
        (("method", "order"), ("problem", "die", "increment")),
        (("method", "theta", "order", "die"), ("gamma",)),
    )
    image = None
    for part, (axis, title, (down, across)) in enumerate(zip(axes, titles, keys, strict=True), start=1):
        mine = [row for row in rows if row["part"] == part]
        axis.set_title(title, loc="left", fontsize=10)
        if not mine:
            continue
        labels_y = list(dict.fromkeys(tuple(row[name] for name in down) for row in mine))
        labels_x = list(dict.fromkeys(tuple(row[name] for name in across) for row in mine))
        mean = np.full((len(labels_y), len(labels_x)), np.nan)
        for row in mine:
            at = labels_y.index(tuple(row[n] for n in down)), labels_x.index(tuple(row[n] for n in across))
            if row["status"] == "converged":
                mean[at] = row["iterations"] / max(1, row["steps"])
            else:
                bad = row["status"] in ("failed", "lost")
                axis.plot(at[1], at[0], "x" if bad else ".", color="red" if bad else "0.6", ms=6 if bad else 3)
        axis.imshow(np.isnan(mean), cmap=ListedColormap(["white", "0.93"]), aspect="auto", vmin=0, vmax=1)
        image = axis.imshow(mean, cmap="viridis", aspect="auto", vmin=0, vmax=20)
        axis.set_yticks(range(len(labels_y)), [" ".join(map(_short, label)) for label in labels_y], fontsize=7)
        axis.set_xticks(range(len(labels_x)), [" ".join(map(_short, label)) for label in labels_x], fontsize=6)
        axis.tick_params(axis="x", rotation=90)
    if image is not None:
        figure.colorbar(
            image, ax=axes, label="linear solves a step (dot: excluded or refused beforehand, cross: failed)"
        )
    figure.savefig(path, dpi=110)


def _short(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[field.name] for field in fields(Cell))


def summary(rows: list[dict[str, Any]]) -> list[tuple[str, int, int, int, int]]:
    """Per part and method: cells, of them converged, excluded or refused, and the rest (failed or lost)."""
    out = []
    for part, method in sorted({(row["part"], row["method"]) for row in rows}):
        status = [row["status"] for row in rows if (row["part"], row["method"]) == (part, method)]
        good, left = status.count("converged"), status.count("excluded") + status.count("refused")
        out.append((f"{part} {method}", len(status), good, left, len(status) - good - left))
    return out
