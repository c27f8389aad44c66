"""Who flies: plans when poses are seen and gates are passed, tracks the plan at 50 Hz, and learns the thrust."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

import torchgco
from benchmarks.outside.drone_racing_model import (
    CONTROLS,
    DRAG,
    GRAVITY,
    LIFT,
    MASS,
    POSITION,
    STATES,
    Strength,
    commanded,
    rates,
    tilt_state,
    turned,
)
from benchmarks.outside.drone_racing_plan import STAGES, Limits, Plan, Track, again, as_soon, first
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost

PERIOD, AHEAD = 0.02, 15  # s; periods
STRONGEST, WEAKEST = 0.72, 0.1  # N, commanded
OFTEN, SOON = 0.4, 0.1  # s, at most, from plan to plan; from one with eased limits
RETRY = 0.06  # s, from where none was found to the next
CLOSE = 0.12  # s before a gate, in which the plan isn't changed
ON_GROUND = 0.05  # m
STEEPEST = 1.1  # rad, commanded

# Of states, and of commands beside the plan's.
WEIGHTS = [400.0] * 3 + [20.0] * 3 + [2.0] * 2 + [0.02] * 2 + [0.02]
EFFORT = [4.0, 4.0, 0.04]


def tracker() -> torchgco.MPC:
    """Follows states and controls `x_ref`, `u_ref` for the next periods."""
    model = FunctionDynamics(rates, STATES, CONTROLS, PERIOD, "rk4", POSITION)
    zero, rest = np.zeros((AHEAD + 1, STATES)), np.tile([0.0, 0.0, GRAVITY], (AHEAD, 1))
    zero[:, LIFT] = GRAVITY
    cost = QuadraticCost(WEIGHTS, EFFORT, WEIGHTS, x_ref=zero, u_ref=rest)
    bounds = ControlBounds([-STEEPEST, -STEEPEST, 2.0], [STEEPEST, STEEPEST, 17.0])
    return torchgco.MPC(Problem(model, cost, [bounds], [zero[0].tolist()], AHEAD), "interior_point", tolerance=1e-4)


class Pilot:
    """One flight.

    Args:
        nominal: a plan from the nominal start through the nominal track.
        mpc: `tracker()`; one serves flight after flight.
        limits: of plans.
    """

    def __init__(self, nominal: Plan, mpc: torchgco.MPC, limits: Limits) -> None:
        self.plan, self.mpc, self.limits = nominal, mpc, limits
        self.strength, self.t, self.planned = Strength(), 0.0, -np.inf
        self.known: Any = None
        self.lost = False  # whether the last plan wasn't found
        self.before: tuple[np.ndarray, np.ndarray] | None = None  # velocity and axis of a period ago
        self.command = 0.0
        self.stray = 0.0  # m, the farthest from a plan so far
        mpc.reset()

    def command_of(self, obs: Mapping[str, Any]) -> np.ndarray:
        """Roll, pitch, yaw, rad, and thrust, N, for the next period."""
        obs = {name: np.asarray(value, dtype=float) for name, value in obs.items()}
        x = self._state(obs)
        passed = int(obs["target_gate"])
        track = Track(
            obs["gates_pos"], obs["gates_quat"], obs["obstacles_pos"], obs["obstacles_visited"] > 0,
            obs["gates_visited"] > 0,
        )  # fmt: skip
        if passed >= 0:
            self._plan(track, x, passed)
        times = self.t + PERIOD * np.arange(AHEAD + 1)
        X, U = self.plan.at(times)
        share = self.strength.share
        u = self.mpc.step(
            x, x_ref=X, u_ref=0.5 * (U[:-1] + U[1:]),
            lower=[-STEEPEST, -STEEPEST, share * WEAKEST / MASS], upper=[STEEPEST, STEEPEST, share * STRONGEST / MASS],
        ).numpy()  # fmt: skip
        self.command = float(u[2]) / share
        self.stray = max(self.stray, float(np.linalg.norm(X[0, POSITION] - x[POSITION])))
        self.t += PERIOD
        return np.array([*commanded(u[:2], 0.0), self.command * MASS])

    def _state(self, obs: Mapping[str, np.ndarray]) -> np.ndarray:
        """The state (n,), and what the last period says of the thrust."""
        n, v = turned(obs["quat"])[:, 2], obs["vel"]
        if self.before is not None:
            v0, n0 = self.before
            push = (v - v0) / PERIOD + DRAG * 0.5 * (v + v0) + [0.0, 0.0, GRAVITY]
            mean = n + n0
            self.strength.flown(
                self.command, PERIOD, push, mean / np.linalg.norm(mean), bool(obs["pos"][2] > ON_GROUND)
            )
        self.before = v, n
        lift = self.strength.share * self.strength.lift
        if obs["pos"][2] < ON_GROUND:
            lift = max(lift, GRAVITY)  # the floor carries what thrust doesn't
        return np.array([*obs["pos"], *v, *tilt_state(obs["quat"], obs["ang_vel"]), lift])

    def _plan(self, track: Track, x: np.ndarray, passed: int) -> None:
        """Plan again where something is new, unless the next gate is near."""
        known = (passed, track.gates.tobytes(), track.poles.tobytes())
        new = known != self.known
        at_gate = min((passed - self.plan.passed + 1) * STAGES, len(self.plan.t) - 1)
        to_gate = self.plan.t[at_gate] - self.t
        often = SOON if self.plan.speed > self.limits.speed else OFTEN
        if self.t - self.planned < RETRY - 1e-9 and self.lost:
            return
        if not new and (self.t - self.planned < often - 1e-9 or to_gate < CLOSE):
            return
        found = again(self.plan, track, x, self.t, passed, self.strength.share, self.limits)
        self.planned, self.lost = self.t, found is None
        if found is not None and (new or as_soon(found, self.plan, self.t, SOON)):
            self.plan, self.known = found, known


def nominal_plan(config: Any, limits: Limits) -> Plan:
    """The plan through the track as its file has it."""
    track = Track(
        np.array([g["pos"] for g in config.gates]), quaternions(np.array([g["rpy"] for g in config.gates])),
        np.array([o["pos"] for o in config.obstacles]), np.zeros(len(config.obstacles), bool),
        np.zeros(len(config.gates), bool),
    )  # fmt: skip
    x = np.zeros(STATES)
    x[POSITION], x[LIFT] = config.drones[0]["pos"], GRAVITY
    return first(track, x, limits)


def quaternions(rpy: np.ndarray) -> np.ndarray:
    """[x, y, z, w] (..., 4) of roll, pitch and yaw about axes that stay, rad."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", rpy).as_quat()
