"""Meshes refined where the goal needs it, from a dual-weighted estimate.

The error of a goal J (K's displacement, or the reaction) is, to first order, what the residual of the computed stress
does on the dual solution w. With the tangent A of the accepted step (bulk and contact) and j = dJ/du::

    A^T w = j

Where both fields are poor the mesh is too coarse for the goal. How poor is seen from the stress, which jumps from
triangle to triangle, against a continuous one (Zienkiewicz and Zhu 1987, doi:10.1002/nme.1620240206), so that::

    eta_T = |sigma(u) - sigma*(u)|_T  |sigma(w) - sigma*(w)|_T        |s|_T^2 = int_T s : C^-1 s

sigma* is quadratic: the mean of the triangles' stresses at each vertex, and at each middle of an edge. In a mesh that
has the least error for its triangles all eta_T are equal, and so the next one is made (`refined`).

Against the converged reference the sum of eta_T is 2 to 9 times the error of K, and 2 to 11 times that of the reaction,
on meshes refined for them from a graded one on (from a uniform one 0.8 times at worst; K's on meshes refined for the
reaction 0.6 times). The distance of two successive meshes is 2 to 12 and 2 to 14 times the error, and takes a run more.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

import basix
import ufl
from dolfinx import fem

from extrusion.cases import Case
from extrusion.condensed import choose
from extrusion.elasticity import epsilon, sigma
from extrusion.errors import InputError, StepError
from extrusion.estimate import GOALS, Error, Estimate, Goal, Part, continuous, reaction_scale, tell_space
from extrusion.gap import Array
from extrusion.guide import choose_guide
from extrusion.mesh import PlainMesh, graded_mesh, on_root, sized_mesh
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.profile import Profile
from extrusion.stepping import Step, steps

log = logging.getLogger(__name__)

COARSEST = 0.16
"""Element size of the first mesh, as a part of the billet's radius."""

GROWTH = 3.0
"""Triangles of a mesh by those of the one before, about; fewer where the tolerance is near."""

RATE = 1.25
"""Order of the error in the number of triangles, by which a mesh is made for a tolerance."""

BEST_RATE = 2.0
"""That of smooth solutions: where it does not reach the tolerance nothing does."""

MESHES = 6
"""How many are tried."""

LEAST, MOST = 0.25, 2.0
"""Bounds of an element's new size by its old one."""

FINEST = 1e-4
"""Least element size, as a part of the billet's radius."""

ORDER = 4.0
"""Of eta_T in the size of the triangle: 6 where stresses are smooth, 2 or less at corners."""

GRADING = {"billet": 0.35, "die": 0.7}
"""By how much the element size grows over a distance, at most."""

STATIONS = 32
"""Steps of a run at which the estimate is made, about."""


def duals(problem: Problem, x: PETSc.Vec, goals: Sequence[Goal] = GOALS) -> dict[Goal, PETSc.Vec]:
    """The dual solution of each goal at an accepted step, in the layout of `Problem.x`; zero at the supports.

    A small change q of the residual changes the goal by ``-w . q``.

    Args:
        problem: The scene on one rank, its contact state that of the step.
        x: All displacements there.
        goals: "K", or "reaction": the axial contact forces on the billet.
    """
    problem.forget_pattern()
    pc = PETSc.PC().create(problem.comm)
    pc.setType("lu")
    pc.setFactorSolverType("mumps")
    pc.setOperators(problem.tangent(x, True))
    pc.setUp()
    out = {}
    for goal in goals:
        j, out[goal] = problem.x.duplicate(), problem.x.duplicate()
        j.array[:] = derivative(problem, x, goal)
        pc.applyTranspose(j, out[goal])
        j.destroy()
    pc.destroy()
    return out


