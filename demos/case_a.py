# %% [markdown]
# # Case A: an elastic billet through an elastic die
#
# A billet of radius 50 mm and length 65 mm (E = 5000 MPa, nu = 0.45) is pushed by its rear face, frictionless, through
# a steel die whose bore narrows to 45 mm, opens to 48 mm and ends in a cone. This is modelisation A of the validation
# sheet SSNV504: axisymmetric, linear triangles, contact at the nodes, unilateral, in two zones (the billet's side in
# the bore, its front on the cone), 31 increments of 5 mm.
#
# **Target.** K is the middle of the billet's front. The sheet tests its axial displacement each time it faces a named
# point of the die, when the rear face has moved by t:

# %%
from extrusion import cases, run

TARGET = {  # t: u_y of K in mm, and its relative tolerance
    5: (5.000, 1e-3),
    20: (20.825, 2e-3),
    50: (55.880, 2e-3),
    70: (78.690, 1e-3),
    140: (144.895, 1e-3),
    155: (155.096, 1e-3),
}
OVERLAP = {100: (-5.000, 1e-3), 155: (-2.000, 1e-3)}  # gap at M, mm, where contact is checked but not solved

# %% [markdown]
# The case is data, so a run is one call. The result shows itself as a table: u_y of K beside the sheet's, the force on
# the rear face, the gap at the billet's corners L and M, and the linear solves of each step.

# %%
result = run(cases.A)
result  # noqa: B018

# %% [markdown]
# The billet at t = 20, 70 and 155 mm: entering the narrow part, half through it, and upset against the cone.

# %%
result.plot()

# %% [markdown]
# From t = 80 to 135 mm the force is negative: the billet wants to leave the narrow part, and has to be held back. Its
# zigzag is the mesh's, each time a node passes a corner of the die (Nitsche's method on quadratic elements has a smooth
# one). K runs ahead of the rear face while the billet is squeezed.

# %%
result.plot("history")

# %% [markdown]
# Half through the die the pressure along the side peaks at C and D, the corners that stick out into the billet.

# %%
result.plot("pressure")

# %% [markdown]
# With contact checked but not solved the billet moves rigidly through the die, and the gap at its rear corner M says
# by how much they overlap: 5 mm in the narrow part, 2 mm behind it.

# %%
checked = run(cases.A, contact="check")
overlap = dict(zip(checked.t, checked.gap("M"), strict=True))
{t: round(overlap[t], 6) for t in OVERLAP}

# %% [markdown]
# The targets are met.

# %%
K = dict(zip(result.t, result.point("K")[:, 1], strict=True))
for t, (value, tolerance) in TARGET.items():
    assert abs(K[t] - value) <= tolerance * value, (t, K[t], value)
for t, (value, tolerance) in OVERLAP.items():
    assert abs(overlap[t] - value) <= tolerance * abs(value), (t, overlap[t], value)
