"""Load stepping: a table of increments into accepted steps.

An increment that does not converge is cut in half, and grows again once it does. The driver yields each accepted step;
files, pictures and progress bars observe it, and the loop does not know them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

from petsc4py import PETSc

import numpy as np

from extrusion.cases import Case
from extrusion.errors import StepError
from extrusion.newton import Newton, Outcome
from extrusion.pairs import ContactState
from extrusion.system import Forecast, System

log = logging.getLogger(__name__)

MAX_CUTS = 8
"""Halvings of an increment before it is given up."""

CAUGHT = 1e-3
"""A glissière that takes hold of a point farther than this (of the billet's radius) from the die is warned of."""

PASSES = 30
"""Geometry passes of one increment (nodal contact) before it is cut."""

ROUGH = 4
"""Passes that may be solved roughly, as long as the pairing still changes by a tenth of the increment."""

AT_MOST = 1
"""Linear solves of a rough pass, beside the one that takes the contact set of the pass before."""

ROUGHLY = 1e-4
"""Part of its first residual at which a rough pass may end."""

SETTLE = 3
"""Passes after which a node that rests on a die vertex stays with the facet it had."""

DAMP = 8
"""Passes after which billet and die are paired halfway between the last two solutions."""

SOFT = 10.0
"""Contact stiffness (`Case.gamma_of`) that an increment is solved with at once; it is led to a larger one (`_led`)."""

STIFFEN = 10.0
"""Ratio of the contact stiffness between two solves that lead to a large one."""

LEAST = 1.5
"""The ratio below which this is given up."""

LED = 1e-2
"""Part of its first residual at which a solve on the way may end."""

PATIENCE = 20
"""Linear solves on the way to a stiffness before a shorter one is tried."""

PASS_TOLERANCE = 0.01
"""Passes stop when the displacement increment changes by less than this part of itself (the sheet's RESI_GEOM)."""


@dataclass(frozen=True)
class Step:
    """An accepted step."""

    t: float  # displacement of the rear face, mm
    points: dict[str, tuple[float, float]]  # displacement (u_r, u_y) of named points, mm
    reaction: float  # axial force on the rear face, N, whole revolution, positive when it pushes the billet in +y
    die_reaction: float  # axial force of the die's supports on the die, N, whole revolution
    energy: float  # elastic energy, N mm
    iterations: int  # linear solves, over all passes and cuts
    tangents: int  # how many of these were with a new tangent
    passes: int  # geometry passes of the accepted increment
    cuts: int
    residual: float  # N
    gap: dict[str, float]  # at the named slave points, mm
    caught: dict[str, float]  # per bilateral zone: how far from the die the points were that it now holds for good, mm
    zones: dict[str, ContactState] = field(repr=False)
    recover: Callable[[], PETSc.Vec] = field(repr=False, compare=False)  # as long as no other step has been taken

    @property
    def x(self) -> PETSc.Vec:
        """All displacements, mm (`Problem.x`). Live, and collective: copy what must outlast the step.

        Raises:
            RuntimeError: The next step has been taken, or the run is over.
        """
        return self.recover()


def steps(
    problem: System, newton: Newton, times: list[float], foreseen: Callable[[float], Forecast | None] | None = None
) -> Iterator[Step]:
    """Drive the billet through the times (mm), yielding accepted steps.

    Args:
        problem: The scene.
        newton: What solves an increment.
        times: Displacements of the rear face, increasing, mm.
        foreseen: Gives the forecast for each of them, if there is one (`extrusion.guide.Guide`).

    Raises:
        StepError: An increment could not be solved even when cut; its message gives time, zone, place and remedy.
    """
    x, accepted = problem.x, problem.x.duplicate()
    x.set(0.0)
    problem.start(x)
    problem.place_billet(x)
    caught = _caught(problem, 0.0)
    points = problem.named_points()
    t, rate, last, live = 0.0, x.duplicate(), 0.0, _Live(problem)
    problem.shift_billet(rate, 1.0)  # du/dt that predicts the next increment: rigid at first, then that of the last one
    for target in times:
        cuts = iterations = passes = 0
        tangents = newton.tangents
        dt = target - t
        least = dt / 2**MAX_CUTS
        while t < target:
            goal = target if t + 1.001 * dt >= target else t + dt
            dt = goal - t
            x.copy(accepted)
            ahead = dt / last if last else 1.0
            forecast = foreseen(target) if foreseen is not None and not cuts else None
            for start in (ahead,) if forecast is None else (replace(forecast, ahead=ahead), ahead):
                accepted.copy(x)
                x.axpy(dt, rate)
                problem.drive(x, goal)
                problem.forget_pattern()
                outcome = _increment(problem, newton, accepted, start)
                iterations += outcome.iterations
                if outcome.converged:
                    break
            if outcome.converged:
                try:
                    states = problem.accept(x)
                except ArithmeticError as error:
                    outcome = replace(outcome, converged=False, reason=str(error))
            if outcome.converged:
                t, passes, last = goal, outcome.passes, dt
                for zone, distance in _caught(problem, t).items():
                    caught[zone] = max(distance, caught[zone])
                rate.waxpy(-1.0, accepted, x)
                rate.scale(1 / dt)
                dt *= 2
                continue
            cuts += 1
            dt /= 2
            rate.set(0.0)
            problem.shift_billet(rate, 1.0)
            place = problem.worst(x)
            accepted.copy(x)
            problem.pair_up(x)
            if dt < 0.999 * least:
                raise StepError(
                    f"step to t = {goal:.6g} mm not solved after {cuts - 1} cuts: {outcome.reason}; {place}. "
                    f"{outcome.remedy or _remedy(problem.case)}"
                )
            log.info("t = %.6g mm: %s; %s; cut to %.3g mm", goal, outcome.reason, place, dt)
        rear, die, energy = problem.balance(x)
        yield Step(
            t=t,
            points=problem.point_displacements(x, points),
            reaction=rear,
            die_reaction=die,
            energy=energy,
            iterations=iterations,
            tangents=newton.tangents - tangents,
            passes=passes,
            cuts=cuts,
            residual=outcome.residual,
            gap=problem.point_gaps(x),
            caught=caught,
            zones=states,
            recover=live.of_next(),
        )
        caught = dict.fromkeys(caught, 0.0)


class _Live:
    """The displacements of the step that has been taken last."""

    def __init__(self, problem: System) -> None:
        self._problem, self._number = problem, 0

    def of_next(self) -> Callable[[], PETSc.Vec]:
        """What gives those of the next step, as long as it is the last."""
        self._number += 1
        return partial(self._recover, self._number)

    def _recover(self, number: int) -> PETSc.Vec:
        if number != self._number:
            raise RuntimeError("the field of a step is gone once the next one is taken: copy what must outlast it")
        return self._problem.recover(self._problem.x)


def _remedy(case: Case) -> str:
    """What else may solve a step."""
    if case.method in ("nitsche", "mortar") and case.order == 2:
        other = "nitsche" if case.method == "mortar" else "mortar"
        if other == "mortar" and any(zone.slave == "die" for zone in case.zones):  # which it does not know
            return "Try another --increment or a finer mesh"
        return f"Try another --increment, a finer mesh, or --method {other}"
    return "Try another --increment, a finer mesh, or --method nitsche or mortar on P2"


def _caught(problem: System, t: float) -> dict[str, float]:
    """What each bilateral zone has just taken hold of, with a warning where that was far from the die."""
    out = {term.pair.name: term.caught for term in problem.terms if term.pair.closure == "bilateral"}
    for zone, distance in out.items():
        if distance > CAUGHT * problem.case.profile.radius and problem.comm.rank == 0:
            log.warning("t = %.6g mm: zone %s holds points that were up to %.3g mm from the die", t, zone, distance)
    return out


@dataclass(frozen=True)
class _Attempt:
    converged: bool
    iterations: int
    passes: int
    residual: float
    reason: str
    remedy: str = ""


def _increment(problem: System, newton: Newton, accepted: PETSc.Vec, ahead: float | Forecast) -> _Attempt:
    """Solve one predicted increment, in place; ``ahead`` as `Newton.solve` has it.

    With frozen pairing that takes geometry passes (two at least, as the sheet).

    Without, once is enough, unless a mortar row that is just leaving the die flips between held and let go: then these
    rows are frozen, and may only grow in number.
    """
    x = problem.x
    frozen = problem.case.method == "nodal" and problem.n_multipliers > 0
    iterations, change = 0, x.duplicate()
    seen: list[float] = []
    previous = x.duplicate()
    # while the pairing still changes much, few iterations are as good as many: worth it where they are dear
    rough = frozen and problem.case.space == "3d"
    for attempt in range(1, PASSES + 1):
        settle, damp = attempt > (SETTLE if frozen else 1), frozen and attempt > DAMP
        problem.pair_up(x, settle, previous if damp else None)
        x.copy(previous)
        rough &= attempt <= ROUGH
        if frozen:
            few, share = (AT_MOST, ROUGHLY) if rough else (None, 0.0)
            outcome = newton.solve(x, few, 0.0 if attempt > 1 else ahead, share)
        else:
            outcome = _led(problem, newton, ahead)
        iterations += outcome.iterations
        if not outcome.converged and not (rough and np.isfinite(outcome.residual)):
            if attempt == 1 and problem.may_settle:
                previous.copy(x)
                continue
            return _Attempt(False, iterations, attempt, outcome.residual, outcome.reason)
        if not frozen:
            if problem.settled(x):
                break
            continue
        change.waxpy(-1.0, previous, x)
        moved = problem.largest_displacement(change)
        change.waxpy(-1.0, accepted, x)
        increment = problem.largest_displacement(change)
        if not rough and attempt >= 2 and moved <= PASS_TOLERANCE * increment:
            break
        rough &= moved > 10 * PASS_TOLERANCE * increment
        seen.append(moved)
    else:
        if not frozen:
            return _Attempt(False, iterations, PASSES, outcome.residual, "rows that leave the die do not settle")
        two = len(seen) > 4 and np.isclose(seen[-1], seen[-3], rtol=1e-3)
        reason = (
            f"the pairing {'flips between two states' if two else 'does not settle'} (last change {seen[-1]:.3g} mm)"
        )
        remedy = "A node rests on a die corner: change the --increment a little, or use --method nitsche"
        return _Attempt(False, iterations, PASSES, outcome.residual, reason, remedy)
    return _Attempt(True, iterations, attempt, outcome.residual, outcome.reason)


def _led(problem: System, newton: Newton, ahead: float | Forecast) -> Outcome:
    """Solve one predicted increment, in place: with a soft contact first, if it is stiff, and led from there.

    Where the gap is curved or changes facet an update is off by some part of its square; times a large stiffness that
    is a large force, which Newton's method answers by letting go. From a softer contact's solution the update is as
    short as that contact's penetration: ten times the stiffness then costs two to five solves, whatever the stiffness.
    Where that leads nowhere the increment is solved at once; and so it is at first where contact is only stiff because
    a slave is the stiffer body.
    """
    x, case = problem.x, problem.case
    if case.method not in ("penalty", "nitsche"):
        return newton.solve(x, ahead=ahead)
    soft = SOFT * STIFFEN if case.theta == 1 else SOFT  # which is not coercive below 27 to 36
    stiffest = max(case.gamma_of(zone) for zone in case.zones)
    iterations, at, ratio = 0, 0.0, STIFFEN

    def following(at: float, end: float) -> float:
        goal = max(soft, ratio * at)
        return end if goal > end / np.sqrt(ratio) else goal  # no further solve for a ratio as small as that

    if following(0.0, stiffest) == stiffest:
        return newton.solve(x, ahead=ahead)
    predicted, reached = x.duplicate(), x.duplicate()
    x.copy(predicted)
    at_once = following(0.0, case.contact_gamma) == case.contact_gamma
    if at_once:
        outcome = newton.solve(x, ahead=ahead)
        if outcome.converged:
            return outcome
        iterations, direct, failed = outcome.iterations, outcome, x.duplicate()
        x.copy(failed)
        predicted.copy(x)
    try:
        while True:
            goal = following(at, stiffest)
            problem.soften(goal if goal < stiffest else None)
            outcome = newton.solve(x, PATIENCE if at else None, None if at else ahead, LED if goal < stiffest else 0.0)
            iterations += outcome.iterations
            if outcome.converged:
                if goal == stiffest:
                    break
                at = goal
                x.copy(reached)
                continue
            while at and ratio > LEAST and following(at, stiffest) >= goal:
                ratio **= 0.5
            if not at or following(at, stiffest) >= goal:
                if at_once:
                    outcome = direct
                    failed.copy(x)
                else:
                    predicted.copy(x)
                    problem.soften(None)
                    outcome = newton.solve(x, ahead=ahead)
                    iterations += outcome.iterations
                break
            reached.copy(x)
    finally:
        problem.soften(None)
    return replace(outcome, iterations=iterations)
