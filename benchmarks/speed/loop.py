"""A receding horizon: a car that follows a reference between two discs, by a compiled problem, by `solve`, by peers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.speed.bench import SEED, Bench
from benchmarks.speed.loop_peers import ByHand, Peer
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost, Spheres, Status

SECTION = "loop"
N, DT = 20, 0.1
Q, R, QF = [1.0, 1.0, 0.1, 0.1], [0.1, 1.0], [10.0, 10.0, 1.0, 1.0]
CENTERS, RADIUS, VEHICLE = np.array([[12.0, 1.2], [30.0, -1.0]]), 0.8, 0.5  # m
LOWER, UPPER = [-3.0, -0.5], [3.0, 0.5]
START = np.array([0.0, 0.0, 0.0, 3.0])
FIRST = 5  # periods that aren't timed
ROOM = RADIUS + VEHICLE + 0.7  # m from a disc's centre that a car at 3 m/s needs to turn away; nearer discs vanish
NOISE = np.array([0.1, 0.1, 0.05, 0.3])  # standard deviation of a disturbance, times its share
Report = Callable[[], tuple[int, bool]]  # iterations, and whether the period is solved: asked for after it is timed
Controller = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, Report]]


def rates(x: Tensor, u: Tensor) -> Tensor:
    """Of x = [px, py, heading, speed] under u = [acceleration, steering angle]."""
    speed, heading = x[..., 3], x[..., 2]
    return torch.stack((speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / 2.5, u[..., 0]), -1)


CAR = FunctionDynamics(rates, 4, 2, DT, "rk4", position=slice(0, 2))


def reference(t: float) -> np.ndarray:
    """States (N+1, 4) along a sine at 3 m/s, from time t on."""
    times = t + DT * np.arange(N + 1)
    return np.stack((3 * times, 2 * np.sin(0.5 * times), 0 * times, 3 + 0 * times), -1)


def problem(x: np.ndarray, x_ref: np.ndarray, centers: np.ndarray) -> Problem:
    """From states x (B, 4)."""
    cost = QuadraticCost(Q, R, QF, x_ref=torch.tensor(x_ref))
    parts = [ControlBounds(LOWER, UPPER), Spheres(centers, [RADIUS] * len(centers), VEHICLE)]
    return Problem(CAR, cost, parts, torch.tensor(x), N)


@dataclass
class Drive:
    """One drive's periods."""

    seconds: list[float] = field(default_factory=list)  # of the processor
    iterations: list[int] = field(default_factory=list)
    solved: int = 0

    def say(self, bench: Bench, case: str, solver: str) -> None:
        times = 1000 * np.array(self.seconds[FIRST:] or self.seconds)
        for quantity, value in (("median", np.median(times)), ("99 %", np.quantile(times, 0.99)), ("max", times.max())):
            bench.row(SECTION, case, solver, quantity, float(value), "ms")
        bench.row(SECTION, case, solver, "iterations", float(np.mean(self.iterations)))
        bench.row(SECTION, case, solver, "solved", f"{self.solved}/{len(self.seconds)}")


def drive(control: Controller, periods: int, noise: float = 0.0) -> Drive:
    """A car alone; with noise it is disturbed, and the discs drive ahead of it and are put into its way again."""
    found, x, random = Drive(), START.copy(), np.random.default_rng(SEED)
    ahead = CENTERS[:, 0].copy()
    for k in range(periods):
        t, centers = DT * k, CENTERS
        if noise > 0:
            ahead += DT * np.array([1.5, 2.7])
            passed = ahead < x[0] - 6
            ahead[passed] = x[0] + 14 + random.uniform(0, 6, int(passed.sum()))
            centers = np.stack((ahead, 2 * np.sin(0.5 * ahead / 3) + np.array([1.2, -1.0])), -1)
            centers = centers - 10.0 * (np.linalg.norm(centers - x[:2], axis=1) < ROOM)[:, None]
        began = time.thread_time()
        u, report = control(x, reference(t), centers)
        found.seconds.append(time.thread_time() - began)
        iterations, solved = report()
        found.iterations.append(iterations)
        found.solved += solved
        x = CAR.step(torch.tensor(x[None]), torch.tensor(u[None]))[0].numpy()
        x = x + noise * NOISE * random.standard_normal(4)
    return found


