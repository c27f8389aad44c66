"""Fleets: what is sound by a simulation of its own, batches, different vehicles, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.patches import Circle
from torch import Tensor

import torchgco
from tests.fleets.scenes import DISC, DT, D, disc, pushed, ring, swaps
from tests.view.test_packing import part
from torchgco import Boxes, Fleet, FreeTime, FunctionDynamics, InputError, Moved, Problem, Spheres, judge
from torchgco.fleets.among import Among
from torchgco.fleets.fleet import _forms
from torchgco.fleets.guesses import bent, in_conflict, widths
from torchgco.fleets.plans import Plans
from torchgco.fleets.replanned import Replanned
from torchgco.fleets.solve import alone
from torchgco.fleets.verdict import judge_fleet
from torchgco.problem.known import Known


def dense(U: Tensor, x0: Tensor, dt: float, steps: int = 40) -> np.ndarray:
    """Places (N steps + 1, 2) of a disc under controls (N, 2) held over each stage, in closed form."""
    p, v, found = x0[:2].numpy(), x0[2:].numpy(), [x0[:2].numpy()]
    for u in U.numpy():
        for s in np.arange(1, steps + 1) / steps * dt:
            found.append(p + s * v + 0.5 * s * s * u)
        p, v = p + dt * v + 0.5 * dt * dt * u, v + dt * u
    return np.array(found)


def nearest(fleet: Fleet, solutions: Any, b: int = 0) -> float:
    ways = [dense(one.U[b], problem.x0[b], DT) for one, problem in zip(solutions, fleet.members, strict=True)]
    return min(
        np.linalg.norm(ways[i] - ways[j], axis=1).min()
        for i in range(len(ways)) for j in range(i) if fleet.distances[i, j] > 0
    )  # fmt: skip


def test_four_discs_swap_places() -> None:
    fleet = Fleet(swaps(4, 2), apart=0.4)
    found = torchgco.solve(fleet)
    assert len(found) == 4 and bool(found.sound.all()) and len(fleet.forms) == 1
    for b in range(2):
        own = nearest(fleet, found, b)
        assert own >= 0.95 * 0.4 - 1e-3
        assert abs(own - float(found.least_distance[b])) < 2e-3
    costs = torch.stack([judge(one, each.U).cost for one, each in zip(fleet.members, found, strict=True)])
    torch.testing.assert_close(found.cost, costs.sum(0))
    torch.testing.assert_close(torch.stack([one.cost for one in found]).sum(0), found.cost)
    assert bool((found.cost > _alone(fleet)).all()) and bool((found.cost < 1.1 * _alone(fleet)).all())
    ends = torch.stack([one.x0[:, :2] for one in fleet.members]).neg().unsqueeze(2)
    away = (torch.stack([one.X[..., :2] for one in found]) - ends).norm(dim=-1)
    for b in range(2):
        last = max(k for k in range(51) if bool((away[:, b, k] > 0.3).any()))
        assert float(found.makespan[b]) == pytest.approx(DT * (last + 1))


def _alone(fleet: Fleet) -> Tensor:
    return sum((torchgco.solve(one, verbose=False).cost for one in fleet.members), torch.zeros(fleet.B, dtype=D))


def test_one_batch_whose_problems_are_the_vehicles_is_a_single_fleet() -> None:
    starts, ends = ring(4)
    batch = disc(starts[:, 0], ends[:, 0])
    found, listed = torchgco.solve(Fleet(batch, 0.4)), torchgco.solve(Fleet(swaps(4), 0.4))
    assert len(found) == 4 and len(found[0].X) == 1 and bool(found.sound.all())
    torch.testing.assert_close(found.cost, listed.cost, rtol=1e-6, atol=0)


def test_results_do_not_depend_on_the_other_fleets_of_a_batch() -> None:
    fleet, second = Fleet(swaps(3, 3), apart=0.4), torch.tensor([1])
    whole = torchgco.solve(fleet)
    one = torchgco.solve(Fleet([member.take(second) for member in fleet.members], 0.4), ids=second)
    for v in range(3):
        assert torch.equal(one[v].U[0], whole[v].U[1])
    assert torch.equal(one.least_distance[0], whole.least_distance[1])


def test_who_is_in_nobodys_way_flies_as_if_alone() -> None:
    fleet = Fleet([disc([0, 3.0 * v], [3, 3.0 * v]) for v in range(3)], apart=0.4)
    found = torchgco.solve(fleet)
    assert torch.equal(torchgco.judge(fleet, found).cost, found.cost)
    for v, (one, member) in enumerate(zip(found, fleet.members, strict=True)):
        assert torch.equal(one.U, torchgco.solve(member, ids=torch.tensor([v])).U)
    assert bool(found.sound.all()) and float(found.least_distance[0]) == pytest.approx(3.0, abs=1e-6)


def test_prioritised_planning_alone() -> None:
    """Each vehicle plans among the motions of those before it; teams don't depend on each other."""
    fleet, both = Fleet(swaps(5, 2), apart=0.4), torch.arange(2)
    first = alone(fleet, torchgco.solve, 0, both, "gco")
    assert not bool(judge_fleet(fleet, first.U).feasible.any())
    orders, none = [[4, 2, 0, 1, 3], [0, 1, 2, 3, 4]], torch.zeros(2, 5, dtype=torch.bool)
    plans = Replanned(fleet, forms_of(fleet), both, first, orders, none).run()
    verdict = judge_fleet(fleet, plans.U)
    assert bool(verdict.reached.all())
    for b in range(2):
        ways = [Bare(u[[b]]) for u in plans.U]
        assert nearest(fleet.take([b]), ways) >= 0.95 * 0.4 - 1e-3
    second = torch.tensor([1])
    again = Replanned(fleet, forms_of(fleet), second, first.take(second), orders[1:], none[1:]).run()
    assert all(torch.equal(mine[0], yours[1]) for mine, yours in zip(again.U, plans.U, strict=True))
    late = Replanned(fleet, forms_of(fleet), both, first, orders, none, late=lambda: True).run()
    assert all(torch.equal(mine, yours) for mine, yours in zip(late.U, first.U, strict=True))


