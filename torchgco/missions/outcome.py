"""How a flight ended, judged from the log of the plant alone.

A flight ends with the first of three events: the vehicle touches an obstacle (COLLISION), its state is no longer finite
or leaves all reason (DIVERGED), or it comes within the goal's radius (REACHED), in a race once all gates are passed.
Without any it ends with TIMEOUT.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import torch

from torchgco.base.errors import InputError
from torchgco.base.options import Meters, Seconds, check_value
from torchgco.missions.contact import Contact
from torchgco.missions.passing import Passing

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
    gates_passed: int | None = None  # in their order, between samples too; None without gates
    gate_distance: float | None = None  # m, largest of the least distances from the middles of these and the next one


def judge_flight(
    x: Any, dt: float, contact: Contact, goal: Any, goal_radius: float, gates: Passing | None = None
) -> Ending:
    """Judge one flight.

    Args:
        x: samples (T, 17) of the plant's state, one every dt, s, or where no vehicle has a `Body` of its positions
            (T, 3), m; after the flight's end NaN.
        contact, gates: of a single problem.
        goal, goal_radius: (3,) and a number above 0, m.

    Raises:
        InputError: arrays of other shapes, without a sample, or of anything but numbers; a radius or a time step that
            isn't above 0.
    """
    x, goal = _numbers(x, "x", (None, None)), _numbers(goal, "goal", (3,))
    if x.shape[1] not in (3, 17):
        raise InputError("x", "positions (T, 3) or states (T, 17)", x.shape)
    position = x[:, :3]
    check_value(goal_radius, Meters, "goal_radius")
    check_value(dt, Seconds, "dt")
    if len(position) == 0:
        raise InputError("x", "at least one sample", "none")
    with np.errstate(invalid="ignore"):
        lost = ~(np.linalg.norm(position - position[0], axis=-1) <= FARTHEST)
    there = np.linalg.norm(position - goal, axis=-1) < goal_radius
    if gates is not None:
        when, _ = gates.along(torch.from_numpy(position[~lost].astype(float)))
        there &= np.arange(len(there)) >= int(when.max())
    last = int(np.argmax(lost | there)) if (lost | there).any() else len(position) - 1
    way = torch.from_numpy(x[None, : last + (not lost[last])].astype(float))

    def clearance(samples: int) -> float:
        return float(contact.along(way[:, :samples], dt)) if samples else np.inf

    outcome = Outcome.DIVERGED if lost[last] else Outcome.REACHED if there[last] else Outcome.TIMEOUT
    samples = way.shape[1]
    if clearance(samples) < 0:  # the first sample by which there was contact
        samples = 1 + bisect_left(range(1, samples), True, key=lambda count: clearance(count) < 0)
        outcome, last = Outcome.COLLISION, samples - 1
    distance = float("nan") if outcome is Outcome.DIVERGED else float(np.linalg.norm(position[last] - goal))
    ending = Ending(outcome, last * dt, clearance(samples), distance)
    if gates is None:
        return ending
    when, away = gates.along(way[0, :samples, :3])
    return replace(ending, gates_passed=int((when < samples).sum()), gate_distance=float(away[away.isfinite()].max()))


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
