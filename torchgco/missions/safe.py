"""Which control periods of missions with a sensor held a safe plan, by the judge of their logs."""

from __future__ import annotations

import numpy as np

from torchgco.missions.log import MissionLog
from torchgco.missions.unknown.safety import safe_periods
from torchgco.obstacles.base import CONTACT_FACTOR
from torchgco.problem.problem import Problem


def safe_arrays(log: MissionLog, problem: Problem) -> dict[str, np.ndarray]:
    """`safe` (B, K) of missions: 1 where safe, 0 where not, NaN after their ends; no array without a sensor."""
    if not log.seen:
        return {}
    safe = np.full(tuple(log.cost.shape), np.nan)
    for b, seen in enumerate(log.seen):
        radius = max((float(part.vehicle_radius[b]) for part in problem.obstacles), default=0.0)
        found = safe_periods(seen, CONTACT_FACTOR * radius, log.period)
        safe[b, : len(found)] = found
    return {"safe": safe}
