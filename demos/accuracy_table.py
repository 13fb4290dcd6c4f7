"""The README's table of accuracy: every method on a few meshes, beside the converged reference.

    python demos/accuracy_table.py

Columns: all unknowns; linear solves of the whole run; K t: u_y of K at t (mm), and its relative difference from the
reference (%); R t: reaction on the rear face at t (kN, whole revolution), and its difference (% of 780 kN, or of itself
if that is more); p 50: difference of the contact pressure along the side at t = 50, averaged over 2 mm (L2 norm, %);
s: solve phase. The first row of each table is the reference with its error bars.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from extrusion import Result, cases, run
from extrusion.reference import REACTION_SCALE, STATIONS, pressure_at_stations, read

HEAD = [
    *("method", "order", "mesh", "dofs", "iterations"),
    *("K 20", "K 50", "K 155", "R 20", "R 50", "R 70", "p 50", "s"),
]

SETTINGS: list[tuple[str, int, float | None]] = [  # method, order, size in mm (None: the sheet's divisions)
    *(("penalty", order, size) for order in (1, 2) for size in (None, 4.0)),
    *(
        (method, order, size)
        for method in ("nodal", "nitsche", "mortar")
        for order, sizes in ((1, (None, 4.0)), (2, (None, 4.0, 2.0, 1.0)))
        for size in sizes
    ),
]


def row(result: Result, reference: dict[float, dict[str, Any]]) -> Iterator[str]:
    """What was run, and its figures with their differences from the reference."""
    case = result.case
    yield from (case.method, f"P{case.order}", "sheet" if case.size is None else f"{case.size:g} mm")
    yield from (str(result.dofs), str(result.iterations.sum()))
    if not result.converged:
        yield from [str(result.error), *[""] * 7]
        return
    at = {step.t: step for step in result.steps}
    for t in (20, 50, 155):
        K, exact = at[t].points["K"][1], reference[t]["K"]
        yield f"{K:.4f} ({100 * (K / exact - 1):+.3f})"
    for t in (20, 50, 70):
        R, exact = at[t].reaction, reference[t]["reaction"]
        yield f"{R / 1e3:.1f} ({100 * (R - exact) / max(REACTION_SCALE, abs(exact)):+.1f})"
    side, exact = at[50].zones["1"], np.array(reference[50]["pressure"])
    nodal = case.method == "nodal"
    p = np.interp(STATIONS, side.s, side.ray_pressure) if nodal else pressure_at_stations(side)
    yield f"{100 * np.linalg.norm(p - exact) / np.linalg.norm(exact):.1f}"
    yield f"{result.seconds['solve']:.1f}"


def reference_row(reference: dict[float, dict[str, Any]]) -> Iterator[str]:
    """The reference's figures with their error bars."""
    yield from ("reference", "", "", "", "")
    for t in (20, 50, 155):
        yield f"{reference[t]['K']:.4f} ± {reference[t]['K_error']:.4f}"
    for t in (20, 50, 70):
        yield f"{reference[t]['reaction'] / 1e3:.1f} ± {reference[t]['reaction_error'] / 1e3:.1f}"
    yield from ("", "")


def main() -> None:
    """Print a table for the elastic die, and one for the rigid."""
    for die in ("elastic", "rigid"):
        reference = {one["t"]: one for one in read()["problems"]["unilateral"][die]}
        print(f"\n{die.capitalize()} die:\n")
        print("| " + " | ".join(HEAD) + " |")
        print("|---|---|---" + "|---:" * (len(HEAD) - 3) + "|")
        print("| " + " | ".join(reference_row(reference)) + " |")
        for method, order, size in SETTINGS:
            result = run(cases.A, die=die, method=method, order=order, size=size)
            print("| " + " | ".join(row(result, reference)) + " |", flush=True)


if __name__ == "__main__":
    main()
