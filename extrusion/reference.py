"""A converged reference of our own: K, reaction and pressure along the side, each with an error bar.

Three continuous problems (both zones unilateral; zone 1 bilateral alone; zone 1 bilateral and zone 2 unilateral), each
with the elastic and with the rigid die, are solved with Nitsche's method on P2 elements (defaults) on a series of
graded meshes, each half as fine as the next. The value is that of the finest; its error bar is the largest of its
distances to the level before and to the mortar method on the finest mesh but one, so that it covers both the
discretisation and the law.

``python -m extrusion.reference`` makes ``extrusion/data/reference.json`` anew (about ten minutes on two cores).
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from extrusion import cases
from extrusion.cases import Case

if TYPE_CHECKING:
    from extrusion.pairs import ContactState

Array = NDArray[np.float64]

TIMES = (10.0, 20.0, 50.0, 70.0, 85.0, 100.0, 140.0, 155.0)
"""Displacements of the rear face at which the reference stands, mm."""

SIZES = (4.0, 2.0, 1.0, 0.5, 0.25)
"""Element sizes on the billet's side, mm."""

REACTION_SCALE = 7.8e5
"""N: the reaction's largest value up to t = 135; its error is taken relative to the larger of this and itself."""

STATIONS = np.linspace(0.0, 65.0, 131)
"""Reference distance from M along the side at which the pressure is stored, mm."""

DATA = Path(__file__).parent / "data" / "reference.json"


def problems() -> dict[str, Case]:
    """The continuous problems, without a discretisation of the sheet's: ``unilateral``, ``bilateral``, ``mixed``."""
    side, front = cases.SIDE, cases.FRONT
    held = replace(side, contact="bilateral")
    zones = {"unilateral": (side, front), "bilateral": (held,), "mixed": (held, front)}
    return {
        name: Case(name=name, zones=pair, increments=((5.0, 140.0 if name == "bilateral" else 155.0),))
        for name, pair in zones.items()
    }


def read() -> dict[str, Any]:
    """The stored reference: problem -> die -> list of ``{t, K, K_error, reaction, reaction_error, pressure, ...}``."""
    data: dict[str, Any] = json.loads(DATA.read_text())
    return data


def errors(
    reference: list[dict[str, Any]], found: dict[float, tuple[float, float]]
) -> dict[float, tuple[float, float, float, float]]:
    """Errors of K (relative) and of the reaction (of max(7.8e5 N, its size)) against a reference.

    Args:
        reference: One problem and die of `read`.
        found: t -> (u_y of K in mm, reaction in N).

    Returns:
        t -> error of K, the reference's own error bar of it, error of the reaction, its error bar; all relative.
    """
    out = {}
    for row in reference:
        if row["t"] in found:
            K, reaction = found[row["t"]]
            scale = max(REACTION_SCALE, abs(row["reaction"]))
            out[row["t"]] = (
                abs(K / row["K"] - 1),
                row["K_error"] / abs(row["K"]),
                abs(reaction - row["reaction"]) / scale,
                row["reaction_error"] / scale,
            )
    return out


def pressure_at_stations(state: ContactState) -> Array:
    """Contact pressure along the ray at `STATIONS`, MPa: averages over 2 mm weighted with the area.

    Averages, since at C and D the pressure has logarithmic peaks whose height at a point means nothing.
    """
    distance = 65.0 - state.s if state.x[0, 1] > state.x[-1, 1] else state.s
    order = np.argsort(distance)
    distance, area = distance[order], state.weight[order]
    force = state.ray_pressure[order] * area
    low, high = (np.searchsorted(distance, STATIONS + shift) for shift in (-1.0, 1.0))
    total = np.append(0.0, np.cumsum(force)), np.append(0.0, np.cumsum(area))
    weight = total[1][high] - total[1][low]
    return np.asarray((total[0][high] - total[0][low]) / np.where(weight > 0, weight, np.inf))


def solve(case: Case) -> list[dict[str, Any]]:
    """K, reaction and pressure of one discretised problem at `TIMES`."""
    from extrusion.condensed import choose
    from extrusion.mesh import case_mesh
    from extrusion.newton import Newton
    from extrusion.problem import Problem
    from extrusion.stepping import steps

    problem = Problem(case, case_mesh(case.profile, case.size))
    system = choose(problem)
    return [
        {
            "t": step.t,
            "K": step.points["K"][1],
            "reaction": step.reaction,
            "pressure": pressure_at_stations(step.zones["1"]),
            "iterations": step.iterations,
            "dofs": problem.dofs,
        }
        for step in steps(system, Newton(system), [t for t in TIMES if t <= case.end])
    ]


def make(sizes: tuple[float, ...] = SIZES) -> dict[str, Any]:
    """Solve everything; prints a line a run."""
    out: dict[str, Any] = {"sizes": sizes, "stations": STATIONS.tolist(), "problems": {}}
    for name, base in problems().items():
        out["problems"][name] = {}
        for die in ("elastic", "rigid"):
            levels = []
            for size in sizes:
                levels.append(solve(replace(base, die=die, size=size)))
                print(name, die, size, [f"{row['K']:.6f}" for row in levels[-1]], file=sys.stderr, flush=True)
            mortar = solve(replace(base, die=die, size=sizes[-2], method="mortar"))
            rows = []
            for i, (fine, coarse, other) in enumerate(zip(levels[-1], levels[-2], mortar, strict=True)):

                def bar(key: str, fine: Any = fine, coarse: Any = coarse, other: Any = other) -> Any:
                    return np.maximum(np.abs(fine[key] - coarse[key]), np.abs(fine[key] - other[key]))

                rows.append(
                    {
                        "t": fine["t"],
                        "K": fine["K"],
                        "K_error": float(bar("K")),
                        "reaction": fine["reaction"],
                        "reaction_error": float(bar("reaction")),
                        "pressure": np.round(fine["pressure"], 4).tolist(),
                        "pressure_error": np.round(bar("pressure"), 4).tolist(),
                        "levels": [[level[i]["dofs"], level[i]["K"], level[i]["reaction"]] for level in levels],
                        "mortar": [other["dofs"], other["K"], other["reaction"]],
                    }
                )
            out["problems"][name][die] = rows
    return out


if __name__ == "__main__":
    data = make()
    DATA.parent.mkdir(exist_ok=True)
    DATA.write_text(json.dumps(data, indent=None, separators=(",", ":")) + "\n")
