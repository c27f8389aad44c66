"""Whether a model's time step is short enough: each step of a trajectory against two of half its length.

Both start at the same state, with the stage's control held. Their difference is 1 - 2^-p of the error of one step of
order p, to leading order: half of Euler's, nearly all of that of rk4 (Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I, section II.4). A model whose field isn't known can't take half steps, and has no such errors.

What the differences e cost is told by costates to first order, p'e. Where a trajectory ends near its reference these
nearly vanish, and the second order counts: d'Hd / 2 of deviations d that the differences leave, with the cost's
curvature H, while controls follow by the gains that a regulator of the two half steps has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.shapes import computing_on
from torchgco.base.tree import is_users, take
from torchgco.dynamics.base import INTEGRATORS, Dynamics
from torchgco.problem.horizons import at_rest_after, within_horizons
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem
from torchgco.problem.scale import LEAST_COST

ORDER_OF = {"euler": 1, "implicit_euler": 1, "midpoint": 2, "radau3": 3, "rk4": 4, "radau5": 5}
LARGE_ERROR = 0.1  # step errors above this are large
# The same of order 1. Euler's difference is a quarter of the second difference of the states, half of their range at
# most, which controls that change at every stage come close to without a stiff model.
LARGE_OF_FIRST = 0.5
LARGE_COST = 0.01  # costs that are off by more than this share are, and the step costs by which they show
# Of torchgco's own models in given times, with which their Euler steps were published. A method of order p changes the
# cost by c / N^p where nothing changes faster than within the whole duration: for these c is 0.3 to 2.2.
COARSE = 2.5
LEAST_RANGE = 1e-3  # of a state's largest size: its range counts as no less
LEAST_OF_ALL = 1e-9  # of the largest size of any state: no range counts as less
# By how many per cent no cost changes where the shares of all stages add up to one. Of 858 claims of drawn models those
# whose shares add up to less than a 30th of what is large have at most a tenth of a large step cost.
ELASTIC = 30.0
Costates = Callable[[Problem, Tensor, Tensor, Sequence[Tensor]], Tensor | None]  # of problems, X, U and multipliers
Regulated = Callable[..., tuple[Tensor, Tensor]]  # of the same, steps F and costates
Kernels = tuple[Costates | None, Regulated | None]
# Share of what is large below which costs of first order, and squares of the sum of all shares, say that both orders
# are small: of these claims at most 0.45 of what is large.
FAR = 0.2
LEAST_SLACK = 1e-6  # of a row that binds: where its multiplier is 1 it gives way by 1e-6 to a force of 1
JACOBIANS_AT_ONCE = 2**20  # numbers of one intermediate tensor at once: 8 MB


@dataclass(frozen=True)
class StepErrors:
    """One value per problem, (B,); NaN where the model's steps can't be halved."""

    step_error: Tensor  # largest difference of one step and two of half its length, as a share of the state's range
    # By how much the differences of all steps change the cost, as a share of the sum of the absolute costs of the
    # stages and the end: the sizes of the changes of first and of second order. With given multipliers the least cost,
    # where controls answer by the feedback of the linear-quadratic regulator; else that of the same controls.
    step_cost: Tensor
    state: Tensor  # int64: the state of `step_error`
    stage: Tensor  # int64: its stage
    large: Tensor  # bool: one of them is, and dt too long for the model
    of_cost: Tensor  # bool: of Euler steps, the cost's alone

    def told(self, b: int, problem: Problem) -> str:
        """What is wrong with the steps of problem b, in words: dt, the state and the shares."""
        where, names = int(self.state[b]), problem.dynamics.state_names
        name = f" ({names[where]})" if len(names) else ""
        error, cost = float(self.step_error[b]), float(self.step_cost[b])
        dt = "dt of a stage" if problem.time is not None else f"dt = {problem.dynamics.dt:g} s"
        more = "" if cost != cost else f", and the cost by {self.cost_told(b)}"
        change = "makes state {}{} NaN" if error == torch.inf else f"changes state {{}}{{}} by {error:.2g} of its range"
        what = f"half of {dt} {change.format(where, name)}"
        return f"{what} at stage {int(self.stage[b])}{more}"

    def cost_told(self, b: int, times: float = 1.0) -> str:
        """A multiple of the step cost of problem b in words."""
        cost = times * float(self.step_cost[b])
        return "many times itself" if cost > 10.0 else f"{cost:.2g} of itself"


def step_errors(
    problem: Problem,
    X: Tensor,
    U: Tensor,
    times: Tensor | None = None,
    multipliers: Sequence[Tensor] | None = None,
    doubted: bool = False,
    kernels: Kernels = (None, None),
) -> StepErrors:
    """The errors of the steps along trajectories X (B, N+1, n), U (B, N, m), where each state follows from the last.

    Args:
        times: (B, N+1), s, of the knots where the time is free.
        multipliers: of every constraint, (B, K, p); None: the cost alone counts.
        doubted: the step cost, which takes longer, is 0 where it would have to be over `ELASTIC` times the errors of
            all stages together to be large, and of first order alone where that says enough (`FAR`).
        kernels: what finds costates, or returns None where it can't; where they are given, those of the end are its
            slopes; and what finds the changes of `_answered`, where there are costates.
    """
    if problem.B == 0 or not _halves(problem):
        zeros = torch.zeros(problem.B, dtype=torch.int64, device=X.device)
        lost, none = X.new_full((problem.B,), torch.nan), torch.zeros_like(zeros, dtype=torch.bool)
        return StepErrors(lost, lost.clone(), zeros, zeros.clone(), none, none.clone())
    order, parts = ORDER_OF[problem.dynamics.integrator], list[tuple[Tensor, ...]]()
    too_much = X.new_full((problem.B,), (1.0 - 0.5**order) * LARGE_COST)
    if not is_users(problem.dynamics) and problem.time is None:
        too_much = torch.maximum(too_much, COARSE / problem.stages.to(X.dtype) ** order)
    with computing_on(X.device), torch.no_grad():
        for rows in _in_parts(problem.B, problem.N * problem.n**2):
            lams = None if multipliers is None else tuple(lam[rows] for lam in multipliers)
            own = problem.take(rows), X[rows], U[rows], None if times is None else times[rows]
            e, share = _along(*own)
            worst, index = share.flatten(1).max(-1)
            total, limit = share.amax(-1).sum(-1), too_much[rows]
            asked = total > limit / ELASTIC if doubted else torch.isfinite(worst)
            costs = 0.0 * worst  # NaN where that isn't finite
            chosen = (asked & torch.isfinite(worst)).nonzero().flatten()
            if chosen.numel() > 0:
                part = _Differences(*own[:3], e, own[3], lams, kernels[1]).take(chosen)
                if kernels[0] is not None:
                    part = replace(part, slopes=kernels[0](part.problem, part.X, part.U, part.multipliers or ()))
                costs[chosen] = part.cost(total[chosen], limit[chosen] if doubted else None)
            parts.append((worst, costs, index % problem.n, index // problem.n))
        error, cost, state, stage = parts[0] if len(parts) == 1 else map(torch.cat, zip(*parts, strict=True))
        large, costly = error > (LARGE_OF_FIRST if order == 1 else LARGE_ERROR), cost > too_much
        return StepErrors(error, cost, state, stage, large | costly, costly & ~large & (order == 1))


def differences(problem: Problem, X: Tensor, U: Tensor, times: Tensor | None) -> Tensor | None:
    """Each state minus what two steps of half the length lead to, (B, N, n); None without a known field."""
    return _along(problem, X, U, times)[0] if _halves(problem) else None


def _halves(problem: Problem) -> bool:
    """Whether a step integrates a known field."""
    model = problem.dynamics
    return model.stretches and model.integrator in INTEGRATORS


def _in_parts(B: int, numbers: int) -> Iterator[slice]:
    """The rows of a batch in parts, of which each holds so many numbers per row."""
    rows = max(1, JACOBIANS_AT_ONCE // max(1, numbers))
    return (slice(i, min(i + rows, B)) for i in range(0, B, rows))


def _two_halves(model: Dynamics, x: Tensor, U: Tensor, times: Tensor | None) -> Tensor:
    """The states (B, N, n) after two steps of half the length from x (B, N, n), by the model of all stages."""
    as_it_is = lambda z: z
    ahead = as_it_is if times is None and model.is_integrated else model.settled
    if times is None:
        rates, half = lambda z: model.field(z, U), 0.5 * model.dt
    else:
        lengths = times.diff(dim=1).unsqueeze(-1)
        rates, half = lambda z: lengths * model.field(model.settled(z), U), 0.5
    for _ in range(2):
        x = ahead(INTEGRATORS[model.integrator](rates, x, half))
    return x


def _along(problem: Problem, X: Tensor, U: Tensor, times: Tensor | None) -> tuple[Tensor, Tensor]:
    """X_{k+1} minus two steps of half the length from X_k, (B, N, n), and its size as a share of the states' ranges.

    0 after a problem's own last stage. Infinite shares where Newton's method ends the whole step, and not the halves.
    """
    e = X[:, 1:] - _two_halves(problem.along, X[:, :-1], U, times)
    e = e if problem.horizon is None else torch.where(problem.running.unsqueeze(-1), e, 0.0)
    size, apart = X.abs().amax(1, keepdim=True), e.abs()
    apart = torch.where(e.isnan() & torch.isfinite(X[:, 1:] - X[:, :-1]), torch.inf, apart)
    ranges = torch.maximum(X.amax(1, keepdim=True) - X.amin(1, keepdim=True), LEAST_RANGE * size)
    ranges = torch.maximum(ranges, LEAST_OF_ALL * size.amax(-1, keepdim=True))
    return e, torch.where(apart > 0, apart / ranges, apart)


def first_order_cost(problem: Problem, X: Tensor, U: Tensor, e: Tensor, slopes: Tensor) -> Tensor:
    """`StepErrors.step_cost` (B,) to first order, of differences e (B, N, n) and costates (B, N+1, n)."""
    return _shares(_of_first_order(e, slopes), _size(problem, X, U))


def _of_first_order(e: Tensor, slopes: Tensor) -> Tensor:
    """By how much differences e (B, N, n) change the cost by costates (B, N+1, n), (B,)."""
    return (slopes[:, 1:, : e.shape[-1]] * e).flatten(1).sum(-1).abs()


def _shares(change: Tensor, size: Tensor) -> Tensor:
    """Changes of costs as shares of their sizes, (B,); 0 where there is none."""
    return torch.where(change != 0, change / size, 0.0)


def costates_of(problem: Problem, X: Tensor, U: Tensor, multipliers: Sequence[Tensor]) -> Tensor:
    """Slopes (B, N+1, n) of J_var + lam'c by the states, where later states follow from each; by autodiff.

    Raises:
        RuntimeError: code that autograd can't differentiate.
    """
    by_x, (B, N, n) = _slopes(problem, X, U, None, multipliers)[0], X[:, 1:].shape
    each = torch.arange(B, device=X.device).repeat_interleave(n)
    twins, u = problem.along.take(each), U[each]
    rows = lambda x: twins.step(x, u).view(B, n, N, n).diagonal(dim1=1, dim2=3)
    fx = gradients_at_once(rows, X[each, :-1])[0].view(B, n, N, n)
    costates = [by_x[:, -1]]
    for k in range(N - 1, 0, -1):
        costates.append(by_x[:, k] + (costates[-1].unsqueeze(1) @ fx[:, :, k]).squeeze(1))
    return torch.stack((by_x[:, 0], *costates[::-1]), dim=1)


@dataclass(frozen=True)
class _Differences:
    """Trajectories X (B, N+1, n), U (B, N, m) with the differences e (B, N, n) of their steps."""

    problem: Problem
    X: Tensor
    U: Tensor
    e: Tensor
    times: Tensor | None
    multipliers: tuple[Tensor, ...] | None  # None: controls don't answer
    regulated: Regulated | None
    slopes: Tensor | None = None  # (B, N+1, n), of the cost by the states, where later states follow

    def take(self, rows: Tensor) -> _Differences:
        if (problem := self.problem.take(rows)) is self.problem:
            return self
        tensors = self.X, self.U, self.e, self.times, self.multipliers, self.regulated, self.slopes
        return _Differences(problem, *take(tensors, rows))

    def cost(self, shares: Tensor, too_much: Tensor | None) -> Tensor:
        """`StepErrors.step_cost` (B,), of first order alone where both orders are far below too_much (B,).

        Args:
            shares: sums over all stages, (B,).
        """
        size = _size(*at_times(within_horizons(self.problem), self.X, at_rest_after(self.problem, self.U), self.times))
        if self.slopes is None or too_much is None:
            return self.of_both_orders(size)
        costs = _shares(_of_first_order(self.e, self.slopes), size)
        doubts = (~((costs < FAR * too_much) & (shares.square() < FAR * too_much))).nonzero().flatten()
        if doubts.numel() > 0:
            costs[doubts] = self.take(doubts).of_both_orders(size[doubts])
        return costs

    def of_both_orders(self, size: Tensor) -> Tensor:
        """`StepErrors.step_cost` (B,), of costs of this `_size` (B,)."""
        problem, n = self.problem, self.problem.n
        held, U = within_horizons(problem), at_rest_after(problem, self.U)
        try:
            F = _half_steps(problem, self.X[:, :-1], U, self.e, self.times)
            if self.regulated is not None and self.slopes is not None and self.multipliers is not None:
                first, second = self.regulated(problem, self.X, U, self.multipliers, F, self.slopes)
            else:
                by_x, by_u = _slopes(held, self.X, U, self.times, self.multipliers or ())
                H = _curvatures(problem, *at_times(held, self.X, U, self.times), self.multipliers)
                if self.slopes is not None:  # of a phase, which doesn't know what follows
                    by_x[:, -1] = self.slopes[:, -1, :n]
                H[:, :, :n, n] = H[:, :, n, :n] = by_x
                H[:, :-1, n + 2 :, n] = H[:, :-1, n, n + 2 :] = by_u
                first, second = _answered(F, H, self.multipliers is not None)
        except RuntimeError:  # code that autograd can't differentiate twice, as that of samplers
            return torch.full_like(self.X[:, 0, 0], torch.nan)
        change = first.abs() + second.clamp(min=0.0) / (1.0 - 0.5 ** ORDER_OF[problem.dynamics.integrator])
        return _shares(change, size)


def _answered(F: Tensor, H: Tensor, feedback: bool) -> tuple[Tensor, Tensor]:
    """The change of J_var + lam'c by the differences, of first and of second order, (B,) each.

    Of z = [x, 1, share of the differences, u], the controls follow the states by the gains of the linear-quadratic
    regulator, or stay.

    Args:
        F: of two halves, (B, N, n+2, s); H: slopes and curvatures, (B, N+1, s, s).
    """
    (B, N, z, s), n = F.shape, F.shape[2] - 2
    # In NumPy, as an operation of PyTorch on a few small matrices takes several times as long.
    steps, rows = (np.ascontiguousarray(blocks.transpose(0, 1).cpu().numpy()) for blocks in (F, H))
    V, whole = rows[-1, :, :z, :z], np.zeros((B, s, z), rows.dtype)
    whole[:, :z] = np.eye(z)  # [z, u] from z
    turned, back = np.ascontiguousarray(steps.swapaxes(2, 3)), whole.swapaxes(1, 2)
    with np.errstate(all="ignore"):
        for k in range(N - 1, -1, -1):
            Q = rows[k] + turned[k] @ (V @ steps[k])
            if feedback:
                S, right = Q[:, z:, z:], -Q[:, z:, :n]
                try:
                    np.linalg.cholesky(S)
                    whole[:, z:, :n] = np.linalg.solve(S, right)
                except np.linalg.LinAlgError:
                    whole[:, z:, :n] = [_solution(*of_each) for of_each in zip(S, right, strict=True)]
            V = back @ (Q @ whole)
    V = torch.from_numpy(V).to(F.device)
    return V[:, n, n + 1], 0.5 * V[:, n + 1, n + 1]


def _solution(S: np.ndarray, right: np.ndarray) -> np.ndarray:
    """S^-1 right (m, n), the same bits as in a batch; 0 where S isn't positive definite."""
    try:
        np.linalg.cholesky(S)
        return np.linalg.solve(S, right)
    except np.linalg.LinAlgError:
        return np.zeros_like(right)


