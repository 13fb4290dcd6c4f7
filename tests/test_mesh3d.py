"""Hexahedral meshes of a quarter: blocks, files, subdivision, and their distribution over ranks."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from math import pi
from pathlib import Path
from types import ModuleType

from mpi4py import MPI

import numpy as np
import pytest

import basix
import ufl
from dolfinx import fem

from extrusion.errors import InputError
from extrusion.mesh3d import (
    FACETS_3D,
    HexMesh,
    check_hex_profile,
    distribute_hex,
    hex_mesh,
    plain_hexes,
    read_hex,
    scaled_jacobians,
    write_hex,
)
from extrusion.profile import SSNV504, Profile

PUBLISHED = Path(__file__).parents[2] / "shared" / "ssnv504" / "ssnv504b.med"

TUBE = Profile(  # counter-clockwise, without a cone
    die=(("a", 12, -5), ("b", 20, -5), ("c", 20, 30), ("d", 10, 30), ("e", 12, 15)),
    bore=("a", "e", "d"),
    fixed=(("b", "c"),),
    radius=12,
    length=10,
    divisions=(("a", "b", 2), ("e", "d", 5), ("a", "e", 7), ("L", "M", 3), ("M", "N", 8)),
)
BENT = Profile(  # a cone of two edges, named from the axis
    die=(("A", 50, 0), ("F", 45, 100), ("f", 20, 105), ("G", 0, 120), ("H", 0, 140), ("I", 70, 150), ("J", 60, 0)),
    bore=("A", "F"),
    cone=("G", "f", "F"),
    fixed=(("H", "I"),),
    radius=50,
    length=40,
)


def published(**options: bool) -> HexMesh:
    """The published mesh, where it is at hand."""
    if not PUBLISHED.exists():
        pytest.skip("the published mesh ssnv504b.med is not at hand")
    return read_hex(PUBLISHED, tuple(FACETS_3D), **options)


def turned(a: np.ndarray, b: np.ndarray) -> float:
    """Area of the edge a-b of the half-plane turned by a right angle."""
    return pi / 2 * (a[0] + b[0]) / 2 * float(np.linalg.norm(b - a))


def exact(profile: Profile) -> dict[str, float]:
    """Measure of each group by Pappus's theorem, mm3 and mm2."""
    a = profile.curve([name for name, _, _ in profile.die])
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    radius, length = profile.radius, profile.length
    area, volume = abs(np.sum(cross)) / 2, pi / 2 * abs(np.sum((a + b)[:, 0] * cross)) / 6
    measures = {"billet": pi / 4 * radius**2 * length, "die": float(volume)}
    measures |= {plane: radius * length if "billet" in plane else area for plane in FACETS_3D if "_" in plane}
    return measures | {
        group: sum(turned(*profile.curve(e)) for e in edges)
        for group, edges in profile.edges.items()
        if group in FACETS_3D and edges
    }


def volume(mesh: HexMesh, body: str) -> float:
    """By Gauss's rule, exact for the isoparametric cell."""
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, basix.CellType.hexahedron, mesh.order, variant)
    points, weights = basix.make_quadrature(basix.CellType.hexahedron, 3 * mesh.order)
    slopes = element.tabulate(1, points)[1:, :, :, 0]
    jacobian = np.einsum("dpn,cnx->cpdx", slopes, mesh.points[mesh.cells[body]], optimize=True)
    return float(np.sum(np.linalg.det(jacobian) @ weights))


def quality(mesh: HexMesh) -> float:
    """The worst scaled Jacobian."""
    return min(float(np.min(scaled_jacobians(mesh.points, c, mesh.order)[0])) for c in mesh.cells.values())


def area(mesh: HexMesh, group: str) -> float:
    """Of the facets as plane quadrilaterals, halves of the cross product of the diagonals."""
    a, b, c, d = mesh.points[mesh.facets[group]].transpose(1, 0, 2)
    return float(np.sum(np.linalg.norm(np.cross(c - a, d - b), axis=1)) / 2)


