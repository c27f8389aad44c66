"""A small policy that imitates the planner in forests: `python docs/imitation.py`, one to two minutes on one core.

The planner flies 24 missions, and a network learns its actions from what it sees; then the network flies, while the
planner says what it would have done there, and the network learns from both (DAgger, Ross et al. 2011). In the end both
fly the same forests, which neither has seen.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchgco.envs import MissionVectorEnv, PlannerPolicy
from torchgco.envs.missions import forests
from torchgco.missions import Outcome

TRAINED, UNSEEN = 0, 1  # seeds of the forests


class Policy(nn.Module):
    """Actions of the mean and the spread of the planner's, for observations of the mean and the spread seen so far."""

    def __init__(self, seen: Tensor, action: Tensor, width: int = 128) -> None:
        super().__init__()
        sizes = [seen.shape[1], width, width, action.shape[1]]
        layers = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.Tanh())]
        self.net = nn.Sequential(*layers[:-1])
        for name, values in (("seen", seen), ("action", action)):
            self.register_buffer(f"{name}_mean", values.mean(0))
            self.register_buffer(f"{name}_spread", values.std(0).clamp(min=1e-3))

    def forward(self, seen: Tensor) -> Tensor:
        scaled = ((seen - self.seen_mean) / self.seen_spread).clamp(-5, 5)
        return self.net(scaled) * self.action_spread + self.action_mean

    def __call__(self, seen: Any) -> Any:
        if isinstance(seen, Tensor):
            return super().__call__(seen)
        with torch.no_grad():
            return super().__call__(torch.from_numpy(seen)).numpy()


def fly(env: MissionVectorEnv, pilot: Any, teacher: Any, steps: int, seed: int) -> tuple[Tensor, Tensor]:
    """What the pilot has seen in so many steps, and what the teacher would have done there."""
    seen, kept = env.reset(seed=seed)[0], []
    for _ in range(steps):
        taught = teacher(seen)
        flying = ~env.waiting
        kept.append((seen[flying], taught[flying]))
        seen, *_ = env.step(taught if pilot is teacher else pilot(seen))
    return tuple(torch.from_numpy(np.concatenate(part)) for part in zip(*kept, strict=True))  # type: ignore[return-value]


def learn(seen: Tensor, action: Tensor, epochs: int) -> Policy:
    """A policy with small squared errors."""
    policy = Policy(seen, action)
    optimiser = torch.optim.Adam(policy.parameters(), 2e-3)
    batches = math.ceil(len(seen) / 512)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, epochs * batches)
    for _ in range(epochs):
        for rows in torch.randperm(len(seen)).split(512):
            error = (policy(seen[rows]) - action[rows]) / policy.action_spread
            optimiser.zero_grad()
            error.square().mean().backward()
            optimiser.step()
            schedule.step()
    return policy


def rate(pilot: Any, env: MissionVectorEnv, layouts: int) -> tuple[int, float]:
    """How many of so many missions reach their goal, one in each environment, and milliseconds of an action."""
    seen, _ = env.reset(seed=0, options={"layout": np.arange(layouts)})
    spent, outcome = list[float](), np.full(layouts, -1)
    while (flying := (outcome == -1).sum()) > 0:
        began = time.process_time()
        action = pilot(seen)
        spent.append((time.process_time() - began) / flying)
        seen, _, _, _, info = env.step(action)
        outcome = info["outcome"]
    return int((outcome == Outcome.REACHED).sum()), 1e3 * float(np.median(spent))


def main() -> None:
    """Train, fly, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", type=int, default=24)
    parser.add_argument("--steps", type=int, default=80, help="control periods of a round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--epochs", type=int, default=200)
    parser.add_argument("--layouts", type=int, default=32, help="forests in which the two are compared")
    options = parser.parse_args()
    torch.manual_seed(0)
    env = MissionVectorEnv(options.envs, forests(512, TRAINED))
    unseen = MissionVectorEnv(options.layouts, forests(options.layouts, UNSEEN), autoreset_mode="Disabled")
    # What the network leads to may have no feasible plan; the teacher says its best, and doesn't search for long.
    teacher = PlannerPolicy(env, replace(env.episodes.mission.planner, tolerance=math.inf))
    seen, action = fly(env, teacher, teacher, options.steps, seed=0)
    policy = learn(seen, action, options.epochs)
    for k in range(1, options.rounds):
        more = fly(env, policy, teacher, options.steps, seed=k)
        seen, action = torch.cat((seen, more[0])), torch.cat((action, more[1]))
        policy = learn(seen, action, options.epochs)
        print(f"round {k}: {len(seen)} actions of the planner")
    print(f"trained in {time.process_time():.0f} s of processor time")
    for name, pilot in (("planner", PlannerPolicy(unseen)), ("policy", policy)):
        reached, milliseconds = rate(pilot, unseen, options.layouts)
        print(f"{name}: {reached} of {options.layouts} reached, {milliseconds:.3f} ms of processor time an action")


if __name__ == "__main__":
    main()
