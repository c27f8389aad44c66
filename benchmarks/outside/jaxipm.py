"""python -m benchmarks.outside.jaxipm: the seven scenarios of jaxipm at 1e-8, beside IPOPT and the published figures.

Whole pools are solved in one thread from the published guess, by `InteriorPoint` and by the default solver; IPOPT
solves some instances, as published and as this package states them. All results are judged in NumPy by
`Scenario.counted`. With --write the tables go into benchmarks/results/jaxipm.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import torchgco
from benchmarks.lib import comparison as lib
from benchmarks.lib.command import Command
from benchmarks.lib.page import chosen, filed, markdown
from benchmarks.outside.jaxipm_ipopt import Ipopt
from benchmarks.outside.jaxipm_problems import SCENARIOS, Scenario, spread
from torchgco import InteriorPoint, Status
from torchgco.baselines import CasADiSolver

TOLERANCE = 1e-8  # the published one
OURS = InteriorPoint(tolerance=0.1 * TOLERANCE, violation_tolerance=TOLERANCE)
IPOPT = CasADiSolver("ipopt", 500, TOLERANCE, options={"warm_start_init_point": "yes"})
SAME = 1e-6  # relative difference of costs up to which two solvers have found the same optimum
FEWER = 4  # a swap takes many times as long as the other scenarios: IPOPT solves so many times fewer of them
INTERIOR, DEFAULT, MX, SX = "`InteriorPoint`", "`torchgco.solve`, defaults", "IPOPT, MX as published", "IPOPT, SX"


class Published(NamedTuple):
    """Problems per second, and mean costs: tests/rebuttal/results of jaxipm, commit d32c145, at a tolerance of 1e-8."""

    jaxipm: float  # paper_tables.md, row jaxipm-IL: on an L40S
    ipopt_64: float  # the same, row IPOPT-64: 64 processes on two EPYC 9354
    ipopt: float  # e1_cpu_scaling_tol1e-08.md, P = 1: on one of their cores; of swaps, one fixed instance
    jaxipm_cost: float
    ipopt_cost: float


PUBLISHED = {
    "navigation, 90 degrees": Published(89.03, 280.7, 7.66, 518.0, 517.0),
    "navigation, 180 degrees": Published(95.45, 310.9, 8.44, 507.6, 507.6),
    "tracking, pace 1.0": Published(92.49, 234.7, 6.51, 244.0, 265.7),
    "tracking, pace 1.5": Published(81.76, 185.4, 5.18, 539.2, 556.7),
    "tracking, pace 2.0": Published(73.71, 105.4, 2.99, 1142.4, 1146.7),
    "swap of 2": Published(18.42, 26.38, 0.40, 755.5, 755.5),
    "swap of 4": Published(4.54, 13.99, 0.14, 1533.7, 1529.7),
}


def excess(own: pd.DataFrame, peer: pd.DataFrame) -> pd.Series:
    """By which share costs exceed the peer's, on the instances that both solved."""
    both = own.index.intersection(peer.index)
    one, other = own.loc[both], peer.loc[both]
    return (one.cost / other.cost - 1)[is_solved(one) & is_solved(other)]


def versus(own: pd.DataFrame, peer: pd.DataFrame) -> str:
    """On how many of these instances the cost is the same, lower and higher."""
    over = excess(own, peer)
    return f"{(over.abs() <= SAME).sum()}, {(over < -SAME).sum()}, {(over > SAME).sum()}"


def extremes(own: pd.DataFrame, peer: pd.DataFrame) -> str:
    """The least and the largest excess, in percent."""
    over = 100.0 * excess(own, peer)
    return f"{over.min():+.3g}, {over.max():+.3g}" if len(over) else "-"


def is_solved(flight: pd.DataFrame) -> pd.Series:
    """Whether instances count by the published rule: by rows at the knots, which plans that touch between them keep."""
    return flight.converged | (flight.violation <= 100 * TOLERANCE)


def solved(flight: pd.DataFrame) -> pd.Series:
    """The costs of the instances that were solved, which the published ones are of, too."""
    return flight.cost[is_solved(flight)]


def rate(flight: pd.DataFrame) -> float:
    """Problems per second."""
    return 1.0 / flight.seconds.mean()


COLUMNS: list[tuple[str, lib.Column]] = [
    ("scenario", lib.named("scenario")),
    ("solver", lib.named("solver")),
    ("n", lib.count),
    ("CONVERGED", lambda own, peer: int(own.converged.sum())),
    ("violation <= 1e-8", lambda own, peer: int((own.violation <= TOLERANCE).sum())),
    ("largest violation", lib.worst("violation")),
    ("cost, mean and deviation", lambda own, peer: f"{solved(own).mean():.1f}, {solved(own).std():.1f}"),
    ("cost as IPOPT's (MX), lower, higher", versus),
    ("least and largest excess over it, %", extremes),
    ("iterations, mean and largest", lambda own, peer: f"{own.iterations.mean():.1f}, {own.iterations.max()}"),
    ("problems per second", lambda own, peer: f"{rate(own):.3g}" if rate(own) < 100 else f"{rate(own):.0f}"),
]