@pytest.mark.parametrize("order", [1, 2])
def test_divisions_are_the_sheets(order: int) -> None:
    """Cells and nodes by hand: a block too few, or two that are not joined, changes the counts."""
    mesh = hex_mesh(SSNV504, order=order)
    disc, lid = 5 * 5 + 10 * 3, 5 * 5 + 10 * 5  # billet M-N: 5 in the core and 3 round it; cone F-G: 5 and 5
    assert {k: len(c) for k, c in mesh.cells.items()} == {"billet": disc * 10, "die": (44 * 2 + 2 * 2) * 10 + lid * 2}
    assert {k: len(f) for k, f in mesh.facets.items()} == {
        **{"side": 100, "front": disc, "rear": disc, "billet_z": 80, "billet_x": 80},
        **{"bore": 440, "cone": lid, "fixed": (2 + 46 + 2) * 10 + lid},
        **{"die_z": 44 * 2 + 2 * 2 + 10 * 2, "die_x": 44 * 2 + 2 * 2 + 10 * 2},
    }
    q = order  # lattice nodes along n cells: q n + 1
    cap = (5 * q + 1) ** 2 + (10 * q + 1) * 3 * q
    roof = (5 * q + 1) ** 2 + (10 * q + 1) * 5 * q
    wall = (10 * q + 1) * ((44 * q + 1) * (2 * q + 1) + 2 * q * (2 * q + 1))
    assert len(mesh.points) == cap * (10 * q + 1) + wall + (roof - (10 * q + 1)) * (2 * q + 1)
    assert quality(mesh) > 0.8
    check_hex_profile(mesh, SSNV504)


@pytest.mark.parametrize("order", [1, 2])
def test_nodes_are_on_the_surfaces(order: int) -> None:
    """Every node of side and bore, those within edges and faces as well: on a chord it would not be counted."""
    mesh = hex_mesh(SSNV504, order=order, sectors=8)
    x = {body: mesh.points[np.unique(c)] for body, c in mesh.cells.items()}
    side = np.abs(np.hypot(x["billet"][:, 0], x["billet"][:, 2]) - 50) < 1e-13 * 50
    assert np.count_nonzero(side) == (8 * order + 1) * (10 * order + 1)
    r, y = np.hypot(x["die"][:, 0], x["die"][:, 2]), x["die"][:, 1]
    bore = (np.abs(r - SSNV504.bore_radius(y)) < 1e-13 * 50) & (y <= 205)
    assert np.count_nonzero(bore) == (8 * order + 1) * (44 * order + 1)
    cone = np.abs(y - (220 - r / 48 * 15)) < 1e-12 * 50
    n = 4 * order
    assert np.count_nonzero(cone) == (n + 1) ** 2 + (2 * n + 1) * 6 * order
    for name in SSNV504.bore:
        ring = (np.abs(r - SSNV504.points[name][0]) < 1e-12) & (y == SSNV504.points[name][1])
        assert np.count_nonzero(ring) == 8 * order + 1
    for plane, axis in (("billet_z", 2), ("die_z", 2), ("billet_x", 0), ("die_x", 0)):
        assert np.all(mesh.points[mesh.facets[plane], axis] == 0)


@pytest.mark.parametrize(("order", "rate"), [(1, 2), (2, 4)])
@pytest.mark.parametrize("body", ["billet", "die"])
def test_volumes_converge(body: str, order: int, rate: int) -> None:
    """As chords do, or parabolas; with middles of edges off the circle order 2 is no better than order 1."""
    errors = [1 - volume(hex_mesh(SSNV504, sectors=n, order=order), body) / exact(SSNV504)[body] for n in (4, 8)]
    observed = np.log2(errors[0] / errors[1])
    assert observed == pytest.approx(rate, abs=0.3), f"observed rate {observed:.2f}"
    if order == 1 and body == "billet":
        assert errors[0] == pytest.approx(1 - np.sin(pi / 8) / (pi / 8), rel=1e-9)
    assert abs(errors[1]) < {1: 7e-3, 2: 4e-6}[order]


