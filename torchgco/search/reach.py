"""Whether a horizon suffices for the way to the goal: said where a solve misses it, if the model has limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.draws import uniform
from torchgco.base.errors import NAMED
from torchgco.base.shapes import computing_on
from torchgco.constraints.bounds import bounds_of
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import length, scene_of
from torchgco.roadmap.roadmap import Roadmap

STEP_SAMPLES = 64  # states and controls at which a step's length is looked at
WIDE = 3.0  # the range, around 0, of what has no bounds
INERT = 1e-9  # slope, as a share of the largest, of what a step's length doesn't depend on
CLIMBS = 40  # rounds of ascent from the samples, which halve a step of half the box to 5e-13 of it
WIDER, GROWN = 100.0, 0.01  # times that range, in which what has no bounds may raise the acceleration by this share
LEAST_SPEED = 1e-12  # m^2/s^2: squared speeds below it count as it
FEWER = 4  # one in so many samples shows how strong the acceleration is
LEEWAY = 1.25  # times the least stages: so many leave room for accelerating and turning, which that least hasn't
SHORT_TIME = 1e-6  # s, over which a change of velocity is measured
REACH_SEED = 0x5EED


def short_horizons(problem: Problem) -> str | None:
    """A sentence on the problems whose horizon is shorter than the way to their goal needs; None without any.

    Only for goals that were stated, and models with a largest step, one that no state or control without bounds makes
    longer, or else with a largest acceleration: of a double integrator with bounded controls. Through a map the way is
    the roadmap's, otherwise the straight line. Where the time is free, `solvers.timing` tells which would do.
    """
    found = _limit_and_way(problem)
    if found is None or problem.goal is None:
        return None
    limit, far = found
    goal, misses = problem.goal, (far > limit.reach(problem) + problem.goal.radius) & torch.isfinite(far)
    short = misses.nonzero().flatten().tolist()
    if not short:
        return None
    first, named = short[0], ", ".join(map(str, short[:NAMED])) + (", ..." if len(short) > NAMED else "")
    needed = float(limit.stages(problem, far - goal.radius)[misses].amax())
    return (
        f"{len(short)} of {problem.B} horizons are too short for the way to the goal (problem {named}): the first is "
        f"{float(far[first]):.3g} m long, of which {int(problem.stages[first])} stages cover at most "
        f"{float(limit.reach(problem)[first]):.3g} m; {limit.advice(first, needed)}"
    )


def beyond_reach(problem: Problem) -> Tensor:
    """Whether the horizon is known to be too short for the way to a stated goal, (B,) bool."""
    found = _limit_and_way(problem)
    if found is None or problem.goal is None:
        return torch.zeros_like(problem.x0[:, 0], dtype=torch.bool)
    return found[1] > found[0].reach(problem) + problem.goal.radius


def _limit_and_way(problem: Problem) -> tuple[Limit, Tensor] | None:
    """What limits the way within the horizon, and the way (B,) to a stated goal, m; None where nothing does."""
    goal = problem.goal
    if goal is None or goal.assumed or problem.B == 0 or problem.time is not None:
        return None
    with computing_on(problem.x0.device):
        limit = limit_of(problem)
        if limit is None:
            return None
        far = goal.distance(problem.x0[:, problem.position])
        reach = limit.reach(problem) + goal.radius
        far = torch.maximum(far, torch.where(far <= reach, _ways(problem, far <= reach), 0.0))
        if bool((far > reach).any()):  # the largest may lie between the samples
            limit = limit_of(problem, CLIMBS)
            assert limit is not None
    return limit, far


class Horizon(NamedTuple):
    """A horizon and the way to the goal, of one problem."""

    way: float  # m
    reach: float  # m, at most, within the stages
    stages: int
    needed: int  # stages, at least
    advice: str  # which horizon would do

    @property
    def suffices(self) -> bool | None:
        """Whether it isn't what keeps the vehicle from the goal; None where it may be, but needn't."""
        return False if self.needed > self.stages else True if self.stages >= LEEWAY * self.needed else None

    def __str__(self) -> str:
        """A sentence on one that is too short."""
        return (
            f"A longer horizon: the way to the goal is {self.way:.3g} m long, of which {self.stages} stages cover at "
            f"most {self.reach:.3g} m; {self.advice}."
        )


def horizon_of(problem: Problem) -> Horizon | None:
    """The horizon of a batch of one; None where no goal is stated, or nothing limits the way within it."""
    goal = problem.goal
    if goal is None or goal.assumed or problem.time is not None:
        return None
    with computing_on(problem.x0.device):
        limit = limit_of(problem, CLIMBS)
        if limit is None:
            return None
        far = goal.distance(problem.x0[:, problem.position])
        far = torch.maximum(far, _ways(problem, torch.isfinite(far)))
        needed = float(limit.stages(problem, (far - goal.radius).clamp(min=0.0))[0])
        if not math.isfinite(needed):
            return None
        stages, reach = int(problem.stages[0]), float(limit.reach(problem)[0])
        return Horizon(float(far[0]), reach, stages, math.ceil(needed), limit.advice(0, needed))


def within_reach(problem: Problem) -> Tensor:
    """Whether horizons suffice for the straight way to the goal, (B,) bool; as far as is known."""
    assert problem.goal is not None
    limit, far = limit_of(problem), problem.goal.distance(problem.x0[:, problem.position])
    return torch.ones_like(far).bool() if limit is None else far <= limit.reach(problem) + problem.goal.radius


class Limit(NamedTuple):
    """What limits the way of each problem; infinite: nothing of that kind does."""

    step: Tensor  # the longest way of a stage, (B,), m
    push: Tensor  # the largest increase of the speed, (B,), m/s^2; of problems without a longest step alone

    def advice(self, b: int, stages: float) -> str:
        """Which horizon problem b should take, if it takes so many stages."""
        if not math.isfinite(stages):
            return "no horizon would do: the bounds keep the vehicle where it is"
        N = math.ceil(stages)
        if math.isfinite(float(self.step[b])):
            return f"N = {N} would do at full speed"
        return f"from rest to rest it takes N = {N} at full acceleration"

    def reach(self, problem: Problem) -> Tensor:
        """The way (B,), m, that the horizon covers at most, or on which a vehicle accelerates until its end."""
        time, u = problem.stages * float(problem.dynamics.dt), problem.x0.new_zeros(problem.B, problem.m)
        by_steps = problem.stages * self.step
        if not bool(torch.isfinite(self.push).any()):
            return by_steps
        speed = problem.dynamics.field(problem.x0, u)[:, problem.position].square().sum(-1).sqrt()
        return torch.minimum(by_steps, speed * time + 0.5 * self.push * time.square())

    def stages(self, problem: Problem, way: Tensor) -> Tensor:
        """The stages (B,) that ways (B,), m, take at least; by a push half accelerating and half braking."""
        return torch.maximum(way / self.step, 2.0 * (way / self.push).sqrt() / float(problem.dynamics.dt))


def limit_of(problem: Problem, climbs: int = 0) -> Limit | None:
    """What limits the way within a horizon, by the bounds on states and controls; None where nothing can.

    The longest step is the greatest of samples and corners of what it depends on, which has bounds at all knots, after
    so many rounds of projected gradient ascent from each. So is the strongest push, where controls don't change the
    speed at once; but what has no bounds may matter as long as the push doesn't grow with it: it is compared in ranges
    that are a hundred times as wide, or as narrow.
    """
    box = _Box.of(problem)
    if box is None:
        return None
    fits = (box.bounded | ~box.depends).all(-1)
    step = push = torch.full_like(problem.x0[:, 0], torch.inf)
    if bool(fits.any()):
        ways = _climbed(lambda z: _way(problem, z), box.z, box.least, box.most, climbs).amax(-1).sqrt()
        step = torch.where(fits, ways, step)
    if not bool(fits.all()) and problem.dynamics.is_integrated:
        push = torch.where(fits, push, _strongest(problem, box, climbs))
    return Limit(step, push) if bool(torch.isfinite(torch.minimum(step, push)).any()) else None


def push_of(problem: Problem) -> Tensor:
    """The largest increase of the speed, (B,), m/s^2, also where speeds are bounded; infinite where none is."""
    box = _Box.of(problem)
    if box is None or not problem.dynamics.is_integrated:
        return torch.full_like(problem.x0[:, 0], torch.inf)
    return _strongest(problem, box, 0)


class _Box(NamedTuple):
    """Where states and controls are looked at."""

    bounded: Tensor  # (B, n + m) bool; the others lie within `WIDE` around 0
    least: Tensor  # (B, 1, n + m)
    most: Tensor
    z: Tensor  # (B, 2 STEP_SAMPLES, n + m): samples, and corners
    depends: Tensor  # (B, n + m) bool: on what the way of a stage does

    @classmethod
    def of(cls, problem: Problem) -> _Box | None:
        """None without a position, or with a model that isn't the same at all stages."""
        if problem.dynamics.position is None or problem.dynamics.at(0) is not problem.dynamics:
            return None
        low, high = bounds_at_inner_knots(problem)
        bounded = torch.isfinite(low) & torch.isfinite(high)
        share = uniform(REACH_SEED, (1, STEP_SAMPLES, problem.n + problem.m), low)  # the same for every problem
        least, most = (torch.where(bounded, *ends).unsqueeze(1) for ends in ((low, -WIDE), (high, WIDE)))
        z = least + share * (most - least)
        (slopes,) = gradients_at_once(lambda z: _way(problem, z), z)
        depends = (slopes.abs() > INERT * slopes.abs().amax((1, 2), keepdim=True)).any(1)
        return cls(bounded, least, most, torch.cat((z, least + (share > 0.5) * (most - least)), dim=1), depends)


