"""Bodies of several balls: places by hand, derivatives against autodiff, one ball, other forms, and bad input."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.problems import planar_batch, quadrotor_batch, random_trajectory
from torchgco import (
    Body,
    Boxes,
    Capsules,
    ControlBounds,
    Field,
    FreeTime,
    FunctionDynamics,
    Goal,
    InputError,
    OccupancyGrid,
    OscillatingBoxes,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    Unicycle,
)
from torchgco.kernels import use_native
from torchgco.maps import PointCloud
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.body import BoundBody
from torchgco.plotting.scene import world_of
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.problem.horizons import for_solvers
from torchgco.roadmap.geometry import scene_of
from torchgco.search.nearby import Nearby
from torchgco.solvers.contracts import Call

D = torch.float64
ROD = Body([[-0.3, 0.0], [0.0, 0.05], [0.4, 0.0]], [0.1, 0.15, 0.08])
FRAME = Body([[0.2, 0.0, 0.0], [-0.1, 0.2, 0.05], [0.0, 0.0, 0.0]], [0.1, 0.15, 0.2], "quaternion")
B = 3


def kinds(d: int, seed: int = 0) -> dict[str, Callable[[Any], Any]]:
    """Obstacles of every kind around the starts of `planar_batch` or `quadrotor_batch`, by the vehicle's radius."""
    rng = np.random.default_rng(seed)
    middle = np.array([-0.8, 0.0]) if d == 2 else np.array([-0.8, 1.0, 0.0])
    centers, radii = middle + rng.normal(0, 0.5, (B, 4, d)), rng.uniform(0.05, 0.2, (B, 4))
    half = rng.uniform(0.05, 0.2, (B, 4, d))
    for numbers in (centers, radii, half):
        numbers[1, -1] = np.nan
    swings = [rng.uniform(0.1, 0.5, (4, 2, d)) for _ in range(3)]
    cells = rng.random((12,) * d) < 0.1
    cloud = PointCloud(centers[0], 0.1)
    return {
        "spheres": lambda r: Spheres(centers, radii, r),
        "moving": lambda r: Spheres(centers, radii, r, 0.3 * np.nan_to_num(half)),
        "boxes": lambda r: Boxes(centers, half, r, radii[..., :] if d == 2 else None),
        "capsules": lambda r: Capsules(centers, centers + 0.3, radii, r),
        "oscillating": lambda r: OscillatingBoxes(Boxes(centers, half, r), *swings),
        "map": lambda r: Field(OccupancyGrid(cells, middle - 1.2, 0.2), r),
        "points": lambda r: Field(cloud, r),
    }


KINDS = list(kinds(2))


def problem_of(d: int, make: Callable[[Any], Any], body: Any = None) -> tuple[Problem, Tensor, Tensor]:
    """A problem among these obstacles, and a trajectory whose vehicle turns."""
    plain, U = planar_batch(B, 8) if d == 2 else quadrotor_batch(B, 8)
    body = (ROD if d == 2 else FRAME) if body is None else body
    problem = Problem(plain.dynamics, plain.cost, [make(body)], plain.x0, 8)
    X, U = random_trajectory(problem, 3, 0.4)
    return problem, X, U


