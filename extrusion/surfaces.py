"""Tagged boundary curves of a distributed mesh, gathered whole on every rank (they are tiny)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

import basix

from extrusion.gap import Array, Index, Surface
from extrusion.gap3d import Facets, places


@dataclass(frozen=True)
class Trace:
    """Facets of one group with the cells behind them, in order along the curve, numbered as the function space is."""

    X: Array  # (m, k, 2)
    nodes: Index  # (m, k) global blocked dofs: start, end(, middle)
    cell_nodes: Index  # (m, K)
    local: Index  # (m, k)
    cell_X: Array  # (m, 3, 2)
    facet_vertices: Index  # (m, 2)
    side: float
    tabulate: Any
    pressures: Index  # (m, 3) global pressure dofs of the cells; (m, 0) without a pressure space

    def surface(self, numbers: Index, with_cells: bool, pressure_cols: Index | None = None) -> Surface:
        """The same facets numbered by place in ``numbers`` (sorted global dofs).

        Args:
            numbers: Sorted global blocked dofs that z holds.
            with_cells: Take the cells behind the facets too.
            pressure_cols: Where z holds the cells' pressures, if it does.
        """
        cell_nodes, local = self.cell_nodes, self.local
        if not with_cells:
            cell_nodes, local = self.nodes, np.broadcast_to(np.arange(self.nodes.shape[1]), self.nodes.shape)
        return Surface(
            self.X,
            np.searchsorted(numbers, self.nodes),
            np.searchsorted(numbers, cell_nodes),
            local,
            self.cell_X,
            self.facet_vertices,
            self.side,
            self.tabulate,
            pressure_cols,
        )


def gather_trace(V: Any, facets: Index, base: int, Q: Any = None) -> Trace:
    """The facets of one boundary curve on every rank, in order of growing coordinate ``base``.

    Args:
        V: Vector Lagrange space of order 1 or 2 on straight triangles.
        facets: This rank's exterior facets of the curve (ghosts allowed).
        base: Coordinate along which the curve is ordered, 0 or 1.
        Q: Linear pressure space on the same mesh, if any.

    Raises:
        ValueError: The facets are no single open curve.
    """
    msh, tdim = V.mesh, V.mesh.topology.dim
    for pair in ((tdim - 1, tdim), (tdim, tdim - 1)):
        msh.topology.create_connectivity(*pair)
    to_cell, to_facet = (msh.topology.connectivity(*pair) for pair in ((tdim - 1, tdim), (tdim, tdim - 1)))
    owned = msh.topology.index_map(tdim).size_local
    layout, dofmap = V.dofmap.dof_layout, V.dofmap
    node_x = V.tabulate_dof_coordinates()
    rows = []
    for facet in facets:
        cell = to_cell.links(facet)[0]
        if cell >= owned:
            continue
        number = int(np.flatnonzero(to_facet.links(cell) == facet)[0])
        local = np.sort(layout.entity_closure_dofs(tdim - 1, number))
        dofs = dofmap.cell_dofs(cell)
        vertices = msh.geometry.x[msh.geometry.dofmaps[0][cell]][:3, :2]
        start, end = (i for i in range(3) if i != number)
        inward = vertices[number] - vertices[start]
        t = vertices[end] - vertices[start]
        if t[0] * inward[1] - t[1] * inward[0] < 0:  # the body lies to the left
            start, end = end, start
            local[:2] = local[1::-1]
        nodes = dofs[local]
        pressures = _global(Q.dofmap, Q.dofmap.cell_dofs(cell)) if Q is not None else np.zeros(0, dtype=np.int64)
        at = _global(dofmap, nodes), _global(dofmap, dofs)
        rows.append((node_x[nodes][:, :2], *at, local, vertices, (start, end), pressures))
    gathered = [row for part in msh.comm.allgather(rows) for row in part]
    columns = [np.array(column) for column in zip(*gathered, strict=True)]
    order = _chain(columns[1][:, :2])
    side = 1.0
    X, nodes, cell_nodes, local, cell_X, ends, pressures = (column[order] for column in columns)
    if X[-1, 1, base] < X[0, 0, base]:
        swap, side = [1, 0, *range(2, nodes.shape[1])], -1.0
        X, nodes, local, ends = X[::-1, swap], nodes[::-1, swap], local[::-1, swap], ends[::-1, ::-1]
        cell_nodes, cell_X, pressures = cell_nodes[::-1], cell_X[::-1], pressures[::-1]
    return Trace(X, nodes, cell_nodes, local, cell_X, ends, side, _tabulator(V.element.basix_element), pressures)


@dataclass(frozen=True)
class FaceTrace:
    """Quadrilateral facets of one group with the cells behind them, numbered as the function space is (`Facets`)."""

    X: Array  # (m, k, 3)
    nodes: Index  # (m, k) global blocked dofs, in the order of `places`
    cell_nodes: Index  # (m, K)
    local: Index  # (m, k)
    frame: Array  # (m, 3, 3)
    cell_X: Array  # (m, Kg, 3)
    side: Array  # (m,)
    pressures: Index  # (m, 8) global pressure dofs of the cells; (m, 0) without a pressure space
    tabulate: Any
    tabulate_geometry: Any

    def surface(self, numbers: Index, with_cells: bool, pressure_cols: Index | None = None) -> Facets:
        """The same facets numbered by place in ``numbers``, as `Trace.surface`."""
        cell_nodes, local = self.cell_nodes, self.local
        if not with_cells:
            cell_nodes, local = self.nodes, np.broadcast_to(np.arange(self.nodes.shape[1]), self.nodes.shape)
        return Facets(
            self.X, np.searchsorted(numbers, self.nodes), np.searchsorted(numbers, cell_nodes), local, self.frame,
            self.cell_X, self.side, self.tabulate, self.tabulate_geometry, pressure_cols,
        )  # fmt: skip


CUBE = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=float)
"""Vertices of the reference hexahedron."""


def gather_faces(V: Any, facets: Index, base: int, Q: Any = None) -> FaceTrace:
    """The facets of one boundary surface on every rank, in order along the meridian, then by azimuth.

    Args:
        V: Vector space on hexahedra whose dofs are values at nodes.
        facets: This rank's exterior facets of the surface (ghosts allowed).
        base: What grows along the facets' s: 1 for y, 0 for the radius.
        Q: Linear pressure space on the same mesh, if any.

    Raises:
        ValueError: There are none.
    """
    msh, tdim = V.mesh, V.mesh.topology.dim
    for pair in ((tdim - 1, tdim), (tdim, tdim - 1)):
        msh.topology.create_connectivity(*pair)
    to_cell, to_facet = (msh.topology.connectivity(*pair) for pair in ((tdim - 1, tdim), (tdim, tdim - 1)))
    owned = msh.topology.index_map(tdim).size_local
    facets = np.asarray(facets, dtype=np.int64)
    cells = to_cell.array[to_cell.offsets[facets]]
    facets, cells = facets[cells < owned], cells[cells < owned]
    number = np.argmax(to_facet.array.reshape(-1, 6)[cells] == facets[:, None], axis=1)
    faces = np.array(basix.topology(basix.CellType.hexahedron)[2])  # (6, 4) vertices
    geometry = basix.create_element(
        basix.ElementFamily.P, basix.CellType.hexahedron, msh.geometry.cmaps[0].degree, basix.LagrangeVariant.gll_warped
    )
    cell_X = msh.geometry.x[msh.geometry.dofmaps[0][cells]]
    corner_X = np.einsum("vk,mki->mvi", geometry.tabulate(0, CUBE)[0, ..., 0], cell_X)
    # of the eight ways to lay s and t on the face, the one along which the base and the azimuth grow most
    ways = np.array([[0, 1, 2], [1, 0, 3], [2, 3, 0], [3, 2, 1], [0, 2, 1], [2, 0, 3], [1, 3, 0], [3, 1, 2]])
    corners = corner_X[np.arange(len(cells))[:, None], faces[number]] + 0.0  # (m, 4, 3); -0 has another azimuth
    along = corners[..., 1] if base == 1 else np.hypot(corners[..., 0], corners[..., 2])
    radius = np.hypot(corners[..., 0], corners[..., 2]).mean(
        axis=1, keepdims=True
    )  # of the facet: the same on any rank
    angle = np.arctan2(corners[..., 2], corners[..., 0]) * radius
    scale = np.abs(corners - corners.mean(axis=1, keepdims=True)).max(axis=(1, 2))[:, None]
    gain = (along[:, ways[:, 1]] - along[:, ways[:, 0]] + angle[:, ways[:, 2]] - angle[:, ways[:, 0]]) / scale
    chosen = faces[number][np.arange(len(cells))[:, None], ways[np.argmax(np.round(gain, 6), axis=1)]]
    origin, s_end, t_end = (CUBE[chosen[:, i]] for i in range(3))
    frame = np.stack([origin, s_end - origin, t_end - origin], axis=1)
    # which node of the cell lies at which place of the facet
    points = np.asarray(V.element.interpolation_points)
    closure = np.array([np.sort(V.dofmap.dof_layout.entity_closure_dofs(tdim - 1, i)) for i in range(6)])[number]
    at = places(closure.shape[1])
    offset = points[closure] - origin[:, None]
    s, t = (np.einsum("mki,mi->mk", offset, frame[:, i]) for i in (1, 2))
    distance = np.abs(s[:, None] - at[:, 0, None]) + np.abs(t[:, None] - at[:, 1, None])
    local = np.take_along_axis(closure, np.argmin(distance, axis=2), axis=1)
    dofs = V.dofmap.list[cells]
    nodes = np.take_along_axis(dofs, local, axis=1)
    centre = np.einsum("k,mki->mi", geometry.tabulate(0, np.full((1, 3), 0.5))[0, 0, :, 0], cell_X)
    a, b, c = (corner_X[np.arange(len(cells)), chosen[:, i]] for i in range(3))
    outward = np.einsum("mi,mi->m", np.cross(b - a, c - a), corners.mean(axis=1) - centre)
    X = V.tabulate_dof_coordinates()[nodes]
    pressures = np.zeros((len(cells), 0), dtype=np.int64)
    if Q is not None:
        pressures = _global(Q.dofmap, Q.dofmap.list[cells])
    row = (X, _global(V.dofmap, nodes), _global(V.dofmap, dofs), local, frame, cell_X, np.sign(outward), pressures)
    parts = [np.concatenate(part) for part in zip(*msh.comm.allgather(row), strict=True)]
    if not len(parts[0]):
        raise ValueError("the group has no facets")
    middle = parts[0].mean(axis=1)
    size = np.abs(middle).max()
    key = np.round(np.stack([np.arctan2(middle[:, 2], middle[:, 0]), middle[:, 1] / size]), 7)
    if base == 0:
        key = np.round(np.stack([key[0], np.hypot(middle[:, 0], middle[:, 2]) / size]), 7)
    order = np.lexsort(key)
    X, nodes, dofs, local, frame, cell_X, side, pressures = (part[order] for part in parts)
    tabulate = _tabulator(V.element.basix_element)
    return FaceTrace(X, nodes, dofs, local, frame, cell_X, side, pressures, tabulate, _tabulator(geometry))


def _tabulator(element: Any) -> Any:
    def tabulate(derivatives: int, points: Array) -> Array:
        return np.asarray(element.tabulate(derivatives, points)[..., 0])

    return tabulate


def _global(dofmap: Any, nodes: Index) -> Index:
    flat = np.asarray(nodes, dtype=np.int32).ravel()
    return np.asarray(dofmap.index_map.local_to_global(flat)).reshape(np.shape(nodes))


def _chain(ends: Index) -> Index:
    """Order in which facets given by (start, end) follow each other."""
    starts = {int(a): i for i, (a, _) in enumerate(ends)}
    first = set(starts) - {int(b) for b in ends[:, 1]}
    if len(first) != 1 or len(starts) != len(ends):
        raise ValueError("the facets of a contact surface are no single open curve")
    node, order = first.pop(), []
    while node in starts:
        order.append(starts[node])
        node = int(ends[order[-1], 1])
    if len(order) != len(ends):
        raise ValueError("the facets of a contact surface are no single open curve")
    return np.array(order)


def all_ranks(comm: MPI.Intracomm, values: Index) -> Index:
    """Sorted union of every rank's integers."""
    return np.unique(np.concatenate(comm.allgather(np.asarray(values, dtype=np.int64))))
