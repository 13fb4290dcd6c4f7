# %% [markdown]
# # Hertz: a rigid sphere pressed into an elastic block
#
# The first problem of contact mechanics with a closed form (Hertz 1882). A rigid sphere of radius R goes the depth d
# into an elastic half-space without friction. With E* = E / (1 - nu^2), the radius of contact, the force and the
# pressure are
#
# $$a = \sqrt{R d}, \qquad F = \tfrac43 E^* \sqrt R\, d^{3/2} = \frac{4 E^* a^3}{3 R}, \qquad
#   p = p_0 \sqrt{1 - r^2 / a^2}, \qquad p_0 = \frac{2 E^* a}{\pi R} = \frac{3 F}{2 \pi a^2},$$
#
# and outside the contact the surfaces part by
# $\frac{a^2}{\pi R}\left[\sqrt{\rho^2 - 1} + (\rho^2 - 2) \arccos \frac1\rho\right]$ with $\rho = r / a$.
#
# **Target.** The force within 0.5 % and the peak pressure within 2 %. Here a = 1 mm and R = 1 m, so that strains are
# small, as Hertz assumes.

# %%
import matplotlib.pyplot as plt
import numpy as np

from extrusion import run
from extrusion.cases import Case, Zone
from extrusion.elasticity import Elastic
from extrusion.mesh import plain_mesh
from extrusion.profile import Profile

E, NU, R, D = 5000.0, 0.3, 1000.0, 1e-3  # MPa, -, mm, mm
E_STAR = E / (1 - NU**2)

# %% [markdown]
# A half-space has no end, a mesh has. The block is made a thousand times as large as the contact, so that its far side
# costs 0.1 % of the force. Oblate spheroidal coordinates, r = c cosh(xi) sin(eta) and depth = c sinh(xi) cos(eta), get
# that far in 76 layers; they go over into a rectangle, and are finest at r = c = 1.2 mm, a little outside the contact.

# %%
N, FOCUS, FAR = 24, 1.2, 7.6  # elements along r < c; c, mm; ln of twice the block's size over c
RADIUS, LENGTH = float(FOCUS * np.cosh(FAR)), float(FOCUS * np.sinh(FAR))

layers = round(FAR * N / 2.4)
eta, xi = np.meshgrid(np.linspace(np.pi / 2, 0, N + 1), np.linspace(0, FAR, layers + 1))
far = xi / FAR
with np.errstate(divide="ignore"):
    r = np.cosh(xi) * ((1 - far) * np.sin(eta) + far * np.minimum(1, np.tan(eta)))
    depth = np.sinh(xi) * ((1 - far) * np.cos(eta) + far * np.minimum(1, 1 / np.tan(eta)))
depth[:, 0] = 0  # cos(pi / 2), without its round-off
points = np.stack([FOCUS * r, LENGTH - FOCUS * depth], axis=-1).reshape(-1, 2)

node = np.arange(len(points)).reshape(layers + 1, N + 1)
a, b, c, d = (corner.ravel() for corner in (node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]))
lines = {
    "front": np.append(node[0, ::-1], node[1:, 0]),
    "side": node[-1, : N // 2 + 1],
    "rear": node[-1, N // 2 :],
    "axis": node[:, -1],
}
mesh = plain_mesh(
    points,
    {"billet": np.vstack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])},
    {name: np.stack([line[:-1], line[1:]], axis=1) for name, line in lines.items()},
)
len(points)

# %% [markdown]
# The block is a billet, the sphere a rigid die whose cone is a polygon on the parabola r^2 / 2R, and the far side is
# pushed by d. Nitsche's method and quadratic triangles are the defaults.

# %%
rim = np.append(np.linspace(0, 1.5, 61), np.linspace(1.5, 3, 17)[1:])
height = LENGTH + rim**2 / (2 * R)
sphere = tuple(f"C{i}" for i in range(len(rim)))
case = Case(
    name="hertz",
    profile=Profile(
        die=(
            *zip(sphere, rim.tolist(), height.tolist(), strict=True),
            ("J", 2 * RADIUS, height[-1]),
            ("I", 2 * RADIUS, 2 * LENGTH),
            ("H", 0.0, 2 * LENGTH),
        ),
        cone=sphere,
        bore=(sphere[-1], "J"),
        fixed=(("H", "I"),),
        radius=RADIUS,
        length=LENGTH,
    ),
    zones=(Zone(name="2", billet="front", die="cone", ray="y"),),
    billet=Elastic(E, NU),
    die="rigid",
    increments=((D, D),),
)
result = run(case, mesh=mesh)
result  # noqa: B018

# %% [markdown]
# The zone reports pressure and gap at its points. The radius of contact comes from the pressure, whose mean square
# radius is 2/5 a^2: no node has to lie on the edge.

# %%
step = result.steps[-1]
state = step.zones["2"]
at, force = state.x[:, 0], state.weight * state.pressure
radius = np.sqrt(2.5 * np.sum(force * at**2) / np.sum(force))
p0 = 2 * E_STAR * radius / (np.pi * R)
errors = {
    "F(d)": step.reaction / (4 / 3 * E_STAR * np.sqrt(R) * D**1.5) - 1,
    "F(a)": step.reaction / (4 * E_STAR * radius**3 / (3 * R)) - 1,
    "a(d)": radius / np.sqrt(R * D) - 1,
    "p0(a)": np.max(state.pressure) / p0 - 1,
}
for name, error in errors.items():
    print(f"{name:6} {100 * error:+.2f} %")

# %% [markdown]
# Pressure and gap beside the closed forms.

# %%
weighs = state.weight > 1e-9 * np.max(state.weight)
inside, outside = np.linspace(0, 1, 200), np.linspace(1, 2, 200)
parted = np.sqrt(outside**2 - 1) + (outside**2 - 2) * np.arccos(1 / outside)
picture, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
left.plot(at[weighs] / radius, state.pressure[weighs], ".", label="computed")
left.plot(inside, p0 * np.sqrt(1 - inside**2), "k", lw=1, label="Hertz")
left.set(xlabel="r / a", ylabel="pressure, MPa", xlim=(0, 2))
right.plot(at / radius, 1e3 * state.gap, ".")
right.plot(outside, 1e3 * radius**2 / (np.pi * R) * parted, "k", lw=1)
right.set(xlabel="r / a", ylabel="gap, µm", xlim=(0, 2), ylim=(-0.02, 0.6))
left.legend()
plt.show()

# %% [markdown]
# The targets are met.

# %%
for name, tolerance in {"F(d)": 5e-3, "F(a)": 5e-3, "a(d)": 2e-3, "p0(a)": 2e-2}.items():
    assert abs(errors[name]) <= tolerance, (name, errors[name])