def turned(d: int, x: np.ndarray) -> np.ndarray:
    """The vehicle's frame in a state, by the textbook."""
    if d == 2:
        return np.array([[np.cos(x[2]), -np.sin(x[2])], [np.sin(x[2]), np.cos(x[2])]])
    w, *v = x[6:10] / np.linalg.norm(x[6:10])
    v, cross = np.array(v), np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross  # Rodrigues


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("d", [2, 3])
def test_rows_are_those_of_each_ball(d: int, kind: str) -> None:
    """Each ball's rows and depths are those of a point vehicle of its radius at its place, found by hand."""
    make = kinds(d)[kind]
    problem, X, U = problem_of(d, make)
    body, (part,) = ROD if d == 2 else FRAME, problem.constraints
    found, depths = part.value(X, U), part.violation(X, U)
    point = FunctionDynamics(lambda x, u: u, d, d, problem.dynamics.dt, position=slice(0, d))
    free = QuadraticCost([0.0] * d, [1.0] * d, [0.0] * d)
    M = found.shape[-1] // 3
    for i, (offset, radius) in enumerate(zip(body.offsets.numpy(), body.radii.tolist(), strict=True)):
        P = np.stack([[x[:d] + turned(d, x) @ offset for x in one] for one in X.numpy()])
        alone = Problem(point, free, [make(radius)], torch.tensor(P[:, 0]), 8).constraints[0]
        mine = slice(i * M, i * M + M)
        torch.testing.assert_close(found[..., mine], alone.value(torch.tensor(P), U[..., :0]), rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(depths[..., mine], alone.violation(torch.tensor(P), U), rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(part.at(X[:, 3:5], 4)[:, 1, mine], part.value(X, U)[:, 3, mine])
    assert bool((depths > 0).any()) and bool((depths == 0).any())


@pytest.mark.parametrize(("d", "kind"), [(2, "moving"), (2, "map"), (3, "boxes")])
def test_expansions_are_those_of_autodiff(d: int, kind: str) -> None:
    problem, X, U = problem_of(d, kinds(d)[kind])
    (part,) = problem.constraints
    c = part.value(X, U)
    generator, n, s = torch.Generator().manual_seed(2), problem.n, problem.n + 1 + problem.m
    g, h = (torch.rand(c.shape, generator=generator, dtype=D) for _ in range(2))
    H = torch.zeros(B, 9, s, s, dtype=D)
    part.accumulate(X, U, g, h, H)
    for b in range(B):
        one = part.take(slice(b, b + 1))
        slopes: Any = torch.autograd.functional.jacobian(lambda x, one=one: one.value(x, U[:1])[0], X[b : b + 1])
        for k in range(1, 9):
            J = slopes[k - 1, :, 0, k]
            torch.testing.assert_close(H[b, k, :n, n], J.T @ g[b, k - 1])
            torch.testing.assert_close(H[b, k, :n, :n], J.T @ torch.diag(h[b, k - 1]) @ J)
            assert bool((J[:, 2 if d == 2 else slice(6, 10)] != 0).any())  # it turns


def test_one_ball_at_the_position_is_a_number() -> None:
    make = kinds(2)["boxes"]
    parts: list[Any] = [problem_of(2, make, body)[0].constraints[0] for body in (Body([[0.0, 0.0]], 0.2), 0.2)]
    one, number = parts
    assert type(one) is type(number) and torch.equal(one.depths, number.depths)
    aside = problem_of(2, make, Body([[0.0, 0.1]], 0.2))[0].constraints[0]
    assert isinstance(aside, BoundBody) and len(aside.balls) == 1


def test_a_function_says_the_attitude() -> None:
    """Turned by a function as by the heading; its slopes come from autodiff."""

    def attitude(x: Tensor) -> Tensor:
        cos, sin = x[..., 2].cos(), x[..., 2].sin()
        return torch.stack((torch.stack((cos, -sin), dim=-1), torch.stack((sin, cos), dim=-1)), dim=-2)

    make = kinds(2)["spheres"]
    problem, X, U = problem_of(2, make)
    other = problem_of(2, make, Body(ROD.offsets, ROD.radii, attitude))[0]
    torch.testing.assert_close(other.constraints[0].value(X, U), problem.constraints[0].value(X, U))


@pytest.mark.parametrize("kind", ["spheres", "moving", "boxes", "oscillating", "map"])
def test_distances_between_knots(kind: str) -> None:
    """A close lower bound of those at many states between, also of obstacles that move."""
    problem, X, _ = problem_of(2, kinds(2)[kind])
    part: Any = problem.constraints[0]
    X[..., 2] = X[:, :1, 2] + torch.linspace(0, 3, 9, dtype=D)
    pieces, dt = 100, problem.dynamics.dt
    share = torch.linspace(0, 1, pieces + 1, dtype=D)[:-1].view(1, 1, -1, 1)
    dense = torch.lerp(X[:, :-1, None], X[:, 1:, None], share).flatten(1, 2)
    t = dt / pieces * torch.arange(dense.shape[1], dtype=D)
    least = [ball.signed_distance(P, t) + 0.05 * ball.margins.unsqueeze(1) for ball, P in part.each(dense)]
    exact = torch.cat(least, dim=-1).flatten(1).amin(-1)
    found = part.chord_clearance(X)
    loose = 0.15 if kind == "map" else 0.02  # a field's distances are lower bounds between its nodes
    assert bool((found <= exact + 1e-3).all()) and bool((found >= exact - loose).all()), (found, exact)


def test_parts_of_a_batch_have_the_bits_of_the_whole() -> None:
    problem, X, U = problem_of(3, kinds(3)["moving"])
    part: Any = problem.constraints[0]
    c = part.value(X, U)
    for rows in (torch.tensor([2, 0]), torch.tensor([1])):
        some = part.take(rows)
        assert torch.equal(some.value(X[rows], U[rows]), c[rows])
        assert torch.equal(some.chord_clearance(X[rows]), part.chord_clearance(X)[rows])
        size = problem.n + 1 + problem.m
        whole, own = (torch.zeros(len(i), 9, size, size, dtype=D) for i in (X, rows))
        part.accumulate(X, U, c.abs(), c.abs(), whole)
        some.accumulate(X[rows], U[rows], c[rows].abs(), c[rows].abs(), own)
        assert torch.equal(own, whole[rows])


def test_other_forms_keep_the_rows() -> None:
    """With the controls before, or the time, among the states; and of horizons that end before."""
    plain, make = planar_batch(B, 8)[0], kinds(2)["spheres"]
    parts = [make(ROD), ControlBounds([-1, -1], [1, 1])]
    X, U = random_trajectory(plain, 3, 0.4)
    want = Problem(plain.dynamics, plain.cost, parts, plain.x0, 8).constraints[0].value(X, U)
    rates = for_solvers(Problem(plain.dynamics, plain.cost, [*parts, RateBounds(-1.0, 1.0)], plain.x0, 8))
    timed = for_solvers(Problem(plain.dynamics, plain.cost, parts, plain.x0, 8, time=FreeTime(0.5, 2.0)))
    for form in (rates, timed):
        more = torch.cat((X, X.new_ones(B, 9, form.n - plain.n)), dim=-1)
        (body,) = form.obstacles
        torch.testing.assert_close(body.value(more, U.new_zeros(B, 8, form.m)), want)
    short = for_solvers(Problem(plain.dynamics, plain.cost, parts, plain.x0, 8, horizon=torch.tensor([3, 8, 5])))
    rows = short.obstacles[0].value(X, U)
    assert torch.equal(rows[0, :3], want[0, :3]) and bool((rows[0, 3:] == -1).all()) and torch.equal(rows[1], want[1])


def test_the_search_sees_the_ball_that_the_body_holds() -> None:
    """Paths are sought for it, which the body's length doesn't bar; no obstacle that the body reaches is left out."""
    body = Body([[-2.0, 0.0], [0.0, 0.0], [2.0, 0.0]], 0.5)
    far = [[0.0, 0.0], [3.0, 5.0], [3.0, 30.0]]  # m: a ball alone meets the first on the way, the body two
    x0, cost = torch.zeros(1, 4, dtype=D), QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4, x_ref=[6.0, 0, 0, 0])
    problem = Problem(Unicycle(), cost, [Spheres(far, [0.1] * 3, body)], x0, 5, Goal([6.0, 0.0], 0.5))
    assert body.inscribed_radius == 0.5 and body.reach == 2.5
    scene = scene_of(problem, torch.zeros(1, 5, 2, dtype=D))
    assert scene is not None and scene.obstacles.spheres.radii.tolist() == [[0.6] * 3]
    near = Nearby.of(Call.checked(problem, torch.zeros(1, 5, 2, dtype=D)))
    assert near is not None and near.call.problem.obstacles[0].absent.tolist() == [[False] * 6]
    assert near.places[0].tolist() == [[0, 1, 3, 4, 6, 7]]  # type: ignore[union-attr]
    assert not bool(problem.start_is_clear)
    assert problem.constraints[0].told(4, 1, problem.dynamics) == "ball 1, obstacle 1"
    assert "Body(3 balls among Spheres(3 each of 1 problems))" in repr(problem)


@pytest.mark.parametrize(("d", "kind"), [(2, "spheres"), (2, "capsules"), (3, "boxes")])
@pytest.mark.parametrize("spread", [0.02, 0.4])
def test_only_what_may_be_nearest_is_measured_between_knots(d: int, kind: str, spread: float, monkeypatch) -> None:
    """Of obstacles here and there along the way some are left out, and the clearance keeps its bits."""
    problem, _, _ = problem_of(d, kinds(d)[kind])
    X, _ = random_trajectory(problem, 3, spread)
    (part,) = problem.constraints
    found, near = part.chord_clearance(X), part._nearest(X, 0.05)
    assert near is not None and (spread > 0.1 or near.shape[1] < 4)
    monkeypatch.setattr(BoundBody, "_nearest", lambda self, X, share: None)
    assert torch.equal(found, part.chord_clearance(X))


def test_balls_cover_a_box() -> None:
    car = Body.covering([-0.7, -0.9], [3.3, 0.9], [5, 3])
    rng = np.random.default_rng(0)
    inside = rng.uniform([-0.7, -0.9], [3.3, 0.9], (2000, 2))
    apart = np.linalg.norm(inside[:, None] - car.offsets.numpy(), axis=-1) - 0.95 * car.radii.numpy()
    assert len(car.radii) == 15 and apart.min(-1).max() <= 1e-12


def test_bad_bodies_are_told() -> None:
    cases = [
        (lambda: Body([0.0, 1.0], 0.1), "body.offsets: expected shape (P, 2) or (P, 3)"),
        (lambda: Body([[0.0, np.nan]], 0.1), "body.offsets: expected finite numbers"),
        (lambda: Body([[0.0, 0.0]], [0.1, 0.2]), "body.radii: expected shape (1)"),
        (lambda: Body([[0.0, 0.0]], -0.1), "body.radii: expected finite radii"),
        (lambda: Body([[0.0, 0.0]], 0.1, 3), "body.attitude: expected 'heading', 'quaternion', names of angles"),
        (lambda: problem_of(2, kinds(2)["map"], Body([[0.1, 0.0]], 0.1, "yaw")), "a model with states named yaw"),
        (lambda: Body.covering([0, 0], [1, 0], [2, 2]), "body.upper"),
        (lambda: Body.covering([0, 0], [1, 1], [2, 0]), "body.cells"),
        (lambda: Body([[0.0, 0.0]], 0.1, box=[[0, 0]]), "body.box: expected two corners"),
        (lambda: Body([[0.0, 0.0]], 0.1, box=[[0, 0], [0, 1]]), "body.box: expected two finite corners (2,)"),
        (lambda: problem_of(2, kinds(2)["spheres"], FRAME), "body.offsets: expected 2-D offsets"),
        (lambda: problem_of(3, kinds(3)["map"], ROD), "body.offsets: expected 3-D offsets"),
        (
            lambda: problem_of(2, kinds(2)["map"], Body([[1.0, 0.0]], 1.0, "quaternion")),
            "body.attitude: expected 'heading', or a function, in the plane",
        ),
        (
            lambda: problem_of(2, kinds(2)["boxes"], Body([[1.0, 0.0]], 1.0, lambda x: x[..., :2])),
            "body.attitude: expected rotation matrices (3, 2, 2)",
        ),
        (
            lambda: problem_of(2, kinds(2)["boxes"], Body([[1.0, 0.0]], 1.0, twice)),
            "body.attitude: expected rotation matrices R, with R R' = 1",
        ),
        (without_heading, "body.attitude: expected a model with states named heading"),
    ]  # fmt: skip
    for case, told in cases:
        with pytest.raises(InputError, match=re.escape(told)):
            case()


def twice(x: Tensor) -> Tensor:
    return 2 * torch.eye(2, dtype=D).expand(len(x), 2, 2)


def without_heading() -> None:
    point = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, position=slice(0, 2))
    cost = QuadraticCost([1.0, 1.0], [1.0, 1.0], [1.0, 1.0])
    Problem(point, cost, [Spheres([[5.0, 5.0]], [1.0], ROD)], torch.zeros(1, 2, dtype=D), 3)