def compiled(solver: str) -> Controller:
    """By `torchgco.compile`."""
    mpc = torchgco.compile(problem(START[None], reference(0.0)[None], CENTERS), solver, receding=True)

    def control(x: np.ndarray, x_ref: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, Report]:
        answer = mpc(x0=x, x_ref=x_ref, centers=centers)
        return answer.U[0, 0].numpy(), lambda: (int(answer.iterations), answer.statuses[0] == Status.CONVERGED)

    return control


def plain(solver: str) -> Controller:
    """By a new problem and `torchgco.solve` in every period, warm."""
    last: list[torchgco.Solution] = []

    def control(x: np.ndarray, x_ref: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, Report]:
        now = problem(x[None], x_ref[None], centers)
        found = torchgco.solve(now, solver=solver, warm=last[-1] if last else None, verbose=False)
        last[:] = [found]
        return found.U[0, 0].numpy(), lambda: (int(found.iterations), found.statuses[0] == Status.CONVERGED)

    return control


def stepped() -> Controller:
    """By `torchgco.MPC`."""
    mpc = torchgco.MPC(problem(START[None], reference(0.0)[None], CENTERS))

    def control(x: np.ndarray, x_ref: np.ndarray, centers: np.ndarray) -> tuple[np.ndarray, Report]:
        u = mpc.step(x, x_ref=x_ref, centers=centers)
        return u.numpy(), lambda: (int(mpc.answer.iterations), mpc.statuses[0] == Status.CONVERGED)

    return control


def by_hand() -> ByHand:
    """The same as CasADi's users write it."""
    import casadi as ca

    rates = lambda x, u: ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), x[3] * ca.tan(u[1]) / 2.5, u[0])
    return ByHand(rates, N, DT, Q, R, QF, LOWER, UPPER, [np.inf] * 4, reach=[RADIUS + VEHICLE] * 2)


def fleet(count: int, periods: int) -> Drive:
    """As many cars in one call."""
    found, random = Drive(), np.random.default_rng(SEED)
    x = START + 0.1 * random.standard_normal((count, 4))
    mpc = torchgco.compile(problem(x, reference(0.0)[None], CENTERS), receding=True)
    for k in range(periods):
        began = time.thread_time()
        answer = mpc(x0=x, x_ref=reference(DT * k))
        found.seconds.append(time.thread_time() - began)
        found.iterations.append(int(answer.iterations.max()))
        found.solved += all(status == Status.CONVERGED for status in answer.statuses)
        x = CAR.step(torch.tensor(x), answer.u).numpy()
    return found


def run(bench: Bench) -> None:
    """Ours, the peers, and ours again are alternated by the order of rows: a drift of the machine shows in the two."""
    periods, long = bench.sizes.loop_periods, bench.sizes.loop_disturbed
    case = f"one car, {periods} periods"
    drive(compiled("gco"), periods).say(bench, case, "compile, gco")
    for peer in Peer.ready(by_hand(), bench.sizes.loop_compiled):
        drive(peer, periods).say(bench, case, peer.name)
    drive(compiled("interior_point"), periods).say(bench, case, "compile, interior_point")
    drive(stepped(), periods).say(bench, case, "MPC")
    for solver in ("interior_point", "gco"):
        drive(plain(solver), periods // 8).say(bench, case, f"solve, {solver}")
    for noise in (0.02, 0.2):
        drive(compiled("gco"), long, noise).say(bench, f"disturbed by {noise:g}, {long} periods", "compile, gco")
    for count in bench.sizes.loop_fleets:
        fleet(count, periods // 4).say(bench, f"{count} cars", "compile, gco")
