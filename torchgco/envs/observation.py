"""What a policy sees of a mission: the vehicle, the way to its goal, and the obstacles next to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchgco.dynamics.quadrotor import Airframe

Texts = tuple[str, ...]
AXES = "xyz"
STEP = 1e-4  # m, of the differences that tell where an obstacle is
VEHICLE: Texts = (
    *(f"goal {axis}" for axis in AXES),
    *(f"v{axis}" for axis in AXES),
    *(f"R{row}{column}" for row in AXES for column in AXES),
    *(f"w{axis}" for axis in AXES),
    "a",
)
UNITS: Texts = (*["m"] * 3, *["m/s"] * 3, *[""] * 9, *["rad/s"] * 3, "m/s^2")


def names(nearest: int) -> Texts:
    """Of the components of an observation with so many obstacles.

    `goal` is the way to the goal and `v` the velocity in the world's axes, R the rotation from the body's axes to
    them, w the body rates, a the joint thrust by the mass. Of each obstacle, nearest first, the direction in which it
    lies, of length 1, and its distance from the vehicle's ball.
    """
    fields = (*(f"toward {axis}" for axis in AXES), "distance")
    return (*VEHICLE, *(f"obstacle {k} {name}" for k in range(1, nearest + 1) for name in fields))


def units(nearest: int) -> Texts:
    """Of the same components; empty for numbers without one."""
    return (*UNITS, *(("", "", "", "m") * nearest))


def observed(x: Tensor, goal: Tensor, obstacles: Sequence[Any], airframe: Airframe, nearest: int, sight: float):
    """Observations (B, 19 + 4 nearest) of plants x (B, 17) with goals (B, 3)."""
    v, w, a = x[:, 3:6], x[:, 10:13], x[:, 13:].sum(-1, keepdim=True) / airframe.mass
    state = torch.cat((goal - x[:, :3], v, rotation(x[:, 6:10]).flatten(1), w, a), dim=-1)
    return torch.cat((state, surroundings(x[:, :3], obstacles, nearest, sight).flatten(1)), dim=-1)


def rotation(q: Tensor) -> Tensor:
    """R (B, 3, 3) from the body's axes to the world's, of unit quaternions (B, 4), scalar first."""
    w, x, y, z = q.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def surroundings(p: Tensor, obstacles: Sequence[Any], nearest: int, sight: float) -> Tensor:
    """Direction and distance (B, nearest, 4), m, of the obstacles nearest to positions p (B, 3), nearest first.

    Distances count from the obstacle's surface to the vehicle's ball, and are at most `sight`; an obstacle that is
    absent or farther away has the direction 0.
    """
    seen = torch.cat((torch.zeros(len(p), nearest, 3), torch.full((len(p), nearest, 1), sight)), dim=-1).to(p)
    if nearest == 0 or not obstacles:
        return seen
    offsets = STEP * torch.cat((torch.zeros(1, 3), torch.eye(3), -torch.eye(3))).to(p)
    points, times = p.unsqueeze(1) + offsets, p.new_zeros(len(offsets))
    d = torch.cat([obstacle.signed_distance(points, times) for obstacle in obstacles], dim=-1)  # (B, 7, M)
    distance, which = d[:, 0].topk(min(nearest, d.shape[-1]), largest=False)
    slope = (d[:, 1:4] - d[:, 4:]) / (2.0 * STEP)
    toward = -slope.gather(2, which.unsqueeze(1).expand(-1, 3, -1)).transpose(1, 2)
    toward = toward / toward.norm(dim=-1, keepdim=True).clamp(min=STEP)
    far = ~(distance < sight)
    seen[:, : which.shape[1], :3] = toward.masked_fill(far.unsqueeze(-1), 0.0).nan_to_num()
    seen[:, : which.shape[1], 3] = distance.masked_fill(far, sight)
    return seen
