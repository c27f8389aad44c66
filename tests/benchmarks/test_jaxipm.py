"""jaxipm's scenarios: problem and judge agree, pools follow their rules, and two instances of each are solved."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks.outside.jaxipm import MX, OURS, PUBLISHED, TOLERANCE, by_ipopt, extremes, main, versus
from benchmarks.outside.jaxipm_problems import SCENARIOS, Scenario, centers, spread
from tests.slow import mostly
from torchgco import Status, judge
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.quality import violation

NAMED = {scenario.name: scenario for scenario in SCENARIOS}
# Of the first instance: by the published form of IPOPT at 1e-8.
KNOWN = {
    "navigation, 90 degrees": 498.304019, "navigation, 180 degrees": 497.919359, "tracking, pace 1.0": 291.024586,
    "tracking, pace 1.5": 547.347901, "tracking, pace 2.0": 1175.245067, "swap of 2": 753.970762,
    "swap of 4": 1522.209838,
}  # fmt: skip


def test_the_published_figures_are_of_these_scenarios() -> None:
    assert list(PUBLISHED) == list(NAMED) and [s.size for s in SCENARIOS] == [2000] * 2 + [1000] * 3 + [75] * 2


@pytest.mark.parametrize("scenario", SCENARIOS, ids=list(NAMED))
def test_the_problem_is_the_one_that_is_judged(scenario: Scenario) -> None:
    some = scenario.at(scenario.places(3))
    problem, (X0, U) = scenario.problem(some), scenario.guess(some)
    assert problem.B == 3 and torch.equal(X0[:, 0], some.x0) and bool(problem.start_is_clear.all())
    U = U + 0.02 * torch.randn(U.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    U[1, 5] += 1.0  # beyond its bounds
    X = open_loop(problem.dynamics, problem.x0, U)
    cost, worst = scenario.counted(some, U.numpy())
    torch.testing.assert_close(problem.cost.total(X, U), torch.from_numpy(cost), rtol=1e-9, atol=1e-9)
    lengths = scenario.family != "tracking"  # there the rows of cylinders are in m^2
    if lengths:
        torch.testing.assert_close(violation(problem.constraints, X, U), torch.from_numpy(worst), rtol=1e-9, atol=1e-9)
    assert worst[1] > 0.2


@pytest.mark.parametrize("name", ["tracking, pace 1.0", "swap of 2", "swap of 4"])
def test_what_keeps_clear_is_judged_in_metres(name: str) -> None:
    """Along hand-made states: vehicles inside a cylinder, upside down or too close to each other."""
    scenario = NAMED[name]
    X = scenario.guess(scenario.at(torch.arange(1)))[0].numpy().copy()
    assert scenario.missed(X) <= 0 or scenario.family == "tracking"
    if scenario.family == "tracking":
        X[..., :2], X[..., 3:7] = 0.0, [1.0, 0.0, 0.0, 0.0]
        X[0, 7, :2] = centers(np.array([7]))[0, 1] + [0.6, 0.0]
        assert scenario.missed(X) == pytest.approx(0.4)
        X[0, 9, 3:7] = 0.7
        assert scenario.missed(X) == pytest.approx(4 * 0.49 - 1.5)
    else:
        X[0, 4, 13:16] = X[0, 4, :3] + [0.0, 0.3, 0.4]
        assert scenario.missed(X) == pytest.approx(0.5)
        X[0, 29, 13:16] = X[0, 29, :3]  # the last knot has no rows
        assert scenario.missed(X) == pytest.approx(0.5)


def test_pools_follow_their_rules() -> None:
    swap = NAMED["swap of 4"].at(torch.arange(75))
    start = np.deg2rad(5) * (2 * np.mod(3 * 0.6180339887498949, 1) - 1)
    goal = start + np.deg2rad(5) * (2 * np.mod(3 * 0.41421356237309515, 1) - 1)
    for i in range(4):
        for part, angle in ((swap.x0[3], start), (swap.aim[3, 17], goal + np.pi)):
            place = 3 * np.array([np.cos(i * np.pi / 2 + angle), np.sin(i * np.pi / 2 + angle), 0])
            np.testing.assert_allclose(part[13 * i : 13 * i + 3], place, atol=1e-12)
    track = NAMED["tracking, pace 1.5"].at(torch.arange(1000))
    apart = np.linalg.norm(track.x0[:, None, :2].numpy() - centers(np.zeros(1))[0], axis=-1)
    assert apart.min() >= 1.1 and float((track.x0[:, :3] - track.aim[:, 0, :3]).std()) == pytest.approx(0.5, rel=0.05)
    speed = track.aim[:, 1:, :3].diff(dim=1).norm(dim=-1) / 0.1
    np.testing.assert_allclose(speed, track.aim[:, 1:-1, 7:10].norm(dim=-1), rtol=0.1)
    assert spread(10, 3).tolist() == [0, 4, 9] and spread(2, 5).tolist() == [0, 1]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", mostly(NAMED, *tuple(NAMED)[1::2], "swap of 4"))
def test_two_instances_are_solved_to_the_published_tolerance(name: str) -> None:
    scenario = NAMED[name]
    some = scenario.at(scenario.places(2))
    X0, U0 = scenario.guess(some)
    found = OURS.solve(scenario.problem(some), U0, X0=X0)
    cost, worst = scenario.counted(some, found.U.numpy())
    assert worst.max() <= TOLERANCE
    # The published swaps have no rows between the knots, where the optimum brings its vehicles nearer than 1 m.
    apart = judge(scenario.problem(some), found.U).clearance >= 0
    assert found.statuses == [Status.CONVERGED if clear else Status.INFEASIBLE for clear in apart.tolist()]
    assert bool(apart.all()) == (scenario.family != "swap")
    np.testing.assert_allclose(cost[0], KNOWN[scenario.name], rtol=1e-6)


@pytest.mark.slow
def test_ipopt_as_published_finds_the_same() -> None:
    """Model, rows and guess are written a second time in CasADi."""
    published, own = by_ipopt(NAMED["tracking, pace 1.0"], torch.arange(2))
    assert published.solver.iloc[0] == MX and published.converged.all() and own.converged.all()
    np.testing.assert_allclose(published.cost, own.cost, rtol=1e-6)
    assert published.cost[0] == pytest.approx(KNOWN["tracking, pace 1.0"], rel=1e-6)


def test_costs_are_compared_instance_by_instance() -> None:
    own = pd.DataFrame({"cost": [1.0, 2.0, 3.0, 4.0, 9.0], "converged": [True] * 5}, index=[0, 3, 6, 9, 12])
    peer = pd.DataFrame({"cost": [2.0 + 1e-7, 3.5, 3.0, 1.0], "converged": [True] * 3 + [False]}, index=[3, 6, 9, 12])
    own["violation"], peer["violation"] = 1e-3, 1e-3
    assert versus(own, peer) == "1, 1, 1" and extremes(own, peer) == "-14.3, +33.3"
    own["converged"], own["violation"] = False, [0.0, 0.0, 1e-9, 1e-5, 0.0]  # the fourth breaks rows
    assert versus(own, peer) == "1, 1, 0"


@pytest.mark.slow
def test_the_tables(capsys) -> None:
    assert main(["--instances", "3", "--ipopt", "2", "--scenarios", "navigation"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 22 and all(line.split(" | ")[3] == "3" for line in lines[3:5])