def test_positions_alone_are_refused() -> None:
    part: Obstacles = problem_of(2, kinds(2)["spheres"])[0].constraints[0]  # type: ignore[assignment]
    with pytest.raises(InputError, match="body"):
        part.signed_distance(torch.zeros(B, 1, 2, dtype=D), torch.zeros(1, dtype=D))
    with pytest.raises(InputError, match="body"):
        part.segment_clearance(*torch.zeros(2, B, 1, 2, dtype=D))


def test_bodies_among_no_obstacles() -> None:
    problem, X, U = problem_of(2, lambda body: Spheres([], [], body))
    (part,) = problem.constraints
    H = torch.zeros(B, 9, 9, 9, dtype=D)
    part.accumulate(X, U, part.value(X, U), part.value(X, U), H)
    assert part.value(X, U).shape == (B, 8, 0) and not bool(H.any()) and bool(problem.start_is_clear.all())
    assert part.chord_clearance(X).tolist() == [torch.inf] * B  # type: ignore[attr-defined]
    assert part.worst(X, U).tolist() == [0.0] * B


def test_pictures_show_the_balls() -> None:
    """They stand for the vehicle: obstacles aren't grown by a radius, and contacts are those of the balls."""
    problem, X, _ = problem_of(2, kinds(2)["boxes"])
    world = world_of(problem, 1)
    assert world.body is not None
    centers, radii = world.body.balls(X[1].numpy()), world.body.radii
    assert world.first.margin == 0.0 and radii.tolist() == ROD.radii.tolist() and centers.shape == (9, 3, 2)
    x = X[1, 4].numpy()
    np.testing.assert_allclose(centers[4, 2], x[:2] + turned(2, x) @ ROD.offsets[2].numpy(), atol=1e-12)


