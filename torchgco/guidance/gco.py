"""Guidance by constraint optimisation: the paper's plug-in of the outer loop (Algorithm 4), and which problems suit it.

MPPI evaluates a problem in forms that the solver itself never needs: many samples at a time, in single precision. A
user's own functions may fail there. Then the sampler falls back to the problem's own precision, or is left out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Self

import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import GuidanceWarning, first_line
from torchgco.base.options import AtLeast, Checked, Positive
from torchgco.base.shapes import repeated
from torchgco.base.tree import put, take
from torchgco.guidance.mppi import MPPI
from torchgco.kernels import cost_scale, kernels_of
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.problem.problem import Problem
from torchgco.solvers.caught import active_counts, caught_knots
from torchgco.solvers.contracts import Advice

TRIAL_SAMPLES = 2  # of a trial


def suited_sampler(sampler: MPPI | None, problem: Problem) -> tuple[MPPI | None, str | None]:
    """The usable sampler, or None; and a sentence on what is lost, or None.

    Raises:
        InputError: a covariance that doesn't fit the controls.
    """
    if sampler is None:
        return None, None
    sampler.check(problem)
    if kernels_of(problem).compiled:
        return sampler, None  # natively it samples the same traced functions that the solver runs
    dtype = problem.x0.dtype
    wanted = dtype if sampler.dtype is None else getattr(torch, sampler.dtype)
    why = failure(_sample, problem, wanted)
    if why is None:
        return sampler, None
    if wanted != dtype and failure(_sample, problem, dtype) is None:
        return replace(sampler, dtype=None), f"samples are drawn in {_name(dtype)}, as {_name(wanted)} fails ({why})"
    return None, f"no trajectory can be sampled ({why})"


def suited_guide(sampler: MPPI | None, problem: Problem) -> tuple[MPPI | None, str | None]:
    """`suited_sampler` for a sampler that guides a solver, which needs a position."""
    if sampler is not None and problem.dynamics.position is None:
        return None, "the dynamics have no position"
    return suited_sampler(sampler, problem)


def warn_of_losses(losses: list[str], solved_without: bool) -> None:
    """One GuidanceWarning that names the parts of guidance that can't serve; none where all can."""
    if losses:
        effect = "solved without guidance" if solved_without else "guided in part"
        warnings.warn(f"{effect}: {'; '.join(dict.fromkeys(losses))}", GuidanceWarning, stacklevel=6)


def failure(trial: Callable[[Problem], None], problem: Problem, dtype: torch.dtype) -> str | None:
    """Why a trial with the first problem of a batch, in another precision, fails."""
    try:
        trial(problem.take(torch.zeros(1, dtype=torch.int64, device=problem.x0.device)).cast(dtype))
    except Exception as error:  # users' functions may raise anything, and no such error may end the solve
        return first_line(error)
    return None


def _sample(problem: Problem) -> None:
    """One stage of some samples of one problem."""
    x = repeated(problem.x0, TRIAL_SAMPLES)
    u = x.new_zeros(1, TRIAL_SAMPLES, problem.m)
    cost = problem.cost.stage(x, u, 0) + problem.cost.terminal(x)
    after = problem.dynamics.at(0).step(x, u)
    check_form("dynamics", after, x)
    hits = [(constraint.at(after, 1) >= 0).sum(-1) for constraint in problem.geometric]
    for name, rows in (("cost", cost), *(("a constraint", rows) for rows in hits)):
        if rows.shape != x.shape[:2]:
            raise ValueError(f"{name}: shape {tuple(rows.shape)} for samples {tuple(x.shape[:2])}")


def check_form(name: str, got: torch.Tensor, like: torch.Tensor) -> None:
    if got.shape != like.shape or got.dtype != like.dtype:
        got_form, want_form = (f"{_name(z.dtype)} {tuple(z.shape)}" for z in (got, like))
        raise ValueError(f"{name}: {got_form} instead of {want_form}")


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


