"""Fleets of a batch of layouts are planned, and every fleet becomes a row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.api import solve
from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.experiments.config.build import Setup
from torchgco.experiments.flying.flight import Schedule, SolveBatch, plan_of
from torchgco.experiments.flying.mission_flight import SINGLE
from torchgco.fleets.drawn import solution_of
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.verdict import FleetVerdict
from torchgco.kernels import native
from torchgco.scenarios import Layouts, Vehicle

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