@pytest.mark.parametrize(("size", "sectors"), [(10, None), (4, None), (4, 8), (3, 30)])
def test_size_is_that_of_side_bore_and_cone(size: float, sectors: int | None) -> None:
    """Within rounding to whole cells; layers of the die grow, and no cell is bad at any size."""
    mesh = hex_mesh(SSNV504, size, sectors)
    check_hex_profile(mesh, SSNV504)
    assert quality(mesh) > 0.7
    arc = pi * 50 / 2 / (sectors or 2 * round(pi * 50 / 4 / size))
    assert len(mesh.facets["side"]) == round(65 / size) * round(pi * 25 / arc)
    for group in ("side", "bore"):
        a, b, c, _ = mesh.points[mesh.facets[group]].transpose(1, 0, 2)
        longest = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1))
        assert np.median(longest) == pytest.approx(max(size, arc), rel=0.25)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("profile", "size"), [(TUBE, None), (TUBE, 2), (BENT, 8), (BENT, 50)])
def test_other_scenes_are_meshed(profile: Profile, size: float | None, order: int) -> None:
    """Listed the other way round, without cone, with a bent one; groups are where the edges are."""
    mesh = hex_mesh(profile, size, order=order)
    check_hex_profile(mesh, profile)
    assert quality(mesh) > 0.4
    measures = exact(profile)
    assert set(mesh.facets) == set(measures) - {"billet", "die"}
    for body in mesh.cells:
        assert volume(mesh, body) == pytest.approx(measures[body], rel=0.05 if order == 1 else 2e-3)
    for group in mesh.facets:
        assert area(mesh, group) == pytest.approx(measures[group], rel=0.05)


@pytest.mark.parametrize("on_circle", [False, True])
def test_published_mesh_is_subdivided(on_circle: bool) -> None:
    """8 cells of each of its 700 + 1450 hexahedra, 6 of each of its 100 + 160 wedges; it lies at z <= 0."""
    mesh = published(on_circle=on_circle)
    check_hex_profile(mesh, SSNV504)
    assert {k: len(c) for k, c in mesh.cells.items()} == {
        "billet": 8 * 700 + 6 * 100,
        "die": 8 * 1450 + 6 * 160,
    }
    assert len(mesh.facets["side"]) == 4 * 100
    assert len(mesh.facets["front"]) == len(mesh.facets["rear"]) == 4 * 70 + 3 * 10
    assert np.min(mesh.points) == 0
    assert quality(mesh) > 0.14  # the corner of a sector of 9 degrees
    measures = exact(SSNV504)
    chord = pi / (40 if on_circle else 20)
    for body in mesh.cells:  # chords of 9 degrees cut off 0.41 %, those of 4.5 degrees a quarter of it
        assert volume(mesh, body) / measures[body] == pytest.approx(np.sin(chord) / chord, abs=2e-4), body
    for group in mesh.facets:
        assert area(mesh, group) == pytest.approx(measures[group], rel=6e-3), group


