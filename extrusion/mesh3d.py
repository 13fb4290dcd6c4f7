"""All-hexahedral meshes of a quarter of billet and die: made, read, written, and distributed over ranks.

Coordinates (x, y, z): y is the axis of extrusion. The quarter is x >= 0, z >= 0; the profile's (r, y) half-plane
lies at z = 0 (r = x), and the azimuth runs from there to the plane x = 0 (r = z). Blocks of structured cells need no
mesher: gmsh is not used. Files are read by meshio, imported where it is used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

import basix
import basix.ufl
import dolfinx.mesh
import ufl
from dolfinx.graph import adjacencylist
from dolfinx.io.utils import distribute_entity_data

from extrusion.errors import InputError
from extrusion.mesh import ALIASES, SOLID, TAGS, Indices, TaggedMesh, checked_nodes, named_cells, on_root
from extrusion.profile import Array, Edge, Profile

FACETS_3D = {
    **{name: "billet" for name in ("side", "front", "rear", "billet_z", "billet_x")},
    **{name: "die" for name in ("bore", "cone", "fixed", "die_z", "die_x")},
}
"""Facet groups and the body each belongs to; ``billet_z`` and ``die_z`` lie on z = 0, ``_x`` on x = 0."""

PLANES = ("billet_z", "billet_x", "die_z", "die_x")

TAGS_3D = {name: TAGS[name] for name in ("billet", "die", *FACETS_3D) if name in TAGS} | {
    name: i for i, name in enumerate(PLANES, start=max(TAGS.values()) + 1)
}
"""Number of every cell and facet group in mesh tags and MSH files; those of `mesh.TAGS` where they have one."""

ALIASES_3D = ALIASES | {
    "lop_esc1": "side",
    "lop_esc2": "front",
    "lop_ddl": "rear",
    "lop_sym1": "billet_z",
    "lop_sym2": "billet_x",
    "fil_mai1": "bore",
    "fil_mai2": "cone",
    "fil_ext": "fixed",
    "fil_sym1": "die_z",
    "fil_sym2": "die_x",
}
"""Names of the published MED meshes, lower case."""

FACES = np.array(basix.topology(basix.CellType.hexahedron)[2])[:, [0, 1, 3, 2]]
"""Vertices of each face of a cell, going round, ``shape=(6, 4)``."""

GMSH = np.array([0, 1, 3, 2, 4, 5, 7, 6, *range(8, 14), 15, 14, *range(16, 27)])
"""Nodes of a cell in gmsh's order, from those in ours, and the other way round."""

_VTK = np.array([*range(9), 11, 13, 9, 16, 18, 19, 17, 10, 12, 14, 15, 22, 23, 21, 24, 20, 25, 26])
"""Nodes of a 27-node cell as meshio gives them, from those in gmsh's order."""


@dataclass(frozen=True)
class HexMesh:
    """Hexahedra of a quarter of the scene, on one rank. Make it with `plain_hexes`, which checks it.

    Attributes:
        points: Nodes, ``shape=(n, 3)``, mm; every one is used by a cell.
        order: Of the geometry, 1 or 2.
        cells: Nodes of each body's cells in DOLFINx's order (vertices first), ``shape=(m, 8)`` or ``(m, 27)``.
        facets: Vertices of each group's boundary quadrilaterals, going round, ``shape=(f, 4)``; groups without
            facets are absent.
    """

    points: Array
    order: int
    cells: Mapping[str, Indices]
    facets: Mapping[str, Indices]


def plain_hexes(
    points: npt.ArrayLike,
    cells: Mapping[str, npt.ArrayLike],
    facets: Mapping[str, npt.ArrayLike],
    order: int = 1,
    origin: str = "mesh",
) -> HexMesh:
    """Checked mesh: unused nodes and empty groups dropped, left-handed cells mirrored.

    Args:
        points: Nodes, ``shape=(n, 3)``, mm.
        cells: Cells of each body, ``shape=(m, (order + 1)**3)``.
        facets: Quadrilaterals of each facet group, ``shape=(f, 4)``.
        order: Of the geometry.
        origin: What error messages call the mesh, say its file.

    Raises:
        InputError: If a node is not finite, a cell is turned inside out at a node or a Gauss point, more than two
            cells share a face, bodies share nodes, a facet is no boundary face of its body, or two groups share one.
    """

    def refuse(what: str) -> InputError:
        return InputError("mesh", origin, what)

    widths = {"hexahedra": (order + 1) ** 3, "quadrilaterals": 4}
    x, bodies, groups, used = checked_nodes(points, cells, facets, FACETS_3D, widths, refuse)

    for name, c in bodies.items():
        least, most = scaled_jacobians(x, c, order)
        c[most < 0] = c[most < 0][:, _MIRROR[order]]
        least = np.where(most < 0, -most, least)
        if (bad := np.flatnonzero(~(least > 1e-6))).size:
            where = tuple(float(v) for v in x[c[bad[0], 0]])
            raise refuse(f"has a cell without volume, or folded, in {name} at {where}; mesh it again")

    new = np.full(len(x), -1)
    new[used] = np.arange(len(used))
    for body in ("billet", "die"):
        names = [name for name in groups if FACETS_3D[name] == body for _ in groups[name]]
        quads = np.vstack([np.empty((0, 4), dtype=np.int64), *(f for k, f in groups.items() if FACETS_3D[k] == body)])
        faces, times = _faces(bodies.get(body, np.empty((0, 8), dtype=np.int64)), quads)
        if np.any(times[0] > 2):
            raise refuse(f"has cells that overlap in {body}; mesh it again")
        for wrong, what in (
            (times[0] != 1, f"that is no boundary face of the {body}"),
            (times[1] > 1, "that is in the group twice, or in another one"),
        ):
            if (bad := np.flatnonzero(wrong[len(faces) - len(quads) :])).size:
                nodes = ", ".join(map(str, quads[bad[0]]))
                raise refuse(f"has a facet of group {names[bad[0]]} of nodes {nodes} {what}")
    return HexMesh(x[used], order, {k: new[c] for k, c in bodies.items()}, {k: new[f] for k, f in groups.items()})


