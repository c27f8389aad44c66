"""Gates: rows, knots, what solver, search, judge and pictures make of them, and errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    Boxes,
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Gates,
    Goal,
    InputError,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    Status,
    judge,
)
from torchgco.constraints.gates import GateBalls, GateSquares
from torchgco.dynamics.rollout import open_loop
from torchgco.experiments.results.durations import states_of
from torchgco.judging.gates import passes
from torchgco.kernels import measured
from torchgco.plotting.ways import ways_along
from torchgco.roadmap.roadmap import timed
from torchgco.search import Follow
from torchgco.search.nearby import Nearby
from torchgco.solvers.contracts import Call
from torchgco.view.document import flights_of
from torchgco.view.packing import Packing
from torchgco.view.vehicles import Look

D = torch.float64
B, N = 2, 40
PLACES = [[2.0, 1.0, 1.0], [4.0, -1.0, 1.5]]
AHEAD = [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
BALLS = Gates(PLACES, [0.2, 0.3])
SQUARES = Gates(PLACES, normals=AHEAD, half_widths=0.25)
START = torch.tensor([[0.0, 0, 1, 0, 0, 0], [0, 0.5, 1, 0.2, 0, 0]], dtype=D)


def points(*parts: Any, x0: Tensor = START, goal: Any = (6.0, 0.0, 1.0), **more: Any) -> Problem:
    """Points in space that are drawn from x = 0 to 6 m in 6 s."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 3:], u), -1), 6, 3, 0.15, "rk4", slice(0, 3))
    cost = QuadraticCost([0.0] * 6, [1.0] * 3, [300.0] * 6, x_ref=[*goal, 0, 0, 0])
    return Problem(model, cost, parts, x0, more.pop("N", N), Goal(list(goal), 0.3), **more)


def corners(d: int, normal: Any) -> np.ndarray:
    """The directions of a square's sides, by hand."""
    n = np.array(normal) / np.linalg.norm(normal)
    level = np.cross([0, 0, 1], n)
    return np.stack([level / np.linalg.norm(level), np.cross(n, level / np.linalg.norm(level))])


def test_rows_of_balls_are_distances_at_their_knots() -> None:
    problem = points(BALLS)
    (part,) = problem.constraints
    X, U = torch.randn(B, N + 1, 6, dtype=D), torch.zeros(B, N, 3, dtype=D)
    assert isinstance(part, GateBalls) and part.places is not None
    expected = np.zeros((B, N))
    for b, g in np.ndindex(B, 2):
        k = int(part.places[b, g])
        expected[b, k - 1] = max(0.0, np.linalg.norm(X[b, k, :3].numpy() - PLACES[g]) - [0.2, 0.3][g])
    np.testing.assert_allclose(part.violation(X, U)[..., 0], expected, atol=1e-12)
    torch.testing.assert_close(measured(problem, X, U), torch.tensor(expected).amax(-1))
    torch.testing.assert_close(part.centers, torch.tensor([PLACES] * B, dtype=D))


