# %% [markdown]
# # Discrete or continuous contact: what the sheet concludes, measured
#
# The sheet finds the continuous kind of contact (an augmented Lagrangian on the contact surface) quicker than the
# discrete one (constraints at nodes, by an active set). Here each of its axisymmetric cases is run with both on its own
# mesh, order and table of increments: `nodal` with the billet as slave and raw normals, and `mortar`. Their linear
# solves, cuts and seconds of the solve phase (medians of five runs in turn) are printed as the README's table.

# %%
import statistics
from dataclasses import replace

from extrusion import cases, run

RUNS = 5


def variant(case, method):
    """The case with one kind of contact; everything else is its own."""
    zones = tuple(replace(zone, slave="billet", smooth=False, gap=None) for zone in case.zones)
    return replace(case, method=method, zones=zones, figures=())


# %%
print("| case | discrete: solves | cuts | s | continuous: solves | cuts | s | time ratio |")
print("|---|---|---|---|---|---|---|---|")
ratios = {}
for name, case in cases.CASES.items():
    if case.space == "3d":
        continue
    seconds = {"nodal": [], "mortar": []}
    results = {}
    for _ in range(RUNS + 1):  # the first is the warm-up
        for method in seconds:
            results[method] = run(variant(case, method))
            seconds[method].append(results[method].seconds["solve"])
    cells = [name]
    for method, result in results.items():
        cuts = sum(step.cuts for step in result.steps)
        reached = "" if result.converged else f" (stopped at t = {result.t[-1]:g} mm)"
        cells += [f"{result.iterations.sum()}{reached}", str(cuts), f"{statistics.median(seconds[method][1:]):.2f}"]
    pairs = zip(seconds["nodal"][1:], seconds["mortar"][1:], strict=True)
    ratios[name] = statistics.median(a / b for a, b in pairs)
    print(f"| {' | '.join(cells)} | {ratios[name]:.2f} |")

# %% [markdown]
# The time ratio is discrete over continuous, run by run: above one the continuous kind is quicker. A run that stopped
# short shows what it had done until then.

# %%
assert all(ratio > 0 for ratio in ratios.values())
