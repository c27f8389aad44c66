"""What the racing drone of `drone_racing` is and flies through: its model, its commands, its mass, and the track.

The simulator turns the drone by a cascade of controllers and rotors. Here this is a motion of second order of the axis
of thrust: numbers fitted to random flights of crazyflow 0.1.0's first-principles cf21B_500. Sizes of gates and poles
are those of github.com/learnsyslab/lsy_drone_racing, commit eb891d0 (MIT licence), envs/assets.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

GRAVITY, MASS = 9.81, 0.04338  # m/s^2; kg, nominal
STIFF, DAMPED, HARDEST = 325.0, 46.5, 70.0  # of the thrust's axis, 1/s^2 per rad, 1/s and 1/s^2
RISE = 10.2  # of the thrust, 1/s
DRAG = 0.5  # 1/s
STATES, CONTROLS = 11, 3
POSITION, VELOCITY, TILT, TURN, LIFT = slice(0, 3), slice(3, 6), slice(6, 8), slice(8, 10), 10

OPENING, OUTER, THICK = 0.2, 0.36, 0.01  # m, halves: of a gate's opening, of its frame, and of that along the normal
STAND = np.array([0.05, 0.05, 0.5])  # m, half sides of what a gate stands on
POLE, TALL = 0.015, 1.6  # m: radius and length of a pole below its top


def axis(tilt: Tensor) -> Tensor:
    """The direction of thrust (..., 3) of tilts (..., 2), rad: pitch, then roll, of a drone that heads along x."""
    a, b = tilt.unbind(-1)
    return torch.stack((b.cos() * a.sin(), -b.sin(), b.cos() * a.cos()), dim=-1)


def rates(x: Tensor, u: Tensor) -> Tensor:
    """x' of x = [position, velocity, tilt (2), its rate (2), thrust by mass] (..., 11), SI units.

    Args:
        u: tilt and thrust by mass that are commanded, (..., 3), rad and m/s^2.
    """
    velocity, tilt, turn, lift = x[..., VELOCITY], x[..., TILT], x[..., TURN], x[..., LIFT:]
    weight = torch.tensor([0.0, 0.0, GRAVITY], dtype=x.dtype)
    push = lift * axis(tilt) - DRAG * velocity - weight
    spin = HARDEST * ((STIFF * (u[..., :2] - tilt).sin() - DAMPED * turn) / HARDEST).tanh()
    return torch.cat((velocity, push, turn, spin, RISE * (u[..., 2:] - lift)), dim=-1)


def turned(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions [x, y, z, w]."""
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def tilts(n: np.ndarray) -> np.ndarray:
    """The tilts (..., 2) of directions of thrust n (..., 3), rad: the inverse of `axis`."""
    return np.stack((np.arctan2(n[..., 0], n[..., 2]), -np.arcsin(np.clip(n[..., 1], -1.0, 1.0))), axis=-1)


def tilt_state(q: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Tilt and its rate (4,) of a quaternion [x, y, z, w] and the rate of turn (3,) in the drone's frame, rad/s."""
    R = turned(q)
    n = R[:, 2]
    (a, b), change = tilts(n), np.cross(R @ spin, n)
    turn = (change[0] * np.cos(a) - change[2] * np.sin(a), -change[1])
    return np.array([a, b, *(np.array(turn) / np.cos(b))])


def commanded(tilt: np.ndarray, heading: float) -> np.ndarray:
    """Roll, pitch and yaw (3,) that give a tilt (2,) at a heading, rad."""
    n = axis(torch.from_numpy(tilt)).numpy()
    c, s = np.cos(heading), np.sin(heading)
    pitch, roll = tilts(np.array([c * n[0] + s * n[1], c * n[1] - s * n[0], n[2]]))
    return np.array([roll, pitch, heading])


class Strength:
    """How strong the thrust is beside the nominal one, 1 + an unknown share: the mass isn't known.

    Least squares of what the velocities say, with the spread that the mass is drawn with as what is known before.
    """

    SPREAD, NOISE = 0.07, 0.45  # of the share; of an acceleration over a period, by the drawn force, m/s^2

    def __init__(self) -> None:
        self.weight, self.sum, self.lift = self.SPREAD**-2, self.SPREAD**-2, 0.0

    @property
    def share(self) -> float:
        return self.sum / self.weight

    def flown(self, command: float, period: float, push: np.ndarray, n: np.ndarray, counts: bool) -> None:
        """Take in a period, s.

        Args:
            command: thrust by the nominal mass, m/s^2.
            push: the acceleration (3,) that thrust alone gave, m/s^2.
            n: the direction of thrust, (3,).
            counts: whether the drone was in the air.
        """
        gone = 1.0 - np.exp(-RISE * period)
        mean = command + (self.lift - command) * gone / (RISE * period)
        self.lift += (command - self.lift) * gone
        if counts:
            self.weight += (mean / self.NOISE) ** 2
            self.sum += mean * float(push @ n) / self.NOISE**2


def frames(centers: np.ndarray, quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Four beams and the stand of each of G gates: centers, half sides (5 G, 3), m, and quaternions [w, x, y, z].

    Args:
        centers: (G, 3), m.
        quaternions: (G, 4), [x, y, z, w].
    """
    middle, wide = 0.5 * (OPENING + OUTER), 0.5 * (OUTER - OPENING)
    at = np.array([[0, 0, middle], [0, 0, -middle], [0, middle, 0], [0, -middle, 0], [0, 0, -OUTER - STAND[2]]])
    half = np.array([[THICK, OUTER, wide]] * 2 + [[THICK, wide, OUTER]] * 2 + [STAND])
    places = centers[:, None] + np.einsum("gij,kj->gki", turned(quaternions), at)
    G = len(centers)
    return places.reshape(-1, 3), np.tile(half, (G, 1)), np.repeat(np.roll(quaternions, 1, axis=-1), 5, axis=0)