@pytest.mark.parametrize("knots", [None, [10, 14], [10, 13], [10, 12], [1, N - 1]])
def test_rows_of_squares_keep_both_knots_in_the_prism_on_their_sides(knots: list[int] | None) -> None:
    (part,) = points(replace(SQUARES, knots=knots)).constraints
    X, U = 2.0 * torch.randn(B, N + 1, 6, dtype=D), torch.zeros(B, N, 3, dtype=D)
    assert isinstance(part, GateSquares)
    violation = part.violation(X, U)
    expected = np.zeros((B, N, 5))
    for b, g in np.ndindex(B, 2):
        n, places = np.array(AHEAD[g]) / np.linalg.norm(AHEAD[g]), part.places[b].tolist()
        for beyond in (0, 1):
            k = places[g] + beyond
            away = X[b, k, :3].numpy() - PLACES[g]
            across = corners(3, AHEAD[g]) @ away
            rows = [n @ away * (1 - 2 * beyond) + 2e-3, *(across - 0.25), *(-across - 0.25)]
            expected[b, k - 1] = np.maximum(rows, 0.0)
            k += 2 * beyond - 1
            if 1 <= k <= N and not {k, k - 1} & set(places):
                behind = n @ (X[b, k, :3].numpy() - PLACES[g]) * (1 - 2 * beyond)
                expected[b, k - 1, beyond] = max(behind + 6e-3, 0.0)
    np.testing.assert_allclose(violation, expected, atol=1e-12)
    g, h = torch.randn(B, N, 5, dtype=D), torch.randn(B, N, 5, dtype=D)
    H = X.new_zeros(B, N + 1, 10, 10)
    part.accumulate(X, U, g, h, H)
    for b in range(B):
        J = torch.func.jacrev(lambda x, b=b: part.take(slice(b, b + 1)).value(x[None], U[:1])[0])(X[b])
        for k in {1, *(max(1, int(part.places[b, 0]) + shift) for shift in (-1, 0, 1, 2))}:
            own = J[k - 1, :, k]
            torch.testing.assert_close(H[b, k, :6, 6], g[b, k - 1] @ own)
            torch.testing.assert_close(H[b, k, :6, :6], own.mT @ (h[b, k - 1].unsqueeze(-1) * own))


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "gates", [BALLS, SQUARES, replace(BALLS, knots=[10, 30]), replace(SQUARES, knots=[[9, 28], [12, 30]])]
)
@pytest.mark.parametrize("among", [False, True])
def test_all_are_passed_in_their_order(gates: Gates, among: bool) -> None:
    discs = [Spheres([[3.0, 0.1, 1.2], [5.0, -0.4, 1.2]], [0.5, 0.3], 0.1)] if among else []
    problem = points(gates, ControlBounds(-5.0, 5.0), *discs)
    found = torchgco.solve(problem)
    part, X = problem.constraints[0], found.X.numpy()
    assert found.statuses == [Status.CONVERGED] * B and bool(judge(problem, found.U).reached.all())
    for b, g in np.ndindex(B, 2):
        k = int(part.places[b, g])
        if isinstance(part, GateBalls):
            assert np.linalg.norm(X[b, k, :3] - PLACES[g]) < [0.2, 0.3][g] + 1e-3
            continue
        fine = X[b, k, :3] + np.linspace(0, 1, 100001)[:, None] * (X[b, k + 1, :3] - X[b, k, :3]) - PLACES[g]
        along = fine @ np.array(AHEAD[g])
        assert along[0] <= -1e-3 and along[-1] >= 1e-3
        assert np.abs(corners(3, AHEAD[g]) @ fine[np.abs(along).argmin()]).max() < 0.25 + 1e-3
    assert found.to_frame(problem).gates_passed.tolist() == [2, 2]
    if gates.knots is not None:
        assert part.places.tolist() == np.broadcast_to(gates.knots, (B, 2)).tolist()


def test_the_judge_counts_what_is_passed_between_the_knots_too() -> None:
    x0 = torch.tensor([[0.0, 0, 0, 2.0, 0, 0]], dtype=D)  # 0.3 m a knot along x
    near = points(Gates([[1.05, 0.1, 0.0], [3.0, 0.3, 0.0]], 0.12, knots=[3, 10]), x0=x0)
    U = torch.zeros(1, N, 3, dtype=D)
    way = passes(near.constraints[0], open_loop(near.dynamics, x0, U))
    assert way is not None and way.passed.tolist() == [[True, False]]  # at the knot itself the first is 0.18 m away
    torch.testing.assert_close(way.distance, torch.tensor([[0.1, 0.3]], dtype=D))
    torch.testing.assert_close(way.place[0, 0], torch.tensor([1.05, 0.0, 0.0], dtype=D))
    assert bool(way.place[0, 1].isnan().all())
    assert judge(near, U).gates_passed.tolist() == [1] and not bool(judge(near, U).feasible)
    frames = Gates([[1.05, 0.1, 0], [3.1, 0, 0], [4.0, 0, 0]], normals=[[1.0, 0, 0], [-1, 0, 0], [1, 0, 0]],
        half_widths=0.2, knots=[3, 10, 20])  # fmt: skip
    crossed = passes(points(frames, x0=x0).constraints[0], open_loop(near.dynamics, x0, U))
    assert crossed is not None and crossed.passed.tolist() == [[True, False, False]]  # backwards; not then
    torch.testing.assert_close(crossed.place[0, 0], torch.tensor([1.05, 0.0, 0.0], dtype=D))
    assert float(crossed.distance[0, 0]) == pytest.approx(0.1) and bool(torch.isinf(crossed.distance[0, 1:]).all())