def derivative(problem: Problem, x: PETSc.Vec, goal: Goal) -> Array:
    """Of a goal by the entries of x, those at the supports left out, ``shape=(n,)``."""
    out = np.zeros(problem.n)
    if goal == "K":
        out[problem.places_of(problem.named_points())["K"][1]] = 1.0
        return out
    z = problem.gather(x)
    axial = np.zeros(problem.n_z, dtype=bool)
    axial[1 : 2 * len(problem.z_in_billet) : 2] = problem.z_in_billet
    for term in problem.terms:
        rows, cols, values = term.tangent(z, True)
        on = axial[rows] & problem.z_free[cols]
        np.add.at(out, problem.z_to_x[cols[on]], values[on])
    return out


class Recovery:
    """Distance of a displacement's stress to a continuous one, triangle by triangle.

    Args:
        problem: The scene on one rank. If its form is mixed only the deviator counts: the pressure is continuous.
    """

    CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

    def __init__(self, problem: Problem) -> None:
        case, msh = problem.case, problem.tagged.msh
        self._owned = 2 * problem.V.dofmap.index_map.size_local
        DG0 = fem.functionspace(msh, ("DG", 0))
        lmbda, mu = fem.Function(DG0), fem.Function(DG0)
        self._trace = np.zeros_like(mu.x.array)  # C^-1 s = (s - trace tr(s) I) / 2 mu
        materials = {"billet": case.billet, "die": case.die_material}
        for body in problem.bodies:
            cells, material = problem.tagged.cell_tags.find(problem.tagged.groups[body]), materials[body]
            lmbda.x.array[cells], mu.x.array[cells] = material.lmbda, material.mu
            self._trace[cells] = 1 / 3 if body == "billet" and case.mixed else material.nu / (1 + material.nu)
        self._mu = mu.x.array.copy()
        self._u = fem.Function(problem.V)
        x = ufl.SpatialCoordinate(msh)
        s = sigma(epsilon(self._u, x, axisymmetric=case.axisymmetric), lmbda, mu)
        inside = (1 + 3 * self.CORNERS) / 6  # three points, r > 0 at all of them
        self._expression = fem.Expression(ufl.as_vector([s[0, 0], s[1, 1], s[2, 2], s[0, 1]]), inside)
        self._to_corners = np.linalg.inv(_linear(inside))
        self._nodes = fem.functionspace(msh, ("Lagrange", 2)).dofmap.list
        self._share = 1.0 / np.bincount(self._nodes.ravel())
        element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.triangle, 2, basix.LagrangeVariant.equispaced
        )
        self._edge = _linear(element.points)  # corner values to those at the six nodes
        points, weights = basix.make_quadrature(basix.CellType.triangle, 4)
        self._N = element.tabulate(0, points)[0, :, :, 0]
        corners = msh.geometry.x[msh.geometry.dofmaps[0]][:, :, :2]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        r = corners[:, :, 0] @ _linear(points).T
        around = 2 * np.pi * r if case.axisymmetric else np.ones_like(r)
        self._weight = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[:, None] * weights * around
        self._original = np.argsort(msh.topology.original_cell_index)

    def __call__(self, x: PETSc.Vec) -> Array:
        """Difference of the two stresses at quadrature points, MPa, ``shape=(cells, points, 4)``: rr, yy, hoop, ry."""
        self._u.x.array[: self._owned] = x.array_r[: self._owned]
        cells = np.arange(len(self._nodes), dtype=np.int32)
        inside = self._expression.eval(self._u.function_space.mesh, cells).reshape(len(cells), 3, 4)
        own = np.einsum("nc,kcs->kns", self._edge @ self._to_corners, inside)
        mean = np.zeros((len(self._share), 4))
        np.add.at(mean, self._nodes, own)
        mean *= self._share[:, None]
        return np.einsum("qn,kns->kqs", self._N, mean[self._nodes] - own)

    def inner(self, s: Array, z: Array) -> Array:
        """``int s : C^-1 z`` over each triangle, N mm, in the order of the mesh's cells, the billet's first."""
        full = np.sum(s[..., :3] * z[..., :3], axis=-1) + 2 * s[..., 3] * z[..., 3]
        trace = np.sum(s[..., :3], axis=-1) * np.sum(z[..., :3], axis=-1)
        density = (full - self._trace[:, None] * trace) / (2 * self._mu[:, None])
        return np.sum(self._weight * density, axis=1)[self._original]


