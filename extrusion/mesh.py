"""Meshes of a profile: made, read, written, and distributed over ranks as DOLFINx meshes with named groups.

Cell groups are the bodies ``billet`` and ``die``, which share no node; facet groups are the keys of `FACETS`.
gmsh and meshio are imported where they are used: a run on a bundled mesh needs no gmsh.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

import basix.ufl
import dolfinx.mesh
import ufl
from dolfinx.graph import adjacencylist
from dolfinx.io.utils import distribute_entity_data

from extrusion.errors import InputError
from extrusion.interrupt import interrupted_after
from extrusion.profile import SSNV504, Array, Edge, Profile

Indices = npt.NDArray[np.int64]

FACETS = {
    "side": "billet",
    "front": "billet",
    "rear": "billet",
    "axis": "billet",
    "bore": "die",
    "cone": "die",
    "fixed": "die",
    "die_axis": "die",
}
"""Facet groups and the body each belongs to."""

TAGS = {name: i for i, name in enumerate(("billet", "die", *FACETS), start=1)}
"""Number of every cell and facet group in mesh tags and MSH files."""

ALIASES = {
    "lopin": "billet",
    "filiere": "die",
    "sesc1": "side",
    "sesc2": "front",
    "lmn": "rear",
    "lnk": "axis",
    "smai1": "bore",
    "smai2": "cone",
    "lja": "fixed",
    "lij": "fixed",
    "lhi": "fixed",
    "lgh": "die_axis",
}
"""Names of the published MED meshes, lower case."""

SOLID = ("hexahedron", "wedge", "tetra", "pyramid")
"""How meshio's names of cells in three dimensions begin."""

BUNDLED_SIZES = (8.0, 4.0, 2.0, 1.0)
"""Sizes h (mm) of the graded meshes of SSNV504 that are shipped."""

SSNV504_C = SSNV504.with_divisions(("L", "M", 100), ("N", "K", 100))
"""SSNV504 with the divisions of modelisation C's mesh."""


@dataclass(frozen=True)
class PlainMesh:
    """Triangles in the (r, y) half-plane, on one rank. Make it with `plain_mesh`, which checks it.

    Attributes:
        points: Nodes, ``shape=(n, 2)``, mm; every one is used by a cell.
        cells: Triangles of each body, counter-clockwise, ``shape=(m, 3)``.
        facets: Boundary edges of each group, ``shape=(f, 2)``; groups without edges are absent.
    """

    points: Array
    cells: Mapping[str, Indices]
    facets: Mapping[str, Indices]


@dataclass(frozen=True)
class TaggedMesh:
    """A distributed mesh; ``cell_tags.find(groups["billet"])`` are the billet's cells on this rank."""

    msh: dolfinx.mesh.Mesh
    cell_tags: dolfinx.mesh.MeshTags
    facet_tags: dolfinx.mesh.MeshTags
    groups: dict[str, int]


