"""Wrong input from Python: each mistake gets one InputError that names the field, on one line."""

from __future__ import annotations

import inspect
import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache, reduce
from math import inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch, quadrotor_batch
from torchgco import (
    ILQR,
    Airframe,
    AugmentedLagrangian,
    Boxes,
    ControlBounds,
    Cost,
    Dynamics,
    FirstStepRates,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    Restarts,
    RotorTracking,
    Solution,
    Spheres,
    StateBounds,
    certify,
    judge,
    plan_batch,
    presets,
    solve,
)
from torchgco.base.options import option_places
from torchgco.baselines import CasADiSolver
from torchgco.missions import Mission, Planner, RotorPlant
from torchgco.missions.contact import Contact
from torchgco.missions.outcome import judge_flight

D, GOAL = torch.float64, torch.tensor([1.0, 0.4], dtype=torch.float64)
LOCAL = AugmentedLagrangian(ILQR(max_iterations=1), max_outer_iterations=1)
ZERO = torch.zeros(2, 6, dtype=D)


@cache
def solved() -> tuple[Problem, Tensor, Solution]:
    problem, U0 = planar_batch(B=2, N=6)
    return problem, U0, LOCAL.solve(problem, U0)


def make(**change: Any) -> Problem:
    parts = dict(dynamics=Planar(), cost=QuadraticCost([1] * 6, [1, 1], [1] * 6), constraints=[], x0=ZERO, N=6)
    return Problem(**{**parts, **change})


def held(constraint: Any) -> Problem:
    return make(constraints=[constraint])


class Car(Dynamics):
    n, m, dt, integrator, position = 6, 2, 0.1, "euler", slice(0, 2)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 3:], 0.0 * x[..., :1], u), dim=-1)


def car(**change: Any) -> Problem:
    return make(dynamics=type("Car", (Car,), change)())


class Odd(Cost):
    def __init__(self, stage: Callable[[Tensor, Tensor], Any], column: bool = False) -> None:
        self.function, self.column = stage, column

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return self.function(x, u)

    def terminal(self, x: Tensor) -> Tensor:
        return x.square().sum(-1, keepdim=self.column)


def call(**change: Any) -> Solution:
    problem, U0, _ = solved()
    return LOCAL.solve(problem, **{"U0": U0, **change})


def flight(**change: Any) -> object:
    parts = dict(x=np.zeros((3, 3)), dt=0.01, contact=Contact(()), goal=np.zeros(3), goal_radius=0.1)
    return judge_flight(**{**parts, **change})


