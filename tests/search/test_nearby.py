"""Obstacles far from every way change nothing: neither the answer nor, by much, the work; those that matter do."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.problems import assert_same_bits, planar_batch, quick_gco
from tests.slow import mostly
from torchgco import Body, Boxes, InteriorPoint, Problem, Solution, Spheres, judge
from torchgco.lagrangian.lagrangian import Iterate, SolveEnd
from torchgco.native.compiler import find_compiler
from torchgco.search import nearby
from torchgco.search.finish import continued
from torchgco.search.nearby import Nearby
from torchgco.solvers.contracts import Call

B, FAR = 3, 40


def of(centers: torch.Tensor, inflated: torch.Tensor, vehicle: torch.Tensor) -> Spheres:
    """Spheres of inflated radii, absent where these are 0."""
    absent = inflated == 0
    radii = (inflated - vehicle[:, None]).masked_fill(absent, torch.nan)
    return Spheres(centers.masked_fill(absent.unsqueeze(-1), torch.nan), radii, vehicle)


def planar(kind: str, far: float, near: int = 9) -> tuple[Problem, Problem, torch.Tensor]:
    """A batch, and the same with many more obstacles at a distance of the way."""
    problem, U0 = planar_batch(B=B, N=25, obstacles=near, seed=4)
    spheres = problem.obstacles[0]
    angle = torch.arange(FAR) * 0.1
    ring = far * torch.stack((angle.cos(), angle.sin()), dim=-1).expand(B, -1, -1).to(spheres.centers)
    vehicle = spheres.vehicle_radius
    if kind in ("spheres", "body"):
        radii = torch.cat((spheres.inflated_radii, vehicle[:, None] + 0.05 + 0.0 * ring[..., 0]), dim=1)
        more = [of(torch.cat((spheres.centers, ring), dim=1), radii, vehicle)]
    else:
        more = [spheres, Boxes(ring, torch.full_like(ring, 0.05), vehicle_radius=vehicle)]
    rest, few = [part for part in problem.constraints if part is not spheres], [spheres]
    if kind == "body":
        rod = Body([[0.05, 0.0], [-0.05, 0.0]], float(vehicle[0]))
        few = [of(spheres.centers, spheres.inflated_radii, vehicle)]
        few, more = ([replace(part, vehicle_radius=rod) for part in parts] for parts in (few, more))
    return replace(problem, constraints=[*few, *rest]), replace(problem, constraints=[*more, *rest]), U0


def trajectories(solution: Solution) -> tuple[torch.Tensor, ...]:
    return solution.X, solution.U, solution.cost, solution.status, solution.iterations


def test_fewer_obstacles_leave_the_scale_of_the_cost_as_it_is() -> None:
    _, many, U0 = planar("spheres", 9.0)
    near = Nearby.of(Call.checked(many, U0))
    assert near is not None
    scale = near.given.problem.cost_scale
    assert near.call.problem.cost_scale is scale
    assert all(map(torch.equal, scale, near.call.problem.renewed().cost_scale))


@pytest.mark.parametrize("inside", [False, True], ids=["all clear", "one inside a far one"])
def test_what_is_known_of_starts_holds_among_fewer_obstacles(inside: bool) -> None:
    _, many, U0 = planar("spheres", 9.0)
    X = many.x0.unsqueeze(1).expand(-1, many.N + 1, -1)
    if inside:
        x0 = many.x0.clone()
        x0[1, :2] = many.obstacles[0].centers[1, -1]  # which is left out, as X is elsewhere
        many = replace(many, x0=x0)
    call = Call.checked(many, U0)
    assert call.problem.start_is_clear.tolist() == [True, not inside, True]
    near = Nearby.along(call, X)
    assert near is not None and bool(near.call.problem.start_is_clear.all())


@pytest.mark.sampled(0)
@pytest.mark.parametrize("kind", mostly(["spheres", "boxes", "body"], "body"))
def test_far_obstacles_change_no_bit(kind: str) -> None:
    few, many, U0 = planar(kind, 9.0)
    solver = quick_gco(few)
    one, two = solver.solve(few, U0, seed=3), solver.solve(many, U0, seed=3)
    if kind != "boxes":
        for a, b in zip(trajectories(one), trajectories(two), strict=True):
            assert torch.equal(a, b)
    shapes = [part.value(two.X, two.U).shape for part in many.constraints]
    assert [lam.shape for lam in two.multipliers.lam] == shapes
    again = solver.solve(many, two.U, seed=3, warm=two.multipliers)  # multipliers of all obstacles are taken
    assert bool((again.violation <= 1e-3).all())
    assert bool(judge(many, two.U).clear_95.all())


def test_a_single_far_obstacle_changes_no_bit() -> None:
    few, many, U0 = planar("spheres", 9.0)
    spheres = many.obstacles[0]
    kept = slice(0, few.obstacles[0].centers.shape[1] + 1)
    one = of(spheres.centers[:, kept], spheres.inflated_radii[:, kept], spheres.vehicle_radius)
    one = replace(many, constraints=[one, *many.constraints[1:]])
    solver = quick_gco(few)
    for a, b in zip(*(trajectories(solver.solve(p, U0, seed=3)) for p in (few, one)), strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
def test_the_result_does_not_depend_on_problems_that_keep_all() -> None:
    """In a batch with a problem whose obstacles are near, the others leave theirs out all the same."""
    _, many, U0 = planar("spheres", 9.0)
    spheres = many.obstacles[0]
    centers = spheres.centers.clone()
    centers[1, -FAR:] *= 0.1  # around the start and the way
    centers[1, -FAR:, 1] += 2.0
    near = replace(
        many, constraints=[of(centers, spheres.inflated_radii, spheres.vehicle_radius), *many.constraints[1:]]
    )
    solver, every = quick_gco(many), torch.arange(B)
    whole = solver.solve(near, U0, seed=3, ids=every)
    for b in range(B):
        rows = torch.tensor([b])
        assert_same_bits(solver.solve(near.take(rows), U0[rows], seed=3, ids=every[rows]), whole.take(rows))


def test_a_way_through_obstacles_that_were_left_out_is_sought_again() -> None:
    """Where the trajectory leads through them, they are all obstacles of a second search."""
    few, many, U0 = planar("spheres", 9.0)
    call = Call.checked(many, U0)
    near = Nearby.of(call)
    assert near is not None and near.call.problem.obstacles[0].centers.shape[1] < FAR
    found = near.whole(quick_gco(few).solve(near.call.problem, U0, seed=3))
    assert near.wrong(found).numel() == 0
    X = found.X.clone()
    X[1, 12, :2] = many.obstacles[0].centers[1, -1]  # over one of the far ones
    assert near.wrong(replace(found, X=X)).tolist() == [1]
    assert Nearby.of(Call.checked(few, U0)) is None


# Refining -------------------------------------------------------------------------------------------------------------


def refined(problem: Problem, U0: torch.Tensor, solution: Solution) -> SolveEnd:
    start = Iterate(solution.X, solution.U, solution.multipliers, solution.cost, solution.violation)
    return continued(InteriorPoint(), Call.checked(problem, U0), start)


@pytest.mark.sampled(2)
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kind", ["spheres", "boxes"])
@pytest.mark.parametrize("enough", [True, False], ids=["the near ones", "too few"])
def test_a_trajectory_is_refined_among_the_obstacles_near_it(kind: str, enough: bool, monkeypatch) -> None:
    """Whatever is left out, the end is that among all: where too few are looked at, the others are hit and count."""
    _, many, U0 = planar(kind, 9.0)
    start = replace(quick_gco(many).solve(many, U0, seed=3), search=None, trace=None)
    if not enough:
        monkeypatch.setattr(nearby, "_beside", lambda X, part, solids: torch.zeros_like(solids.absent))
    found = refined(many, U0, start)
    monkeypatch.setattr(Nearby, "along", classmethod(lambda cls, call, X: None))
    whole = refined(many, U0, start)
    torch.testing.assert_close(found.best.cost, whole.best.cost, rtol=1e-6, atol=0)
    assert torch.equal(found.status, whole.status) and float(found.best.violation.max()) <= 1e-6
    for mine, theirs in zip(found.best.multipliers.lam, whole.best.multipliers.lam, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_both_searches_are_recorded_and_the_second_is_told(monkeypatch) -> None:
    _, many, U0 = planar("spheres", 9.0)
    wrong, solver = Nearby.wrong, quick_gco(many)

    def second(self: Nearby, found: Solution | Iterate) -> torch.Tensor:
        return torch.tensor([1]) if isinstance(found, Solution) else wrong(self, found)

    with monkeypatch.context() as patch:
        patch.setattr(Nearby, "wrong", second)
        found = solver.recording().solve(many, U0, seed=3)
    search, rows = found.search, len(solver.passes)
    assert search is not None and search.caught is not None and len(search.standings) == 2 * rows
    last = search.standings[-1]
    assert last is not None and last.rows.tolist() == [1] and float(last.cost[0]) == pytest.approx(float(found.cost[1]))
    assert len(set(search.caught[0].tolist())) == len(search.caught[0])
    first = solver.recording().solve(many.take(torch.tensor([0, 2])), U0[:2], seed=3, ids=torch.tensor([0, 2])).search
    assert first is not None and first.caught is not None
    alone = {[0, 2][i] for i in first.caught[0].tolist()}
    assert {i for i in search.caught[0].tolist() if i != 1} == alone  # the second search drops none of the first
    assert {one.again for one in search.comparisons if 1 in one.rows} == {False, True}
    assert "solved again with all obstacles" in found.explain(1) and "again with all" not in found.explain(0)
    assert found.explain(1).count("\n  1 guess") == found.explain(0).count("\n  1 guess") == 1
