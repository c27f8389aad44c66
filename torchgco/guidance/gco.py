"""Guidance by constraint optimisation: the paper's plug-in of the outer loop (Algorithm 4)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.constraints.guides import GuideRegion
from torchgco.constraints.obstacles import BoundSpheres
from torchgco.draws import DrawKey
from torchgco.errors import GuidanceWarning, InputError
from torchgco.guidance.detection import active_counts, caught_knots
from torchgco.guidance.detour import Detour
from torchgco.guidance.misfits import suited_detour, suited_sampler
from torchgco.guidance.mppi import MPPI
from torchgco.guidance.region import guide_along
from torchgco.guidance.scene import position
from torchgco.lagrangian import Multipliers
from torchgco.native.dispatch import cost_unit
from torchgco.problem import Problem
from torchgco.solvers.state import Advice
from torchgco.tree import put, take

REACH = 0.02  # r_guide as a share of the distance to be flown; the paper's vehicles have radii of 0.017 and 0.03 of it
DIVERGED = 1e3  # times what staying at the start costs: a plan that costs more leads nowhere


@dataclass(frozen=True)
class GCO:
    """Where a solved trajectory is caught between obstacles, draw it to where MPPI found a way.

    Args:
        sampler: finds the way, from the present controls; None: no way but that of `detour`.
        initial_penalty, penalty_growth: mu_gco and its factor nu per outer iteration; nu above the solver's eta lets
            the guide prevail.
        radius: r_guide, m; None takes the vehicle's radius, or without spheres `REACH` times the distance from start to
            goal (to the farthest knot of the path where the cost names no goal).
        grow_when_idle: mu_gco grows in every outer iteration (as Algorithm 4, line 11, prints it), or only in those
            that find the element caught, so that late guidance starts as gently as early guidance.
        adopt: where the sampled plan touches nothing, go on from the plan itself instead of being drawn to it.
        afresh: sample around the cost's reference controls (the vehicle at rest), not around the path that is caught.
        detour: a plan along a short way around static spheres, to go on from; None: never (as in the paper).
        detour_at: the attempt, from 1, that is the first detour, along the best of the ways.
        detours: how many attempts from there on are, each along the next best; all others are sampled, and these too
            where there is no way.
        patience: from this outer iteration on, a single active sphere counts as being caught too; None: never.

    Raises:
        InputError: a field out of its range; on `suited`, a covariance or pushes that don't fit the controls.
    """

    sampler: MPPI | None = MPPI()
    initial_penalty: float = 20.0
    penalty_growth: float = 4.84
    radius: float | None = None
    grow_when_idle: bool = True
    adopt: bool = False
    patience: int | None = None
    afresh: bool = False
    detour: Detour | None = None
    detour_at: int = 1
    detours: int = 1

    def __post_init__(self) -> None:
        if not self.initial_penalty > 0:
            raise InputError("gco.initial_penalty", "above 0", self.initial_penalty)
        if not self.penalty_growth >= 1:
            raise InputError("gco.penalty_growth", "at least 1", self.penalty_growth)
        for name in ("detour_at", "detours"):
            if getattr(self, name) < 1:
                raise InputError(f"gco.{name}", "at least 1", getattr(self, name))
        if self.radius is not None and not self.radius > 0:
            raise InputError("gco.radius", "above 0 m, or null", self.radius)

    def suited(self, problem: Problem) -> GCO | None:
        """This guidance without the parts that can't serve a problem, which a GuidanceWarning names; None: nothing can.

        Without geometric constraints nothing is ever caught, and none is needed.
        """
        if not problem.geometric:
            return None
        if problem.dynamics.position is None:
            sampler, detour, lost = None, None, ["the dynamics have no position"]
        else:
            sampler, unsampled = suited_sampler(self.sampler, problem)
            detour, unsought = suited_detour(self.detour, problem)
            lost = [why for why in (unsampled, unsought) if why is not None]
        if lost:
            what = "solved without guidance" if sampler is None and detour is None else "guided in part"
            warnings.warn(f"{what}: {'; '.join(lost)}", GuidanceWarning, stacklevel=4)
        return None if sampler is None and detour is None else replace(self, sampler=sampler, detour=detour)

    def start(self, problem: Problem, X: Tensor) -> GuideRegion:
        """No guidance yet, for any element (Algorithm 4, lines 3-4)."""
        weight = X.new_full((problem.B,), self.initial_penalty)
        return GuideRegion.inactive(X, weight, position(problem))

    def update(self, problem: Problem, X: Tensor, U: Tensor, guide: GuideRegion, key: DrawKey) -> Advice:
        """CPUF for every element: a region where it is caught, none where it isn't; or the plan itself, where taken."""
        knots = self._caught(problem, X, U, key)
        caught = knots.any(-1)
        growing = torch.ones_like(caught) if self.grow_when_idle else caught
        weight = torch.where(growing, guide.weight * self.penalty_growth, guide.weight)
        new, plan, taken = GuideRegion.inactive(X, weight, guide.position), U.clone(), torch.zeros_like(caught)
        duals = iterations = None
        if self.detour is not None:
            attempt = torch.ones_like(key.ids) if key.attempt is None else key.attempt
            rank = attempt - self.detour_at
            turn = (caught & (rank >= 0) & (rank < self.detours)).nonzero().flatten()
            if turn.numel() > 0:
                proposal = self.detour.propose(problem.take(turn), rank[turn])
                plan[turn], taken[turn] = proposal.U, proposal.found
                duals, iterations = Multipliers.zero(problem, torch.nan), torch.zeros_like(key.ids)
                put((duals, iterations), turn, (proposal.duals, proposal.iterations))
        rows = (caught & ~taken).nonzero().flatten()
        if rows.numel() > 0 and self.sampler is not None:
            part = problem.take(rows)
            X_safe, plan[rows] = self.sampler.improve(part, self._mean(part, U[rows]), key.take(rows))
            holds = self._holds(part, X_safe, plan[rows])
            if self.adopt:
                taken[rows] = ~active_counts(part, X_safe, plan[rows]).any(-1) & holds
            drawn = guide_along(
                take(new, rows), X_safe, knots[rows] & holds.unsqueeze(-1), self._radius(problem, X)[rows]
            )
            put(new, rows[~taken[rows]], take(drawn, (~taken[rows]).nonzero().flatten()))
        return Advice(new, plan, taken, duals, iterations)

    def _holds(self, problem: Problem, X: Tensor, U: Tensor) -> Tensor:
        """Whether a sampled plan keeps to its task, (B,): unstable dynamics let samples diverge, away from all else."""
        return problem.cost.total(X, U).abs() <= DIVERGED * problem.N * cost_unit(problem)

    def _caught(self, problem: Problem, X: Tensor, U: Tensor, key: DrawKey) -> Tensor:
        """The knots (B, N+1) that guidance is for: J, and with patience those at a single sphere."""
        knots = caught_knots(problem, X, U)
        if self.patience is None:
            return knots
        # One sphere met dead-centre has no gradient to the side: J stays empty, and only time tells.
        return knots | (caught_knots(problem, X, U, least=1) & (key.age >= self.patience).unsqueeze(-1))

    def _mean(self, problem: Problem, U: Tensor) -> Tensor:
        """What the sampler starts from, (B, N, m)."""
        return problem.cost.rest_controls(U) if self.afresh else U

    def _radius(self, problem: Problem, X: Tensor) -> Tensor:
        """r_guide (B,), m."""
        if self.radius is not None:
            return problem.x0.new_full((problem.B,), self.radius)
        for constraint in problem.geometric:
            if isinstance(constraint, BoundSpheres):
                return constraint.vehicle_radius
        goal = problem.cost.goal(problem.x0)
        ends = X[:, 1:] if goal is None else goal.unsqueeze(1)
        return REACH * (ends - problem.x0.unsqueeze(1))[..., position(problem)].square().sum(-1).sqrt().amax(-1)