KINDS = {  # of tensors that are refused
    "gradients": ZERO.clone().requires_grad_(), "a parameter": torch.nn.Parameter(ZERO), "float16": ZERO.half(),
    "bfloat16": ZERO.bfloat16(), "complex": ZERO.to(torch.complex128), "sparse": ZERO.to_sparse(),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_tensors_that_are_not_plain_are_refused(kind: str) -> None:
    value, problem = KINDS[kind], solved()[0]
    shaped = value.detach().to_dense()[:, :2].unsqueeze(1).repeat(1, 6, 1)
    U = shaped.to_sparse() if value.is_sparse else shaped.requires_grad_(value.requires_grad)
    diagonal = value if value.is_sparse else value[0]
    uses = {
        "x0": lambda: make(x0=value),
        "U0": lambda: call(U0=U),
        "U": lambda: judge(problem, U),
        "cost.Q": lambda: make(cost=QuadraticCost(diagonal, [1, 1], [1] * 6)),
        "state_bounds.lower": lambda: held(StateBounds(value, 1)),
        "goal.radius": lambda: make(goal=Goal([0.0, 0.0], diagonal)),
    }
    served = ("x0", "cost.Q", "state_bounds.lower") if value.requires_grad else ()
    for field, use in uses.items():
        if field in served:
            use()
            continue
        with pytest.raises(InputError) as caught:
            use()
        assert caught.value.field == field


CASES: dict[str, list[Callable[[], object]]] = {
    "x0": [lambda x=x: make(x0=x) for x in ([["a"] * 6], [[0.0] * 5], np.zeros((2, 3, 6)), None)],
    "dynamics": [lambda: make(dynamics=None), lambda: make(dynamics=Planar)],
    "cost": [
        lambda: make(cost=None), lambda: make(cost=QuadraticCost), lambda: make(cost=Cost()),
    ],
    "cost.stage": [
        lambda: make(cost=Odd(lambda x, u: x)), lambda: make(cost=Odd(lambda x, u: None)),
        lambda: make(cost=Odd(lambda x, u: {}["weight"])),
    ],
    "cost.terminal": [lambda: make(cost=Odd(lambda x, u: x.sum(-1), True))],
    "cost.Q": [
        lambda q=q: make(cost=QuadraticCost(q, [1, 1], [1] * 6))
        for q in ("a", None, {}, True, 1j, nan, [[1], [1, 2]], np.array([1j] * 6), np.array([True] * 6), [10**400] * 6)
    ],
    "constraints": [
        lambda: make(constraints=Spheres([[5.0, 0.0]], [0.1])), lambda: make(constraints=None),
        lambda: make(constraints=(c for c in [ControlBounds(-1, 1)])), lambda: make(constraints=""),
        lambda: make(constraints=[Spheres]), lambda: solved()[0].started_at(solved()[0].x0, 5),  # type: ignore
    ],
    "N": [lambda N=N: make(N=N) for N in ("5", 5.0, True, None, 0, nan)],
    "goal": [lambda: make(goal=5), *(
        lambda g=g: judge(*solved()[:2], g, 0.1) for g in ("a", 5, torch.zeros(3, dtype=D), GOAL.float(), nan * GOAL)
    )],
    "goal_radius": [
        *(lambda r=r: judge(*solved()[:2], GOAL, r) for r in (nan, -1.0, 0.0, "a", True, torch.ones(3, dtype=D))),
        lambda: flight(goal_radius="a"), lambda: flight(goal_radius=nan),
    ],
    "planar.dt": [
        lambda dt=dt: Planar(dt=dt) for dt in ("a", torch.tensor([0.1, 0.2]), 0, -1.0, nan, inf, None, True)
    ],
    "dynamics.dt": [lambda dt=dt: car(dt=dt) for dt in ("a", torch.tensor([0.1, 0.2]), 0, nan)],
    "dynamics.n": [lambda: car(n="6"), lambda: FunctionDynamics(lambda x, u: x, 0, 1, 0.1)],
    "dynamics.function": [lambda: FunctionDynamics(5, 1, 1, 0.1)],  # type: ignore[arg-type]
    "dynamics.integrator": [lambda: car(integrator="heun")],
    "dynamics.position": [
        lambda p=p: car(position=p) for p in ((0, 1), slice(0, 9), slice(None, 2), slice("a", "b"), slice(2, 1))
    ],
    "dynamics.step": [
        lambda: car(step=lambda self, x, u: None), lambda: car(step=lambda self, x, u: {}["a"]),
        lambda: car(step=lambda self, x: x), lambda: car(step=lambda self, x, u: x.float()),
    ],
    "dynamics.k": [
        lambda k=k: car(per_element=("k",), k=k) for k in ("a", [1.0, 2.0], torch.ones(2, dtype=D).requires_grad_())
    ],
    "planar.drag": [lambda k=k: Planar(drag=k) for k in ("a", None, [1.0], nan, True, 1j)],
    "quadrotor.rate_time_constant": [lambda k=k: QuadrotorPlanning(rate_time_constant=k) for k in (0, "a", -1.0)],
    "plant.airframe": [lambda: QuadrotorPlant(airframe=5), lambda: RotorPlant(airframe=Airframe)],  # type: ignore
    "rotors.airframe": [lambda: RotorTracking(airframe={})],  # type: ignore[arg-type]
    "airframe.inertia": [
        lambda J=J: Airframe(inertia=J)
        for J in ("abc", None, ((1, 0), (0, 1)), ((1, 0, 0), (0, 1, 0), (0, 0, 0)), ((1, 1, 0), (0, 1, 0), (0, 0, 1)))
    ],
    "airframe.rotor_time_constant": [lambda: Airframe(rotor_time_constant=0)],
    "control_bounds.lower": [
        *(lambda b=b: held(ControlBounds(b, 1)) for b in ("a", {}, nan, [inf, 0], [0] * 3, [])),
        lambda: held(ControlBounds(1, -1)),
    ],
    "control_bounds.upper": [lambda b=b: held(ControlBounds(-1, b)) for b in (-inf, [1, -inf], True)],
    "control_bounds": [lambda: held(ControlBounds(-inf, inf))],
    "control_bounds.knots": [
        lambda k=k: held(ControlBounds(-1, 1, k))
        for k in ([1.5], [1.0], ["a"], "12", 1, [True, False], torch.tensor([1.0]), torch.tensor([True]),
                  torch.zeros(2, 2, dtype=torch.int64), slice("a", "b"), slice(0, 4, 0), [99], [])
    ],
    "obstacles.centers": [lambda c=c: held(Spheres(c, [0.1])) for c in ("a", None, 1.0, [[inf, 0.0]])],
    "obstacles.vehicle_radius": [
        lambda r=r: held(Spheres([[5.0, 0.0]], [0.1], r)) for r in ("a", None, nan, inf, [0.1] * 3, [[0.1, 0.2]], -1.0)
    ],
    "obstacles.velocities": [
        lambda v=v: held(Spheres([[5.0, 0.0]], [0.1], 0.0, v)) for v in ("a", [[nan, 0.0]], [[inf, 0.0]], [1.0, 2.0])
    ],
    "boxes.vehicle_radius": [lambda r=r: held(Boxes([[5.0, 0.0]], [[1.0, 1.0]], r)) for r in ("a", nan, inf, -1.0)],
    "constraint.function": [
        lambda f=f: held(FunctionConstraint(f))
        for f in (5, None, lambda x: None, lambda x: x[..., 9], lambda x, u: x, lambda x: x > 0, lambda x: {}["a"])
    ],
    "constraint.geometric": [lambda: held(FunctionConstraint(lambda x: x, geometric="yes"))],  # type: ignore
    "constraint.of": [lambda: held(FunctionConstraint(lambda x: x, of=["x"]))],  # type: ignore[arg-type]
    "first_step.period": [
        lambda: replace(quadrotor_batch(B=1, N=3)[0], constraints=[FirstStepRates([1.0] * 4, "a")])  # type: ignore
    ],
    "problem": [
        lambda: LOCAL.solve(5, None), lambda: solve(5), lambda: judge(5, None), lambda: certify(5, None, None),  # type: ignore
        lambda: plan_batch(5), lambda: Mission(Planner(LOCAL)).fly(5),  # type: ignore
        lambda: CasADiSolver().prepare(5),  # type: ignore[arg-type]
    ],
    "solver": [lambda: solve(solved()[0], solver="gco2"), lambda: solve(solved()[0], solver=Restarts)],  # type: ignore
    "U0": [lambda: call(U0=[[0.0]]), lambda: call(U0=None), lambda: solve(solved()[0], 5)],  # type: ignore[arg-type]
    "seed": [
        *(lambda s=s: call(seed=s) for s in ("x", -1, nan, None, 1.0, True, 2**70)),
        lambda: Mission(Planner(LOCAL)).fly(solved()[0], seed="a"),  # type: ignore[arg-type]
    ],
    "ids": [
        *(lambda i=i: call(ids=i) for i in ([0, 1], 5, torch.zeros(2), torch.zeros(2, 1).long(), torch.zeros(2).int())),
        lambda: Mission(Planner(LOCAL)).fly(solved()[0], ids=[0, 1]),  # type: ignore[arg-type]
    ],
    "warm": [
        lambda: call(warm=solved()[2]), lambda: call(warm=5), lambda: solve(solved()[0], warm=5),  # type: ignore
        lambda: solve(solved()[0], warm=solved()[2].multipliers),  # type: ignore[arg-type]
        lambda: call(warm=replace(solved()[2].multipliers, lam=5)),
        lambda: call(warm=replace(solved()[2].multipliers, mu=torch.ones(1, dtype=D))),
        lambda: call(warm=replace(solved()[2].multipliers, mu=torch.ones(2))),
    ],
    "callback": [lambda: call(callback=5)],
    "max_seconds": [lambda t=t: call(max_seconds=t) for t in ("abc", 0, nan, [1], True)],
    "U": [lambda: judge(solved()[0], solved()[1].tolist()), lambda: certify(solved()[0], solved()[2].X, [[0.0]])],  # type: ignore
    "X": [
        lambda: certify(solved()[0], solved()[2].X.tolist(), solved()[2].U),  # type: ignore[arg-type]
        lambda: certify(solved()[0], solved()[2].X.clone().requires_grad_(), solved()[2].U),
    ],
    "asked": [
        lambda a=a: certify(solved()[0], solved()[2].X, solved()[2].U, a) for a in ([True] * 2, torch.ones(2).long())
    ],
    "dt": [lambda: flight(dt=0.0), lambda: flight(dt=None)],
    "x": [lambda x=x: flight(x=x) for x in (np.zeros((3, 2)), np.zeros((0, 3)), "a", [[0], [0, 1], [2]])],
    "device": [
        lambda: plan_batch(solved()[0], "nowhere"), lambda: plan_batch(solved()[0], 1.5),  # type: ignore[arg-type]
        lambda: plan_batch(solved()[0], "cuda:99"), lambda: Solution.load("none.npz", "nowhere"),
    ],
    "processes": [lambda p=p: plan_batch(solved()[0], processes=p) for p in ("a", 1.5, 0)],
}  # fmt: skip


@pytest.mark.parametrize("field", CASES)
def test_a_mistake_gets_one_line_that_names_the_field(field: str) -> None:
    for i, mistake in enumerate(CASES[field]):
        with pytest.raises(InputError) as caught:
            mistake()
            pytest.fail(f"mistake {i} is accepted")
        assert caught.value.field == field and len(str(caught.value).splitlines()) == 1, i


def test_files_that_hold_no_solution_are_named(tmp_path: Path) -> None:
    good = tmp_path / "good.npz"
    solved()[2].save(good)
    arrays, whole = dict(np.load(good)), good.read_bytes()
    (tmp_path / "text.npz").write_text("controls")
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "early.npz").write_bytes(whole[:300])
    (tmp_path / "late.npz").write_bytes(whole[:-30])
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps({"X": 1}))
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "words.npz", **{**arrays, "X": np.array(["a"])})
    np.savez(tmp_path / "objects.npz", **{**arrays, "X": np.array([{}])})
    np.savez(tmp_path / "shape.npz", **{**arrays, "X": np.zeros(3)})
    for path in (*(p for p in tmp_path.iterdir() if p != good), tmp_path / "absent.npz", tmp_path, None, 5):
        with pytest.raises(InputError) as caught:
            Solution.load(path)  # type: ignore[arg-type]
        assert caught.value.field == "path" and len(str(caught.value).splitlines()) == 1, path
    assert torch.equal(Solution.load(good).X, solved()[2].X)


