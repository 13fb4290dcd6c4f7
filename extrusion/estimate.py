"""The cheapest model of a scene that is good enough, and how far off it is estimated to be.

A model is a rigid or elastic die, an order and an element size. What each choice costs in accuracy is estimated from
runs that are cheaper than the one in question:

- *size*: the scene with a rigid die on meshes of which each is half as fine as the next. The error of the finest is
  taken as its distance to the one before, that of the others as their distance to the finest. Against the converged
  reference the first is 1.3 to 4.6 times too large for K, and 0.8 to 3.1 times for the reaction (`verify --estimates`
  measures it anew);
- *order*: the distance of linear to quadratic elements on one of these meshes;
- *die*: the displacements of an elastic die under the forces of the rigid one, by a back-substitution, and what they do
  to K and the reaction, by a solve with the tangent (`Condensed.die_effect`): first order. At 4 mm it finds 0.93 to
  1.23 of the effect on K up to t = 140, and 0.4 of it at t = 155, where K has met the tip of the cone;
- *zone*: a zone whose gap stays wide open is left out, which changes nothing;
- *space*: a scene in three dimensions is solved as axisymmetric, which it is.

Errors are the largest over all steps: relative of K; of the reaction relative to its size, or to its largest before the
billet's front is in contact where that is more.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from extrusion.cases import Case
from extrusion.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

    from extrusion.stepping import Step

log = logging.getLogger(__name__)

Goal = Literal["K", "reaction"]
GOALS: tuple[Goal, ...] = ("K", "reaction")

LADDER = (0.16, 0.08, 0.04, 0.02, 0.01, 0.005)
"""Element sizes that are tried, as parts of the billet's radius."""

RATE = 1.5
"""Order in the size that says beforehand whether a finer mesh can reach a tolerance."""

OPEN = 0.1
"""A zone whose gap is never below this part of the billet's radius is left out."""


@dataclass(frozen=True)
class Error:
    """Estimated errors, relative, the largest over all steps."""

    K: float
    reaction: float

    def __add__(self, other: Error) -> Error:
        return Error(self.K + other.K, self.reaction + other.reaction)

    def of(self, goal: Goal) -> float:
        """That of one goal."""
        return float(getattr(self, goal))


NONE = Error(0.0, 0.0)


@dataclass(frozen=True)
class Part:
    """A simplification: whether the model has it, and what it costs."""

    name: str
    taken: bool
    error: Error


@dataclass(frozen=True)
class Estimate:
    """What a model was chosen for, and how far off it is estimated to be."""

    goal: Goal
    tolerance: float
    error: Error
    parts: tuple[Part, ...]
    reaction_scale: float  # N: what the reaction's error is relative to, or its own size where that is more

    def lines(self) -> list[str]:
        """In words."""
        out = [f"estimated error at any step: K {self.error.K:.1e}, reaction {self.error.reaction:.1e} (relative)"]
        for part in self.parts:
            word = "taken" if part.taken else "not taken"
            out.append(f"{part.name}: {word}, costs {part.error.K:.1e} of K, {part.error.reaction:.1e} of the reaction")
        return out

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Track:
    """K (mm) and the reaction (N) at each t of a run."""

    t: tuple[float, ...]
    K: tuple[float, ...]
    reaction: tuple[float, ...]

    @classmethod
    def of(cls, steps: Sequence[Step]) -> Track:
        """From accepted steps."""
        return cls(tuple(s.t for s in steps), tuple(s.points["K"][1] for s in steps), tuple(s.reaction for s in steps))

    def distance(self, other: Track, scale: float) -> Error:
        """Largest differences to a better run with the same steps."""
        K, R = np.array(other.K), np.array(other.reaction)
        return Error(
            float(np.max(np.abs(self.K - K) / np.maximum(np.abs(K), np.finfo(float).tiny), initial=0.0)),
            float(np.max(np.abs(self.reaction - R) / np.maximum(np.abs(R), scale), initial=0.0)),
        )


def reaction_scale(steps: Sequence[Step]) -> float:
    """Largest reaction before any zone but the first is in contact, N."""
    early = [abs(s.reaction) for s in steps if not any(z.closed.any() for z in list(s.zones.values())[1:])]
    return max(early or [abs(s.reaction) for s in steps], default=0.0) or 1.0


def continuous(case: Case, **changes: Any) -> Case:
    """The scene of a case as a continuous problem: Nitsche's method along rays, the billet slave, no third dimension.

    Raises:
        InputError: The scene is not axisymmetric.
    """
    if case.off_symmetry:
        remedy = "no model is chosen for a scene that is not axisymmetric: leave it or the tolerance out"
        raise InputError("off_symmetry", case.off_symmetry, remedy)
    zones = tuple(dataclasses.replace(zone, slave="billet", gap=None, smooth=False) for zone in case.zones)
    plain: dict[str, Any] = dict(
        zones=zones, method="nitsche", order=2, form=None, gamma=None, theta=0, mesh=None, size=None, sectors=None,
        element="lagrange", space="axisymmetric" if case.space == "3d" else case.space,
    )  # fmt: skip
    return dataclasses.replace(case, **{**plain, **changes})


