"""python -m benchmarks.families.gates: gates drawn in forests, against IPOPT by hand, and the published race.

The layouts are those of `torchgco scenario=gates`: a quadrotor's planning model, balls of 0.5 m as gates, spheres
between them, and a duration for each leg. IPOPT, through CasADi's SX by hand, states the same problem as multiple
shooting; it begins with our states, controls and times, and knows the spheres within 3 m of our knots. Layouts are
flown in their order, for so many minutes of processor time. The race is that of `benchmarks.families.race`.
"""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import torch

import torchgco
from benchmarks.families.race import races
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from torchgco import Problem, Solution, Status
from torchgco.constraints.gates import GateBalls, gates_of
from torchgco.scenarios import Task

NEAR = 3.0  # m: spheres farther than this from our knot aren't rows of IPOPT's
EXACT = 5e-3  # share of IPOPT's duration
STAGES = (20, 80)  # of each leg of the race, one after the other
MARGIN = 1e-3  # m, of a plan that is aimed
BANDS = (3, 5), (6, 8), (9, 12)  # numbers of gates, a row of the table each


@dataclass(frozen=True)
class Flown:
    """What was found on a layout."""

    gates: int
    converged: bool
    passed: bool  # all gates, as judged between knots too
    sound: bool
    duration: float  # s
    iterations: int
    seconds: float  # of processor time
    by_hand: float | None = None  # s, where IPOPT solved it


def field(x: Any, u: Any, gravity: float, lag: float) -> Any:
    """x' of the planning model."""
    q = x[6:10] / ca.norm_2(x[6:10])
    w, a = x[10:13], x[13]
    axis = ca.vertcat(
        2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2
    )
    turn = 0.5 * ca.vertcat(
        -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
        q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
        q[0] * w[1] - q[1] * w[2] + q[3] * w[0],
        q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
    )
    return ca.vertcat(x[3:6], a * axis - ca.vertcat(0, 0, gravity), turn, (u[:3] - w) / lag, (u[3] - a) / lag)


def by_hand(problem: Problem, found: Solution) -> float | None:
    """The duration, s, that IPOPT finds from our trajectory; None where it finds none."""
    gates, time_ = gates_of(problem), problem.time
    assert isinstance(gates, GateBalls) and gates.places is not None and time_ is not None
    N, dt, legs = problem.N, problem.dynamics.dt, time_.count
    X0, U0 = found.X[0].numpy(), found.U[0].numpy()
    of_stages = time_.of_stages(N).tolist()
    tau0 = (found.t[0].diff().numpy() / dt)[[of_stages.index(leg) for leg in range(legs)]]
    X, U, tau = ca.SX.sym("X", 14, N + 1), ca.SX.sym("U", 4, N), ca.SX.sym("tau", legs)
    lag, gravity = problem.dynamics.rate_time_constant, problem.dynamics.airframe.gravity  # type: ignore[attr-defined]
    rows, low, high = [X[:, 0] - problem.x0[0].numpy()], [0.0] * 14, [0.0] * 14
    rest = problem.cost.rest_controls(problem.x0.new_zeros(1, 1, 4))[0, 0]
    at, one = problem.x0, torch.eye(4, dtype=rest.dtype)
    weights = [float(problem.cost.stage(at, (rest + one[i]).expand(1, 4), 0)) for i in range(4)]
    cost = 0.0
    for k in range(N):
        h, rates = tau[of_stages[k]] * dt, partial(field, u=U[:, k], gravity=gravity, lag=lag)
        k1 = rates(X[:, k])
        k2 = rates(X[:, k] + 0.5 * h * k1)
        k3 = rates(X[:, k] + 0.5 * h * k2)
        ahead = X[:, k] + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(X[:, k] + h * k3))
        ahead[6:10] = ahead[6:10] / ca.norm_2(ahead[6:10])
        rows.append(X[:, k + 1] - ahead)
        low, high = low + [0.0] * 14, high + [0.0] * 14
        beside = sum(w * (U[i, k] - rest[i].item()) ** 2 for i, w in enumerate(weights))
        cost += tau[of_stages[k]] * (float(time_.weight[0]) * dt + beside)
    goal = problem.goal
    assert goal is not None
    balls = [*zip(gates.places[0].tolist(), gates.centers[0].numpy(), gates.sizes[0].tolist(), strict=True),
             (N, goal.position[0].numpy(), float(goal.radius[0]))]  # fmt: skip
    for k, center, radius in balls:
        rows.append(ca.sumsqr(X[:3, k] - center))
        low, high = [*low, -ca.inf], [*high, radius**2]
    spheres = problem.obstacles[0]
    there = ~spheres.absent[0]
    held = spheres.centers[0, there].numpy(), spheres.inflated_radii[0, there].tolist()  # type: ignore[attr-defined]
    for center, radius in zip(*held, strict=True):
        for k in (np.linalg.norm(X0[:, :3] - center, axis=1) < radius + NEAR).nonzero()[0]:
            if k > 0:
                rows.append(ca.sumsqr(X[:3, k] - center))
                low, high = [*low, radius**2], [*high, ca.inf]
    bounds = problem.control_bounds
    assert bounds is not None
    lower, upper = (b[0, 0].numpy() for b in bounds.by_knot)
    free = np.full(14 * (N + 1), np.inf)
    lbx = np.concatenate((-free, np.tile(lower, N), time_.least[0].numpy()))
    ubx = np.concatenate((free, np.tile(upper, N), time_.most[0].numpy()))
    z = ca.vertcat(ca.vec(X), ca.vec(U), tau)
    options = {"ipopt.print_level": 0, "print_time": False, "ipopt.max_iter": 1000, "ipopt.mu_init": 1e-3}
    solver = ca.nlpsol("hand", "ipopt", {"x": z, "f": cost, "g": ca.vertcat(*rows)}, options)
    end = solver(x0=np.concatenate((X0.ravel(), U0.ravel(), tau0)), lbx=lbx, ubx=ubx, lbg=low, ubg=high)
    if not solver.stats()["success"]:
        return None
    taus = np.array(end["x"]).ravel()[-legs:]
    return float(sum(taus[leg] * dt for leg in of_stages))


