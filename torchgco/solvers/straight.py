"""Where the time is free: states to begin with, on straight lines and through gates, and an estimate of the time.

The controls that do so with the least squares are found for times between the bounds, each a fixed share longer than
the one before; the first time counts at which they are within the bounds on controls, and the states within theirs. For
a linear model this time suffices. Of a double integrator from rest to rest it is 1.22 times the least.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.products import exponential, least_squares, product
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import Bounds, bounds_of
from torchgco.constraints.gates import gates_of
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem

NEWTON_STEPS = 20  # of Gauss and Newton towards the rows of the last knot
ROUNDINGS = 4.0  # of the largest state: no smaller step is made
SOFT = 1e-12  # regularisation of a step, as a share of the largest entry of J J'


def straight_line(problem: Problem, towards: Tensor | None = None) -> Tensor:
    """States X (B, N+1, n), evenly from the start to `asked_of_the_end`; the position leads through the gates."""
    share = torch.linspace(0.0, 1.0, problem.N + 1, dtype=problem.x0.dtype, device=problem.x0.device).view(1, -1, 1)
    x0 = torch.where(torch.isfinite(problem.x0), problem.x0, 0.0).unsqueeze(1)
    X = (1.0 - share) * x0 + share * asked_of_the_end(problem, towards).unsqueeze(1)
    legs = Legs.of(problem, X[:, -1])
    if legs is not None:
        X[..., problem.position] = legs.positions(problem.N)
    settled = problem.dynamics.settled(X)
    return torch.where(torch.isfinite(settled), settled, X)


@dataclass(frozen=True)
class Legs:
    """The straight lines from the start through the gates to the end."""

    stops: Tensor  # (B, G+2, d), m
    knots: Tensor  # (B, G+2) int64: when each is passed

    @classmethod
    def of(cls, problem: Problem, end: Tensor) -> Legs | None:
        """Those of problems that end at states (B, n); None without gates."""
        gates, position = gates_of(problem), problem.dynamics.position
        if gates is None or position is None:
            return None
        first, last = torch.zeros_like(gates.places[:, :1]), torch.full_like(gates.places[:, :1], problem.N)
        stops = torch.cat((problem.x0[:, None, position], gates.centers, end[:, None, position]), dim=1)
        return cls(stops, torch.cat((first, gates.places, last), dim=1))

    @property
    def farthest(self) -> Tensor:
        """The stop (B, d) that is farthest from the start."""
        index = (self.stops - self.stops[:, :1]).norm(dim=-1).argmax(-1)
        return self.stops[torch.arange(len(index), device=index.device), index]

    def positions(self, N: int) -> Tensor:
        """(B, N+1, d): evenly along each leg from its knot to the next."""
        k = torch.arange(N + 1, device=self.knots.device).expand(len(self.knots), -1).contiguous()
        leg = self._leg(k)
        first, last = self.knots.gather(1, leg), self.knots.gather(1, leg + 1)
        share = ((k - first) / (last - first).clamp(min=1)).to(self.stops).unsqueeze(-1)
        index = leg.unsqueeze(-1).expand(-1, -1, self.stops.shape[-1])
        a, b = (self.stops.gather(1, index + shift) for shift in (0, 1))
        return (1.0 - share) * a + share * b

    def stage_factors(self, estimate: Tensor, N: int) -> Tensor:
        """Factors (B, N) of the stages, where the way to the farthest stop would take all in `estimate` (B, 1).

        As if the vehicle rested at each gate: times grow as the roots of lengths. That is long, and no leg is short.
        """
        far = (self.farthest - self.stops[:, 0]).norm(dim=-1, keepdim=True).clamp(min=1e-12)
        stages = self.knots.diff(dim=1).clamp(min=1)
        each = estimate * N * (self.stops.diff(dim=1).norm(dim=-1) / far).sqrt() / stages
        return each.gather(1, self._leg(torch.arange(N, device=self.knots.device).expand(len(each), -1).contiguous()))

    def _leg(self, k: Tensor) -> Tensor:
        """On which leg knots (B, K) are."""
        return (torch.searchsorted(self.knots, k, right=True) - 1).clamp(0, self.knots.shape[1] - 2)


def asked_of_the_end(problem: Problem, towards: Tensor | None = None) -> Tensor:
    """States (B, n) near the start that keep the rows of the last knot, as far as steps of Gauss and Newton find any.

    They begin at the state that the cost draws to, with the position of a stated goal, else at `towards` (B, n), or at
    the start. Obstacles don't count.
    """
    x0 = torch.where(torch.isfinite(problem.x0), problem.x0, 0.0)
    drawn = problem.cost.goal(problem.x0)
    near = x0 if towards is None else torch.where(torch.isfinite(towards), towards, x0)
    z = near.clone() if drawn is None else torch.where(torch.isfinite(drawn), drawn, near)
    if problem.goal is not None and not problem.goal.assumed:
        z[:, problem.position] = problem.goal.position
    parts = [c for c in problem.constraints if c.holds_at(problem.N) and not isinstance(c, Obstacles)]
    if not parts:
        return z
    rows = lambda z: torch.cat([last_rows(constraint, problem, z) for constraint in parts], dim=-1)
    for _ in range(NEWTON_STEPS):
        try:
            c, (J,) = rows(z), jacobian(rows, z)
        except MISTAKES:  # rows that PyTorch can't differentiate forwards: the guess stays where it is
            return z
        if not bool((c != 0).any()):
            return z
        A = product(J, J.mT)
        A = A + torch.diag_embed((SOFT * A.abs().amax((1, 2)) + 1e-300).unsqueeze(-1).expand_as(c))
        step = (J * torch.linalg.solve_ex(A, c.unsqueeze(-1)).result).sum(1)
        size = torch.maximum(z.abs(), x0.abs()).amax(-1)
        moves = step.abs().amax(-1) > ROUNDINGS * torch.finfo(z.dtype).eps * size  # which NaN isn't
        if not bool(moves.any()):
            return z
        z = torch.where((moves & torch.isfinite(step).all(-1)).unsqueeze(-1), z - step, z)
    return z


def last_rows(constraint: Constraint, problem: Problem, z: Tensor) -> Tensor:
    """The rows (B, p) of the last knot at z (B, n): of inequalities, by how much they are violated."""
    X = z.unsqueeze(1).expand(-1, problem.N + 1, -1)
    knots = torch.arange(problem.N + 1, device=z.device)[constraint.knots]
    index = int((knots == problem.N).nonzero()[0, 0])
    c = constraint.value(X, z.new_zeros(len(z), problem.N, problem.m))[:, index]
    return c if constraint.sense == "equality" else c.clamp(min=0.0)


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
