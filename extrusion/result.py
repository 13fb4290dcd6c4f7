"""A case run from its first increment to its last, and what comes back.

This module imports neither DOLFINx nor PETSc until `run` is called.
"""

from __future__ import annotations

import dataclasses
import html
import math
import os
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from extrusion.cases import Case, Figure
from extrusion.check import require_dolfinx
from extrusion.contact import CLOSURES
from extrusion.errors import InputError, StepError

if TYPE_CHECKING:
    from mpi4py import MPI

    from matplotlib.figure import Figure as Picture
    from rich.table import Table

    from extrusion.estimate import Estimate, Goal
    from extrusion.mesh import PlainMesh
    from extrusion.mesh3d import HexMesh
    from extrusion.problem import Problem
    from extrusion.stepping import Step

Array = NDArray[np.float64]
Observer = Callable[["Problem", "Step"], None]
"""Called on every rank after each accepted step; a ``close()``, if it has one, is called at the end of the run."""

PICTURED = (20.0, 70.0, 155.0)
"""The t (mm) of the sheet's pictures."""


CHOSEN = ("method", "order", "size", "mesh", "sectors", "element", "form", "gamma", "theta")
"""What a tolerance chooses, and so is not given beside one."""


@dataclass(frozen=True)
class Snapshots:
    """The meridian plane at a few t, for pictures. Straight-sided triangles, also where displacements are quadratic."""

    points: Array  # (n, 2) reference positions (r, y), mm
    triangles: NDArray[np.int64]  # (m, 3)
    billet: NDArray[np.bool_]  # (m,) the triangle is the billet's, not the die's
    t: Array  # (k,) mm
    displacement: Array  # (k, n, 2) mm
    von_mises: Array  # (k, m) cell means, MPa


@dataclass(frozen=True)
class Comparison:
    """A figure of the sheet beside the computed one."""

    figure: Figure
    computed: float  # mm; NaN if the run has no step there

    @property
    def difference(self) -> float:
        """Relative to the sheet's value, if that is not 0."""
        return (self.computed - self.figure.value) / (abs(self.figure.value) or 1.0)

    @property
    def ok(self) -> bool:
        """Within the tolerance."""
        return abs(self.difference) <= self.figure.tolerance


