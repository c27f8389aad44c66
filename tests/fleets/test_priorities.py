"""Priorities that vehicles get where they find no plan, who is then in the way, and lattices that are kept."""

from __future__ import annotations

import math
from dataclasses import fields

import pytest
import torch
from torch import Tensor

import torchgco
from tests.fleets.scenes import DISC, D, disc, swaps
from torchgco import Boxes, Fleet, Spheres
from torchgco.dynamics.rollout import open_loop
from torchgco.fleets import prioritised, solve
from torchgco.fleets.among import SOLVER, Among
from torchgco.fleets.forces import responses
from torchgco.fleets.prioritised import Prioritised, touches
from torchgco.fleets.solve import alone
from torchgco.fleets.verdict import judge_fleet
from torchgco.lagrangian.kkt import RightSides
from torchgco.problem.known import Known
from torchgco.search.timed_scenes import scene_in_time
from torchgco.sensitivity.points import rows_that_hold, solve_at

ONE = torch.tensor([0])


def in_the_door(*starts: float) -> Fleet:
    """The first comes to rest in a door before the second can be there; fleets differ in where the second starts."""
    walls, B = Boxes([[0.0, 2.5], [0.0, -2.5]], [[0.1, 2.0], [0.1, 2.0]], 0.2), len(starts)
    first = disc([[-1.0, 0.0]] * B, [[0.0, 0.0]] * B, walls)
    return Fleet([first, disc([[x, 0.1] for x in starts], [[-2.5, 0.1]] * B, walls)], 0.4)


def test_who_finds_no_plan_gets_priority_and_others_wait() -> None:
    fleet = in_the_door(2.5)
    first = alone(fleet, torchgco.solve, 0, ONE, "gco")
    forms = [Among(problem, Known()) for problem, _ in fleet.forms]
    for raised, sound in ((0, False), (1, True)):
        run = Prioritised(fleet, forms, ONE, first, [[0, 1]], raised=raised)
        verdict = judge_fleet(fleet, run.run().U)
        assert bool(verdict.reached[0]) == sound
        assert run.level.tolist() == [[0, raised]]
    assert torch.equal(run.plans.U[1], first.U[1])  # does as alone
    assert not torch.equal(run.plans.U[0], first.U[0])


def test_priorities_do_not_depend_on_other_fleets() -> None:
    whole, found = in_the_door(2.5, 2.2), []
    for fleet, ids in ((whole, torch.arange(2)), (whole.take([1]), torch.tensor([1]))):
        first = alone(fleet, torchgco.solve, 0, ids, torchgco.InteriorPoint())
        best, forms = solve._Best(fleet, first), [Among(problem, Known()) for problem, _ in fleet.forms]
        solve._one_after_other(best, forms, torch.arange(fleet.B), 0, ids, lambda: False)
        found.append(best)
    assert bool(found[0].verdict.reached.all())
    for mine, yours in zip(found[1].plans.U, found[0].plans.U, strict=True):
        assert torch.equal(mine[0], yours[1])


def test_who_is_alone_in_the_way_does_not_rise_for_ever() -> None:
    """A goal inside a wall: there is no plan, with any priority."""
    walls = Boxes([[0.0, 0.0]], [[0.5, 3.0]], 0.2)
    fleet = Fleet([disc([-2.0, 0.0], [0.0, 0.0], walls), disc([-2.0, 1.0], [-1.5, 1.0], walls)], 0.4)
    first = alone(fleet, torchgco.solve, 0, ONE, torchgco.InteriorPoint())
    forms = [Among(problem, Known()) for problem, _ in fleet.forms]
    run = Prioritised(fleet, forms, ONE, first, [[1, 0]], raised=50)
    run.run()
    assert run.raised[0] >= 49 and run.left == [[]]


def test_paths_touch_between_knots_too() -> None:
    t = torch.linspace(0.0, 1.0, 3, dtype=D)
    p = torch.stack((t, torch.zeros(3, dtype=D)), dim=-1)
    crossing = torch.stack((torch.full_like(t, 0.25), 0.3 - 1.2 * t), dim=-1)  # knots stay 0.39 m away
    far = p + torch.tensor([0.0, 1.0], dtype=D)
    others, keep = torch.stack((crossing, far, far, torch.full_like(p, math.nan))), torch.full((4,), 0.2, dtype=D)
    off = torch.tensor([0.0, 0.0, 0.82, 0.0], dtype=D)
    assert touches(p, others, keep, off).tolist() == [True, False, True, False]
    assert not bool(touches(p, others, 0.0 * keep, off).any())


