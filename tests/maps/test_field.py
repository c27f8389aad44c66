"""Distance fields and the constraint, against cells and points measured one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference.maps import distance_from_cells, lower_square, signed_distance
from tests.slow import mostly
from torchgco import ControlBounds, Field, Goal, InputError, Planar, Problem, QuadraticCost, QuadrotorPlanning
from torchgco.maps import DistanceField, OccupancyGrid, PointCloud
from torchgco.maps import field as field_module
from torchgco.maps.field import BoundField
from torchgco.maps.lookup import lengths

SHAPES = {2: (9, 7), 3: (6, 5, 4)}


def random_grid(d: int, seed: int = 0, share: float = 0.12) -> OccupancyGrid:
    rng = np.random.default_rng(seed)
    cells = rng.random(SHAPES[d]) < share
    cells[1:4, 1:4] = True  # thick enough to have an inside
    return OccupancyGrid(cells, -0.3 * np.arange(1, d + 1), 0.2)


def bound(field: DistanceField, radius: float | list[float] = 0.1, smooth: bool = True, B: int = 1) -> BoundField:
    model = Planar(dt=0.05) if field.d == 2 else QuadrotorPlanning(dt=0.05)
    cost = QuadraticCost([1.0] * model.n, [1.0] * model.m, [1.0] * model.n, [0.0] * model.n)
    constraint = Field(field, radius, "smooth" if smooth else "linear")
    problem = Problem(model, cost, [constraint], torch.zeros(B, model.n, dtype=torch.float64), 3)
    (part,) = problem.constraints
    assert isinstance(part, BoundField)
    return part


def points_around(grid: OccupancyGrid, count: int, seed: int = 1, beyond: float = 0.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(grid.origin - beyond, grid.upper + beyond, (count, grid.d))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("refine", [1, 2, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_nodes_have_the_exact_distances(d: int, refine: int) -> None:
    grid = random_grid(d)
    field = DistanceField.of(grid, refine=refine)
    assert field.values.shape == (1, *(refine * size + 1 for size in grid.shape))
    for index in np.random.default_rng(3).permutation(list(np.ndindex(field.values.shape[1:])))[:150]:
        p = field.origin[0] + field.spacing * index
        due = signed_distance(p, grid.is_occupied, grid.origin, grid.resolution)
        assert field.values[0][tuple(index)] == pytest.approx(due, abs=1e-6)
    assert (field.values < -0.05).any()


@pytest.mark.parametrize("smooth", mostly([True, False], False))
@pytest.mark.parametrize("d", [2, 3])
def test_values_between_nodes_are_those_of_the_slow_sum_and_never_too_large(d: int, smooth: bool) -> None:
    grid = random_grid(d)
    field = DistanceField.of(grid, refine=1 if d == 3 else 2)
    part, p = bound(field, 0.15, smooth), points_around(grid, 150)
    core, R = float(part.cores), float(part.vehicle_radius)
    c = part.at(torch.nn.functional.pad(torch.from_numpy(p)[None], (0, 10)), 1)[0, :, 0]
    for i, at in enumerate(p):
        G = lower_square(at, field.values[0], field.origin[0], field.spacing, core, smooth)
        assert float(c[i]) == pytest.approx(float(part.factors) * (R * R - G), rel=1e-9, abs=1e-12)
    distance = part.signed_distance(torch.from_numpy(p)[None], torch.zeros(len(p)))[0, :, 0].numpy() + R
    due = np.array([distance_from_cells(at, grid.is_occupied, grid.origin, grid.resolution) for at in p])
    assert (distance <= due + 1e-6).all()
    kept_clear = c.numpy() <= 0
    assert (due[kept_clear] >= R - 1e-6).all() and kept_clear.any() and (~kept_clear).any()
    within = (p > grid.origin).all(1) & (p < grid.upper).all(1) & (due > R)
    assert (due - distance)[within].max() < 0.75 * field.spacing * d**0.5


def test_a_radius_of_zero_and_radii_below_a_cell_are_kept() -> None:
    grid = random_grid(2)
    field = DistanceField.of(grid)
    p = points_around(grid, 400)
    due = np.array([distance_from_cells(at, grid.is_occupied, grid.origin, grid.resolution) for at in p])
    for radius in (0.0, 0.02, 0.05):
        part = bound(field, radius)
        c = part.at(torch.nn.functional.pad(torch.from_numpy(p)[None], (0, 4)), 1)[0, :, 0].numpy()
        assert (due[c <= 0] >= radius - 1e-6).all()
        assert (c[due > radius + 1.5 * field.spacing] < 0).all()
        distance = part.signed_distance(torch.from_numpy(p)[None], torch.zeros(1))[0, :, 0].numpy()
        assert ((c <= 0) == (distance >= 0)).all()


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("d", [2, 3])
def test_slopes_are_autodiffs(d: int, smooth: bool) -> None:
    grid = random_grid(d)
    part = bound(DistanceField.of(grid), [0.1, 0.3], smooth, B=2)
    X = torch.nn.functional.pad(torch.from_numpy(points_around(grid, 2 * 40)).view(2, 40, d), (0, 4 if d == 2 else 7))
    part = replace(part, knots=slice(0, 40))
    U = torch.zeros(2, 39, 2, dtype=torch.float64)
    slopes = torch.func.jacrev(lambda X: part.value(X, U).sum((1, 2)))(X)  # (2, 2, 40, n)
    n = X.shape[-1]
    H = torch.zeros(2, 40, n + 3, n + 3, dtype=torch.float64)
    one = torch.ones(2, 40, 1, dtype=torch.float64)
    part.accumulate(X, U, one, one, H)
    due = torch.stack([slopes[b, b] for b in range(2)])
    torch.testing.assert_close(H[:, :, :n, n], due, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(H[:, :, :n, :n], due.unsqueeze(-1) * due.unsqueeze(-2), rtol=1e-10, atol=1e-12)
    assert not bool(slopes[0, 1].any())


def test_smooth_values_have_continuous_slopes_and_linear_ones_have_kinks() -> None:
    grid = random_grid(3)
    field = DistanceField.of(grid)
    rng, eps = np.random.default_rng(0), 1e-7
    jumps = {}
    for smooth in (True, False):
        half = 0.5 if smooth else 0.0  # where one set of nodes gives way to the next
        at = field.origin[0] + field.spacing * (rng.integers(-3, 12, (60, 3)) + half)
        part = bound(field, 0.1, smooth)
        H = [torch.zeros(1, 60, 15, 15, dtype=torch.float64) for _ in range(2)]
        for side, sign in zip(H, (-1, 1), strict=True):
            X = torch.nn.functional.pad(torch.from_numpy(at + sign * eps)[None], (0, 7))
            one = torch.ones(1, 60, 1, dtype=torch.float64)
            replace(part, knots=slice(0, 60)).accumulate(X, torch.zeros(1, 59, 4).double(), one, one, side)
        jumps[smooth] = float((H[0] - H[1])[..., :3, 10].abs().max())
    assert jumps[True] < 1e-4 < 1e-2 < jumps[False]


def test_inside_of_a_thin_wall_the_row_pushes_out_and_far_away_it_is_met() -> None:
    cells = np.zeros((30, 30), bool)
    cells[14] = True
    part = bound(DistanceField.of(OccupancyGrid(cells, [0, 0], 0.1)), 0.2)
    p = torch.tensor([[[1.42, 1.5], [1.48, 1.5], [40.0, -70.0], [1.45, 9.0], [torch.nan, 0.0]]]).double()
    X = torch.nn.functional.pad(p, (0, 4))
    H = torch.zeros(1, 5, 9, 9, dtype=torch.float64)
    one = torch.ones(1, 5, 1, dtype=torch.float64)
    replace(part, knots=slice(0, 5)).accumulate(X, torch.zeros(1, 4, 2).double(), one, one, H)
    assert float(H[0, 0, 0, 6]) > 0.1 and float(H[0, 1, 0, 6]) < -0.1  # to the nearer side
    c = part.at(X, 1)[0, :, 0]
    assert bool((c[:2] > 0).all()) and bool((c[2:4] < 0).all()) and bool(torch.isnan(c[4]))
    # Of a point beyond the edge, the distance from the nearest point of the grid counts too.
    assert float(lengths(part.vehicle_radius.square() - c[3] / part.factors, part.cores)) == pytest.approx(
        6.0, abs=0.01
    )


def test_unknown_cells_are_occupied_unless_told_otherwise() -> None:
    cells = np.zeros((5, 5), np.int8)
    cells[2, 2] = -1
    grid = OccupancyGrid(cells, [0, 0], 1.0)
    assert DistanceField.of(grid).values.min() == -0.5
    free = bound(DistanceField.of(grid, unknown="free"))
    assert bool(free.absent.all()) and float(free.at(torch.zeros(1, 1, 6).double(), 1)) == -1.0


def test_a_map_per_problem_is_shared_by_subsets_and_one_map_by_all() -> None:
    grids = [random_grid(2, seed) for seed in (0, 1, 2)]
    origins = np.stack([grid.origin + i for i, grid in enumerate(grids)])
    many = DistanceField.of(OccupancyGrid(np.stack([grid.occupied for grid in grids]), origins, 0.2))
    part = bound(many, 0.1, B=3)
    some = part.take(torch.tensor([2, 0, 2]))
    assert some.field is part.field and some.lattice.nodes.data_ptr() == part.lattice.nodes.data_ptr()
    p = torch.from_numpy(points_around(grids[0], 20)).expand(3, 20, 2) + torch.arange(3).view(3, 1, 1)
    rows = part.at(torch.nn.functional.pad(p, (0, 4)), 1)
    for b, grid in enumerate(grids):
        alone = bound(DistanceField.of(replace(grid, origin=grid.origin + b)), 0.1)
        assert torch.equal(alone.at(torch.nn.functional.pad(p[b : b + 1], (0, 4)), 1), rows[b : b + 1])
    assert torch.equal(some.at(torch.nn.functional.pad(p[[2, 0, 2]], (0, 4)), 1), rows[[2, 0, 2]])
    with pytest.raises(InputError, match="one map for all, or 2 maps"):
        bound(many, B=2)


@pytest.mark.parametrize("d", [2, 3])
def test_clouds_are_balls(d: int) -> None:
    rng = np.random.default_rng(0)
    centers = rng.uniform(-1, 1, (30, d))
    field = DistanceField.of(PointCloud(centers, 0.1))
    p = rng.uniform(-1.5, 1.5, (1000, d))
    distance = field.distance(p).numpy()
    due = np.linalg.norm(p[:, None] - centers, axis=-1).min(-1) - 0.1
    within = (np.abs(p) < 1.0).all(1)  # beyond the points the distance from their box counts
    assert (distance <= due + 1e-6)[due > 0].all() and (due - distance)[within & (due > 0)].max() < 0.1
    # Where all nodes see the same point, and none of them from within the core, nothing is lost.
    few = DistanceField.of(PointCloud(np.concatenate((np.zeros((1, d)), np.eye(d), -np.eye(d))), 0.0), resolution=0.1)
    p = p[(np.abs(p) < 0.3).all(1)]
    away = np.linalg.norm(p, axis=-1)
    some = (away > 0.2) & (away < 0.3)
    assert some.any() and np.abs(few.distance(p).numpy() - away)[some].max() < 1e-6


@pytest.mark.parametrize("d", [2, 3])
def test_starts_are_measured_exactly(d: int) -> None:
    """A start that touches nothing isn't refused because an interpolated distance is too low."""
    grid, R = random_grid(d), 0.15
    field = DistanceField.of(grid, refine=1)
    p = points_around(grid, 200)
    due = np.array([distance_from_cells(at, grid.is_occupied, grid.origin, grid.resolution) for at in p])
    part = bound(field, [R] * len(p), B=len(p))
    x0 = torch.nn.functional.pad(torch.from_numpy(p), (0, 4 if d == 2 else 7))
    assert part.start_is_clear(x0).tolist() == (due >= 0.95 * R).tolist()
    bounds = part.signed_distance(torch.from_numpy(p).unsqueeze(1), torch.zeros(1))[:, 0, 0].numpy()
    assert ((bounds < -0.05 * R) & (due >= 0.95 * R)).any()
    cloud = PointCloud(p, 0.0)
    inside = bound(DistanceField.of(cloud, resolution=0.1), R).start_is_clear(x0[:1])
    assert inside.tolist() == [False]