@dataclass(frozen=True, eq=False)
class Result:
    """A run: its accepted steps, in order, and what it took. The same on every rank, but for `snapshots`."""

    case: Case
    steps: list[Step] = field(repr=False)  # their live x is dropped
    dofs: int  # displacements of both bodies, fixed ones included, and multipliers
    contact_points: int  # in all zones, at the end
    ranks: int
    converged: bool
    error: str | None  # why the run stopped early
    solver: str  # surface, full or iterative
    # setup, solve, output; of solve: on the surface factor and condensation, and pairing, and what a guide took
    seconds: dict[str, float]
    snapshots: Snapshots | None = field(repr=False)  # rank 0; None without accepted steps
    guide: float | None = None  # mm: element size of the model that went ahead, if one did
    estimate: Estimate | None = None  # how far off it is, if the model was chosen for a tolerance

    @property
    def t(self) -> Array:
        """Displacement of the rear face, mm, ``shape=(steps,)``."""
        return np.array([step.t for step in self.steps])

    @property
    def reaction(self) -> Array:
        """Axial force on the rear face, N, whole revolution, ``shape=(steps,)``."""
        return np.array([step.reaction for step in self.steps])

    @property
    def energy(self) -> Array:
        """Elastic energy, N mm, ``shape=(steps,)``."""
        return np.array([step.energy for step in self.steps])

    @property
    def iterations(self) -> NDArray[np.int64]:
        """Linear solves, over all passes and cuts, ``shape=(steps,)``."""
        return np.array([step.iterations for step in self.steps], dtype=np.int64)

    def point(self, name: str) -> Array:
        """Displacement (u_r, u_y) of a named point, mm, ``shape=(steps, 2)``.

        Raises:
            InputError: The mesh has no node there.
        """
        return np.array([_named("point", name, step.points) for step in self.steps]).reshape(-1, 2)

    def gap(self, name: str) -> Array:
        """Gap at a named slave point, mm, ``shape=(steps,)``.

        Raises:
            InputError: It is no point of a slave surface.
        """
        return np.array([_named("gap", name, step.gap) for step in self.steps])

    def figures(self) -> list[Comparison]:
        """The sheet's figures for contact as this run has it (solved, or only checked)."""
        checked = all(zone.contact == "check" for zone in self.case.zones)
        rows = []
        for figure in self.case.figures:
            if (figure.contact == "check") is not checked:
                continue
            computed = math.nan
            for step in self.steps:
                if math.isclose(step.t, figure.t, rel_tol=1e-9):
                    computed = _figure(figure, step)
            rows.append(Comparison(figure, computed))
        return rows

    def to_dict(self) -> dict[str, Any]:
        """What ``--json`` writes: mm, N, N mm; a value that is not finite becomes None."""
        return {
            "case": self.case.name,
            "method": self.case.method,
            "order": self.case.order,
            "die": self.case.die,
            "dofs": self.dofs,
            "contact_points": self.contact_points,
            "ranks": self.ranks,
            "solver": self.solver,
            "guide": self.guide,
            "converged": self.converged,
            "error": self.error,
            "seconds": dict(self.seconds),
            "estimate": self.estimate and self.estimate.to_dict(),
            "steps": [
                {
                    "t": step.t,
                    "points": {name: [_finite(value) for value in u] for name, u in step.points.items()},
                    "reaction": _finite(step.reaction),
                    "energy": _finite(step.energy),
                    "iterations": step.iterations,
                    "tangents": step.tangents,
                    "cuts": step.cuts,
                    "gap": {name: _finite(value) for name, value in step.gap.items()},
                }
                for step in self.steps
            ],
        }

    def table(self) -> Table:
        """A short table for the terminal: about ten steps, among them those with a figure of the sheet."""
        from rich.box import SIMPLE_HEAD
        from rich.table import Table

        header, rows = self._rows(self._chosen())
        table = Table(
            title=self._title(), caption=self._caption(), box=SIMPLE_HEAD, padding=0,
            title_justify="left", caption_justify="left", title_style="bold", caption_style="",
        )  # fmt: skip
        for name in header:
            table.add_column(name.replace(" ", "\n"), justify="right")
        for row in rows:
            table.add_row(*row)
        return table

    def __repr__(self) -> str:
        end = f"{len(self.steps)} steps to t = {self.steps[-1].t:g} mm" if self.steps else "no step"
        return f"<Result of {self._title()}: {end}, {'converged' if self.converged else self.error}>"

    def _repr_html_(self) -> str:
        header, rows = self._rows(range(len(self.steps)))
        head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
        body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
        title, caption = html.escape(self._title()), html.escape(self._caption())
        return f"<p>{title}</p><table><tr>{head}</tr>{body}</table><p>{caption}</p>"

    def plot(self, kind: Literal["billet", "history", "pressure"] = "billet") -> Picture:
        """A picture: the deformed billet in the die, reaction and K against t, or the pressure along the side.

        Raises:
            InputError: matplotlib is missing, or there is nothing to draw yet.
        """
        from extrusion import plots

        return plots.draw(plots.Record.of(self), kind)

    def _title(self) -> str:
        case, ranks = self.case, "1 rank" if self.ranks == 1 else f"{self.ranks} ranks"
        return f"{case.name}: {case.method}, {element_name(case)}, {case.die} die, {self.dofs} dofs, {ranks}"

    def _caption(self) -> str:
        end = "converged" if self.converged else f"stopped: {self.error}"
        return f"{end}; " + ", ".join(f"{name} {value:.2f} s" for name, value in self.seconds.items())

    def _chosen(self) -> list[int]:
        last = len(self.steps) - 1
        tested = {comparison.figure.t for comparison in self.figures()}
        chosen = {i for i, step in enumerate(self.steps) if step.t in tested}
        if len(chosen) < 3:
            chosen |= {int(i) for i in np.linspace(0, last, 10).round()} if last >= 0 else set()
        return sorted(chosen | {last} - {-1})

    def _rows(self, chosen: Sequence[int]) -> tuple[list[str], list[list[str]]]:
        figures = {c.figure.t: c for c in self.figures() if (c.figure.point, c.figure.quantity) == ("K", "u_y")}
        gaps = [name for name in ("L", "M") if self.steps and name in self.steps[0].gap]
        e = self.estimate
        bars = (["± mm"], ["± kN"]) if e else ([], [])
        header = ["t mm", "u_y(K) mm", *bars[0], *(["sheet mm", "diff. %"] if figures else [])]
        per = per_thickness(self.case)
        header += [f"reaction kN{per}", *(bars[1] or [f"energy J{per}"])]
        header += [*(f"gap({name}) mm" for name in gaps), "iterations", "cuts"]
        rows = []
        for step in (self.steps[i] for i in chosen):
            K = step.points["K"][1]
            row = [f"{step.t:g}", f"{K:.3f}", *([_rough(e.error.K * abs(K))] if e else [])]
            if figures:
                c = figures.get(step.t)
                row += ["", ""] if c is None else [f"{c.figure.value:.3f}", f"{100 * c.difference:+.3f}"]
            row += [_fixed(step.reaction / 1e3, 2)]
            bar = e.error.reaction * max(e.reaction_scale, abs(step.reaction)) / 1e3 if e else 0.0
            row += [_rough(bar) if e else _fixed(step.energy / 1e3, 2)]
            row += [_fixed(step.gap[name], 3) for name in gaps]
            rows.append([*row, str(step.iterations), str(step.cuts)])
        return header, rows


