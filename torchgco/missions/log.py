"""The log of missions: plans by control step, the plant's states and the tracker's commands by time step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.missions.planner import MissionPlan
from torchgco.missions.tracker import Tracking

TIMED_PARTS = ("map_seconds", "field_seconds", "search_seconds")


@dataclass
class SeenLog:
    """What a vehicle knew of its grid, period by period.

    Args:
        corner: (3,), m, where cell (0, 0, 0) begins.
        shape: number of cells (3,).
        resolution: side of a cell, m.
        changes: for each period the flat indices of the cells whose state changed in it, int32, and their new states,
            uint8; cells are unknown at first.
        safe: for each period the positions (N+1, 3), m, of the plan that comes to rest.
    """

    corner: np.ndarray
    shape: tuple[int, int, int]
    resolution: float
    changes: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    safe: list[np.ndarray] = field(default_factory=list)

    def state(self, step: int) -> np.ndarray:
        """The states (X, Y, Z) of all cells in a period."""
        state = np.zeros(self.shape, np.uint8)
        for cells, new in self.changes[: step + 1]:
            state.reshape(-1)[cells] = new
        return state


@dataclass(frozen=True)
class MissionLog:
    """What happened to B missions of at most K control steps with J time steps each; NaN after a mission's end."""

    period: float  # s
    x: Tensor  # (B, K, J+1, 17): states of the plant; the first of a period is the last of the one before
    commands: Tensor  # (B, K, J, 4): rotor speeds, rpm; within the period of a mission's end, NaN after it
    tracking_violation: Tensor  # (B, K): largest of the tracking problems, N
    plan: Tensor  # (B, K, N+1, 3): planned positions, m
    cost: Tensor  # (B, K): of the plan
    violation: Tensor  # (B, K): of the plan
    shifted: Tensor  # (B, K): 1 where the previous plan was kept, else 0
    guided: Tensor  # (B, K): outer iterations with guidance on
    iterations: Tensor  # (B, K): of the planner's solve
    planner_seconds: Tensor  # (B, K): of the batch's solve, divided by its missions
    tracker_seconds: Tensor  # (B, K): of the J solves, divided likewise
    map_seconds: Tensor  # (B, K): of missions with a sensor, parts of planner_seconds: cells of the map,
    field_seconds: Tensor  # (B, K): distances on the map, and corridors,
    search_seconds: Tensor  # (B, K): paths on it; NaN without a sensor
    seen: list[SeenLog] = field(default_factory=list)  # of each mission with a sensor

    @classmethod
    def blank(cls, x: Tensor, steps: int, substeps: int, period: float, knots: int) -> MissionLog:
        """To be filled, for plants that begin at x (B, 17)."""
        B = x.shape[0]

        def empty(*shape: int) -> Tensor:
            return x.new_full((B, steps, *shape), torch.nan)

        scalars: list[Any] = [empty() for _ in range(10)]
        log = cls(period, empty(substeps + 1, 17), empty(substeps, 4), empty(), empty(knots, 3), *scalars)
        log.x[:, 0, 0] = x  # of missions, too, that end at their start
        return log

    def add_plan(self, rows: Tensor, step: int, x: Tensor, plan: MissionPlan, seconds: float) -> None:
        """The start of a control period: states x (b, 17) of the missions `rows`, and their plans."""
        self.x[rows, step, 0] = x
        every = round(self.period / plan.dt)  # of the knots are logged
        knots = (every * torch.arange(self.plan.shape[2])).clamp(max=plan.X.shape[1] - 1)  # or of another pilot's plan
        self.plan[rows, step] = plan.X[:, knots, :3]
        for name in ("cost", "violation", "shifted", "guided", "iterations"):
            getattr(self, name)[rows, step] = getattr(plan, name).to(x.dtype)
        self.planner_seconds[rows, step] = seconds
        self.tracker_seconds[rows, step] = 0.0
        self.tracking_violation[rows, step] = 0.0

    def add_parts(self, rows: Tensor, step: int, parts: Mapping[str, Tensor]) -> None:
        """Seconds of a control period by part, (b,) each."""
        for name, seconds in parts.items():
            getattr(self, name)[rows, step] = seconds

    def add_sample(
        self, rows: Tensor, step: int, j: int, x: Tensor, tracking: Tracking, seconds: float, flew: Tensor
    ) -> None:
        """A time step: the states after it, and the commands that led there where a vehicle still flew, (b,) bool."""
        self.x[rows, step, j + 1] = x
        self.commands[rows, step, j] = torch.where(flew.unsqueeze(-1), tracking.commands, torch.nan)
        self.tracker_seconds[rows, step] += seconds
        worst = torch.maximum(self.tracking_violation[rows, step], tracking.violation)
        self.tracking_violation[rows, step] = worst

    def samples(self) -> tuple[Tensor, Tensor]:
        """Times (K J + 1,), s, and states (B, K J + 1, 17) of the plant at all time steps."""
        B, K, J = self.commands.shape[:3]
        x = torch.cat((self.x[:, :1, 0], self.x[:, :, 1:].reshape(B, K * J, 17)), dim=1)
        t = torch.arange(K * J + 1, dtype=x.dtype) * (self.period / J)
        return t, x

    def steps(self) -> np.ndarray:
        """Control steps that each mission made, (B,)."""
        return (~torch.isnan(self.planner_seconds)).sum(1).numpy()

    def arrays(self, plans: bool = False) -> dict[str, np.ndarray]:
        """What a study keeps of every mission, by name (B, ...); with the planned positions where asked for."""
        names = ("x", "commands", "tracking_violation", "cost", "violation", "shifted", "guided", "iterations")
        names = (*names, "planner_seconds", "tracker_seconds", *(TIMED_PARTS if self.seen else ()))
        names = (*names, *(["plan"] if plans else []))
        return {name: getattr(self, name).numpy() for name in names}