def wedges(z: float = -1.0, kind: str = "6 2 1 1") -> str:
    """A billet of two wedges round the axis, radius 2, length 3, as an MSH file; at z <= 0 unless told."""
    circle = [(0, 0), (2, 0), (2**0.5, z * 2**0.5), (0, 2 * z)]
    nodes = [f"{x!r} {y} {z!r}" for y in (0, 3) for x, z in circle]
    elements = [f"{kind} 1 2 3 5 6 7", f"{kind} 1 3 4 5 7 8"]
    elements += ["3 2 2 2 2 3 7 6", "3 2 2 2 3 4 8 7", "2 2 3 3 1 2 3", "2 2 3 3 1 3 4"]
    elements += ["3 2 4 4 1 2 6 5", "3 2 5 5 1 4 8 5"]
    names = ["LOPIN", "LOP_ESC1", "LOP_DDL", "LOP_SYM1", "LOP_SYM2"]
    listed = [f'{3 if i == 1 else 2} {i} "{name}"' for i, name in enumerate(names, start=1)]
    sections = {"PhysicalNames": listed, "Nodes": nodes, "Elements": elements}
    text = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
    for name, lines in sections.items():
        numbered = lines if name == "PhysicalNames" else [f"{i} {line}" for i, line in enumerate(lines, start=1)]
        text += "\n".join([f"${name}", str(len(lines)), *numbered, f"$End{name}\n"])
    return text


@pytest.mark.parametrize("on_circle", [False, True])
def test_wedges_are_subdivided(on_circle: bool, tmp_path: Path) -> None:
    """Volume is kept on chords; on the circle the new nodes of the side, and only these, are at its radius."""
    (tmp_path / "a.msh").write_text(wedges())
    mesh = read_hex(tmp_path / "a.msh", on_circle=on_circle)
    sizes = {"billet": 12, "side": 8, "rear": 6, "billet_z": 4, "billet_x": 4}
    assert {k: len(v) for k, v in (dict(mesh.cells) | dict(mesh.facets)).items()} == sizes
    assert np.min(mesh.points) == 0
    assert len(mesh.points) == 11 * 3  # of two triangles: 4 vertices, 5 edges, 2 middles; on 3 levels
    chords = 2 * 3 * 2**2 * np.sin(pi / 4) / 2
    assert volume(mesh, "billet") == pytest.approx(chords) if not on_circle else volume(mesh, "billet") > chords
    radius = np.hypot(*mesh.points[np.unique(mesh.facets["side"])][:, [0, 2]].T)
    assert len(radius) == 5 * 3
    assert np.count_nonzero(np.abs(radius - 2) < 1e-14) == (15 if on_circle else 9)
    check_hex_profile(mesh, replace(TUBE, radius=2, length=3))


@pytest.mark.parametrize("order", [1, 2])
def test_written_mesh_is_read_back(order: int, tmp_path: Path) -> None:
    """Coordinates to the last bit, and the same cells: at order 2 in gmsh's order of 27 nodes, which meshio turns."""
    mesh = hex_mesh(SSNV504, 20, sectors=4, order=order)
    write_hex(tmp_path / "a.msh", mesh)
    again = read_hex(tmp_path / "a.msh", tuple(FACETS_3D))
    assert again.order == order
    np.testing.assert_array_equal(again.points, mesh.points)
    for body, c in mesh.cells.items():
        np.testing.assert_array_equal(np.unique(again.cells[body], axis=0), np.unique(c, axis=0))
    for group, f in mesh.facets.items():
        np.testing.assert_array_equal(np.unique(np.sort(again.facets[group])), np.unique(np.sort(f)))