R_GUIDE = 0.02  # r_guide as a share of the distance to be flown; the paper's vehicles have radii of 0.017 and 0.03
DIVERGED = 1e3  # times the cost of staying at the start: a costlier sample mean is not used


@dataclass(frozen=True)
class GCO(Checked, named="gco"):
    """Where a solved trajectory is caught between obstacles, attract it to a region that MPPI found.

    r_guide is the vehicle's radius, or without spheres and boxes `R_GUIDE` times the distance from start to goal
    (to the farthest knot where the problem has no goal).

    Args:
        sampler: finds a trajectory past the obstacles.
        initial_penalty, penalty_growth: mu_gco and its factor nu per outer iteration; with nu above the solver's eta
            the guide prevails.
        start_from_sample: where the sampled trajectory touches nothing, it replaces the iterate instead of attracting
            it (not in the paper).
        sample_from_rest: sample around the cost's reference controls (the vehicle at rest), not around the caught
            trajectory (not in the paper).

    Raises:
        InputError: a field out of its range; on `suited`, a covariance that doesn't fit the controls.
    """

    sampler: MPPI = MPPI()
    initial_penalty: Positive = 20.0
    penalty_growth: Annotated[float, AtLeast(1)] = 4.84
    start_from_sample: bool = False
    sample_from_rest: bool = False
    single_contact_after: ClassVar[int | None] = None  # as of `Solve`, whose rule `in_search` takes over

    def suited(self, problem: Problem) -> GCO | None:
        """This guidance where it can serve a problem; None where it can't, which a GuidanceWarning explains.

        Without geometric constraints no trajectory is ever caught, and no guidance is needed.
        """
        if not problem.geometric:
            return None
        sampler, lost = suited_guide(self.sampler, problem)
        warn_of_losses([] if lost is None else [lost], sampler is None)
        return None if sampler is None else replace(self, sampler=sampler)

    def in_search(self, single_contact_after: int | None) -> Self:
        """The same for trajectories that a search counts as caught by this rule."""
        other = replace(self)
        object.__setattr__(other, "single_contact_after", single_contact_after)
        return other

    def start(self, problem: Problem, X: Tensor) -> GuideRegion:
        """An inactive region for every problem (Algorithm 4, lines 3-4)."""
        weight = X.new_full((problem.B,), self.initial_penalty)
        return GuideRegion.inactive(X, weight, problem.position)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        """CPUF for every problem: a region where it is caught, none elsewhere; or the sampled controls themselves."""
        assert penalty is not None
        knots = caught_knots(problem, X, U, key.outer, self.single_contact_after)
        region = GuideRegion.inactive(X, penalty.weight * self.penalty_growth, penalty.position)
        plan, taken = U.clone(), torch.zeros_like(knots[:, 0])
        rows = knots.any(-1).nonzero().flatten()
        if rows.numel() > 0:
            subset = problem.take(rows)
            mean = problem.cost.rest_controls(U)[rows] if self.sample_from_rest else U[rows]
            X_safe, plan[rows] = self.sampler.improve(subset, mean, key.take(rows))
            holds = subset.cost.total(X_safe, plan[rows]).abs() <= DIVERGED * subset.N * cost_scale(subset).unit
            if self.start_from_sample:
                taken[rows] = ~active_counts(subset, X_safe, plan[rows]).any(-1) & holds
            near = torch.where(knots[rows] & holds.unsqueeze(-1), _radius(problem, X)[rows].unsqueeze(-1), torch.inf)
            attracted = replace(take(region, rows), center=X_safe[..., region.position], radius=near)
            put(region, rows[~taken[rows]], take(attracted, (~taken[rows]).nonzero().flatten()))
        return Advice(region, plan, taken)


def _radius(problem: Problem, X: Tensor) -> Tensor:
    """r_guide (B,), m."""
    if problem.obstacles:
        return problem.obstacles[0].vehicle_radius
    position = problem.position
    ends = X[:, 1:, position] if problem.goal is None else problem.goal.position.unsqueeze(1)
    return R_GUIDE * (ends - problem.x0[:, None, position]).square().sum(-1).sqrt().amax(-1)