def flight(scenario: Scenario, places: Tensor, solver: str, U: Tensor, **more: object) -> pd.DataFrame:
    """A row per instance, by its place in the pool."""
    cost, violation = scenario.counted(scenario.at(places), U.numpy())
    held = {"scenario": scenario.name, "solver": solver, "cost": cost, "violation": violation, **more}
    return pd.DataFrame(held, index=places.tolist())


def by_torchgco(scenario: Scenario, places: Tensor) -> list[pd.DataFrame]:
    """Instances as one batch: by the interior point from the published guess, and with default options."""
    some = scenario.at(places)
    problem, (X0, U0) = scenario.problem(some), scenario.guess(some)
    solvers = {
        INTERIOR: lambda p, X, U: OURS.solve(p, U, X0=X),
        DEFAULT: lambda p, X, U: torchgco.solve(p),
    }
    flights = []
    for name, solve in solvers.items():
        solve(problem.take(slice(0, 2)), X0[:2], U0[:2])  # compiles
        found, seconds = lib.timed(partial(solve, problem, X0, U0))
        ended = {"converged": (found.status == Status.CONVERGED).numpy(), "iterations": found.iterations.numpy()}
        flights.append(flight(scenario, places, name, found.U, seconds=seconds / problem.B, **ended))
    return flights


def by_ipopt(scenario: Scenario, places: Tensor) -> list[pd.DataFrame]:
    """Instances one after the other, as published and by `CasADiSolver`, without the time to build programs."""
    some = scenario.at(places)
    problem, guess = scenario.problem(some), scenario.guess(some)
    published = Ipopt(scenario, TOLERANCE)
    published.solve(some, 0, guess)  # builds the solver
    U, iterations, ends, seconds = zip(*(published.solve(some, i, guess) for i in range(problem.B)), strict=True)
    held = {"converged": ends, "iterations": iterations, "seconds": seconds}
    flights = [flight(scenario, places, MX, torch.from_numpy(np.stack(U)), **held)]
    prepared = IPOPT.prepare(problem)
    found, whole = lib.timed(lambda: prepared.solve(problem, guess[1], X0=guess[0]))
    ended = {"converged": (found.status == Status.CONVERGED).numpy(), "iterations": found.iterations.numpy()}
    return [*flights, flight(scenario, places, SX, found.U, seconds=whole / problem.B, **ended)]


def tables(instances: int, ipopt: int, scenarios: Sequence[str]) -> str:
    """What was measured, and below it the rates beside the published ones, in Markdown."""
    rows, rates = [], []
    for scenario in SCENARIOS:
        if scenario.family not in scenarios:
            continue
        few = max(1, ipopt // FEWER) if scenario.family == "swap" else ipopt
        places = scenario.places(instances)
        flights = [*by_torchgco(scenario, places), *by_ipopt(scenario, places[spread(len(places), few)])]
        rows += [[column(each, flights[2]) for _, column in COLUMNS] for each in flights]
        rates.append(_beside(scenario.name, dict(zip((INTERIOR, DEFAULT, MX, SX), flights, strict=True))))
    beside = markdown(HEAD, rates)
    return filed(
        "jaxipm", markdown([name for name, _ in COLUMNS], rows), filed("jaxipm-rates", beside, chosen(beside, SHOWN))
    )


HEAD = [
    "scenario", "`InteriorPoint`, one core, this machine", "IPOPT SX, the same core", "IPOPT MX, the same core",
    "jaxipm, NVIDIA L40S", "IPOPT MX, 64 processes, 2 x EPYC 9354", "IPOPT MX, one of these cores",
    "times jaxipm", "times IPOPT, 64 processes", "mean cost", "jaxipm's", "IPOPT's",
]  # fmt: skip
SHOWN = [*HEAD[:3], *HEAD[4:6], *HEAD[7:9]]  # in the page


def _beside(name: str, flights: dict[str, pd.DataFrame]) -> list[str]:
    """Problems per second by hardware, and mean costs over the pool."""
    there, own = PUBLISHED[name], flights[INTERIOR]
    here = [rate(flights[solver]) for solver in (INTERIOR, SX, MX)]
    shown = [*here, there.jaxipm, there.ipopt_64, there.ipopt]
    times = [here[0] / there.jaxipm, here[0] / there.ipopt_64]
    costs = [solved(own).mean(), there.jaxipm_cost, there.ipopt_cost]
    cells = [*(f"{x:.3g}" if x < 1000 else f"{x:.0f}" for x in [*shown, *times]), *(f"{x:.1f}" for x in costs)]
    return [name, *cells]


main = Command(
    __doc__, "jaxipm", tables,
    "at most {instances} instances per scenario, {ipopt} for IPOPT (of swaps a quarter)", "CasADi",
    instances=(2000, "instances per scenario, at most its pool"), ipopt=(40, "of them for IPOPT, of swaps a quarter"),
    scenarios=(["navigation", "tracking", "swap"], "families", ["navigation", "tracking", "swap"]),
)  # fmt: skip


if __name__ == "__main__":
    raise SystemExit(main())
