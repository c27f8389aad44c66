"""Whether a model's time step is short enough: each step of a trajectory against two of half its length.

Both start at the same state, with the stage's control held. Their difference is 1 - 2^-p of the error of one step of
order p, to leading order: half of Euler's, nearly all of that of rk4 (Hairer, Norsett and Wanner, Solving Ordinary
Differential Equations I, section II.4). A model whose field isn't known can't take half steps, and has no such errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.shapes import computing_on
from torchgco.base.tree import is_users
from torchgco.costs.base import Cost
from torchgco.dynamics.base import INTEGRATORS
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
ELASTIC = 100.0  # by how many per cent no cost changes where a state changes by one per cent of its range
Costates = Callable[[Problem, Tensor, Tensor, Sequence[Tensor]], Tensor | None]  # of problems, X, U and multipliers
JACOBIANS_AT_ONCE = 2**20  # numbers of one intermediate tensor at once: 8 MB


@dataclass(frozen=True)
class StepErrors:
    """One value per problem, (B,); NaN where the model's steps can't be halved."""

    step_error: Tensor  # largest difference of one step and two of half its length, as a share of the state's range
    # By how much the differences of all steps change the cost to first order, as a share of the sum of the absolute
    # costs of the stages and the end: with given multipliers the least cost, else that of the same controls.
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
        what = f"half of {dt} changes state {where}{name} by {error:.2g} of its range"
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
    costates: Costates | None = None,
) -> StepErrors:
    """The errors of the steps along trajectories X (B, N+1, n), U (B, N, m), where each state follows from the last.

    Args:
        times: (B, N+1), s, of the knots where the time is free.
        multipliers: of every constraint, (B, K, p); None: the cost alone counts.
        doubted: the step cost, which takes longer, is 0 where it would have to be over `ELASTIC` times the errors of
            all stages together to be large.
        costates: finds them, or returns None where autodiff has to; None: it always has.
    """
    lost = X.new_full((problem.B,), torch.nan)
    zeros = torch.zeros(problem.B, dtype=torch.int64, device=X.device)
    none = torch.zeros_like(zeros, dtype=torch.bool)
    error = StepErrors(lost, lost.clone(), zeros, zeros.clone(), none, none.clone())
    if not _halves(problem):
        return error
    order = ORDER_OF[problem.dynamics.integrator]
    too_much = X.new_full((problem.B,), (1.0 - 0.5**order) * LARGE_COST)
    if not is_users(problem.dynamics) and problem.time is None:
        too_much = torch.maximum(too_much, COARSE / problem.stages.to(X.dtype) ** order)
    with computing_on(X.device), torch.no_grad():
        for rows in _in_parts(problem.B, problem.N * problem.n**2):
            e, share = _along(problem.take(rows), X[rows], U[rows], None if times is None else times[rows])
            worst, index = share.flatten(1).max(-1)
            error.step_error[rows], error.stage[rows], error.state[rows] = worst, index // problem.n, index % problem.n
            asked = torch.isfinite(worst)
            if doubted:
                asked &= share.amax(-1).sum(-1) > too_much[rows] / ELASTIC
            costs = torch.where(torch.isfinite(worst), torch.zeros_like(worst), torch.nan)
            chosen = asked.nonzero().flatten()
            if chosen.numel() > 0:
                numbers = chosen + rows.start
                parts = X[numbers], U[numbers], e[chosen], None if times is None else times[numbers]
                costs[chosen] = cost_of(
                    problem.take(numbers), *parts, [lam[numbers] for lam in multipliers or ()], costates
                )
            error.step_cost[rows] = costs
        large = error.step_error > (LARGE_OF_FIRST if order == 1 else LARGE_ERROR)
        costs = error.step_cost > too_much
        error.large[:], error.of_cost[:] = large | costs, costs & ~large & (order == 1)
    return error


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


def _along(problem: Problem, X: Tensor, U: Tensor, times: Tensor | None) -> tuple[Tensor, Tensor]:
    """X_{k+1} minus two steps of half the length from X_k, (B, N, n), and its size as a share of the states' ranges.

    0 after a problem's own last stage.
    """
    model, x = problem.along, X[:, :-1]
    as_it_is = lambda z: z
    ahead = as_it_is if times is None and model.is_integrated else model.settled
    if times is None:
        rates, half = lambda z: model.field(z, U), 0.5 * model.dt
    else:
        lengths = times.diff(dim=1).unsqueeze(-1)
        rates, half = lambda z: lengths * model.field(model.settled(z), U), 0.5
    for _ in range(2):
        x = ahead(INTEGRATORS[model.integrator](rates, x, half))
    e = X[:, 1:] - x
    e = e if problem.horizon is None else torch.where(problem.running.unsqueeze(-1), e, 0.0)
    size, apart = X.abs().amax(1, keepdim=True), e.abs()
    ranges = torch.maximum(X.amax(1, keepdim=True) - X.amin(1, keepdim=True), LEAST_RANGE * size)
    ranges = torch.maximum(ranges, LEAST_OF_ALL * size.amax(-1, keepdim=True))
    return e, torch.where(apart > 0, apart / ranges, apart)


def cost_of(
    problem: Problem,
    X: Tensor,
    U: Tensor,
    e: Tensor,
    times: Tensor | None,
    multipliers: Sequence[Tensor],
    costates: Costates | None = None,
) -> Tensor:
    """`StepErrors.step_cost` (B,) of the differences e (B, N, n)."""
    found = None if costates is None else costates(problem, X, U, multipliers)
    whole, X, U = at_times(within_horizons(problem), X, at_rest_after(problem, U), times)
    try:
        found = _costates(whole, X, U, multipliers) if found is None else found
    except RuntimeError:  # code that autograd can't differentiate, which samplers serve
        return torch.full_like(X[:, 0, 0], torch.nan)
    change = (found[:, 1:, : problem.n] * e).flatten(1).sum(-1)
    return torch.where(change != 0, change.abs() / _size(whole, X, U), 0.0)


def _costates(problem: Problem, X: Tensor, U: Tensor, multipliers: Sequence[Tensor]) -> Tensor:
    """Slopes (B, N+1, n) of J_var + lam'c by the states, where later states follow from each; by autodiff."""
    pairs = list(zip(problem.constraints, multipliers, strict=False))

    def lagrangian(x: Tensor) -> Tensor:
        pushes = (torch.where(lam != 0, lam * c.value(x, U), 0.0).flatten(1).sum(-1) for c, lam in pairs)
        return sum(pushes, problem.cost.total(x, U))

    (slopes,), fx = gradients_at_once(lagrangian, X), _by_states(problem, X[:, :-1], U)
    costates, rows = [slopes[:, -1:]], slopes.unsqueeze(2).unbind(1)
    for k, by_x in zip(range(problem.N - 1, 0, -1), reversed(fx.unbind(1)[1:]), strict=True):
        costates.append(torch.baddbmm(rows[k], costates[-1], by_x))
    return torch.cat((slopes[:, :1], *costates[::-1]), dim=1)


def _by_states(problem: Problem, x: Tensor, U: Tensor) -> Tensor:
    """Jacobians of the steps by the states, (B, N, n, n)."""
    B, N, n = x.shape
    each = torch.arange(B, device=x.device).repeat_interleave(n)
    twins, u = problem.take(each).along, U[each]
    rows = lambda z: twins.step(z, u).view(B, n, N, n).diagonal(dim1=1, dim2=3)
    return gradients_at_once(rows, x[each])[0].view(B, n, N, n).transpose(1, 2).contiguous()


def _size(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """What changes of the cost are shares of, (B,): the sum of its absolute values at all stages and the end.

    At least `LEAST_COST` of the cost of staying at the start: what vanishes there, as a fit's misfit, has no size.
    """
    cost, least = problem.cost, LEAST_COST * problem.cost.total(*problem.at_rest).abs().nan_to_num(0.0, 0.0)
    if type(cost).total is not Cost.total:
        return torch.maximum(cost.total(X, U).abs(), least)
    k = torch.arange(U.shape[1], device=U.device)
    with cost.precision(X.dtype):
        size = cost.stage(X[:, :-1], U, k).abs().sum(-1) + cost.terminal(X[:, -1]).abs()
    return torch.maximum(size, least)
