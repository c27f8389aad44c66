"""Nets that are trained through solves: 500 steps of Adam, each a batch of solves, a backward pass and a step.

The zig-zag is the point mass that TurboMPC trains (ToyotaResearchInstitute/turbompc@5ecc275, examples/pointmass_rl),
with its reference, net, loss, batch and learning rate: a net of the state gives a tracker's weights, and there is a
solve each period. The others plan boats between two buoys, with a net in the dynamics, or in the stage cost.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from tqdm import tqdm

import torchgco
from torchgco import (
    ControlBounds,
    FunctionCost,
    FunctionDynamics,
    Goal,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    StateBounds,
)
from torchgco.dynamics.rollout import open_loop

D = torch.float64
HELD_OUT = 64  # problems that training doesn't see


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Numbers between -1 and 1."""
    return 2 * torch.rand(*shape, generator=generator, dtype=D) - 1


def net(
    sizes: list[int], generator: torch.Generator, spread_of: Callable[[int], float] = lambda into: into**-0.5
) -> nn.Sequential:
    """Linear layers and tanh. Weights begin normal, with deviations by their inputs, the last ones at 0."""
    layers: list[nn.Module] = []
    for into, out in pairwise(sizes):
        layer, spread = nn.Linear(into, out, dtype=D), 0.0 if out == sizes[-1] else spread_of(into)
        with torch.no_grad():
            layer.weight.copy_(spread * torch.randn(out, into, generator=generator, dtype=D))
            layer.bias.zero_()
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Task(ABC):
    """What a net learns.

    Attributes:
        net: which is trained.
        rate: of Adam.
    """

    net: nn.Sequential
    rate: float

    @abstractmethod
    def losses(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Of problems drawn for a step: losses (B,), and where they have gradients (B,)."""

    @abstractmethod
    def missed(self) -> Tensor:
        """Distances, root mean squares of the knots, m, of plans or flights that training doesn't see."""


class Zigzag(Task):
    """Weights of a tracker of 8 periods as a function of the state, 4 loops of 8 periods a step.

    `missed` is the distance to the reference in two cycles of 40 periods, m.
    """

    rate, horizon, loops = 3e-3, 8, 4

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.net = net([6, 8, 9 * (self.horizon + 1)], generator, lambda into: 0.5)
        corners = torch.tensor([[0.1 * (-1) ** i, 0.05 * i, 0.05 * i] for i in range(4)], dtype=D)
        back = torch.stack((corners[0] + torch.tensor([0.0, 0.1, 0.1], dtype=D), corners[1]))
        ring = torch.cat((corners, back))
        self.cycle = ring[[0, 1, 2, 3, 4, 5, 4, 3, 2, 1]].repeat_interleave(4, dim=0)
        self.usual = torch.tensor([1.0] * 6 + [1e-3] * 3, dtype=D)
        self.model = FunctionDynamics(lambda x, u: torch.cat((x[..., 3:], u), -1), 6, 3, 0.1, "euler", slice(0, 3))

    def target(self, i: Tensor) -> Tensor:
        """Positions (..., 3), m, at periods (...)."""
        return self.cycle[i % len(self.cycle)]

    def planned(self, x: Tensor, i: Tensor) -> Solution:
        """Plans from states x (B, 6) at periods i (B,)."""
        w = self.usual * self.net(x).view(len(x), self.horizon + 1, 9).exp()
        ahead = self.target(i.unsqueeze(-1) + torch.arange(self.horizon + 1))
        states, controls = torch.diag_embed(w[..., :6]), torch.diag_embed(w[:, :-1, 6:])
        x_ref = torch.cat((ahead, torch.zeros_like(ahead)), dim=-1)
        cost = QuadraticCost(states[:, :-1], controls, states[:, -1], x_ref)
        problem = Problem(self.model, cost, [StateBounds(-5, 5), ControlBounds(-5, 5)], x, self.horizon)
        return torchgco.solve(problem, solver="interior_point", verbose=False)

    def flown(self, x: Tensor, i: Tensor, periods: int) -> tuple[Tensor, Tensor, Tensor]:
        """Positions (B, periods, 3), controls, and whether all plans have gradients (B,)."""
        positions, controls, good = [], [], torch.ones(len(x), dtype=torch.bool)
        for k in range(periods):
            plan = self.planned(x, i + k)
            good = good & plan.differentiable if torch.is_grad_enabled() else good
            x = x + 0.1 * torch.cat((x[:, 3:], plan.U[:, 0]), dim=-1)
            positions.append(x[:, :3])
            controls.append(plan.U[:, 0])
        return torch.stack(positions, 1), torch.stack(controls, 1), good

    def losses(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        i = torch.randint(len(self.cycle), (self.loops,), generator=generator)
        p, v = self.target(i) + 0.03 * uniform(generator, self.loops, 3), 0.05 * uniform(generator, self.loops, 3)
        P, U, good = self.flown(torch.cat((p, v), dim=-1), i, 8)
        off = (P - self.target(i.unsqueeze(-1) + 1 + torch.arange(8))).square().sum(-1).mean(-1)
        return off + 1e-3 * U.square().sum(-1).mean(-1), good

    def missed(self) -> Tensor:
        periods = 2 * len(self.cycle)
        x = torch.cat((self.cycle[0], torch.zeros(3, dtype=D))).unsqueeze(0)
        P, _, _ = self.flown(x, torch.zeros(1, dtype=torch.int64), periods)
        return (P - self.target(1 + torch.arange(periods))).square().sum(-1).mean(-1).sqrt()


class Boats(Task):
    """Boats that cross between two buoys; states are positions, m, and velocities, controls accelerations.

    Batches of 8 take turns; each is planned from its last plan. The first begin as `last` says, or are those of `gco`.
    """

    rate, N, dt, boats, batches = 3e-3, 30, 0.12, 8, 4
    buoys, goal = torch.tensor([[1.6, 0.25], [2.5, -0.8]], dtype=D), (3.6, 0.0)
    model: FunctionDynamics
    cost: QuadraticCost | FunctionCost

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.starts = [self._drawn(self.boats, generator) for _ in range(self.batches)]
        self.held_out = self._drawn(HELD_OUT, generator)
        self.last: dict[int, Solution] = {}
        self.turn = 0

    def _drawn(self, count: int, generator: torch.Generator) -> Tensor:
        return uniform(generator, count, 4) * torch.tensor([0.3, 1.2, 0.3, 0.3], dtype=D)

    def crossing(self, cost: QuadraticCost | FunctionCost, x0: Tensor) -> Problem:
        rows = [Spheres(self.buoys, [0.5, 0.5], 0.15), ControlBounds(-4, 4)]
        return Problem(self.model, cost, rows, x0, self.N, Goal(list(self.goal), 0.5))

    @abstractmethod
    def off(self, plan: Solution, batch: int | None) -> Tensor:
        """Mean square distance (B,), m^2, of the plans of a batch, or of those held out."""

    def losses(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        batch = self.turn % self.batches
        warm = self.last.get(batch)
        solver = "gco" if warm is None else "interior_point"
        plan = torchgco.solve(self.crossing(self.cost, self.starts[batch]), warm=warm, solver=solver, verbose=False)
        self.turn, self.last[batch] = self.turn + 1, plan.detach()
        return self.off(plan, batch), plan.differentiable

    def missed(self) -> Tensor:
        plan = torchgco.solve(self.crossing(self.cost, self.held_out), verbose=False)
        return self.off(plan, None).sqrt()


class Residual(Boats):
    """A net in the dynamics, which learns a current and a drag: plans and their flights are to agree.

    `missed` is the distance between the plan and its flight at the same time, m.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        learned = self.net = net([6, 32, 32, 4], torch.Generator().manual_seed(seed))
        field = lambda x, u: torch.cat((x[..., 2:], u), -1) + learned(torch.cat((x, u), -1))
        self.model = FunctionDynamics(field, 4, 2, self.dt, "rk4", slice(0, 2))
        self.cost = QuadraticCost([1, 1, 0.5, 0.5], [0.15, 0.15], [20, 20, 2, 2], x_ref=[*self.goal, 0, 0])

    def water(self, x: Tensor, u: Tensor) -> Tensor:
        """The true rates: a current that turns around (1.8, -0.2), and a quadratic drag."""
        away, v = x[..., :2] - torch.tensor([1.8, -0.2], dtype=D), x[..., 2:]
        turned = torch.stack((-away[..., 1], away[..., 0]), dim=-1)
        push = 1.5 * turned * torch.exp(-away.square().sum(-1, keepdim=True))
        return torch.cat((v, u + push - 0.2 * v * (v.square().sum(-1, keepdim=True) + 1e-4).sqrt()), -1)

    def fly(self, x: Tensor, U: Tensor) -> Tensor:
        """The flight (B, N+1, 4) of the true boats."""
        return open_loop(FunctionDynamics(self.water, 4, 2, self.dt, "rk4"), x, U)

    def off(self, plan: Solution, batch: int | None) -> Tensor:
        return (plan.X - self.fly(plan.X[:, 0], plan.U))[..., :2].square().sum(-1).mean(-1)


class StageCost(Boats):
    """A net as a part of the stage cost, which learns from demonstrations what their teacher keeps away from.

    `missed` is the distance between plan and demonstration at the same time, m.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        learned = self.net = net([6, 32, 32, 1], torch.Generator().manual_seed(seed))
        self.model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, self.dt, "rk4", slice(0, 2))
        self.cost = self._cost(lambda x, u: learned(torch.cat((x, u), -1)).squeeze(-1))
        teacher = self._cost(self.taste)
        with torch.no_grad():
            shown = [torchgco.solve(self.crossing(teacher, x0), verbose=False) for x0 in (*self.starts, self.held_out)]
        *self.shown, self.unseen = [one.X for one in shown]
        self.last = dict(enumerate(shown[:-1]))  # on the way round of the demonstration

    def taste(self, x: Tensor, u: Tensor) -> Tensor:
        """What the teacher pays besides: for shallow water around (0.9, -0.6), and for speed."""
        away, v = x[..., :2] - torch.tensor([0.9, -0.6], dtype=D), x[..., 2:]
        return 4.0 * torch.exp(-2.0 * away.square().sum(-1)) + 0.5 * v.square().sum(-1)

    def _cost(self, more: Callable[[Tensor, Tensor], Tensor]) -> FunctionCost:
        end = torch.tensor([*self.goal, 0.0, 0.0], dtype=D)
        w, wf = torch.tensor([0.5, 0.5, 0.05, 0.05], dtype=D), torch.tensor([10.0, 10.0, 1.0, 1.0], dtype=D)
        return FunctionCost(
            lambda x, u: (w * (x - end).square()).sum(-1) + 0.075 * u.square().sum(-1) + more(x, u),
            lambda x: (wf * (x - end).square()).sum(-1),
        )

    def off(self, plan: Solution, batch: int | None) -> Tensor:
        shown = self.unseen if batch is None else self.shown[batch]
        return (plan.X - shown)[..., :2].square().sum(-1).mean(-1)


TASKS: dict[str, type[Task]] = {"zigzag": Zigzag, "residual": Residual, "cost": StageCost}


@dataclass(frozen=True)
class Trained:
    """A training.

    Attributes:
        before, after: what is missed, m (problems,).
        differentiable: share of all losses.
        seconds, first: of all steps, by processor, and of the first, which compiles, by clock.
    """

    before: Tensor
    after: Tensor
    differentiable: float
    seconds: float
    first: float


def stepped(task: Task, generator: torch.Generator, optimizer: torch.optim.Optimizer) -> float:
    """Take a step; returns the share of its losses that have gradients."""
    each, has = task.losses(generator)
    loss = torch.where(has, each, 0.0).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return float(has.double().mean())


def trained(kind: str, seed: int, steps: int) -> Trained:
    """Train the net of a task."""
    task = TASKS[kind](seed)  # type: ignore[call-arg]
    generator, adam = torch.Generator().manual_seed(seed), torch.optim.Adam(task.net.parameters(), task.rate)
    with torch.no_grad():
        before = task.missed()
    good, first, clock, began = 0.0, 0.0, time.perf_counter(), time.process_time()
    for _ in tqdm(range(steps), f"{kind}, seed {seed}", unit="step", leave=False):
        good += stepped(task, generator, adam)
        first = first or time.perf_counter() - clock
    seconds = time.process_time() - began
    with torch.no_grad():
        after = task.missed()
    return Trained(before, after, good / steps, seconds, first)
