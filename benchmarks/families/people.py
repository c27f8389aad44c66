"""python -m benchmarks.families.people DIR: loops of `MPC` on real maps among people, and periods without a sound plan.

A differential drive (+-1 m/s^2, +-1.5 rad/s, -0.3 to 1 m/s) follows the grid's way at 20 Hz between the starts and
goals of `floors.MAPS`, among people who walk straight on until something is in their way, and don't give way. It knows
where they are and how they walk now. In each period what it would fly from then on is judged; where that breaks a
constraint, a sound one is sought: the plan before, and braking at many rates of turn, at once or a little later.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.families.floors import MAPS, Owned
from torchgco import ControlBounds, Problem, QuadraticCost, Spheres, StateBounds, Unicycle
from torchgco.maps import DistanceField, Field, read
from torchgco.maps.ways import Ways

N, DT, PERIOD, SPEED = 40, 0.1, 0.05, 0.8
ACCELERATION, TURNING, SLOWEST, FASTEST = 1.0, 1.5, -0.3, 1.0
PEOPLE, BODY, AWAY = 6, 0.3, 1e3  # in the problem; a person's radius, m; where nobody is
APART = 0.05  # m that people keep from a vehicle that is in their way, then they turn round
CROSSES, FROM, AHEAD = (
    1.5,
    1.2,
    (0.4, 1.2),
)  # s between people who cross; m from which, and how far ahead of the vehicle
SECONDS = 6.0  # of a loop
SOUND = 1e-3  # m


@dataclass
class People:
    """Discs that walk straight on, and turn where a wall or the vehicle is in their way."""

    field: DistanceField
    p: np.ndarray
    v: np.ndarray
    draw: np.random.Generator

    @classmethod
    def near(cls, way: np.ndarray, free: DistanceField, density: float, seed: int) -> People:
        """As many for each metre of a way (P, 2), within 3 m of it, but not at its first 3 m."""
        draw, drawn = np.random.default_rng(seed), list[np.ndarray]()
        along = np.r_[0.0, np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum()]
        for _ in range(10000):
            if len(drawn) >= max(4, int(density * along[-1])):
                break
            at = way[np.searchsorted(along, draw.uniform(min(3.0, 0.5 * along[-1]), along[-1])).clip(max=len(way) - 1)]
            p = at + draw.uniform(-3, 3, 2)
            if clear(free, p[None])[0] > BODY + 0.1 and np.linalg.norm(p - way[0]) > 2.0:
                drawn.append(p)
        angles, speeds = draw.uniform(-np.pi, np.pi, len(drawn)), draw.uniform(0.4, 1.4, len(drawn))
        return cls(free, np.array(drawn), speeds[:, None] * np.stack((np.cos(angles), np.sin(angles)), -1), draw)

    def walk(self, h: float, vehicle: np.ndarray, radius: float) -> None:
        """For h seconds."""
        later = self.p + h * self.v
        before, after = (np.linalg.norm(q - vehicle, axis=1) for q in (self.p, later))
        met = (after < BODY + radius + APART) & (after < before)
        walled = (clear(self.field, later) < BODY) & (clear(self.field, later) < clear(self.field, self.p))
        turned = met | walled
        self.p = np.where(turned[:, None], self.p, later)
        angles = self.draw.uniform(0.5 * np.pi, 1.5 * np.pi, len(self.p))
        c, s = np.cos(angles), np.sin(angles)
        other = np.stack((c * self.v[:, 0] - s * self.v[:, 1], s * self.v[:, 0] + c * self.v[:, 1]), -1)
        self.v = np.where(turned[:, None], other, self.v)

    def cross(self, x: np.ndarray) -> None:
        """Let one more walk so as to cross the way of a vehicle at x (4,)."""
        side, speed, ahead = self.draw.choice([-1.0, 1.0]), self.draw.uniform(0.6, 1.4), self.draw.uniform(*AHEAD)
        along = np.array([np.cos(x[2]), np.sin(x[2])])
        across = side * np.array([-along[1], along[0]])
        p = x[:2] + (ahead + max(x[3], 0.0) * FROM / speed) * along - FROM * across
        if clear(self.field, p[None])[0] > BODY:
            self.p, self.v = np.vstack((self.p, p)), np.vstack((self.v, speed * across))

    def nearest(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Places and velocities (PEOPLE, 2) of those nearest to a place."""
        order = np.argsort(np.linalg.norm(self.p - x, axis=1))[:PEOPLE]
        centers, velocities = np.full((PEOPLE, 2), AWAY), np.zeros((PEOPLE, 2))
        centers[: len(order)], velocities[: len(order)] = self.p[order], self.v[order]
        return {"centers": centers, "velocities": velocities}


def clear(free: DistanceField, points: np.ndarray) -> np.ndarray:
    """Distances (K,), m."""
    return free.distance(torch.from_numpy(points)).reshape(-1).numpy()