def solve(case: Case, comm: MPI.Intracomm, stiff_die: bool = False) -> tuple[list[Step], list[tuple[float, float]]]:
    """Steps of a run, and with ``stiff_die`` what an elastic die would change at each, to first order. Collective."""
    from extrusion.condensed import Condensed
    from extrusion.mesh import case_mesh, on_root
    from extrusion.newton import Newton
    from extrusion.problem import Problem
    from extrusion.stepping import steps

    problem = Problem(case, on_root(comm, lambda: case_mesh(case.profile, case.mesh_size)), comm)
    system = Condensed(problem, stiff_die)
    done, effects = [], []
    for step in steps(system, Newton(system), case.times()):
        done.append(step)
        if stiff_die:
            effects.append(system.die_effect(system.x))
    return done, effects


def choose_model(case: Case, tolerance: float, goal: Goal, comm: MPI.Intracomm) -> tuple[Case, Estimate]:
    """The cheapest model of the case's scene whose estimated error is below a tolerance. Collective.

    Args:
        case: Its scene and increments count, its own discretisation does not.
        tolerance: Relative, of the goal.
        goal: "K" or "reaction".
        comm: Ranks that share the work.

    Raises:
        InputError: The tolerance or the goal is no such thing, or no mesh that is tried reaches it.
        StepError: An increment could not be solved.
    """
    if goal not in GOALS:
        raise InputError("goal", goal, f"choose one of {', '.join(GOALS)}")
    if not isinstance(tolerance, int | float) or not math.isfinite(tolerance) or not 0 < tolerance < 1:
        raise InputError("tolerance", tolerance, "give a relative error between 0 and 1")
    sizes = [float(f"{part * case.profile.radius:.6g}") for part in LADDER]
    scene = continuous(case)
    tell_space(case, comm)
    scene, zone_parts = _without_open_zones(scene, sizes[0], comm)
    _tell(comm, "%g mm, rigid die, and what an elastic one would change", sizes[0])
    elastic = case.die == "elastic"

    first, effects = solve(dataclasses.replace(scene, size=sizes[0]), comm, stiff_die=elastic)
    scale = reaction_scale(first)
    tracks = [Track.of(first)]
    die = NONE
    if elastic:
        moved = Track(
            tracks[0].t,
            tuple(K + dK for K, (dK, _) in zip(tracks[0].K, effects, strict=True)),
            tuple(R + dR for R, (_, dR) in zip(tracks[0].reaction, effects, strict=True)),
        )
        die = tracks[0].distance(moved, scale)
    rigid = dataclasses.replace(scene, die="rigid")
    with _unwarned():
        linear = Track.of(solve(dataclasses.replace(rigid, order=1, size=sizes[1]), comm)[0])
    by_symmetry = (Part("axisymmetry instead of three dimensions", True, NONE),) if scene.axisymmetric else ()

    for level in range(1, len(sizes)):
        tracks.append(Track.of(solve(dataclasses.replace(rigid, size=sizes[level]), comm)[0]))
        finest = tracks[-1]
        by_size = [track.distance(finest, scale) for track in tracks[:-1]]
        by_size.append(finest.distance(tracks[-2], scale))
        by_order = linear.distance(finest, scale)
        # from the cheapest on: (order, size, rigid, error)
        models = [(1, sizes[1], by_order), *((2, h, error) for h, error in zip(sizes, by_size, strict=False))]
        for is_rigid in (True, False) if elastic else (True,):
            for order, size, error in models:
                total = error + (die if is_rigid and elastic else NONE)
                if total.of(goal) > tolerance:
                    continue
                parts = [
                    *by_symmetry,
                    *zone_parts,
                    *([Part("rigid instead of elastic die", is_rigid, die)] if elastic else []),
                    Part(f"linear instead of quadratic elements, {sizes[1]:g} mm", order == 1, by_order),
                    *(
                        Part(f"quadratic elements, {h:g} mm", order == 2 and h == size, one)
                        for h, one in zip(sizes, by_size, strict=False)
                    ),
                ]
                chosen = dataclasses.replace(scene, die="rigid" if is_rigid else "elastic", size=size)
                chosen = dataclasses.replace(chosen, order=1) if order == 1 else chosen
                return chosen, Estimate(goal, tolerance, total, tuple(parts), scale)
        left = len(sizes) - 1 - level
        reachable = by_size[-1].of(goal) / 2 ** (RATE * left)
        if reachable > tolerance:
            remedy = (
                f"{sizes[-1]:g} mm, the finest mesh that is tried, is expected to reach {reachable:.1e}: give no less"
            )
            raise InputError("tolerance", tolerance, remedy)
        _tell(comm, "%g mm: estimated error of %s %.1e; the next mesh", sizes[level], goal, by_size[-1].of(goal))
    raise InputError("tolerance", tolerance, f"{sizes[-1]:g} mm, the finest mesh that is tried, does not reach it")