def _linear(points: Array) -> Array:
    """Shape functions of the triangle's corners, ``shape=(points, 3)``."""
    return np.column_stack([1 - points.sum(axis=1), points])


def indicators(
    problem: Problem, x: PETSc.Vec, goals: Sequence[Goal] = GOALS, recovery: Recovery | None = None
) -> dict[Goal, Array]:
    """The estimate eta_T of each triangle at an accepted step, for each goal in its unit (mm, N).

    Args:
        problem: The scene on one rank, its contact state that of the step.
        x: All displacements there.
        goals: "K", "reaction".
        recovery: That of the problem, if it is at hand.

    Returns:
        goal -> estimates, ``shape=(cells,)``, not negative, in the order of the mesh's cells: the billet's, and if it
        is elastic the die's. Their sum estimates the error.

    Raises:
        InputError: There is no such goal.
    """
    for goal in goals:
        if goal not in GOALS:
            raise InputError("goal", goal, f"choose one of {', '.join(GOALS)}")
    recovery = recovery or Recovery(problem)
    own = recovery(x)
    squared, out = recovery.inner(own, own), {}
    for goal, w in duals(problem, x, goals).items():
        other = recovery(w)
        w.destroy()
        out[goal] = np.sqrt(squared * recovery.inner(other, other))
    return out


def refined(profile: Profile, mesh: PlainMesh, eta: Array, growth: float = GROWTH) -> PlainMesh:
    """A mesh by gmsh on which the estimates would be about equal.

    Args:
        profile: The scene.
        mesh: Where the estimates were made; it has both bodies.
        eta: Estimates of its triangles, ``shape=(cells,)``, the billet's first; without the die's its sizes are kept.
        growth: How many times more triangles there are to be, about.

    Raises:
        InputError: If the estimates do not fit the mesh, or gmsh is missing.
    """
    eta = np.asarray(eta, dtype=float)
    corners = {body: mesh.points[mesh.cells[body]] for body in ("billet", "die")}
    n = len(corners["billet"])
    if eta.shape not in ((n,), (n + len(corners["die"]),)):
        raise InputError("eta", f"{eta.shape}", f"give a number for each of the {n} triangles of the billet, or of all")
    if not np.isfinite(eta).all() or np.any(eta < 0) or not np.any(eta > 0):
        raise InputError("eta", "estimates", "give finite numbers that are not negative, and not all of them 0")
    part = np.append(_parts(eta, growth), np.ones(n + len(corners["die"]) - len(eta)))
    sizes = []
    for (body, x), change in zip(corners.items(), np.split(part, [n]), strict=True):
        h = np.maximum(_sizes(x) * change, FINEST * profile.radius)
        sizes.append(_graded(x.mean(axis=1), h, GRADING[body]))
    return sized_mesh(profile, *sizes)


def _parts(eta: Array, growth: float) -> Array:
    """New element sizes by old ones, for equal estimates on growth times as many triangles."""
    wish = np.maximum(eta / np.max(eta), 1e-9) ** (-1 / ORDER)
    low, high = LEAST / float(np.max(wish)), MOST / float(np.min(wish))
    while high / low > 1.001:
        middle = math.sqrt(low * high)
        many = np.sum(np.clip(middle * wish, LEAST, MOST) ** -2.0) > growth * len(eta)
        low, high = (middle, high) if many else (low, middle)
    return np.clip(high * wish, LEAST, MOST)


