"""Weights of a cost from demonstrations among obstacles, by Gauss and Newton through the solves.

Per seed: twelve layouts of `planar_random`, true weights (the usual ones, each times e^x, x normal with deviation 0.5)
that the demonstrations are planned with, and a first guess (the true ones, each times e^x, x normal with deviation 1).
One weight of a control is known, as all weights times a number have the same trajectories. Plans begin with the
demonstrations, whose multipliers keep them on their way round. `noise` blurs the numbers of the demonstrations.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

import torchgco
from torchgco import InteriorPoint, Problem, QuadraticCost, Solution, Status
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.experiments.config.build import compose

D = torch.float64
# From a larger barrier, plans leave the way of their demonstration for another.
NEAR = InteriorPoint(warm_barrier=1e-6, tolerance=1e-10)
OTHERS, LEAST_MISS = 3.0, 1e-20  # a plan that misses by over so many times the median counts little
DAMPING, LEAST_DAMPING = 0.1, 1e-4
TRIALS, SHORTEST = 60, 1e-6  # of steps, and the length of one, in logarithms, at which the search ends
BLUR = 1e-3  # error of all numbers of demonstrations, in their deviations, for which ...
IDENTIFIED = (
    0.02  # ... a weight is identifiable if its standard deviation, by Cramer's and Rao's bound, is below this share
)
USED = 1e-6  # weights below it only keep a matrix regular, and are known


@dataclass(frozen=True)
class Recovered:
    """Of one seed, with w unknown weights.

    Attributes:
        start, found: weights divided by the true ones, (w,).
        identifiable: (w,) bool.
        solves: gradients and trials.
        seconds: of processor.
        loss: mean square miss at the end, in deviations of the demonstrations; infinite where a plan fails.
    """

    start: Tensor
    found: Tensor
    identifiable: Tensor
    solves: int
    seconds: float
    loss: float

    @property
    def largest(self) -> float:
        """The largest relative error of an identifiable weight."""
        return float((self.found - 1).abs()[self.identifiable].max())

    @property
    def median(self) -> float:
        """The median relative error of the identifiable weights."""
        return float((self.found - 1).abs()[self.identifiable].median())

    @property
    def of_all(self) -> float:
        """The largest relative error of any weight."""
        return float((self.found - 1).abs().max())


class Demonstrations:
    """What is shown under one seed, and what plans of other weights miss of it.

    Args:
        noise: error of all numbers seen, in their deviations.
    """

    def __init__(self, seed: int, count: int, noise: float = 0.0) -> None:
        setup = compose(["model=planar", "scenario=planar_random"])
        self.problem = setup.vehicle.task(setup.scenario.draw(list(range(count)), seed)).problem
        n, m = self.problem.n, self.problem.m
        self.cost = cost = cast(BoundQuadratic, self.problem.cost)
        usual = torch.cat([part.flatten()[:size] for part, size in ((cost.Q, n), (cost.R, m), (cost.Qf, n))])
        unknown = usual > USED
        unknown[n] = False
        self.unknown, generator = unknown.nonzero().flatten(), torch.Generator().manual_seed(seed)
        drawn = lambda: torch.randn(len(self.unknown), generator=generator, dtype=D)
        self.usual, self.true = usual, (usual[unknown].log() + 0.5 * drawn()).detach()
        self.guess = self.true + drawn()
        with torch.no_grad():
            self.shown = torchgco.solve(self.planned_by(self.true), verbose=False)
            self.shown = torchgco.solve(self.planned_by(self.true), warm=self.shown, solver=NEAR, verbose=False)
        self.scale = [part.std((0, 1)).clamp(min=1e-3) for part in (self.shown.X, self.shown.U)]
        self.known = self._identifiable()  # of what is flown
        if noise:
            pairs = zip((self.shown.X, self.shown.U), self.scale, strict=True)
            X, U = (part + noise * by * torch.randn(part.shape, generator=generator, dtype=D) for part, by in pairs)
            self.shown = replace(self.shown, X=X, U=U)

    def planned_by(self, logarithms: Tensor) -> Problem:
        """The problems with these weights."""
        whole, cost, n, m = self.problem, self.cost, self.problem.n, self.problem.m
        weights = self.usual.index_copy(0, self.unknown, logarithms.exp())
        Q, R, Qf = weights.split([n, m, n])
        x_ref = torch.cat((cost.x_ref.expand(-1, whole.N, -1), cost.xf_ref.unsqueeze(1)), dim=1)
        new = QuadraticCost(Q, R, Qf, x_ref=x_ref, u_ref=cost.u_ref)
        return Problem(whole.dynamics, new, whole.constraints, whole.x0, whole.N, whole.goal)

    def plan(self, logarithms: Tensor) -> Solution:
        """Plans with these weights, from the demonstrations."""
        return torchgco.solve(self.planned_by(logarithms), warm=self.shown, solver=NEAR, verbose=False)

    @cached_property
    def usable(self) -> Tensor:
        """Whether a demonstration is a solution, (B,)."""
        return self.shown.status == Status.CONVERGED

    def off(self, plan: Solution) -> Tensor:
        """What plans miss, (B, numbers), in deviations; the sum of a problem's squares is the mean of states' squares
        and that of controls' squares."""
        pairs = ((plan.X, self.shown.X), (plan.U, self.shown.U))
        parts = [((new - old) / by).flatten(1) for (new, old), by in zip(pairs, self.scale, strict=True)]
        return torch.cat([part / math.sqrt(part.shape[1]) for part in parts], dim=1)

    def slopes(self, logarithms: Tensor) -> Tensor:
        """Derivatives (usable, numbers, w) of `off`, all columns from one solve; 0 where a plan has none."""
        miss = lambda at: self.off(self.plan(at))
        found = torch.autograd.functional.jacobian(miss, logarithms, vectorize=True, strategy="forward-mode")
        return cast(Tensor, found).detach()[self.usable]

    def _identifiable(self) -> Tensor:
        """Which weights (w,) the demonstrations determine."""
        sizes = torch.tensor([part[0].numel() for part in (self.shown.X, self.shown.U)])
        each = self.slopes(self.true) * sizes.double().sqrt().repeat_interleave(sizes).unsqueeze(-1)  # by deviations
        _, s, V = torch.linalg.svd(each.flatten(0, 1), full_matrices=False)
        return BLUR * (V / s.unsqueeze(-1)).square().sum(0).sqrt() < IDENTIFIED


