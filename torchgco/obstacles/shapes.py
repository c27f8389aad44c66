"""How obstacles look, for pictures, pages and sensors: boxes, rounded outwards. A sphere is one without sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class RoundedBoxes:
    """M of them in one problem, without the vehicle's radius; lengths in metres.

    Args:
        center: (M, d) at t = 0.
        half: (M, d), half the sides' lengths before rounding.
        sides: (M, d, d), their directions, as rows.
        radius: (M,) by which they are rounded.
        velocity: (M, d), m/s; None: none moves evenly.
        sines: amplitudes, rates and phases (3, M, S, d) of sines along which centres move; None: none swings.
        track: (T, M, d), where centres are every `step` seconds, between which they move evenly; None: none has one.
    """

    center: np.ndarray
    half: np.ndarray
    sides: np.ndarray
    radius: np.ndarray
    velocity: np.ndarray | None = None
    sines: np.ndarray | None = None
    track: np.ndarray | None = None
    step: float = 0.0

    @classmethod
    def of(
        cls,
        solids: Any,
        vehicle_radius: Tensor,
        b: int,
        velocity: Any = None,
        sines: Any = None,
        track: Any = None,
        step: float = 0.0,
    ) -> Self:
        """Problem b's of `Solids`, those that are there; velocities (M, d), sines (3, M, S, d) and tracks (T, M, d) are
        those of all, and tracks have the centres."""
        here = ~solids.absent[b].cpu().numpy()
        center, radius = (array(values[b])[here] for values in (solids.centers, solids.radii))
        M, d = center.shape
        half, sides = np.zeros((M, d)), np.broadcast_to(np.eye(d), (M, d, d))
        if hasattr(solids, "half_sizes"):
            half, sides = array(solids.half_sizes[b])[here], array(solids.axes[b])[here]
        radius = (radius - float(vehicle_radius[b])).clip(min=0.0)
        velocity, sines = (None if velocity is None else velocity[here]), (None if sines is None else sines[:, here])
        if track is not None:
            track = track[:, here]
            center = track[0]
        return cls(center, half, sides, radius, velocity, sines, track, step)


def array(values: Tensor) -> np.ndarray:
    """A tensor as an array in double precision."""
    return values.detach().cpu().double().numpy()
