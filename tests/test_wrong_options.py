"""Wrong options of solvers, missions, vehicles and scenarios: one InputError that names the field, on one line."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import torch

from tests.problems import planar_batch
from torchgco import (
    MPPI,
    AugmentedLagrangian,
    Hold,
    InputError,
    IteratedMPPI,
    Layouts,
    MultiStart,
    Planar,
    compose,
    presets,
)
from torchgco.baselines import CasADiSolver, GuidedCasADi
from torchgco.missions import Disturbance, Mission, Planner, RotorPlant, Tracker
from torchgco.scenarios import Forest, LayoutFile, PlanarTrap, Vehicle, concatenate

LOCAL = AugmentedLagrangian()


def vehicle(**change: Any) -> Vehicle:
    six, two = [0.0] * 6, [0.0] * 2
    parts = dict(
        name="v", dynamics=Planar(), state_weight=six, control_weight=two, terminal_weight=six, control_reference=two,
        control_lower=[-1, -inf], control_upper=[1, inf], start=six, goal=six, radius=0.1, goal_radius=0.1, stages=5,
    )  # fmt: skip
    return Vehicle(**{**parts, **change})


def layouts(**change: Any) -> Layouts:
    return Layouts(**{"centers": np.zeros((1, 1, 2)), "radii": np.ones((1, 1)), **change})


CASES: dict[str, list[Callable[[], object]]] = {
    "overrides": [lambda o=o: compose(o) for o in (5, "solver=gco", [5], None, {"solver": "gco"})],
    "model": [lambda: compose(["model=5"])],
    "a": [lambda: compose(["a=b=c"])],
    "model.vehicle": [lambda: compose(["model.vehicle=5"])],
    "samples.redraws": [lambda: compose(["solver.passes.samples.redraws=1.5"])],
    "solver.guidance": [
        lambda: compose(["solver=gco_paper", "solver.guidance=5"]), lambda: AugmentedLagrangian(guidance=MPPI),  # type: ignore
    ],
    "study.baselines.0": [lambda: compose(["study.baselines=[al_ilqr]", "~study.baselines.0"])],
    "solver.passes.paths": [lambda: compose(["solver.passes.paths=3"])],
    "solver.passes": [
        lambda: compose(["solver.passes=a"]), lambda: GuidedCasADi(passes=None), lambda: GuidedCasADi(passes=()),  # type: ignore
    ],
    "solver.options": [lambda: CasADiSolver(options=5)],  # type: ignore[arg-type]
    "solver.sampler": [lambda: IteratedMPPI(sampler=5)],  # type: ignore[arg-type]
    "solver.violation_tolerance": [lambda: Hold("a")],  # type: ignore[arg-type]
    "solver.slots": [lambda: LOCAL.in_slots("a")],  # type: ignore[arg-type]
    "multistart.covariance": [lambda: MultiStart(covariance=inf).solve(*planar_batch(B=1, N=3))],
    "space": [lambda: presets.gco("a"), lambda: presets.mppi(1)],  # type: ignore[arg-type]
    "vehicle.radius": [lambda: compose(["model.vehicle.radius=abc"]), lambda: vehicle(radius=True)],
    "vehicle.state_weight": [lambda w=w: vehicle(state_weight=w) for w in ("abcdef", [1.0] * 5, ["a"] * 6, None)],
    "vehicle.control_reference": [
        lambda: compose(["model.vehicle.control_reference=[a,b,c,d]"]), lambda: vehicle(control_reference=[inf, 0]),
    ],
    "vehicle.control_lower": [lambda: vehicle(control_lower=[nan, 0])],
    "vehicle.dynamics": [lambda: vehicle(dynamics=5)],
    "dtype": [lambda t=t: vehicle().task(layouts(), dtype=t) for t in (torch.float16, "float64")],
    "layouts": [lambda: vehicle().task(5), lambda: concatenate(5), lambda: concatenate([5])],  # type: ignore
    "layouts.ids": [lambda i=i: layouts(ids=i) for i in ("a", ["a"], [0.5], [-1], [[1], [1, 2]])],
    "layouts.centers": [lambda: layouts(centers=torch.zeros(1, 1, 2, requires_grad=True))],
    "layouts.vehicle_radius": [lambda r=r: layouts(vehicle_radius=r) for r in ("3", True, [1, 2], nan)],
    "layouts.stages": [lambda n=n: layouts(stages=n) for n in ("5", 1.5, inf, True)],
    "layouts.name": [lambda: layouts(name=5)],
    "scenario.path": [lambda: LayoutFile(5), lambda: Layouts.load(5)],  # type: ignore[arg-type]
    "scenario.num_obstacles": [lambda: Forest(num_obstacles="5"), lambda: Forest(num_obstacles=True)],  # type: ignore
    "scenario.start": [lambda: Forest(start=["0", "0", "0"])],  # type: ignore[list-item]
    "scenario.control_lower": [lambda b=b: PlanarTrap(control_lower=b) for b in ("a", True, nan)],
    "planner.solver": [lambda: Planner(5), lambda: Planner(AugmentedLagrangian)],  # type: ignore[arg-type]
    "mission.plant": [lambda: Mission(Planner(LOCAL), plant=5)],  # type: ignore[arg-type]
    "plant.mass_error": [lambda: RotorPlant(mass_error=torch.tensor(1j)), lambda: RotorPlant(mass_error="a")],  # type: ignore
    "tracker.inner": [lambda: Tracker(inner=5)],  # type: ignore[arg-type]
    "disturbance.wind": [lambda: Disturbance(wind="a")],  # type: ignore[arg-type]
    "device": [lambda: vehicle().task(layouts(), "nowhere")],
    "seed": [lambda: Forest().draw([0], nan), lambda: Forest().draw([0], "1")],  # type: ignore[arg-type]
    "ids": [lambda: Forest().draw([0.5], 0), lambda: Forest().draw(5, 0)],  # type: ignore[arg-type]
}  # fmt: skip


@pytest.mark.sampled(13)
@pytest.mark.parametrize("field", CASES)
def test_a_mistake_gets_one_line_that_names_the_field(field: str) -> None:
    for i, mistake in enumerate(CASES[field]):
        with pytest.raises(InputError) as caught:
            mistake()
            pytest.fail(f"mistake {i} is accepted")
        assert caught.value.field == field and len(str(caught.value).splitlines()) == 1, i
