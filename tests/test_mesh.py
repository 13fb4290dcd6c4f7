"""Meshes: those shipped, those gmsh makes, files, and their distribution over ranks."""

import signal
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from mpi4py import MPI

import numpy as np
import pytest

import ufl
from dolfinx import fem

from extrusion.errors import InputError
from extrusion.mesh import (
    FACETS,
    SSNV504_C,
    PlainMesh,
    bundled,
    case_mesh,
    check_profile,
    distribute,
    graded_mesh,
    on_root,
    plain_mesh,
    read_mesh,
    sheet_mesh,
    write_mesh,
)
from extrusion.profile import SSNV504, Profile

PUBLISHED = Path(__file__).parents[2] / "shared" / "ssnv504"
AREAS = {"billet": 3250.0, "die": 3587.5}  # mm2, of the published meshes
SHIPPED = [(SSNV504, None), (SSNV504_C, None), (SSNV504, 4), (SSNV504, 2), (SSNV504, 1)]


@pytest.fixture
def gmsh() -> ModuleType:
    """The module, where it and its system libraries are installed."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        pytest.skip(f"gmsh: {error}")
    return gmsh


def published(name: str) -> PlainMesh:
    """One of the published meshes, where they are at hand."""
    if not (path := PUBLISHED / name).exists():
        pytest.skip(f"the published mesh {name} is not at hand")
    return read_mesh(path, tuple(FACETS))


def sides(mesh: PlainMesh, body: str) -> np.ndarray:
    """The three edge vectors of each triangle, ``shape=(m, 3, 2)``."""
    corners = mesh.points[mesh.cells[body]]
    return np.roll(corners, -1, axis=1) - corners


def areas(mesh: PlainMesh, body: str) -> np.ndarray:
    """Signed area of each triangle."""
    e = sides(mesh, body)
    return (e[:, 0, 0] * e[:, 1, 1] - e[:, 0, 1] * e[:, 1, 0]) / 2


def triangles(mesh: PlainMesh, body: str) -> set[frozenset[tuple[float, ...]]]:
    """A body's triangles by the coordinates of their corners, to 1e-4 mm."""
    corners = np.round(mesh.points, 4) + 0.0  # no -0.0
    return {frozenset(map(tuple, corners[cell].tolist())) for cell in mesh.cells[body]}


def lengths(mesh: PlainMesh, group: str) -> np.ndarray:
    """Lengths of a group's facets, ordered by y, then r, of their middles."""
    x = mesh.points[mesh.facets[group]]
    return np.linalg.norm(x[:, 1] - x[:, 0], axis=1)[np.lexsort(x.mean(axis=1).T)]


def p2_dofs(mesh: PlainMesh) -> int:
    """Displacements of a P2 mesh: two at each vertex and at each edge."""
    cells = np.vstack(list(mesh.cells.values()))
    edges = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return 2 * (len(mesh.points) + len(np.unique(edges, axis=0)))


@pytest.mark.parametrize(("profile", "size"), SHIPPED)
def test_shipped_meshes_are_the_profiles(profile: Profile, size: float | None) -> None:
    """Both bodies are filled once, every group covers its edges, and no triangle is a sliver."""
    mesh = bundled(profile, size)
    assert mesh is not None
    assert set(mesh.facets) == set(FACETS)
    check_profile(mesh, profile)
    for body, area in AREAS.items():
        a = areas(mesh, body)
        assert np.sum(a) == pytest.approx(area, rel=1e-12)
        quality = 4 * np.sqrt(3) * a / np.sum(sides(mesh, body) ** 2, axis=(1, 2))
        assert np.min(quality) > (0.15 if profile is SSNV504_C else 0.5)


def test_shipped_meshes_have_the_announced_sizes() -> None:
    """The sheet's 333 nodes and 510 triangles; a graded mesh that has grown costs every run."""
    sheet = case_mesh(SSNV504)
    assert (len(sheet.points), sum(map(len, sheet.cells.values()))) == (333, 510)
    assert {name: len(f) for name, f in case_mesh(SSNV504_C).facets.items() if name in ("side", "axis")} == {
        "side": 100,
        "axis": 100,
    }
    assert p2_dofs(case_mesh(SSNV504, 4)) <= 2500
    assert p2_dofs(case_mesh(SSNV504, 1)) <= 15000


@pytest.mark.parametrize("name", ["ssnv504a.med", "ssnv504e.med"])
def test_published_meshes_are_read(name: str) -> None:
    """Clockwise, or P2, with other names and a stray line K-G: the billet's triangles are those shipped."""
    mesh, ours = published(name), case_mesh(SSNV504)
    check_profile(mesh, SSNV504)
    assert {g: len(f) for g, f in mesh.facets.items()} == {g: len(f) for g, f in ours.facets.items()}
    for body, area in AREAS.items():
        assert np.min(areas(mesh, body)) > 0
        assert np.sum(areas(mesh, body)) == pytest.approx(area, rel=1e-7)
    assert triangles(mesh, "billet") == triangles(ours, "billet")


