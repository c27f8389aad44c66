"""`MissionVectorEnv` and `MissionEnv`: missions among obstacles, for Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from torch import Tensor

from torchgco import presets
from torchgco.base.errors import InputError
from torchgco.base.options import Above, AtLeast, AtMost, Count, Meters, check_value
from torchgco.base.shapes import computing_on
from torchgco.dynamics.quadrotor import ROTORS, Airframe
from torchgco.envs import episodes
from torchgco.envs.episodes import FLYING, Control, Episodes
from torchgco.missions.mission import CPU, Mission
from torchgco.missions.outcome import Outcome
from torchgco.missions.planner import Planner
from torchgco.problem.problem import Problem
from torchgco.scenarios.base import generator
from torchgco.scenarios.quadrotor import Forest
from torchgco.scenarios.vehicle import Vehicle

FORESTS = 1024  # layouts of the paper's mission that are flown where no problems are given
BONUS = 10.0
MAX_RATE = 5.0  # rad/s, of the paper's plans


def forests(count: int = FORESTS, seed: int = 0) -> Problem:
    """The paper's mission, from (1, 1, 0) to (20, 1, 0.2) m, in so many forests of a seed."""
    return Vehicle.quadrotor(Airframe()).among(Forest(start=(1, 1, 0)), range(count), seed).problem