def _element(order: int) -> Any:
    """The Lagrange element whose nodes are the cell's."""
    variant = basix.LagrangeVariant.gll_warped
    return basix.create_element(basix.ElementFamily.P, basix.CellType.hexahedron, order, variant)


_LATTICE = {order: np.rint(order * _element(order).points).astype(int) for order in (1, 2)}
"""Position of each node in the cell's lattice, ``shape=((order + 1)**3, 3)``."""

_MIRROR = {
    order: np.array([np.flatnonzero(np.all(p == q, axis=1))[0] for q in p * [-1, 1, 1] + [order, 0, 0]])
    for order, p in _LATTICE.items()
}
"""Nodes of a cell seen in a mirror."""


def scaled_jacobians(points: Array, cells: Indices, order: int) -> tuple[Array, Array]:
    """Least and greatest determinant of the unit tangents over each cell's nodes and Gauss points, in [-1, 1].

    1 in a brick; 0 where a cell is flat.
    """
    element = _element(order)
    gauss = basix.make_quadrature(basix.CellType.hexahedron, 2 * order + 1)[0]
    slopes = element.tabulate(1, np.vstack([element.points, gauss]))[1:, :, :, 0]  # (direction, point, node)
    least, most = np.empty(len(cells)), np.empty(len(cells))
    for i in range(0, len(cells), 10_000):  # bounds the memory
        x = points[cells[i : i + 10_000]].transpose(2, 0, 1)
        t = np.einsum("dpn,xcn->dxcp", slopes, x, optimize=True)
        with np.errstate(divide="ignore", invalid="ignore"):  # NaN where a tangent vanishes
            t = t / np.sqrt(np.sum(t * t, axis=1, keepdims=True))
        a, b, c = t
        det = (
            a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        least[i : i + 10_000], most[i : i + 10_000] = det.min(axis=1), det.max(axis=1)
    return least, most


def _faces(cells: Indices, quads: Indices) -> tuple[Indices, Indices]:
    """Faces of all cells, then the quads, and for each how often it is among the cells' faces, and among the quads."""
    faces = np.vstack([cells[:, FACES].reshape(-1, 4), quads])
    ids, n = _numbered(np.sort(faces, axis=1)), len(faces) - len(quads)
    times = [np.bincount(part, minlength=np.max(ids, initial=0) + 1)[ids] for part in (ids[:n], ids[n:])]
    return faces, np.array(times)


def _numbered(rows: Indices) -> Indices:
    """A number for each row of node numbers >= -1, the same for equal rows; the width is even."""
    base = np.max(rows, initial=0) + 2
    key = (rows[:, ::2] + 1) * base + rows[:, 1::2] + 1
    order = np.lexsort(key.T)
    key = key[order]
    number = np.empty(len(rows), dtype=np.int64)
    number[order] = np.cumsum(np.concatenate([[True], np.any(key[1:] != key[:-1], axis=1)])[: len(rows)]) - 1
    return number


# --- meshes of a profile


def hex_mesh(profile: Profile, size: float | None = None, sectors: int | None = None, order: int = 1) -> HexMesh:
    """Mesh of a quarter by structured blocks; gmsh is not needed.

    The billet is a disc drawn out along y: a bulged core of n x n quadrilaterals, where n is half of `sectors`, and
    layers out to the circle. The die is its section turned round: a block between bore and outside; with a cone
    another between cone and top, closed at the axis by a disc, and one in the outer corner between the two. Nodes of
    side, bore and cone are on these surfaces, at order 2 those within edges and faces as well; each vertex of bore and
    cone is a ring of nodes.

    Args:
        profile: The scene. Its polygon must be bore, cone down to the axis, and three more vertices (H, I, J), or
            bore and two more vertices.
        size: Element size h, mm, along side, front, bore and cone; the die's layers grow outwards from h by half.
            Without it the profile's divisions count: those of L-M, M-N, bore, cone, A-J and G-H.
        sectors: Divisions of the quarter circle, an even number; unless given 10 as in the published mesh, or with
            a size as many as give h on the billet's circle. A radius that would have less than n / 2 layers round
            the core gets n / 2.
        order: Of the geometry, 1 or 2, on the same cells.

    Raises:
        InputError: If an argument is out of range, the die is of another shape, an edge has no divisions, or the
            blocks cannot be laid in this profile.
    """
    if size is not None and (isinstance(size, bool) or not isinstance(size, int | float) or not math.isfinite(size)):
        raise InputError("size", size, "give the element size as a number, mm")
    if size is not None and not profile.radius / 100 <= size <= profile.radius:
        least, most = profile.radius / 100, profile.radius
        raise InputError("size", size, f"give an element size between {least:g} and {most:g} mm")
    if sectors is None:
        sectors = 10 if size is None else max(4, 2 * round(math.pi * profile.radius / (4 * size)))
    if isinstance(sectors, bool) or not isinstance(sectors, int) or sectors % 2 or not 4 <= sectors <= 400:
        raise InputError("sectors", sectors, "give an even integer from 4 to 400")
    if isinstance(order, bool) or not isinstance(order, int) or order not in (1, 2):
        raise InputError("order", order, "give 1 or 2, the order of the geometry")
    cuts = _Cuts(profile, size, sectors, order)
    return _whole(_billet(cuts), _die(cuts))


@dataclass(frozen=True)
class _Cuts:
    """How a profile's edges are cut."""

    profile: Profile
    size: float | None
    sectors: int
    order: int

    def edge(self, a: str, b: str) -> int:
        """Number of equal parts of an edge."""
        length = float(np.linalg.norm(np.diff(self.profile.curve((a, b)), axis=0)))
        return self.profile.division(a, b) if self.size is None else max(1, round(length / self.size))

    def path(self, names: Sequence[str]) -> list[int]:
        """The same for each edge of a path."""
        return [self.edge(a, b) for a, b in itertools.pairwise(names)]

    def layers(self, a: str, b: str, thickness: float) -> Array:
        """Nodes' positions from 0 to 1 through the die, by the edge a-b: equal, or with a size growing by half."""
        if self.size is None:
            t = np.linspace(0, 1, self.edge(a, b) + 1)
        else:
            n = max(1, round(math.log1p(0.5 * thickness / self.size) / math.log(1.5)))
            t = np.expm1(np.arange(n + 1) * math.log(1.5)) / math.expm1(n * math.log(1.5))
        return _fine(t, self.order)

    def arc(self) -> Array:
        """Nodes of the quarter of the unit circle, ``shape=(n, 2)``; exactly 0 on the planes."""
        angle = math.pi / 2 * np.arange(self.sectors * self.order + 1) / (self.sectors * self.order)
        return np.stack([np.sin(angle[::-1]), np.sin(angle)], axis=-1)

    def disc(self, cuts: int) -> tuple[Array, Array]:
        """The quarter of the unit disc in (x, z), `cuts` cells along x where sectors allow it.

        Returns:
            Its core of n x n cells, along x and along z; the layers round it, from z = 0 to x = 0, and outwards.
        """
        n = self.sectors // 2
        layers = max(cuts - n, (n + 1) // 2)
        half = min(n / (n + layers), 0.6)  # of the core, along x and z
        bulge = (2 - math.sqrt(3)) / (3 - math.sqrt(3))  # its corner has 120 degrees, as have the two cells outside it
        u, v = np.meshgrid(*2 * [_fine(np.linspace(0, 1, n + 1), self.order)], indexing="ij")
        core = half * np.stack([u * np.sqrt(1 - bulge * v**2), v * np.sqrt(1 - bulge * u**2)], axis=-1)
        t = _fine(np.linspace(0, 1, layers + 1), self.order)
        return core, _between(_hem(core)[:, None], self.arc()[:, None], t)


def _billet(cuts: _Cuts) -> _Blocks:
    profile = cuts.profile
    y = _fine(np.linspace(0, profile.length, cuts.edge("L", "M") + 1), cuts.order)
    blocks = _Blocks(cuts)
    core, ring = blocks.disc(cuts.edge("M", "N"), lambda p: _stack(p[..., None, :] * profile.radius, y), "billet")
    blocks.skin("side", ring[:, -1])
    blocks.skin("rear", core[..., 0], ring[..., 0])
    blocks.skin("front", core[..., -1], ring[..., -1])
    return blocks


def _die(cuts: _Cuts) -> _Blocks:
    """The die: ``wall`` along the bore, and with a cone ``joint``, ``roof`` and a disc; see `hex_mesh`.

    The wall's nodes are numbered along the bore, then outwards; the joint's upwards, then outwards; the roof's along
    the cone, then upwards; then all round the axis.
    """
    profile, order, blocks = cuts.profile, cuts.order, _Blocks(cuts)
    bore, cone, outer = _die_paths(profile)
    group = {frozenset(e): name for name, edges in profile.edges.items() for e in edges}

    def skin(path: Sequence[str], face: Indices, parts: Sequence[int] | None = None) -> None:
        """Put a block's face into the group of an edge, or its parts into those of a path's edges."""
        ends = np.array([0, len(face)]) if parts is None else order * np.cumsum([0, *parts])
        for edge, i, j in zip(itertools.pairwise(path), ends[:-1], ends[1:], strict=True):
            blocks.skin(group.get(frozenset(edge)), face[i : j + 1])

    inner, parts = profile.curve(bore), cuts.path(bore)
    *_, end, start = profile.curve(outer)
    if cone:
        top, corner, _ = profile.curve(outer)
        end, above = _foot(inner[-1], start, corner), _foot(inner[-1], top, corner)
    t = cuts.layers(bore[0], outer[-1], max(math.dist(inner[0], start), math.dist(inner[-1], end)))
    wall = blocks.turn(_strip(inner, _beside(inner, start, end), parts, t, order))
    skin(bore, wall[:, 0], parts)
    skin((bore[0], outer[-1]), wall[0])
    skin(outer[-2:], wall[:, -1])
    if not cone:
        skin((bore[-1], outer[0]), wall[-1])
        return blocks

    edge, parts = profile.curve(cone), cuts.path(cone)
    s = cuts.layers(cone[-1], outer[0], max(math.dist(inner[-1], above), math.dist(edge[-1], top)))
    outside = _between(_between(inner[-1], end, t), _between(above, corner, t), s[:, None])
    joint = blocks.turn(outside, start=wall[-1])
    skin(outer[1:], joint[:, -1])
    skin(outer[:2], joint[-1])
    lid = _beside(edge, above, top)
    roof = blocks.turn(_strip(edge[:-1], lid[:-1], parts[:-1], s, order), start=joint[:, 0])
    skin(cone[:-1], roof[:, 0], parts[:-1])
    rim, axis = _between(edge[-2], lid[-2], s), _between(edge[-1], top, s)

    def place(p: Array) -> Array:
        rho = np.linalg.norm(p, axis=-1)[..., None]
        return _stack(p[..., None, :] * rim[:, :1], (1 - rho) * axis[:, 1] + rho * rim[:, 1])

    core, ring = blocks.disc(parts[-1], place, "die", rim=roof[-1].T)
    for face in (core, ring):
        skin(cone[-2:], face[..., 0])
        skin(outer[:2], face[..., -1])
    skin(outer[:2], roof[:, -1])
    return blocks


def _die_paths(profile: Profile) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Bore, cone (may be empty) and the vertices that follow them, along the die's polygon."""
    bore, cone, names = profile.bore, profile.cone, [name for name, _, _ in profile.die]
    i = names.index(bore[0])
    forward = names[(i + 1) % len(names)] == bore[1]
    path = tuple(names[i:] + names[:i] if forward else names[i::-1] + names[:i:-1])
    cone = cone[::-1] if cone and cone[-1] == bore[-1] else cone
    inner = bore + cone[1:]
    outer = path[len(inner) :]
    on_axis = {name for name, r, _ in profile.die if r == 0}
    closed = cone[:1] == bore[-1:] and len(outer) == 3 and on_axis == {inner[-1], outer[0]}
    if path[: len(inner)] != inner or not (closed if cone else len(outer) == 2 and not on_axis):
        remedy = "give bore, cone down to the axis and three more vertices, or bore and two more; or a mesh file"
        raise InputError("profile.die", "-".join(path), f"hexahedra need another outline: {remedy}")
    return bore, cone, outer


def _between(a: Array, b: Array, t: Array) -> Array:
    """(1 - t) a + t b, both ends to the last bit."""
    return (1 - t)[..., None] * a + t[..., None] * b


def _fine(t: Array, order: int) -> Array:
    """Positions t, at order 2 with their middles between them."""
    return t if order == 1 else np.interp(np.arange(2 * len(t) - 1) / 2, np.arange(len(t)), t)


def _foot(p: Array, a: Array, b: Array) -> Array:
    """Point of the segment a-b nearest p, away from its ends."""
    s = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0.05, 0.95)
    return a + s * (b - a)


def _beside(path: Array, start: Array, end: Array) -> Array:
    """Points of the segment start-end opposite the vertices of a path, ``shape=(n, 2)``."""
    chord = path[-1] - path[0]
    s = (path - path[0]) @ chord / (chord @ chord)
    if np.any(np.diff(s) <= 0):  # the path turns back: by its length
        s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return _between(start, end, s / s[-1])


def _strip(inner: Array, outer: Array, cuts: Sequence[int], t: Array, order: int) -> Array:
    """Lattice of (r, y) between two polylines whose edges are cut alike, ``shape=(m, len(t), 2)``."""
    at = np.concatenate([[0.0], *(i + np.arange(1, n * order + 1) / (n * order) for i, n in enumerate(cuts))])
    weights = np.column_stack([np.interp(at, np.arange(len(inner)), unit) for unit in np.eye(len(inner))])
    return _between((weights @ inner)[:, None], (weights @ outer)[:, None], t)


def _stack(xz: Array, y: Array) -> Array:
    """(x, y, z), ``shape=(..., 3)``."""
    return np.stack(np.broadcast_arrays(xz[..., 0], y, xz[..., 1]), axis=-1)


def _hem(core: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The outer edge of a disc's core, from z = 0 to x = 0."""
    return np.concatenate([core[-1], core[-2::-1, -1]])


class _Blocks:
    """Nodes, structured blocks of cells, and facets of one body."""

    def __init__(self, cuts: _Cuts) -> None:
        self.cuts, self.count = cuts, 0
        self.points: list[Array] = []
        self.blocks: list[Indices] = []
        self.facets: dict[str, list[Indices]] = {}

    def add(self, x: Array) -> Indices:
        """Node numbers of a block's lattice, ``shape=x.shape[:3]``. Overwrite some to join it to another block."""
        ids = self.count + np.arange(x[..., 0].size).reshape(x.shape[:3])
        self.points.append(x.reshape(-1, 3))
        self.blocks.append(ids)
        self.count += ids.size
        return ids

    def turn(self, section: Array, start: Indices | None = None) -> Indices:
        """A lattice of (r, y) of the die turned round the axis (its third axis), joined at its first row."""
        ids = self.add(_stack(section[..., :1, None] * self.cuts.arc(), section[..., 1:]))
        if start is not None:
            ids[0] = start
        self.skin("die_z", ids[..., 0])
        self.skin("die_x", ids[..., -1])
        return ids

    def disc(
        self, cuts: int, place: Callable[[Array], Array], body: str, rim: Indices | None = None
    ) -> tuple[Indices, Indices]:
        """Core and layers of a disc (see `_Cuts.disc`) placed in space, the third axis along y, joined at the rim."""
        core, ring = (self.add(place(p)) for p in self.cuts.disc(cuts))
        ring[:, 0] = _hem(core)
        if rim is not None:
            ring[:, -1] = rim
        self.skin(f"{body}_z", core[:, 0], ring[0])
        self.skin(f"{body}_x", core[0], ring[-1])
        return core, ring

    def skin(self, name: str | None, *faces: Indices) -> None:
        """Put faces of blocks into a group, if there is one."""
        for f in (f[:: self.cuts.order, :: self.cuts.order] for f in faces if name is not None):
            quads = np.stack([f[:-1, :-1], f[1:, :-1], f[1:, 1:], f[:-1, 1:]], axis=-1)
            self.facets.setdefault(str(name), []).append(quads.reshape(-1, 4))

    def cells(self) -> Indices:
        """Nodes of all cells, ``shape=(m, (order + 1)**3)``."""
        order, cells = self.cuts.order, []
        for ids in self.blocks:
            i, j, k = np.array(ids.shape) - 1
            nodes = [ids[a : a + i : order, b : b + j : order, c : c + k : order] for a, b, c in _LATTICE[order]]
            cells.append(np.stack(nodes, axis=-1).reshape(-1, (order + 1) ** 3))
        return np.vstack(cells)


def _whole(billet: _Blocks, die: _Blocks) -> HexMesh:
    facets = {name: np.vstack(f) for name, f in billet.facets.items()}
    facets |= {name: np.vstack(f) + billet.count for name, f in die.facets.items()}
    cells = {"billet": billet.cells(), "die": die.cells() + billet.count}
    return plain_hexes(np.vstack(billet.points + die.points), cells, facets, billet.cuts.order, "of this profile")


# --- files


def read_hex(path: str | Path, needed: Sequence[str] = (), on_circle: bool = False) -> HexMesh:
    """Mesh from a ``.msh`` or ``.med`` file of hexahedra and wedges; a mesh with wedges becomes all-hexahedral.

    Groups go by our names or by those of the published mesh (`ALIASES_3D`), upper or lower case; other groups,
    and what is in no group, are left out. The quarter may lie at z <= 0 or x <= 0, as the published one does: it is
    mirrored. Cells of 27 nodes in a ``.msh`` file are kept as order 2 if all are; other quadratic cells are reduced
    to their vertices.

    Wedges have no facet integrals in DOLFINx, so where there is one each vertex of each cell gives a hexahedron: 8 of
    a hexahedron, 6 of a wedge, between the middles of its edges, faces and itself. Each facet becomes 4 or 3. These
    new nodes lie on chords, inside the circle.

    Args:
        path: The file.
        needed: Groups that must be there besides billet, side, rear and the billet's two planes.
        on_circle: Move new nodes of side, bore, cone and fixed out, to the mean radius of the vertices around them.

    Raises:
        InputError: If the file cannot be read, has other cells, lacks a group, is no quarter, or is refused by
            `plain_hexes`.
    """
    path = Path(path)

    def refuse(what: str) -> InputError:
        return InputError("mesh", str(path), what)

    suffix = path.suffix.lower()
    if suffix not in (".msh", ".med"):
        raise refuse("give a .msh or .med file")
    if not path.is_file():
        raise refuse("no such file")
    import meshio

    try:
        raw = (meshio.gmsh if suffix == ".msh" else meshio.med).read(path)
        named = list(named_cells(raw))
    except Exception as error:  # meshio's readers fail in as many ways as there are broken files
        reason = " ".join(str(error).split()) or type(error).__name__
        raise refuse(f"cannot be read as a mesh ({reason}); write it again") from None

    if not any(block.type.startswith(SOLID) for block in raw.cells):
        raise refuse("has no cells in three dimensions: give hexahedra of a quarter, or space = 'axisymmetric'")
    found: dict[str, dict[int, list[Indices]]] = {}  # group -> number of vertices -> cells
    solids = {kind for _, kind, _ in named if kind.startswith(("hexahedron", "wedge"))}
    order = 2 if solids == {"hexahedron27"} and suffix == ".msh" else 1
    for name, kind, c in named:
        group = ALIASES_3D.get(name.lower(), name.lower())
        shape = kind.rstrip("0123456789")
        if group in FACETS_3D and shape in ("quad", "triangle"):
            width = 4 if shape == "quad" else 3
            found.setdefault(group, {}).setdefault(width, []).append(c[:, :width])
        elif group in ("billet", "die") and shape not in ("quad", "triangle", "line", "vertex"):
            if shape not in ("hexahedron", "wedge"):
                raise refuse(f"group {name} holds {kind} cells; give hexahedra or wedges")
            width = 6 if shape == "wedge" else 8
            nodes = c[:, :width] if order == 1 else c[:, np.argsort(_VTK)]
            found.setdefault(group, {}).setdefault(width, []).append(nodes)
    groups = {name: {w: _once(np.vstack(c)) for w, c in kinds.items()} for name, kinds in found.items()}
    for group in ("billet", "side", "rear", "billet_z", "billet_x", *needed):
        if group not in groups:
            present = ", ".join(sorted({name for name, _, _ in named})) or "none"
            raise refuse(f"has no group {group!r}; groups present: {present}")

    points = np.array(raw.points, dtype=float)
    used = points[np.concatenate([c.ravel() for kinds in groups.values() for c in kinds.values()])]
    scale = np.max(np.abs(used))
    points[np.abs(points) < 1e-12 * scale] = 0
    for axis in (0, 2):
        if np.max(used[:, axis]) < 1e-9 * scale:
            points[:, axis] = 0.0 - points[:, axis]
        elif np.min(used[:, axis]) < -1e-9 * scale:
            raise refuse(f"has nodes on both sides of the plane {'xyz'[axis]} = 0; give a quarter")
    if any(w in kinds for kinds in groups.values() for w in (3, 6)):
        points, groups = _subdivided(points, groups, on_circle)
    bodies = {name: c[8] for name, c in groups.items() if name not in FACETS_3D}
    ours = GMSH if order == 2 else GMSH[:8]
    facets = {name: f[4] for name, f in groups.items() if name in FACETS_3D and 4 in f}
    return plain_hexes(points, {name: c[:, ours] for name, c in bodies.items()}, facets, order, str(path))


def _once(cells: Indices) -> Indices:
    """Cells without those that are there twice."""
    return cells[np.unique(np.sort(cells, axis=1), axis=0, return_index=True)[1]]


def _parts(width: int, solid: bool) -> list[list[list[int]]]:
    """Vertices whose means are the nodes of each part of a quad or triangle, or of what stands on it, gmsh's order."""
    quads = [[[i], [i, (i + 1) % width], [*range(width)], [i, (i - 1) % width]] for i in range(width)]
    if not solid:
        return quads
    parts = []
    for low in quads:
        high = [[j + width for j in nodes] for nodes in low]
        both = [p + q for p, q in zip(low, high, strict=True)]
        parts += [low + both, both + high]
    return parts


def _subdivided(
    points: Array, groups: Mapping[str, Mapping[int, Indices]], on_circle: bool
) -> tuple[Array, dict[str, dict[int, Indices]]]:
    """Midpoint subdivision: hexahedra (in gmsh's order) and quadrilaterals alone."""
    rows: dict[str, list[Indices]] = {}
    for name, kinds in groups.items():
        for w, cells in kinds.items():
            padded = np.column_stack([cells, np.full(len(cells), -1)])
            for part in _parts({8: 4, 6: 3}.get(w, w), w > 4):
                take = np.array([nodes + [w] * (8 - len(nodes)) for nodes in part])
                rows.setdefault(name, []).append(padded[:, take])  # (cell, node of the part, its parents)
    shapes = {name: np.concatenate(r) for name, r in rows.items()}
    parents = np.sort(np.concatenate([r.reshape(-1, 8) for r in shapes.values()]), axis=1)
    _, first, number = np.unique(_numbered(parents), return_index=True, return_inverse=True)
    parents = parents[first]
    weight = (parents >= 0) / np.sum(parents >= 0, axis=1, keepdims=True)
    x = np.einsum("nk,nkx->nx", weight, points[parents])
    ends = np.cumsum([r.shape[0] * r.shape[1] for r in shapes.values()])
    new = {
        name: {r.shape[1]: ids.reshape(-1, r.shape[1])}
        for (name, r), ids in zip(shapes.items(), np.split(number, ends[:-1]), strict=True)
    }
    if on_circle:
        skin = np.unique(np.concatenate([new[g][4].ravel() for g in ("side", "bore", "cone", "fixed") if g in new]))
        wanted = np.sum(weight[skin] * np.hypot(points[:, 0], points[:, 2])[parents[skin]], axis=1)
        radius = np.hypot(x[skin, 0], x[skin, 2])
        x[skin[:, None], [0, 2]] *= (wanted / np.where(radius > 0, radius, 1))[:, None]
    return x, new


def write_hex(path: str | Path, mesh: HexMesh) -> None:
    """Write MSH 2.2 in ASCII with physical names; `read_hex` gives the same coordinates back.

    Facets are written by their vertices, also at order 2.

    Raises:
        InputError: If the name does not end in .msh, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".msh":
        raise InputError("mesh", str(path), "give a name that ends in .msh")
    ours = GMSH if mesh.order == 2 else GMSH[:8]
    groups = [(3, 12 if mesh.order == 2 else 5, name, c[:, ours]) for name, c in mesh.cells.items()]
    groups += [(2, 3, name, f) for name, f in mesh.facets.items()]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", str(len(groups))]
    lines += [f'{dim} {TAGS_3D[name]} "{name}"' for dim, _, name, _ in groups]
    lines += ["$EndPhysicalNames", "$Nodes", str(len(mesh.points))]
    lines += [f"{i} {x!r} {y!r} {z!r}" for i, (x, y, z) in enumerate(mesh.points.tolist(), start=1)]
    lines += ["$EndNodes", "$Elements", str(sum(len(e) for *_, e in groups))]
    elements = ((kind, TAGS_3D[name], nodes) for _, kind, name, e in groups for nodes in (e + 1).tolist())
    for i, (kind, tag, nodes) in enumerate(elements, start=1):
        lines.append(f"{i} {kind} 2 {tag} {tag} " + " ".join(map(str, nodes)))
    lines.append("$EndElements\n")
    try:
        path.write_text("\n".join(lines), encoding="ascii")
    except OSError as error:
        raise InputError("mesh", str(path), f"cannot be written: {error.strerror}") from None


def check_hex_profile(mesh: HexMesh, profile: Profile) -> None:
    """Check that every facet group of a mesh covers its surface of revolution or plane, to 1e-6 of the radius.

    So the billet's edges and the die's vertices are rings of nodes, and no facet cuts a corner. A facet may have
    nodes on chords, as a subdivided mesh has: inside its surface by no more than the facet's own sagitta.

    Raises:
        InputError: If a facet lies off its surface, or a face of the bodies is in no group and on no other surface.
    """
    tolerance = 1e-6 * profile.radius

    def on(plane: str, x: Array) -> npt.NDArray[np.bool_]:
        return np.all(np.abs(x[..., 0 if plane.endswith("_x") else 2]) <= tolerance, axis=1)

    for body, cells in mesh.cells.items():
        edges = {name: e for name, e in profile.edges.items() if FACETS_3D.get(name) == body}
        groups = {name: f for name, f in mesh.facets.items() if FACETS_3D[name] == body}
        for name, f in groups.items():
            x = mesh.points[f]
            if name not in PLANES and not edges[name]:
                raise InputError("mesh", name, "the profile has no such edge; leave the group out")
            fits = on(name, x) if name in PLANES else _fits(x, profile, edges[name], tolerance)
            if not np.all(fits):
                names = ", ".join(f"{a}-{b}" for a, b in edges.get(name, ())) or f"plane {name[-1]} = 0"
                raise InputError("mesh", f"{name} at {_place(x, fits)}", f"lies off the profile's {names}")
        faces, times = _faces(cells, np.vstack([np.empty((0, 4), dtype=np.int64), *groups.values()]))
        x = mesh.points[faces[(times[0] == 1) & (times[1] == 0)]]  # boundary faces of no group
        taken = {frozenset(e) for name in groups if name in edges for e in edges[name]}
        outline = profile.billet_edges[:3] if body == "billet" else profile.die_edges
        other = [e for e in outline if frozenset(e) not in taken]
        fits = _fits(x, profile, other, tolerance)
        for name in (p for p in PLANES if FACETS_3D[p] == body and p not in groups):
            fits |= on(name, x)
        if not np.all(fits):
            raise InputError("mesh", f"{body} at {_place(x, fits)}", "has a boundary face that is missing in its group")


def _fits(x: Array, profile: Profile, edges: Sequence[Edge], tolerance: float) -> npt.NDArray[np.bool_]:
    """Whether each facet, ``shape=(f, 4, 3)``, lies on one of some edges turned round the axis."""
    r = np.hypot(x[..., 0], x[..., 2])
    azimuth = np.where(r > tolerance, np.arctan2(x[..., 2], x[..., 0]), np.nan)
    with np.errstate(invalid="ignore"):
        sagitta = np.max(r, axis=1) * (1 - np.cos(np.nanmax(azimuth, axis=1) - np.nanmin(azimuth, axis=1)))
    fits = np.zeros(len(x), dtype=bool)
    for a, b in (profile.curve(e) for e in edges):
        p = np.stack([r, x[..., 1]], axis=-1) - a
        s = np.clip(p @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        off = p - s[..., None] * (b - a)
        distance = np.linalg.norm(off, axis=-1)
        near = (np.min(distance, axis=1) <= tolerance) & (np.max(distance, axis=1) <= tolerance + sagitta)
        fits |= near & (np.max(off[..., 0], axis=1) <= tolerance)  # a chord is inside
    return fits


def _place(x: Array, fits: npt.NDArray[np.bool_]) -> tuple[float, ...]:
    """Middle of the first facet that does not fit."""
    return tuple(round(float(v), 6) for v in np.mean(x[np.argmin(fits)], axis=0))


# --- distribution


def distribute_hex(comm: MPI.Comm, mesh: HexMesh | None, bodies: Sequence[str] = ("billet", "die")) -> TaggedMesh:
    """DOLFINx mesh of some bodies, with tagged cells and facets. Collective.

    Args:
        comm: The ranks to spread the cells over.
        mesh: The mesh on rank 0; not looked at elsewhere.
        bodies: Which bodies to take; facet groups of the others, and their nodes, are dropped.

    Raises:
        InputError: On every rank, if a body is missing or there are more ranks than cells.
    """

    def taken() -> HexMesh:
        if mesh is None:
            raise InputError("mesh", None, "give rank 0 a mesh")
        for body in bodies:
            if body not in mesh.cells:
                raise InputError("mesh", body, f"has no such body; it has {', '.join(mesh.cells)}")
        if (count := sum(len(mesh.cells[body]) for body in bodies)) < comm.size:
            raise InputError("ranks", comm.size, f"the mesh has {count} cells only; use fewer ranks")
        facets = {name: f for name, f in mesh.facets.items() if FACETS_3D[name] in bodies}
        return plain_hexes(mesh.points, {body: mesh.cells[body] for body in bodies}, facets, mesh.order)

    part = on_root(comm, taken)
    order, names = comm.bcast(None if part is None else (part.order, [*part.cells, *part.facets]), root=0)
    part = part or HexMesh(np.empty((0, 3)), order, {}, {})
    cells, cell_values = _tagged(part.cells, (order + 1) ** 3)
    element = basix.ufl.element("Lagrange", "hexahedron", order, shape=(3,))
    sizes = [len(part.cells.get(body, ())) for body in bodies]
    msh = dolfinx.mesh.create_mesh(comm, cells, ufl.Mesh(element), part.points, _each_body(sizes))
    tags = []
    for dim, nodes, values in ((3, cells[:, :8].copy(), cell_values), (2, *_tagged(part.facets, 4))):
        entities, local = distribute_entity_data(msh, dim, nodes, values)  # by their vertices at any order
        msh.topology.create_connectivity(dim, 3)
        tags.append(dolfinx.mesh.meshtags_from_entities(msh, dim, adjacencylist(entities), local))
    return TaggedMesh(msh, tags[0], tags[1], {name: TAGS_3D[name] for name in names})


def _each_body(sizes: Sequence[int]) -> Callable[..., Any]:
    """A partitioner that spreads each body over all ranks: left to itself, two ranks get one each.

    Args:
        sizes: This rank's cells of each body, which stand one after the other; none but on rank 0.
    """
    partition = dolfinx.mesh.create_cell_partitioner(dolfinx.mesh.GhostMode.none, 2)

    def destinations(comm: MPI.Comm, n: int, types: list[Any], cells: list[Indices]) -> Any:
        of_body = np.split(cells[0], 8 * np.cumsum(sizes)[:-1])  # by their vertices
        found = [partition(comm, n, types, [body]).array for body in of_body]
        return adjacencylist(np.concatenate(found).reshape(-1, 1))._cpp_object

    return destinations


def _tagged(groups: Mapping[str, Indices], width: int) -> tuple[Indices, npt.NDArray[np.int32]]:
    """All entities of some groups, and the tag of each."""
    nodes = np.vstack([np.empty((0, width), dtype=np.int64), *groups.values()])
    tags = np.repeat([TAGS_3D[name] for name in groups], [len(e) for e in groups.values()])
    return nodes, tags.astype(np.int32)
