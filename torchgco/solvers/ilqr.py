"""iLQR, the local solver (Algorithm 2): its options, one iteration, and an inner solve."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.options import Count, NonNegative, Share, check_options
from torchgco.base.status import STALLED, Status
from torchgco.base.tree import put, take
from torchgco.lagrangian.expansion import linearise
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.native.dispatch import engine_of, measured, open_loop, value
from torchgco.native.structures import End, Options
from torchgco.obstacles.base import ADMITTED
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call, Solver
from torchgco.solvers.ending import start_status
from torchgco.solvers.lifted import LOST, diverges, lifted_search, native_lifted_search
from torchgco.solvers.line_search import LineSearch
from torchgco.solvers.riccati import BackwardPass, backward
from torchgco.solvers.rules import PRINTED, STANDARD, Rules
from torchgco.solvers.session import Session
from torchgco.solvers.state import InnerState, Iterate, PassEnd, SolveEnd

ROUNDING = 1e-14  # share of L_M: a smaller expected change is rounding error
# mu_r after a failed Cholesky (Algorithm 2, line 9): first value, growth factor, and the limit that ends a problem.
REGULARISATION_FIRST, REGULARISATION_GROWTH, REGULARISATION_MAX = 1e-6, 10.0, 1e10
# mu_r after a failed line search: first value in units of `Problem.cost_unit`, factor per failure, divisor per success.
DAMPING, DAMPING_GROWTH, DAMPING_DECAY = 0.02, 10.0, 3.0


@dataclass(frozen=True)
class ILQR(Solver):
    """Iterative LQR: expansions, backward pass, line search, until L_M no longer falls.

    Used alone, it makes one inner solve; constraints count only through the multipliers and penalties of a warm start,
    which stay fixed.

    Args:
        as_printed: the algorithm as the paper prints it: costs in their own units, the last step of a line search is
            accepted even if L_M rises, and the inner solve ends with the first failed search. Otherwise costs are in
            units of `Problem.cost_unit`, so that scaling all weights changes no iterate, no step raises L_M, and a
            failed line search raises mu_r (Levenberg-Marquardt).
        tolerance: an inner solve has converged where actual and expected change of L_M are at most this share of it;
            as printed: where the actual change is below it, in units of cost.
        max_iterations: inner limit.
        line_search: how step lengths are chosen.
        damp_below: an accepted step length below it raises mu_r too, as a failed line search does: where dynamics are
            curved and multipliers large, steps of a thousandth would use up all iterations. As printed: never.

    Raises:
        InputError: a field out of its range.
    """

    as_printed: bool = False
    tolerance: NonNegative = 1e-6
    max_iterations: Count = 50
    line_search: LineSearch = LineSearch()
    damp_below: Share = 0.0

    def __post_init__(self) -> None:
        check_options(self, "ilqr")

    @property
    def rules(self) -> Rules:
        """The form of the algorithm."""
        return PRINTED if self.as_printed else STANDARD

    def run(self, call: Call) -> Solution:
        """One inner solve of a checked call."""
        session = Session(call, self.rules)
        problem, warm = session.call.problem, session.call.warm
        fixed = Multipliers.zero(problem, 0.0) if warm is None else warm
        lagrangian = Lagrangian(problem, fixed, None, phr=False)
        s, status = descend(self, lagrangian, session.call.U0, start_is_clear=problem.start_is_clear)
        end = Iterate(s.X, s.U, fixed, s.cost, measured(problem, s.X, s.U))
        # Multipliers are fixed: a trajectory that has converged and isn't feasible stays so.
        done = (status == Status.MAX_ITERATIONS) & (s.inner < self.max_iterations)
        status = torch.where(done, STALLED, status)
        none = torch.zeros_like(status)
        ended = SolveEnd(end, end, status, s.iterations, (s.iterations > 0).long(), none)
        return session.finished(ended, ADMITTED)

    def one_iteration(self, s: InnerState, lagrangian: Lagrangian) -> PassEnd:
        """One iteration of every running problem, in place, by PyTorch's kernels; `advance` prefers native ones."""
        F, H = linearise(lagrangian.problem, s.X, s.U), lagrangian.expand(s.X, s.U)
        step = backward(F, H, s.regularisation)
        status = torch.full_like(s.rows, Status.RUNNING)
        expected = step.expected_change(torch.ones_like(s.merit)).abs()
        settled = expected <= ROUNDING * s.merit.abs()
        moving = ~step.failed & ~settled
        if bool(step.failed.any()):
            _raise_regularisation(s, step, F, H, status)
        old_merit, alpha, refused = self._forward(s, lagrangian, step, moving)
        refused = self._lift(s, lagrangian, step, refused)
        change, used = (s.merit - old_merit).abs(), s.regularisation
        s.inner, s.iterations = s.inner + ~step.failed, s.iterations + ~step.failed
        hard = refused | (moving & (alpha < self.damp_below))
        s.regularisation = torch.where(step.failed, used, self._damping(used, hard))
        stuck = refused & (s.regularisation == 0)
        flat = self.rules.is_flat(change, expected, s.merit, self.tolerance)
        if self.rules.damped:
            flat = flat & (used <= DAMPING)
        converged = settled | (moving & ~refused & flat)
        ended = ~step.failed & (converged | stuck | (s.inner >= self.max_iterations))
        return PassEnd(ended, converged, stuck, status, alpha, used, step.failed)

    def _forward(
        self, s: InnerState, lagrangian: Lagrangian, step: BackwardPass, moving: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Line search of the problems in `moving`; returns old merit, step lengths, and where none was accepted."""
        old_merit = s.merit
        alpha, refused = torch.zeros_like(old_merit), torch.zeros_like(moving)
        rows = moving.nonzero().flatten()
        if rows.numel() == 0:
            return old_merit, alpha, refused
        if rows.numel() < moving.numel():
            step = BackwardPass(step.gains[:, rows], *(t[rows] for t in step[1:]))
            lagrangian = lagrangian.take(rows)
        found = self.line_search.search(
            lagrangian, s.X[rows], s.U[rows], s.merit[rows], step, s.rung[rows], self.rules.accept_last
        )
        won = rows[found.accepted]
        for name in ("X", "U", "cost", "merit"):
            values = getattr(s, name).clone()
            values[won] = getattr(found, name)[found.accepted]
            setattr(s, name, values)
        s.rung = s.rung.index_copy(0, rows, self.line_search.next_rung(found, self.rules.accept_last))
        alpha[rows] = found.alpha
        refused[rows] = ~found.accepted
        return old_merit, alpha, refused

    def _damping(self, now: Tensor, hard: Tensor) -> Tensor:
        """mu_r (B,) of the next iteration: 0 as printed; otherwise raised where the search was hard, else lowered."""
        if not self.rules.damped:
            return torch.zeros_like(now)
        up, down = (DAMPING_GROWTH * now).clamp(min=DAMPING), now / DAMPING_DECAY
        up = torch.where(up > REGULARISATION_MAX, 0.0, up)
        return torch.where(hard, up, torch.where(down < DAMPING, 0.0, down))

    def _lift(self, s: InnerState, lagrangian: Lagrangian, step: BackwardPass, refused: Tensor) -> Tensor:
        """A lifted search where rollouts diverge at every step length; returns which problems are still refused.

        Only in the first iteration of an inner solve: later iterates come from gains that kept the states bounded.
        """
        rows = (refused & (s.inner == 0)).nonzero().flatten()
        if not self.rules.damped or rows.numel() == 0:
            return refused
        part, X, U, merit = lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows]
        lost = diverges(part, X, U, merit, step.gains[:, rows], self.line_search.smallest).nonzero().flatten()
        refused = refused.clone()
        if lost.numel() > 0:
            refused[rows[lost][_lifted(s, lagrangian, rows[lost], native=False)]] = False
        return refused


def advance(inner: ILQR, s: InnerState, lagrangian: Lagrangian, limit: int) -> PassEnd:
    """The inner solve of every running problem, in place: up to `limit` native iterations, or one by PyTorch.

    Both make the same iterates, up to rounding.
    """
    engine = engine_of(lagrangian.problem)
    if engine is None:
        return inner.one_iteration(s, lagrangian)
    state = {}
    for name in ("X", "U", "cost", "merit", "regularisation", "inner", "iterations", "rung"):
        state[name] = getattr(s, name).clone(memory_format=torch.contiguous_format)
        setattr(s, name, state[name])
    out = engine.inner_solve(lagrangian, state, native_options(inner), limit)
    converged, stuck, lost = (out[name] != 0 for name in ("converged", "refused", "lost"))
    ended = out["status"] == End.ENDED
    failed = ~ended & (out["status"] != Status.RUNNING)
    rows = lost.nonzero().flatten()
    if rows.numel() > 0:
        won = rows[_lifted(s, lagrangian, rows, native=True)]
        ended[won] = s.inner[won] >= inner.max_iterations
        s.regularisation[won] = 0.0
    status = torch.where(failed, out["status"].long(), int(Status.RUNNING))
    return PassEnd(ended, converged, stuck, status, out["alpha"], out["used"], failed)


def descend(
    inner: ILQR, lagrangian: Lagrangian, U: Tensor, start_is_clear: Tensor | None = None
) -> tuple[InnerState, Tensor]:
    """One inner solve of each problem from controls U (B, N, m); returns the end states and the statuses (B,).

    A problem whose L_M isn't finite, or whose `start_is_clear` (B,) is False, stays as it starts. Tolerances are in the
    units of the problem's cost.
    """
    problem = lagrangian.problem
    X = open_loop(problem, U)
    cost, merit = value(lagrangian, X, U)
    rows = torch.arange(problem.B, device=U.device)
    none = (torch.zeros_like(rows) for _ in range(3))
    found = InnerState(rows, X, U.clone(), cost, merit.clone(), torch.zeros_like(cost), *none)
    status = start_status(problem, X, merit, start_is_clear)
    running, going = found, status == Status.RUNNING
    while bool(going.any()):
        if not bool(going.all()):
            stay = going.nonzero().flatten()
            running, lagrangian = take(running, stay), lagrangian.take(stay)
        end = advance(inner, running, lagrangian, inner.max_iterations)
        reason = torch.where(end.stuck, int(Status.LINE_SEARCH_FAILED), int(Status.MAX_ITERATIONS))
        now = torch.where(end.ended, reason, end.status)
        status[running.rows], going = now, now == Status.RUNNING
        if running is not found:
            put(found, running.rows, running)
    return found, status


def native_options(inner: ILQR) -> Options:
    """The options in the structure that the library reads."""
    search, printed = inner.line_search, inner.as_printed
    ladder = torch.tensor(search.ladder(printed), dtype=torch.float64)
    return Options.complete(
        ladder=ladder, rungs=len(ladder), back=-1 if search.back is None else search.back, accept_last=printed,
        ratio_min=search.ratio_min, ratio_max=search.ratio_max, smallest=search.smallest,
        max_iterations=inner.max_iterations, tolerance=0.0 if printed else inner.tolerance,
        absolute_tolerance=inner.tolerance if printed else 0.0, rounding=ROUNDING, lost=LOST,
        regularisation_first=REGULARISATION_FIRST, regularisation_growth=REGULARISATION_GROWTH,
        regularisation_max=REGULARISATION_MAX, damping=0.0 if printed else DAMPING, damping_growth=DAMPING_GROWTH,
        damping_decay=DAMPING_DECAY, damp_below=inner.damp_below,
    )  # fmt: skip


def _raise_regularisation(s: InnerState, step: BackwardPass, F: Tensor, H: Tensor, status: Tensor) -> None:
    """Raise mu_r of problems whose Cholesky failed (Algorithm 2, line 9): they try again in the next iteration."""
    higher = (s.regularisation * REGULARISATION_GROWTH).clamp(min=REGULARISATION_FIRST)
    s.regularisation = torch.where(step.failed, higher, s.regularisation)
    finite = torch.isfinite(F).all(-1).all(-1).all(0) & torch.isfinite(H).all(-1).all(-1).all(0)
    status[step.failed & (s.regularisation > REGULARISATION_MAX)] = Status.NOT_POSITIVE_DEFINITE
    status[step.failed & ~finite] = Status.NON_FINITE


def _lifted(s: InnerState, lagrangian: Lagrangian, rows: Tensor, native: bool) -> Tensor:
    """Replace the iterates in `rows` by the result of a lifted search; returns which rows have one."""
    search = native_lifted_search if native else lifted_search
    found = search(lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows])
    won = rows[found.accepted]
    for name in ("X", "U", "cost", "merit"):
        getattr(s, name)[won] = getattr(found, name)[found.accepted]
    return found.accepted