def test_plain_input_of_other_kinds_is_taken() -> None:
    """One number for all bounds, arrays that are read-only or reversed, integers of NumPy as knots."""
    bounds = held(ControlBounds(-1, 2)).constraints[0]
    assert bounds.lower.tolist() == [[-1.0, -1.0]] and bounds.upper.tolist() == [[2.0, 2.0]]
    weight = np.arange(6.0)[::-1]
    weight.flags.writeable = False
    assert make(cost=QuadraticCost(weight, [1, 1], [1] * 6)).cost.Q.flatten().tolist() == [5.0, 4.0, 3.0, 2.0, 1.0, 0.0]
    assert held(ControlBounds(-1, 1, np.array([0, 2]))).constraints[0].knots.tolist() == [0, 2]
    network = torch.nn.Linear(8, 6, dtype=D)
    make(dynamics=FunctionDynamics(lambda x, u: network(torch.cat((x, u), dim=-1)), 6, 2, 0.1))  # a learned model


@pytest.mark.parametrize("name", ["gco", "al_ilqr", "interior_point", None])
def test_an_option_among_the_arguments_is_sent_to_its_place(name: str | None) -> None:
    """Every option of the solver and of its parts: the place that is named leads to it."""
    problem, U0, _ = solved()
    solver: Any = presets.named(name or "gco", problem)
    for place in option_places(solver):
        option = place.rpartition(".")[2]
        if option in inspect.signature(solve).parameters:
            continue
        with pytest.raises(InputError) as caught:
            solve(problem, U0, solver=name, **{option: 12})
        line = str(caught.value)
        assert line.startswith(f"solve.{option}: expected an option of the solver in its place: ") and "\n" not in line
        (named,) = re.findall(r"in its place: (.*) of presets\.", line)
        assert place in named.split(", ") and line.endswith("got 12")
        assert all(hasattr(reduce(getattr, one.split(".")[:-1], solver), option) for one in named.split(", "))


def test_a_misspelt_argument_is_named_beside_the_one_like_it() -> None:
    problem, U0, _ = solved()
    for wrong, like in (("max_second", "max_seconds"), ("warmstart", "warm"), ("Seed", "seed")):
        with pytest.raises(InputError, match=f"^solve.{wrong}: expected an argument of solve, such as {like}, got 1$"):
            solve(problem, U0, **{wrong: 1})  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^solve\.qqq: expected an argument of solve, got 1$"):
        solve(problem, U0, qqq=1)  # type: ignore[call-arg]