def _slopes(
    problem: Problem, X: Tensor, U: Tensor, times: Tensor | None, multipliers: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Slopes of J_var + lam'c by the states (B, N+1, n) and the controls (B, N, m), by autodiff."""

    def lagrangian(X: Tensor, U: Tensor) -> Tensor:
        whole, X, U = at_times(problem, X, U, times)
        pairs = zip(whole.constraints, multipliers, strict=False)
        pushes = (torch.where(lam != 0, lam * c.value(X, U), 0.0).flatten(1).sum(-1) for c, lam in pairs)
        return sum(pushes, whole.cost.total(X, U))

    by_x, by_u = gradients_at_once(lagrangian, X, U)
    return by_x, by_u


def _half_steps(problem: Problem, x: Tensor, U: Tensor, e: Tensor, times: Tensor | None) -> Tensor:
    """F (B, N, n+2, s) with [dx_{k+1}, 1, t] = F_k [dx_k, 1, t, du_k] of two halves that lead t e_k elsewhere."""
    (B, N, n), m = x.shape, U.shape[-1]
    each = torch.arange(B, device=x.device).repeat_interleave(n)
    twins, t = problem.along.take(each), None if times is None else times[each]
    rows = lambda x, u: _two_halves(twins, x, u, t).view(B, n, N, n).diagonal(dim1=1, dim2=3)
    by_x, by_u = (z.view(B, n, N, -1).transpose(1, 2) for z in gradients_at_once(rows, x[each], U[each]))
    if problem.horizon is not None:
        runs = problem.running.view(B, N, 1, 1)
        by_x, by_u = torch.where(runs, by_x, torch.eye(n).to(x)), torch.where(runs, by_u, 0.0)
    F = x.new_zeros(B, N, n + 2, n + 2 + m)
    F[..., :n, :n], F[..., :n, n + 1], F[..., :n, n + 2 :] = by_x, -e, by_u
    F[..., n, n] = F[..., n + 1, n + 1] = 1.0
    return F


def _curvatures(problem: Problem, whole: Problem, X: Tensor, U: Tensor, multipliers: Sequence[Tensor] | None) -> Tensor:
    """H (B, N+1, s, s) of the cost, and by the controls of rows that bind as a barrier has it: multiplier / slack.

    It holds controls at their bounds. Rows of states, as those of obstacles, push to first order alone: what a
    barrier's curvature adds is no cost. Rows of several knots have none.
    """
    n, m, size = problem.n, problem.m, whole.n + 1 + whole.m
    blocks = X.new_empty(*X.shape[:2], size, size)
    whole.cost.expand(X, U, blocks)
    H, mine = X.new_zeros(*X.shape[:2], n + 2 + m, n + 2 + m), slice(n + 2, None)
    theirs = slice(size - whole.m, size - whole.m + m)
    H[:, :, :n, :n], H[:, :, mine, mine] = blocks[:, :, :n, :n], blocks[:, :, theirs, theirs]
    H[:, :, mine, :n], H[:, :, :n, mine] = blocks[:, :, theirs, :n], blocks[:, :, :n, theirs]
    for row, lam in zip(whole.constraints, multipliers or (), strict=False):
        if not row.joins_knots and not row.geometric and bool(lam.any()):
            stiff = torch.where(lam != 0, lam.abs() / row.value(X, U).abs().clamp(min=LEAST_SLACK), 0.0)
            row.accumulate(X, U, torch.zeros_like(lam), stiff, blocks.zero_())
            H[:, :, mine, mine] += blocks[:, :, theirs, theirs]
    return H


def _size(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """What changes of the cost are shares of, (B,): the sum of its absolute values at all stages and the end.

    At least `LEAST_COST` of the cost of staying at the start: what vanishes there, as a fit's misfit, has no size.
    """
    cost, least = problem.cost, LEAST_COST * problem.cost_at_rest.abs().nan_to_num(0.0, 0.0)
    k = torch.arange(U.shape[1], device=U.device)
    with cost.precision(X.dtype):
        size = cost.stage(X[:, :-1], U, k).abs().sum(-1) + cost.terminal(X[:, -1]).abs()
    return torch.maximum(size, least)
