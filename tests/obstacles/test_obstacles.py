"""The contract of all obstacles: distances, chords, starts; a kind that cannot be judged raises an error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch
from torchgco import Boxes, FunctionDynamics, InputError, Problem, QuadraticCost, Spheres, certify, judge
from torchgco.base.shapes import Dimensions
from torchgco.dynamics.rollout import open_loop
from torchgco.obstacles import CONTACT_FACTOR, Obstacles
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.roadmap.geometry import scene_of


@dataclass(frozen=True)
class HalfPlane(Obstacles):
    """All points with x > `edge`: a kind that no registry has."""

    edge: float

    def bind(self, dims: Dimensions) -> Self:
        for name, value in {
            "knots": slice(1, dims.N + 1), "position": dims.position, "dt": dims.dt,
            "absent": torch.zeros(dims.B, 1, dtype=torch.bool), "vehicle_radius": dims.like.new_zeros(dims.B),
        }.items():  # fmt: skip
            object.__setattr__(self, name, value)
        return self

    @property
    def margins(self) -> Tensor:
        return torch.zeros_like(self.vehicle_radius).unsqueeze(-1)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return self.edge - p[..., :1]

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return X[:, self.knots, :1] - self.edge


def test_a_kind_that_cannot_be_judged_is_named() -> None:
    problem, U = planar_batch(B=1, N=5)
    problem = Problem(problem.dynamics, problem.cost, [HalfPlane(0.5)], problem.x0, problem.N)
    with pytest.raises(InputError, match=r"HalfPlane\.measured: expected a method of this name"):
        judge(problem, U, torch.zeros(2, dtype=torch.float64), 0.1)
    with pytest.raises(InputError, match=r"HalfPlane\.measured"):
        certify(problem, open_loop(problem.dynamics, problem.x0, U), U)
    assert scene_of(problem, U) is None and bool(problem.start_is_clear.all())


def test_distances_of_spheres_by_hand() -> None:
    problem, _ = planar_batch(B=2, N=4)
    spheres = problem.constraints[0]
    assert isinstance(spheres, BoundSpheres)
    generator = torch.Generator().manual_seed(3)
    p = torch.randn(2, 5, 2, generator=generator, dtype=torch.float64)
    distance = spheres.signed_distance(p, torch.zeros(5, dtype=torch.float64))
    along = spheres.segment_clearance(p[:, :-1], p[:, 1:])
    shares = np.linspace(0, 1, 4001)[:, None]
    for b in range(2):
        for m in range(5):
            o, R = spheres.centers[b, m].numpy(), float(spheres.inflated_radii[b, m])
            if spheres.absent[b, m]:
                assert bool(torch.isinf(distance[b, :, m]).all() & torch.isinf(along[b, :, m]).all())
                continue
            for k in range(5):
                assert float(distance[b, k, m]) == pytest.approx(np.linalg.norm(p[b, k].numpy() - o) - R)
            for k in range(4):
                path = (1 - shares) * p[b, k].numpy() + shares * p[b, k + 1].numpy()
                assert float(along[b, k, m]) == pytest.approx(np.linalg.norm(path - o, axis=1).min() - R, abs=1e-4)
    assert torch.equal(spheres.inflated_radii, spheres.margins) and CONTACT_FACTOR == 0.95


@pytest.mark.parametrize("number", [0.3, torch.tensor(0.3, dtype=torch.float64)])
def test_one_radius_stands_for_all_obstacles(number: Any) -> None:
    centers = torch.tensor([[[1.0, 0.2], [2.0, -0.3]], [[1.2, 0.1], [torch.nan, torch.nan]]], dtype=torch.float64)
    made = lambda radii: [Spheres(centers, radii, 0.1), Boxes(centers, 0.0 * centers + 0.1, radii=radii)]
    x0 = torch.zeros(2, 4, dtype=torch.float64)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, position=slice(0, 2))
    cost = QuadraticCost([1.0] * 4, [0.1] * 2, [9.0] * 4)
    X = torch.rand(2, 11, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 2
    full = 0.3 + 0.0 * centers[..., 0]
    one, all_of_them = (Problem(model, cost, made(radii), x0, 10) for radii in (number, full))
    for a, b in zip(one.constraints, all_of_them.constraints, strict=True):
        assert torch.equal(a.value(X, X[:, :-1, :2]), b.value(X, X[:, :-1, :2]))
