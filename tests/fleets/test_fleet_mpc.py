"""Fleets in a loop: what is flown is apart, and arrives, with disturbed states too."""

from __future__ import annotations

from itertools import combinations

import pytest
import torch
from torch import Tensor

import torchgco
from tests.fleets.scenes import DT, D, disc, swaps
from torchgco import Fleet, FleetMPC, InputError


def test_vehicles_plan_among_each_others_plans_and_stay_apart() -> None:
    """Three swap places, pushed by a wind that no plan knows; places between the knots are in closed form."""
    fleet = Fleet(swaps(3), apart=0.4)
    mpc = FleetMPC(fleet)
    assert mpc.period == DT and bool(mpc.first.sound.all())
    x = [member.x0.clone() for member in fleet.members]
    rng = torch.Generator().manual_seed(0)
    least, adopted = torch.inf, 0
    for _ in range(50):
        controls = mpc.step(x)
        adopted += int(mpc.adopted.sum())
        wind = [0.02 * torch.randn(1, 2, generator=rng, dtype=D) for _ in x]
        for s in torch.linspace(0.1, 1.0, 10, dtype=D) * DT:
            p = [_moved(state, u + w, s)[:, :2] for state, u, w in zip(x, controls, wind, strict=True)]
            least = min(least, *(float((a - b).norm()) for a, b in combinations(p, 2)))
        x = [_moved(state, u + w, torch.tensor(DT, dtype=D)) for state, u, w in zip(x, controls, wind, strict=True)]
    assert least > 0.95 * 0.4 - 0.01 and adopted > 75  # of 150
    for member, state in zip(fleet.members, x, strict=True):
        assert member.goal is not None and float((state[:, :2] - member.goal.position).norm()) < 0.3


def _moved(x: Tensor, u: Tensor, s: Tensor) -> Tensor:
    return torch.cat((x[:, :2] + s * x[:, 2:] + 0.5 * s * s * u, x[:, 2:] + s * u), dim=-1)


def test_plans_that_touch_one_in_force_are_not_adopted() -> None:
    fleet = Fleet([disc([0.0, 0.0], [2.0, 0.0]), disc([0.0, 1.0], [2.0, 1.0]), disc([0.0, 3.0], [2.0, 3.0])], 0.4)
    mpc = FleetMPC(fleet)
    p, good = mpc._places(), torch.tensor([True])
    before = mpc.plans[0]
    mpc.adopted[:] = False
    X = before.X.clone()
    X[..., 1] += 0.65
    mpc._adopt(0, torchgco.receding.plan.replace(before, X=X), good, p)
    assert not bool(mpc.adopted[0, 0]) and torch.equal(mpc.plans[0].X, before.X)
    X = before.X.clone()
    X[..., 1] -= 0.65
    mpc._adopt(0, torchgco.receding.plan.replace(before, X=X), ~good, p)
    assert not bool(mpc.adopted[0, 0])
    mpc._adopt(0, torchgco.receding.plan.replace(before, X=X), good, p)
    assert bool(mpc.adopted[0, 0]) and torch.equal(mpc.plans[0].X, X) and torch.equal(p[0, 0], X[0, :, :2])
    with pytest.raises(InputError, match=r"x: expected states \(B, n\) of each of 3 vehicles"):
        mpc.step(torch.zeros(3, 4))  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"x\[1\]: expected shape \(1, 4\), got \(1, 3\)"):
        mpc.step([torch.zeros(1, 4), torch.zeros(1, 3), torch.zeros(1, 4)])
    with pytest.raises(InputError, match=r"fleet: expected a Fleet, got list"):
        FleetMPC(list(fleet.members))  # type: ignore[arg-type]