# A car, a trailer behind its axle, and an arm of two links on the trailer, whose second joint's angle is relative.
ARM = Body([[0.2, 0.0]], 0.08, ("swing", "elbow"), hinge=[0.3, 0.0])
BOOM = Body([[0.15, 0.0]], 0.05, "swing", parts=[ARM], hinge=[-0.4, 0.1])
TRAILER = Body([[-0.3, 0.0]], 0.1, "trailer", hinge=[-0.3, 0.0])
TRUCK = Body([[0.2, 0.0], [-0.2, 0.0]], [0.15, 0.12], "yaw", parts=[TRAILER, BOOM])
TURNED = ("x", "y", "yaw", "trailer", "swing", "elbow")


def jointed(make: Callable[[Any], Any], body: Body = TRUCK, dt: float = 0.1) -> Problem:
    """A point whose angles are turned by controls of their own, among obstacles."""
    model = FunctionDynamics(lambda x, u: x + dt * u, 6, 6, dt, position=slice(0, 2), state_names=TURNED)
    starts = torch.tensor(np.random.default_rng(4).normal(0, 0.3, (B, 6)) - np.eye(6)[0] * 0.8)
    return Problem(model, QuadraticCost([1.0] * 6, [0.1] * 6, [1.0] * 6), [make(body)], starts, 8)


