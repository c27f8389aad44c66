"""An estimate of the time that a problem takes: the shortest in which its linear model is steered to the end.

The controls that do so with the least squares are found for times between the bounds, each a fixed share longer than
the one before; the first time counts at which they are within the bounds on controls, and the states within theirs. For
a linear model this time suffices. Of a double integrator from rest to rest it is 1.22 times the least.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.products import exponential, least_squares, product
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.bounds import Bounds, bounds_of
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem
from torchgco.solvers.straight import last_rows

TIMES = 16  # that are tried, from the shortest to the longest
STAGES = 20  # of constant controls in each
MISSES = 1e-6  # of the way to the end, which counts as reached
LIMIT_SLACK = 1e-9  # by which controls and states may pass their bounds


class LinearTime:
    """The linear model of problems with a free time, and what its controls of least squares do in some time.

    Args:
        problem: of B problems.
        line: states (B, N+1, n) on the way to the end, in whose middle the model is linear.
    """

    def __init__(self, problem: Problem, line: Tensor) -> None:
        self.problem, self.line = problem, line
        self.model: tuple[Tensor, Tensor, Tensor] | None = None
        bounds = problem.control_bounds
        if bounds is None:
            return
        lower, upper = (bound.mean(1).expand(problem.B, -1) for bound in bounds.by_knot)
        self.bounded = (torch.isfinite(lower) & torch.isfinite(upper)).all(-1)
        lower, upper = (torch.where(self.bounded.unsqueeze(-1), bound, 0.0) for bound in (lower, upper))
        self.middle, self.half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        try:
            A, G, c = _linear(problem, line[:, problem.N // 2], self.middle)
            self.asked = _asked(problem, line[:, -1])
        except MISTAKES:  # a model that PyTorch can't differentiate forwards
            return
        self.model = A, G * self.half.unsqueeze(1), c

    def factors(self) -> Tensor:
        """The shortest times that serve, as factors (B,) of the nominal one; NaN where none does, or none is known."""
        time = self.problem.time
        assert time is not None
        shortest = torch.full_like(self.line[:, 0, 0], torch.nan)
        shares = torch.linspace(0.0, 1.0, TIMES, dtype=shortest.dtype, device=shortest.device)
        least, most = time.least.amin(-1, keepdim=True), time.most.amax(-1, keepdim=True)
        for factor in (least * (most / least) ** shares).flip(-1).unbind(-1):  # the shortest is written last
            steered = self._steered(factor)
            if steered is not None:
                shortest = torch.where(self._fits(*steered), factor, shortest)
        return shortest

    def guess(self, factor: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """States (B, N+1, n) and controls (B, N, m) in factor (B,) times the nominal time; elsewhere the line and U."""
        steered = self._steered(factor)
        if steered is None:
            return self.line, U
        x, u, misses = steered
        position = torch.linspace(0.0, float(STAGES), self.problem.N + 1, dtype=x.dtype, device=x.device)
        first = position.long().clamp(max=STAGES - 1)
        share = (position - first).view(1, -1, 1)
        X = (1.0 - share) * x[:, first] + share * x[:, first + 1]
        X = self.problem.dynamics.settled(X)
        controls = self.middle.unsqueeze(1) + self.half.unsqueeze(1) * u[:, first[:-1]]
        lower, upper = self.middle - self.half, self.middle + self.half
        controls = torch.minimum(torch.maximum(controls, lower.unsqueeze(1)), upper.unsqueeze(1))
        fits = (self._fits(x, u, misses) & torch.isfinite(X).flatten(1).all(-1)).view(-1, 1, 1)
        return torch.where(fits, X, self.line), torch.where(fits, controls, U)

    def _steered(self, factor: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
        """States (B, STAGES+1, n), controls (B, STAGES, m) as shares of half their range, and by how much they miss."""
        if self.model is None:
            return None
        (A, G, c), problem = self.model, self.problem
        B, n, m = problem.B, problem.n, problem.m
        generator = A.new_zeros(B, n + m + 1, n + m + 1)
        generator[:, :n] = torch.cat((A, G, c.unsqueeze(-1)), dim=-1)
        generator *= (factor * problem.N * problem.dynamics.dt / STAGES).view(-1, 1, 1)
        step = exponential(generator)[:, :n]
        phi, push, drift = step[..., :n], step[..., n : n + m], step[..., -1:]
        x, reach, through, start = self.line[:, 0].unsqueeze(-1), [], self.asked, self.line[:, 0].unsqueeze(-1)
        for _ in range(STAGES):
            x = product(phi, x) + drift
            reach.append(product(through, push))
            through = product(through, phi)
        W, missing = torch.cat(reach[::-1], dim=-1), product(self.asked, self.line[:, -1:].mT - x)  # (B, p, STAGES m)
        known = (torch.isfinite(W).all((1, 2)) & torch.isfinite(missing).all((1, 2)) & self.bounded).view(-1, 1, 1)
        W, missing = torch.where(known, W, 0.0), torch.where(known, missing, torch.inf)
        u = least_squares(W, torch.where(known, missing, 0.0).squeeze(-1)).unsqueeze(-1)
        size = 1.0 + product(self.asked, x - start).abs().amax((1, 2))
        misses = (product(W, u) - missing).abs().amax((1, 2)) / size
        u = u.view(B, STAGES, m)
        path = [start]
        for v in u.unsqueeze(-1).unbind(1):
            path.append(product(phi, path[-1]) + product(push, v) + drift)
        return torch.cat(path, dim=-1).mT, u, misses

    def _fits(self, x: Tensor, u: Tensor, misses: Tensor) -> Tensor:
        """Whether the end is reached, and controls and states are within their bounds, (B,) bool."""
        fits = (misses <= MISSES) & (u.abs().amax((1, 2)) <= 1.0 + LIMIT_SLACK)
        for bounds in bounds_of(self.problem.constraints, "x"):
            if isinstance(bounds.knots, slice) and bounds.lower.dim() == 2:
                over = torch.maximum(x - bounds.upper.unsqueeze(1), bounds.lower.unsqueeze(1) - x)
                fits &= over[:, 1:].amax((1, 2)) <= LIMIT_SLACK
        return fits


def _linear(problem: Problem, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A (B, n, n), G (B, n, m) and c (B, n) of x' = A x + G (u - u0) + c near states x and controls u0."""
    model = problem.dynamics
    rates = lambda x, u: model.field(model.settled(x), u)
    A, G = jacobian(rates, x, u)
    return A, G, rates(x, u) - product(A, x.unsqueeze(-1)).squeeze(-1)


def _asked(problem: Problem, end: Tensor) -> Tensor:
    """What is asked of the end (B, n), as rows (B, p, n): those of the last knot, else the position, else all."""
    n, where = problem.n, problem.dynamics.position
    parts = [c for c in problem.constraints if c.holds_at(problem.N) and not isinstance(c, Obstacles | Bounds)]
    balls = [c for c in parts if c.bare.is_goal and c.bare.in_metres]  # of no slope in the middle
    parts = [c for c in parts if c not in balls]
    rows = [jacobian(lambda z, c=c: last_rows(c, problem, z), end)[0] for c in parts]
    if not rows or balls:
        every = torch.eye(n, dtype=end.dtype, device=end.device)
        rows.append((every if where is None else every[where]).expand(len(end), -1, -1))
    return torch.cat(rows, dim=1)
