"""Tagged boundary curves of a distributed mesh, gathered whole on every rank (they are tiny)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from extrusion.gap import Array, Index, Surface


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


def _tabulator(element: Any) -> Any:
    def tabulate(derivatives: int, points: Array) -> Array:
        return np.asarray(element.tabulate(derivatives, points)[..., 0])

    return tabulate


def _global(dofmap: Any, nodes: Index) -> Index:
    return np.asarray(dofmap.index_map.local_to_global(np.asarray(nodes, dtype=np.int32)))


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
