"""One iteration of iLQR for a batch of problems, in PyTorch (Algorithm 2), and what follows where it fails.

Where the dynamics are unstable and the gains around an iterate don't stabilise them, rollouts diverge at every step
length. With the states as variables, and gaps between them that the linearised dynamics close, the steps lead to a
trajectory whose gains stabilise the dynamics.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.dynamics.rollout import closed_loop
from torchgco.ilqr.line_search import LineSearch, Rollouts
from torchgco.ilqr.riccati import BackwardPass, backward
from torchgco.lagrangian.lagrangian import InnerState, Lagrangian, PassEnd, linearise

LIFTED_STEPS = 20  # steps at most
GAIN = 1e-2  # share of L_M by which a rollout must lower it
LOST_BY = 1e6  # rollouts diverge where even the shortest step makes L_M this many times as large


def diverges(lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor, G: Tensor, shortest: float) -> Tensor:
    """Whether even the shortest step along the gains G (N, B, m, n+1) makes L_M more than `LOST_BY` |merit|, (B,)."""
    value = lagrangian.value(*closed_loop(lagrangian.problem.dynamics, X, U, G, torch.full_like(merit, shortest)))[1]
    return ~(value <= LOST_BY * merit.abs())


def lifted_search(lagrangian: Lagrangian, X: Tensor, U: Tensor, merit: Tensor) -> Rollouts:
    """The first rollout that lowers L_M = merit (B,) by `GAIN`, from X (B, N+1, n), U (B, N, m); else not accepted."""
    none = torch.zeros_like(merit, dtype=torch.bool)
    rollouts = Rollouts(X.clone(), U.clone(), merit.clone(), merit.clone(), torch.ones_like(merit), none)
    rows = torch.arange(X.shape[0], device=X.device)
    for i in range(LIFTED_STEPS):
        if rows.numel() == 0:
            break
        subset, dynamics = lagrangian.take(rows), lagrangian.problem.dynamics.take(rows)
        n, F = X.shape[-1], linearise(subset.problem, X, U)
        F[:, :, :n, n] = (subset.problem.along.step(X[:, :-1], U) - X[:, 1:]).transpose(0, 1)
        step = backward(F, subset.expand(X, U), torch.zeros_like(X[:, 0, 0]))
        if i > 0:  # the first gains are those that failed
            _keep(rollouts, rows, subset, *closed_loop(dynamics, X, U, step.gains, torch.ones_like(X[:, 0, 0])))
        X, U = _linear_step(F, step.gains, X, U)
        going = ~rollouts.accepted[rows] & ~step.failed & torch.isfinite(X).flatten(1).all(-1)
        rows, X, U = rows[going], X[going], U[going]
    return rollouts


def _keep(rollouts: Rollouts, rows: Tensor, lagrangian: Lagrangian, X: Tensor, U: Tensor) -> None:
    """Write the trajectories with a low enough L_M into `rollouts`."""
    cost, value = lagrangian.value(X, U)
    low = torch.isfinite(value) & (value < rollouts.merit[rows] - GAIN * rollouts.merit[rows].abs())
    won = rows[low]
    for tensor, new in ((rollouts.X, X), (rollouts.U, U), (rollouts.cost, cost), (rollouts.merit, value)):
        tensor[won] = new[low]
    rollouts.accepted[won] = True


def _linear_step(F: Tensor, G: Tensor, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
    """States and controls after a full step of the linearised dynamics F (N, B, n+1, s) under the gains G."""
    n, unit = X.shape[-1], torch.ones_like(X[:, 0, :1])
    dx = torch.zeros_like(X[:, 0])
    new_X, new_U = [X[:, 0]], []
    for k in range(U.shape[1]):
        z = torch.cat((dx, unit), dim=-1).unsqueeze(-1)
        du = torch.bmm(G[k], z)
        dx = torch.bmm(F[k, :, :n], torch.cat((z, du), dim=1)).squeeze(-1)
        new_X.append(X[:, k + 1] + dx)
        new_U.append(U[:, k] + du.squeeze(-1))
    return torch.stack(new_X, dim=1), torch.stack(new_U, dim=1)


ROUNDED_OFF = 1e-14  # share of L_M: a smaller expected change is rounding error
# mu_r after a failed Cholesky (Algorithm 2, line 9): first value, growth factor, and the limit that ends a problem.
REGULARISATION_FIRST, REGULARISATION_GROWTH, REGULARISATION_MAX = 1e-6, 10.0, 1e10
# mu_r after a failed line search: first value in units of `Problem.cost_unit`, factor per failure, divisor per success.
DAMPING, DAMPING_GROWTH, DAMPING_DECAY = 0.02, 10.0, 3.0


@dataclass(frozen=True)
class Descent:
    """How an inner solve descends: the fields of `solvers.ilqr.ILQR`, which explains them."""

    line_search: LineSearch
    tolerance: float
    max_iterations: int
    as_printed: bool


def iterate(how: Descent, s: InnerState, lagrangian: Lagrangian) -> PassEnd:
    """One iteration of every running problem, in place."""
    F, H = linearise(lagrangian.problem, s.X, s.U), lagrangian.expand(s.X, s.U)
    step = backward(F, H, s.regularisation)
    status = torch.full_like(s.rows, Status.RUNNING)
    expected = step.expected_change(torch.ones_like(s.merit)).abs()
    settled = expected <= ROUNDED_OFF * s.merit.abs()
    moving = ~step.failed & ~settled
    if bool(step.failed.any()):
        _raise_regularisation(s, step, F, H, status)
    old_merit, alpha, refused = _forward(how, s, lagrangian, step, moving)
    refused = _lift(how, s, lagrangian, step, refused)
    change, used = (s.merit - old_merit).abs(), s.regularisation
    s.inner, s.iterations = s.inner + ~step.failed, s.iterations + ~step.failed
    s.regularisation = torch.where(step.failed, used, _damping(how, used, refused))
    stuck = refused & (s.regularisation == 0)
    flat = _is_flat(how, change, expected, s.merit)
    if not how.as_printed:
        flat = flat & (used <= DAMPING)
    converged = settled | (moving & ~refused & flat)
    ended = ~step.failed & (converged | stuck | (s.inner >= how.max_iterations))
    return PassEnd(ended, converged, stuck, status, alpha, used, step.failed)


def _forward(
    how: Descent, s: InnerState, lagrangian: Lagrangian, step: BackwardPass, moving: Tensor
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
    tried = how.line_search.search(lagrangian, s.X[rows], s.U[rows], s.merit[rows], step, s.rung[rows], how.as_printed)
    won = rows[tried.accepted]
    for name in ("X", "U", "cost", "merit"):
        values = getattr(s, name).clone()
        values[won] = getattr(tried, name)[tried.accepted]
        setattr(s, name, values)
    s.rung = s.rung.index_copy(0, rows, how.line_search.next_rung(tried, how.as_printed))
    alpha[rows] = tried.alpha
    refused[rows] = ~tried.accepted
    return old_merit, alpha, refused


def _damping(how: Descent, now: Tensor, hard: Tensor) -> Tensor:
    """mu_r (B,) of the next iteration: 0 as printed; otherwise raised where the search was hard, else lowered."""
    if how.as_printed:
        return torch.zeros_like(now)
    up, down = (DAMPING_GROWTH * now).clamp(min=DAMPING), now / DAMPING_DECAY
    up = torch.where(up > REGULARISATION_MAX, 0.0, up)
    return torch.where(hard, up, torch.where(down < DAMPING, 0.0, down))


def _lift(how: Descent, s: InnerState, lagrangian: Lagrangian, step: BackwardPass, refused: Tensor) -> Tensor:
    """A lifted search where rollouts diverge at every step length; returns which problems are still refused.

    Only in the first iteration of an inner solve: later iterates come from gains that kept the states bounded.
    """
    rows = (refused & (s.inner == 0)).nonzero().flatten()
    if how.as_printed or rows.numel() == 0:
        return refused
    subset, X, U, merit = lagrangian.take(rows), s.X[rows], s.U[rows], s.merit[rows]
    lost = diverges(subset, X, U, merit, step.gains[:, rows], how.line_search.smallest).nonzero().flatten()
    refused = refused.clone()
    if lost.numel() > 0:
        refused[
            rows[lost][keep_lifted(s, rows[lost], lifted_search(subset.take(lost), X[lost], U[lost], merit[lost]))]
        ] = False
    return refused


def _is_flat(how: Descent, change: Tensor, expected: Tensor, merit: Tensor) -> Tensor:
    """Whether L_M = merit (B,) changes too little to go on: as a share of it, or as printed in units of cost."""
    if how.as_printed:
        return change < how.tolerance
    return torch.maximum(change, expected) <= how.tolerance * merit.abs()


def _raise_regularisation(s: InnerState, step: BackwardPass, F: Tensor, H: Tensor, status: Tensor) -> None:
    """Raise mu_r of problems whose Cholesky failed (Algorithm 2, line 9): they try again in the next iteration."""
    higher = (s.regularisation * REGULARISATION_GROWTH).clamp(min=REGULARISATION_FIRST)
    s.regularisation = torch.where(step.failed, higher, s.regularisation)
    finite = torch.isfinite(F).all(-1).all(-1).all(0) & torch.isfinite(H).all(-1).all(-1).all(0)
    status[step.failed & (s.regularisation > REGULARISATION_MAX)] = Status.NOT_POSITIVE_DEFINITE
    status[step.failed & ~finite] = Status.NON_FINITE


def keep_lifted(s: InnerState, rows: Tensor, rollouts: Rollouts) -> Tensor:
    """Replace the iterates in `rows` by the result of their lifted search; returns which rows have one."""
    won = rows[rollouts.accepted]
    for name in ("X", "U", "cost", "merit"):
        getattr(s, name)[won] = getattr(rollouts, name)[rollouts.accepted]
    return rollouts.accepted
