"""One iteration of iLQR for a batch of problems, in PyTorch (Algorithm 2)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.status import Status
from torchgco.ilqr import descent
from torchgco.ilqr.descent import Descent
from torchgco.ilqr.lifted import diverges, lifted_search
from torchgco.ilqr.line_search import Rollouts
from torchgco.ilqr.riccati import BackwardPass, backward
from torchgco.lagrangian.expansion import linearise
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.lagrangian.state import InnerState, PassEnd


def iterate(how: Descent, s: InnerState, lagrangian: Lagrangian) -> PassEnd:
    """One iteration of every running problem, in place."""
    F, H = linearise(lagrangian.problem, s.X, s.U), lagrangian.expand(s.X, s.U)
    step = backward(F, H, s.regularisation)
    status = torch.full_like(s.rows, Status.RUNNING)
    expected = step.expected_change(torch.ones_like(s.merit)).abs()
    settled = expected <= descent.ROUNDED_OFF * s.merit.abs()
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
        flat = flat & (used <= descent.DAMPING)
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
    up, down = (descent.DAMPING_GROWTH * now).clamp(min=descent.DAMPING), now / descent.DAMPING_DECAY
    up = torch.where(up > descent.REGULARISATION_MAX, 0.0, up)
    return torch.where(hard, up, torch.where(down < descent.DAMPING, 0.0, down))


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
    higher = (s.regularisation * descent.REGULARISATION_GROWTH).clamp(min=descent.REGULARISATION_FIRST)
    s.regularisation = torch.where(step.failed, higher, s.regularisation)
    finite = torch.isfinite(F).all(-1).all(-1).all(0) & torch.isfinite(H).all(-1).all(-1).all(0)
    status[step.failed & (s.regularisation > descent.REGULARISATION_MAX)] = Status.NOT_POSITIVE_DEFINITE
    status[step.failed & ~finite] = Status.NON_FINITE


def keep_lifted(s: InnerState, rows: Tensor, rollouts: Rollouts) -> Tensor:
    """Replace the iterates in `rows` by the result of their lifted search; returns which rows have one."""
    won = rows[rollouts.accepted]
    for name in ("X", "U", "cost", "merit"):
        getattr(s, name)[won] = getattr(rollouts, name)[rollouts.accepted]
    return rollouts.accepted
