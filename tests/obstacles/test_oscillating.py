"""Boxes on sums of sines: places, rows, derivatives, chords, the judge and the certificate, against plain NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import quadrotor_batch
from torchgco import Boxes, Goal, OscillatingBoxes, Problem, QuadraticCost, certify, judge
from torchgco.base.errors import InputError
from torchgco.exploration.sensing import World
from torchgco.missions.contact import Contact
from torchgco.obstacles.boxes import BoundOscillatingBoxes

B, M, S, N, DT = 3, 4, 2, 6, 0.05


def drawn(seed: int = 0) -> tuple[np.ndarray, ...]:
    """Centres, half sides, quaternions, and the three arrays of sines, of M boxes in each of B problems."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(B, M, 4))
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    sines = rng.uniform(-1, 1, (B, M, S, 3)), rng.uniform(0.2, 2, (B, M, S, 3)), rng.uniform(0, 6, (B, M, S, 3))
    return rng.uniform(-3, 3, (B, M, 3)), rng.uniform(0.2, 0.6, (B, M, 3)), turns, *sines


def problem_of(arrays: tuple[np.ndarray, ...], radius: float = 0.2) -> Problem:
    task, _ = quadrotor_batch(B)
    centers, half, turns, *sines = map(torch.from_numpy, arrays)
    swings = OscillatingBoxes(Boxes(centers, half, radius, turns), *sines)
    dynamics = replace(task.dynamics, dt=DT)
    return Problem(dynamics, task.cost, [swings], task.x0, N, Goal(torch.zeros(B, 3).double(), 0.4))


def place(arrays: tuple[np.ndarray, ...], b: int, m: int, t: float) -> np.ndarray:
    centers, _, _, amplitudes, rates, phases = arrays
    return centers[b, m] + sum(amplitudes[b, m, s] * np.sin(rates[b, m, s] * t + phases[b, m, s]) for s in range(S))


def distance(arrays: tuple[np.ndarray, ...], b: int, m: int, p: np.ndarray, t: float) -> float:
    w, x, y, z = arrays[2][b, m]
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    over = np.abs(turn.T @ (p - place(arrays, b, m, t))) - arrays[1][b, m]
    return float(np.linalg.norm(np.maximum(over, 0)) + min(over.max(), 0.0))


def bound(problem: Problem) -> BoundOscillatingBoxes:
    (part,) = problem.constraints
    assert isinstance(part, BoundOscillatingBoxes)
    return part