@dataclass
class Loop:
    """What a loop came to."""

    name: str
    seconds: list[float] = field(default_factory=list)  # of the processor, a step
    wall: list[float] = field(default_factory=list)
    solved: int = 0
    held: int = 0
    unsound: int = 0  # periods in which what is flown breaks a constraint by more than `SOUND`
    missed: list[str] = field(default_factory=list)  # of these: what was sound there
    outside: int = 0  # controls out of their bounds
    wrong: int = 0  # periods whose loop says otherwise whether what is flown is feasible
    least: float = np.inf  # distance to people and walls, m
    arrived: bool = False


def reference(way: np.ndarray, x: np.ndarray) -> np.ndarray:
    """States (N+1, 4) along a way from the place nearest to the vehicle on, at `SPEED`."""
    near = int(np.linalg.norm(way - x[:2], axis=1).argmin())
    along = np.r_[0.0, np.linalg.norm(np.diff(way[near:], axis=0), axis=1).cumsum()]
    s = np.minimum(SPEED * DT * np.arange(N + 1), along[-1])
    p = np.stack([np.interp(s, along, way[near:, i]) for i in (0, 1)], -1)
    ahead = np.stack([np.interp(np.minimum(s + 0.3, along[-1]), along, way[near:, i]) for i in (0, 1)], -1) - p
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    heading[np.linalg.norm(ahead, axis=1) < 1e-6] = x[2]
    heading = np.unwrap(np.r_[x[2], heading])[1:]
    return np.column_stack((p, heading, np.where(s < along[-1], SPEED, 0.0)))


def posed(field_: DistanceField, radius: float) -> Problem:
    cost = QuadraticCost([1.0, 1.0, 0.01, 0.1], [0.1, 0.1], [10.0, 10.0, 0.01, 1.0], x_ref=np.zeros((N + 1, 4)))
    inf = float("inf")
    parts = [
        ControlBounds([-ACCELERATION, -TURNING], [ACCELERATION, TURNING]),
        StateBounds([-inf, -inf, -inf, SLOWEST], [inf, inf, inf, FASTEST]),
        Field(field_, radius),
        Spheres(np.full((PEOPLE, 2), AWAY), BODY, radius, velocities=np.zeros((PEOPLE, 2))),
    ]
    return Problem(Unicycle(dt=DT), cost, parts, torch.zeros(1, 4, dtype=torch.float64), N)


def flown(mpc: torchgco.MPC, x: np.ndarray, u: Tensor) -> Tensor:
    """The controls (1, N, 2) with which a vehicle goes on by the loop's plan, at stages from now on."""
    if not bool(mpc.held):
        return mpc.plan.U
    state, U, model = torch.from_numpy(x)[None], [u[None]], mpc.compiled.problem.dynamics
    for k in range(1, N):
        state = model.step(state, U[-1])
        U.append(mpc.plan.at(mpc.t + k * DT, state).u)
    return torch.stack(U, 1)


def brakes(problem: Problem) -> Tensor:
    """Controls (K, N, 2) that brake, at once or a little later, at many rates of turn."""
    turns = np.linspace(-TURNING, TURNING, 13)
    first, sign, turn = (a.reshape(-1) for a in np.meshgrid([0, 2, 5, 10], [1.0, -1.0], turns, indexing="ij"))
    U, speed = np.zeros((len(turn), N, 2)), np.full(len(turn), float(problem.x0[0, 3]))
    for k in range(N):
        a = np.where(k < first, sign * ACCELERATION, -speed / DT)
        low, high = (SLOWEST - speed) / DT, np.maximum((FASTEST - speed) / DT, -ACCELERATION)
        U[:, k, 0] = np.minimum(np.maximum(np.clip(a, -ACCELERATION, ACCELERATION), low), high)
        U[:, k, 1] = np.where(np.abs(speed) > 1e-9, turn, 0.0)
        speed += DT * U[:, k, 0]
    return torch.from_numpy(U)


def violations(problem: Problem, U: Tensor) -> Tensor:
    """The largest violations (K,) of controls (K, N, 2) from the start of a problem alone, by PyTorch."""
    many = problem.take(torch.zeros(len(U), dtype=torch.int64))
    X = [many.x0]
    for k in range(N):
        X.append(many.dynamics.step(X[-1], U[:, k]))
    states = torch.stack(X, 1)
    return torch.stack([part.violation(states, U).flatten(1).amax(-1) for part in many.constraints]).amax(0)


def known(problem: Problem, plan_before: Tensor | None) -> str | None:
    """The name of something sound in a problem, or None."""
    U = brakes(problem) if plan_before is None else torch.cat((plan_before, brakes(problem)))
    worst = violations(problem, U)
    if bool((worst <= SOUND).any()):
        return "before" if plan_before is not None and worst[0] <= SOUND else "braking"
    return None


