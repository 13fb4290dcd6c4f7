"""A coarse model that goes ahead of a fine one: where its increments end, the fine one's begin to look.

Newton's method converges quadratically, and an increment's own start is a millimetre or more away: it takes four to
six linear solves. The same scene on a mesh some times coarser, in the meridian plane, is solved in a fraction of the
time to a few hundredths of a millimetre; with contact linearised there, and with its contact set, the first solve ends
so near that two or three more do, and hardly more as the mesh is refined. The answer is that of the fine model: it only
starts elsewhere. Nested iteration; Deuflhard, Newton Methods for Nonlinear Problems (2011) 8,
doi:10.1007/978-3-642-23899-4.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from extrusion.cases import Case
from extrusion.condensed import ITERATIONS, Condensed, seconds_an_iteration
from extrusion.errors import InputError, StepError
from extrusion.gap import Array, Index, Surface, shape
from extrusion.gap3d import radial
from extrusion.mesh import bundled_path, case_mesh, on_root
from extrusion.newton import Newton
from extrusion.pairs import Pair
from extrusion.problem import Problem
from extrusion.stepping import Step, steps
from extrusion.system import Forecast, System, node_positions

log = logging.getLogger(__name__)

GUIDES = ("auto", "on", "off")

SIZES = (0.16, 0.08, 0.04, 0.02)
"""Element sizes of a guide, of the billet's radius: 8, 4, 2 and 1 mm in SSNV504, whose meshes are shipped.

The first one serves where the second is too fine.
"""

LEAST, MOST = 2.0, 8.0
"""How many times as large these are as the elements it guides: at least, in the plane; at most, if one is so fine."""

ROUGHLY = 1e-4
"""Residual at which a guide's increment ends, of E times the radius squared: 1250 N in SSNV504, where 8e5 N press.

In plane strain, where forces are those of 1 mm of thickness, of E times the radius.
"""

SAVED = 0.3
"""Part of Newton's iterations that a guide saves: 0.2 to 0.55 were measured, most on fine meshes, in 3D 0.1 to 0.25."""


def choose_guide(problem: Problem, system: System, guide: str = "auto") -> Guide | None:
    """The guide of a scene, if it has one: auto takes one that is estimated to save more than it takes. Collective.

    Args:
        problem: The scene.
        system: What is solved (`extrusion.condensed.choose`).
        guide: One of `GUIDES`.

    Raises:
        InputError: There is no such choice, or no guide can be had and it is asked for.
    """
    if guide not in GUIDES:
        raise InputError("guide", guide, f"choose one of {', '.join(GUIDES)}")
    case, size, why = problem.case, guide_size(problem), ""
    if case.method == "nodal":
        why = "nodal contact pairs its nodes anew"
    elif all(zone.contact == "check" for zone in case.zones):
        why = "contact is only checked"
    elif size is None:
        why = "there is no coarser mesh"
    if guide == "on" and why:
        raise InputError("guide", guide, f"{why}: leave it out")
    if guide == "off" or why or size is None:
        return None
    takes = _seconds(case, size)
    saves = SAVED * ITERATIONS * len(case.times()) * seconds_an_iteration(problem, system)
    if guide == "auto" and saves < takes:
        return None
    try:
        made = Guide(problem, size)
    except InputError as error:  # no gmsh for its mesh
        if guide == "on":
            remedy = f"it has no mesh of {size:g} mm ({error.remedy}): leave it out"
            raise InputError("guide", guide, remedy) from None
        return None
    if problem.comm.rank == 0:
        why = f": estimated to take {takes:.2g} s and to save {saves:.2g} s" if guide == "auto" else ""
        log.info("guided by P2 triangles of %g mm%s", size, why)
    return made


def _seconds(case: Case, size: float) -> float:
    """What a guide takes, estimated at the rates of `extrusion.condensed.Cost`."""
    fine = SIZES[1] * case.profile.radius / size
    mesh = 1.0 if bundled_path(case.profile, size) is None else 0.0
    return (mesh + 0.1) * fine + 3.5 * len(case.times()) * (0.6e-3 + 0.7e-3 * fine)


def guide_size(problem: Problem) -> float | None:
    """Element size of a scene's guide, mm; None where that would be no mesh."""
    zone, pair, profile = problem.case.zones[0], problem.terms[0].pair, problem.case.profile
    billet = pair.slave if zone.slave == "billet" else pair.die
    fine = 1.1 * float(np.max(billet.length))  # sizes are divided into whole numbers of facets
    coarsest, *sizes = (share * profile.radius for share in SIZES)
    size = next((size for size in sizes if size <= min(MOST * fine, profile.length / 2)), sizes[-1])
    if problem.dim == 2 and 1.2 * size < LEAST * fine:
        size = coarsest
        if 1.2 * size < LEAST * fine:
            return None
    return size if size <= profile.length / 2 else None