def test_sheet_mesh_by_gmsh_is_the_shipped_one(gmsh: ModuleType) -> None:
    """The same billet and the same divisions; gmsh leaves the handler of Ctrl-C alone, and is closed."""
    handler = signal.getsignal(signal.SIGINT)
    mesh, shipped = sheet_mesh(SSNV504), case_mesh(SSNV504)
    assert signal.getsignal(signal.SIGINT) is handler
    assert not gmsh.isInitialized()
    assert triangles(mesh, "billet") == triangles(shipped, "billet")
    for group in FACETS:
        np.testing.assert_allclose(lengths(mesh, group), lengths(shipped, group), rtol=1e-12)
    np.testing.assert_array_equal(sheet_mesh(SSNV504).points, mesh.points)


def test_graded_mesh_has_the_sizes_asked_for(gmsh: ModuleType) -> None:
    """h on the side, 0.05 h at L, 2 h along the bore, 0.2 h at its vertices; half the size costs more."""
    coarse, fine = graded_mesh(SSNV504, 6), graded_mesh(SSNV504, 3)
    check_profile(fine, SSNV504)
    assert np.median(lengths(fine, "side")) == pytest.approx(3, rel=0.2)
    assert lengths(fine, "side")[-1] == pytest.approx(0.15, rel=0.4)
    assert np.max(lengths(fine, "bore")) == pytest.approx(6, rel=0.2)
    assert np.min(lengths(fine, "bore")) == pytest.approx(0.6, rel=0.4)
    assert p2_dofs(fine) > 1.3 * p2_dofs(coarse)


def test_another_scene_is_meshed(gmsh: ModuleType) -> None:
    """A die listed counter-clockwise, without cone or edge on the axis; its absent groups are absent."""
    tube = Profile(
        die=(("a", 12, -5), ("b", 20, -5), ("c", 20, 30), ("d", 10, 30), ("e", 12, 15)),
        bore=("a", "e", "d"),
        fixed=(("b", "c"),),
        radius=12,
        length=10,
        divisions=(
            *(("a", "b", 2), ("b", "c", 8), ("c", "d", 2), ("d", "e", 5), ("e", "a", 7)),
            *(("L", "M", 3), ("M", "N", 4), ("N", "K", 3), ("K", "L", 4)),
        ),
    )
    for mesh in (case_mesh(tube), case_mesh(tube, 2)):
        check_profile(mesh, tube)
        assert set(FACETS) - set(mesh.facets) == {"cone", "die_axis"}
        assert np.sum(areas(mesh, "die")) == pytest.approx(295)
    with pytest.raises(InputError, match="add the edge"):
        case_mesh(replace(tube, divisions=tube.divisions[:-1]))
    with pytest.raises(InputError, match="alike"):
        case_mesh(tube.with_divisions(("L", "M", 5)))


