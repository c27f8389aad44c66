"""Fleets of layouts, and what stored controls make of them."""

from __future__ import annotations

import numpy as np
import torch

from torchgco.fleets.fleet import Fleet
from torchgco.fleets.solution import FleetSolution
from torchgco.scenarios import Layouts, Vehicle


def fleet_of(vehicle: Vehicle, layouts: Layouts) -> Fleet:
    """The fleets of L layouts with as many stages, B = L.

    Raises:
        InputError: as `Vehicle.task` and `Fleet`; layouts of single vehicles.
    """
    return Fleet([vehicle.task(layouts.of_vehicle(v)).problem for v in range(layouts.vehicles or 0)], layouts.apart)


def solution_of(vehicle: Vehicle, layouts: Layouts, U: np.ndarray) -> FleetSolution:
    """What stored controls (L, N, V m), one vehicle behind the other, lead to."""
    fleet = fleet_of(vehicle, layouts)
    parts = torch.from_numpy(U[:, : fleet.N]).split(vehicle.dynamics.m, dim=-1)
    return FleetSolution.of(fleet, [part.contiguous() for part in parts])