def flown(seed: int = 1) -> tuple[Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    X = torch.from_numpy(rng.uniform(-3, 3, (B, N + 1, 14)))
    return X, torch.from_numpy(rng.uniform(-1, 1, (B, N, 4)))


def test_distances_and_rows_agree_with_numpy() -> None:
    arrays = drawn()
    problem, (X, U) = problem_of(arrays), flown()
    part = bound(problem)
    found = part.signed_distance(X[:, 1:, :3], DT * torch.arange(1, N + 1).double()).numpy()
    for b in range(B):
        for k in range(N):
            for m in range(M):
                expected = distance(arrays, b, m, X[b, k + 1, :3].numpy(), DT * (k + 1)) - 0.2
                assert found[b, k, m] == pytest.approx(expected, abs=1e-12)
    depth = 0.2 + arrays[1].min(axis=-1)
    assert np.allclose(part.value(X, U).numpy(), -2.0 * depth[:, None] * found, atol=1e-12)
    assert torch.equal(part.at(X[:, 3:4], 3)[:, 0], part.value(X, U)[:, 2])
    later = part.later(0.7).signed_distance(X[:, :1, :3], torch.zeros(1).double())
    now = part.signed_distance(X[:, :1, :3], torch.tensor([0.7]).double())
    assert part.moving and torch.allclose(later, now, atol=1e-12)


def test_derivatives_agree_with_autodiff() -> None:
    part, (X, U) = bound(problem_of(drawn())), flown()
    g, h = torch.rand(B, N, M).double(), torch.rand(B, N, M).double()
    H = torch.zeros(B, N + 1, 19, 19).double()
    part.accumulate(X, U, g, torch.zeros_like(h), H)
    x = X.clone().requires_grad_()
    (slope,) = torch.autograd.grad((g * part.value(x, U)).sum(), x)
    assert torch.allclose(H[..., :14, 14], slope, atol=1e-12)
    H.zero_()
    part.accumulate(X, U, torch.zeros_like(g), h, H)
    for b in range(B):
        rows = torch.func.jacrev(lambda x: part.take(slice(b, b + 1)).value(x.unsqueeze(0), U[:1])[0])(X[b])  # noqa: B023
        for k in range(N):
            own = rows[k, :, k + 1]
            assert torch.allclose(H[b, k + 1, :14, :14], (h[b, k, :, None] * own).T @ own, atol=1e-12)


def test_what_lies_between_knots_is_never_nearer_than_said() -> None:
    arrays = drawn()
    problem, (X, U) = problem_of(arrays), flown()
    part, shares = bound(problem), np.linspace(0, 1, 60)
    contact = Contact.among(problem).along(X[..., :3], DT)
    chords = part.chord_clearance(X, 0.0)
    certified = certify(problem, X, U).clearance
    for b in range(B):
        least = np.inf
        for k in range(N):
            for share in shares:
                p = ((1 - share) * X[b, k, :3] + share * X[b, k + 1, :3]).numpy()
                least = min(least, *(distance(arrays, b, m, p, DT * (k + share)) for m in range(M)))
        for value, radius in ((contact[b], 0.95 * 0.2), (chords[b], 0.2), (certified[b], 0.2)):
            assert float(value) <= least - radius + 1e-9 and float(value) > least - radius - 0.1
    assert float(part.bulge.max()) < 0.01


def test_a_box_that_comes_is_touched_and_one_that_has_left_is_not() -> None:
    """A cube on x = 2 cos t around the origin, of half side 0.4: at x = 0 from t = 1.27 to 1.87 with a ball of 0.1."""
    arrays = [np.zeros((B, 1, 3)), np.full((B, 1, 3), 0.4), np.tile([1.0, 0, 0, 0], (B, 1, 1))]
    sines = [np.zeros((B, 1, 1, 3)) for _ in range(3)]
    sines[0][..., 0], sines[1][..., 0], sines[2][..., 0] = 2.0, 1.0, 0.5 * np.pi
    contact = Contact.among(problem_of((*arrays, *sines), 0.1))
    here = torch.zeros(B, 3).double()
    touched = [bool((contact.distance(here, t) < 0).all()) for t in (0.0, 1.31, 1.33, 1.81, 1.83, 3.0)]
    edge = np.arccos((0.4 + 0.095) / 2)  # 1.32
    assert 1.31 < edge < 1.33 and touched == [False, False, True, True, False, False]
    way = here.unsqueeze(1).expand(-1, 3, -1)
    assert bool((contact.along(way, 1.57) < 0).all()) and float(contact.distance(here, 0.0)[0]) == pytest.approx(1.505)


def test_a_sensor_sees_it_where_it_is() -> None:
    arrays = drawn()
    world = World.of(problem_of(arrays), 1).at(1.3)
    assert np.allclose(world.boxes[:, :3], [place(arrays, 1, m, 1.3) for m in range(M)]) and not world.moving
    assert np.allclose(world.boxes[:, 12:15], arrays[1][1])


def test_problems_keep_their_bits_and_absent_boxes_count_nowhere() -> None:
    centers, half, turns, *sines = drawn()
    centers[1, 2], half[1, 2], turns[1, 2] = np.nan, np.nan, np.nan
    problem, (X, U) = problem_of((centers, half, turns, *sines)), flown()
    part, order = bound(problem), torch.tensor([2, 0, 1])
    assert torch.equal(part.take(order).value(X[order], U), part.value(X, U)[order])
    assert torch.equal(part.take(order[:1]).chord_clearance(X[order[:1]]), part.chord_clearance(X)[order[:1]])
    assert bool((part.value(X, U)[1, :, 2] == -1.0).all())
    assert bool(torch.isfinite(judge(problem, U).clearance).all())


@pytest.mark.slow
def test_a_problem_among_them_is_solved() -> None:
    import torchgco

    sines = [np.zeros((1, 2, 3)) for _ in range(3)]
    sines[0][0, 0, 1], sines[1][0, 0, 1] = 0.5, 1.0
    boxes = Boxes([[1.0, 0.1, 0.0]], [[0.2, 0.2, 0.2]], 0.1)
    task, _ = quadrotor_batch(1)
    cost = QuadraticCost(Q=[1.0] * 14, R=[0.1] * 4, Qf=[50.0] * 14, x_ref=[2.0, *[0.0] * 5, 1.0, *[0.0] * 6, 9.81])
    start = torch.zeros(1, 14).double()
    start[:, 6], start[:, 13] = 1.0, 9.81
    swings = OscillatingBoxes(boxes, *sines)
    problem = Problem(task.dynamics, cost, [swings], start, 60, Goal([[2.0, 0.0, 0.0]], 0.3))
    solution = torchgco.solve(problem)
    assert bool(judge(problem, solution.U).reached.all())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"amplitudes": [[[0.0] * 3]]}, "boxes.rates: expected shape"),
        ({"amplitudes": [[[0.0] * 3]] * 2, "rates": [[[0.0] * 3]] * 2}, "boxes.amplitudes: expected shape"),
        ({"phases": [[[np.inf] * 3, [0.0] * 3]]}, "boxes.phases: expected finite numbers"),
    ],
)
def test_wrong_sines_are_refused(change: dict, message: str) -> None:
    sines = {name: [[[0.1] * 3, [0.0] * 3]] for name in ("amplitudes", "rates", "phases")}
    task, _ = quadrotor_batch(1)
    swings = OscillatingBoxes(Boxes([[1.0, 0.0, 0.0]], [[0.2] * 3]), **(sines | change))
    with pytest.raises(InputError, match=message):
        Problem(task.dynamics, task.cost, [swings], task.x0, 5)