def test_shipped_meshes_need_no_gmsh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without gmsh they are still there, and others are refused with the remedy."""
    monkeypatch.setitem(sys.modules, "gmsh", None)
    for profile, size in SHIPPED:
        case_mesh(profile, size)
    with pytest.raises(InputError, match="pip install gmsh"):
        case_mesh(SSNV504, 3)


@pytest.mark.parametrize("size", [0, -1, 1e-3, 51, float("nan"), "4", True])
def test_bad_size_is_refused(size: object) -> None:
    """Before gmsh is asked for millions of triangles."""
    with pytest.raises(InputError, match="size = "):
        graded_mesh(SSNV504, size)  # type: ignore[arg-type]


def test_written_mesh_is_read_back(tmp_path: Path) -> None:
    """Coordinates to the last bit."""
    mesh = case_mesh(SSNV504, 4)
    write_mesh(tmp_path / "a.msh", mesh)
    again = read_mesh(tmp_path / "a.msh")
    np.testing.assert_array_equal(again.points, mesh.points)
    for body in AREAS:
        assert triangles(again, body) == triangles(mesh, body)
    for group in FACETS:
        np.testing.assert_array_equal(lengths(again, group), lengths(mesh, group))


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_gmsh_files_are_read(gmsh: ModuleType, version: float, tmp_path: Path) -> None:
    """Binary, quadratic, with an edge in two groups and a node of no cell; gmsh reads what we write."""
    write_mesh(tmp_path / "a.msh", case_mesh(SSNV504))
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(tmp_path / "a.msh"))
        model = gmsh.model
        side = next(tag for _, tag in model.getPhysicalGroups(1) if model.getPhysicalName(1, tag) == "side")
        model.addPhysicalGroup(1, list(model.getEntitiesForPhysicalGroup(1, side)), name="outside")
        model.mesh.setOrder(2)
        for option, value in (("MshFileVersion", version), ("Binary", 1)):
            gmsh.option.setNumber(f"Mesh.{option}", value)
        gmsh.write(str(tmp_path / "b.msh"))
    finally:
        gmsh.finalize()
    mesh = read_mesh(tmp_path / "b.msh", tuple(FACETS))
    check_profile(mesh, SSNV504)
    assert triangles(mesh, "die") == triangles(case_mesh(SSNV504), "die")


def square(**change: object) -> tuple[np.ndarray, dict[str, object], dict[str, object]]:
    """Arguments of `plain_mesh` for a billet of two triangles."""
    points = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    cells = {"billet": [[0, 1, 2], [0, 3, 2]]}
    facets = {"rear": [[0, 1]], "side": [[1, 2]], "front": [[2, 3]], "axis": [[3, 0]]}
    return change.get("points", points), change.get("cells", cells), facets | change.get("facets", {})  # type: ignore


def test_plain_mesh_turns_triangles_and_drops_nodes() -> None:
    """The second triangle of the square is clockwise; nodes of no cell, even infinite ones, are left out."""
    points, cells, facets = square()
    mesh = plain_mesh(np.vstack([[[np.inf, 0]], points]), {k: np.array(c) + 1 for k, c in cells.items()}, {})
    np.testing.assert_array_equal(mesh.points, points)
    np.testing.assert_allclose(areas(mesh, "billet"), [0.5, 0.5])
    assert plain_mesh(points, cells, facets).facets.keys() == facets.keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": [[0, 0], [1, 0], [1, np.nan], [0, 1]]}, "not finite"),
        ({"points": [[0, 0], [1, 0], [1, 1], [-1, 1]]}, "r = -1"),
        ({"points": [[0, 0], [1, 0], [2, 0], [0, 1]]}, r"without area in billet at \(0.0, 0.0\)"),
        ({"cells": {"billet": [[0, 1, 2], [0, 3, 9]]}}, "has 4 nodes"),
        ({"cells": {"billet": [[0, 1, 2], [0, 1, 3]]}}, "overlap"),
        ({"cells": {"billet": [[0, 1, 2]], "die": [[0, 2, 3]]}}, "belong to billet and die"),
        ({"cells": {"slug": [[0, 1, 2]]}}, "unknown group 'slug'"),
        ({"cells": {}}, "no triangles"),
        ({"facets": {"front": [[0, 2]]}}, "front between nodes 0 and 2 that is no boundary edge"),
        ({"facets": {"bore": [[0, 1]]}}, "bore between nodes 0 and 1 that is no boundary edge of the die"),
        ({"facets": {"front": [[2, 3], [2, 1]]}}, "front between nodes 1 and 2 that is in the group twice"),
    ],
)
def test_broken_mesh_is_refused(change: Mapping[str, object], message: str) -> None:
    """In words, before DOLFINx fails on it or gives a wrong answer."""
    with pytest.raises(InputError, match=message):
        plain_mesh(*square(**change), origin="a.msh")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("a.txt", lambda text: text, "give a .msh or .med file"),
        ("b.med", lambda text: text, "cannot be read"),
        ("b.msh", lambda text: text[: len(text) // 2], "cannot be read"),
        (
            "b.msh",
            lambda text: text.replace('"rear"', '"back"'),
            "no group 'rear'; groups present: axis, back",
        ),
        ("b.msh", lambda text: text.replace('"bore"', '"hole"'), "no group 'bore'"),
        ("b.msh", lambda text: text.replace(" 0\n", " 7.5\n", 1), "off the plane"),
    ],
)
def test_bad_file_is_refused(name: str, edit: Callable[[str], str], message: str, tmp_path: Path) -> None:
    """In one line that names the file."""
    write_mesh(tmp_path / "good.msh", case_mesh(SSNV504))
    (tmp_path / name).write_text(edit((tmp_path / "good.msh").read_text()))
    with pytest.raises(InputError, match=message) as caught:
        read_mesh(tmp_path / name, ("bore",))
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="no such file"):
        read_mesh(tmp_path / "none.msh")
    with pytest.raises(InputError, match="No such file or directory"):
        write_mesh(tmp_path / "none" / "a.msh", case_mesh(SSNV504))


def test_mesh_of_another_profile_is_refused() -> None:
    """A billet of another length, a vertex elsewhere, a facet too few, a facet that cuts a corner."""
    mesh = case_mesh(SSNV504)
    for other in (replace(SSNV504, length=60), replace(SSNV504, bore=tuple("ABCDE"))):
        with pytest.raises(InputError, match="lies off"):
            check_profile(mesh, other)
    with pytest.raises(InputError, match=r"cone.* 5\.02892 mm of the profile's F-G is missing"):
        check_profile(replace(mesh, facets={"cone": mesh.facets["cone"][1:]}), SSNV504)
    b = np.flatnonzero(np.all(mesh.points == SSNV504.points["B"], axis=1))
    near = mesh.facets["bore"][np.any(mesh.facets["bore"] == b, axis=1)]
    with pytest.raises(InputError, match="lies off"):
        check_profile(replace(mesh, facets={"bore": near[near != b].reshape(1, 2)}), SSNV504)
    with pytest.raises(InputError, match="no such edge"):
        check_profile(mesh, replace(SSNV504, cone=()))


@pytest.mark.mpi
@pytest.mark.parametrize("bodies", [("billet", "die"), ("billet",)])
def test_distributed_groups_have_their_measures(bodies: tuple[str, ...]) -> None:
    """On any ranks, and however nodes and cells were numbered: a tag on the wrong entity changes a length."""
    comm = MPI.COMM_WORLD
    mesh = case_mesh(SSNV504)
    shuffle = np.random.default_rng(4).permutation(len(mesh.points))
    position = np.argsort(shuffle)
    shuffled = PlainMesh(
        mesh.points[shuffle],
        {name: position[c][::-1] for name, c in mesh.cells.items()},
        {name: position[f][::-1, ::-1] for name, f in mesh.facets.items()},
    )
    groups = [group for group, body in FACETS.items() if body in bodies]
    for plain in (mesh, shuffled):
        tagged = distribute(comm, plain if comm.rank == 0 else None, bodies)
        msh = tagged.msh
        assert set(tagged.groups) == {*bodies, *groups}
        for tags, names in ((tagged.cell_tags, bodies), (tagged.facet_tags, groups)):
            kind = "dx" if tags.dim == 2 else "ds"
            measure = ufl.Measure(kind, domain=msh, subdomain_data=tags)
            for name in names:
                form = fem.form(1.0 * measure(tagged.groups[name]))
                value = comm.allreduce(fem.assemble_scalar(form))
                exact = AREAS[name] if kind == "dx" else np.sum(lengths(mesh, name))
                assert value == pytest.approx(exact, rel=1e-12), name
                count = comm.allreduce(len(tags.find(tagged.groups[name])))
                assert count == len((mesh.cells if kind == "dx" else mesh.facets)[name]), name
        assert msh.geometry.dim == 2
        assert msh.topology.index_map(0).size_global == len(np.unique(np.vstack([mesh.cells[b] for b in bodies])))


@pytest.mark.mpi
def test_errors_of_rank_0_are_raised_everywhere() -> None:
    """A rank that went on alone would hang in the next collective call."""
    comm = MPI.COMM_WORLD
    with pytest.raises(InputError, match=r"none\.msh.*no such file"):
        on_root(comm, lambda: read_mesh("none.msh"))
    billet = plain_mesh(*square()) if comm.rank == 0 else None  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no such body"):
        distribute(comm, billet)
    with pytest.raises(InputError, match="give rank 0 a mesh"):
        distribute(comm, None)


@pytest.mark.mpi
@pytest.mark.skipif(MPI.COMM_WORLD.size < 2, reason="needs two processes")
def test_more_ranks_than_cells_is_refused() -> None:
    """One triangle on two processes; DOLFINx would hang or give a rank nothing."""
    triangle = plain_mesh([[0, 0], [1, 0], [0, 1]], {"billet": [[0, 1, 2]]}, {})
    with pytest.raises(InputError, match=r"ranks = .* 1 cells only"):
        distribute(MPI.COMM_WORLD, triangle, ("billet",))


def test_a_size_of_too_many_facets_is_refused() -> None:
    """A thousandth of a thin billet's radius is too many along it."""
    with pytest.raises(InputError, match=r"size = 0.01: give an element size between 0.013 and 1 mm"):
        graded_mesh(replace(SSNV504, radius=1.0), 0.01)


def test_interrupted_meshing() -> None:
    """Ctrl-C in gmsh's callback had been taken for any size: the mesh was another one, and the run went on."""
    pytest.importorskip("gmsh")
    timer = threading.Timer(0.3, signal.raise_signal, (signal.SIGINT,))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        graded_mesh(SSNV504, 0.2)
    timer.join()
    assert len(graded_mesh(SSNV504, 20.0).points) < 1000