def layout_flown(task: Task, solver: Any, number: int, ask: bool) -> Flown:
    """One layout, solved by itself."""
    problem = task.problem
    began = time.process_time()
    found = solver.solve(problem, task.U0, ids=torch.tensor([number]))
    spent = time.process_time() - began
    verdict = torchgco.judge(problem, found.U, times=found.t)
    gates = int(task.layouts.gate_counts[0])  # type: ignore[index]
    sound = bool(verdict.reached)
    hand = by_hand(problem, found) if ask and sound else None
    one = Flown(gates, found.statuses[0] is Status.CONVERGED, int(verdict.gates_passed) == gates, sound,
                float(found.duration), int(found.iterations), spent, hand)  # fmt: skip
    print(number, one, file=sys.stderr, flush=True)
    return one


def text(count: int, seed: int, ipopt: int, minutes: float, tracks: int, moved: int) -> str:
    """The tables of forests and race."""
    race = races(STAGES, MARGIN, tracks, moved)
    print(race, file=sys.stderr, flush=True)
    return f"{table(forests(count, seed, ipopt, minutes))}\n\n{race}"


def forests(count: int, seed: int, ipopt: int, minutes: float) -> list[Flown]:
    """Layouts from the first on, until the minutes of processor time are over, or Ctrl-C."""
    setup = torchgco.compose(["scenario=gates", f"seed={seed}"])
    layouts, flown, began = setup.layouts(count), list[Flown](), time.process_time()
    with suppress(KeyboardInterrupt):
        for number in range(count):
            task = setup.task(layouts.take([number]))
            setup.solver.solve(task.problem, task.U0, max_seconds=1e-3)  # compiles
            flown.append(layout_flown(task, setup.solver, number, number < ipopt))
            if time.process_time() - began > 60.0 * minutes:
                break
    return flown


def table(flown: list[Flown]) -> str:
    """Of what was flown, by the number of gates."""
    rows = []
    for low, high in (*BANDS, (BANDS[0][0], BANDS[-1][1])):
        some = [one for one in flown if low <= one.gates <= high]
        if some:
            rows.append([f"{low} to {high}", *_row(some)])
    head = ["gates", "passed and clear", "duration, s", "s a layout (most)",
            "longer than IPOPT by hand by over 0.5 %", "duration / IPOPT's (most)"]  # fmt: skip
    return markdown(head, rows)


def _row(some: list[Flown]) -> list[object]:
    good = [one for one in some if one.sound and one.passed]
    ratios = [one.duration / one.by_hand for one in some if one.by_hand is not None]
    seconds = [one.seconds for one in some]
    return [
        share(len(good), len(some)),
        f"{np.median([one.duration for one in some]):.2f}",
        f"{np.median(seconds):.1f} ({max(seconds):.1f})",
        f"{sum(ratio > 1.0 + EXACT for ratio in ratios)} of {len(ratios)}",
        f"{np.median(ratios):.4f} ({max(ratios):.4f})" if ratios else "-",
    ]  # fmt: skip


main = Command(
    __doc__,
    "gates",
    text,
    "layouts of seed {seed}, at most {count}, for at most {minutes} minutes; IPOPT on the first {ipopt} of them; "
    "{tracks} tracks moved by seed {moved}, the worst of these; a margin of 1 mm where a plan is aimed",
    "CasADi",
    count=(64, "layouts"),
    seed=(12, "of the layouts; constants were chosen on others"),
    ipopt=(16, "layouts that IPOPT solves, too"),
    minutes=(30.0, "of processor time, after which no further layout is begun"),
    tracks=(10, "races with moved gates"),
    moved=(7, "the seed of these"),
)

if __name__ == "__main__":
    raise SystemExit(main())
