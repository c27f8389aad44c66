"""The mission's planner as a policy: what a learned one is compared with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import computing_on
from torchgco.base.tree import put
from torchgco.envs.missions import MissionVectorEnv
from torchgco.missions.mission import CPU
from torchgco.missions.pilot import SEED_STEP
from torchgco.missions.planner import MissionPlan, Planner
from torchgco.missions.tracker import RATES

AHEAD = 2  # the knot of a plan that is asked for


class PlannerPolicy:
    """Plans from the measured state in every period, and asks for what the plan has two periods later.

    At a plan's second knot the body rates are those that the rotors lead to in any case, see `FirstStepRates`.

        policy = PlannerPolicy(env)
        action = policy(observation)

    It knows the whole state and all obstacles: it reads nothing of the observation. Its draws depend on how often it
    has been called.

    Args:
        env: whose missions it plans, with control "rates"; wrapped ones, too.
        planner: None: that of the environment's mission.

    Raises:
        InputError: another environment, or one whose actions are rotor speeds.
    """

    def __init__(self, env: Any, planner: Planner | None = None, seed: int = 0) -> None:
        env = env.unwrapped
        if not isinstance(env, MissionVectorEnv) or env.episodes.control != "rates":
            got = type(env).__name__ if not isinstance(env, MissionVectorEnv) else 'control "rotors"'
            raise InputError("env", 'a MissionVectorEnv with control "rates"', got)
        self.env, self.seed = env, seed
        self.planner = env.episodes.mission.planner if planner is None else planner
        self._plan: MissionPlan | None = None
        self._step, self._number = 0, torch.zeros_like(env.episodes.number)

    def __call__(self, observation: Any = None) -> np.ndarray:
        """Actions (B, 4), float32; of environments that wait for a reset as for one that rests.

        Raises:
            InputError: before the first reset.
        """
        flying = self.env.episodes
        if bool((flying.number == 0).any()):
            raise InputError("env", "a reset before a policy is asked", "none")
        with computing_on(CPU):
            x, waiting = flying.measured(), torch.from_numpy(self.env.waiting)
            begun = (flying.number != self._number) & ~waiting
            action = torch.zeros(len(x), 4, dtype=x.dtype)
            action[:, 3] = flying.airframe.gravity
            for rows, anew in ((begun, True), (~begun & ~waiting, False)):
                indices = rows.nonzero().flatten()
                if len(indices) > 0:
                    X = self._planned(x, indices, anew).X
                    action[indices] = X[:, min(AHEAD, X.shape[1] - 1), RATES.start :]
            self._number, self._step = torch.where(waiting, self._number, flying.number), self._step + 1
            return action.clamp(*self.env._bounds).to(torch.float32).numpy()

    def _planned(self, x: Tensor, rows: Tensor, anew: bool) -> MissionPlan:
        """The plans of the environments `rows` (b,), which are kept for the next call."""
        flying, planner = self.env.episodes, self.planner
        whole, x = flying.problem.take(flying.layout[rows]), x[rows]
        before = None if anew or self._plan is None else self._plan.take(rows)
        ids, seed = torch.tensor(self.env.ids)[rows], self.seed + SEED_STEP * self._step
        posed = planner.problem(whole, x)
        plan, _, _ = planner.plan(whole, posed, x, self._step, before, seed, ids)
        plan = replace(plan, dynamics=whole.dynamics)
        if self._plan is None:
            self._plan = plan.take(torch.zeros(len(flying.x), dtype=torch.int64))  # room for the plans of all
        for name in (*plan.trajectory, *plan.beside):
            put(getattr(self._plan, name), rows, getattr(plan, name))
        self._plan = replace(self._plan, dynamics=flying.problem.dynamics.take(flying.layout))
        return plan
