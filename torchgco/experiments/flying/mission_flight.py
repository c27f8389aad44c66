"""Missions and fleets of a batch of layouts, flown by one solver: each becomes a row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.api import solve
from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.experiments.config.build import Setup
from torchgco.experiments.flying.flight import Batch, Schedule, SolveBatch, plan_of
from torchgco.exploration.safety import safe_arrays
from torchgco.fleets.drawn import solution_of
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.verdict import FleetVerdict
from torchgco.kernels import native
from torchgco.missions.contact import Contact, Passing
from torchgco.missions.outcome import Outcome, clearances, ending, mission_row, packed
from torchgco.missions.planning_problem import airframe_of
from torchgco.scenarios import Layouts, Vehicle

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
        """Rows (without success), and logs (L, K, W) as `outcome.packed` has them, NaN after a mission's end."""
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


AT_ONCE = 8  # fleets that plan side by side, at most: their linear responses fill memory
VEHICLES = "vehicles.parquet"  # a row per solver, fleet and vehicle
JUDGED_AT_ONCE = 64  # fleets
EMPTY = (*(name for name in SINGLE if name != "cost"), "clearance_knots")  # columns that belong to a single vehicle


def fleet_columns(verdict: FleetVerdict) -> dict[str, Any]:
    """The verdict on fleets as arrays, by the names of a study's columns."""
    names = ("feasible", "reached", "cost", "violation", "clearance", "least_distance", "makespan")
    away = torch.stack([one.goal_distance for one in verdict.vehicles]).amax(0)
    more = {"clear_95": verdict.feasible.numpy(), "goal_distance": away.numpy(), **dict.fromkeys(EMPTY, np.nan)}
    return {name: getattr(verdict, name).numpy() for name in names} | more


def vehicles_table(vehicle: Vehicle, layouts: Layouts, controls: Mapping[str, np.ndarray]) -> pd.DataFrame:
    """A row for each vehicle of each fleet, of controls (L, N, V m) by the names of solvers."""
    names, rows = ("feasible", "reached", "cost", "violation", "clearance", "goal_distance"), list[dict[str, object]]()
    for solver, U in controls.items():
        for places in layouts.together(JUDGED_AT_ONCE):
            some = layouts.take(places)
            verdict = solution_of(vehicle, some, U[places]).verdict
            for b, number in enumerate(some.ids.tolist()):
                for v, one in enumerate(verdict.vehicles):
                    own, apart = {name: getattr(one, name)[b].item() for name in names}, bool(verdict.apart[b, v])
                    rows.append({"solver": solver, "layout": number, "vehicle": v, "apart": apart, **own})
    return pd.DataFrame(rows)


def check_fleets(setup: Setup, layouts: Layouts, plan: Schedule) -> None:
    """Raise where fleets can't be flown as a study asks for it."""
    if setup.mission is not None:
        raise InputError("mission", "null for fleets", "a mission")
    if (setup.device.type, setup.dtype) != ("cpu", torch.float64):
        raise InputError("device", "device=cpu in float64 for fleets", f"{setup.device.type}, {setup.dtype}")
    for name, word in (("explain", "false"), ("figure", "null")):
        if getattr(plan, name):
            raise InputError(f"study.{name}", f"{word} for fleets", getattr(plan, name))
    setup.fleet(layouts.take([0]))


@dataclass
class FleetBatch(SolveBatch):
    """Fleets, each vehicle of which a solver plans as if it were alone, before all are brought apart."""

    def compile(self) -> None:
        """See `Batch`: of two vehicles, which need what all need."""
        fleet = self.setup.fleet(self.layouts.take([0]))
        solve(Fleet(fleet.members[:2], float(fleet.distances.max())), solver=self.solver)

    def _lengthened(self, U: np.ndarray, stages: int) -> np.ndarray:
        rest = np.resize(np.array(self.setup.vehicle.control_reference, np.float64), U.shape[-1])
        return np.concatenate((U, np.broadcast_to(rest, (len(U), stages - U.shape[1], len(rest)))), axis=1)

    def _fly(self, places: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
        self.compile()
        asked = plan_of(self.setup).batch_size
        size = AT_ONCE if asked == "auto" else asked
        parts = [self._planned(places[first : first + size]) for first in range(0, len(places), size)]
        return pd.concat([rows for rows, _ in parts], ignore_index=True), np.concatenate([U for _, U in parts])

    def _planned(self, places: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
        layouts = self.tasks.layouts.take(places)
        fleet, began = self.setup.fleet(layouts), clock.seconds()
        found = solve(fleet, solver=self.solver, seed=self.setup.seed, ids=torch.as_tensor(layouts.ids))
        statuses = [Status(number).name for number in found.status.tolist()]
        rows = pd.DataFrame(
            {
                **self.shared, "layout": layouts.ids, "status": statuses,
                **fleet_columns(found.verdict), "vehicles": fleet.V,
                "iterations": torch.stack([one.iterations for one in found]).sum(0).numpy(), "outer_iterations": 0,
                "guided": 0, "seconds": (clock.seconds() - began) / fleet.B, "batch_size": fleet.B,
                "kernels": "native" if native() else "pytorch",
            }
        )  # fmt: skip
        self.show(self.shown + len(places))
        return rows, torch.cat([one.U for one in found], dim=-1).numpy()
