"""A kind of obstacles that a user writes: rings in space, at rest or moving, by the methods that each must have."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import Body, Constraint, ControlBounds, FunctionDynamics, Goal, Problem, QuadraticCost, judge
from torchgco.base.shapes import Dimensions
from torchgco.compiled.numbers import with_own_numbers
from torchgco.obstacles import Obstacles
from torchgco.obstacles.base import ABSENT, least
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.obstacles.measured import along_ways
from torchgco.obstacles.shapes import RoundedBoxes
from torchgco.plotting.scene import world_of
from torchgco.roadmap.geometry import scene_of

D = torch.float64
BARS = 12  # around a ring, as the search and pictures see it
CUTS = 32  # of a way


@dataclass(frozen=True)
class Rings(Obstacles):
    """Tubes around circles in planes x = const, one or more per problem."""

    centers: Tensor  # (B, M, 3), m
    ring_radii: Tensor  # (B, M), m
    tube_radii: Tensor  # (B, M), m
    vehicle_radius: Any  # (B,), m; or a `Body`
    velocities: Tensor | None = None  # (B, M, 3), m/s
    knots: Any = None
    position: Any = None
    dt: float = 0.0
    stops: Tensor | None = None

    batched = ("centers", "ring_radii", "tube_radii", "vehicle_radius", "velocities", "stops")
    margins = property(lambda self: self.tube_radii + self.vehicle_radius.unsqueeze(-1))  # type: ignore[assignment]
    absent = property(lambda self: torch.zeros_like(self.margins, dtype=torch.bool))  # type: ignore[assignment]
    moving = property(lambda self: self.velocities is not None)  # type: ignore[assignment]

    def bind(self, dims: Dimensions) -> Constraint:
        if isinstance(self.vehicle_radius, Body):
            return self.vehicle_radius.around(self, dims)
        return replace(self, knots=slice(1, dims.N + 1), position=dims.position, dt=dims.dt)

    def grown(self, by: Tensor) -> Self:
        return replace(self, vehicle_radius=self.vehicle_radius + by)

    def away(self, p: Tensor, t: Tensor) -> Tensor:
        away = p.unsqueeze(2) - self.centers.unsqueeze(1)
        return away if self.velocities is None else away - t.view(1, -1, 1, 1) * self.velocities.unsqueeze(1)

    def apart(self, away: Tensor) -> Tensor:
        across = (away[..., 1:].square().sum(-1) + 1e-12).sqrt() - self.ring_radii.unsqueeze(1)
        return (across.square() + away[..., 0].square() + 1e-12).sqrt() - self.margins.unsqueeze(1)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return self.apart(self.away(p, t))

    def along(self, a: Tensor, b: Tensor) -> Tensor:
        cuts = torch.stack([self.apart(torch.lerp(a, b, i / CUTS)) for i in range(CUTS + 1)])
        return 0.5 * (cuts[1:] + cuts[:-1] - (b - a).norm(dim=-1) / CUTS).amin(0)

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        return self.along(self.away(a, a.new_zeros(1)), self.away(b, b.new_zeros(1)))

    def chord_clearance(self, X: Tensor, share: float | None = None) -> Tensor:
        away = self.away(X[..., self.position], self.dt * torch.arange(X.shape[1], dtype=X.dtype))
        return least(self.along(away[:, :-1], away[:, 1:]) + self.beneath(share).unsqueeze(1))

    def measured(self, X: Tensor) -> tuple[Tensor, Tensor]:
        away = self.away(X[..., self.position], self.dt * torch.arange(X.shape[1], dtype=X.dtype))
        across = torch.linalg.vector_norm(away[..., 1:], dim=-1) - self.ring_radii.unsqueeze(1)
        ends = torch.hypot(across, away[..., 0]) - self.margins.unsqueeze(1)

        def nearest(i: Tensor, k: Tensor, j: Tensor) -> Tensor:
            share = torch.linspace(0, 1, 200, dtype=X.dtype).view(-1, 1, 1)
            q = torch.lerp(away[i, k, j], away[i, k + 1, j], share)
            across = torch.linalg.vector_norm(q[..., 1:], dim=-1) - self.ring_radii[i, j]
            step = (away[i, k + 1, j] - away[i, k, j]).norm(dim=-1) / 199
            return (torch.hypot(across, q[..., 0]) - self.margins[i, j]).amin(0) - 0.5 * step

        return along_ways(ends, away, self.contact_depths, self.absent, nearest)

    def bars(self) -> tuple[Tensor, Tensor, Tensor]:
        """Centres, half sides and sides of bars around the rings, of all rings: (B, M P, 3), (B, M P, 3, 3)."""
        turn = 2.0 * math.pi * torch.arange(BARS, dtype=D) / BARS
        out = torch.stack((0.0 * turn, turn.cos(), turn.sin()), dim=-1)
        along = torch.stack((0.0 * turn, -turn.sin(), turn.cos()), dim=-1)
        ahead = torch.eye(3, dtype=D)[0].expand_as(out)
        radii = self.ring_radii[..., None, None]
        centers = self.centers.unsqueeze(2) + radii * math.cos(math.pi / BARS) * out
        half = radii * math.sin(math.pi / BARS) * torch.tensor([1.0, 0.0, 0.0], dtype=D).expand_as(centers)
        sides = torch.stack((along, out, ahead), dim=-2).expand(*self.margins.shape, BARS, 3, 3)  # left-handed
        return centers.flatten(1, 2), half.flatten(1, 2), sides.flatten(1, 2)

    def inflated(self) -> Cuboids | None:
        if self.moving:
            return None
        centers, half, sides = self.bars()
        radii = self.margins + (1.0 - math.cos(math.pi / BARS)) * self.ring_radii
        radii = radii.repeat_interleave(BARS, dim=1)
        return Cuboids(centers, radii, torch.zeros_like(radii, dtype=torch.bool), sides, half)

    def shapes(self, b: int) -> RoundedBoxes:
        center, half, sides = (part[b].numpy() for part in self.bars())
        radius = self.tube_radii[b].repeat_interleave(BARS).numpy()
        velocity = None if self.velocities is None else self.velocities[b].repeat_interleave(BARS, dim=0).numpy()
        return RoundedBoxes(center, half, sides, radius, velocity)


def flight(moving: bool, body: Body | None = None, horizon: list[int] | None = None) -> Problem:
    """Three flights to x = 4 through or past two rings, from y = 0, 0.5 and 0.9 m."""
    model = FunctionDynamics(
        lambda x, u: torch.cat((x[..., 3:], u), -1), n=6, m=3, dt=0.1, integrator="rk4", position=slice(0, 3)
    )
    x0 = torch.zeros(3, 6, dtype=D)
    x0[:, 1] = torch.tensor([0.0, 0.5, 0.9])
    each = lambda rows: torch.tensor(rows, dtype=D).expand(3, *np.shape(rows)).contiguous()
    velocities = each([[0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]) if moving else None
    centers, radius = each([[2.0, 0.6, 0.0], [3.0, -0.3, 0.2]]), each(0.15) if body is None else body
    rings = Rings(centers, each([0.6, 0.5]), each([0.1, 0.08]), radius, velocities)
    cost = QuadraticCost(Q=[0.1] * 6, R=[0.1] * 3, Qf=[50] * 3 + [5] * 3, x_ref=[4, 0, 0, 0, 0, 0])
    parts = [ControlBounds([-3] * 3, [3] * 3), rings]
    return Problem(model, cost, parts, x0, N=50, goal=Goal([4, 0, 0], radius=0.2), horizon=horizon)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("moving", [False, True])
def test_it_is_solved_judged_and_drawn(moving: bool) -> None:
    problem = flight(moving)
    assert (scene_of(problem, torch.zeros(3, 50, 3, dtype=D)) is None) == moving
    solution = torchgco.solve(problem)
    verdict = judge(problem, solution.U)
    assert bool((verdict.reached & verdict.feasible).all())
    assert torch.equal(torchgco.solve(problem.take(torch.tensor([2])), ids=torch.tensor([2])).U, solution.U[2:])
    assert torchgco.show(problem, solution) is not None
    (scene,) = world_of(problem, 0).scenes
    assert len(scene.bodies[0]) == 2 * BARS and all(body.moving == moving for body in scene.bodies[0])
    if moving:
        np.testing.assert_allclose(scene.bodies[0][0].at(2.0) - scene.bodies[0][0].center, [0.0, 0.2, 0.0])


def level(x: Tensor) -> Tensor:
    """A vehicle that doesn't turn."""
    return torch.eye(3, dtype=x.dtype).expand(*x.shape[:-1], 3, 3)


