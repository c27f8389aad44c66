"""Courses through gates: how they are drawn and kept, the problems they make, and a study of a race."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchgco
from torchgco import FreeTime, InputError, Status, compose
from torchgco.base.errors import StepWarning
from torchgco.constraints.gates import GateBalls
from torchgco.dynamics.base import INTEGRATORS
from torchgco.experiments.config.build import Setup
from torchgco.scenarios import GateForest, Layouts, Race, concatenate


def test_courses_follow_their_rule() -> None:
    scenario = GateForest()
    drawn = scenario.draw(range(40), 0)
    alone, other = scenario.draw([7], 0), scenario.draw([7], 1)
    for name in ("centers", "gate_centers", "goal"):
        here = getattr(drawn, name)[7]
        assert np.array_equal(getattr(alone, name)[0], here[~np.isnan(here).all(-1)] if here.ndim > 1 else here)
        assert not np.array_equal(getattr(other, name)[0][:1], here[:1])
    counts = drawn.gate_counts
    assert counts is not None and counts.min() == 3 and counts.max() == 12
    for i in range(drawn.count):
        places = np.vstack((drawn.start[i], drawn.gate_centers[i, : counts[i]], drawn.goal[i]))
        legs = np.diff(places, axis=0)
        assert (np.abs(np.arctan2(legs[:, 1], legs[:, 0])) <= scenario.turn + 1e-12).all()
        far = np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(len(places), 1)]
        assert far.min() >= scenario.spacing[0] and np.hypot(*legs[:, :2].T).max() <= scenario.spacing[1]
        there = drawn.centers[i][~np.isnan(drawn.radii[i])]
        assert np.linalg.norm(there[:, None] - places, axis=-1).min() > scenario.clearance
        assert drawn.stages[i] == scenario.stages * (counts[i] + 1)


def test_the_first_race_is_the_published_one() -> None:
    drawn = Race().draw([3, 0], 0)
    assert np.array_equal(drawn.gate_centers[1], Race().gates) and drawn.stages == 400
    moved = np.abs(drawn.gate_centers[0] - np.array(Race().gates))
    assert 0.2 < moved.max() <= 0.3 and drawn == concatenate([Race().draw([3], 0), Race().draw([0], 0)])


def test_files_hold_gates_and_times(tmp_path: Path) -> None:
    drawn = GateForest(num_gates=(1, 3)).draw(range(5), 0)
    drawn.save(tmp_path / "gates.npz")
    assert replace(Layouts.load(tmp_path / "gates.npz"), name="gates") == drawn
    plain = replace(drawn.take([0]), gate_centers=None, gate_radii=None)
    both = concatenate([drawn.take([1]), plain])
    assert both.gate_counts.tolist() == [drawn.gate_counts[1], 0]
    kinds = [set(zip(drawn.stages[some], drawn.gate_counts[some], strict=True)) for some in drawn.alike()]
    assert all(len(kind) == 1 for kind in kinds) and sorted(np.concatenate(drawn.alike())) == list(range(5))


def test_problems_have_a_time_for_each_leg() -> None:
    setup = compose(["scenario=gates", "scenario.num_gates=[2,4]"])
    layouts = setup.layouts(6)
    with pytest.raises(InputError, match=r"layouts\.gate_centers: expected as many gates in all layouts of a batch"):
        setup.task(layouts)
    some = layouts.alike()[0]
    problem = setup.task(layouts.take(some)).problem
    part = next(part for part in problem.constraints if isinstance(part, GateBalls))
    count = layouts.gate_counts[some[0]]
    legs = [20 * (g + 1) for g in range(count)]
    assert part.places.tolist() == [legs] * len(some) and problem.time.segments == (0, *legs)
    np.testing.assert_array_equal(part.centers, layouts.gate_centers[some, :count])
    assert problem.goal.required and isinstance(problem.time, FreeTime)
    x = torch.randn(problem.B, problem.n, dtype=torch.float64)
    assert not bool(problem.cost.stage(x, problem.cost.rest_controls(x.new_zeros(problem.B, 1, 4))[:, 0], 0).any())
    end = setup.task(replace(layouts.take(some), free_time=None)).problem
    assert end.time is None and not end.goal.required and bool((end.cost.stage(x, x[:, :4], 0) > 0).all())


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"gate_centers": np.zeros((2, 3, 2))}, r"gate_centers: expected shape \(1, G, 3\)"),
        ({"gate_radii": np.zeros((1, 3))}, "gate_radii: expected radii above 0"),
        ({"gate_radii": None}, "gate_radii: expected this array with gate_centers"),
        ({"gate_centers": None}, "gate_radii: expected none without gate_centers"),
        ({"gate_centers": np.array([[[np.nan] * 3, [1.0] * 3, [2.0] * 3]])}, "expected absent gates behind all others"),
        ({"free_time": np.array([2.0, 1.0, 1.0])}, "free_time: expected 0 < least <= most"),
        ({"free_time": np.array([2.0, 1.0])}, "free_time: expected three numbers"),
    ],
)
def test_wrong_arrays_are_named(changes: dict, told: str) -> None:
    drawn = GateForest(num_gates=(3, 3)).draw([0], 0)
    with pytest.raises(InputError, match=told):
        replace(drawn, **changes)


def test_the_time_is_given_where_spheres_move() -> None:
    drawn = GateForest(num_gates=(3, 3)).draw([0], 0)
    with pytest.raises(InputError, match="free_time: expected None where spheres move"):
        replace(drawn, velocities=np.where(np.isnan(drawn.centers), np.nan, 0.1))


def test_missions_refuse_them() -> None:
    with pytest.raises(InputError, match="scenario: expected one in space for a mission"):
        compose(["experiment=mission", "scenario=gates"])


def _misses(setup: Setup) -> tuple[float, float]:
    """How far from the plan's places at the gates its controls lead under the field itself: the least and the most."""
    layouts = setup.layouts(2)
    problem = setup.task(layouts).problem
    plan = torchgco.solve(problem)
    assert bool((plan.status == Status.CONVERGED).all())
    lengths, x, misses = plan.t.diff(dim=1), plan.X[:, 0], []
    for k in range(problem.N):
        rates = lambda z, k=k: lengths[:, k, None] * problem.dynamics.field(z, plan.U[:, k])
        for _ in range(20):
            x = INTEGRATORS["rk4"](rates, x, 1 / 20)
        if k + 1 in problem.time.segments:
            misses.append((x - plan.X[:, k + 1])[:, :3].norm(dim=-1))
    return float(torch.stack(misses).min()), float(torch.stack(misses).max())


@pytest.mark.filterwarnings("error::torchgco.base.errors.StepWarning")
def test_plans_lead_through_the_gates_under_the_model_itself() -> None:
    assert _misses(compose(["scenario=gates", "scenario.num_gates=[3,3]"]))[1] < 0.01


@pytest.mark.slow
def test_steps_of_euler_that_lead_past_the_gates_are_told() -> None:
    words = ["scenario=gates", "scenario.num_gates=[3,3]", "scenario.integrator=euler"]
    with pytest.warns(StepWarning, match=r"Euler's steps change the costs of . of 2 trajectories by over 1 %"):
        assert _misses(compose(words))[1] > 0.5  # m: the radius of the gates