def recovered(seed: int, count: int, noise: float = 0.0) -> Recovered:
    """Find the weights: damped steps of Gauss and Newton for the mean of e / (1 + e / c), e a plan's miss.

    c is OTHERS times the median miss: plans on another way round, which miss by more than others, count little. Damping
    is in proportion to the loss, so that weights that nothing shows stay.
    """
    shown = Demonstrations(seed, count, noise)
    began, at, damping, solves = time.process_time(), shown.guess, DAMPING, 2
    now, J = _seen(shown, at), shown.slopes(at)
    for _ in range(TRIALS):
        c = max(OTHERS * float(now.each[now.solved].median()), LEAST_MISS)
        step = _step(J, now, c, damping)
        new, solves = _seen(shown, at + step), solves + 1
        if new.loss(c) < now.loss(c):
            at, now, damping = at + step, new, max(damping / 5, LEAST_DAMPING)
            J, solves = shown.slopes(at), solves + 1
        else:
            damping *= 10
        if float(step.abs().max()) < SHORTEST:
            break
    ratio = lambda logarithms: (logarithms - shown.true).exp()
    loss = float(now.each.mean())
    return Recovered(ratio(shown.guess), ratio(at), shown.known, solves, time.process_time() - began, loss)


@dataclass(frozen=True)
class Seen:
    """What plans with some weights miss, (B, numbers), of demonstrations that are solved."""

    miss: Tensor
    solved: Tensor  # (B,) bool: whether the plan is

    @property
    def each(self) -> Tensor:
        """Mean squares (B,), infinite without a plan."""
        return torch.where(self.solved, self.miss.square().sum(-1), math.inf)

    def loss(self, c: float) -> float:
        return float(torch.where(self.solved, self.each / (1 + self.each / c), c).mean())


def _seen(shown: Demonstrations, at: Tensor) -> Seen:
    with torch.no_grad():
        plan = shown.plan(at)
        miss = shown.off(plan)
    return Seen(miss[shown.usable], (plan.status == Status.CONVERGED)[shown.usable])


def _step(J: Tensor, now: Seen, c: float, damping: float) -> Tensor:
    """The step of the logarithms (w,), no longer than 1."""
    pull = (1 / (1 + now.each / c)).unsqueeze(-1)
    A, b = (J * pull.unsqueeze(-1)).flatten(0, 1), torch.where(now.solved.unsqueeze(-1), now.miss * pull, 0.0).flatten()
    H = A.mT @ A
    step = torch.linalg.solve(H + damping * len(J) * now.loss(c) * torch.eye(len(H), dtype=D), -(A.mT @ b))
    return step / max(1.0, float(step.abs().max()))
