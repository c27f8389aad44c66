"""How a flight ended, judged from the log of the plant alone: no code is shared with the simulation.

A flight ends with the first of three events: the vehicle touches an obstacle (COLLISION), its state is no longer finite
or leaves all reason (DIVERGED), or it comes within the goal's radius (REACHED). Without any it ends with TIMEOUT.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.options import Meters, check_value

FARTHEST = 1e3  # m from the start: a vehicle beyond has diverged


class Outcome(IntEnum):
    """The four ends of a mission; `sentence` explains each."""

    REACHED = 0
    COLLISION = 1
    TIMEOUT = 2
    DIVERGED = 3

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Outcome.REACHED: "The vehicle came within the goal's radius, without contact before.",
    Outcome.COLLISION: "The vehicle touched an obstacle.",
    Outcome.TIMEOUT: "The time was over before the vehicle came within the goal's radius.",
    Outcome.DIVERGED: "The state became non-finite, or the vehicle left for more than a kilometre.",
}


@dataclass(frozen=True)
class Ending:
    """How one flight ended."""

    outcome: Outcome
    flight_time: float  # s, until the event, or of the whole log
    clearance: float  # m, smallest distance to where bodies touch, between samples too; infinite without obstacles
    goal_distance: float  # m, at the end


def judge_flight(
    t: np.ndarray,
    position: np.ndarray,
    centers: np.ndarray,
    contact: np.ndarray,
    velocities: np.ndarray | None,
    goal: np.ndarray,
    goal_radius: float,
) -> Ending:
    """Judge one flight among spheres.

    Args:
        t, position: samples (T,), s, and (T, 3), m, of the plant; after the flight's end NaN.
        centers, contact, velocities: spheres at t = 0, (M, 3), m, with the distances (M,) at which bodies touch, m, and
            (M, 3), m/s, or None where they are at rest; NaN rows are absent.
        goal, goal_radius: (3,) and a number above 0, m.

    Raises:
        InputError: arrays of other shapes, without a sample, or of anything but numbers; a radius that isn't above 0.
    """
    t = _numbers(t, "t", (None,))
    position, goal = _numbers(position, "position", (len(t), 3)), _numbers(goal, "goal", (3,))
    contact = _numbers(contact, "contact", (None,))
    centers = _numbers(centers, "centers", (len(contact), 3))
    velocities = None if velocities is None else _numbers(velocities, "velocities", (len(contact), 3))
    check_value(goal_radius, Meters, "goal_radius")
    if len(t) == 0:
        raise InputError("t", "at least one sample", "none")
    here = ~np.isnan(contact)
    centers, contact = centers[here], contact[here]
    moves = np.zeros_like(centers) if velocities is None else velocities[here]
    clearance, before = np.inf, None
    for k in range(len(t)):
        p = position[k]
        if not np.isfinite(p).all() or np.linalg.norm(p - position[0]) > FARTHEST:
            return Ending(Outcome.DIVERGED, float(t[k]), float(clearance), float("nan"))
        away = p - (centers + t[k] * moves)
        if len(away):
            nearest = _distance(away if before is None else before, away) - contact
            clearance = min(clearance, float(nearest.min()))
        before = away
        distance = float(np.linalg.norm(p - goal))
        if clearance < 0:
            return Ending(Outcome.COLLISION, float(t[k]), clearance, distance)
        if distance < goal_radius:
            return Ending(Outcome.REACHED, float(t[k]), clearance, distance)
    return Ending(Outcome.TIMEOUT, float(t[-1]), clearance, distance)


def _numbers(value: Any, field: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """`value` as an array of numbers of this shape; None stands for any length."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        array = np.empty((), object)
    fits = len(shape) == array.ndim and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "iuf":
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise InputError(field, f"numbers of shape ({wanted})", f"{array.dtype} of shape {array.shape}")
    return array


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distances (M,) of the origin from the segments between a and b (M, 3)."""
    along = b - a
    length = (along**2).sum(-1)
    share = np.clip(-(a * along).sum(-1) / np.maximum(length, np.finfo(float).tiny), 0.0, 1.0)
    return np.linalg.norm(a + share[:, None] * along, axis=-1)
