"""The README's table of adapted against graded meshes: case A's problem, elastic die, `nitsche` on P2.

    python demos/adapted_meshes.py

Columns: all unknowns; the largest errors of K and of the reaction over the reference's t, relative; on adapted meshes
the error that was estimated for the goal. Needs gmsh; takes some two minutes.
"""

from extrusion import run
from extrusion.adapt import estimated, refined
from extrusion.estimate import GOALS
from extrusion.mesh import PlainMesh, graded_mesh
from extrusion.profile import SSNV504
from extrusion.reference import errors, problems, read

CASE = problems()["unilateral"]
KNOWN = read()["problems"]["unilateral"]["elastic"]


def row(name: str, mesh: PlainMesh, estimate: str = "") -> None:
    """Print a mesh's dofs and actual errors."""
    result = run(CASE, mesh=mesh)
    found = {step.t: (step.points["K"][1], step.reaction) for step in result.steps}
    of_K, _, of_reaction, _ = (max(column) for column in zip(*errors(KNOWN, found).values(), strict=True))
    print(f"| {name} | {result.dofs} | {of_K:.1e} | {of_reaction:.1e} | {estimate} |", flush=True)


def main() -> None:
    """Graded meshes, then three passes for each goal from the coarsest of them on."""
    print("| mesh | dofs | K | reaction | estimated |\n|---|---:|---:|---:|---:|")
    for size in (8.0, 4.0, 2.0, 1.0):
        row(f"graded {size:g} mm", graded_mesh(SSNV504, size))
    for goal in GOALS:
        mesh = graded_mesh(SSNV504, 8.0)
        _, eta, _ = estimated(CASE, mesh, goal)
        for number in (1, 2, 3):
            mesh = refined(SSNV504, mesh, eta)
            error, eta, _ = estimated(CASE, mesh, goal)
            row(f"for {goal}, pass {number}", mesh, f"{goal} {error.of(goal):.1e}")


if __name__ == "__main__":
    main()