def forms_of(fleet: Fleet) -> list[Among]:
    return [Among(problem, Known()) for problem, _ in fleet.forms]


class Bare:
    """Controls alone."""

    def __init__(self, U: Tensor) -> None:
        self.U = U


@pytest.mark.slow
def test_different_vehicles_distances_and_obstacles() -> None:
    """A slow one with drag, one that nobody minds, a wall with a door, and something that moves."""

    def dragged(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 2:], u - 0.5 * x[..., 2:]), dim=-1)

    walls = Boxes([[0.0, 2.5], [0.0, -2.5]], [[0.1, 2.0], [0.1, 2.0]], 0.2)
    path = np.stack([np.full(51, 1.0), np.linspace(2.0, -2.0, 51)], axis=-1)[:, None]
    slow = FunctionDynamics(dragged, 4, 2, DT, "rk4", position=slice(0, 2))
    fleet = Fleet(
        [
            disc([-1.5, 0.0], [1.5, 0.0], walls, Moved(path, 0.2, 0.2)),
            disc([1.5, 0.3], [-1.5, 0.2], walls, model=slow),
            disc([-1.5, 0.1], [1.5, 0.1], walls, weight=0.2),
        ],
        apart=[0.5, 0.3],
        pairs=[(1, 0), (1, 2)],
    )
    assert len(fleet.forms) == 3 or len(fleet.forms) == 2
    found = torchgco.solve(fleet)
    assert bool(found.sound.all()) and float(found.least_distance[0]) >= 0.95 * 0.3
    first, second, third = fleet.places([one.X for one in found])[0]
    assert float((first - second).norm(dim=-1).min()) >= 0.5 - 1e-3
    assert float((second - third).norm(dim=-1).min()) >= 0.3 - 1e-3