@pytest.mark.slow
def test_it_is_met_by_a_body_and_ends_with_each_horizon() -> None:
    long = Body([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]], [0.1, 0.1], level)
    for problem in (flight(False, body=long), flight(False, horizon=[50, 40, 35])):
        verdict = judge(problem, torchgco.solve(problem).U)
        assert bool((verdict.reached & verdict.feasible).all())
    by_hand = flight(False).constraints[1]
    assert isinstance(by_hand, Rings)
    X, U = torch.randn(3, 51, 6, dtype=D, generator=torch.Generator().manual_seed(2)), torch.zeros(3, 50, 3, dtype=D)
    ball = by_hand.grown(torch.full((3,), -0.05, dtype=D))
    ahead = torch.tensor([0.1, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=D)
    due = torch.cat([ball.value(X + side * ahead, U) for side in (1.0, -1.0)], dim=-1)
    torch.testing.assert_close(flight(False, body=long).constraints[1].value(X, U), due)


def test_rows_are_minus_the_distances_with_their_slopes() -> None:
    problem = flight(True)
    part = problem.constraints[1]
    assert isinstance(part, Rings)
    X = torch.randn(3, 51, 6, dtype=D, generator=torch.Generator().manual_seed(1))
    U, rows = torch.zeros(3, 50, 3, dtype=D), part.value(X, torch.zeros(3, 50, 3, dtype=D))
    assert torch.equal(rows, -part.distances(X))
    assert torch.equal(rows[:, 6:7], part.at(X[:, 7:8], 7))
    g, H = torch.rand_like(rows), X.new_zeros(3, 51, 10, 10)
    part.accumulate(X, U, g, torch.zeros_like(g), H)
    free = X.clone().requires_grad_()
    (g * part.value(free, U)).sum().backward()
    torch.testing.assert_close(H[..., :6, 6], free.grad)
    ends = part.stopping_at(torch.tensor([3, 50, 50]))
    assert bool((ends.value(X, U)[0, 3:] == ABSENT).all()) and torch.equal(ends.value(X, U)[1], rows[1])


def test_its_numbers_are_written_by_a_compiled_problem() -> None:
    problem = flight(False)
    again = torchgco.compile(problem)
    names = [number.name for number in with_own_numbers(problem).constraints[1].numbers("rings", 1)]
    assert names == ["rings.centers", "rings.ring_radii", "rings.tube_radii", "rings.vehicle_radius"]
    again(x0=problem.x0)
    U = again(tube_radii=[0.25, 0.25]).U
    verdict, before = (judge(each, torch.as_tensor(U)) for each in (again.problem, problem))
    assert bool(verdict.reached.all()) and bool((before.clearance - verdict.clearance > 0.05).all())
