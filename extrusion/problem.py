"""Two bodies, their supports and their contact zones: residual, tangent and reports of one scene.

The unknown x holds, on each rank, the displacement of both bodies in one Lagrange space (one mesh, two unconnected
parts), the billet's pressure if the form is mixed, and, on the last rank, at its end, the multipliers. The bulk
stiffness K is constant; contact adds a few sparse rows, computed from the surfaces, which every rank holds whole, and
of which it keeps those it owns. Each rank finds all contact points, or those of a part of the slave's facets
(`ContactTerm.divide`).
"""

from __future__ import annotations

import logging
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

import basix.ufl
import dolfinx.fem.petsc
import ufl
from dolfinx import fem
from dolfinx.jit import get_options

from extrusion.cases import GAMMA, LOCKING_FROM, MIXED_ABOVE, Case, Zone
from extrusion.compiled import ray
from extrusion.contact import CLOSED_GAP, REFERENCE_NU, stiffness
from extrusion.elasticity import (
    epsilon,
    mixed_virtual_work,
    quadrature_degree,
    serendipity,
    sigma,
    virtual_work,
    von_mises,
)
from extrusion.errors import InputError
from extrusion.gap import Array, Index, polyline
from extrusion.gap3d import Revolved
from extrusion.matrix import TangentMatrix, widened
from extrusion.mesh import PlainMesh, TaggedMesh, check_profile, distribute, on_root
from extrusion.pairs import CurvePair, Pair
from extrusion.pairs3d import COPIES, SurfacePair
from extrusion.surfaces import FaceTrace, Trace, all_ranks, gather_faces, gather_trace
from extrusion.system import System, in_words
from extrusion.zones import ContactTerm, IntegratedContact, MortarContact, NodalContact, Triplets

if TYPE_CHECKING:
    from extrusion.krylov import Krylov
    from extrusion.mesh3d import HexMesh

log = logging.getLogger(__name__)

SAFETY = 32.0
"""How far below the symmetric method's coercive gamma the unsymmetric one (theta = 0) may go."""

STIFF_SLAVE = 5.0
"""How many times stiffer than the billet a die is warned of as slave."""

AXIS = {"r": 0, "y": 1}

PLANES = {2: {"axis": 0, "die_axis": 0}, 3: {"billet_x": 0, "billet_z": 2, "die_x": 0, "die_z": 2}}
"""Facet groups on the axis, or on planes of symmetry, and the component of the displacement that is held there."""

BILLET_POINTS = ("K", "L", "M", "N")
"""Named points of the profile that are the billet's corners; the others are the die's."""


def _warn(case: Case) -> None:
    """Say what of a case is known to do badly."""
    nu, in_space, nodal = case.billet.nu, case.space == "3d", case.method == "nodal"
    if case.order == 1 and nu >= LOCKING_FROM and not in_space and not nodal:
        log.warning("order = 1 at nu = %g: linear triangles lock: pressure and reaction are far off, use order 2", nu)
    if case.order == 1 and in_space and not nodal:
        log.warning("order = 1 in 3D: facets are chords of the circle, and contact holds these: use order 2")
    if case.element == "serendipity" and nodal and any(zone.contact == "unilateral" for zone in case.zones):
        log.warning("20-node hexahedra under nodal pressure: its vertices pull, use nitsche or mortar")
    if case.order == 2 and nu > MIXED_ABOVE and case.method == "nitsche" and not case.mixed:
        log.warning("nitsche in the displacement form at nu = %g: the force is far off, take form = mixed", nu)
    overlap = max(case.overlap(zone) for zone in case.zones)
    if overlap > CLOSED_GAP * case.profile.radius:
        log.warning("the billet stands up to %.3g mm deep in the die at t = 0: an interference fit", overlap)
    leads = any(zone.slave == "billet" and zone.contact != "check" for zone in case.zones)
    if case.die == "elastic" and case.die_material.E < case.billet.E and leads:
        other = " and the method nitsche" if case.method == "mortar" else ""
        log.warning('the die is softer than the billet: let it be slave (slave = "die")%s, or steps fail', other)
    for zone in case.zones:
        if case.method in ("penalty", "nitsche") and zone.slave == "die" and case.contrast(zone) >= STIFF_SLAVE:
            log.warning(
                "zone %s: a die %g times stiffer is slave: forces jump at edges, let the billet be slave "
                '(slave = "billet")',
                zone.name,
                case.contrast(zone),
            )