def _named[T](what: str, name: str, values: Mapping[str, T]) -> T:
    if name not in values:
        raise InputError(what, name, f"choose one of {', '.join(values)}" if values else "the run has none")
    return values[name]


def element_name(case: Case) -> str:
    """In short: P1 or P2 (triangles), Q1 or Q2 (hexahedra), or 20-node (serendipity hexahedra)."""
    if case.element == "serendipity":
        return "20-node"
    return f"{'Q' if case.space == '3d' else 'P'}{case.order}"


def per_thickness(case: Case) -> str:
    """What forces and energies are divided by: nothing, or the slab's thickness."""
    return "/mm" if case.space == "plane strain" else ""


def _fixed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:.{digits}f}"  # no -0.000


def _rough(value: float) -> str:
    return f"{float(f'{value:.1g}'):g}"  # 50, not 5e+01


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def changed(case: Case, **changes: Any) -> Case:
    """The case with some fields changed; those at None are left as they are.

    Args:
        case: What to start from.
        **changes: Fields of `Case`, and ``contact``, ``increment``, ``until`` as in its ``with_contact`` and
            ``with_increment``. A size or sectors take the place of the case's mesh file, and a mesh file theirs;
            another space that of mesh file, sectors and element.

    Raises:
        InputError: A value is out of range, or a mesh file is given beside a size or sectors.
    """
    changes = {name: value for name, value in changes.items() if value is not None}
    made = [name for name in ("size", "sectors") if name in changes]
    if made and "mesh" in changes:
        raise InputError(made[0], changes[made[0]], "a mesh file has its own elements: give one or the other")
    contact, increment, until = (changes.pop(name, None) for name in ("contact", "increment", "until"))
    if contact is not None:
        if contact not in CLOSURES:
            raise InputError("contact", contact, f"choose one of {', '.join(CLOSURES)}")
        case = case.with_contact(contact)
    if increment is not None or until is not None:
        case = case.with_increment(increment, until)
    if "mesh" in changes:
        changes = {"size": None, "sectors": None, **changes}
    elif made:
        changes["mesh"] = None
    if changes.get("space", case.space) != case.space:
        changes = {"mesh": None, "sectors": None, "element": "lagrange", **changes}
    if changes.get("theta") and changes.get("method", case.method) != "nitsche":
        raise InputError("theta", changes["theta"], "leave it out: it is a variant of method = 'nitsche'")
    if changes.get("space", case.space) == "plane strain" != case.space:
        changes = {"figures": (), **changes}  # which are of the whole revolution
    fields = [f.name for f in dataclasses.fields(Case)]
    for name, value in changes.items():
        if name not in fields:
            known = ", ".join([*fields, "contact", "increment", "until"])
            raise InputError(name, value, f"no such option; choose from {known}")
    return dataclasses.replace(case, **changes) if changes else case


