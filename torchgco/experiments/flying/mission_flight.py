"""A solver flies a batch of layouts as the planner of closed-loop missions, and every mission becomes a row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.experiments.flying.flight import Batch
from torchgco.exploration.safety import safe_arrays
from torchgco.missions.contact import Contact
from torchgco.missions.outcome import Outcome
from torchgco.missions.passing import Passing
from torchgco.missions.planning_problem import airframe_of
from torchgco.missions.tables import clearances, ending, mission_row, packed

PLANS_KEPT = 4  # missions in a study, up to which plans are kept and each mission gets figures
FAILED = (Outcome.COLLISION, Outcome.DIVERGED)
# Columns of a study that a mission leaves empty: they belong to a single trajectory.
SINGLE = (
    "cost", "dynamics_residual", "clearance_full", "bound_violation", "kkt_residual", "step_error", "step_cost"
)  # fmt: skip


@dataclass
class MissionBatch(Batch):
    """Missions in lockstep, planned by one solver."""

    plans: bool = False  # keep the planned positions, for figures

    def fly(self) -> tuple[pd.DataFrame, np.ndarray]:
        """Rows (without success), and logs (L, K, W) as `flights.packed` has them, NaN after a mission's end."""
        setup, layouts = self.setup, self.layouts
        assert setup.mission is not None
        mission = replace(setup.mission, planner=replace(setup.mission.planner, solver=self.solver))
        problem = self.tasks.of(self.places, exact=True).problem
        ids = torch.as_tensor(layouts.ids)
        progress = partial(self._progress, float(problem.dynamics.dt), mission.duration)
        log = mission.fly(problem, seed=setup.seed, ids=ids, report=progress)
        self.show(layouts.count)
        arrays, contact, gates = log.arrays(self.plans), Contact.among(problem), Passing.among(problem)
        arrays |= safe_arrays(log, problem)
        nearest = np.fmin.reduce(clearances(arrays, log.period, contact), axis=1, initial=np.inf)
        goal, radius = problem.goal.position.numpy(), problem.goal.radius.numpy()  # type: ignore[union-attr]
        rows = []
        for b in range(layouts.count):
            near = float(radius[b]) if mission.goal_radius is None else mission.goal_radius
            end = ending(arrays, b, log.period, contact, goal[b], near, gates)
            flown = mission_row(arrays, b, log.period, end, airframe_of(problem.dynamics))
            rows.append({**self._row(b, end.outcome), "clearance_knots": float(nearest[b]), **flown})
        return pd.DataFrame(rows), packed(arrays)

    def _row(self, b: int, outcome: Outcome) -> dict[str, Any]:
        return {
            **self.shared, "layout": int(self.layouts.ids[b]), "status": outcome.name,
            "feasible": outcome not in FAILED, "reached": outcome == Outcome.REACHED, "clear_95": outcome not in FAILED,
            **dict.fromkeys(SINGLE, np.nan),
            "batch_size": self.layouts.count, "kernels": "",
        }  # fmt: skip

    def _progress(self, period: float, duration: float, step: int, flying: int) -> None:
        """Show the time in the missions; one that flies counts with the share of its duration."""
        t = min((step + 1) * period, duration)
        done = self.layouts.count - flying * (1 - t / duration)
        count = f", {flying} flying" if self.layouts.count > 1 else ""
        self.bar.set_postfix_str(f"t = {t:.1f} of {duration:g} s{count}", refresh=False)
        self.show(done)
