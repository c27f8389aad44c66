"""What the interior point keeps of each problem, its multipliers, and the test of its end.

Names are those of the paper (Waechter and Biegler 2006): theta is the sum of all residuals, phi the cost less mu times
the logarithms of the slacks. Rows are c + s = 0 with s > 0 in the barrier, or c = 0: those of equalities, and bounds
that coincide. Rows without a part in either stay out (`fixed.py`). s is 1 where a row has no slack.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.tree import put as put_rows
from torchgco.base.tree import take as take_rows
from torchgco.eager.model import Derivatives, Model, Values
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.problem.problem import Problem
from torchgco.problem.scale import CostScale

FILTERED = 64  # entries of a filter; the oldest are forgotten
LONGEST_FALL = 50  # reductions of the barrier parameter in one iteration


@dataclass
class State:
    """The iterates of b problems, with R rows each, and what the globalisation remembers of them."""

    X: Tensor  # (b, N+1, n)
    U: Tensor  # (b, N, m)
    y: Tensor  # (b, N+1, n): costates of the states; the first is 0
    gap: Tensor  # (b, N, n)
    cost: Tensor  # (b,): scaled
    c: Tensor  # (b, R): values, less what they are relaxed by
    s: Tensor
    z: Tensor  # multipliers
    out: Tensor  # bool: inequalities outside the barrier
    fixes: Tensor  # bool: those of them that hold as equalities
    gives: Tensor  # delta_c of a row, as a multiple of `soft`
    room: Tensor  # half the range between two bounds, 1 at most
    relaxed: Tensor  # by how much a row is
    mu: Tensor  # (b,), as all that follows
    scale: Tensor  # of the cost
    raised: Tensor  # how many times larger it is than it would be in the units of the problem
    objective: Tensor  # 0 where feasibility alone is sought
    soft: Tensor  # delta_c
    shift: Tensor  # delta_w
    theta: Tensor
    phi: Tensor
    highest: Tensor  # theta_max
    lowest: Tensor  # theta_min
    filter: Tensor  # (b, FILTERED, 2): theta and phi, in their order; infinite where empty
    last: Tensor  # the last shift that was needed
    forced: Tensor  # the least shift
    entered: Tensor  # theta at the beginning of the restoration
    slope: Tensor  # of phi, and the step length, before steps on trial
    alpha: Tensor
    least: Tensor  # the smallest error of the end test so far
    left: Tensor  # the smallest complementarity so far, of those that counted
    idle: Tensor  # iterations since it fell by half, int64 as the counts that follow
    made: Tensor
    failures: Tensor
    shortened: Tensor
    ahead: Tensor
    restoring: Tensor  # bool, as the others
    crawls: Tensor
    rows_relaxed: Tensor
    presses: Tensor  # mu falls further than the tolerance asks for
    watching: Tensor  # a step was taken on trial; theta, phi, slope and alpha are those before it
    kept: tuple[Tensor, ...]  # X, U, y, gap, cost, c, s, z before the steps on trial
    rows: Tensor  # places in the batch

    def take(self, index: Tensor) -> State:
        """The problems at places `index`."""
        return take_rows(self, index)

    def put(self, index: Tensor, some: State) -> None:
        """Write the problems at places `index`."""
        put_rows(self, index, some)


STATE_FIELDS = "X", "U", "y", "gap", "cost", "c", "s", "z"


@dataclass(frozen=True)
class Kinds:
    """What does not differ between problems of a form."""

    equality: Tensor  # (R,) bool
    how: BarrierOptions
    costs: CostScale
    barrier: Tensor  # (B,): mu at the start
    N: int
    n: int

    def inside(self, t: State) -> Tensor:
        """Rows in the barrier (b, R)."""
        return ~(t.out | self.equality)

    def fixed(self, t: State) -> Tensor:
        """Rows that hold as equalities (b, R)."""
        return self.equality | (t.out & t.fixes)


def first_barrier(kinds: Kinds, t: State) -> Tensor:
    """The barrier parameter (b,) to begin with: at least that at which it ends, where the barrier stays."""
    return torch.maximum(kinds.barrier[t.rows], kinds.how.smoothing * t.scale)


def blank(problem: Problem, X: Tensor, U: Tensor, z: Tensor) -> State:
    """The state of problems that have not begun."""
    b = X.shape[0]
    zero, one = X.new_zeros(b), X.new_ones(b)
    none, count = torch.zeros_like(z), torch.zeros(b, dtype=torch.int64, device=X.device)
    no, never = torch.zeros_like(count, dtype=torch.bool), torch.zeros_like(z, dtype=torch.bool)
    inf = X.new_full((b,), torch.inf)
    gap = X.new_zeros(b, problem.N, problem.n)
    own = {
        "X": X.clone(), "U": U.clone(), "y": torch.zeros_like(X), "gap": gap, "cost": zero, "c": none,
        "s": torch.ones_like(z), "z": z.clone(),
    }  # fmt: skip
    made = {
        **own, "out": never, "fixes": never, "gives": torch.ones_like(z), "room": torch.ones_like(z), "relaxed": none,
        "mu": zero, "scale": one, "raised": one, "objective": one, "soft": zero, "shift": zero, "theta": zero,
        "phi": zero, "highest": inf, "lowest": zero, "filter": X.new_full((b, FILTERED, 2), torch.inf), "last": zero,
        "forced": zero, "entered": zero, "slope": zero, "alpha": zero, "least": inf, "left": inf, "idle": count,
        "made": count, "failures": count, "shortened": count, "ahead": count, "restoring": no, "crawls": no,
        "rows_relaxed": no, "presses": no, "watching": no, "rows": torch.arange(b, device=X.device),
    }  # fmt: skip
    made = {name: value.clone() for name, value in made.items()}
    return State(**made, kept=tuple(made[name].clone() for name in STATE_FIELDS))


def column(values: Tensor) -> Tensor:
    """Numbers (b,) beside rows (b, R)."""
    return values.unsqueeze(-1)


def residuals(kinds: Kinds, t: State, c: Tensor, s: Tensor) -> Tensor:
    """c + s in the barrier, c of equalities, 0 of rows outside."""
    return torch.where(kinds.inside(t), c + s, torch.where(kinds.fixed(t), c, 0.0))


def theta_of(gap: Tensor, r: Tensor) -> Tensor:
    """The sum of all residuals, (b,)."""
    return gap.abs().flatten(1).sum(-1) + r.abs().sum(-1)


def logarithms(s: Tensor) -> Tensor:
    """The sum of the logarithms of slacks, (b,)."""
    return s.log().sum(-1)


def evaluate(model: Model, t: State, X: Tensor, U: Tensor) -> Values:
    """Values with the scaled cost and relaxed rows."""
    found = model.values(X, U, t.c.shape[1])
    return Values(t.scale * found.cost, found.c - t.relaxed, found.gap)


def settle(kinds: Kinds, model: Model, t: State) -> None:
    """Values and an empty filter, in place."""
    found = evaluate(model, t, t.X, t.U)
    t.cost, t.c, t.gap = found.cost, found.c, found.gap
    remeasure(kinds, t)


def remeasure(kinds: Kinds, t: State) -> None:
    """theta, phi and their limits at the iterate, and an empty filter."""
    how = kinds.how
    t.theta = theta_of(t.gap, residuals(kinds, t, t.c, t.s))
    t.phi = t.cost - t.mu * logarithms(t.s)
    base = torch.maximum(t.theta, torch.ones_like(t.theta))
    t.highest, t.lowest = how.theta_max_fact * base, how.theta_min_fact * base
    t.filter = torch.full_like(t.filter, torch.inf)


def renew(kinds: Kinds, model: Model, t: State) -> None:
    """New multipliers: those of the central path, none of equalities, and costates that fit them."""
    t.z = torch.where(kinds.inside(t), column(t.mu) / t.s, 0.0)
    adjoin(kinds, model.slopes(t.X, t.U), t)


def adjoin(kinds: Kinds, at: Derivatives, t: State) -> None:
    """Costates that make the Lagrangian stationary in the states; none where they are too large."""
    n = kinds.n
    g = column(t.scale).unsqueeze(-1) * at.cost + at.pull(t.z.unsqueeze(1))[:, 0]
    g, fx = g[..., :n].transpose(0, 1).unsqueeze(-1), at.F[..., :n].transpose(0, 1)
    y = [g[-1]]
    for k in range(kinds.N - 1, 0, -1):
        y.append(torch.baddbmm(g[k], fx[k].mT, y[-1]))
    found = torch.stack([torch.zeros_like(g[0]), *y[::-1]]).squeeze(-1).transpose(0, 1)
    sound = found.abs().flatten(1).amax(-1) <= kinds.how.constr_mult_init_max * t.raised
    t.y = torch.where(sound.view(-1, 1, 1), found, 0.0)


@dataclass(frozen=True)
class Errors:
    """The end test: largest slopes of the Lagrangian, residuals and complementarity, scaled as in the paper; (b,)."""

    dual: Tensor
    primal: Tensor
    scale_z: Tensor
    whole: Tensor


def errors(kinds: Kinds, at: Derivatives, t: State, r: Tensor, free: Tensor | None) -> Errors:
    """The errors at an iterate with residuals r (b, R)."""
    how, n = kinds.how, kinds.n
    slope = at.cost + at.pull(t.z.unsqueeze(1))[:, 0]
    slope[:, :-1] += (at.F.mT @ t.y[:, 1:].unsqueeze(-1)).squeeze(-1)
    slope[:, 1:, :n] -= t.y[:, 1:]
    slope[:, 0, :n] = 0.0 if free is None else torch.where(free, slope[:, 0, :n], 0.0)
    slope[:, -1, n:] = 0.0
    gap = t.gap.abs().flatten(1).amax(-1)
    if r.shape[1] > 0:
        gap = torch.maximum(gap, r.abs().amax(-1))
    sum_y, sum_z = t.y.abs().flatten(1).sum(-1), torch.minimum(t.z.abs(), column(how.explodes * t.raised)).sum(-1)
    mean = (sum_y + sum_z) / (kinds.N * n + t.z.shape[1])
    usual = torch.full_like(mean, how.s_max)
    dual = slope.abs().flatten(1).amax(-1) * usual / torch.maximum(mean, usual)
    scale_z = usual / torch.maximum(sum_z / max(t.z.shape[1], 1), usual)
    whole = torch.maximum(torch.maximum(dual, gap), complementarity(kinds, t, how.smoothing * t.scale) * scale_z)
    return Errors(dual, gap, scale_z, whole)


def complementarity(kinds: Kinds, t: State, mu: Tensor) -> Tensor:
    """The largest |s z - mu|, (b,)."""
    if t.z.shape[1] == 0:
        return torch.zeros_like(mu)
    return torch.where(kinds.inside(t), (t.s * t.z - column(mu)).abs(), 0.0).amax(-1)


def lower_barrier(kinds: Kinds, t: State, test: Errors, running: Tensor) -> None:
    """The next mu where the barrier problem is solved well enough; the filter begins again there."""
    how = kinds.how
    base, usual = torch.maximum(test.dual, test.primal), how.tol * how.mu_floor
    smallest = torch.where(t.presses, how.mu_min, torch.full_like(t.mu, usual))
    smallest = how.smoothing * t.scale if how.smoothing > 0 else smallest
    lowered = torch.zeros_like(t.presses)
    for _ in range(LONGEST_FALL):
        error = torch.maximum(base, complementarity(kinds, t, t.mu) * test.scale_z)
        low = (error <= how.barrier_tol_factor * t.mu) & (t.mu > smallest) & running & ~t.restoring & ~t.watching
        if not bool(low.any()):
            break
        following = torch.maximum(smallest, torch.minimum(how.mu_linear_decrease_factor * t.mu, t.mu * t.mu.sqrt()))
        t.mu = torch.where(low, following, t.mu)
        lowered = lowered | low
    t.phi = torch.where(lowered, t.cost - t.mu * logarithms(t.s), t.phi)
    t.filter = torch.where(lowered.view(-1, 1, 1), torch.inf, t.filter)


def find_solved(kinds: Kinds, t: State, test: Errors, running: Tensor) -> Tensor:
    """Which of `running` end here.

    Tolerances below the usual rounding are met as well as the iterate can be: a problem goes on while the error falls,
    and ends above them where rounding keeps it there. So does one whose barrier counts, for as long as this share
    falls.
    """
    how, error = kinds.how, test.whole
    t.idle = torch.where(running, torch.where(error <= 0.5 * t.least, 0, t.idle + 1), t.idle)
    t.least = torch.where(running & (error < t.least), error, t.least)
    feasible = running & ~t.restoring & (test.primal <= how.constr_viol_tol)
    met = feasible & (error <= how.tol)
    left, size = left_over(kinds, t)
    counts = met & (left > how.counts * size) & (how.smoothing == 0)
    t.idle = torch.where(counts & (left <= 0.5 * t.left), 0, t.idle)
    t.left = torch.where(counts, torch.minimum(left, t.left), t.left)
    t.presses, rests = t.presses | counts, t.idle >= how.acceptable_iter
    met = met & (~counts | rests)
    loose = ~t.presses if how.tol >= how.rounding else torch.zeros_like(met)
    met = met & (loose | (error <= 2.0 * t.mu) | (t.idle >= 1))
    return met | (feasible & rests & (error <= how.acceptable_tol))


def left_over(kinds: Kinds, t: State) -> tuple[Tensor, Tensor]:
    """The complementarity and what the rows' residuals are worth, and the size of the cost, (b,).

    Where the units are small, neither need be small beside the cost where its tolerance is met.
    """
    left = torch.where(kinds.inside(t), t.s * t.z, 0.0).sum(-1) + (t.z * residuals(kinds, t, t.c, t.s)).abs().sum(-1)
    constant, size = kinds.costs.constant[t.rows], kinds.costs.size[t.rows]
    return left, (t.cost - t.scale * constant).abs() + t.scale * size