def run(
    case: Case,
    *,
    mesh: str | Path | PlainMesh | HexMesh | None = None,
    comm: MPI.Intracomm | None = None,
    observers: Sequence[Observer] = (),
    out: str | Path | None = None,
    pictures: bool = True,
    solver: str = "auto",
    guide: str = "auto",
    tolerance: float | None = None,
    goal: Goal = "K",
    adapt: bool = False,
    **changes: Any,
) -> Result:
    """Solve a case. Collective.

    Args:
        case: The scene, say ``cases.A``.
        mesh: A mesh file, or a mesh (on rank 0), in place of the case's.
        comm: Ranks that share the work; all by default.
        observers: Called as ``observer(problem, step)`` after each accepted step.
        out: Folder for files and pictures; without it nothing is written.
        pictures: Draw them; else `extrusion plot` draws them from the files.
        solver: "surface" (the bulk factored once, Newton's method on the forces of contact), "full" (on all unknowns),
            "iterative" (these by multigrid, in 3D), or "auto": the one that is estimated to be cheapest. All give the
            same answer, where there is but one.
        guide: "on": a coarser model in the meridian plane goes ahead, and each increment starts from where its own
            ends, so that Newton's method takes fewer iterations (`extrusion.guide`); "off"; or "auto": where it is
            estimated to save more than it takes. The answer is the fine model's, to its tolerance, where there is but
            one.
        tolerance: Relative error of the goal for which the cheapest model is chosen (die, order, size, zones), in place
            of the case's own; the result has the `Estimate`.
        goal: "K" (its u_y) or "reaction".
        adapt: Refine a mesh where the goal needs it until it has the tolerance, in place of choosing a model: P2
            elements and Nitsche's method, the case's die and zones. Needs gmsh.
        **changes: See `changed`: ``run(cases.A, order=2, method="nitsche", increment=10)``.

    Returns:
        The result. If a step could not be solved it is not ``converged``, says why in ``error``, and holds the
        steps before.

    Raises:
        InputError: Something in the input is wrong; nothing has been written.
    """
    start = time.perf_counter()
    require_dolfinx()
    from mpi4py import MPI

    from extrusion import output
    from extrusion.condensed import SOLVERS, choose
    from extrusion.guide import GUIDES, choose_guide
    from extrusion.newton import Newton
    from extrusion.painter import Painter
    from extrusion.problem import Problem
    from extrusion.stepping import steps

    _refuse_other(case)
    if solver not in SOLVERS:
        raise InputError("solver", solver, f"choose one of {', '.join(SOLVERS)}")
    if guide not in GUIDES:
        raise InputError("guide", guide, f"choose one of {', '.join(GUIDES)}")
    if goal != "K":
        from extrusion.estimate import GOALS

        if goal not in GOALS:
            raise InputError("goal", goal, f"choose one of {', '.join(GOALS)}")
    comm = MPI.COMM_WORLD if comm is None else comm
    if out is not None and not isinstance(out, str | os.PathLike):
        raise InputError("out", out, "give a folder")
    if mesh is not None and not isinstance(mesh, str | Path) and not hasattr(mesh, "cells"):
        raise InputError("mesh", mesh, "give a mesh file, or what extrusion.mesh makes")
    given = str(mesh) if isinstance(mesh, str | Path) else None
    plain = None if isinstance(mesh, str | Path) else mesh
    case = changed(case, mesh=given, **changes)
    top = max(y for _, _, y in case.profile.die)
    if case.end > top and any(zone.contact != "check" for zone in case.zones):
        remedy = f"end before the rear face leaves the die, which ends at y = {top:g} mm"
        raise InputError("increments" if changes.get("until") is None else "until", case.end, remedy)
    if solver == "iterative" and (case.space != "3d" or case.mixed):
        why = f"the displacement form (at nu = {case.billet.nu:g} mixed)" if case.space == "3d" else "space = '3d'"
        raise InputError("solver", solver, f"is for {why}: choose surface, full or auto")
    estimate = None
    if adapt and tolerance is None:
        raise InputError("adapt", adapt, "give a tolerance too: the mesh is refined until the goal has it")
    if tolerance is not None:
        given_beside = {name: changes.get(name) for name in CHOSEN} | {"mesh": mesh}
        given_beside["guide"] = "on" if guide == "on" else None  # which that model may be too coarse for
        for name, value in given_beside.items():
            if value is not None:
                raise InputError(name, value, "leave it out: with a tolerance the model is chosen")
        if adapt:
            from extrusion.adapt import adapt as adapted
            from extrusion.estimate import continuous

            plain, estimate = adapted(case, tolerance, goal, comm, guide=guide)
            case = continuous(case)
        else:
            from extrusion.estimate import choose_model

            case, estimate = choose_model(case, tolerance, goal, comm)
    painter = Painter(comm.size) if out is not None and pictures and comm.rank == 0 else None
    problem = Problem(case, _mesh(comm, case, plain), comm)
    seconds = {"setup": time.perf_counter() - start, "solve": 0.0, "output": 0.0}
    began = time.perf_counter()
    guided = choose_guide(problem, problem, guide) if guide == "on" else None  # or refused, before anything is written
    seconds["solve"] += time.perf_counter() - began
    camera = output.Camera(case, PICTURED)
    folder = None if out is None else output.Folder(out, comm, painter)
    watching = [camera, *(() if folder is None else folder.observers), *observers]
    began = time.perf_counter()
    system = choose(problem, solver)
    newton = Newton(system)
    if guide == "auto":
        guided = choose_guide(problem, system)
    seconds["solve"] += time.perf_counter() - began

    accepted: list[Step] = []
    error = None
    try:
        with closing(_timed(steps(system, newton, case.times(), guided), seconds, "solve")) as stepping:
            for step in stepping:
                began = time.perf_counter()
                accepted.append(dataclasses.replace(step, recover=_gone))
                for observer in watching:
                    observer(problem, step)
                seconds["output"] += time.perf_counter() - began
    except StepError as e:
        error = str(e)
    for observer in watching:
        if close := getattr(observer, "close", None):
            close()
    seconds |= {**getattr(system, "seconds", {}), "pairing": system.pairing}
    seconds |= {} if guided is None else {"guide": guided.seconds}
    points = sum(len(state.gap) for state in accepted[-1].zones.values()) if accepted else 0
    result = Result(
        case=case,
        steps=accepted,
        dofs=problem.dofs,
        contact_points=points,
        ranks=comm.size,
        converged=error is None,
        error=error,
        solver="surface" if system is not problem else "iterative" if problem.iterates else "full",
        guide=None if guided is None else guided.size,
        seconds=seconds,
        snapshots=camera.snapshots(),
        estimate=estimate,
    )
    if folder is not None and adapt:
        from extrusion.mesh import PlainMesh, write_mesh

        if isinstance(plain, PlainMesh):  # on rank 0
            write_mesh(folder.path / "mesh.msh", plain)  # to run it again with --mesh
    if folder is not None:
        options = {"mesh": given, "solver": solver, "guide": guide, "tolerance": tolerance, "adapt": adapt or None}
        folder.finish(result, {**options, **changes})
    return result


