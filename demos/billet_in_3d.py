# mpiexec -n 2 .venv/bin/python demos/billet_in_3d.py
"""A picture in three dimensions: the billet at t = 20, 70 and 155 mm, a quarter of it cut out, in half of the die.

    python demos/billet_in_3d.py [PICTURE.png]

Case B's scene with Nitsche's method on quadratic hexahedra and a rigid die, on any number of ranks; half a minute. The
quarter that is solved is mirrored. Needs PyVista, pip install ".[view]"; where there is no display, libEGL too (Debian,
Ubuntu: libegl1), and no graphics card.
"""

import importlib.util
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from extrusion import cases, run
from extrusion.mesh3d import FACETS_3D
from extrusion.output import Faces
from extrusion.problem import Problem
from extrusion.profile import Profile
from extrusion.result import PICTURED, Array
from extrusion.stepping import Step

PICTURE = Path(__file__).with_suffix(".png")
RIGHT, UP = np.array([-0.88, 0.0, -0.475]), np.array([0.0, 1.0, 0.0])
"""The picture's axes: the camera looks at the quarter x > 0 > z, which is cut out."""

STEEL, CUT, DARK = "#e3e7ea", "#a9b4bf", "#333333"


class Skin:
    """An observer that keeps the billet's skin on rank 0 at the pictured t: t -> places (mm) and stresses (MPa)."""

    def __init__(self) -> None:
        self.faces: Faces | None = None
        self.taken: dict[float, tuple[Array, Array]] = {}

    def __call__(self, problem: Problem, step: Step) -> None:
        """Take a step if it is pictured. Collective."""
        if step.t in PICTURED:
            self.faces = self.faces or Faces(problem, [name for name, body in FACETS_3D.items() if body == "billet"])
            found = self.faces.fields(problem, step)
            if found is not None:
                self.taken[step.t] = self.faces.points + found[0], found[1]


def billet(pv: Any, corners: Array, points: Array, mises: Array) -> Any:
    """Three quarters of the billet's skin."""
    quads = np.column_stack([np.full(len(corners), 4), corners])
    quarters = []
    for x, z in ((1, 1), (-1, 1), (-1, -1)):
        quarter = pv.PolyData(points * (x, 1, z), quads)
        quarter.cell_data["mises"] = mises
        quarters.append(quarter.cell_data_to_point_data())
    return pv.merge(quarters, merge_points=False)


def die(pv: Any, profile: Profile) -> tuple[list[Any], Any]:
    """The surfaces of half a die, one for each edge of the profile, and its section at z = 0."""
    outline = np.array([vertex[1:] for vertex in profile.die])
    turn = np.linspace(0, np.pi, 91)[:, None]
    skins = []
    for a, b in pairwise([*outline, outline[0]]):
        r, y = np.array([a[0], b[0]]), np.array([a[1], b[1]])
        if r.any():
            grid = pv.StructuredGrid(*(np.atleast_3d(v) for v in (r * np.cos(turn), y + 0 * turn, r * np.sin(turn))))
            skins.append(grid.extract_surface(algorithm=None))
    flat = np.column_stack([outline, np.zeros(len(outline))])
    numbers = np.arange(len(flat))
    section = pv.merge([pv.PolyData(flat * (side, 1, 1), [len(flat), *numbers]).triangulate() for side in (1, -1)])
    return skins, section


def draw(pv: Any, profile: Profile, skin: Skin, path: Path) -> None:
    """Render the taken steps side by side, without a display."""
    assert skin.faces is not None
    plotter = pv.Plotter(off_screen=True, window_size=(1800, 1040))
    plotter.set_background("white")
    plotter.enable_anti_aliasing("ssaa")
    plotter.remove_all_lights()
    middle = np.array([0.0, 0.5 * max(y for _, _, y in profile.die), 0.0])
    back = np.cross(RIGHT, UP)
    towards = back + 0.30 * UP
    for direction, strength in ((towards + 0.5 * RIGHT + 0.8 * UP, 0.8), (towards - 1.2 * RIGHT, 0.45)):
        place = tuple(middle + 1000 * direction)
        light = pv.Light(position=place, focal_point=tuple(middle), intensity=strength, color="white")
        light.positional = False
        plotter.add_light(light)
    rim = max(r for _, r, _ in profile.die)
    stresses = np.concatenate([mises for _, mises in skin.taken.values()])
    top = 500 * float(np.ceil(np.percentile(stresses, 97) / 500))  # the peaks at L and at the cone are singular
    skins, section = die(pv, profile)
    bar = dict(
        title=f"von Mises\nstress, MPa\n(peak {stresses.max():.0f})\n ", fmt="%.0f", n_labels=round(top / 500) + 1,
        vertical=True, position_x=0.885, position_y=0.2, height=0.6, width=0.055, color=DARK,
        title_font_size=24, label_font_size=22,
    )  # fmt: skip
    for i, (t, (points, mises)) in enumerate(skin.taken.items()):
        shift = (i - (len(skin.taken) - 1) / 2) * 2.45 * rim * RIGHT
        for part in skins:
            plotter.add_mesh(
                part.translate(shift), color=STEEL, smooth_shading=True, ambient=0.25, diffuse=0.75, specular=0.15
            )
        plotter.add_mesh(section.translate(shift), color=CUT, ambient=0.5, diffuse=0.5)
        outline = section.extract_feature_edges(feature_edges=False, manifold_edges=False, non_manifold_edges=False)
        plotter.add_mesh(outline.translate(shift), color=DARK, line_width=2)
        plotter.add_mesh(
            billet(pv, skin.faces.corners, points, mises).translate(shift),
            scalars="mises", cmap="turbo", clim=(0, top), smooth_shading=True, split_sharp_edges=True,
            ambient=0.45, diffuse=0.6, scalar_bar_args=bar, show_scalar_bar=i == 0,
        )  # fmt: skip
        below = shift + middle - (middle[1] + 0.47 * rim) * UP
        plotter.add_point_labels(
            [below], [f"t = {t:g} mm"], font_size=30, text_color=DARK, shape=None, show_points=False,
            always_visible=True, justification_horizontal="center",
        )  # fmt: skip
    aim = middle + 0.42 * rim * RIGHT - 0.16 * rim * UP
    plotter.camera.position = tuple(aim + 1000 * towards)
    plotter.camera.focal_point = tuple(aim)
    plotter.camera.up = tuple(UP)
    plotter.camera.parallel_projection = True
    plotter.camera.parallel_scale = 2.42 * rim
    plotter.reset_camera_clipping_range()
    plotter.screenshot(path)
    plotter.close()


def main(path: Path = PICTURE, **changes: Any) -> None:
    """Solve, and draw on rank 0."""
    comm, skin = MPI.COMM_WORLD, Skin()
    if importlib.util.find_spec("pyvista") is None:
        if comm.rank == 0:
            print('pyvista is not installed: pip install ".[view]"', file=sys.stderr)
        sys.exit(2)
    settings = dict(method="nitsche", order=2, die="rigid", sectors=12)
    result = run(cases.B, observers=[skin], **{**settings, **changes})
    if comm.rank == 0:
        import pyvista as pv
        from vtkmodules.vtkCommonCore import vtkLogger

        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # it warns where there is no display

        from rich import print as show

        show(result.table())
        draw(pv, result.case.profile, skin, path)
        print(path)
    assert result.converged, result.error


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
