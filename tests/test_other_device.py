"""PyTorch's kernels on a device besides the CPU that is none: no operation mixes devices, and all bits are the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from tests.other_device import OTHER, SecondDevice
from tests.slow import mostly
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    Body,
    Boxes,
    Capsules,
    ControlBounds,
    FunctionConstraint,
    Goal,
    InteriorPoint,
    OscillatingBoxes,
    Planar,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    StateBounds,
    certify,
    judge,
)
from torchgco.base.shapes import computing_on
from torchgco.experiments.config.build import compose
from torchgco.kernels import use_native
from torchgco.maps import Field, OccupancyGrid
from torchgco.maps.distance import DistanceField
from torchgco.missions import RotorPlant
from torchgco.roadmap.geometry import scene_of
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search.reach import limit_of

N, R = 3, 0.06
DOUBLE: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
WALL = np.pad(np.ones((3, 6), bool), 8)
LOCAL = AugmentedLagrangian(ILQR(max_iterations=1), max_outer_iterations=1)


def constraints(kind: str, device: Any) -> list[Any]:
    put = lambda value: torch.tensor(value, **DOUBLE).to(device)
    center, half = put([[0.1, 0.15]]), put([[0.1, 0.2]])
    parts = {
        "spheres": lambda: Spheres(center, put([0.15]), R, velocities=put([[0.05, 0.0]])),
        "boxes": lambda: Boxes(center, half, R, rotations=put([0.3])),
        "capsules": lambda: Capsules(center, center + half, put([0.1]), R),
        "body": lambda: Spheres(center, put([0.15]), Body([[-0.1, 0.0], [0.1, 0.0]], R)),
        "oscillating": lambda: OscillatingBoxes(Boxes(center, half, R), *[put([[[0.05, 0.05]]])] * 3),
        "map": lambda: Field(OccupancyGrid(WALL, [-1.7, -2.0], 0.15), vehicle_radius=R),
        "states": lambda: StateBounds(put([-9.0, -9, -9, -1, -1, -9]), put([9.0, 9, 9, 1, 1, 9])),
        "function": lambda: FunctionConstraint(lambda x: x[..., 3:5].square().sum(-1, keepdim=True) - 1.0),
    }
    return [parts[kind](), ControlBounds(put([-10.0, -10]), put([10.0, 10]))]


def problem_of(kind: str, device: Any) -> tuple[Problem, Tensor]:
    put = lambda value: torch.tensor(value, **DOUBLE).to(device)
    goal = put([1, 0.4, 0, 0, 0, 0])
    cost = QuadraticCost(put([5, 5, 1, 1, 1, 1]), put([0.1, 0.1]), put([50, 50, 1, 1, 1, 1]), x_ref=goal)
    x0 = put([[-1.0, 0, 0, 0, 0, 0], [-1, 0.1, 0, 0, 0, 0]])
    problem = Problem(Planar(dt=0.6), cost, constraints(kind, device), x0, N, Goal(goal[:2], 0.3))
    return problem, torch.zeros(2, N, 2, **DOUBLE).to(device)


def on_both(work: Any, kind: str) -> set[str]:
    """Do some work on the CPU and on the other device; the results are the same bits. Where tensors were moved."""
    expected = [part.tolist() for part in work(*problem_of(kind, "cpu"))]
    with SecondDevice() as second:
        given = problem_of(kind, OTHER)
        second.moved.clear()
        found = work(*given)
        moved = set(second.moved)
        assert all(part.device == OTHER for part in found)
        assert [part.tolist() for part in found] == expected
    return moved


@pytest.fixture(autouse=True)
def eager() -> Iterator[None]:
    use_native(False)
    yield
    use_native(True)


def solved(problem: Problem, U0: Tensor, solver: Any = LOCAL) -> tuple[Solution, list[Tensor]]:
    found = solver.solve(problem, U0)
    return found, [found.X, found.U, found.K, found.d, found.cost, found.violation, found.status, found.iterations]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("kind", mostly(["map", "states"], "map"))
def test_what_solve_checks_before_and_after_stays_on_the_device(kind: str) -> None:
    """Horizons, contact between knots, scales, explanations: the solver itself has tests of its own."""

    def work(problem: Problem, U0: Tensor) -> list[Tensor]:
        found = torchgco.solve(problem, U0, solver=LOCAL, verbose=False)
        assert found.explain(1) and len(found.to_frame(problem)) == len(found.worst_rows(problem)) == 2
        later = torchgco.solve(problem, warm=found.shifted(), solver="hold", verbose=False)
        return [found.X, found.U, found.cost, found.violation, later.X]

    on_both(work, kind)


OTHERS = ("spheres", "boxes", "capsules", "body", "oscillating", "function")
SLOW = [pytest.param(kind, marks=pytest.mark.slow) for kind in OTHERS]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["states", pytest.param("map", marks=pytest.mark.slow), *SLOW])
def test_local_solves_are_judged_and_certified(kind: str) -> None:
    def work(problem: Problem, U0: Tensor) -> list[Tensor]:
        found, parts = solved(problem, U0)
        return [*parts, *vars(judge(problem, found.U)).values(), *vars(certify(problem, found.X, found.U)).values()]

    on_both(work, kind)


def test_the_longest_step_is_found() -> None:
    def work(problem: Problem, U0: Tensor) -> list[Tensor]:
        with computing_on(problem.x0.device):
            found = limit_of(problem)
        assert found is not None and bool(found.step.isfinite().all())
        return [found.step]

    on_both(work, "states")


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("kind", ["states", pytest.param("map", marks=pytest.mark.slow), *SLOW])
def test_the_interior_point_solves(kind: str) -> None:
    """Another device has the same iterates; a part of the start is free, and a bound has no room."""

    def work(problem: Problem, U0: Tensor) -> list[Tensor]:
        bounds = StateBounds(problem.x0, problem.x0 + 1.0, knots=[0])
        free = Problem(
            problem.dynamics, problem.cost, [*problem.constraints, bounds], problem.x0, N, problem.goal,
            free_start=torch.tensor([False, False, True, False, False, False], device=problem.x0.device),
        )  # fmt: skip
        return solved(free, U0, InteriorPoint(max_iterations=3))[1]

    on_both(work, kind)


def test_samples_guide() -> None:
    guided = AugmentedLagrangian(LOCAL.inner, guidance=GCO(MPPI(samples=4)), max_outer_iterations=2)
    on_both(lambda problem, U0: solved(problem, U0, guided)[1], "spheres")


@pytest.mark.parametrize("kind", ["boxes", "map"])
def test_paths_are_handed_over(kind: str) -> None:
    def work(problem: Problem, U0: Tensor) -> list[Tensor]:
        with computing_on(problem.x0.device):
            scene = scene_of(problem, problem.cost.rest_controls(U0))
            assert scene is not None
            return list(Roadmap(num_halton=8).paths(scene, 2))

    on_both(work, kind)


@pytest.mark.slow
def test_solutions_are_kept_and_shown(tmp_path: Path) -> None:
    def work(problem: Problem, U0: Tensor) -> list[Tensor]:
        found, _ = solved(problem, U0)
        found.to_frame(problem)
        found.save(tmp_path / "solution.npz")
        again = Solution.load(tmp_path / "solution.npz", problem.x0.device)
        return [again.X, again.multipliers.mu, found.take(torch.tensor([1])).U]

    on_both(work, "states")


def test_nothing_is_brought_to_the_cpu_within_a_solve() -> None:
    """Numbers that an option holds go to the device; no tensor comes back."""
    moved = on_both(lambda problem, U0: solved(problem, U0)[1], "boxes")
    assert {place.partition(":")[0] for place in moved} <= {"outside", "ilqr/line_search.py", "base/shapes.py"}


def test_mixed_devices_are_refused_here() -> None:
    with SecondDevice():
        there = torch.ones(2).to(OTHER)
        assert (there + 1.0).tolist() == [2.0, 2.0] and (there + torch.tensor(1.0)).device == OTHER
        for mixed in (lambda: there + torch.ones(2), lambda: torch.stack((there, torch.ones(2)))):
            with pytest.raises(RuntimeError, match="tensors on two devices"):
                mixed()
        with pytest.raises((RuntimeError, TypeError)):
            there.numpy()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["spheres", "map", "states"])
def test_another_default_device_changes_nothing(kind: str, tmp_path: Path) -> None:
    """Problems of the CPU are solved, judged, explained and kept there, whatever PyTorch makes elsewhere."""

    def work() -> list[Any]:
        problem, U0 = problem_of(kind, "cpu")
        found, parts = solved(problem, U0)
        found.save(tmp_path / "solution.npz")
        part, loaded = found[1:], Solution.load(tmp_path / "solution.npz")
        verdicts = *vars(judge(problem, found.U)).values(), *vars(certify(problem, found.X, found.U)).values()
        texts = str(found.explain(1)), str(part.explain(0)), str(loaded.explain(0, problem)), found.to_frame(problem)
        tables = found.worst_rows(problem), loaded[:1].t.tolist(), problem.take(torch.tensor([1], device="cpu")).x0
        return [str(one.tolist() if isinstance(one, Tensor) else one) for one in (*parts, *verdicts, *texts, *tables)]

    expected = work()
    with OTHER:
        assert work() == expected


def test_maps_and_vehicles_are_made_on_the_cpu() -> None:
    def work() -> list[Any]:
        field = DistanceField.of(OccupancyGrid(WALL, [-1.7, -2.0], 0.15))
        plant = RotorPlant(mass_error=0.1)
        problem = compose(["scenario=forest", "study.layouts=1"]).task().problem
        return [field.distance([[0.1, 0.2]]).tolist(), plant.mass_error, problem.x0.tolist()]

    expected = work()
    with OTHER:
        assert work() == expected


def test_times_of_a_part_of_a_loaded_solution(tmp_path: Path) -> None:
    problem, U0 = problem_of("states", "cpu")
    found, _ = solved(replace(problem, horizon=torch.tensor([2, 3])), U0)
    found.save(tmp_path / "solution.npz")
    loaded = Solution.load(tmp_path / "solution.npz")
    assert loaded[1:].t.tolist() == found[1:].t.tolist() and loaded[1:].t.shape == (1, N + 1)
