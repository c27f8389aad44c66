"""Fleets that nobody can plan have a status, and the others of their batch don't notice."""

from __future__ import annotations

import pytest
import torch

import torchgco
from tests.fleets.scenes import disc
from torchgco import Fleet, FleetSolution, Spheres


@pytest.mark.slow
def test_a_start_that_is_not_finite_is_lost_alone() -> None:
    nan = float("nan")
    members = [disc([[0, 0], [0, 0]], [[4, 0], [4, 0]]), disc([[4, 0], [nan, 0]], [[0, 0.1], [0, 0.1]])]
    found = torchgco.solve(Fleet(members, 0.4))
    assert found.sound.tolist() == [True, False] and found.verdict.apart.tolist() == [[True] * 2, [False] * 2]
    assert bool(found.makespan.isnan()[1]) and "1 sound; cost 2" in repr(found)
    assert [torchgco.Status(number).name for number in found.status.tolist()] == ["FEASIBLE", "INFEASIBLE"]
    assert found[1].statuses[1].name == "NON_FINITE"
    alone = torchgco.solve(Fleet([member.take(torch.tensor([0])) for member in members], 0.4))
    assert all(torch.equal(mine.U[0], yours.U[0]) for mine, yours in zip(found, alone, strict=True))


def test_who_starts_inside_an_obstacle_ends_the_planning_of_its_fleet() -> None:
    stone = Spheres([[2.0, 1.0]], [0.5], 0.2)
    found = torchgco.solve(Fleet([disc([2, 1], [0, 0], stone), disc([4, 0], [0, 1], stone)], 0.4))
    assert found[0].statuses[0].name == "INVALID_START" and not bool(found.sound[0])
    assert torchgco.Status(int(found.status[0])).name == "INVALID_START"


def test_vehicles_that_touch_at_the_start_are_lost_with_their_fleet_alone() -> None:
    members = [disc([[0, 0], [0, 0]], [[4, 0], [4, 0]]), disc([[4, 0], [0.2, 0]], [[0, 0.1], [0, 0.1]])]
    members.append(disc([[2, 2], [2, 2]], [[2, -2], [2, -2]]))
    found = torchgco.solve(Fleet(members, 0.4))
    assert found.sound.tolist() == [True, False] and not bool(found.verdict.apart[1, :2].any())
    assert torchgco.Status(int(found.status[1])).name == "INVALID_START"
    assert [one.statuses[1].name == "INVALID_START" for one in found] == [True, True, False]
    alone = torchgco.solve(Fleet([member.take(torch.tensor([0])) for member in members], 0.4))
    assert all(torch.equal(mine.U[0], yours.U[0]) for mine, yours in zip(found, alone, strict=True))
    with pytest.raises(torchgco.InputError, match="vehicles for which plans are found that keep them apart"):
        torchgco.FleetMPC(Fleet(members, 0.4))


def test_controls_alone_make_a_solution() -> None:
    fleet = Fleet([disc([0, 0], [4, 0]), disc([4, 0.3], [0, 0.3])], 0.2)
    found = torchgco.solve(fleet)
    again = FleetSolution.of(fleet, [one.U for one in found])
    assert bool(again.sound[0]) and torchgco.Status(int(again.status[0])).name == "FEASIBLE"
    for mine, yours in zip(again, found, strict=True):
        torch.testing.assert_close(mine.X, yours.X, rtol=0, atol=1e-6)


def test_no_fleets_at_all() -> None:
    found = torchgco.solve(Fleet([disc([0, 0], [4, 0]), disc([4, 0], [0, 0])], 0.4).take([]))
    assert len(found) == 2 and len(found.sound) == 0 and repr(found).endswith("cost unknown)")