def test_default_knots_follow_the_way_with_room_between_them() -> None:
    line = np.cumsum([np.linalg.norm(step) for step in np.diff([[0, 0, 1], *PLACES, [6.0, 0, 1]], axis=0)])
    when = np.arange(N + 1) / N
    for b, gates in ((0, BALLS),):
        places = points(gates).constraints[0].places[b].numpy()
        for g, k in enumerate(places):
            assert abs((when**2 * (3 - 2 * when) - line[g] / line[-1])[k]) <= np.diff(when**2 * (3 - 2 * when)).max()
    crowd = [[0.01 * i, 0.0, 1.0] for i in range(1, 8)]
    tight = points(Gates(crowd, 1.0), N=7).constraints[0].places
    assert tight.tolist() == [[1, 2, 3, 4, 5, 6, 7]] * B
    pairs = points(Gates(crowd[:3], normals=[[1.0, 0, 0]] * 3, half_widths=1.0), N=6).constraints[0].places
    assert pairs.tolist() == [[1, 3, 5]] * B
    short = points(BALLS, horizon=torch.tensor([N, 20])).constraints[0].places
    assert int(short[1].max()) <= 20


def test_paths_lead_through_them_leg_by_leg() -> None:
    """A wall with a gap far from the straight line: the gate lies in the gap, and behind another wall."""
    walls = Boxes([[2.0, -1.0, 1.0], [4.0, 1.0, 1.0]], [[0.3, 2.5, 5.0]] * 2, 0.1)
    gates = Gates([[3.0, 0.0, 1.0]], 0.2)
    problem = points(gates, walls, ControlBounds(-4.0, 4.0))
    found = torchgco.solve(problem, record=True)
    assert bool(judge(problem, found.U).reached.all()) and found.to_frame(problem).gates_passed.tolist() == [1, 1]
    far = Spheres([[3.0, 30.0, 1.0], [3.0, 9.0, 1.0]], [0.5, 0.5], 0.1)
    on_the_way = points(Gates([[3.0, 10.0, 1.0]], 0.2), far)
    kept = Nearby.of(Call.checked(on_the_way, torch.zeros(B, N, 3, dtype=D)))
    assert kept is not None and kept.call.problem.obstacles[0].centers[:, :, 1].unique().tolist() == [9.0]


def test_a_path_is_at_each_gate_at_its_knot() -> None:
    path = torch.tensor([[[0.0, 0], [1, 0], [1, 0], [1, 3], [1, 3], [2, 3]]], dtype=D)  # three legs of two corners
    at = timed(path, torch.tensor([[5, 15]]), torch.tensor([18]), 20)
    torch.testing.assert_close(at[0, [0, 5, 15, 18, 20]], path[0, [0, 1, 3, 5, 5]])
    steps = at.diff(dim=1).norm(dim=-1)[0]
    assert float(steps[0]) < float(steps[2]) and float(steps[17]) < float(steps[15])


@pytest.mark.slow
def test_beside_horizons_rates_and_the_rest_of_a_batch() -> None:
    ends = torch.tensor([N, 30])
    whole = points(BALLS, ControlBounds(-5.0, 5.0), horizon=ends)
    found = torchgco.solve(whole)
    assert found.statuses == [Status.CONVERGED] * B and found.to_frame(whole).gates_passed.tolist() == [2, 2]
    for gates in (BALLS, SQUARES):
        slow = points(gates, RateBounds(-0.5, 0.5), ControlBounds(-5.0, 5.0))
        assert torchgco.solve(slow).statuses == [Status.CONVERGED] * B
        both = torchgco.solve(points(gates, ControlBounds(-5.0, 5.0)))
        for b in range(B):
            alone = torchgco.solve(points(gates, ControlBounds(-5.0, 5.0), x0=START[b : b + 1]))
            torch.testing.assert_close(alone.U[0], both.U[b], rtol=1e-9, atol=1e-9)
            part = points(gates, ControlBounds(-5.0, 5.0)).take(torch.tensor([b]))
            assert torch.equal(torchgco.solve(part).U[0], both.U[b])


