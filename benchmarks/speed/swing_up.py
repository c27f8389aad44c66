"""A cart-pole that swings up in a receding horizon, by `MPC` and by FATROP by hand."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.speed.bench import Bench
from benchmarks.speed.loop_peers import ByHand, Peer, Report
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost, StateBounds, Status

SECTION = "swing_up"
N, DT, PERIODS = 75, 0.02, 200
Q, R, QF = [1.0, 1.0, 0.1, 0.1], [0.01], [100.0, 100.0, 10.0, 10.0]
TRACK, FORCE = 1.5, 15.0  # m, N
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0])
START, NOISE, NEAR = 0.05, 0.002, 0.2  # standard deviations of the start and of each period, and what counts as there
Controller = Callable[[np.ndarray], tuple[np.ndarray, Report]]


def rates(x: Tensor, u: Tensor) -> Tensor:
    """Of x = [cart (m), angle from hanging (rad), their rates] under a force, N."""
    sine, cosine, turn, force = x[..., 1].sin(), x[..., 1].cos(), x[..., 3], u[..., 0]
    heavy = 1.0 + 0.1 * sine * sine
    push = (force + 0.1 * sine * (0.5 * turn * turn + 9.81 * cosine)) / heavy
    swing = (-force * cosine - 0.05 * turn * turn * cosine * sine - 1.1 * 9.81 * sine) / (0.5 * heavy)
    return torch.stack((x[..., 2], turn, push, swing), -1)


CART = FunctionDynamics(rates, 4, 1, DT, "rk4")


@dataclass
class Swings:
    """The periods of several swings."""

    first: list[float] = field(default_factory=list)  # s of the processor
    later: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    solved: int = 0
    up: int = 0


def problem() -> Problem:
    bounds = [ControlBounds([-FORCE], [FORCE]), StateBounds([-TRACK] + [-99.0] * 3, [TRACK] + [99.0] * 3)]
    return Problem(CART, QuadraticCost(Q, R, QF, x_ref=UPRIGHT), bounds, [[0.0] * 4], N)


def by_hand() -> ByHand:
    """The same as CasADi's users write it; -O3 would compile its 75 stages for longer than all else here takes."""
    import casadi as ca

    def rates(x: ca.SX, u: ca.SX) -> ca.SX:
        sine, cosine, turn, force = ca.sin(x[1]), ca.cos(x[1]), x[3], u[0]
        heavy = 1.0 + 0.1 * sine * sine
        push = (force + 0.1 * sine * (0.5 * turn * turn + 9.81 * cosine)) / heavy
        swing = (-force * cosine - 0.05 * turn * turn * cosine * sine - 1.1 * 9.81 * sine) / (0.5 * heavy)
        return ca.vertcat(x[2], turn, push, swing)

    return ByHand(rates, N, DT, Q, R, QF, [-FORCE], [FORCE], [TRACK, 99.0, 99.0, 99.0], "-O1")


def stepped() -> Callable[[], Controller]:
    """By `torchgco.MPC`, which each swing resets."""
    mpc = torchgco.MPC(problem())

    def control(x: np.ndarray) -> tuple[np.ndarray, Report]:
        u = mpc.step(x)
        return u.numpy(), lambda: (int(mpc.answer.iterations), mpc.statuses[0] == Status.CONVERGED)

    def begin() -> Controller:
        mpc.reset()
        return control

    return begin


def of_peer(peer: Peer) -> Callable[[], Controller]:
    """By a peer, whose swings begin from zeros."""
    blank, x_ref = peer.last, np.tile(UPRIGHT, (N + 1, 1))

    def begin() -> Controller:
        peer.last = dict(blank)
        return lambda x: peer(x, x_ref, np.zeros((0, 2)))

    return begin


def swing(begin: Callable[[], Controller], seeds: int) -> Swings:
    """From the start of each seed: 0 hangs at rest, others near there."""
    found = Swings()
    for seed in range(seeds):
        random, control = np.random.default_rng(seed), begin()
        x = START * (seed > 0) * random.standard_normal(4)
        for k in range(PERIODS):
            began = time.thread_time()
            u, report = control(x)
            (found.later if k else found.first).append(time.thread_time() - began)
            iterations, solved = report()
            found.iterations.append(iterations)
            found.solved += solved
            x = CART.step(torch.tensor(x[None]), torch.tensor(u[None]))[0].numpy() + NOISE * random.standard_normal(4)
        found.up += bool(np.abs(x - UPRIGHT).max() < NEAR)
    return found


def run(bench: Bench) -> None:
    """Ours, the peers, and ours again."""
    seeds = bench.sizes.swing_seeds
    case = f"{seeds} starts"
    cases = [("MPC", stepped())]
    cases += [(peer.name, of_peer(peer)) for peer in Peer.ready(by_hand(), bench.sizes.loop_compiled, ("fatrop",))]
    for name, begin in [*cases, ("MPC, again", stepped())]:
        found = swing(begin, seeds)
        times = 1000 * np.array(found.later)
        for quantity, value in (
            ("median", np.median(times)), ("99 %", np.quantile(times, 0.99)), ("max", times.max()),
            ("first period", 1000 * np.median(found.first)),
        ):  # fmt: skip
            bench.row(SECTION, case, name, quantity, float(value), "ms")
        bench.row(SECTION, case, name, "iterations", float(np.mean(found.iterations)))
        bench.row(SECTION, case, name, "solved", f"{found.solved}/{seeds * PERIODS}")
        bench.row(SECTION, case, name, "up", f"{found.up}/{seeds}")