def _refuse_other(case: object) -> None:
    if not isinstance(case, Case):
        raise InputError("case", case, "give a Case: extrusion.cases.A, or extrusion.cases.read_toml(FILE)")


def _gone() -> Any:
    raise RuntimeError("the field of a step is gone once the run is over: take it in an observer")


def _figure(figure: Figure, step: Step) -> float:
    """A figure as a step has it; NaN where the step does not know it."""
    if figure.quantity == "gap":
        return step.gap.get(figure.point, math.nan)
    if figure.quantity == "open":
        closed = next(iter(step.zones.values())).closed  # in order from M
        opened = int(np.argmax(closed)) if closed.any() else len(closed)
        return float(opened) if closed[opened:].all() else -1.0
    return step.points.get(figure.point, (math.nan, math.nan))[1]


def _mesh(comm: MPI.Intracomm, case: Case, given: PlainMesh | HexMesh | None) -> PlainMesh | HexMesh | None:
    """The mesh on rank 0, with every group that the case asks for; None elsewhere."""
    from extrusion.mesh import case_mesh, on_root, read_mesh

    in_space = case.space == "3d"
    supports = ("billet_x", "billet_z") if in_space else ("axis",)
    groups = ["billet", "rear", *supports, *(zone.billet for zone in case.zones)]
    if case.die == "elastic":
        groups += ["die", "fixed", *(zone.die for zone in case.zones)]

    def make() -> PlainMesh | HexMesh:
        mesh: PlainMesh | HexMesh
        if given is not None:
            mesh = given
            if (mesh.points.shape[1] == 3) is not in_space:
                remedy = "give a HexMesh, or another space" if in_space else "give a PlainMesh, or space = '3d'"
                raise InputError("mesh", f"{mesh.points.shape[1]}-dimensional points", remedy)
        elif in_space:
            from extrusion.mesh3d import hex_mesh, read_hex

            if case.mesh is not None:
                return read_hex(case.mesh, groups)
            mesh = hex_mesh(case.profile, case.mesh_size, case.sectors, case.order)
        elif case.mesh is not None:
            return read_mesh(case.mesh, groups)
        else:
            mesh = case_mesh(case.profile, case.mesh_size)
        present = [*mesh.cells, *mesh.facets]
        for group in groups:
            if group not in present:
                raise InputError("mesh", group, f"no such group; groups present: {', '.join(present)}")
        return mesh

    return on_root(comm, make)


