"""Ways that vehicles negotiate, those who plan again where somebody is lost, and lattices that are kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import torchgco
from benchmarks.families.fleet_scenes import discs
from tests.fleets.scenes import DISC, D, disc
from torchgco import Boxes, Fleet, Spheres
from torchgco.dynamics.rollout import open_loop
from torchgco.fleets import solve
from torchgco.fleets.among import BESIDE, SOLVER, Among
from torchgco.fleets.forces import responses
from torchgco.fleets.negotiated import DEARER, DEAREST, Negotiated
from torchgco.fleets.replanned import Replanned
from torchgco.fleets.solve import alone
from torchgco.fleets.verdict import judge_fleet
from torchgco.lagrangian.kkt import RightSides
from torchgco.problem.known import Known
from torchgco.roadmap.timed import PARTS, library_for
from torchgco.sensitivity.points import rows_in_barrier, solve_at

ONE = torch.tensor([0])


@pytest.fixture(autouse=True)
def searched() -> None:
    if library_for(2) is None:
        pytest.skip("no compiler")


def forms_of(fleet: Fleet) -> list[Among]:
    return [Among(problem, Known()) for problem, _ in fleet.forms]


def in_the_door(*starts: float) -> Fleet:
    """The first comes to rest in a door before the second can be there; fleets differ in where the second starts."""
    walls, B = Boxes([[0.0, 2.5], [0.0, -2.5]], [[0.1, 2.0], [0.1, 2.0]], 0.2), len(starts)
    first = disc([[-1.0, 0.0]] * B, [[0.0, 0.0]] * B, walls)
    return Fleet([first, disc([[x, 0.1] for x in starts], [[-2.5, 0.1]] * B, walls)], 0.4)


def test_ways_are_negotiated_until_nobody_meets_another_one() -> None:
    """Who stops in a door lets the other pass, in whatever order they have turns."""
    fleet = in_the_door(2.5)
    first = alone(fleet, torchgco.solve, 0, ONE, "gco")
    assert not bool(judge_fleet(fleet, first.U).feasible[0])
    for order in ([0, 1], [1, 0]):
        teams = Negotiated(fleet, forms_of(fleet), ONE, first, [order])
        assert bool(teams.meets.any()) and float(teams.cost[0]) == math.inf
        plans = teams.run()
        assert not bool(teams.meets.any())
        each = zip(fleet.members, plans.X, plans.U, strict=True)
        assert torch.equal(teams.cost, torch.stack([one.cost.total(x, u) for one, x, u in each]).sum(0))
        p = fleet.places(plans.X)[0]
        assert float((p[0] - p[1]).norm(dim=-1).min()) > 0.95 * 0.4
        for one, x, u in zip(fleet.members, plans.X, plans.U, strict=True):
            torch.testing.assert_close(open_loop(DISC, one.x0, u), x, rtol=0, atol=1e-5)
        best, forms = solve._Best(fleet, first, 0, ONE), forms_of(fleet)
        solve._improve(best, forms, ONE, plans, lambda: False)
        assert bool(best.verdict.reached[0])


def test_the_price_of_two_rises_while_they_meet() -> None:
    fleet = in_the_door(2.5)
    first = alone(fleet, torchgco.solve, 0, ONE, "gco")
    teams = Negotiated(fleet, forms_of(fleet), ONE, first, [[0, 1]])
    teams._go(0, 0, torchgco.roadmap.timed.TimedWays([], np.zeros(0), 1.0))  # finds no way
    assert teams.dearer[0].tolist() == [[1.0, DEARER], [DEARER, 1.0]]


def test_negotiations_do_not_depend_on_other_fleets() -> None:
    whole, found = in_the_door(2.5, 2.2), []
    for fleet, ids in ((whole, torch.arange(2)), (whole.take([1]), torch.tensor([1]))):
        first = alone(fleet, torchgco.solve, 0, ids, torchgco.InteriorPoint())
        best = solve._Best(fleet, first, 0, ids)
        solve._negotiate(best, forms_of(fleet), lambda: False)
        found.append(best)
    assert bool(found[0].verdict.reached.all())
    for mine, yours in zip(found[1].plans.U, found[0].plans.U, strict=True):
        assert torch.equal(mine[0], yours[1])


def test_a_negotiation_about_a_goal_inside_a_wall_ends() -> None:
    """Two that want to be at the same place meet at any price."""
    fleet = Fleet([disc([-2.0, 0.0], [0.0, 0.0]), disc([2.0, 0.1], [0.0, 0.1])], 0.8)
    first = alone(fleet, torchgco.solve, 0, ONE, torchgco.InteriorPoint())
    teams = Negotiated(fleet, forms_of(fleet), ONE, first, [[1, 0]])
    plans = teams.run()
    assert float(teams.dearer.max()) == DEAREST and all(bool(torch.isfinite(x).all()) for x in plans.X)
    late = Negotiated(fleet, forms_of(fleet), ONE, first, [[1, 0]], [[0]], late=lambda: True).run()
    assert all(torch.equal(mine, yours) for mine, yours in zip(late.U, first.U, strict=True))


@pytest.mark.slow
def test_a_door_of_16_is_negotiated() -> None:
    fleet = discs("door", 16, 1, 2718)
    first = alone(fleet, torchgco.solve, 0, ONE, "gco")
    order = np.random.default_rng(0).permutation(16).tolist()
    teams = Negotiated(fleet, forms_of(fleet), ONE, first, [order])
    teams.run()
    assert not bool(teams.meets.any())


def test_who_finds_no_plan_is_lost_and_others_do_not_plan_among_it() -> None:
    """A goal inside a wall."""
    walls = Boxes([[0.0, 0.0]], [[0.5, 3.0]], 0.2)
    fleet = Fleet([disc([-2.0, 0.0], [0.0, 0.0], walls), disc([-2.0, 1.0], [-1.5, 1.0], walls)], 0.4)
    first = alone(fleet, torchgco.solve, 0, ONE, torchgco.InteriorPoint())
    run = Replanned(fleet, forms_of(fleet), ONE, first, [[0, 1]], torch.zeros(1, 2, dtype=torch.bool))
    run.run()
    assert run.lost == [[0]] and run.known.tolist() == [[False, True]]


def test_a_lattice_is_made_once_and_sees_others_where_they_are() -> None:
    fleet = in_the_door(2.5)
    among = forms_of(fleet)[0]
    free = open_loop(DISC, fleet.members[0].x0, torch.zeros(1, 50, 2, dtype=D))[0]
    ground = among.ground(fleet, 0, 0, free)
    assert ground is not None and among.ground(fleet, 0, 0, free) is ground and len(among.grounds) == 1
    lattice = ground.scene.lattice
    assert lattice.spacing == pytest.approx(0.2) and ground.scene.others is None
    places = torch.stack((torch.linspace(0.0, 5.0, 51).double(), torch.zeros(51).double()), dim=-1).unsqueeze(0)
    others = ground.among(places, torch.tensor([0.4], dtype=D), torch.tensor([2.0], dtype=D), 0.1).others
    assert others is not None and others.reach.tolist() == pytest.approx([0.4 + BESIDE * lattice.spacing])
    t = (torch.arange(lattice.layers * PARTS + 1) * lattice.tau / PARTS).double()
    torch.testing.assert_close(others.center[:, 0, 0], t.clamp(max=5.0))


def test_responses_are_columns_of_the_inverse() -> None:
    """As solves with a right side for each place, among obstacles that are touched and limits that hold."""
    problem = disc([[-2.0, 0.1], [-2.0, 0.4]], [[2.0, 0.1], [2.0, 0.1]], Spheres([[0.0, 0.0]], [0.5], 0.2), N=30)
    found = SOLVER.solve(problem, torch.zeros(2, 30, 2, dtype=D), X0=problem.at_rest[0])
    found = torchgco.solve(problem, U0=found.U)
    holds, give, _ = rows_in_barrier(problem, found, 0.0)
    assert bool((holds & (give < 1e-6)).any())
    R, _ = responses(problem, found, torch.zeros(2, 31, 2, dtype=D), torch.zeros(2, dtype=D))
    a = torch.zeros(3, 2, 31, 6, dtype=D)
    for column, (k, axis) in enumerate(((1, 0), (14, 1), (30, 0))):
        a[column, :, k, axis] = -1.0
    gaps, rows = a.new_zeros(3, 2, 30, 4), a.new_zeros(3, *holds.shape)
    z = solve_at(problem, found, holds, RightSides(a, gaps, rows), give).z[:, :, 1:, :2].flatten(2)
    for column, at in enumerate((0, 27, 58)):
        torch.testing.assert_close(R[:, :, at], z[column], rtol=1e-5, atol=1e-6 * float(R.abs().max()))