@pytest.fixture
def model() -> Iterator[ModuleType]:
    """An open session of gmsh, where it and its system libraries are installed."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        pytest.skip(f"gmsh: {error}")
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    yield gmsh
    gmsh.finalize()


def test_gmsh_reads_what_is_written(model: ModuleType, tmp_path: Path) -> None:
    """At order 2 by its own Jacobians: a node out of order folds the cell. And we read what it writes of it."""
    mesh = hex_mesh(SSNV504, 20, sectors=4, order=2)
    volumes = sum(volume(mesh, body) for body in mesh.cells)
    write_hex(tmp_path / "a.msh", mesh)
    model.open(str(tmp_path / "a.msh"))
    assert {model.model.getPhysicalName(*g) for g in model.model.getPhysicalGroups()} == {*mesh.cells, *mesh.facets}
    cells = model.model.mesh.getElementsByType(12)[0]
    assert np.sum(model.model.mesh.getElementQualities(cells, "volume")) == pytest.approx(volumes)
    assert np.min(model.model.mesh.getElementQualities(cells, "minSJ")) > 0.4
    for option, value in (("MshFileVersion", 4.1), ("Binary", 1)):
        model.option.setNumber(f"Mesh.{option}", value)
    model.write(str(tmp_path / "b.msh"))
    again = read_hex(tmp_path / "b.msh", tuple(FACETS_3D))
    assert again.order == 2
    assert sum(volume(again, body) for body in again.cells) == pytest.approx(volumes)


def test_serendipity_cells_are_reduced(model: ModuleType, tmp_path: Path) -> None:
    """20-node hexahedra, 8-node quadrilaterals: their vertices count."""
    mesh = hex_mesh(SSNV504, 20, sectors=4)
    write_hex(tmp_path / "a.msh", mesh)
    model.open(str(tmp_path / "a.msh"))
    model.option.setNumber("Mesh.SecondOrderIncomplete", 1)
    model.model.mesh.setOrder(2)
    assert len(model.model.mesh.getElementsByType(17)[0]) == sum(map(len, mesh.cells.values()))
    model.write(str(tmp_path / "b.msh"))
    again = read_hex(tmp_path / "b.msh", tuple(FACETS_3D))
    assert (again.order, len(again.points)) == (1, len(mesh.points))
    check_hex_profile(again, SSNV504)


@pytest.mark.mpi
@pytest.mark.parametrize("order", [1, 2])
def test_distributed_groups_have_their_measures(order: int) -> None:
    """On any ranks: counts over owned entities, volumes and areas. A tag on the wrong entity changes one."""
    comm = MPI.COMM_WORLD
    mesh = hex_mesh(SSNV504, sectors=8, order=order)
    measures = exact(SSNV504)
    for bodies in (("billet", "die"), ("billet",)):
        tagged = distribute_hex(comm, mesh if comm.rank == 0 else None, bodies)
        msh = tagged.msh
        assert set(tagged.groups) == {*bodies, *(g for g, body in FACETS_3D.items() if body in bodies)}
        assert len(set(tagged.groups.values())) == len(tagged.groups)
        chosen = {name: fem.Constant(msh, 0.0) for name in (*mesh.cells, *mesh.facets)}  # one form to compile
        integral = sum(
            c * ufl.Measure(kind, domain=msh, subdomain_data=tags)(i + 1 if name not in tagged.groups else at)
            for i, (name, c) in enumerate(chosen.items())
            for kind, tags in [("dx", tagged.cell_tags) if name in mesh.cells else ("ds", tagged.facet_tags)]
            for at in [tagged.groups.get(name, 0)]
        )
        form = fem.form(integral)
        for name in tagged.groups:
            chosen[name].value = 1.0
            value = comm.allreduce(fem.assemble_scalar(form))
            chosen[name].value = 0.0
            assert value == pytest.approx(measures[name], rel={1: 8e-3, 2: 1e-4}[order]), name
            tags, groups = (tagged.cell_tags, mesh.cells) if name in mesh.cells else (tagged.facet_tags, mesh.facets)
            owned = tags.find(tagged.groups[name]) < msh.topology.index_map(tags.dim).size_local
            assert comm.allreduce(np.count_nonzero(owned)) == len(groups[name]), name
        used = np.unique(np.concatenate([mesh.cells[body].ravel() for body in bodies]))
        assert msh.geometry.index_map().size_global == len(used)


@pytest.mark.mpi
def test_each_body_is_spread_over_all_ranks() -> None:
    """What is done for one body at a time is then done by all of them."""
    comm = MPI.COMM_WORLD
    tagged = distribute_hex(comm, hex_mesh(SSNV504, sectors=8) if comm.rank == 0 else None)
    for body in ("billet", "die"):
        cells = tagged.cell_tags.find(tagged.groups[body])
        mine = np.count_nonzero(cells < tagged.msh.topology.index_map(3).size_local)
        assert mine == pytest.approx(comm.allreduce(mine) / comm.size, rel=0.1)


@pytest.mark.mpi
def test_errors_of_rank_0_are_raised_everywhere() -> None:
    """A rank that went on alone would hang in the next collective call."""
    comm = MPI.COMM_WORLD
    cube = plain_hexes(*brick()) if comm.rank == 0 else None
    with pytest.raises(InputError, match="no such body"):
        distribute_hex(comm, cube)
    with pytest.raises(InputError, match="give rank 0 a mesh"):
        distribute_hex(comm, None)
    if comm.size > 1:
        with pytest.raises(InputError, match="1 cells only"):
            distribute_hex(comm, cube, ("billet",))


def brick(**change: object) -> tuple[np.ndarray, dict[str, object], dict[str, object]]:
    """Arguments of `plain_hexes` for a billet of one cell, the unit cube, nodes counted in x, y, z."""
    points = np.array(np.meshgrid([0, 1.0], [0, 1.0], [0, 1.0], indexing="ij")).reshape(3, -1).T[:, ::-1]
    facets = {"rear": [[0, 1, 5, 4]], "side": [[1, 3, 7, 5]]}
    return (
        np.array(change.get("points", points)),
        change.get("cells", {"billet": [range(8)]}),
        facets | change.get("facets", {}),  # type: ignore
    )


def test_plain_hexes_mirrors_cells_and_drops_nodes() -> None:
    """A left-handed cell is mirrored; nodes of no cell, even infinite ones, are left out."""
    points, _, facets = brick()
    mesh = plain_hexes(np.vstack([points[[1, 0, 3, 2, 5, 4, 7, 6]], [3 * [np.inf]]]), {"billet": [range(8)]}, {})
    assert volume(mesh, "billet") == pytest.approx(1)
    assert len(mesh.points) == 8
    assert plain_hexes(points, {"billet": [range(8)]}, facets).facets.keys() == facets.keys()


CUBE = brick()[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.where(CUBE == 1, [1, np.nan, 1], CUBE)}, "not finite"),
        ({"points": CUBE * [1, 0, 1]}, "without volume"),
        ({"points": CUBE[[3, 1, 2, 0, 4, 5, 6, 7]]}, "folded, in billet"),
        ({"cells": {"billet": [[0, 1, 2, 3, 4, 5, 6, 9]]}}, "has 8 nodes"),
        ({"cells": {"billet": 3 * [range(8)]}}, "overlap"),
        ({"cells": {"billet": [range(8)], "die": [range(8)]}}, "belong to billet and die"),
        ({"cells": {"slug": [range(8)]}}, "unknown group 'slug'"),
        ({"cells": {}}, "no hexahedra"),
        ({"facets": {"front": [[0, 1, 2, 7]]}}, "front of nodes 0, 1, 2, 7 that is no boundary face of the billet"),
        ({"facets": {"bore": [[0, 1, 5, 4]]}}, "bore of nodes 0, 1, 5, 4 that is no boundary face of the die"),
        ({"facets": {"front": [[4, 5, 1, 0]]}}, "rear of nodes 0, 1, 5, 4 that is in the group twice"),
    ],
)
def test_broken_mesh_is_refused(change: Mapping[str, object], message: str) -> None:
    """In words, before DOLFINx fails on it or gives a wrong answer."""
    with pytest.raises(InputError, match=message):
        plain_hexes(*brick(**change), origin="a.msh")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        *(({"size": size}, "size = ") for size in (0, -1, 0.4, 51, float("nan"), "4", True)),
        *(({"sectors": sectors}, "sectors = .*even") for sectors in (0, 2, 5, 402, 8.0, True)),
        *(({"order": order}, "order = ") for order in (0, 3, True, 2.0, None)),
        ({"profile": replace(SSNV504, divisions=SSNV504.divisions[1:])}, "add the edge A-B"),
        ({"profile": replace(SSNV504, cone=())}, "another outline"),
        ({"profile": replace(SSNV504, bore=("B", "C", "D", "E", "F"))}, "another outline"),
        ({"profile": replace(TUBE, die=(*TUBE.die[:2], ("o", 25, 0), *TUBE.die[2:]), fixed=(("o", "c"),))}, "outline"),
    ],
)
def test_bad_arguments_are_refused(arguments: Mapping[str, object], message: str) -> None:
    """Before millions of cells are made, naming the argument."""
    with pytest.raises(InputError, match=message):
        hex_mesh(**{"profile": SSNV504} | dict(arguments))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("a.txt", lambda text: text, "give a .msh or .med file"),
        ("b.med", lambda text: text, "cannot be read"),
        ("b.msh", lambda text: text[: len(text) // 2], "cannot be read"),
        ("b.msh", lambda text: text.replace("LOP_DDL", "back"), "no group 'rear'; groups present: LOPIN, "),
        ("b.msh", lambda text: text.replace("LOP_SYM2", "bore"), "no group 'billet_x'"),
        ("b.msh", lambda text: wedges(1.0).replace("2 2 0 0", "2 2 0 -1"), "both sides of the plane z = 0"),
        ("b.msh", lambda text: wedges(kind="11 2 1 1 1 1 1 1"), "LOPIN holds tetra10 cells"),
    ],
)
def test_bad_file_is_refused(name: str, edit: Callable[[str], str], message: str, tmp_path: Path) -> None:
    """In one line that names the file."""
    (tmp_path / name).write_text(edit(wedges()))
    with pytest.raises(InputError, match=message) as caught:
        read_hex(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        read_hex(tmp_path / "none.msh")
    with pytest.raises(InputError, match="No such file or directory"):
        write_hex(tmp_path / "none" / "a.msh", hex_mesh(TUBE))
    with pytest.raises(InputError, match="give a name that ends"):
        write_hex(tmp_path / "a.med", hex_mesh(TUBE))


def test_mesh_of_another_profile_is_refused() -> None:
    """A billet of another length or radius, a vertex elsewhere, a facet too few of any group."""
    mesh = hex_mesh(SSNV504)
    for other in (
        replace(SSNV504, length=60),
        replace(SSNV504, radius=49.7),
        replace(SSNV504, radius=50.3),  # inside by less than the sagitta
        replace(SSNV504, bore=tuple("ABCDE")),
        replace(SSNV504, die=tuple((n, r, 86 if n == "C" else y) for n, r, y in SSNV504.die)),
    ):
        with pytest.raises(InputError, match="lies off the profile's"):
            check_hex_profile(mesh, other)
    for group, f in mesh.facets.items():
        with pytest.raises(InputError, match="a boundary face that is missing in its group"):
            check_hex_profile(replace(mesh, facets=dict(mesh.facets) | {group: f[1:]}), SSNV504)
    with pytest.raises(InputError, match="no such edge"):
        check_hex_profile(mesh, replace(SSNV504, cone=()))
    bulged = hex_mesh(SSNV504)
    bulged.points[np.argmax(bulged.points[:, 0] == 50), 0] += 0.3
    with pytest.raises(InputError, match=r"side at .* lies off the profile's M-L"):
        check_hex_profile(bulged, SSNV504)
    coarse = hex_mesh(SSNV504.with_divisions(("B", "C", 1)))
    ring = np.isclose(coarse.points[:, 1], 85) & (np.hypot(coarse.points[:, 0], coarse.points[:, 2]) < 45.1)
    coarse.points[ring, 1] += 1  # C's ring slides along the bore: facets cut the corner
    with pytest.raises(InputError, match=r"bore at .* lies off the profile's A-B, B-C"):
        check_hex_profile(coarse, SSNV504)
