"""python -m benchmarks.families.discs: cars among one to five discs, and two problems with a trap, alone.

The way is easily seen in the plane, so a search has to earn its time: `gco` is compared with interior points from rest,
ours and IPOPT, by cost and time. Each problem is solved alone, in one thread. With --write the tables go into
benchmarks/results/discs.md.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Sequence
from typing import Any

import pandas as pd
import torch
from torch import Tensor

import torchgco
from benchmarks.families.floors import median
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from benchmarks.lib.page import markdown, measured, put, share, shown
from torchgco import ControlBounds, FunctionDynamics, Goal, Problem, QuadraticCost, Spheres

OWN, PEERS = "gco", ("interior_point", "ipopt")
LITTLE = 1e-3  # share of the cost, up to which two count as equal
LENGTH = 2.5  # wheelbase, m
RADIUS = 0.5  # of the car, m
D = torch.float64
HEAD = (
    "solver", "n", "at the goal", "lost", "over 0.1 % more expensive", "iterations, most", "s, median",
    f"time / `{PEERS[0]}` where that arrives, median [95 %]", "where it doesn't",
)  # fmt: skip
TRAP_HEAD = ("problem", "known to exist", *(f"`{name}`" for name in (OWN, *PEERS)), "iterations of `gco`")


def car(x: Tensor, u: Tensor) -> Tensor:
    """Position, heading and speed of a kinematic bicycle; acceleration and steering angle."""
    heading, speed = x[..., 2], x[..., 3]
    return torch.stack((speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / LENGTH, u[..., 0]), -1)


def drifting(share_of: float) -> Any:
    """The same car with a constant drift in all states."""
    drift = share_of * torch.tensor([0.1, -0.2, 0.15, 0.1], dtype=D)
    return lambda x, u: car(x, u) + drift


def cars(seed: int, count: int, least: int = 1, most: int = 5) -> list[Problem]:
    """Drawn problems, one to five discs each: goals 8 to 12 m away, discs near the straight way, none at its ends."""
    drawn = torch.Generator().manual_seed(seed)
    uniform = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=drawn, dtype=D)
    problems = []
    for _ in range(count):
        discs = int(torch.randint(least, most + 1, (1,), generator=drawn))
        goal = torch.cat((uniform(8.0, 12.0, 1), uniform(-2.0, 2.0, 1)))
        radii, centers = uniform(0.4, 1.0, discs), torch.empty(0, 2, dtype=D)
        while len(centers) < discs:
            at = uniform(0.15, 0.85, 1) * goal + torch.cat((torch.zeros(1, dtype=D), uniform(-1.5, 1.5, 1)))
            gap = radii[len(centers)] + RADIUS + 0.3
            if at.norm() > gap and (at - goal).norm() > gap:
                centers = torch.cat((centers, at.unsqueeze(0)))
        problems.append(problem_of(car, goal, centers, radii))
    return problems


def problem_of(field: Any, goal: Tensor, centers: Tensor, radii: Tensor) -> Problem:
    model = FunctionDynamics(field, n=4, m=2, dt=0.1, integrator="rk4", position=slice(0, 2))
    x_ref = torch.cat((goal, torch.zeros(2, dtype=D)))
    cost = QuadraticCost(Q=[1, 1, 0.1, 0.1], R=[0.1, 1.0], Qf=[10, 10, 1, 1], x_ref=x_ref)
    rows = [ControlBounds([-3, -0.5], [3, 0.5]), Spheres(centers, radii, vehicle_radius=RADIUS)]
    return Problem(model, cost, rows, torch.zeros(1, 4, dtype=D), 50, goal=Goal(position=goal, radius=0.3))


def pendulum(angle: float) -> Problem:
    """A pendulum at rest, some rad from upright, with less torque than a swing-up from there needs at once."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 9.81 * x[..., 0].sin() - 0.1 * x[..., 1] + u[..., 0]), -1)

    model = FunctionDynamics(field, n=2, m=1, dt=0.05, integrator="rk4")
    cost = QuadraticCost(Q=[1, 0.1], R=[0.1], Qf=[100, 10], x_ref=[0.0, 0.0])
    x0 = torch.tensor([[angle, 0.0]], dtype=D)
    return Problem(model, cost, [ControlBounds([-5.0], [5.0])], x0, 60)


