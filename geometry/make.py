# %% [markdown]
# # The scene, and the meshes that are shipped
#
# Run it after a change of `extrusion/profile.py` or `extrusion/mesh.py`: `python geometry/make.py`. It writes
# `extrusion/meshes/*.msh` anew, prints what each one costs, and draws the scene in `geometry/ssnv504.png`.

# %%
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from extrusion.mesh import (
    BUNDLED_SIZES,
    SSNV504_C,
    bundled_path,
    case_mesh,
    check_profile,
    graded_mesh,
    sheet_mesh,
    write_mesh,
)
from extrusion.profile import SSNV504

# %% [markdown]
# A P2 mesh has a node at every vertex and on every edge, and two displacements at each.

# %%
for profile, size in [(SSNV504, None), (SSNV504_C, None), *((SSNV504, h) for h in BUNDLED_SIZES)]:
    mesh = sheet_mesh(profile) if size is None else graded_mesh(profile, size)
    check_profile(mesh, profile)
    path = bundled_path(profile, size)
    path.parent.mkdir(exist_ok=True)
    write_mesh(path, mesh)
    cells = np.vstack(list(mesh.cells.values()))
    edges = np.unique(np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    dofs = 2 * (len(mesh.points) + len(edges))
    print(f"{path.name:16} {len(mesh.points):5} nodes {len(cells):5} triangles {dofs:6} P2 dofs")

# %% [markdown]
# Named points, and divisions of the edges, written inside the body they belong to.

# %%
mesh = case_mesh(SSNV504)
fig, ax = plt.subplots(figsize=(6, 13), layout="constrained")
die_edges = [(b, a) for a, b in SSNV504.die_edges]  # the sheet names them clockwise
for body, edges, color in (("billet", SSNV504.billet_edges, "C1"), ("die", die_edges, "C0")):
    ax.triplot(*mesh.points.T, mesh.cells[body], color=color, linewidth=0.3)
    inward = {}
    for edge in edges:  # counter-clockwise: the body is on the left
        a, b = SSNV504.curve(edge)
        ax.plot(*zip(a, b, strict=True), color=color)
        inward[edge] = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
        x = (a + b) / 2 + 3 * inward[edge]
        ax.text(*x, SSNV504.division(*edge), color=color, ha="center", va="center", size=7)
    for name in {name for edge in edges for name in edge}:
        x = SSNV504.curve([name])[0] + 4 * sum(n for edge, n in inward.items() if name in edge) / 2
        ax.text(*x, name, ha="center", va="center", weight="bold")
ax.set(aspect="equal", xlabel="r (mm)", ylabel="y (mm)", title="SSNV504")
fig.savefig(Path(__file__).with_name("ssnv504.png"), dpi=100)
