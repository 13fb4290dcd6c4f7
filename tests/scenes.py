"""Scenes, meshes and curves that the tests share: small enough to reason about."""

from collections.abc import Iterable

from mpi4py import MPI

import numpy as np

from extrusion.cases import Case, Zone
from extrusion.gap import Surface
from extrusion.mesh import PlainMesh, grid, plain_mesh
from extrusion.newton import Newton
from extrusion.problem import Problem
from extrusion.profile import Profile
from extrusion.stepping import Step, steps

FRONT = Zone(name="2", billet="front", die="cone", ray="y")
SIDE = Zone(name="1", billet="side", die="bore", ray="r")


def straight_die(
    *, radius: float, length: float, bore: tuple[float, float], stop: float, divisions: int = 7
) -> Profile:
    """A billet in a straight or tapered bore that a flat end closes.

    Args:
        radius: Of the billet, mm.
        length: Of the billet, mm.
        bore: Radius of the bore at y = 0 and at the end, mm.
        stop: y of the end, mm.
        divisions: Of bore and end (nodal contact).
    """
    wide = 2 * max(*bore, radius)
    die = (
        ("A", bore[0], 0.0), ("F", bore[1], stop), ("G", 0.0, stop),
        ("H", 0.0, 2 * stop), ("I", wide, 2 * stop), ("J", wide, 0.0),
    )  # fmt: skip
    fixed = (("H", "I"), ("I", "J"), ("J", "A"))
    parts = (("A", "F", divisions), ("F", "G", divisions))
    return Profile(
        die=die, bore=("A", "F"), cone=("F", "G"), fixed=fixed, radius=radius, length=length, divisions=parts
    )


def block(*, radius: float, length: float, start: float, end: float, divisions: int = 7, slope: float = 0.0) -> Profile:
    """A billet before a block of the same radius, held at its far end; both its ends rise by the slope from the axis.

    On the axis the block reaches from y = start to end.
    """
    rise = slope * radius
    die = (("F", radius, start + rise), ("G", 0.0, start), ("H", 0.0, end), ("I", radius, end + rise))
    parts = (("F", "G", divisions),)
    return Profile(
        die=die, bore=("I", "F"), cone=("F", "G"), fixed=(("H", "I"),), radius=radius, length=length, divisions=parts
    )


def billet_mesh(profile: Profile, columns: int, rows: int, die: tuple[int, int] | None = None) -> PlainMesh:
    """Grid of the billet, and of the die of `block` if its columns and rows are given."""
    names = {"bottom": "rear", "right": "side", "top": "front", "left": "axis"}
    points, cells, edges = grid(np.linspace(0, profile.radius, columns + 1), np.linspace(0, profile.length, rows + 1))
    bodies, facets = {"billet": cells}, {names[side]: edge for side, edge in edges.items()}
    if die is not None:
        names = {"bottom": "cone", "right": "bore", "top": "fixed", "left": "die_axis"}
        (radius, rim), (_, start), (_, end) = (profile.points[name] for name in "FGH")
        more, cells, edges = grid(np.linspace(0, radius, die[0] + 1), np.linspace(start, end, die[1] + 1))
        more[:, 1] += (rim - start) * more[:, 0] / radius
        bodies["die"] = cells + len(points)
        facets |= {names[side]: edge + len(points) for side, edge in edges.items()}
        points = np.vstack([points, more])
    return plain_mesh(points, bodies, facets)


def solve(case: Case, mesh: PlainMesh, times: Iterable[float]) -> tuple[Problem, Step]:
    """The scene at the last of the given t."""
    problem = Problem(case, mesh, MPI.COMM_SELF)
    *_, last = steps(problem, Newton(problem), list(times))
    return problem, last


def curve(points: np.ndarray, order: int = 1, first_node: int = 0, side: float = 1.0) -> Surface:
    """Straight facets through the given points, as a deformable surface of order 1 or 2."""
    start, n = np.arange(len(points) - 1), len(points)
    nodes = np.stack([start, start + 1, *([n + start] if order == 2 else [])], axis=1) + first_node
    ends = points[np.stack([start, start + 1], axis=1)]
    X = np.concatenate([ends, ends.mean(axis=1, keepdims=True)], axis=1)[:, : nodes.shape[1]]
    local = np.broadcast_to(np.arange(nodes.shape[1]), nodes.shape)
    return Surface(X, nodes, nodes, local, np.zeros((n - 1, 3, 2)), np.zeros((n - 1, 2), dtype=int), side)