def _make_cache() -> None:
    """The folder in which DOLFINx keeps its compiled forms."""
    folder = Path(get_options()["cache_dir"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        remedy = f"cannot be made ({error.strerror}): let XDG_CACHE_HOME name another folder"
        raise InputError("cache_dir", str(folder), remedy) from None


class Problem(System):
    """One scene, discretised; x holds all displacements (and pressures and multipliers), each rank its own.

    Args:
        case: The scene.
        mesh: Its mesh on rank 0 (None elsewhere).
        comm: Ranks that share it.
    """

    def __init__(self, case: Case, mesh: PlainMesh | HexMesh | None, comm: MPI.Intracomm = MPI.COMM_WORLD) -> None:
        self.case, self.comm = case, comm
        if comm.rank == 0:
            _warn(case)
        bodies = ("billet", "die") if case.die == "elastic" else ("billet",)
        self.tagged: TaggedMesh = _distributed(case, mesh, comm, bodies)
        self.bodies = bodies
        self.dim = self.tagged.msh.topology.dim
        self.copies = 1 if self.dim == 2 else COPIES
        element = serendipity() if case.element == "serendipity" else None
        shape = (self.dim,)
        self.V = fem.functionspace(
            self.tagged.msh,
            ("Lagrange", case.order, shape) if element is None else basix.ufl.blocked_element(element, shape=shape),
        )
        self.Q = fem.functionspace(self.tagged.msh, ("Lagrange", 1)) if case.mixed else None
        self._materials = {"billet": case.billet, "die": case.die_material}
        on_root(comm, _make_cache)
        self._assemble_bulk()
        self._find_supports()
        if self.dim == 2:
            on_root(comm, ray)  # compiled there, if it has to be, before the other ranks look for it
        self._gather_contact()
        self._lay_out()
        self._krylov: Krylov | None = None
        # in space it takes a factorisation of everything, and the default is known to be safe
        known = self.dim == 3 and case.theta == 0 and case.contact_gamma >= GAMMA["nitsche"]
        if case.method == "nitsche" and case.theta != -1 and not known:
            self._refuse_indefinite()

    # -- bulk ------------------------------------------------------------------------------------------------

    def _assemble_bulk(self) -> None:
        msh, groups = self.tagged.msh, self.tagged.groups
        degree = quadrature_degree(self.case.order, self.case.axisymmetric, self.dim)
        dx = ufl.Measure("dx", msh, subdomain_data=self.tagged.cell_tags, metadata={"quadrature_degree": degree})
        trilinear = self.dim == 3 and self.case.order == 1
        u, v = ufl.TrialFunction(self.V), ufl.TestFunction(self.V)
        form: ufl.Form = 0
        blocks: list[list[ufl.Form]] = []
        for body in self.bodies:
            material = self._materials[body]
            lmbda = fem.Constant(msh, 0.0 if trilinear else material.lmbda)
            mu = fem.Constant(msh, material.mu)
            measure = dx(groups[body])
            if body == "billet" and self.Q is not None:
                p, q = ufl.TrialFunction(self.Q), ufl.TestFunction(self.Q)
                blocks = mixed_virtual_work(u, p, v, q, lmbda, mu, measure, axisymmetric=self.case.axisymmetric)
                form += blocks[0][0]
            else:
                form += virtual_work(u, v, lmbda, mu, measure, axisymmetric=self.case.axisymmetric)
        if blocks:
            blocks[0][0] = form
        self._bulk_form = fem.form(blocks or form)
        self.K = dolfinx.fem.petsc.assemble_matrix(self._bulk_form, kind="mpi" if blocks else None)
        self.K.assemble()
        if trilinear:
            self._add_mean_volume(dx)

    def _add_mean_volume(self, dx: ufl.Measure) -> None:
        """The term in lambda, with the mean of each cell's change of volume: trilinear hexahedra do not lock so.

        ``D^T (lambda / V) D`` with ``D u = int div u`` over each cell. Nagtegaal, Parks, Rice, CMAME 4 (1974) 153,
        doi:10.1016/0045-7825(74)90032-2; Hughes, IJNME 15 (1980) 1413, doi:10.1002/nme.1620150914.
        """
        msh, groups = self.tagged.msh, self.tagged.groups
        DG0 = fem.functionspace(msh, ("DG", 0))
        q, lmbda = ufl.TestFunction(DG0), np.zeros(DG0.dofmap.index_map.size_local + DG0.dofmap.index_map.num_ghosts)
        for body in self.bodies:
            lmbda[self.tagged.cell_tags.find(groups[body])] = self._materials[body].lmbda
        D = dolfinx.fem.petsc.assemble_matrix(fem.form(q * ufl.div(ufl.TrialFunction(self.V)) * dx))
        D.assemble()
        V = dolfinx.fem.petsc.assemble_vector(fem.form(q * dx))
        V.array[:] = np.sqrt(lmbda[: V.local_size] / V.array_r)
        D.diagonalScale(V, None)
        self.K.axpy(1.0, D.transposeMatMult(D))

    def stress_fields(self, x: PETSc.Vec) -> dict[str, fem.Function]:
        """Displacement (mm) and von Mises stress (MPa, one a cell) at x: the same two functions at each call."""
        u, mises, expression = self._fields
        u.x.array[: self._owned] = x.array_r[: self._owned]
        u.x.scatter_forward()
        mises.interpolate(expression)
        return {"displacement": u, "von_mises": mises}

    @cached_property
    def _fields(self) -> tuple[fem.Function, fem.Function, fem.Expression]:
        msh, groups = self.tagged.msh, self.tagged.groups
        u = fem.Function(self.V, name="displacement")
        DG0 = fem.functionspace(msh, ("DG", 0))
        lame = {name: fem.Function(DG0) for name in ("lmbda", "mu")}
        for body in self.bodies:
            cells = self.tagged.cell_tags.find(groups[body])
            for name, f in lame.items():
                f.x.array[cells] = getattr(self._materials[body], name)
        position = ufl.SpatialCoordinate(msh)
        stress = sigma(epsilon(u, position, axisymmetric=self.case.axisymmetric), lame["lmbda"], lame["mu"])
        expression = fem.Expression(von_mises(stress), DG0.element.interpolation_points)
        return u, fem.Function(DG0, name="von_mises"), expression

    # -- supports --------------------------------------------------------------------------------------------

    def _dofs_on(self, group: str) -> np.ndarray:
        """This rank's dof blocks (ghosts included) on a facet group; none where the mesh lacks it."""
        number = self.tagged.groups.get(group)
        if number is None:
            return np.zeros(0, dtype=np.int32)
        msh = self.tagged.msh
        msh.topology.create_connectivity(self.dim - 1, self.dim)
        return fem.locate_dofs_topological(self.V, self.dim - 1, self.tagged.facet_tags.find(number))

    def _find_supports(self) -> None:
        rear, clamped = self._dofs_on("rear"), self._dofs_on("fixed")
        index_map, dim = self.V.dofmap.index_map, self.dim
        self._owned = dim * index_map.size_local

        def own(blocks: np.ndarray, component: int) -> np.ndarray:
            dofs = dim * blocks.astype(np.int64) + component
            return np.unique(dofs[dofs < self._owned])

        self._driven, self._clamped_y = own(rear, 1), own(clamped, 1)
        planes = {group: own(self._dofs_on(group), component) for group, component in PLANES[dim].items()}
        none = np.zeros(0, dtype=np.int64)
        self._shifted = np.concatenate([none, *(dofs for group, dofs in planes.items() if group.startswith("billet_"))])
        held = [self._driven, *(own(clamped, i) for i in range(dim)), *planes.values()]
        self._n_pressures = self._free_pressures = 0
        if self.Q is not None:  # the die has none
            self._n_pressures = self.Q.dofmap.index_map.size_local
            billet = np.unique(self.Q.dofmap.list[self.tagged.cell_tags.find(self.tagged.groups["billet"])])
            held.append(self._owned + np.setdiff1d(np.arange(self._n_pressures), billet))
            self._free_pressures = self._n_pressures - len(held[-1])
        self._held = np.unique(np.concatenate(held))
        self._first_dof = dim * index_map.local_range[0]
        self._first_pressure = self.Q.dofmap.index_map.local_range[0] if self.Q is not None else 0
        billet_blocks = self._blocks_of("billet")
        self._billet_y = own(billet_blocks, 1)
        across = [own(billet_blocks, i) for i in (0, 2)] if self.case.off_symmetry else [none]
        self._billet_across = np.concatenate(across)
        if self.comm.allreduce(len(self._driven)) == 0:
            raise InputError("mesh", "rear", "the group of the pushed face has no facets")

    def _blocks_of(self, body: str) -> np.ndarray:
        cells = self.tagged.cell_tags.find(self.tagged.groups[body])
        return np.unique(self.V.dofmap.list[cells])

    # -- contact ---------------------------------------------------------------------------------------------

    def _gather_contact(self) -> None:
        case, profile = self.case, self.case.profile
        traces: dict[str, Trace | FaceTrace] = {}
        for zone in case.zones:
            for group in (zone.billet, *((zone.die,) if case.die == "elastic" else ())):
                facets = self.tagged.facet_tags.find(self.tagged.groups[group])
                try:
                    gather = gather_trace if self.dim == 2 else gather_faces
                    traces[group] = gather(self.V, facets, 1 - AXIS[zone.ray], self.Q)
                except ValueError as error:
                    raise InputError("mesh", group, str(error)) from None
        needs_cells = {zone.billet if zone.slave == "billet" else zone.die for zone in case.zones}
        if case.method != "nitsche":
            needs_cells = set()
        live = [trace.cell_nodes if g in needs_cells else trace.nodes for g, trace in traces.items()]
        self._live = np.unique(np.concatenate([nodes.ravel() for nodes in live]))
        n = len(self._live)
        surfaces: dict[str, Any] = {}
        if case.die == "rigid":
            for zone in case.zones:
                names = profile.bore if zone.die == "bore" else profile.cone
                curve = profile.curve(names)
                if case.method == "nodal":
                    curve = _subdivide(curve, [profile.division(a, b) for a, b in pairwise(names)])
                base, t = 1 - AXIS[zone.ray], curve[1] - curve[0]
                side = float(np.sign(np.dot([t[1], -t[0]], profile.normals(names)[0])))
                if curve[-1, base] < curve[0, base]:
                    curve, side = curve[::-1], -side
                if self.dim == 3:
                    surfaces[zone.die] = Revolved(curve, side)
                    continue
                surfaces[zone.die] = polyline(curve, n, side)
                n += len(curve)
        self._n_nodes = n
        billet = np.concatenate([trace.cell_nodes.ravel() for g, trace in traces.items() if g in ("side", "front")])
        self.z_in_billet = np.zeros(n, dtype=bool)  # nodes of z
        self.z_in_billet[: len(self._live)] = np.isin(self._live, billet)
        with_pressure = [g for g in needs_cells if self.Q is not None and g in ("side", "front")]
        pressed = [traces[g].pressures.ravel() for g in with_pressure]
        self._live_pressures = np.unique(np.concatenate([*pressed, np.zeros(0, dtype=np.int64)]))
        for group, trace in traces.items():
            cols = None
            if group in with_pressure:
                cols = self.dim * n + np.searchsorted(self._live_pressures, trace.pressures)
            surfaces[group] = trace.surface(self._live, group in needs_cells, cols)
        self.terms: list[ContactTerm] = []
        self._first_multiplier = first = self.dim * n + len(self._live_pressures)
        for zone in case.zones:
            term = self._term(zone, surfaces, first)
            first += term.multipliers
            self.terms.append(term)
        self.n_multipliers = first - self._first_multiplier

    def _term(self, zone: Zone, surfaces: dict[str, Any], first: int) -> ContactTerm:
        case = self.case
        slave, master = surfaces[zone.billet], surfaces[zone.die]
        material, sign = case.billet, 1.0
        if zone.slave == "die":
            slave, master, material, sign = master, slave, case.die_material, -1.0
        # past its ends the die goes on straight, to where another zone takes over; without one a side that passes, and
        # what a glissière holds, is let go (past the cone's ends there is the bore)
        follows = len(case.zones) > 1 or (zone.billet == "front" and zone.contact != "bilateral")
        extended = zone.contact == "check" or follows
        extended &= (zone.slave, zone.billet) != ("die", "side")  # the bore goes on where the billet does not
        common: dict[str, Any] = dict(
            name=zone.name, slave=slave, die=master, axis=AXIS[zone.ray], sign=sign, closure=zone.contact,
            ray=case.along_ray(zone),
            smooth=zone.smooth, extended=extended,
        )  # fmt: skip
        pair: Pair = SurfacePair(**common)
        if self.dim == 2:
            pair = CurvePair(**common, axisymmetric=case.axisymmetric)
        # the displacement form's stress, which Nitsche's term bounds, stiffens towards nu = 1/2; a pressure does not
        nu = material.nu if case.method in ("nitsche", "penalty") and not case.mixed else REFERENCE_NU
        k = stiffness(case.contact_gamma, material.E, nu, pair.lengths)
        rest: tuple[float, bool] = (case.profile.radius, zone.initial == "interpenetrating")
        if case.method == "nodal":
            return NodalContact(pair, first, k, *rest)
        if case.method == "mortar":
            return MortarContact(pair, first, k, *rest)
        return IntegratedContact(pair, k, material if case.method == "nitsche" else None, case.theta, *rest)

    # -- layout of x, and of the contact vector z in it ------------------------------------------------------

    def _lay_out(self) -> None:
        comm, last = self.comm, self.comm.rank == self.comm.size - 1
        self.n_local = self._owned + self._n_pressures + (self.n_multipliers if last else 0)
        self.x = PETSc.Vec().createMPI((self.n_local, PETSc.DETERMINE), comm=comm)
        self.n = self.x.size
        self._row0 = self.x.owner_range[0]
        # where each rank's displacements and pressures begin, in their own spaces and in x
        starts = np.array(comm.allgather((self._first_dof, self._first_pressure, self._row0, self._owned)))

        def in_x(dofs: Index, space: int) -> Index:
            rank = np.searchsorted(starts[:, space], dofs, side="right") - 1
            return np.asarray(dofs - starts[rank, space] + starts[rank, 2] + (starts[rank, 3] if space else 0))

        live = in_x((self.dim * self._live[:, None] + np.arange(self.dim)).ravel(), 0)
        pressures = in_x(self._live_pressures, 1)
        multipliers = self.n - self.n_multipliers + np.arange(self.n_multipliers)
        self.n_z = self._first_multiplier + self.n_multipliers
        self.z_to_x = np.full(self.n_z, -1, dtype=np.int64)
        self.z_to_x[: len(live)] = live
        self.z_to_x[self.dim * self._n_nodes :] = np.concatenate([pressures, multipliers])
        taken = self.z_to_x[self.z_to_x >= 0].astype(PETSc.IntType)
        self._z_live = np.flatnonzero(self.z_to_x >= 0)
        source = PETSc.IS().createGeneral(taken, comm=PETSc.COMM_SELF)
        self._z_vec = PETSc.Vec().createSeq(len(taken))
        self._to_z = PETSc.Scatter().create(self.x, source, self._z_vec, None)
        self.held = held = all_ranks(comm, self._held + self._row0)  # entries of x that the supports prescribe
        self._z_held = np.isin(self.z_to_x, held)
        mine = (self.z_to_x >= self._row0) & (self.z_to_x < self._row0 + self.n_local)
        self._z_mine = np.flatnonzero(mine)
        self._x_mine = self.z_to_x[self._z_mine] - self._row0
        self.z_free = ~self._z_held & (self.z_to_x >= 0)
        self._z_row = mine & self.z_free
        indptr, indices, data = self.K.getValuesCSR()
        self._K_wide = widened(comm, self.n_local, self.n, indptr, indices, data)
        self._K_size = widened(comm, self.n_local, self.n, indptr, indices, np.abs(data))

    def gather(self, x: PETSc.Vec) -> Array:
        """The contact vector z of x, on every rank (collective)."""
        self._to_z.scatter(x, self._z_vec, addv=False, mode="forward")
        z = np.zeros(self.n_z)
        z[self._z_live] = self._z_vec.array_r
        return z

    def drive(self, x: PETSc.Vec, t: float) -> None:
        """Set the supports' values at rear displacement t, mm."""
        values = x.array
        values[self._held] = 0.0
        values[self._shifted] = -self.case.off_symmetry
        values[self._driven] = t

    def shift_billet(self, x: PETSc.Vec, dt: float) -> None:
        """Move the whole billet along y by dt, mm."""
        x.array[self._billet_y] += dt

    def place_billet(self, x: PETSc.Vec) -> None:
        """Move the whole billet across the axis by what it stands off its planes of symmetry."""
        x.array[self._billet_across] -= self.case.off_symmetry

    # -- what the condensed problem asks ---------------------------------------------------------------------

    def bulk(self) -> list[tuple[PETSc.Mat, Index]]:
        """The bulk matrix of each body (no multipliers), identity at the supports; which entries of x are its rows.

        The rows are those of all ranks, in order; each rank holds those of its own.
        """
        A = self.K.copy()
        A.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATIONS, True)  # pressures of the die, held, have no diagonal
        A.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)
        A.zeroRowsColumns((self._held + self._row0).astype(PETSc.IntType), self.K.getDiagonal().max()[1])
        of_billet = np.zeros(self._owned + self._n_pressures, dtype=bool)
        blocks = self._blocks_of("billet")
        blocks = blocks[blocks < self._owned // self.dim]
        of_billet[(self.dim * blocks[:, None].astype(np.int64) + np.arange(self.dim)).ravel()] = True
        of_billet[self._owned :] = True
        out = []
        for mine in (of_billet, ~of_billet):
            rows = np.flatnonzero(mine) + self._row0
            if self.comm.allreduce(len(rows)):
                keep = PETSc.IS().createGeneral(rows.astype(PETSc.IntType), comm=self.comm)
                if self.Q is None:
                    keep.setBlockSize(self.dim)  # multigrid takes a node's unknowns together
                out.append((A.createSubMatrix(keep, keep), np.concatenate(self.comm.allgather(rows))))
                keep.destroy()
        A.destroy()
        self.let_go()
        return out

    def places_of(self, points: dict[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
        """Global entries of x that hold the displacement of points given by rank and local block."""
        first = self.comm.allgather(self._row0)
        at = {name: first[rank] + self.dim * block for name, (rank, block) in points.items()}
        return {name: (entry, entry + 1) for name, entry in at.items()}

    def drive_at(self, entries: Index) -> Array:
        """What entries of x are when the billet is moved along y by 1."""
        moved = all_ranks(self.comm, self._billet_y + self._row0)
        return np.isin(entries, moved).astype(float)

    def start_at(self, entries: Index) -> Array:
        """What entries of x are when the billet is where `place_billet` puts it."""
        moved = all_ranks(self.comm, self._billet_across + self._row0)
        return np.where(np.isin(entries, moved), -self.case.off_symmetry, 0.0)

    def set_displacements(self, values: Array, t: float, multipliers: Array) -> None:
        """Set x to this rank's values with the billet moved along y by t; the supports take their values."""
        self.x.array[:] = values
        self.place_billet(self.x)
        self.shift_billet(self.x, t)
        self.drive(self.x, t)
        if self.comm.rank == self.comm.size - 1:
            self.x.array[self.n_local - self.n_multipliers :] = multipliers

    # -- residual and tangent --------------------------------------------------------------------------------

    def forces(self, x: PETSc.Vec, R: Array | None = None) -> PETSc.Vec:
        """Out-of-balance force of all dofs, N: at the supports their reactions, elsewhere the residual.

        R: `contact_forces`, if they are known.
        """
        f = self._K_wide.createVecLeft()
        self._K_wide.mult(x, f)
        R = self.contact_forces(self.gather(x)) if R is None else R
        f.array[self._x_mine] += R[self._z_mine]
        return f

    def residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """Residual into f, N; zero rows at the supports, whose values x carries already."""
        self._K_wide.mult(x, f)
        try:
            R = self.contact_forces(self.gather(x))
        except ArithmeticError:
            f.set(np.nan)
            return
        self._add_contact(f, R)

    def _add_contact(self, f: PETSc.Vec, R: Array) -> None:
        """Contact's forces onto those of the bulk, and no rows at the supports."""
        values = f.array
        values[self._x_mine] += R[self._z_mine]
        values[self._held] = 0.0

    def tangent(self, x: PETSc.Vec, geometric: bool) -> PETSc.Mat:
        """Derivative of the residual; a new matrix whenever its pattern has grown."""
        z = self.gather(x)
        return self._tangent_of(z, self._triplets(z, geometric))

    def linearised(self, x: PETSc.Vec, f: PETSc.Vec, at: Array) -> PETSc.Mat:
        self._K_wide.mult(x, f)
        try:
            D = self._triplets(at, False)
            self._add_contact(f, self.linear_forces(self.gather(x), at, D))
        except ArithmeticError:
            f.set(np.nan)
            return self.tangent_without_contact()
        return self._tangent_of(at, D)

    def _triplets(self, z: Array, geometric: bool) -> Triplets:
        # with multipliers every rank needs their rows for the Krylov method
        every = self._krylov is not None and self.n_multipliers
        return self.contact_tangent(z, geometric, self.z_free if every else self._z_row, self.z_free)

    def _tangent_of(self, z: Array, D: Triplets) -> PETSc.Mat:
        """From contact's part, at z."""
        if self._krylov is not None:
            stiff = [term.stiff(z, self._z_of_billet) for term in self.terms]
            kappa = np.concatenate([part for _, part in stiff])
            self._krylov.set(D, self.of_all([part for part, _ in stiff], self._z_row, self.z_free), kappa)
            self._iterated.assemble()
            return self._iterated
        rows, cols, values = D
        return self._tangent.fill(self.z_to_x[rows] - self._row0, self.z_to_x[cols], values)

    def largest_displacement(self, x: PETSc.Vec) -> float:
        """Largest displacement component in x on any rank, multipliers left out."""
        mine = float(np.max(np.abs(x.array_r[: self._owned]), initial=0.0))
        return float(self.comm.allreduce(mine, op=MPI.MAX)) if self.comm.size > 1 else mine

    def forget_pattern(self) -> None:
        """Let go of the contact pairs met so far: the tangent's pattern is the bulk's again."""
        if self._krylov is None:
            self._tangent.reset()
        self.let_go()

    def let_go(self) -> None:
        """Free matrices that are no longer held: on several ranks petsc4py keeps them until all ranks say so."""
        if self.comm.size > 1:
            PETSc.garbage_cleanup(self.comm)

    def set_accuracy(self, ksp: PETSc.KSP, tolerance: float, share: float) -> None:
        if self._krylov is not None:
            from extrusion.krylov import MOST, RTOL

            rtol = RTOL if self.solves_closely else min(max(RTOL, share), MOST)
            ksp.setTolerances(rtol=rtol, atol=0.3 * tolerance, max_it=400)

    @property
    def keeps_tangents(self) -> bool:
        """Not where all is factored anew for each: that is the plain method, which the others are checked against."""
        return self._krylov is not None

    @property
    def iterates(self) -> bool:
        """Whether it does as `iterate` says."""
        return self._krylov is not None

    def iterate(self) -> None:
        """From now on solve the tangent's linear systems by a Krylov method instead of factoring them."""
        from extrusion.krylov import Krylov

        self._krylov = Krylov(self)
        self._iterated = PETSc.Mat().createPython((self.x.sizes, self.x.sizes), context=self._krylov, comm=self.comm)
        self._iterated.setUp()

    def agreed(self, yes: bool) -> bool:
        """Whether all ranks say yes."""
        return bool(self.comm.allreduce(yes, op=MPI.LAND)) if self.comm.size > 1 else yes

    @cached_property
    def z_rows(self) -> Index:
        """Entries of z that are unknowns of this rank."""
        return self._z_mine[self._z_row[self._z_mine]]

    @cached_property
    def x_rows(self) -> Index:
        """Where this rank's x holds them."""
        return self._x_mine[self._z_row[self._z_mine]]

    @cached_property
    def _z_of_billet(self) -> np.ndarray:
        """Which entries of z are displacements of the billet."""
        out = np.zeros(self.n_z, dtype=bool)
        out[: self.dim * self._n_nodes] = np.repeat(self.z_in_billet, self.dim)
        return out

    @property
    def held_rows(self) -> Index:
        """Where this rank's x holds what the supports prescribe."""
        return self._held

    def bulk_times(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """K x into y; at the supports x itself."""
        self._K_wide.mult(x, y)
        y.array[self._held] = x.array_r[self._held]

    @cached_property
    def _tangent(self) -> TangentMatrix:
        return self._make_tangent()

    def _make_tangent(self) -> TangentMatrix:
        """Bulk and contact with every unknown; of no use on the surface or with multigrid."""
        indptr, indices, data = self.K.getValuesCSR()
        return TangentMatrix(self.comm, self.n_local, self.n, self._row0, indptr, indices, data, self.held)

    def set_solver(self, ksp: PETSc.KSP) -> None:
        """MUMPS, anew for each tangent; or the Krylov method."""
        if self._krylov is not None:
            ksp.setType("fgmres")
            ksp.setGMRESRestart(60)
            pc = ksp.getPC()
            pc.setType("python")
            pc.setPythonContext(self._krylov)
            return
        ksp.setType("preonly")
        pc = ksp.getPC()
        pc.setType("lu")
        pc.setFactorSolverType("mumps")

    def recover(self, x: PETSc.Vec) -> PETSc.Vec:
        """x itself."""
        return x

    def tangent_without_contact(self) -> PETSc.Mat:
        """The bulk's tangent, with identity at the supports (and nothing yet for the multipliers)."""
        if self._krylov is not None:
            return self._iterated
        none = np.zeros(0, dtype=np.int64)
        return self._tangent.fill(none, none, np.zeros(0))

    def round_off(self, x: PETSc.Vec) -> float:
        """Norm of the round-off in the residual at x, N.

        Four times machine epsilon times the forces |K| |u| that cancel in it, and the contact stiffness by a position.
        """
        u = x.duplicate()
        u.array[:] = np.abs(x.array_r)
        u.array[self._owned :] = 0.0
        norm = self._size(u)
        u.destroy()
        return self.round_off_at(norm)

    def _size(self, u: PETSc.Vec) -> float:
        """Norm of |K| u, N."""
        f = u.duplicate()
        self._K_size.mult(u, f)
        norm = float(f.norm())
        f.destroy()
        return norm

    def size_of_drive(self) -> float:
        """Norm of the forces that cancel when the billet moves by 1 mm, N/mm."""
        u = self.x.duplicate()
        self.shift_billet(u, 1.0)
        norm = self._size(u)
        u.destroy()
        return norm

    def round_off_at(self, forces: float) -> float:
        """Norm of the residual's round-off where forces of this norm (N) cancel in the bulk, N."""
        farthest = float(np.max(np.abs(list(self.case.profile.points.values()))))
        in_gaps = sum(farthest * term.stiffness_norm() for term in self.terms)
        return 4 * float(np.finfo(float).eps) * (forces + in_gaps)

    def _refuse_indefinite(self) -> None:
        """Refuse a gamma too small for the mesh, where contact can be lost in silence.

        With all contact facets closed, the symmetric method is coercive from a gamma_c on that depends on the mesh and
        the element (27 to 36 for P2, 8 to 10 for P1): theta = 1 needs as much. theta = 0 is coercive from gamma_c / 4
        on and was found regular to about gamma_c / 90; it is refused below gamma_c / `SAFETY`. theta = -1 always is.

        Raises:
            InputError: The smallest gamma is in the message.
        """
        case = self.case
        factor = 1.0 if case.theta == 1 else SAFETY
        tangent = self._make_tangent()
        if self._indefinite(tangent, factor):
            low, high = factor, 2 * factor
            while self._indefinite(tangent, high):
                low, high = high, 2 * high
            while high / low > 1.02:
                middle = float(np.sqrt(low * high))
                low, high = (middle, high) if self._indefinite(tangent, middle) else (low, middle)
            least = high / factor * case.contact_gamma
            remedy = (
                f"theta = {case.theta} is not safe on this mesh below gamma = {least:.3g}: give more, or theta = -1"
            )
            raise InputError("gamma", case.contact_gamma, remedy)

    def _indefinite(self, tangent: TangentMatrix, factor: float) -> bool:
        """Whether the closed-edge problem with ``factor`` times the contact stiffness has a negative direction."""
        rows, cols, values = [], [], []
        for term in self.terms:
            if isinstance(term, IntegratedContact) and term.pair.closure != "check":
                (i, j, fixed), with_k = term.closed_edge()
                keep = self._z_row[i] & self.z_free[j]
                rows.append(self.z_to_x[i[keep]] - self._row0)
                cols.append(self.z_to_x[j[keep]])
                values.append((fixed + factor * with_k)[keep])
        if not rows:
            return False
        A = tangent.fill(*(np.concatenate(part) for part in (rows, cols, values)))
        pc = PETSc.PC().create(self.comm)
        pc.setType("cholesky")
        pc.setFactorSolverType("mumps")
        pc.setOperators(A)
        pc.setFactorSetUpSolverType()
        factor_matrix = pc.getFactorMatrix()
        factor_matrix.setMumpsIcntl(24, 1)  # inertia is only known with null pivots looked for
        factor_matrix.setMumpsIcntl(13, 1)  # and with the last front factored on one rank
        pc.setUp()
        negative = factor_matrix.getInertia()[0]
        pc.destroy()
        return bool(negative > self.comm.allreduce(self._free_pressures))

    # -- reports ---------------------------------------------------------------------------------------------

    def balance(self, x: PETSc.Vec) -> tuple[float, float, float]:
        z = self.gather(x)
        R = self.contact_forces(z)
        f = self.forces(x, R)
        energy = 0.5 * float(x.dot(f) - z[self._z_live] @ R[self._z_live])
        rear, die = float(f.array_r[self._driven].sum()), float(f.array_r[self._clamped_y].sum())
        f.destroy()
        rear, die = self.comm.allreduce(rear), self.comm.allreduce(die)
        if self.case.die == "rigid":
            axial = slice(1, self.dim * len(self._live), self.dim)
            die = -float(R[axial].sum())  # of what holds it
        return self.copies * rear, self.copies * die, self.copies * energy

    def named_points(self) -> dict[str, tuple[int, int]]:
        """Rank and local dof block of each named point of the profile that is a node of the mesh."""
        x = self.V.tabulate_dof_coordinates()[: self._owned // self.dim]
        blocks = self._blocks_of("billet")
        billet = np.isin(np.arange(len(x)), blocks)
        out = {}
        for name, point in self.case.profile.points.items():
            in_billet = name in BILLET_POINTS
            distance = np.linalg.norm(x - (*point, 0.0), axis=1)
            distance[billet != in_billet] = np.inf
            best = int(np.argmin(distance)) if len(distance) else -1
            mine = float(distance[best]) if best >= 0 else np.inf
            nearest, rank = self.comm.allreduce((mine, self.comm.rank), op=MPI.MINLOC)
            if nearest < 1e-6 * self.case.profile.radius:
                out[name] = (rank, self.comm.bcast(best, root=rank))
        return out

    def point_displacements(self, x: PETSc.Vec, points: dict[str, tuple[int, int]]) -> dict[str, tuple[float, float]]:
        """Displacement (u_r, u_y) of named points, mm."""
        mine = {
            name: (float(x.array_r[self.dim * block]), float(x.array_r[self.dim * block + 1]))
            for name, (rank, block) in points.items()
            if rank == self.comm.rank
        }
        found = {name: value for part in self.comm.allgather(mine) for name, value in part.items()}
        return {name: found[name] for name in points}

    def worst(self, x: PETSc.Vec) -> str:
        """Where the residual is largest: zone and current place, in words."""
        f = x.duplicate()
        self.residual(x, f)
        size = np.nan_to_num(np.abs(f.array_r[: self._owned]), nan=np.inf)
        f.destroy()
        at = int(np.argmax(size)) if len(size) else 0
        largest, rank = self.comm.allreduce((float(size[at]) if len(size) else -1.0, self.comm.rank), op=MPI.MAXLOC)
        text = None
        if rank == self.comm.rank:
            dim = self.dim
            block = at // dim
            place = self.V.tabulate_dof_coordinates()[block, :dim] + x.array_r[dim * block : dim * block + dim]
            where = self.zones_of(int(np.searchsorted(self._live, block + self._first_dof // dim)))
            text = f"{where}, {in_words(place)}, out of balance by {largest:.3g} N"
        return str(self.comm.bcast(text, root=rank))

    @property
    def dofs(self) -> int:
        """Unknowns: displacements of both bodies, fixed ones included, and multipliers."""
        return self.n


def _distributed(case: Case, mesh: PlainMesh | HexMesh | None, comm: MPI.Intracomm, bodies: Any) -> TaggedMesh:
    in_space = case.space == "3d"

    def check() -> None:
        if mesh is not None and isinstance(mesh, PlainMesh) is in_space:
            raise InputError("mesh", "triangles" if in_space else "hexahedra", f"does not suit space = {case.space!r}")
        if isinstance(mesh, PlainMesh):
            check_profile(mesh, case.profile)
        elif mesh is not None:
            from extrusion.mesh3d import check_hex_profile

            check_hex_profile(mesh, case.profile)

    on_root(comm, check)
    if in_space:
        from extrusion.mesh3d import distribute_hex

        return distribute_hex(comm, mesh, bodies)  # type: ignore[arg-type]
    return distribute(comm, mesh, bodies)  # type: ignore[arg-type]


def _subdivide(curve: Array, parts: list[int]) -> Array:
    pieces = [a + (b - a) * np.arange(n)[:, None] / n for a, b, n in zip(curve[:-1], curve[1:], parts, strict=True)]
    return np.vstack([*pieces, curve[-1:]])