@pytest.mark.parametrize("gates", [BALLS, SQUARES])
def test_compiled_problems_take_other_gates_at_the_same_knots(gates: Gates) -> None:
    given = torch.tensor([PLACES] * B, dtype=D)
    places = points(gates).constraints[0].places
    fixed = replace(gates, centers=given, knots=places)
    compiled = torchgco.compile(points(fixed, ControlBounds(-5.0, 5.0)))
    moved = given + torch.tensor([[[0.2, 0.3, -0.1], [0.0, -0.4, 0.2]], [[0.0, -0.2, 0.1], [0.1, 0.1, 0.0]]], dtype=D)
    if gates.normals is None:
        new: dict[str, Any] = {"gates.centers": moved, "gates.radius": [0.1, 0.2]}
        fresh = replace(fixed, centers=moved, radius=[0.1, 0.2])
    else:
        turned = [[1.0, 0.3, 0.0], [1.0, 0.5, -0.2]]
        new = {"gates.centers": moved, "gates.normals": turned, "gates.half_widths": 0.15 * np.ones(2)}
        fresh = replace(fixed, centers=moved, normals=turned, half_widths=0.15)
    other = points(fresh, ControlBounds(-5.0, 5.0))
    answer, found = compiled(numbers=new), torchgco.solve(other)
    np.testing.assert_allclose(answer.U, found.U, atol=1e-5)
    now = compiled.problem
    np.testing.assert_allclose(now.constraints[0].centers, moved, atol=0)
    assert judge(now, torch.as_tensor(answer.U)).gates_passed.tolist() == [2, 2]
    again = compiled(numbers={"gates.centers": given}, x0=START)
    own = gates if gates.normals is None else replace(fresh, centers=given)
    own = replace(own, radius=[0.1, 0.2], knots=places) if gates.normals is None else own
    np.testing.assert_allclose(again.U, torchgco.solve(points(own, ControlBounds(-5.0, 5.0))).U, atol=1e-5)
    with pytest.raises(InputError, match=r"gates\.centers: expected finite numbers"):
        compiled(numbers={"gates.centers": given * torch.nan})
    size = "gates.radius" if gates.normals is None else "gates.half_widths"
    with pytest.raises(InputError, match=f"{size}: expected numbers above 0"):
        compiled(numbers={size: [0.1, 0.0]})


def test_every_pace_is_another_trajectory() -> None:
    """Gates say when they are passed: the paces of a path differ after the last of them."""
    problem = points(BALLS, Spheres([[3.0, 0.1, 1.2]], [0.5], 0.1))
    part = problem.constraints[0]
    legs = torch.tensor([[[0.0, 0, 1], PLACES[0], PLACES[0], PLACES[1], PLACES[1], [6.0, 0, 1]]], dtype=D)
    path, arrive = legs.repeat_interleave(2 * B, dim=0), torch.tensor([0.5, 1.0] * B, dtype=D)
    at = Follow()._centers(path, arrive, problem, None)  # type: ignore[arg-type]
    last = part.places[:, -1].tolist()
    for b in range(B):
        slow, fast = at[2 * b + 1], at[2 * b]
        for own in (slow, fast):
            for g, k in enumerate(part.places[b].tolist()):
                torch.testing.assert_close(own[k], legs[0, 2 * g + 1])
        half = last[b] + (N - last[b] + 1) // 2
        torch.testing.assert_close(fast[half], legs[0, -1])
        assert float((slow[half] - legs[0, -1]).norm()) > 0.1


def test_pictures_show_them() -> None:
    for gates in (BALLS, SQUARES):
        problem = points(gates)
        figure = torchgco.plot(problem, torchgco.solve(problem), b=0)
        words = {text.get_text() for ax in figure.axes for text in ax.texts}
        assert {"1", "2"} <= words


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_pictures_mark_where_the_judge_has_them_passed(square: bool, free: bool) -> None:
    """On the path between the knots, which bends by 0.1 m in a stage; a gate that is missed has no mark."""
    centers = [[1.1, 0.6, 1.0], [3.0, 4.5, 1.0], [3.5, 0.0, 1.0]]
    frames = {"normals": [[1.0, 0.5, 0.0]] * 3, "half_widths": 0.3} if square else {"radius": 0.3}
    start = torch.tensor([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]], dtype=D)
    time = FreeTime(0.5, 2.0) if free else None
    problem = points(Gates(centers, knots=[2, 4, 7], **frames), x0=start, N=8, time=time)
    model = replace(problem.dynamics, dt=0.5)
    problem = replace(problem, dynamics=model)
    U = torch.tensor([0.0, 1.0, 0.0], dtype=D).expand(1, 8, 3).contiguous()
    times = torch.linspace(0.0, 4.0, 9, dtype=D).unsqueeze(0) if free else None
    (way,) = ways_along(problem, states_of(problem, U, times), U, times, [range(3)])
    t = np.linspace(0.0, 4.0, 400_001)
    path = np.stack((t, 0.5 * t**2, np.ones_like(t)), axis=-1)  # by hand
    due = []
    for center in centers[:2]:
        away = path - center
        nearest = np.abs(away @ [1.0, 0.5, 0.0]) if square else np.linalg.norm(away, axis=-1)
        due.append(path[nearest.argmin()])
    np.testing.assert_allclose(way.crossings, due, atol=2e-3)
    knots = way.X[:: way.pieces, :3]
    assert np.linalg.norm(knots - due[0], axis=-1).min() > 0.1 and way.pieces > 1

    solution = torchgco.solve(problem, U, solver="interior_point", verbose=False)
    solution = replace(solution, U=U, X=states_of(problem, U, times), times=times)
    above = torchgco.plot(problem, solution).axes[0]
    (marks,) = [line.get_xydata() for line in above.lines if line.get_marker() == "o" and len(line.get_xdata()) == 2]
    np.testing.assert_allclose(marks, way.crossings[:, :2])
    (flight,) = flights_of(
        problem, Look("ball"), solution.X, U, "one", ["failed"], [[]], 1e-3, np.array([False]), times
    )
    np.testing.assert_allclose(flight.packed(Packing(), 0)["crossings"], way.crossings, atol=1e-3)


