"""Vehicles that fly missions side by side, each with a clock of its own, and what a policy sees of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.tree import put
from torchgco.constraints.gates import has_gates
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.contact import Contact
from torchgco.missions.disturbance import Disturbance, measured
from torchgco.missions.mission import Mission, check_flown
from torchgco.missions.outcome import FARTHEST, Outcome
from torchgco.missions.planning_problem import airframe_of, planning_state
from torchgco.missions.plant import flown, hovering
from torchgco.missions.tracker import RATES, Reference, Tracking
from torchgco.obstacles.body import check_no_body
from torchgco.problem.problem import Problem

FLYING = -1  # the outcome of an episode that hasn't ended
Control = Literal["rates", "rotors"]


class Episodes:
    """B vehicles, each of which flies the mission of one of L planning problems; `begin` gives it another one.

    What a vehicle does depends on its own episode alone, bit by bit.

    Attributes:
        x: states of the plants (B, 17); layout: the rows of `problem` that they fly, (B,); step: control periods that
            they have flown, (B,); number: of each one's episode, (B,), 0 before its first.
        layouts: rows of `problem` that can be flown, whose starts are free of obstacles.

    Raises:
        InputError: problems or missions that can't be flown (`Mission.fly`), or not here: a sensor, a latency,
            obstacles that move, no start that is free.
    """

    def __init__(self, mission: Mission, problem: Problem, count: int, control: Control) -> None:
        problem, _, _ = check_flown(mission, problem, 0, None)
        if not mission.sees_all or mission.latency or has_gates(problem):
            got = "a sensor" if not mission.sees_all else "a latency" if mission.latency else "a race"
            raise InputError("mission", "no sensor, latency or race in an environment", got)
        self.mission, self.problem, self.control = mission, problem, control
        check_no_body(problem, "vehicle_radius", "a number for an environment, whose vehicle is a ball")
        self.contacts = Contact.among(problem)
        if self.contacts.moving:
            raise InputError("problem.constraints", "obstacles at rest in an environment", "some that move")
        self.layouts = problem.start_is_clear.nonzero().flatten()
        if len(self.layouts) == 0:
            raise InputError("problem.x0", "at least one start that is free of obstacles", "none")
        self.airframe, self.period = airframe_of(problem.dynamics), float(problem.dynamics.dt)
        self.substeps, self.steps = mission.substeps(self.period) or 1, mission.periods(self.period)
        goal = problem.goal
        assert goal is not None
        radius = goal.radius if mission.goal_radius is None else torch.full_like(problem.x0[:, 0], mission.goal_radius)
        self._goals, self._radii, self._plants = goal.position, radius, flown(mission.plant, self.airframe)
        self._allocate(count)

    def _allocate(self, B: int) -> None:
        like, calm = self.problem.x0, self.mission.disturbance == Disturbance()
        self.x, self.start = hovering(self.airframe, like.new_zeros(B, 3)), like.new_zeros(B, 3)
        self.layout, self.step, self.number = (torch.zeros(B, dtype=torch.int64) for _ in range(3))
        self._noise = like.new_zeros(B, 1 if calm else self.steps + 1, 13)
        self._force = like.new_zeros(B, 1 if calm else self.steps + 1, 3)
        self._measured_at, self._clearance = like.new_zeros(B, 3), like.new_full((B,), -torch.inf)
        self._fresh = torch.ones(B, dtype=torch.bool)
        self._tracking: Tracking | None = None

    def begin(self, rows: Tensor, layouts: Tensor, seeds: Sequence[int], ids: Sequence[int]) -> None:
        """Put the vehicles `rows` (b,) at rest at the starts of other problems.

        Args:
            layouts: rows of the problems, (b,).
            seeds, ids: the key of each one's disturbances.
        """
        self.layout[rows], self.step[rows] = layouts, 0
        self.number[rows] += 1
        self.start[rows] = self.problem.x0[layouts, :3]
        self.x[rows] = hovering(self.airframe, self.start[rows])
        self._clearance[rows], self._fresh[rows] = -torch.inf, True
        if self._noise.shape[1] > 1:
            for row, seed, number in zip(rows.tolist(), seeds, ids, strict=True):
                drawn = self.mission.disturbance.draw(seed, [number], self.steps + 1, self.period)
                self._force[row], self._noise[row] = drawn[0][0], drawn[1][0]
        self.goal, self.radius = self._goals[self.layout], self._radii[self.layout]
        self.contact, self.plant = self.contacts.take(self.layout), self._plants.take(self.layout)

    def measured(self) -> Tensor:
        """The states as they are measured, (B, 17)."""
        return measured(self.x, self._now(self._noise))

    def distance(self) -> Tensor:
        """From the goals, (B,), m."""
        return (self.x[:, :3] - self.goal).norm(dim=-1)

    def fly(self, action: Tensor, waiting: Tensor) -> Tensor:
        """Fly a control period; returns how vehicles have ended in it, (B,) int64, `FLYING` for those that haven't.

        Args:
            action: (B, 4), held for the period: body rates, rad/s, and thrust acceleration, m/s^2, which the tracker
                follows; or with `control` "rotors" the rotors' speeds, rpm.
            waiting: those that stay as they are, (B,) bool.
        """
        seen, force = self.measured(), self._now(self._force)
        outcome, reference = torch.full_like(self.step, FLYING), self._reference(seen, action)
        for j in range(self.substeps):
            commands = action
            if self.control == "rates":
                commands = self._tracked(self.measured(), reference, j * self.plant.dt)
            self._move(self.plant.advance(self.x, commands, force), outcome, waiting)
        self.step += (~waiting).long()
        return outcome

    def _reference(self, seen: Tensor, action: Tensor) -> Reference:
        X = planning_state(seen, self.airframe).unsqueeze(1).repeat(1, 2, 1)
        X[..., RATES.start :] = action.unsqueeze(1)
        return Reference(X, self.period, self.airframe)

    def _tracked(self, seen: Tensor, reference: Reference, offset: float) -> Tensor:
        """Rotor speeds (B, 4), rpm. The first call of an episode starts from nothing, as that of a mission."""
        tracker, fresh = self.mission.tracker, self._fresh.nonzero().flatten()
        first = self._tracking is None or len(fresh) == len(seen)
        tracking = tracker.track(seen, reference, offset, None if first else self._tracking)
        if not first and len(fresh) > 0:
            restarted = Reference(reference.X[fresh], self.period, self.airframe)
            begun = tracker.track(seen[fresh], restarted, offset)
            for name in ("commands", "violation", "U", "multipliers"):
                put(getattr(tracking, name), fresh, getattr(begun, name))
        self._tracking = tracking
        self._fresh[:] = False
        return tracking.commands

    def _move(self, x: Tensor, outcome: Tensor, waiting: Tensor) -> None:
        """Move vehicles to x (B, 17) a time step later, and note in `outcome` which have ended by that.

        As `judge_flight` does: contact counts between the steps, too, and before the goal. A vehicle that is lost stays
        in its last state, so that observations are finite.
        """
        rest = waiting | (outcome != FLYING)
        p = x[:, :3]
        lost = ~(torch.isfinite(x).all(-1) & ((p - self.start).norm(dim=-1) <= FARTHEST))
        there = (p - self.goal).norm(dim=-1) < self.radius
        ended = torch.where(lost, int(Outcome.DIVERGED), torch.where(there, int(Outcome.REACHED), FLYING))
        ended = torch.where(self._touches(p, ~(rest | lost)), int(Outcome.COLLISION), ended)
        outcome.copy_(torch.where(rest, outcome, ended))
        self.x = torch.where((rest | lost).unsqueeze(-1), self.x, x)

    def _touches(self, p: Tensor, asked: Tensor) -> Tensor:
        """Whether vehicles that are asked for touch an obstacle on the straight ways to p (B, 3), (B,) bool.

        None does that is nearer to where its clearance was measured than that.
        """
        far = ~((p - self._measured_at).norm(dim=-1) < self._clearance)
        rows = (asked & far).nonzero().flatten()
        touching = torch.zeros_like(asked)
        if len(rows) > 0:
            contact = self.contact.take(rows)
            now = p[rows]
            touching[rows] = contact.along(torch.stack((self.x[rows, :3], now), dim=1), self.plant.dt) < 0
            self._measured_at[rows], self._clearance[rows] = now, contact.distance(now, 0.0)
        return touching

    def _now(self, values: Tensor) -> Tensor:
        """Values (B, K, n) of each vehicle's control period."""
        return values[torch.arange(len(values)), self.step.clamp(max=values.shape[1] - 1)]


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