def _timed[T](items: Iterator[T], seconds: dict[str, float], key: str) -> Generator[T]:
    """The items; the time they take to come is added to ``seconds[key]``."""
    while True:
        began = time.perf_counter()
        try:
            item = next(items)
        except StopIteration:
            return
        finally:
            seconds[key] += time.perf_counter() - began
        yield item


def verify(case: Case, **options: Any) -> list[Result]:
    """The runs whose `Result.figures` are all that the sheet has of a case: solved, and only checked. Collective.

    Args:
        case: A case with figures.
        **options: What `run` takes.

    Raises:
        InputError: The case has no figures, or what `run` raises.
    """
    refuse_unverifiable(case, **options)
    asked = {figure.contact for figure in case.figures}
    variants = {"solved": case, "check": case.with_contact("check")}
    plain = options | {"guide": "off"}  # nothing to be guided where contact is only checked
    return [
        run(variant, **(plain if contact == "check" else options))
        for contact, variant in variants.items()
        if contact in asked
    ]


def refuse_unverifiable(case: Case, **options: Any) -> None:
    """Raise what `verify` would raise at once."""
    _refuse_other(case)
    if not case.figures:
        raise InputError("figures", [], f"case {case.name} has none to verify")
    times = changed(case, **{name: options.get(name) for name in ("increment", "until")}).times()
    ends = {"side": ("L", "M"), "front": ("K", "L")}
    for figure in case.figures:
        if figure.quantity == "gap" and not any(figure.point in ends[zone.billet] for zone in case.zones):
            raise InputError("figures.point", figure.point, f"no zone of case {case.name} has it, so it has no gap")
        if not any(math.isclose(t, figure.t, rel_tol=1e-9) for t in times):
            raise InputError(
                "figures.t", figure.t, f"no increment of case {case.name} ends there: add a row to its table"
            )