def looped(one: Owned, folder: Path, seed: int, solver: str | None, seconds: float | None) -> Loop:
    """A loop on a map, among people drawn under a seed."""
    free, mpc, ways = opened(one, folder, solver, seconds)
    way = ways.way(one.start, one.goal)
    assert way is not None
    draw = np.random.default_rng(seed)
    first = int(draw.uniform(0.0, 0.6) * len(way))
    way = way[first:]
    people, found = People.near(way, free, 0.7, seed), Loop(f"{one.file} {seed}")
    start = way[min(5, len(way) - 1)] - way[0]
    x = np.array([*way[0], np.arctan2(start[1], start[0]), 0.0])
    mpc.reset()
    before: Tensor | None = None
    for k in range(int(SECONDS / PERIOD)):
        now = people.nearest(x[:2])
        began, wall = time.thread_time(), time.perf_counter()
        u = mpc.step(x, x_ref=reference(way, x), **now)
        if k > 0:
            found.seconds.append(time.thread_time() - began)
            found.wall.append(time.perf_counter() - wall)
        solved = mpc.statuses[0] in (torchgco.Status.CONVERGED, torchgco.Status.FEASIBLE)
        found.solved += solved
        found.held += bool(mpc.held)
        found.outside += bool((u.abs() > torch.tensor([ACCELERATION, TURNING])).any())
        U, problem = flown(mpc, x, u), mpc.compiled.problem
        sound = float(violations(problem, U)) <= SOUND
        said = getattr(mpc, "feasible", None)
        found.wrong += said is not None and bool(said) != sound
        if not sound:
            found.unsound += 1
            if (what := known(problem, before)) is not None:
                found.missed.append(f"{k}:{what}")
        before = torch.lerp(U, torch.cat((U[:, 1:], U[:, -1:]), 1), PERIOD / DT)
        x = torchgco.Unicycle(dt=PERIOD).step(torch.from_numpy(x)[None], u[None])[0].numpy()
        people.walk(PERIOD, x[:2], one.radius)
        if k % int(CROSSES / PERIOD) == int(CROSSES / PERIOD) - 1:
            people.cross(x)
        apart = np.linalg.norm(people.p - x[:2], axis=1) - BODY
        found.least = min(found.least, float(np.r_[clear(free, x[None, :2]), apart].min()) - one.radius)
        if np.linalg.norm(x[:2] - way[-1]) < 0.3:
            found.arrived = True
            break
    return found


_opened: dict[Any, Any] = {}


def opened(
    one: Owned, folder: Path, solver: str | None, seconds: float | None
) -> tuple[DistanceField, torchgco.MPC, Ways]:
    """A map's field, a loop on it, and its ways."""
    if one.file not in _opened:
        grid = read(folder / one.file) if one.resolution is None else read(folder / one.file, resolution=one.resolution)
        free = DistanceField.of(grid)
        more = {} if seconds is None else {"max_seconds": seconds}
        mpc = torchgco.MPC(posed(free, one.radius), solver, PERIOD, **more)
        ways = Ways.through(free, 0, one.radius)
        _opened[one.file] = free, mpc, Ways(ways.distance, ways.origin, ways.spacing, one.radius + 0.05, 0.4, 4.0)
    return _opened[one.file]


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="DIR", help="with the maps")
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 32], help="the first, and the one after the last")
    parser.add_argument("--solver", help="gco or interior_point")
    parser.add_argument("--seconds", type=float, help="limit of a step; default: a period")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    found = []
    for seed in range(*asked.seeds):
        found.append(looped(MAPS[seed % len(MAPS)], asked.folder, seed, asked.solver, asked.seconds))
        print(line(found[-1].name, found[-1:]), *found[-1].missed, flush=True)
    print(line(f"{len(found)} loops", found))
    return 0


def line(name: str, loops: Sequence[Loop]) -> str:
    """The sums over some loops, and the times of their steps."""
    ms, least = 1e3 * np.concatenate([one.seconds for one in loops]), min(one.least for one in loops)
    names = "solved", "held", "unsound", "outside", "wrong", "arrived"
    counts = [f"{name} {sum(int(getattr(one, name)) for one in loops)}" for name in names]
    missed, times = sum(len(one.missed) for one in loops), [f"{q} {np.quantile(ms, q):.1f}" for q in (0.5, 0.99, 1.0)]
    return (
        f"{name:22} periods {len(ms) + len(loops)} {' '.join(counts)} missed {missed} least {least:+.3f} m, "
        f"processor's ms by quantile {' '.join(times)}, wall at most {1e3 * max(max(one.wall) for one in loops):.0f}"
    )


if __name__ == "__main__":
    sys.exit(main())
