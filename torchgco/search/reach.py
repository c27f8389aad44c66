"""Whether a horizon suffices for the way to the goal: said before a solve, where the model has a limit on speed."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchgco.base.autodiff import gradients
from torchgco.base.shapes import computing_on
from torchgco.constraints import ControlBounds, StateBounds
from torchgco.problem.problem import Problem
from torchgco.roadmap.geometry import length
from torchgco.roadmap.roadmap import Roadmap
from torchgco.roadmap.scene import scene_of

SAMPLES = 64  # states and controls at which a step's length is looked at
WIDE = 3.0  # the range, around 0, of what has no bounds
INERT = 1e-9  # slope, as a share of the largest, of what a step's length doesn't depend on
CLIMBS = 40  # rounds of ascent from the samples, which halve a step of half the box to 5e-13 of it
NAMED = 5  # problems that the sentence names
SEED = 0x5EED


def short_horizons(problem: Problem) -> str | None:
    """A sentence on the problems whose horizon is shorter than the way to their goal needs; None without any.

    Only for goals that were stated, and models with a largest step: one that no state or control without bounds makes
    longer. Through a map the way is the roadmap's, otherwise the straight line.
    """
    goal = problem.goal
    if goal is None or goal.assumed or problem.B == 0:
        return None
    with computing_on(problem.x0.device):
        step = longest_step(problem)
        if step is None:
            return None
        far = goal.distance(problem.x0[:, problem.position])
        reach = problem.stages * step + goal.radius
        far = torch.maximum(far, torch.where(far <= reach, _ways(problem, far <= reach), 0.0))
        if bool((far > reach).any()):  # the longest step may lie between the samples
            step = longest_step(problem, CLIMBS)
            assert step is not None
    short = (far > problem.stages * step + goal.radius).nonzero().flatten().tolist()
    if not short:
        return None
    first, named = short[0], ", ".join(map(str, short[:NAMED])) + (", ..." if len(short) > NAMED else "")
    needed = max(math.ceil(float((far[b] - goal.radius[b]) / step[b])) for b in short)
    return (
        f"{len(short)} of {problem.B} horizons are too short for the way to the goal (problem {named}): the first is "
        f"{float(far[first]):.3g} m long, of which {int(problem.stages[first])} stages cover at most "
        f"{float(problem.stages[first] * step[first]):.3g} m; N = {needed} would do at full speed"
    )


def longest_step(problem: Problem, climbs: int = 0) -> Tensor | None:
    """The longest way (B,), m, of a stage within the bounds on states and controls; None where nothing limits it.

    The greatest of samples and corners of what it depends on, which has bounds at all knots, after so many rounds of
    projected gradient ascent from each.
    """
    if problem.dynamics.position is None or problem.dynamics.at(0) is not problem.dynamics:
        return None
    low, high = bounds_at_inner_knots(problem)
    bounded = torch.isfinite(low) & torch.isfinite(high)
    draws = torch.Generator("cpu").manual_seed(SEED)  # the same for every problem and device
    share = torch.rand(1, SAMPLES, problem.n + problem.m, dtype=low.dtype, generator=draws, device="cpu").to(low.device)
    least, most = torch.where(bounded, low, -WIDE).unsqueeze(1), torch.where(bounded, high, WIDE).unsqueeze(1)
    z = least + share * (most - least)
    (slopes,) = gradients(lambda z: _way(problem, z), z)
    depends = (slopes.abs() > INERT * slopes.abs().amax()).flatten(0, 1).any(0)
    if not bool(bounded[:, depends].all()):
        return None
    z = torch.cat((z, least + (share > 0.5) * (most - least)), dim=1)
    return _climbed(problem, z, least, most, climbs).amax(-1).sqrt()


def _climbed(problem: Problem, z: Tensor, least: Tensor, most: Tensor, climbs: int) -> Tensor:
    """The squared lengths (B, S) after ascent from z (B, S, n + m) within a box; steps that don't ascend are halved."""
    way, size = _way(problem, z), torch.full_like(z[..., :1], 0.5)
    for _ in range(climbs):
        (slopes,) = gradients(lambda z: _way(problem, z), z)
        slopes = slopes * (most - least)
        tried = z + size * (most - least) * slopes / slopes.abs().amax(-1, keepdim=True).clamp(min=1e-300)
        tried = torch.minimum(torch.maximum(tried, least), most)
        longer = _way(problem, tried)
        better = longer > way
        z, way = torch.where(better.unsqueeze(-1), tried, z), torch.where(better, longer, way)
        size = torch.where(better.unsqueeze(-1), size, 0.5 * size)
    return way


def _way(problem: Problem, z: Tensor) -> Tensor:
    """The squared lengths (B, S) of a stage's way at states and controls (B, S, n + m)."""
    x, u = z[..., : problem.n], z[..., problem.n :]
    at, dynamics = problem.position, problem.dynamics
    if getattr(dynamics, "integrator", "none") == "none":
        return (dynamics.step(x, u) - x)[..., at].square().sum(-1)
    return (dynamics.dt * dynamics.field(x, u)[..., at]).square().sum(-1)


def bounds_at_inner_knots(problem: Problem) -> tuple[Tensor, Tensor]:
    """The loosest bounds (B, n + m) of the states at knots 1..N-1 and of the controls; infinite without any."""
    low = problem.x0.new_full((problem.B, problem.n + problem.m), -torch.inf)
    high = -low
    for part in problem.constraints:
        if not isinstance(part, ControlBounds | StateBounds):
            continue
        controls = isinstance(part, ControlBounds)
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