def _strongest(problem: Problem, box: _Box, climbs: int) -> Tensor:
    """The strongest push, (B,), m/s^2; infinite where it isn't limited."""
    bounded, some = box.bounded.unsqueeze(1), box.z[:, ::FEWER]
    z = torch.cat([torch.where(bounded, some, scale * some) for scale in (1.0 / WIDER, 1.0, WIDER)], dim=1)
    low, near, far = _push(problem, z).unflatten(1, (3, -1)).amax(-1).unbind(1)
    near = torch.maximum(low, near)  # where drag grows with the speed, the slowest accelerate the most
    limited = torch.isfinite(near) & (near > 0) & (far <= (1.0 + GROWN) * near) & ~box.depends[:, problem.n :].any(-1)
    if climbs > 0 and bool(limited.any()):
        z = z[:, : 2 * some.shape[1]]
        near = torch.maximum(near, _climbed(lambda z: _push(problem, z), z, box.least, box.most, climbs).amax(-1))
    return torch.where(limited, near, torch.inf)


def _push(problem: Problem, z: Tensor) -> Tensor:
    """How fast the speed grows, (B, S), m/s^2, at states and controls z (B, S, n + m)."""
    field, at, n = problem.dynamics.field, problem.position, problem.n
    x, u = z[..., :n], z[..., n:]
    rate = field(x, u)
    change = (field(x + SHORT_TIME * rate, u)[..., at] - field(x - SHORT_TIME * rate, u)[..., at]) / (2.0 * SHORT_TIME)
    return (rate[..., at] * change).sum(-1) / rate[..., at].square().sum(-1).clamp(min=LEAST_SPEED).sqrt()


