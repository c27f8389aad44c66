"""Contact with every kind of obstacles: distances by hand, and missions that fly around them or into them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.missions.missions import DOUBLE, SOLVER, far, mission
from tests.missions.test_mission import ends
from tests.obstacles.test_obstacles import HalfPlane
from tests.slow import mostly
from torchgco import Boxes, Capsules, ControlBounds, InputError, Problem, Spheres
from torchgco.constraints import Constraint
from torchgco.missions.contact import Contact
from torchgco.missions.outcome import Outcome

VEHICLE = 0.2  # m
# Obstacles on the way from the origin to (2, 0, 0), m: each is passed at its shorter side, or after it has gone by.
KINDS: dict[str, Constraint] = {
    "sphere": Spheres([[1.0, 0.15, 0.0]], [0.3], VEHICLE),
    "moving sphere": Spheres([[1.0, 0.9, 0.0]], [0.3], VEHICLE, [[0.0, -0.55, 0.0]]),
    "box": Boxes([[1.0, 0.3, 0.0]], [[0.1, 0.35, 0.8]], VEHICLE),
    "turned box": Boxes([[1.0, 0.4, 0.0]], [[0.2, 0.4, 0.8]], VEHICLE, [[np.cos(0.2), 0.0, 0.0, np.sin(0.2)]]),
    "trunk": Capsules([[1.0, 0.1, -2.0]], [[1.0, 0.1, 2.0]], [0.2], VEHICLE),
}


def among(*obstacles: Constraint, B: int = 1) -> Problem:
    plain = far(B, N=25)
    return replace(plain, constraints=[*obstacles, ControlBounds([-5, -5, -5, 0.26], [5, 5, 5, 14.9])])


def by_hand(kind: str, p: np.ndarray, t: float) -> float:
    """The distance of a position (3,) at time t from contact with one of KINDS, m."""
    obstacle: Any = KINDS[kind]
    if isinstance(obstacle, Spheres):
        velocity = 0.0 if obstacle.velocities is None else np.array(obstacle.velocities[0])
        return float(np.linalg.norm(p - np.array(obstacle.centers[0]) - t * velocity)) - 0.95 * 0.5
    if isinstance(obstacle, Capsules):
        axis = np.array([1.0, 0.1, np.clip(p[2], -2.0, 2.0)])
        return float(np.linalg.norm(p - axis)) - 0.95 * 0.4
    away, half = p - np.array(obstacle.centers[0]), np.array(obstacle.half_sizes[0])
    angle = 0.4 if kind == "turned box" else 0.0
    turned = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]]) @ away
    over = np.abs(turned) - half
    return float(np.linalg.norm(np.maximum(over, 0.0)) + min(over.max(), 0.0)) - 0.95 * VEHICLE


@pytest.mark.parametrize("kind", KINDS)
def test_distances_are_those_by_hand_at_an_instant_and_along_the_way(kind: str) -> None:
    contact, dt = Contact.among(among(KINDS[kind], B=3)), 0.4
    rng = np.random.default_rng(1)
    p = rng.uniform([0.3, -0.7, -0.9], [1.7, 0.9, 0.9], (3, 4, 3))
    held = torch.from_numpy(p)
    expected = [[by_hand(kind, p[b, k], k * dt) for k in range(4)] for b in range(3)]
    torch.testing.assert_close(contact.distances(held, dt), torch.tensor(expected, **DOUBLE))
    torch.testing.assert_close(contact.distance(held[:, 2], 2 * dt), torch.tensor(expected, **DOUBLE)[:, 2])
    shares = np.linspace(0.0, 1.0, 401)
    for b in range(3):
        steps = ((k + s, (1 - s) * p[b, k] + s * p[b, k + 1]) for k in range(3) for s in shares)
        dense = min(by_hand(kind, place, dt * share) for share, place in steps)
        assert dense - 1e-2 < float(contact.along(held, dt)[b]) <= dense + 1e-9
    part = contact.take(torch.tensor([2, 0]))
    assert torch.equal(part.along(held[[2, 0]], dt), contact.along(held, dt)[[2, 0]])


BLIND = replace(SOLVER, initial_penalty=1e-12, max_outer_iterations=1)  # obstacles cost it next to nothing


@pytest.mark.slow
@pytest.mark.parametrize("kind", mostly(KINDS, "sphere", "box", "trunk", "turned box"))
def test_a_mission_flies_around_obstacles_of_every_kind_and_sees_contact_with_them(kind: str) -> None:
    problem, radius = among(KINDS[kind]), torch.tensor([0.6], **DOUBLE)
    careful = mission(SOLVER, 3.0, goal_radius=0.6).fly(problem)
    (end,) = ends(careful, problem, radius)
    assert end.outcome is Outcome.REACHED and 0.0 <= end.clearance < 0.3
    blind = mission(BLIND, 3.0, goal_radius=0.6).fly(problem)
    (end,) = ends(blind, problem, radius)
    assert end.outcome is Outcome.COLLISION and end.clearance < 0.0
    assert int(blind.steps()[0]) == int(np.ceil(end.flight_time / 0.05 - 1e-9)), "the simulation has seen it, too"


def test_several_kinds_count_together_and_none_is_far_away() -> None:
    p = torch.tensor([[0.7, 0.2, 0.1]], **DOUBLE)
    apart = [Contact.among(among(KINDS[kind])).distance(p, 0.3) for kind in KINDS]
    together = Contact.among(among(*KINDS.values())).distance(p, 0.3)
    assert torch.equal(together, torch.stack(apart).amin(0))
    empty = Contact.among(among(Spheres(torch.zeros(0, 3, **DOUBLE), torch.zeros(0, **DOUBLE), VEHICLE)))
    for contact in (empty, Contact.among(among())):
        assert contact.along(p.unsqueeze(1), 0.1).tolist() == [torch.inf]
        assert contact.distances(p.unsqueeze(1)[:, :0], 0.1).shape == (1, 0)


def test_a_kind_of_ones_own_counts_once_the_judge_knows_it(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = far()
    problem = Problem(plain.dynamics, plain.cost, [HalfPlane(1.0)], plain.x0, plain.N, plain.goal)
    with pytest.raises(InputError, match="got HalfPlane"):
        Contact.among(problem)

    def measured(wall: HalfPlane, X: Tensor) -> tuple[Tensor, Tensor]:
        away = wall.edge - X[..., :1]
        return away, torch.minimum(away[:, :-1], away[:, 1:])

    monkeypatch.setattr(HalfPlane, "measured", measured)
    p = torch.tensor([[[0.2, 0.0, 0.0], [0.7, 0.0, 0.0]]], **DOUBLE)
    assert Contact.among(problem).along(p, 0.1).tolist() == [pytest.approx(0.3)]