def by_hand(x: np.ndarray) -> np.ndarray:
    """Where the five balls of TRUCK are, by the textbook."""

    def along(angle: float, x: float, y: float = 0.0) -> np.ndarray:
        return np.array([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])

    p, yaw, trailer, swing, elbow = x[:2], *x[2:]
    post = p + along(yaw, -0.4, 0.1)
    tip = post + along(swing, 0.3) + along(swing + elbow, 0.2)
    axle = p + along(yaw, -0.3) + along(trailer, -0.3)
    return np.stack((p + along(yaw, 0.2), p + along(yaw, -0.2), axle, post + along(swing, 0.15), tip))


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
def test_parts_are_where_their_hinges_and_angles_put_them(kind: str) -> None:
    problem = jointed(kinds(2)[kind])
    (part,), X = problem.constraints, torch.tensor(np.random.default_rng(5).normal(0, 1, (B, 9, 6)))
    U = torch.zeros(B, 8, 6, dtype=D)
    centers = np.array([[by_hand(x) for x in one] for one in X.numpy()])
    np.testing.assert_allclose(part.points.at(X).numpy(), centers, atol=1e-12)
    np.testing.assert_allclose(part.radii[0].numpy(), [0.15, 0.12, 0.1, 0.05, 0.08])
    away = np.linalg.norm(centers - X[:, :, None, :2].numpy(), axis=-1) + part.radii[0].numpy()
    assert away.max() <= float(part.reach[0]) <= TRUCK.reach + 1e-9 < 1.1
    c, g = part.value(X, U), torch.rand(B, 8, part.value(X, U).shape[-1], dtype=D)
    H = torch.zeros(B, 9, 13, 13, dtype=D)
    part.accumulate(X, U, g, torch.zeros_like(g), H)
    leaf = X.clone().requires_grad_()
    (slope,) = torch.autograd.grad((part.value(leaf, U) * g).sum(), leaf)
    torch.testing.assert_close(H[..., 6, :6], slope, atol=1e-10, rtol=1e-9)
    torch.testing.assert_close(part.take(torch.tensor([2, 0])).value(X[[2, 0]], U[[2, 0]]), c[[2, 0]])
    if not part.moving:  # a lower bound of what fine states between the knots say
        fine = torch.cat([torch.lerp(X[:, :-1], X[:, 1:], s) for s in torch.linspace(0, 1, 21).tolist()], dim=1)
        assert bool((part.clearances(X)[1] <= part.clearances(fine)[0] + 1e-9).all())