def brute_clearance(grid: OccupancyGrid, a: Tensor, b: Tensor) -> np.ndarray:
    share = np.linspace(0, 1, 201)[:, None]
    lines = [x + share * (y - x) for x, y in zip(a.numpy(), b.numpy(), strict=True)]
    measure = lambda p: distance_from_cells(p, grid.is_occupied, grid.origin, grid.resolution)
    return np.array([min(map(measure, line)) for line in lines])


def test_segments_are_measured_where_they_come_near() -> None:
    grid = random_grid(2, share=0.03)
    part = bound(DistanceField.of(grid), 0.1)
    p = torch.from_numpy(points_around(grid, 40)).view(2, 20, 2)
    due = brute_clearance(grid, *p)
    for e in range(20):  # alone: none is left out
        found = float(part.segment_clearance(p[:1, e : e + 1], p[1:, e : e + 1])) + 0.1
        assert found <= due[e] + 1e-9 and (due[e] - found < 0.1 or due[e] == 0)
    together = part.segment_clearance(p[:1], p[1:])
    assert float(together.amin()) + 0.1 <= due.min() + 1e-9


def test_a_segment_that_leads_far_beyond_the_map_is_looked_up_near_it_alone(monkeypatch) -> None:
    """In pieces, of which all that can't be nearer are skipped: the smallest of all points is found."""
    grid = random_grid(2, share=0.03)
    part = bound(DistanceField.of(grid), 0.1)
    middle = 0.5 * (points_around(grid, 40).min(0) + points_around(grid, 40).max(0))
    looked, real = [], field_module.squares
    monkeypatch.setattr(field_module, "squares", lambda *words: looked.append(words[1].shape[:2]) or real(*words))
    for angle in np.linspace(0.1, 6.0, 5):
        way = torch.tensor([np.cos(angle), np.sin(angle)])
        a, b = (torch.from_numpy(middle) + far * way for far in (-31.7, 450.3))
        looked.clear()
        found = float(part.segment_clearance(a.view(1, 1, 2), b.view(1, 1, 2)))
        pieces = math.ceil(482.0 / (0.5 * part.field.spacing))
        assert pieces > 3 * field_module.PIECE and sum(B * K for B, K in looked) < 0.7 * pieces
        assert max(B * K for B, K in looked) <= field_module.PIECE + 1
        points = a + torch.linspace(0, 1, pieces + 1, dtype=torch.float64).unsqueeze(-1) * (b - a)
        r = float(part.signed_distance(points.unsqueeze(0), torch.zeros(pieces + 1)).amin()) + 0.1
        half = 0.5 * 482.0 / pieces
        due = (r * r - half * half) ** 0.5 if r > half else r - half
        assert found + 0.1 == pytest.approx(due, abs=1e-6)
    far = torch.tensor([[[1e7, 0.0], [torch.inf, 0.0], [torch.nan, 1.0]]], dtype=torch.float64)
    looked.clear()
    part.segment_clearance(-far, far)  # no memory for the points between
    assert max(B * K for B, K in looked) <= field_module.POINTS_AT_ONCE


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Field(3.0), "field.field"),
        (lambda: Field(random_grid(2), interpolation="cubic"), "field.interpolation"),
        (lambda: bound(DistanceField.of(random_grid(2)), -1.0), "field.vehicle_radius"),
        (lambda: DistanceField.of(np.zeros((3, 3))), "field.source"),
        (lambda: DistanceField.of(random_grid(2), refine=0), "field.refine"),
        (lambda: DistanceField.of(random_grid(2), resolution=0.1), "field.resolution"),
        (lambda: DistanceField.of(PointCloud([[0.0, 0.0]], 0.0)), "field.resolution"),
        (lambda: DistanceField.of(PointCloud([[0.0, 0.0], [1e6, 1e6]], 0.01)), "field"),
        (lambda: DistanceField.of(random_grid(2), unknown="maybe"), "field.unknown"),
        (lambda: DistanceField.of(random_grid(2)).distance([[0.0, 0.0, 0.0]]), "points"),
    ],
)
def test_wrong_fields_are_refused(make, field: str) -> None:
    with pytest.raises(InputError) as error:
        make()
    assert error.value.field == field


def test_a_map_of_another_space_is_refused() -> None:
    cost = QuadraticCost([1.0] * 6, [1.0] * 2, [1.0] * 6, [0.0] * 6)
    with pytest.raises(InputError, match="a 2-D map, as the vehicle's position is 2-D, got 3-D"):
        Problem(
            Planar(dt=0.1),
            cost,
            [Field(random_grid(3)), ControlBounds(-1, 1)],
            torch.zeros(1, 6).double(),
            5,
            Goal([1, 1], 1),
        )