class Guide:
    """Forecasts of a scene's increments, from a coarser model of it that is solved on rank 0 alone. Collective.

    Args:
        problem: What is to be guided.
        size: Element size of the guide, mm.
    """

    def __init__(self, problem: Problem, size: float) -> None:
        self._comm, self.size, self.seconds = problem.comm, size, 0.0
        with self._ahead_of_it():
            self._ahead = on_root(problem.comm, lambda: _Ahead(problem, size))

    def __call__(self, t: float) -> Forecast | None:
        """The forecast for the increment that ends at t, mm, which is to grow from call to call; None if there is none.

        Collective.
        """
        with self._ahead_of_it():
            found = None if self._ahead is None else self._ahead.at(t)
            return self._comm.bcast(found) if self._comm.size > 1 else found

    @contextmanager
    def _ahead_of_it(self) -> Iterator[None]:
        """Time what is done, and let only the guided model speak: what its guide would say is not of the run."""
        began, all_of_us = time.perf_counter(), logging.getLogger("extrusion")
        level = all_of_us.level
        all_of_us.setLevel(logging.CRITICAL)
        try:
            yield
        finally:
            all_of_us.setLevel(level)
            self.seconds += time.perf_counter() - began


class _Ahead:
    """The coarser model, as far as it has been solved."""

    def __init__(self, problem: Problem, size: float) -> None:
        case = guiding(problem.case, size)
        self._system = Condensed(Problem(case, case_mesh(case.profile, size), MPI.COMM_SELF))
        pairs = [(coarse.pair, fine.pair) for coarse, fine in zip(self._system.terms, problem.terms, strict=True)]
        links = [link for ours, theirs in pairs for link in _links(ours, theirs)]
        free = [problem.z_free[link.entries] for link in links]
        self._links = [link.only(of) for link, of in zip(links, free, strict=True)]
        self._entries = np.concatenate([link.entries for link in self._links])
        dims = 1 if case.space == "plane strain" else 2
        newton = Newton(self._system, atol=ROUGHLY * case.billet.E * case.profile.radius**dims)
        self._steps: Iterator[Step] = steps(self._system, newton, case.times())

    def at(self, t: float) -> Forecast | None:
        """The forecast for t, mm."""
        try:
            step = next((step for step in self._steps if step.t >= t), None)
        except (StepError, ArithmeticError, PETSc.Error):  # the run can do without
            return None
        if step is None or step.t != t:
            return None
        if step.cuts:  # what is hard for it would take longer than it saves
            self._steps = iter(())
        z = self._system.gather(self._system.x)
        values = np.concatenate([link(z) for link in self._links])
        return Forecast(self._entries, values, [term.contact_set(z) for term in self._system.terms])


@dataclass(frozen=True)
class _Link:
    """Displacements of a surface's nodes from those of a coarse curve."""

    entries: Index  # (n,) of the fine contact vector
    cols: Index  # (n, L) of the coarse one
    weights: Array  # (n, L)

    def only(self, some: np.ndarray) -> _Link:
        """Some of the entries."""
        return _Link(self.entries[some], self.cols[some], self.weights[some])

    def __call__(self, z: Array) -> Array:
        return np.asarray((self.weights * z[self.cols]).sum(axis=1))


def _links(coarse: Pair, fine: Pair) -> list[_Link]:
    """From a zone's slave and die to those of another mesh, each node from where it lies on the meridian."""
    out = []
    for curve, surface in ((coarse.slave, fine.slave), (coarse.die, fine.die)):
        nodes = np.unique(surface.nodes)
        if not len(nodes):  # a rigid die of revolution
            continue
        X = node_positions(surface, nodes)
        if fine.dim == 2:
            place, by = X, np.broadcast_to(np.eye(2), (len(X), 2, 2))
        else:
            place, by = np.column_stack([np.hypot(X[:, 0], X[:, 2]), X[:, 1]]), np.zeros((len(X), 3, 2))
            by[:, :, 0], by[:, 1, 1] = radial(X), 1.0
        facet, xi = _nearest(curve, place)
        N = shape(xi, curve.nodes.shape[1])
        cols = 2 * curve.nodes[facet][:, None, :, None] + np.arange(2)
        weights = N[:, None, :, None] * by[:, :, None]
        entries = fine.dim * nodes[:, None] + np.arange(fine.dim)
        cols = np.broadcast_to(cols, weights.shape)
        out.append(_Link(entries.ravel(), cols.reshape(entries.size, -1), weights.reshape(entries.size, -1)))
    return out


def _nearest(curve: Surface, x: Array) -> tuple[Index, Array]:
    """The facet of a curve that each point is nearest to, and where on it, in [0, 1]."""
    start, along = curve.X[:, 0], curve.X[:, 1] - curve.X[:, 0]
    xi = np.einsum("nmi,mi->nm", x[:, None] - start, along) / (along**2).sum(axis=1)
    xi = np.clip(xi, 0.0, 1.0)
    off = np.linalg.norm(x[:, None] - start - xi[..., None] * along, axis=-1)
    facet = np.argmin(off, axis=1)
    return facet, xi[np.arange(len(x)), facet]


def guiding(case: Case, size: float) -> Case:
    """The scene of a guide: in the meridian plane, P2 elements, Nitsche's method as it is by default."""
    space = "axisymmetric" if case.space == "3d" else case.space
    return replace(
        case, space=space, size=size, mesh=None, sectors=None, element="lagrange", off_symmetry=0.0,
        method="nitsche", order=2, gamma=None, theta=0, form=None,
    )  # fmt: skip