def test_two_that_pass_between_the_knots_are_seen() -> None:
    starts, ends = [[-2.45, 0.0], [2.55, 0.0]], [[2.55, 0.0], [-2.45, 0.0]]
    fleet = Fleet([disc(*pair) for pair in zip(starts, ends, strict=True)], apart=0.2)
    speeds = torch.tensor([[2.4, 0.0], [-2.4, 0.0]], dtype=D)
    X = [torch.cat((one.x0[:, :2], speeds[[v]]), -1) for v, one in enumerate(fleet.members)]
    moving = Fleet([replace(one, x0=x) for one, x in zip(fleet.members, X, strict=True)], apart=0.2)
    still = [torch.zeros(1, 50, 2, dtype=D)] * 2
    verdict = judge(moving, still)
    at_knots = min(abs(-2.45 + 0.24 * k - (2.55 - 0.24 * k)) for k in range(51))
    assert at_knots > 0.039 and float(verdict.least_distance[0]) < 1e-9
    assert float(verdict.clearance[0]) == pytest.approx(-0.19, abs=1e-9) and not bool(verdict.feasible[0])
    assert verdict.apart.tolist() == [[False, False]] and all(bool(one.feasible[0]) for one in verdict.vehicles)


def test_guesses_bend_to_one_side() -> None:
    problem = disc([0.0, 0.0], [4.0, 0.0])
    X = torch.zeros(1, 51, 4, dtype=D)
    X[..., 0] = torch.linspace(0, 4, 51)
    right = bent(X, slice(0, 2), 1.0, torch.tensor([0.5], dtype=D))
    assert torch.allclose(right[0, [0, -1]], X[0, [0, -1]]) and float(right[0, 25, 1]) == pytest.approx(-0.5)
    fleet = Fleet([problem, disc([4.0, 0.0], [0.0, 0.0]), disc([0.0, 3.0], [4.0, 3.0])], 0.4)
    conflicts = in_conflict(fleet, alone(fleet, torchgco.solve, 0, torch.arange(1), "gco"))
    assert conflicts.tolist() == [[True, True, False]]
    assert widths(fleet, conflicts).tolist() == [[0.2, 0.2, 0.0]]


def test_problems_of_one_form_are_one_batch() -> None:
    stones = [Spheres([[0.0, 0.2 * v]], [0.3], 0.2) for v in range(3)]
    members = tuple(disc([-2, 0.5 * v], [2, 0.5 * v], stone) for v, stone in enumerate(stones))
    ((batch, whose),) = _forms((members[0], members[1], members[2]))
    assert whose == (0, 1, 2) and batch.B == 3
    X, U = torch.randn(3, 51, 4, dtype=D), torch.randn(3, 50, 2, dtype=D)
    for v, one in enumerate(members):
        for row, own in zip(batch.constraints, one.constraints, strict=True):
            torch.testing.assert_close(row.value(X, U)[v], own.value(X[[v]], U[[v]])[0])
        torch.testing.assert_close(batch.cost.total(X, U)[v], one.cost.total(X[[v]], U[[v]])[0])
    other = disc([-2, 0], [2, 0], model=FunctionDynamics(lambda x, u: pushed(x, u), 4, 2, DT, "rk4", slice(0, 2)))
    assert len(_forms((members[0], other))) == 2


def test_time_is_kept() -> None:
    fleet = Fleet(swaps(4), apart=0.4)
    found = torchgco.solve(fleet, max_seconds=1e-3)
    assert not bool(found.sound.any()) and bool(torch.isfinite(found.cost).all())
    assert {status.name for one in found for status in one.statuses} <= {"TIME_LIMIT", "FEASIBLE"}


def test_a_figure_has_a_colour_for_each_vehicle() -> None:
    fleet = Fleet(swaps(3), apart=0.4)
    plans = Plans.at_rest(fleet)
    verdict = judge_fleet(fleet, plans.U)
    found = torchgco.fleets.FleetSolution(fleet, plans.solutions(fleet, verdict), verdict)
    figure = torchgco.plot(fleet, found)
    colours = {line.get_color() for ax in figure.axes for line in ax.lines if len(line.get_xdata()) > 2}  # type: ignore[arg-type]
    assert len(colours) >= 3
    html = torchgco.show(fleet, found).html
    head, first = part(html, "head"), part(html, "part-0")
    assert [one["name"] for one in head["solvers"]] == ["vehicle 0", "vehicle 1", "vehicle 2"]
    assert len({one["colour"] for one in head["solvers"]}) == 3 and len(first["flights"]) == 3
    for picture in (torchgco.plot, torchgco.animate):
        with pytest.raises(InputError, match="b: expected the place of a fleet, 0 to 0"):
            picture(fleet, found, 1)


