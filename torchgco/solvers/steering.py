"""An estimate of the time that a problem takes: the shortest in which its linear model is steered to the end.

The controls that do so with the least squares are found for times between the bounds, each a fixed share longer than
the one before; the first time counts at which they are within the bounds on controls, and the states within theirs. For
a linear model this time suffices. Of a double integrator from rest to rest it is 1.22 times the least.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.bounds import StateBounds
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.solvers.straight import last_rows

TIMES = 16  # that are tried, from the shortest to the longest
STAGES = 20  # of constant controls in each
MISSES = 1e-6  # of the way to the end, which counts as reached
SLACK = 1e-9  # by which controls and states may pass their bounds


def steering_factors(problem: Problem, X: Tensor) -> Tensor:
    """Factors (B,) of the nominal time, NaN where no time is found, as of models that aren't linear or not bounded.

    Args:
        X: (B, N+1, n), the way to the end, in whose middle the model is linear.
    """
    B, time = problem.B, problem.time
    assert time is not None
    none = X.new_full((B,), torch.nan)
    bounds = problem.control_bounds
    if bounds is None or not bool(torch.isfinite(bounds.range).all()):
        return none
    lower, upper = (bound.mean(1).expand(B, -1) for bound in bounds.by_knot)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    try:
        A, G, c = _linear(problem, X[:, problem.N // 2], middle)
        J = _asked(problem, X[:, -1])
    except MISTAKES:  # a model that PyTorch can't differentiate forwards
        return none
    shares = torch.linspace(0.0, 1.0, TIMES, dtype=X.dtype, device=X.device)
    least, most = time.least.amin(-1, keepdim=True), time.most.amax(-1, keepdim=True)
    factors = least * (most / least) ** shares  # (B, TIMES)
    found = none
    for factor in factors.flip(-1).unbind(-1):  # the shortest that serves is written last
        fits = _steers(problem, X, (A, G * half.unsqueeze(1), c), J, factor)
        found = torch.where(fits, factor, found)
    return found


def _linear(problem: Problem, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A (B, n, n), G (B, n, m) and c (B, n) of x' = A x + G (u - u0) + c near states x and controls u0."""
    model = problem.dynamics
    rates = lambda x, u: model.field(model.settled(x), u)
    A, G = jacobian(rates, x, u)
    return A, G, rates(x, u) - (A @ x.unsqueeze(-1)).squeeze(-1)


def _asked(problem: Problem, end: Tensor) -> Tensor:
    """What is asked of the end (B, n), as rows (B, p, n): those of the last knot, else the position, else all."""
    n, where = problem.n, problem.dynamics.position
    parts = [c for c in problem.constraints if c.holds_at(problem.N) and not isinstance(c, Obstacles | StateBounds)]
    rows = [jacobian(lambda z, part=part: last_rows(part, problem, z), end)[0] for part in parts]
    if not rows:
        every = torch.eye(n, dtype=end.dtype, device=end.device)
        rows = [(every if where is None else every[where]).expand(len(end), -1, -1)]
    return torch.cat(rows, dim=1)


def _steers(problem: Problem, X: Tensor, model: tuple[Tensor, Tensor, Tensor], J: Tensor, factor: Tensor) -> Tensor:
    """Whether least squares of controls (in units of half their range) do it in factor (B,) times the nominal time."""
    (A, G, c), (B, n, m) = model, (problem.B, problem.n, problem.m)
    h = factor * problem.N * problem.dynamics.dt / STAGES
    generator = A.new_zeros(B, n + m + 1, n + m + 1)
    generator[:, :n] = torch.cat((A, G, c.unsqueeze(-1)), dim=-1) * h.view(-1, 1, 1)
    step = torch.linalg.matrix_exp(generator)[:, :n]
    one, push, drift = step[..., :n], step[..., n : n + m], step[..., -1:]
    x, reach, through = X[:, 0].unsqueeze(-1), [], J
    for _ in range(STAGES):
        x = one @ x + drift
        reach.append(through @ push)
        through = through @ one
    W = torch.cat(reach[::-1], dim=-1)  # (B, p, STAGES m)
    missing = J @ (X[:, -1:].mT - x)
    scale = 1.0 + (J @ (X[:, -1:].mT - X[:, :1].mT)).abs().amax((1, 2))
    if not bool(torch.isfinite(W).all()) or not bool(torch.isfinite(missing).all()):
        return torch.zeros_like(factor, dtype=torch.bool)
    u = torch.linalg.pinv(W) @ missing
    fits = ((W @ u - missing).abs().amax((1, 2)) <= MISSES * scale) & (u.abs().amax((1, 2)) <= 1.0 + SLACK)
    x = X[:, 0].unsqueeze(-1)
    for part in u.view(B, STAGES, m, 1).unbind(1):
        x = one @ x + push @ part + drift
        for bounds in problem.constraints:
            if isinstance(bounds, StateBounds) and isinstance(bounds.knots, slice) and bounds.lower.dim() == 2:
                over = torch.maximum(x[..., 0] - bounds.upper, bounds.lower - x[..., 0]).amax(-1)
                fits &= over <= SLACK
    return fits
