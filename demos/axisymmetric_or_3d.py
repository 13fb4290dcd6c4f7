# %% [markdown]
# # Three dimensions beside axisymmetry
#
# The sheet's 3D cases, and their problem with quadratic hexahedra and Nitsche's method, each beside the same method,
# zones, divisions and increments in axisymmetry. K and the reaction are compared with the converged axisymmetric
# reference: largest difference over the tested t that it knows, of K in per cent, of the reaction in per cent of
# max(780 kN, its size). The table is that of the README.

# %%
from dataclasses import replace

from extrusion import cases, reference, run

CASES = {name: cases.CASES[name] for name in "BFGJ"} | {
    "B, Nitsche": replace(cases.B, method="nitsche", order=2, figures=()),
    "B, mortar": replace(cases.B, method="mortar", order=2, figures=()),
}
PROBLEM = {"B": "unilateral", "F": "bilateral", "G": "bilateral", "J": "mixed"}
known = reference.read()["problems"]


def flat(case):
    """The same in axisymmetry."""
    return replace(case, space="axisymmetric", element="lagrange", off_symmetry=0.0, figures=())


# %%
print("| case | dofs | solves | s | K % | R % | axisymmetric: dofs | solves | s | K % | R % | time ratio |")
print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
for name, case in CASES.items():
    cells, seconds = [name], []
    for scene in (case, flat(case)):
        run(scene, until=5)  # forms are compiled beforehand
        result = run(scene)
        found = {step.t: (step.points["K"][1], step.reaction) for step in result.steps}
        rows = reference.errors(known[PROBLEM[name[0]]]["elastic"], found).values()
        K, R = (100 * max(row[i] for row in rows) for i in (0, 2))
        seconds.append(result.seconds["solve"])
        stopped = "" if result.converged else f" (stopped at t = {result.t[-1]:g})"
        cells += [str(result.dofs), f"{result.iterations.sum()}{stopped}", f"{seconds[-1]:.2f}", f"{K:.2g}", f"{R:.2g}"]
    print(f"| {' | '.join(cells)} | {seconds[0] / seconds[1]:.0f} |", flush=True)