def tell_space(case: Case, comm: MPI.Intracomm) -> None:
    """Say so where `continuous` leaves a dimension out."""
    if case.space == "3d":
        _tell(comm, "the three dimensions of case %s have an axis of symmetry: solved as axisymmetric", case.name)


def _tell(comm: MPI.Intracomm, message: str, *values: object) -> None:
    if comm.rank == 0:
        log.info(message, *values)


@contextmanager
def _unwarned() -> Iterator[None]:
    """Without the warning that linear triangles lock: here they are tried to see how much they do."""
    logger = logging.getLogger("extrusion.problem")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def _without_open_zones(scene: Case, size: float, comm: MPI.Intracomm) -> tuple[Case, list[Part]]:
    """The scene without the zones (after the first) that a run on a coarse mesh finds wide open at every step."""
    if len(scene.zones) < 2:
        return scene, []
    coarse, _ = solve(dataclasses.replace(scene, die="rigid", size=size), comm)
    keep, parts = [scene.zones[0]], []
    end = max(scene.profile.points[name][1] for name in scene.profile.bore)
    past = max(float(np.max(step.zones[keep[0].name].x[:, 1])) for step in coarse) > end
    for zone in scene.zones[1:]:
        least = min(float(np.min(step.zones[zone.name].gap)) for step in coarse)
        wide = least > OPEN * scene.profile.radius
        # with another zone nothing is let go past the die's end: without it, it would be
        if wide and not past and scene.zones[0].contact != "bilateral":
            parts.append(Part(f"no zone {zone.name} (its gap is never below {least:.3g} mm)", True, NONE))
        else:
            keep.append(zone)
    return dataclasses.replace(scene, zones=tuple(keep)), parts


@dataclass(frozen=True)
class Check:
    """An estimate beside the actual error, against the converged reference (`extrusion.reference`)."""

    name: str
    model: str
    goal: Goal
    estimated: float
    actual: float
    bar: float  # the reference's own, relative

    LEAST, MOST = 0.5, 10.0

    @property
    def ratio(self) -> float:
        """Estimated over actual."""
        return self.estimated / self.actual if self.actual else math.inf

    @property
    def ok(self) -> bool:
        """At most twice too small, and ten times too large, where the reference can tell."""
        return self.ratio >= self.LEAST and (self.ratio <= self.MOST or self.estimated <= 2 * self.bar)


TOLERANCES: tuple[tuple[float, Goal], ...] = ((2e-3, "K"), (1e-3, "K"), (2e-4, "K"), (5e-2, "reaction"))
"""For which `checks` chooses models."""


def checks(comm: MPI.Intracomm) -> Iterator[Check]:
    """Estimated and actual errors of the sheet's cases in the plane, and of models chosen for a tolerance. Collective.

    The error of a case on the sheet's own mesh is estimated as its distance to the default method at 4 mm.
    """
    from extrusion import cases, reference

    known = reference.read()["problems"]
    scenes = reference.problems()
    better: dict[str, Track] = {}
    for name, case in cases.CASES.items():
        if case.space == "3d":
            continue
        problem = _problem_of(case)
        # uniform increments, so that the run passes the reference's t
        case = case.with_increment(5.0, case.end)
        done, _ = solve(case, comm)
        if problem not in better:
            better[problem] = Track.of(solve(continuous(case, size=4.0), comm)[0])
        track, good = Track.of(done), better[problem]
        error = track.distance(good, reference.REACTION_SCALE)
        yield from _checks(name, f"{case.method}, P{case.order}, sheet", error, track, known[problem]["elastic"])
    for problem, scene in scenes.items():
        for tolerance, goal in TOLERANCES:
            chosen, estimate = choose_model(scene, tolerance, goal, comm)
            with _unwarned():
                track = Track.of(solve(chosen, comm)[0])
            model = f"{chosen.die}, P{chosen.order}, {chosen.size:g} mm"
            yield from _checks(
                f"{problem}, {goal} {tolerance:g}", model, estimate.error, track, known[problem]["elastic"]
            )


def _problem_of(case: Case) -> str:
    """Which of the reference's problems a case of the sheet discretises."""
    if all(zone.contact == "unilateral" for zone in case.zones):
        return "unilateral"
    return "mixed" if len(case.zones) > 1 else "bilateral"


def _checks(name: str, model: str, error: Error, track: Track, known: list[dict[str, Any]]) -> Iterator[Check]:
    from extrusion.reference import errors

    found = {t: (K, R) for t, K, R in zip(track.t, track.K, track.reaction, strict=True)}
    rows = np.array([*errors(known, found).values()])
    K, bar_K, R, bar_R = rows.max(axis=0)
    yield Check(name, model, "K", error.K, float(K), float(bar_K))
    yield Check(name, model, "reaction", error.reaction, float(R), float(bar_R))
