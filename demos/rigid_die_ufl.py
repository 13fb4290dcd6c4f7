# %% [markdown]
# # The rigid die in plain UFL
#
# With a rigid die, contact is one more boundary term: the gap is a piecewise-linear function of where the billet is,
# UFL writes that down as a conditional, and `ufl.derivative` gives the tangent. `extrusion.oracle` holds this form; the
# package's own route, which also knows elastic dies, is tested against it.
#
# **Target.** When the whole billet stands between E and F, in the bore of radius 48 mm, its state is uniform: squeezed
# by d = 2 mm on R = 50 mm, free along the axis. So K is ahead of the rear face by
# L 2 nu d / ((1 - nu) R) = 4.254545 mm, with L = 65 mm and nu = 0.45, the pressure is E d / ((1 - nu) R) = 363.636 MPa,
# and no force pushes. Elsewhere: what `extrusion.run` computes for the same case, to 0.1 mm.

# %%
import inspect
from dataclasses import replace

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import NonlinearProblem

from extrusion import cases, oracle, run
from extrusion.mesh import case_mesh, distribute

LEAD = 65 * 2 * 0.45 * 2 / ((1 - 0.45) * 50)  # mm

# %% [markdown]
# The form: the internal virtual work and, on each contact zone, Nitsche's method with a gap along a fixed ray.

# %%
print(inspect.getsource(oracle.residual))

# %% [markdown]
# The billet of case A alone, on the sheet's divisions with quadratic displacements. The rear face is driven along y; on
# the axis there is no radial displacement.

# %%
case = replace(cases.A, method="nitsche", order=2, die="rigid")
tagged = distribute(MPI.COMM_WORLD, case_mesh(case.profile), ["billet"])
V = fem.functionspace(tagged.msh, ("Lagrange", case.order, (2,)))
u, t = fem.Function(V), fem.Constant(tagged.msh, 0.0)


def dofs(group: str, component: int) -> np.ndarray:
    facets = tagged.facet_tags.find(tagged.groups[group])
    return fem.locate_dofs_topological(V.sub(component), 1, facets)


bcs = [
    fem.dirichletbc(t, dofs("rear", 1), V.sub(1)),
    fem.dirichletbc(fem.Constant(tagged.msh, 0.0), dofs("axis", 0), V.sub(0)),
]
options = {
    "snes_linesearch_type": "bt",
    "snes_atol": 1e-5,  # N
    "snes_rtol": 0.0,
    "snes_stol": 0.0,
    "snes_error_if_not_converged": True,
    "ksp_type": "preonly",
    "pc_type": "lu",
}
F = oracle.residual(case, u, tagged)
problem = NonlinearProblem(F, u, bcs=bcs, petsc_options_prefix="rigid_die_", petsc_options=options)

# %% [markdown]
# The force on the rear face is the virtual work of the residual in a unit displacement of that face.

# %%
lift = fem.Function(V)
lift.x.array[dofs("rear", 1)] = 1.0
force = fem.form(ufl.action(F, lift))
corner = np.linalg.norm(V.tabulate_dof_coordinates()[:, :2] - case.profile.points["K"], axis=1)
K = 2 * int(np.argmin(corner)) + 1


def push(to: float) -> tuple[float, float]:
    """Move the billet on to t, solve, and give u_y of K (mm) and the force (N)."""
    u.x.array[1::2] += to - t.value
    t.value = to
    problem.solve()
    return float(u.x.array[K]), float(fem.assemble_scalar(force))


# %% [markdown]
# There is no history in frictionless, unilateral contact: one step leads to the uniform state.

# %%
uniform, nothing = push(135.5)
print(f"K is {uniform - 135.5:.6f} mm ahead (closed form {LEAD:.6f} mm), force {nothing:.1e} N")

# %% [markdown]
# The whole way, beside the package's route. The two differ only while a facet straddles a corner of the die, where the
# gap has a kink: the package splits its quadrature there, this form does not.

# %%
u.x.array[:], t.value = 0.0, 0.0
result = run(case)
print("   t      K, UFL    K, run    difference (mm)")
difference = []
for step in result.steps:
    u_y, _ = push(step.t)
    difference.append(u_y - step.points["K"][1])
    print(f"{step.t:5g} {u_y:9.4f} {step.points['K'][1]:9.4f} {difference[-1]:+9.4f}")

# %% [markdown]
# The targets are met.

# %%
assert abs(uniform - 135.5 - LEAD) < 1e-9
assert abs(nothing) < 1e-3
assert max(map(abs, difference)) < 0.1
assert abs(difference[-1]) < 1e-4  # the whole side is on E-F, or past F on its extension