def plain_mesh(
    points: npt.ArrayLike,
    cells: Mapping[str, npt.ArrayLike],
    facets: Mapping[str, npt.ArrayLike],
    origin: str = "mesh",
) -> PlainMesh:
    """Checked mesh: unused nodes and empty groups dropped, triangles turned counter-clockwise.

    Args:
        points: Nodes, ``shape=(n, 2)``, mm.
        cells: Triangles of each body, ``shape=(m, 3)``.
        facets: Edges of each facet group, ``shape=(f, 2)``.
        origin: What error messages call the mesh, say its file.

    Raises:
        InputError: If a node is not finite or has r < 0, a triangle has no area, triangles overlap, bodies
            share nodes, a facet is no boundary edge of its body, or two groups share a facet.
    """

    def refuse(what: str) -> InputError:
        return InputError("mesh", origin, what)

    x, bodies, groups, used = checked_nodes(points, cells, facets, FACETS, {"triangles": 3, "edges": 2}, refuse)
    if np.min(x[used, 0]) < -1e-9 * np.max(np.abs(x[used])):
        raise refuse(f"has a node at r = {np.min(x[used, 0]):g}; r is the first coordinate and r >= 0")

    for name, triangles in bodies.items():
        a, b, c = (x[triangles[:, i]] for i in range(3))
        area = _area(a, b, c)
        longest = np.max([np.sum((p - q) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
        if (flat := np.flatnonzero(np.abs(area) <= 1e-10 * longest)).size:
            where = tuple(float(v) for v in x[triangles[flat[0], 0]])
            raise refuse(f"has a triangle without area in {name} at {where}; mesh it again")
        triangles[area < 0] = triangles[area < 0][:, ::-1]
        directed = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        if len(np.unique(directed, axis=0)) < len(directed):  # a neighbour runs along an edge the other way
            raise refuse(f"has triangles that overlap in {name}; mesh it again")

    taken: set[tuple[int, ...]] = set()
    for name, edges in groups.items():
        boundary = _boundary(bodies.get(FACETS[name], np.empty((0, 3), dtype=np.int64)))
        for edge in map(tuple, np.sort(edges, axis=1).tolist()):
            which = f"an edge of group {name} between nodes {edge[0]} and {edge[1]}"
            if edge not in boundary:
                raise refuse(f"has {which} that is no boundary edge of the {FACETS[name]}")
            if edge in taken:
                raise refuse(f"has {which} that is in the group twice, or in another one")
            taken.add(edge)

    new = np.full(len(x), -1)
    new[used] = np.arange(len(used))
    return PlainMesh(x[used], {k: new[c] for k, c in bodies.items()}, {k: new[f] for k, f in groups.items()})


def checked_nodes(
    points: npt.ArrayLike,
    cells: Mapping[str, npt.ArrayLike],
    facets: Mapping[str, npt.ArrayLike],
    known: Mapping[str, str],
    widths: Mapping[str, int],
    refuse: Callable[[str], InputError],
) -> tuple[Array, dict[str, Indices], dict[str, Indices], Indices]:
    """Nodes, cells of each body and facets of each group as arrays, empty groups dropped; and which nodes are used.

    Args:
        points: Nodes, mm.
        cells: Cells of each body.
        facets: Facets of each group.
        known: Facet groups that there can be.
        widths: What cells and facets are called, and how many nodes they have.
        refuse: Makes the error.

    Raises:
        InputError: A group is unknown, there are no cells, a node is missing or not finite, or bodies share nodes.
    """
    (kind, of_cell), (_, of_facet) = widths.items()
    x = np.array(points, dtype=float)
    bodies = {name: np.array(c, dtype=np.int64).reshape(-1, of_cell) for name, c in cells.items()}
    groups = {name: np.array(f, dtype=np.int64).reshape(-1, of_facet) for name, f in facets.items()}
    bodies, groups = ({k: v for k, v in d.items() if len(v)} for d in (bodies, groups))
    for allowed, given in ((("billet", "die"), bodies), (known, groups)):
        for name in given:
            if name not in allowed:
                raise refuse(f"has an unknown group {name!r}; groups are {', '.join(allowed)}")
    if not bodies:
        raise refuse(f"has no {kind} in a group billet or die")
    used = np.unique(np.concatenate([c.ravel() for c in bodies.values()]))
    if used[0] < 0 or used[-1] >= len(x):
        raise refuse(f"has {len(x)} nodes, but a cell of nodes {used[0]} to {used[-1]}")
    if not np.all(np.isfinite(x[used])):
        raise refuse("has nodes that are not finite; mesh it again")
    if len(bodies) == 2 and np.intersect1d(bodies["billet"], bodies["die"]).size:
        raise refuse("has nodes that belong to billet and die; mesh the bodies apart")
    return x, bodies, groups, used


def _area(a: Array, b: Array, c: Array) -> Array:
    """Signed areas of triangles, positive counter-clockwise."""
    u, v = b - a, c - a
    area: Array = 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    return area


def _boundary(triangles: Indices) -> set[tuple[int, ...]]:
    """Edges (sorted node pairs) of exactly one triangle."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    return set(map(tuple, edges[count == 1].tolist()))


def case_mesh(profile: Profile, size: float | None = None) -> PlainMesh:
    """The bundled mesh of a profile if there is one, else the one gmsh makes.

    Args:
        profile: The scene.
        size: Element size h of a graded mesh, mm; without it the profile's divisions count.
    """
    mesh = bundled(profile, size)
    if mesh is None:
        mesh = sheet_mesh(profile) if size is None else graded_mesh(profile, size)
    return mesh


def bundled(profile: Profile, size: float | None = None) -> PlainMesh | None:
    """The mesh shipped for this profile and size, or None; gmsh is not needed."""
    path = bundled_path(profile, size)
    return read_mesh(path) if path is not None and path.exists() else None


def bundled_path(profile: Profile, size: float | None = None) -> Path | None:
    """Where the mesh of this profile and size is shipped, None if it is not."""
    folder = Path(__file__).parent / "meshes"
    if dataclasses.replace(profile, divisions=()) != dataclasses.replace(SSNV504, divisions=()):
        return None
    if size is not None:
        return folder / f"ssnv504_{size:g}.msh" if size in BUNDLED_SIZES else None
    for name, published in (("ssnv504", SSNV504), ("ssnv504_c", SSNV504_C)):
        if _divisions(profile) == _divisions(published):
            return folder / f"{name}.msh"
    return None


def _divisions(profile: Profile) -> dict[frozenset[str], int]:
    return {frozenset((a, b)): n for a, b, n in profile.divisions}


def sheet_mesh(profile: Profile) -> PlainMesh:
    """Mesh with the profile's divisions: the billet as the sheet cuts it, the die by gmsh.

    The billet is a grid of equal rectangles, each cut in two: by ``\\`` in the row at the rear face, then by
    ``/`` and ``\\`` alternating row by row. The sheet's figures depend on that pattern.

    Raises:
        InputError: If an edge has no divisions, opposite billet edges differ in them, or gmsh is missing.
    """
    for (a, b), (c, d) in (profile.billet_edges[0::2], profile.billet_edges[1::2]):
        if profile.division(a, b) != profile.division(c, d):
            raise InputError("profile.divisions", profile.divisions, f"cut {a}-{b} and {c}-{d} alike")
    columns, rows = profile.division("M", "N"), profile.division("L", "M")
    r, y = np.linspace(0, profile.radius, columns + 1), np.linspace(0, profile.length, rows + 1)
    points = np.column_stack([np.tile(r, rows + 1), np.repeat(y, columns + 1)])
    node = np.arange(len(points)).reshape(rows + 1, columns + 1)  # node[j, i] at (r[i], y[j])
    n, m, l, k = (c.ravel() for c in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))  # noqa: E741
    down = np.repeat(np.arange(rows) % 2 == 0, columns)  # the diagonal \ runs from k to m, / from n to l
    cells = np.where(
        down[:, None, None],
        np.stack([np.column_stack([n, m, k]), np.column_stack([m, l, k])], axis=1),
        np.stack([np.column_stack([n, m, l]), np.column_stack([n, l, k])], axis=1),
    ).reshape(-1, 3)
    lines = {"rear": node[0], "side": node[:, -1], "front": node[-1], "axis": node[:, 0]}
    billet = _Part(points, cells, {g: np.column_stack([p[:-1], p[1:]]) for g, p in lines.items()})
    divisions = [profile.division(a, b) for a, b in profile.die_edges]
    outline = sum(float(np.linalg.norm(np.diff(profile.curve(e), axis=0))) for e in profile.die_edges)
    inside = 1.13 * outline / sum(divisions)  # gives the 234 nodes of the published die
    with _gmsh() as gmsh:
        die = _triangulate(gmsh, profile, profile.die_edges, lambda r, y: inside, divisions)
    return _join(billet, die)


def grid(r: Array, y: Array, first: int = 0) -> tuple[Array, Indices, dict[str, Indices]]:
    """Nodes, triangles and sides (bottom, right, top, left) of a rectangle cut at r and y, numbered from ``first``."""
    node = first + np.arange(len(y) * len(r)).reshape(len(y), len(r))
    a, b, c, d = (n.ravel() for n in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
    lines = {"bottom": node[0], "right": node[:, -1], "top": node[-1], "left": node[:, 0]}
    return (
        np.stack(np.meshgrid(r, y), axis=-1).reshape(-1, 2),
        np.vstack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]),
        {side: np.stack([line[:-1], line[1:]], axis=1) for side, line in lines.items()},
    )


MOST_FACETS = 5000
"""Facets along the billet's side, at most."""


def graded_mesh(profile: Profile, size: float) -> PlainMesh:
    """Mesh of element size h = `size` (mm) that is fine where contact is, by gmsh.

    Billet: h on side and front, 0.15 h at K, 0.05 h at L, where the pressure is singular when L is held on the
    cone. Die: 2 h along bore and cone, 0.2 h at their vertices but the entry. From there sizes grow with the
    distance: by 1.5 sqrt(h / radius) in the billet, so that its inside is refined with h, and twice as fast in the
    die, which is stiff: at h = 1 that costs 5e-5 of the die's strain energy, itself a small part of the whole.

    Raises:
        InputError: If the size is not within radius/1000 (or length/`MOST_FACETS`) and radius, or gmsh is missing.
    """
    if isinstance(size, bool) or not isinstance(size, int | float) or not math.isfinite(size):
        raise InputError("size", size, "give the element size as a number, mm")
    least, most = max(profile.radius / 1000, profile.length / MOST_FACETS), profile.radius
    if not least <= size <= most:
        raise InputError("size", size, f"give an element size between {least:g} and {most:g} mm")
    edges = profile.edges
    contact = edges["bore"] + edges["cone"]
    growth = min(1.5 * math.sqrt(size / profile.radius), 0.5)
    in_billet = [(edges["side"] + edges["front"], size), ((("K", "K"),), 0.15 * size), ((("L", "L"),), 0.05 * size)]
    in_die = [(contact, 2 * size), (tuple((v, v) for _, v in contact), 0.2 * size)]
    return sized_mesh(profile, _size(profile, in_billet, growth), _size(profile, in_die, 2 * growth))


def sized_mesh(
    profile: Profile, billet: Callable[[float, float], float], die: Callable[[float, float], float]
) -> PlainMesh:
    """Mesh of a profile by gmsh, with a given element size at (r, y) in each body, mm.

    Raises:
        InputError: If gmsh is missing, or cannot mesh the outline.
    """
    with _gmsh() as gmsh:
        return _join(
            _triangulate(gmsh, profile, profile.billet_edges, billet),
            _triangulate(gmsh, profile, profile.die_edges, die),
        )


def _size(
    profile: Profile, fine: Sequence[tuple[Sequence[Edge], float]], growth: float
) -> Callable[[float, float], float]:
    """Element size at (r, y): given on edges (and on points p, as edges p-p), growing away from them."""
    ends = [(profile.curve(e), h) for edges, h in fine for e in edges]
    a, b = np.array([e[0] for e, _ in ends]), np.array([e[1] for e, _ in ends])
    h, d = np.array([h for _, h in ends]), b - a
    dd = np.maximum(np.sum(d * d, axis=1), np.finfo(float).tiny)

    def size(r: float, y: float) -> float:
        x = np.array([r, y])
        s = np.clip(np.sum((x - a) * d, axis=1) / dd, 0, 1)
        distance = np.linalg.norm(x - a - s[:, None] * d, axis=1)
        return float(np.min(h + growth * distance))

    return size


@dataclass(frozen=True)
class _Part:
    """One body: nodes, triangles, and the facets of each group."""

    points: Array
    cells: Indices
    facets: dict[str, Indices]


def _join(billet: _Part, die: _Part) -> PlainMesh:
    n = len(billet.points)
    return plain_mesh(
        np.vstack([billet.points, die.points]),
        {"billet": billet.cells, "die": die.cells + n},
        billet.facets | {name: f + n for name, f in die.facets.items()},
    )


@contextmanager
def _gmsh() -> Iterator[Any]:
    """A quiet gmsh session that leaves signal handlers and configuration files alone."""
    try:
        import gmsh
    except ImportError:
        raise InputError(
            "gmsh", "not installed", "pip install gmsh; the bundled meshes are of SSNV504's profile alone"
        ) from None
    except OSError as error:
        packages = "libglu1-mesa libgl1 libxcursor1 libxinerama1 libxft2 libgomp1"
        raise InputError("gmsh", str(error), f"apt-get install {packages}") from None
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)
        yield gmsh
    finally:
        gmsh.finalize()


def _triangulate(
    gmsh: Any,
    profile: Profile,
    polygon: Sequence[Edge],
    size: Callable[[float, float], float],
    divisions: Sequence[int] = (),
) -> _Part:
    """Triangles in a closed polygon.

    Args:
        gmsh: The open session.
        profile: Where the polygon's points are, and which facet group each edge belongs to.
        polygon: Its edges in order.
        size: The element size at (r, y), mm.
        divisions: How many equal parts to cut each edge in; without them edges too go by `size`.
    """
    gmsh.model.add("body")
    geo, mesh = gmsh.model.geo, gmsh.model.mesh
    corner = {a: geo.addPoint(*profile.points[a], 0) for a, _ in polygon}
    line = {edge: geo.addLine(corner[edge[0]], corner[edge[1]]) for edge in polygon}
    surface = geo.addPlaneSurface([geo.addCurveLoop(list(line.values()))])
    geo.synchronize()
    for edge, n in zip(polygon, divisions, strict=False):
        mesh.setTransfiniteCurve(line[edge], n + 1)
    for option in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
        gmsh.option.setNumber(f"Mesh.{option}", 0)
    gmsh.option.setNumber("Mesh.Algorithm", 6)  # frontal Delaunay
    try:
        with interrupted_after() as interrupted:
            mesh.setSizeCallback(lambda dim, tag, x, y, z, lc: lc if interrupted else size(x, y))
            mesh.generate(2)
    except Exception as error:  # gmsh raises nothing narrower
        names = "-".join(a for a, _ in polygon)
        raise InputError("profile", names, f"gmsh could not mesh this outline: {error}") from None

    tags, x, _ = mesh.getNodes()
    order = np.argsort(tags)

    def local(kind: int, entity: int, width: int) -> Indices:
        nodes = mesh.getElementsByType(kind, entity)[1].reshape(-1, width)
        return order[np.searchsorted(tags, nodes, sorter=order)]

    groups = {frozenset(e): name for name, edges in profile.edges.items() for e in edges}
    facets: dict[str, list[Indices]] = {}
    for edge in polygon:
        if name := groups.get(frozenset(edge)):
            facets.setdefault(name, []).append(local(1, line[edge], 2))
    part = _Part(x.reshape(-1, 3)[:, :2].copy(), local(2, surface, 3), {k: np.vstack(f) for k, f in facets.items()})
    gmsh.model.remove()
    return part


def read_mesh(path: str | Path, needed: Sequence[str] = ()) -> PlainMesh:
    """Mesh from a ``.msh`` or ``.med`` file.

    Groups go by our names or by those of the published meshes (`ALIASES`), upper or lower case; other groups,
    and what is in no group, are left out. Quadratic triangles are reduced to their vertices.

    Args:
        path: The file.
        needed: Groups that must be there besides billet, side, rear and axis.

    Raises:
        InputError: If the file cannot be read, has other cells than triangles, lacks a group, or is refused
            by `plain_mesh`.
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

    if any(block.type.startswith(SOLID) for block in raw.cells):
        raise refuse("is a mesh in three dimensions: give one of triangles in (r, y), or space = '3d'")
    points = np.asarray(raw.points, dtype=float)
    found: dict[str, list[Indices]] = {}
    for name, kind, cells in named:
        group = ALIASES.get(name.lower(), name.lower())
        if group in FACETS and kind in ("line", "line3"):
            found.setdefault(group, []).append(cells[:, :2])
        elif group in ("billet", "die"):
            if kind not in ("triangle", "triangle6"):
                raise refuse(f"group {name} holds {kind} cells; give triangles of the (r, y) plane")
            found.setdefault(group, []).append(cells[:, :3])
    groups = {name: np.unique(np.sort(np.vstack(c), axis=1), axis=0) for name, c in found.items()}
    for group in ("billet", "side", "rear", "axis", *needed):
        if group not in groups:
            present = ", ".join(sorted({name for name, _, _ in named})) or "none"
            raise refuse(f"has no group {group!r}; groups present: {present}")
    if np.max(np.abs(points[:, 2:]), initial=0) > 1e-9 * np.max(np.abs(points)):
        raise refuse("has nodes off the plane z = 0; give a mesh in (r, y)")
    bodies = {name: c for name, c in groups.items() if name not in FACETS}
    edges = {name: f for name, f in groups.items() if name in FACETS}
    return plain_mesh(points[:, :2], bodies, edges, origin=str(path))


def named_cells(raw: Any) -> Iterator[tuple[str, str, Indices]]:
    """(group, cell type, connectivity) of a meshio mesh, once for every group and block of cells."""
    for i, block in enumerate(raw.cells):
        data = np.ascontiguousarray(block.data, dtype=np.int64)
        chosen: dict[str, npt.NDArray[Any]] = {}
        if "cell_tags" in raw.cell_data:  # MED: a family (negative tag) is a set of groups
            tags = np.asarray(raw.cell_data["cell_tags"][i])
            names = {name for family in raw.cell_tags.values() for name in family}
            chosen = {n: np.isin(tags, [t for t, f in raw.cell_tags.items() if n in f]) for n in names}
        elif "gmsh:physical" in raw.cell_data:
            tags = np.asarray(raw.cell_data["gmsh:physical"][i])
            dim = 3 if block.type.startswith(SOLID) else {"vertex": 0, "line": 1, "line3": 1}.get(block.type, 2)
            chosen = {n: tags == tag for n, (tag, d) in raw.field_data.items() if d == dim}
        for name, sets in raw.cell_sets.items():  # MSH 4.1: an entity may be in several groups
            if not name.startswith("gmsh:") and sets[i] is not None:
                chosen[name] = np.isin(np.arange(len(data)), sets[i])
        for name, mask in sorted(chosen.items()):
            if np.any(mask):
                yield name, block.type, data[mask]


def write_mesh(path: str | Path, mesh: PlainMesh) -> None:
    """Write MSH 2.2 in ASCII with physical names; `read_mesh` gives the same coordinates back.

    Raises:
        InputError: If the name does not end in .msh, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".msh":
        raise InputError("mesh", str(path), "give a name that ends in .msh")
    groups = [(2, *c) for c in mesh.cells.items()] + [(1, *f) for f in mesh.facets.items()]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", str(len(groups))]
    lines += [f'{dim} {TAGS[name]} "{name}"' for dim, name, _ in groups]
    lines += ["$EndPhysicalNames", "$Nodes", str(len(mesh.points))]
    lines += [f"{i} {r!r} {y!r} 0" for i, (r, y) in enumerate(mesh.points.tolist(), start=1)]
    lines += ["$EndNodes", "$Elements", str(sum(len(e) for _, _, e in groups))]
    elements = ((dim, TAGS[name], nodes) for dim, name, e in groups for nodes in (e + 1).tolist())
    for i, (dim, tag, nodes) in enumerate(elements, start=1):
        lines.append(f"{i} {dim} 2 {tag} {tag} " + " ".join(map(str, nodes)))
    lines.append("$EndElements\n")
    try:
        path.write_text("\n".join(lines), encoding="ascii")
    except OSError as error:
        raise InputError("mesh", str(path), f"cannot be written: {error.strerror}") from None


def check_profile(mesh: PlainMesh, profile: Profile) -> None:
    """Check that every facet group of a mesh covers its edges of the profile, to 1e-6 of the radius.

    So the billet's corners and the die's vertices are nodes, and no facet cuts a corner.

    Raises:
        InputError: If a facet lies off the profile's edges, or the facets leave a part of them out.
    """
    tolerance = 1e-6 * profile.radius
    for group, facets in mesh.facets.items():
        if not profile.edges[group]:
            raise InputError("mesh", group, "the profile has no such edge; leave the group out")
        ends = np.array([profile.curve(e) for e in profile.edges[group]]).reshape(-1, 1, 1, 2, 2)
        a, d = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
        x = mesh.points[facets]  # (facet, end, 2); distances have shape (edge, facet, end)
        s = np.clip(np.sum((x - a) * d, axis=-1) / np.sum(d * d, axis=-1), 0, 1)
        distance = np.linalg.norm(x - a - s[..., None] * d, axis=-1)
        off = np.min(np.max(distance, axis=2), axis=0)
        edges = ", ".join(f"{p}-{q}" for p, q in profile.edges[group])
        if np.any(off > tolerance):
            at = tuple(round(v, 6) for v in np.mean(x[np.argmax(off)], axis=0).tolist())
            raise InputError("mesh", f"{group} at {at}", f"lies off the profile's {edges} (both in mm)")
        covered = np.sum(np.linalg.norm(x[:, 1] - x[:, 0], axis=1))
        missing = float(np.sum(np.linalg.norm(d, axis=-1)) - covered)
        if abs(missing) > tolerance * (len(facets) + 1):
            raise InputError("mesh", group, f"{missing:.6g} mm of the profile's {edges} is missing")


def on_root[T](comm: MPI.Comm, make: Callable[[], T]) -> T | None:
    """What `make` gives on rank 0, None elsewhere; its InputError is raised on every rank. Collective."""
    value, error = None, None
    if comm.rank == 0:
        try:
            value = make()
        except InputError as e:
            error = (e.field, e.value, e.remedy)
    if (error := comm.bcast(error, root=0)) is not None:
        raise InputError(*error)
    return value


def distribute(comm: MPI.Comm, mesh: PlainMesh | None, bodies: Sequence[str] = ("billet", "die")) -> TaggedMesh:
    """DOLFINx mesh of some bodies, with tagged cells and facets. Collective.

    Args:
        comm: The ranks to spread the cells over.
        mesh: The mesh on rank 0; not looked at elsewhere.
        bodies: Which bodies to take; facet groups of the others, and their nodes, are dropped.

    Raises:
        InputError: On every rank, if a body is missing or there are more ranks than cells.
    """

    def taken() -> tuple[PlainMesh, Indices, npt.NDArray[np.int32], Indices, npt.NDArray[np.int32]]:
        if mesh is None:
            raise InputError("mesh", None, "give rank 0 a mesh")
        for body in bodies:
            if body not in mesh.cells:
                raise InputError("mesh", body, f"has no such body; it has {', '.join(mesh.cells)}")
        cells = {body: mesh.cells[body] for body in bodies}
        part = plain_mesh(mesh.points, cells, {k: f for k, f in mesh.facets.items() if FACETS[k] in bodies})
        if (count := sum(map(len, part.cells.values()))) < comm.size:
            raise InputError("ranks", comm.size, f"the mesh has {count} cells only; use fewer ranks")
        return part, *_tagged(part.cells, 3), *_tagged(part.facets, 2)

    none = np.empty(0, dtype=np.int32)
    part, cells, cell_values, facets, facet_values = on_root(comm, taken) or (
        PlainMesh(np.empty((0, 2)), {}, {}),
        *(np.empty((0, 3), dtype=np.int64), none),
        *(np.empty((0, 2), dtype=np.int64), none),
    )
    names = comm.bcast((*part.cells, *part.facets), root=0)
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(2,))
    msh = dolfinx.mesh.create_mesh(comm, cells, ufl.Mesh(element), part.points)
    tags = []
    for dim, nodes, values in ((2, cells, cell_values), (1, facets, facet_values)):
        entities, local = distribute_entity_data(msh, dim, nodes, values)
        msh.topology.create_connectivity(dim, 2)
        tags.append(dolfinx.mesh.meshtags_from_entities(msh, dim, adjacencylist(entities), local))
    return TaggedMesh(msh, tags[0], tags[1], {name: TAGS[name] for name in names})


def _tagged(groups: Mapping[str, Indices], width: int) -> tuple[Indices, npt.NDArray[np.int32]]:
    """All entities of some groups, and the tag of each."""
    nodes = np.vstack([np.empty((0, width), dtype=np.int64), *groups.values()])
    tags = np.repeat([TAGS[name] for name in groups], [len(e) for e in groups.values()])
    return nodes, tags.astype(np.int32)