def test_a_film_shows_all_vehicles_where_they_are_then() -> None:
    fleet = Fleet(swaps(3), apart=0.4)
    plans = Plans.at_rest(fleet)
    verdict = judge_fleet(fleet, plans.U)
    found = torchgco.fleets.FleetSolution(fleet, plans.solutions(fleet, verdict), verdict)
    film: Any = torchgco.animate(fleet, found)
    discs = [one for one in film.at(0.0) if isinstance(one, Circle)]
    assert len(discs) == 3 and len({one.get_facecolor() for one in discs}) == 3
    starts = [member.x0[0, member.position].tolist() for member in fleet.members]
    np.testing.assert_allclose(sorted(one.get_center() for one in discs), sorted(map(tuple, starts)), atol=1e-12)
    assert [one.get_radius() for one in discs] == pytest.approx([0.2] * 3)
    stars = [line for line in film.figure.axes[0].lines if line.get_marker() == "*"]
    goals = [member.goal.position[0].tolist() for member in fleet.members if member.goal is not None]
    assert {tuple(line.get_xydata()[0]) for line in stars} == set(map(tuple, goals))


def one_of(**changes: Any) -> Problem:
    return disc([0.0, 2.0], [1.0, 2.0], **changes)


FIRST = disc([0.0, 0.0], [1.0, 0.0])
BAD: dict[str, tuple[Any, Any, str]] = {
    "one": ([FIRST], {}, "fleet.vehicles: expected at least two"),
    "kinds": ("a fleet", {}, "fleet.vehicles: expected a problem per vehicle"),
    "N": ([FIRST, one_of(N=40)], {}, r"fleet.vehicles\[1\]: expected N 50 as of vehicle 0, got 40"),
    "dt": ([FIRST, one_of(model=replace(DISC, dt=0.2))], {}, r"vehicles\[1\]: expected dt 0.1 as of vehicle 0"),
    "batch": ([FIRST, disc([[0, 2], [0, 3]], [[1, 2], [1, 3]])], {}, "expected a batch of 1 as of vehicle 0, got 2"),
    "apart": ([FIRST, one_of()], {"apart": -0.4}, "fleet.apart: expected finite distances above 0 m"),
    "shape": ([FIRST, one_of()], {"apart": [0.4, 0.4]}, "fleet.apart: expected a number, or one for each of 1 pairs"),
    "pairs": ([FIRST, one_of()], {"pairs": [(0, 2)]}, r"fleet.pairs: expected pairs of two vehicles within 0..1"),
    "none": ([FIRST, one_of()], {"pairs": []}, "fleet.pairs: expected pairs of two vehicles within 0..1"),
    "twice": ([FIRST, one_of()], {"pairs": [(0, 1), (1, 0)]}, "fleet.pairs: expected .* none twice"),
    "single": ([FIRST, one_of().cast(torch.float32)], {}, r"vehicles\[1\].x0: expected float64 on the CPU"),
    "time": ([FIRST, replace(one_of(), time=FreeTime(3.0, 6.0))], {}, r"vehicles\[1\].time: expected None"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_with_a_fleet_is_named(case: str) -> None:
    vehicles, more, message = BAD[case]
    with pytest.raises(InputError, match=message):
        Fleet(vehicles, **({"apart": 0.4} | more))


def test_arguments_that_fleets_do_not_take_are_named() -> None:
    fleet = Fleet(swaps(2), 0.4)
    for U, more, message in (
        (torch.zeros(1, 50, 2), {}, r"U: expected a FleetSolution, or controls \(B, N, m\) of each of 2 vehicles"),
        ([torch.zeros(1, 50, 2)], {}, "U: expected a FleetSolution"),
        ([torch.zeros(1, 50, 2)] * 2, {"goal_radius": 0.3}, "judge.goal_radius: expected None of a fleet"),
    ):
        with pytest.raises(InputError, match=message):
            torchgco.judge(fleet, U, **more)  # type: ignore[call-overload]
    with pytest.raises(InputError, match=r"solve.U0: expected None of a fleet"):
        torchgco.solve(fleet, U0=torch.zeros(1, 50, 2))  # type: ignore[call-overload]
    with pytest.raises(InputError, match="solution: expected a fleet and its solution, got NoneType"):
        torchgco.show(fleet, None)  # type: ignore[arg-type]
