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

# %% [markdown]
# The error by size of element: order 2 on the sheet's divisions, on 0.6 and on twice as many, rigid die (minutes).


# %%
def divided(case, by):
    """Every edge of the profile, and the quarter turn, in so many times as many parts."""
    divisions = tuple((a, b, max(1, round(n * by))) for a, b, n in case.profile.divisions)
    return replace(case, profile=replace(case.profile, divisions=divisions), sectors=2 * round(5 * by))


print("\n| method | divisions | dofs | solves | s | K % | R % |")
print("|---|---:|---:|---:|---:|---:|---:|")
for method in ("nitsche", "mortar"):
    for by in (0.6, 1.0, 2.0):
        scene = replace(cases.B, method=method, order=2, die="rigid", figures=())
        result = run(divided(scene, by), solver="surface")
        found = {step.t: (step.points["K"][1], step.reaction) for step in result.steps}
        rows = reference.errors(known["unilateral"]["rigid"], found).values()
        K, R = (100 * max(row[i] for row in rows) for i in (0, 2))
        cells = (by, result.dofs, result.iterations.sum(), f"{result.seconds['solve']:.0f}", f"{K:.2g}", f"{R:.2g}")
        print(f"| {method} | {' | '.join(map(str, cells))} |", flush=True)