def _sizes(corners: Array) -> Array:
    """Edge of the equilateral triangle of the same area, mm."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.sqrt(2 / math.sqrt(3) * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))


def _graded(at: Array, h: Array, growth: float) -> Callable[[float, float], float]:
    """Element size at (r, y): given at some points, and growing away from them."""

    def size(r: float, y: float) -> float:
        return float(np.min(h + growth * np.hypot(at[:, 0] - r, at[:, 1] - y)))

    return size


def estimated(case: Case, mesh: PlainMesh, goal: Goal, guide: str = "auto") -> tuple[Error, Array, float]:
    """A run on a mesh, on one rank: its estimated error, and what `refined` asks.

    Returns:
        The sum of the estimates at the worst step, relative; each triangle's for the goal, summed over the steps; and
        what the reaction's error is relative to, N.

    Raises:
        StepError: An increment could not be solved.
    """
    problem = Problem(case, mesh, MPI.COMM_SELF)
    system, recovery, times = choose(problem), Recovery(problem), case.times()
    every = math.ceil(len(times) / STATIONS)
    done: list[Step] = []
    found: list[tuple[Step, dict[Goal, Array]]] = []
    for step in steps(system, Newton(system), times, choose_guide(problem, system, guide)):
        done.append(step)
        if (len(times) - len(done)) % every == 0:
            found.append((step, indicators(problem, step.x, GOALS, recovery)))
    scale = reaction_scale(done)
    by_goal: dict[Goal, Array] = {
        "K": np.array([eta["K"] / abs(step.points["K"][1]) for step, eta in found]),
        "reaction": np.array([eta["reaction"] / max(scale, abs(step.reaction)) for step, eta in found]),
    }
    worst = {name: float(np.max(np.sum(eta, axis=1))) for name, eta in by_goal.items()}
    return Error(worst["K"], worst["reaction"]), np.sum(by_goal[goal], axis=0), scale


def adapt(
    case: Case,
    tolerance: float,
    goal: Goal,
    comm: MPI.Intracomm,
    start: PlainMesh | None = None,
    guide: str = "auto",
) -> tuple[PlainMesh | None, Estimate]:
    """A mesh that is refined until the estimated error is below a tolerance. Collective; rank 0 works.

    Args:
        case: Its scene and increments count; it is discretised as `continuous` says.
        tolerance: Relative, of the goal.
        goal: "K" or "reaction".
        comm: Ranks that wait for it.
        start: Mesh to begin with, on rank 0; by default a coarse graded one.
        guide: As `run` has it.

    Returns:
        The mesh on rank 0 (None elsewhere), and its estimate.

    Raises:
        InputError: The tolerance or the goal is no such thing, no mesh that is tried reaches it, or gmsh is missing.
        StepError: An increment could not be solved.
    """
    if goal not in GOALS:
        raise InputError("goal", goal, f"choose one of {', '.join(GOALS)}")
    if not isinstance(tolerance, int | float) or not math.isfinite(tolerance) or not 0 < tolerance < 1:
        raise InputError("tolerance", tolerance, "give a relative error between 0 and 1")
    scene = continuous(case)
    tell_space(case, comm)

    def make() -> tuple[PlainMesh, Estimate] | str:
        mesh, parts = start or graded_mesh(case.profile, COARSEST * case.profile.radius), []
        for number in range(MESHES):
            try:
                error, eta, scale = estimated(scene, mesh, goal, guide)
            except StepError as failed:
                return str(failed)
            taken = error.of(goal) <= tolerance
            parts.append(Part(f"{len(eta)} triangles", taken, error))
            log.info("%d triangles: estimated error of %s %.1e", len(eta), goal, error.of(goal))
            if taken:
                return mesh, Estimate(goal, tolerance, error, tuple(parts), scale)
            wish = error.of(goal) / tolerance
            if wish > GROWTH ** (BEST_RATE * (MESHES - 1 - number)):
                break
            mesh = refined(case.profile, mesh, eta, min(GROWTH, (1.25 * wish) ** (1 / RATE)))
        reached = f"{len(eta)} triangles reach {error.of(goal):.1e}"
        raise InputError(
            "tolerance", tolerance, f"{reached}, and the finest mesh that is tried would not do: give more"
        )

    found = on_root(comm, make)
    mesh = found[0] if isinstance(found, tuple) else None
    said = comm.bcast(found[1] if isinstance(found, tuple) else found)
    if isinstance(said, str):
        raise StepError(said)
    return mesh, said