class MissionVectorEnv(gymnasium.vector.VectorEnv):
    """Missions of B vehicles in lockstep; a step is a control period.

    A vehicle starts at rest. Its episode ends where its mission would: at the goal, in contact with an obstacle, or
    lost (terminated), or when the time is over (truncated). Which problem it flies, and its wind and noise, are drawn
    from (seed, id), never from its place in the batch: environment i is the same alone. Everything is computed on the
    CPU in double precision.

    Observations are float32, of `observation_names` with `observation_units`; see `episodes.names`. Actions are
    float32 with `action_names`, `action_units`, cut off to the space's bounds, and held for the period: with control
    "rates" body rates and thrust acceleration, which the mission's tracker makes rotor speeds of; with "rotors" the
    rotor speeds. The reward is the way towards the goal in m, plus 10 at the goal, minus
    10 in contact or lost.

    `info` has for each environment its `layout` (row of the problems), `distance` from the goal in m, and `outcome`: an
    `Outcome`, TIMEOUT where the time is over, or -1 while it flies.

    Args:
        num_envs: B.
        problem: L planning problems on the quadrotor's planning model, such as `Vehicle.among(...).problem`; None: 1024
            of the paper's forests.
        mission: tracker, plant, disturbance, duration and goal radius; its planner is that of `PlannerPolicy`. None:
            the default with `gco`.
        control: what actions are.
        nearest: how many obstacles are observed, up to `sight` m away.
        max_rate: bound of the body rates, rad/s.
        ids: of the environments, at least 0; None: 0 to B-1.
        autoreset_mode: as Gymnasium defines it; with "Disabled" an environment that has ended rests until it is reset,
            and repeats how it has ended.

    Raises:
        InputError: what can't be flown: see `Episodes`; a field out of its range.
    """

    def __init__(
        self,
        num_envs: int = 1,
        problem: Problem | None = None,
        mission: Mission | None = None,
        control: Control = "rates",
        nearest: int = 6,
        sight: float = 10.0,
        max_rate: float = MAX_RATE,
        ids: Sequence[int] | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.num_envs = check_value(num_envs, Count, "num_envs")
        check_value(control, Control, "control")
        self.nearest = check_value(nearest, Annotated[int, AtLeast(0), AtMost(1000)], "nearest")
        self.sight = check_value(sight, Meters, "sight")
        max_rate = check_value(max_rate, Annotated[float, Above(0, "rad/s")], "max_rate")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.ids = list(range(num_envs)) if ids is None else [int(number) for number in ids]
        if len(self.ids) != num_envs or min(self.ids) < 0:
            raise InputError("ids", f"{num_envs} numbers of at least 0", ids)
        with computing_on(CPU):
            problem = forests() if problem is None else problem
            mission = Mission(Planner(presets.gco(3))) if mission is None else mission
            self.episodes = Episodes(mission, problem, num_envs, control)
        self._spaces(control, max_rate)
        self.waiting = np.zeros(num_envs, bool)  # has ended, and begins again with the next step or reset
        self._ended = np.full(num_envs, FLYING)  # how it has
        self._streams: list[np.random.Generator] = []

    def _spaces(self, control: Control, max_rate: float) -> None:
        """The spaces, and the names and units of their components."""
        frame, n = self.episodes.airframe, len(episodes.names(self.nearest))
        self.observation_names, self.observation_units = (
            episodes.names(self.nearest),
            episodes.units(self.nearest),
        )
        if control == "rates":
            self.action_names, self.action_units = ("wx", "wy", "wz", "a"), (*["rad/s"] * 3, "m/s^2")
            low, high = ([*[sign * max_rate] * 3, a] for sign, a in zip((-1, 1), frame.accelerations, strict=True))
        else:
            self.action_names, self.action_units = ROTORS, ("rpm",) * 4
            low, high = ([speed] * 4 for speed in frame.rotor_speeds)
        self.single_observation_space = Box(-np.inf, np.inf, (n,), np.float32)
        self.single_action_space = Box(np.array(low, np.float32), np.array(high, np.float32))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._bounds = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: of all environments, or one for each; None: each goes on with its own draws, at first with some of the
                system.
            options: `reset_mask`, (B,) bool: the environments to begin again; `layout`, (B,) whole numbers: the rows of
                the problems that they fly then. None: all, and those that are drawn.

        Raises:
            InputError: seeds, masks or layouts of another number than there are environments, layouts that can't be
                flown.
        """
        seeds = list(seed) if isinstance(seed, Sequence) else [seed] * self.num_envs
        if len(seeds) != self.num_envs:
            raise InputError("seed", f"one number or {self.num_envs}", len(seeds))
        super().reset(seed=next((entry for entry in seeds if entry is not None), None))
        rows = np.arange(self.num_envs)
        if options is not None and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
                raise InputError("options.reset_mask", f"({self.num_envs},) bool, at least one True", mask)
            rows = mask.nonzero()[0]
        layouts = self._layouts_of(options)
        entropy = None if self._streams else np.random.SeedSequence().entropy
        streams = self._streams or [generator(entropy, number) for number in self.ids]
        for row in rows:
            if seeds[row] is not None:
                streams[row] = generator(seeds[row], self.ids[row])
        if not self._streams:
            rows = np.arange(self.num_envs)  # all have to be somewhere
        self._streams = streams
        with computing_on(CPU):
            self._begin(rows, layouts)
            return self._observed(), self._info(np.full(self.num_envs, FLYING), rows)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly a control period; see the class.

        Raises:
            InputError: before the first `reset`, actions of another shape or that aren't finite.
        """
        waiting = self.waiting.copy()
        with computing_on(CPU):
            action = self._checked(actions)
            before = self.episodes.distance()
            outcome = self.episodes.fly(action, torch.from_numpy(waiting)).numpy()
            after = self.episodes.distance()
            lost = np.isin(outcome, (Outcome.COLLISION, Outcome.DIVERGED))
            ended = (outcome == Outcome.REACHED).astype(float) - lost  # 1 at the goal, -1 in contact or lost
            reward = np.where(waiting, 0.0, (before - after).numpy() + BONUS * ended)
            over = (self.episodes.step >= self.episodes.steps).numpy() & (outcome == FLYING)
            outcome = np.where(over, int(Outcome.TIMEOUT), outcome)
            again, info = waiting, dict[str, Any]()
            if self.autoreset_mode is AutoresetMode.DISABLED:
                again, outcome = np.zeros_like(waiting), np.where(waiting, self._ended, outcome)
            elif self.autoreset_mode is AutoresetMode.NEXT_STEP:
                outcome = np.where(waiting, FLYING, outcome)
            terminated, truncated = (outcome != FLYING) & (outcome != Outcome.TIMEOUT), outcome == Outcome.TIMEOUT
            self.waiting, self._ended = outcome != FLYING, outcome
            if self.autoreset_mode is AutoresetMode.SAME_STEP and self.waiting.any():
                info, again = self._final(self.waiting, outcome), self.waiting.copy()
            if again.any():
                self._begin(again.nonzero()[0])
            return self._observed(), reward, terminated, truncated, self._info(np.where(again, FLYING, outcome)) | info

    def _checked(self, actions: Any) -> Tensor:
        """Actions (B, 4) within their bounds."""
        if not self._streams:
            raise InputError("step", "a reset before", "none")
        values = np.asarray(actions, np.float64)
        if values.shape != (self.num_envs, 4):
            raise InputError("actions", f"numbers of shape ({self.num_envs}, 4)", values.shape)
        if not np.isfinite(values).all():
            raise InputError("actions", "finite numbers", "NaN or infinity")
        return torch.from_numpy(values).clamp(*self._bounds)

    def _layouts_of(self, options: dict[str, Any] | None) -> np.ndarray | None:
        """The rows of the problems (B,) that are asked for."""
        if options is None or "layout" not in options:
            return None
        layouts = np.asarray(options["layout"])
        known = layouts.shape == (self.num_envs,) and layouts.dtype.kind in "iu"
        if not known or not np.isin(layouts, self.episodes.layouts.numpy()).all():
            raise InputError("options.layout", f"({self.num_envs},) rows of problems with a free start", layouts)
        return layouts.astype(np.int64)

    def _begin(self, rows: np.ndarray, layouts: np.ndarray | None = None) -> None:
        """Another episode for the environments `rows` (b,), of `layouts` (B,) or drawn ones."""
        draws = [self._streams[row].integers((len(self.episodes.layouts), 2**62)) for row in rows]
        chosen = self.episodes.layouts[torch.tensor([int(first) for first, _ in draws])]
        chosen = chosen if layouts is None else torch.from_numpy(layouts[rows])
        seeds, ids = [int(seed) for _, seed in draws], [self.ids[row] for row in rows]
        self.episodes.begin(torch.from_numpy(rows), chosen, seeds, ids)
        self.waiting[rows] = False

    def _observed(self) -> np.ndarray:
        flying = self.episodes
        seen = episodes.observed(
            flying.measured(), flying.goal, flying.contact.obstacles, flying.airframe, self.nearest, self.sight
        )
        return seen.to(torch.float32).numpy()

    def _info(self, outcome: np.ndarray, rows: np.ndarray | None = None) -> dict[str, Any]:
        """Outcome, layout and distance, and for which environments they are given: all, or `rows`."""
        mask = np.zeros(self.num_envs, bool)
        mask[slice(None) if rows is None else rows] = True
        values = {
            "outcome": outcome,
            "layout": self.episodes.layout.numpy(),
            "distance": self.episodes.distance().numpy(),
        }
        info = dict[str, Any]()
        for name, value in values.items():
            info[name], info[f"_{name}"] = np.where(mask, value, np.zeros_like(value)), mask.copy()
        return info

    def _final(self, done: np.ndarray, outcome: np.ndarray) -> dict[str, Any]:
        """Observations and infos of episodes that end in the step in which the next ones begin."""
        seen, rows = self._observed(), done.nonzero()[0]
        final = np.full(self.num_envs, None, object)
        for row in rows:
            final[row] = seen[row]
        infos = self._info(outcome, rows)
        return {"final_obs": final, "_final_obs": done.copy(), "final_info": infos, "_final_info": done.copy()}


class MissionEnv(gymnasium.Env):
    """One mission: `MissionVectorEnv` with a single environment, which the user resets.

    Args:
        env_id: its id in the vector environment that it is one of.
        options: as `MissionVectorEnv` takes them.

    Raises:
        InputError: as `MissionVectorEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self, env_id: int = 0, **options: Any) -> None:
        self.vector = MissionVectorEnv(1, ids=[env_id], autoreset_mode=AutoresetMode.DISABLED, **options)
        self.observation_space = self.vector.single_observation_space
        self.action_space = self.vector.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """See `MissionVectorEnv.reset`."""
        super().reset(seed=seed)
        if options is not None and "layout" in options:
            options = {"layout": np.asarray(options["layout"])[None]}
        seen, info = self.vector.reset(seed=seed, options=options)
        return seen[0], _only(info)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """See `MissionVectorEnv.step`."""
        seen, reward, terminated, truncated, info = self.vector.step(np.asarray(action)[None])
        return seen[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), _only(info)


def _only(info: dict[str, Any]) -> dict[str, Any]:
    """The values of a single environment."""
    return {name: values[0] for name, values in info.items() if not name.startswith("_")}