def test_between_knots_no_part_leaves_its_chord_further_than_the_bulge() -> None:
    points, rng = jointed(kinds(2)["spheres"]).constraints[0].points, np.random.default_rng(6)
    for size in (0.1, 1.0, 2.5):
        X = torch.tensor(rng.normal(0, size, (B, 2, 6)))
        X[..., :2] = X[:, :1, :2]  # the position's own chord is straight
        ends, bulge = points.at(X), points.bulge(X)[:, 0]
        for share in np.linspace(0, 1, 33):
            p = points.at(torch.lerp(X[:, :1], X[:, 1:], float(share)))[:, 0]
            chord = ends[:, 1] - ends[:, 0]
            along = (((p - ends[:, 0]) * chord).sum(-1) / chord.square().sum(-1)).clamp(0, 1)
            away = (p - ends[:, 0] - along.unsqueeze(-1) * chord).norm(dim=-1)
            assert bool((away <= bulge + 1e-9).all())


def test_c_solves_bodies_with_parts_as_pytorch_does() -> None:
    problem = jointed(lambda body: Spheres([[-0.2, 0.5]], [0.15], body))
    found = torchgco.solve(problem, solver="al_ilqr")
    use_native(False)
    try:
        plain = torchgco.solve(problem, solver="al_ilqr")
    finally:
        use_native(True)
    torch.testing.assert_close(found.cost, plain.cost, rtol=1e-6, atol=1e-9)
    assert found.account is not None and found.account.kernels == "native"


def test_pictures_show_the_parts() -> None:
    world = world_of(jointed(kinds(2)["spheres"]), 0)
    assert world.body is not None and len(world.body.offsets) == 2
    states = np.random.default_rng(7).normal(0, 1, (3, 6))
    rings = world.body.outlines(states, (0, 1))
    middles = [ring.mean(0) for ring in rings]
    np.testing.assert_allclose(middles, np.concatenate([by_hand(x) for x in states]), atol=0.02)
    box = Body.covering([-0.3, -0.2], [0.3, 0.2], [2, 1], "yaw")
    covered = replace(box, parts=TRUCK.parts)
    hitched = VehicleBody.of(jointed(kinds(2)["spheres"], covered))
    assert hitched is not None and len(hitched.outlines(states, (0, 1))) == 3 + 3 * 3


@pytest.mark.parametrize("make, line", [
    (lambda: Body([[0.0, 0.0]], 0.1, ()), "body.attitude: expected"),
    (lambda: Body([[0.0, 0.0]], 0.1, hinge=[1.0]), "body.hinge: expected"),
    (lambda: Body([[0.0, 0.0]], 0.1, hinge=[1.0, np.nan]), "body.hinge: expected finite"),
    (lambda: Body([[0.0, 0.0]], 0.1, parts=[3]), "body.parts: expected"),
    (lambda: jointed(kinds(2)["map"], Body([[0.0, 0.0]], 0.1, "yaw", parts=[FRAME])), "body.parts: expected 2-D parts"),
    (lambda: jointed(kinds(2)["map"], Body([[0.0, 0.0]], 0.1, "yaw", parts=[ROD])), "states named heading"),
])  # fmt: skip
def test_parts_that_do_not_fit_are_refused_in_a_line(make: Callable[[], Any], line: str) -> None:
    with pytest.raises(InputError) as raised:
        make()
    assert line in str(raised.value) and "\n" not in str(raised.value)
