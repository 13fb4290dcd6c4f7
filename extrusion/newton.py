"""Newton's method for one increment: SNES with absolute residuals in newtons, MUMPS, and a safeguarded step."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

from petsc4py import PETSc

import numpy as np

from extrusion.system import Forecast, System

REASONS = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}


FACTORS = (1.0, 0.5, 0.25, 0.1, 0.04)
"""Parts of a Newton update that are tried. The last two are for the billet's edge on the cone, on fine meshes."""

WATCH = 6
"""Steps in which the residual has to halve, lest it go round in a circle: else a whole one follows, whatever it brings.

The watchdog of Chamberlain, Powell, Lemaréchal, Pedersen, Math. Prog. Study 16 (1982) 1, doi:10.1007/BFb0120945.
"""

PREDICTED = 1e-3
"""Part of the right-hand side that the solve with the expected contact set may leave."""


@dataclass(frozen=True)
class Outcome:
    """What one nonlinear solve did."""

    converged: bool
    iterations: int  # linear solves
    residual: float  # N
    reason: str


class Newton:
    """SNES on the unknowns of a system.

    Each step is a part of the Newton update that lowers the residual's norm (`FACTORS`). The tangent takes the second
    variation of the gap (rotation of the die's facets, moving split points) once updates are small: it is indefinite
    at the die's corners, and from far away it misleads (CONTACT section 2).

    Args:
        problem: What is solved.
        atol: Absolute tolerance of the residual, N; not below the round-off of the forces that cancel in it.
        max_iterations: Linear solves before giving up.
        near: Largest update (mm) after which the second variation is used; by default half a facet, or the radius / 50.
        predicts: Whether the first linear solve of an increment takes the contact set that is expected in the die.
    """

    def __init__(
        self,
        problem: System,
        atol: float = 1e-6,
        max_iterations: int = 40,
        near: float | None = None,
        predicts: bool = True,
    ) -> None:
        self.problem, self.atol, self.predicts = problem, atol, predicts
        self._max = max_iterations
        facet = min((float(np.median(term.pair.slave.length)) for term in problem.terms), default=np.inf)
        self._near = min(0.02 * problem.case.profile.radius, 0.5 * facet) if near is None else near
        self.tangents = 0  # made so far
        self._begin()
        self._f = problem.x.duplicate()
        self._trial = problem.x.duplicate()
        self._trial_f = problem.x.duplicate()
        self._step = problem.x.duplicate()
        self.A = problem.tangent_without_contact()
        snes = PETSc.SNES().create(problem.comm)
        snes.setOptionsPrefix("extrusion_")
        snes.setType("newtonls")
        # SNES holds its callbacks in C, where no garbage collector looks: they must not hold this object, or neither it
        # nor the problem, with its communicators, would ever go
        me = weakref.proxy(self)
        self._hand_over = lambda snes, x, A, P: me._tangent(x)
        snes.setFunction(lambda snes, x, f: me._residual(x, f), self._f)
        snes.setJacobian(self._hand_over, self.A)
        snes.setConvergenceTest(lambda snes, it, norms: me._test(it, norms))
        snes.getLineSearch().setType("basic")
        snes.setLineSearchPreCheck(lambda x, y, *_: me._shorten(x, y))
        problem.set_solver(snes.getKSP())
        snes.setFromOptions()
        self.snes = snes

    def _begin(self) -> None:
        """Forget the last solve."""
        self.history: list[float] = []
        self._update, self._fresh, self._watched = np.inf, False, 0
        self._whole = False  # whether the last step was taken whole

    def _tangent(self, x: PETSc.Vec) -> None:
        """Hand SNES the tangent: the one it has, where that will do; where the pattern has grown, a new matrix."""
        ratio = self.history[-1] / self.history[-2] if len(self.history) > 1 else np.inf
        # as closely as the method converges (Eisenstat, Walker, SIAM J. Sci. Comput. 17 (1996) 16,
        # doi:10.1137/0917003)
        self.problem.set_accuracy(self.snes.getKSP(), self.tolerance, 0.1 * ratio**2)
        # where the last step has left a part e of the residual, another with the same tangent leaves 2 e of the rest
        # (Kelley, Iterative Methods for Linear and Nonlinear Equations (1995) 5.4, doi:10.1137/1.9781611970944)
        if self.problem.keeps_tangents and self._whole and 2 * ratio * self.history[-1] <= self.tolerance:
            return
        self.tangents += 1
        near = self._update < self._near
        if near:
            self.problem.hold(x)  # each time: what has left its facet is held to the next one
        A = self.problem.tangent(x, near)
        if A != self.A:
            self._last_A, self.A = self.A, A  # SNES still looks at the old one on its way out of this call
            self.snes.setJacobian(self._hand_over, A)

    def _residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        if self._fresh:  # the line search has just evaluated it here
            self._trial_f.copy(f)
            self._fresh = False
        else:
            self.problem.residual(x, f)

    def _shorten(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Scale the update y to the first of `FACTORS` that lowers the residual, or else to the best.

        SNES then takes x - y whole.
        """
        before = self.history[-1]
        if len(self.history) > self._watched + WATCH and before > 0.5 * self.history[-1 - WATCH]:
            before, self._watched = np.inf, len(self.history)
        best, norm = 0.0, np.inf
        for factor in FACTORS:
            self._trial.waxpy(-factor, y, x)
            self.problem.residual(self._trial, self._trial_f)
            found = float(self._trial_f.norm())
            if found < norm:
                best, norm = factor, found
            if found < before:
                break
        if best == 0.0:
            y.set(np.nan)
        elif best != factor:
            self._trial.waxpy(-best, y, x)
            self.problem.residual(self._trial, self._trial_f)
        if best not in (0.0, 1.0):
            y.scale(best)
        self._fresh, self._whole = best > 0.0, best == 1.0
        self._update = self.problem.largest_displacement(y)
        return best != 1.0

    def _test(self, it: int, norms: tuple[float, float, float]) -> int:
        norm = norms[2]
        self.history.append(norm)
        reason = PETSc.SNES.ConvergedReason
        if not np.isfinite(norm):
            return int(reason.DIVERGED_FNORM_NAN)
        if norm <= self.tolerance:
            return int(reason.CONVERGED_FNORM_ABS)
        if norm <= self._share * self.history[0]:
            return int(reason.CONVERGED_FNORM_RELATIVE)
        if it >= self._limit:
            return int(reason.DIVERGED_MAX_IT)
        return int(reason.ITERATING)

    def solve(
        self, x: PETSc.Vec, at_most: int | None = None, ahead: float | Forecast | None = 1.0, share: float = 0.0
    ) -> Outcome:
        """Solve from x, in place; x already carries the supports' values.

        Args:
            x: Start and result.
            at_most: Take no more than so many iterations.
            ahead: What the end of the increment is predicted from: a forecast, or the increment over the last one;
                None: from nothing, the contact set is that of x.
            share: End at this part of the first residual.
        """
        self._limit, self._share = self._max if at_most is None else min(at_most, self._max), share
        self._begin()
        self.problem.hold(None)
        self.tolerance = max(self.atol, self.problem.round_off(x))
        self.problem.set_accuracy(self.snes.getKSP(), self.tolerance, PREDICTED)
        predicted = self._predict(x, ahead)
        self.snes.solve(None, x)
        iterations = self.snes.getIterationNumber() + predicted
        reason = self.snes.getConvergedReason()
        residual = self.history[-1] if self.history else np.inf  # SNES has not asked where the first one is no number
        return Outcome(reason > 0, iterations, residual, REASONS.get(reason, str(reason)))

    def _predict(self, x: PETSc.Vec, ahead: float | Forecast | None) -> int:
        """One linear solve with the contact set that is expected: it hardly moves in the die as the billet slides by.

        Newton's method would find the ends of the contact by steps of a few facets. With a forecast, contact is
        linearised at its displacements; where that cannot be, it is as without. Kept unless the residual triples.

        Returns:
            How many linear solves it took.
        """
        if not self.predicts or not (isinstance(ahead, Forecast) or self.problem.expect(ahead)):
            return 0
        y, trial, f, ksp = self._step, self._trial, self._trial_f, self.snes.getKSP()
        self.problem.residual(x, f)
        before = float(f.norm())
        if isinstance(ahead, Forecast) and np.isnan(before):
            before = np.inf  # where the surfaces have lost each other a forecast can still lead
        if not before > self.tolerance:  # there is nothing to predict, or nothing to be had of it
            self.problem.expect(None)
            return 0
        if isinstance(ahead, Forecast):
            at = self.problem.foresee(ahead, self.problem.gather(x))
            A = self.problem.linearised(x, f, at)
        else:
            A = self.problem.tangent(x, False)
        known = np.isfinite(float(f.norm()))
        if known:
            self.tangents += 1
            ksp.setOperators(A)
            ksp.solve(f, y)
        self.problem.expect(None)
        if not known:
            return self._predict(x, ahead.ahead) if isinstance(ahead, Forecast) else 0
        trial.waxpy(-1.0, y, x)
        self.problem.residual(trial, f)
        if float(f.norm()) < 3 * max(before, self.tolerance):  # the norm says little
            trial.copy(x)
            # with the contact set known it is nearer than its size says
            self._update = self.problem.largest_displacement(y) / 4
            if isinstance(ahead, Forecast):
                missed = self.problem.gather(x)[ahead.entries] - ahead.values
                self._update = float(np.max(np.abs(missed), initial=0.0))
        return 1