def test_orders_are_drawn_as_long_as_they_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two orders that cost about the same are the last."""
    teams: list[int] = []

    class Counted(Prioritised):
        def run(self) -> torchgco.fleets.plans.Plans:
            teams.append(len(self.of))
            return super().run()

    monkeypatch.setattr(solve, "Prioritised", Counted)
    fleet = Fleet(swaps(3), 0.4)
    for same, rounds in ((1.0, 1), (-1.0, solve.ORDERS)):
        monkeypatch.setattr(solve, "SAME", same)
        teams.clear()
        first = alone(fleet, torchgco.solve, 0, ONE, "gco")
        best = solve._Best(fleet, first)
        forms = [Among(problem, Known()) for problem, _ in fleet.forms]
        solve._one_after_other(best, forms, ONE, 0, ONE, lambda: False)
        assert teams == [2] * rounds and bool(best.verdict.reached[0])


def test_a_lattice_that_is_kept_sees_what_is_there_now() -> None:
    fleet = in_the_door(2.5)
    (problem, _), *_ = fleet.forms
    among = Among(problem, Known())
    free = open_loop(DISC, problem.x0[:1], torch.zeros(1, 50, 2, dtype=D))
    radii = torch.full((1, 1), 0.4, dtype=D)
    for shift in (0.0, 0.5):
        places = (free[..., :2] + torch.tensor([0.6, shift], dtype=D)).unsqueeze(2)
        one = among.at(ONE, places, radii, own=torch.tensor([0.2], dtype=D))
        kept, fresh = among.scene(0, one, free[0]), scene_in_time(one, free[0])
        assert len(among.scenes) == 1 and torch.equal(kept.cell_cost, fresh.cell_cost)
        for name in (each.name for each in fields(fresh.field)):
            mine, own = getattr(kept.field, name), getattr(fresh.field, name)
            assert torch.equal(mine, own) if isinstance(own, Tensor) else mine == own


def test_responses_are_columns_of_the_inverse() -> None:
    """As solves with a right side for each place, among obstacles that are touched and limits that hold."""
    problem = disc([[-2.0, 0.1], [-2.0, 0.4]], [[2.0, 0.1], [2.0, 0.1]], Spheres([[0.0, 0.0]], [0.5], 0.2), N=30)
    found = SOLVER.solve(problem, torch.zeros(2, 30, 2, dtype=D), X0=problem.at_rest[0])
    found = torchgco.solve(problem, U0=found.U)
    holds, _ = rows_that_hold(problem, found)
    assert bool(holds.any())
    R = responses(problem, found, slice(0, 2))
    a = torch.zeros(3, 2, 31, 6, dtype=D)
    for column, (k, axis) in enumerate(((1, 0), (14, 1), (30, 0))):
        a[column, :, k, axis] = -1.0
    gaps, rows = a.new_zeros(3, 2, 30, 4), a.new_zeros(3, *holds.shape)
    z = solve_at(problem, found, holds, RightSides(a, gaps, rows)).z[:, :, 1:, :2].flatten(2)
    for column, at in enumerate((0, 27, 58)):
        torch.testing.assert_close(R[:, :, at], z[column], rtol=1e-5, atol=1e-6 * float(R.abs().max()))


def test_without_a_lattice_vehicles_bend_to_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prioritised, "library_for", lambda d: None)
    fleet = Fleet([disc([-2.0, 0.0], [2.0, 0.0]), disc([2.0, 0.0], [-2.0, 0.0])], 0.4)
    first = alone(fleet, torchgco.solve, 0, ONE, "gco")
    forms = [Among(problem, Known()) for problem, _ in fleet.forms]
    plans = Prioritised(fleet, forms, ONE, first, [[0, 1]]).run()
    assert bool(judge_fleet(fleet, plans.U).reached[0])