def solved(name: str, problem: Problem) -> dict[str, Any]:
    """One problem alone, judged, with the processor time it took; the form was solved before."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        begun = time.process_time()
        solution = torchgco.solve(problem, solver=name, verbose=False)
        seconds = time.process_time() - begun
    verdict = torchgco.judge(problem, solution.U)
    return {
        "solver": name, "status": solution.statuses[0].name, "seconds": seconds, "cost": float(verdict.cost),
        "feasible": bool(verdict.feasible), "reached": bool(verdict.reached), "iterations": int(solution.iterations),
    }  # fmt: skip


def compared(flights: pd.DataFrame, name: str) -> list[Any]:
    """A row: lost are goals that another solver reaches; costs are compared with those of the best of the peers."""
    by = {one: flights[flights["solver"] == one].set_index("problem") for one in (OWN, *PEERS)}
    own, n = by[name], len(by[name])
    others = [by[one] for one in PEERS if one != name]
    lost = sum(bool(any(peer["reached"][q] for peer in others) and not own["reached"][q]) for q in own.index)
    better = [peer["feasible"] & (peer["reached"] | ~own["reached"]) for peer in others]
    best = pd.concat([peer["cost"].where(rows) for peer, rows in zip(others, better, strict=True)], axis=1).min(axis=1)
    above = int((own["cost"] > best * (1.0 + LITTLE)).sum())
    ratio, arrives = own["seconds"] / by[PEERS[0]]["seconds"], by[PEERS[0]]["reached"]
    times = ["1", "1"] if name == PEERS[0] else [median(ratio[rows], ".2g") for rows in (arrives, ~arrives)]
    return [
        f"`{name}`", n, share(own["reached"].sum(), n), lost, above, int(own["iterations"].max()),
        shown(float(own["seconds"].median()), ".2g"), *times,
    ]  # fmt: skip


def traps() -> list[list[Any]]:
    """Problems on which solvers are known to miss the better minimum: drifting cars, nearly upright pendulums."""
    goal, disc = torch.tensor([10.0, 1.0], dtype=D), torch.tensor([[5.0, 0.2]], dtype=D)
    named = [
        (f"car with a drift of {drift:g}", known, problem_of(drifting(drift), goal, disc, torch.tensor([0.8], dtype=D)))
        for drift, known in ((0.01, 781.0), (0.05, 780.2))
    ]
    named += [
        (f"pendulum {angle:g} rad from upright", known, pendulum(angle))
        for angle, known in ((0.0123, 0.0102), (0.1, 0.67), (0.3, 6.0), (0.5, 24.6))
    ]
    rows = []
    for what, known, problem in named:
        found = [solved(name, problem) for name in (OWN, *PEERS)]
        rows.append([what, known, *(shown(one["cost"], ".4g") for one in found), found[0]["iterations"]])
    return rows


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/discs.md")
    parser.add_argument("--problems", type=int, default=64)
    parser.add_argument("--seed", type=int, default=72)
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    for discs in range(1, 6):  # compiles
        for name in (OWN, *PEERS):
            solved(name, cars(0, 1, discs, discs)[0])
    flights = []
    for number, problem in enumerate(cars(asked.seed, asked.problems)):
        flights += [{"problem": number} | solved(name, problem) for name in (OWN, *PEERS)]
        print(f"{number + 1} of {asked.problems}", file=sys.stderr)
    table = pd.DataFrame(flights)
    rows = [compared(table, name) for name in (OWN, *PEERS)]
    print(markdown(HEAD, rows))
    trap_rows = traps()
    print(markdown(TRAP_HEAD, trap_rows))
    if asked.write:
        how = f"{asked.problems} drawn cars of seed {asked.seed}, each solved alone"
        put(RESULTS / "discs.md", "cars", f"{measured(how)}\n\n{markdown(HEAD, rows)}")
        put(RESULTS / "discs.md", "traps", f"{measured('each solved alone')}\n\n{markdown(TRAP_HEAD, trap_rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