def test_squares_in_the_plane() -> None:
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.15, "rk4", slice(0, 2))
    cost = QuadraticCost([0.0] * 4, [1.0] * 2, [10.0] * 4, x_ref=[4.0, 0, 0, 0])
    gate = Gates([[2.0, 1.0]], normals=[[0.0, -1.0]], half_widths=0.3)
    problem = Problem(model, cost, [gate], torch.zeros(1, 4, dtype=D), N)
    found = torchgco.solve(problem)
    k = int(problem.constraints[0].places)
    (x, above), (_, below) = found.X[0, k, :2].tolist(), found.X[0, k + 1, :2].tolist()
    assert found.statuses == [Status.CONVERGED] and above >= 1.002 - 1e-6 and below <= 0.998 + 1e-6
    assert abs(x - 2.0) < 0.3 + 1e-6


MANY = [[0.1 * i, 0.0, 0.0] for i in range(41)]


@pytest.mark.parametrize(
    ("gates", "message"),
    [
        (Gates([[1.0, 0.0]], 0.1), r"gates.centers: expected shape \(2, G, 3\)"),
        (Gates([[1.0, 0.0, torch.nan]], 0.1), "gates.centers: expected one gate at least, of finite"),
        (Gates([], 0.1), "gates.centers: expected"),
        (Gates(MANY, 0.1), "gates.centers: expected at most 40 gates in N = 40, got 41"),
        (Gates(MANY[:21], normals=[[1.0, 0, 0]] * 21, half_widths=0.1), "gates.centers: expected at most 20 gates"),
        (Gates(PLACES), "gates.radius: expected a radius, or normals and half_widths, got none"),
        (Gates(PLACES, 0.1, normals=AHEAD, half_widths=0.1), "gates.radius: expected .* got both"),
        (Gates(PLACES, normals=AHEAD), "gates.half_widths: expected half widths"),
        (Gates(PLACES, 0.0), "gates.radius: expected finite numbers above 0 m"),
        (Gates(PLACES, [0.1] * 3), r"gates.radius: expected a number, shape \(2,\) or \(2, 2\)"),
        (Gates(PLACES, normals=[[0.0] * 3] * 2, half_widths=0.1), "gates.normals: expected vectors other than 0"),
        (Gates(PLACES, normals=AHEAD, half_widths=-1.0), "gates.half_widths: expected finite numbers above 0 m"),
        (Gates(PLACES, 0.1, knots=[5, 5]), "gates.knots: expected knots that rise: no two gates at one"),
        (Gates(PLACES, 0.1, knots=[9, 5]), "gates.knots: expected knots that rise"),
        (Gates(PLACES, normals=AHEAD, half_widths=0.1, knots=[5, 6]), "gates.knots: expected knots that rise by 2"),
        (Gates(PLACES, 0.1, knots=[0, 5]), "gates.knots: expected knots within 1..40"),
        (Gates(PLACES, 0.1, knots=[5, 41]), "gates.knots: expected knots within 1..40"),
        (Gates(PLACES, 0.1, knots=[5]), "gates.knots: expected 2 whole numbers, or 2 rows"),
        (Gates(PLACES, 0.1, knots="ab"), "gates.knots: expected 2 whole numbers"),
        (Gates(PLACES, 0.1, knots=7), "gates.knots: expected 2 whole numbers"),
    ],
)
def test_wrong_input_is_named(gates: Gates, message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}"):
        points(gates)
    if "within" in message:
        with pytest.raises(InputError, match=r"gates.knots: expected knots within 1..9"):
            points(Gates(PLACES, 0.1, knots=[5, 10]), horizon=torch.tensor([N, 9]))


def test_loops_whose_plans_begin_again_refuse_them() -> None:
    for loop in (torchgco.MPC, torchgco.MPPIController):
        with pytest.raises(InputError, match="one without Gates in a loop"):
            loop(points(BALLS))