def _climbed(value: Callable[[Tensor], Tensor], z: Tensor, least: Tensor, most: Tensor, climbs: int) -> Tensor:
    """The values (B, S) after ascent from z (B, S, n + m) within a box; steps that don't ascend are halved."""
    way, size = value(z), torch.full_like(z[..., :1], 0.5)
    for _ in range(climbs):
        (slopes,) = gradients_at_once(value, z)
        slopes = slopes * (most - least)
        tried = z + size * (most - least) * slopes / slopes.abs().amax(-1, keepdim=True).clamp(min=1e-300)
        tried = torch.minimum(torch.maximum(tried, least), most)
        longer = value(tried)
        better = longer > way
        z, way = torch.where(better.unsqueeze(-1), tried, z), torch.where(better, longer, way)
        size = torch.where(better.unsqueeze(-1), size, 0.5 * size)
    return way


def _way(problem: Problem, z: Tensor) -> Tensor:
    """The squared lengths (B, S) of a stage's way at states and controls (B, S, n + m)."""
    x, u = z[..., : problem.n], z[..., problem.n :]
    at, dynamics = problem.position, problem.dynamics
    if not dynamics.stretches:
        return (dynamics.step(x, u) - x)[..., at].square().sum(-1)
    return (dynamics.dt * dynamics.field(x, u)[..., at]).square().sum(-1)


def bounds_at_inner_knots(problem: Problem) -> tuple[Tensor, Tensor]:
    """The loosest bounds (B, n + m) of the states at knots 1..N-1 and of the controls; infinite without any."""
    low = problem.x0.new_full((problem.B, problem.n + problem.m), -torch.inf)
    high = -low
    for part in bounds_of(problem.constraints):
        controls = part.of == "u"
        lower, upper = part.over(problem.N if controls else problem.N + 1)
        inner = slice(None) if controls or lower.shape[1] == 1 else slice(1, max(2, problem.N))
        own = slice(problem.n, problem.n + lower.shape[-1]) if controls else slice(0, lower.shape[-1])
        low[:, own] = torch.maximum(low[:, own], lower[:, inner].amin(1))
        high[:, own] = torch.minimum(high[:, own], upper[:, inner].amax(1))
    return low, high


def _ways(problem: Problem, asked: Tensor) -> Tensor:
    """Lengths (B,), m, of the shortest ways through the maps of the problems that are asked for; 0 where unknown."""
    found = torch.zeros_like(problem.x0[:, 0])
    rows = asked.nonzero().flatten()
    rest = problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m))
    scene = scene_of(problem, rest)
    if scene is None or not scene.obstacles.maps or rows.numel() == 0:
        return found
    scene = replace(scene.take(rows), traversal_cost=lambda points, some: torch.ones_like(points[..., 0]))
    paths, there = Roadmap().paths(scene)
    found[rows] = torch.where(there, length(paths[:, 0]), 0.0)
    return found
