"""The benchmark of cars among discs: what it draws and what it counts."""

from __future__ import annotations

import pandas as pd
import torch

from benchmarks.families.discs import HEAD, OWN, PEERS, cars, compared


def test_ends_are_free_of_discs_and_draws_depend_on_the_seed_alone() -> None:
    problems, again = cars(3, 6), cars(3, 8)
    for problem, same in zip(problems, again, strict=False):
        assert problem.goal is not None and same.goal is not None
        goal = problem.goal.position.reshape(2)
        ends, rest = torch.stack((problem.x0[0, :2], goal)).unsqueeze(0), torch.zeros(2, dtype=goal.dtype)
        assert (problem.obstacles[0].signed_distance(ends, rest) > 0.29).all() and (
            goal == same.goal.position.reshape(2)
        ).all()


def test_lost_and_more_expensive_are_counted_against_those_that_arrive() -> None:
    """Problem 0: above a peer; 1: cheaper, but the peer alone arrives; 2: above one that doesn't arrive."""
    peer = pd.DataFrame({"problem": range(3), "cost": 10.0, "feasible": True, "reached": [True, True, False],
                         "seconds": 0.1, "iterations": 5})  # fmt: skip
    own = peer.assign(solver=OWN, cost=[10.1, 9.0, 11.0], reached=[True, False, True], seconds=[0.2, 0.2, 0.9])
    flights = pd.concat([own, *(peer.assign(solver=name) for name in PEERS)])
    cells = dict(zip(HEAD, compared(flights, OWN), strict=True))
    assert cells["lost"] == 1 and cells["over 0.1 % more expensive"] == 1
    assert str(cells[HEAD[-2]]).startswith("2 [") and str(cells[HEAD[-1]]).startswith("9 [")
