"""What a loop flies where no solve gives a plan: the plan before, or a way to rest, always within the bounds."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from torchgco import (
    MPC,
    ControlBounds,
    Dynamics,
    FreeTime,
    FunctionConstraint,
    FunctionDynamics,
    Goal,
    Link,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
    Unicycle,
)
from torchgco.native.compiler import find_compiler
from torchgco.problem.horizons import for_solvers
from torchgco.receding.holding import stopping

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
N, DT, RADIUS = 30, 0.1, 0.5
PULLED = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, DT, "rk4", position=slice(0, 2))
NO_TIME = 1e-9  # s


def drives(B: int = 1) -> Problem:
    """Unicycles among two discs, which are far away."""
    x_ref = np.zeros((N + 1, 4))
    x_ref[:, 0], x_ref[:, 3] = 0.8 * DT * np.arange(N + 1), 0.8
    cost = QuadraticCost([1.0, 1.0, 0.01, 0.1], [0.1, 0.1], [5.0, 5.0, 0.01, 1.0], x_ref)
    parts = [
        ControlBounds([-1.0, -1.5], [1.0, 1.5]), StateBounds([-9e9] * 3 + [-0.3], [9e9] * 3 + [1.0]),
        Spheres([[50.0, 0.0], [60.0, 0.0]], 0.3, RADIUS - 0.3, velocities=[[0.0, 0.0], [0.0, 0.0]]),
    ]  # fmt: skip
    return Problem(Unicycle(dt=DT), cost, parts, torch.zeros(B, 4, dtype=torch.float64), N)


def crossed(x: np.ndarray, draw: np.random.Generator) -> dict[str, np.ndarray]:
    """A disc that comes from aside into the way of a vehicle at x (4,), and one that stands beside it."""
    far, side, speed = draw.uniform(0.6, 1.3), draw.choice([-1.0, 1.0]), draw.uniform(0.2, 1.2)
    beside = [[far, side * draw.uniform(0.2, 1.0)], [draw.uniform(-0.5, 1.5), -side * draw.uniform(0.7, 1.2)]]
    return {"centers": x[:2] + np.array(beside), "velocities": np.array([[0.0, -side * speed], [0.0, 0.0]])}


def violation(x: np.ndarray, U: np.ndarray, scene: dict[str, np.ndarray]) -> float:
    """How deep a unicycle comes into the discs, m, or by how much its speed breaks its bounds: by NumPy alone."""
    worst = 0.0
    for k, (a, turn) in enumerate(U):
        f = lambda x, a=a, turn=turn: np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), turn, a])
        a1 = f(x)
        a2 = f(x + 0.5 * DT * a1)
        a3 = f(x + 0.5 * DT * a2)
        x = x + DT / 6 * (a1 + 2 * a2 + 2 * a3 + f(x + DT * a3))
        places = scene["centers"] + (k + 1) * DT * scene["velocities"]
        worst = max(worst, RADIUS - np.linalg.norm(places - x[:2], axis=1).min(), x[3] - 1.0, -0.3 - x[3])
    return worst


def braking(x: np.ndarray, turn: float) -> np.ndarray:
    """Controls (N, 2) that brake with all there is, at a rate of turn."""
    U, speed = np.zeros((N, 2)), x[3]
    for k in range(N):
        U[k] = np.clip(-speed / DT, -1.0, 1.0), turn if abs(speed) > 1e-9 else 0.0
        speed += DT * U[k, 0]
    return U


def driven_on(mpc: MPC, B: int = 1) -> np.ndarray:
    """The state (4,) of a vehicle that has driven for a second, alone."""
    mpc.reset()
    x = np.zeros(4)
    for _ in range(8):
        u = mpc.step(np.tile(x, (B, 1)), centers=[[50.0, 0.0], [60.0, 0.0]], velocities=np.zeros((2, 2)))
        x = Unicycle(dt=DT).step(torch.from_numpy(x), u[0]).numpy()
    return x


@pytest.mark.slow
def test_a_loop_brakes_where_that_is_clear_and_its_plan_isnt() -> None:
    """No time for a solve: braking at one of five rates of turn is known by NumPy to be clear, so the loop is."""
    draw, mpc, braked = np.random.default_rng(0), MPC(drives(), "interior_point"), 0
    x = driven_on(mpc)
    for _ in range(25):
        scene = crossed(x, draw)
        driven_on(mpc)
        before = mpc.plan
        u = mpc.step(x, **scene, max_seconds=NO_TIME).numpy()
        clear = min(violation(x, braking(x, turn), scene) for turn in (-1.5, -0.75, 0.0, 0.75, 1.5)) <= 0.0
        mine = violation(x, mpc.plan.U[0].numpy(), scene) if mpc.plan.start[0] == mpc.t else None
        assert bool(mpc.held) and (np.abs(u) <= [1.0, 1.5]).all()
        assert bool(mpc.feasible) or not clear
        assert mine is None or bool(mpc.feasible) == (mine <= 1e-3)
        moved_on = violation(x, np.r_[before.U[0, 1:], before.U[0, -1:]], scene)
        braked += clear and moved_on > 0.01
    assert braked >= 5


def test_a_vehicle_that_brakes_does_as_alone_and_others_fly_on() -> None:
    draw, several, alone = np.random.default_rng(1), MPC(drives(3), "interior_point"), MPC(drives(), "interior_point")
    x = driven_on(alone)
    scene = crossed(x, draw)
    driven_on(several, 3)
    far = {"centers": np.array([[50.0, 0.0], [60.0, 0.0]]), "velocities": np.zeros((2, 2))}
    for late in (NO_TIME, None, None):
        both = {name: np.stack((far[name], scene[name], far[name])) for name in far}
        u, own = several.step(np.tile(x, (3, 1)), **both, max_seconds=late), alone.step(x, **scene, max_seconds=late)
        assert torch.equal(u[1], own) and several.feasible[1] == alone.feasible and several.held[1] == alone.held
        assert torch.equal(several.plan.U[1], alone.plan.U[0])
    assert several.statuses[0] == several.statuses[2] == Status.CONVERGED


def wall() -> FunctionConstraint:
    return FunctionConstraint(lambda x: x[..., :1] - 5.0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "parts", [[], [RateBounds(-0.3, 0.3, previous=[0.0, 0.0])], [Link(components=[2, 3])]], ids=["", "rates", "link"]
)
def test_a_first_step_that_fails_keeps_the_bounds_and_says_so(parts: list[Any]) -> None:
    draw, cost = np.random.default_rng(2), QuadraticCost([1, 1, 0.1, 0.1], [0.1] * 2, [20, 20, 1, 1], [1.0, 0.5, 0, 0])
    mpc = MPC(Problem(PULLED, cost, [ControlBounds(-2, 2), wall(), *parts], [[0.0] * 4], 20), "interior_point")
    for _ in range(2):
        mpc.reset()
        x, last = np.array([draw.uniform(20.0, 60.0), *draw.uniform(-3.0, 3.0, 3)]), np.zeros(2)
        for late in (None, NO_TIME):
            u = mpc.step(x, max_seconds=late).numpy()
            assert mpc.statuses[0] not in (Status.CONVERGED, Status.FEASIBLE)
            assert bool(mpc.held) and not bool(mpc.feasible) and (np.abs(u) <= 2.0).all()
            if any(isinstance(part, RateBounds) for part in parts):
                assert (np.abs(u - last) <= 0.3 + 1e-12).all()
            x, last = PULLED.step(torch.from_numpy(x), torch.from_numpy(u)).numpy(), u
        assert u[0] < -0.5  # back to where it may be


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.HorizonWarning")
def test_a_first_step_that_fails_in_free_time_keeps_the_bounds() -> None:
    goal, cost = Goal(state=[0.0] * 4, required=True), QuadraticCost([0.0] * 4, [1e-3] * 2, [0.0] * 4)
    problem = Problem(
        PULLED, cost, [ControlBounds(-1.0, 1.0)], [[3.0, 1.0, 0.0, 0.5]], 20, goal, time=FreeTime(0.1, 1.0)
    )
    mpc = MPC(problem, period=0.1, max_seconds=5.0)
    for x in ([90.0, 50.0, 0.0, 0.5], [-80.0, 3.0, 2.0, 0.0]):
        u = mpc.step(x)
        assert bool(mpc.held) and not bool(mpc.feasible) and bool((u.abs() <= 1.0).all())


def test_a_required_goal_isnt_asked_of_what_stops() -> None:
    """Late, with a disc in the way: the vehicle stops in front of it, and goes on when there is time again."""
    spheres = Spheres([[50.0, 0.0]], 0.4, 0.1)
    cost, goal = QuadraticCost([0.0] * 4, [0.1] * 2, [0.0] * 4), Goal([4.0, 0.0], 0.1, required=True)
    mpc = MPC(Problem(PULLED, cost, [ControlBounds(-1.0, 1.0), spheres], [[0.0] * 4], 40, goal))
    x = np.zeros(4)
    for _ in range(8):
        x = PULLED.step(torch.from_numpy(x), mpc.step(x)).numpy()
    mpc.step(x, centers=[[x[0] + 1.2, x[1]]], max_seconds=NO_TIME)
    assert bool(mpc.held) and bool(mpc.feasible) and float(mpc.plan.X[0, -1, 2:].abs().max()) < 1e-6
    mpc.step(PULLED.step(torch.from_numpy(x), mpc.plan.U[0, 0]).numpy(), centers=[[x[0] + 1.2, x[1]]])
    assert mpc.statuses[0] in (Status.CONVERGED, Status.FEASIBLE) and not bool(mpc.held)


def tilted(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return torch.stack((x[..., 1], 9.81 * x[..., 2].tan(), u[..., 0]), -1)


def steered(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    heading, speed = x[..., 2], x[..., 3]
    turn = speed * x[..., 4].tan() / 2.5
    return torch.stack((speed * heading.cos(), speed * heading.sin(), turn, u[..., 0], u[..., 1]), -1)


def stepped(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    return torch.cat((x[..., :2] + DT * x[..., 2:], 0.98 * x[..., 2:] + DT * u), -1)


MODELS: dict[str, tuple[Dynamics, list[float], float]] = {
    "pulled": (PULLED, [0.0, 0.0, 1.0, 1.0], 1e-6),
    "step alone": (FunctionDynamics(stepped, 4, 2, DT, "none", position=slice(0, 2)), [0.0, 0.0, 1.0, 1.0], 1e-6),
    "unicycle": (Unicycle(dt=DT), [0.0, 0.0, 3.0, 1.5], 1e-6),
    "steered": (FunctionDynamics(steered, 5, 2, DT, "rk4", position=slice(0, 2)), [0.0, 0.0, 3.0, 1.5, 0.3], 1e-6),
    "tilted": (FunctionDynamics(tilted, 3, 1, DT, "rk4", position=slice(0, 1)), [0.0, 1.0, 0.2], 0.2),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", MODELS)
def test_vehicles_of_any_model_come_to_rest(name: str) -> None:
    """The speed at the end, as a share of that at the start."""
    model, scale, left = MODELS[name]
    x0 = torch.tensor(np.random.default_rng(3).uniform(-1, 1, (6, model.n)) * scale)
    problem = Problem(
        model, QuadraticCost([1.0] * model.n, [0.1] * model.m, [1.0] * model.n), [ControlBounds(-1, 1)], x0, 40
    )
    U, at = stopping(problem, None), model.position
    X = [x0.unsqueeze(1).expand(-1, U.shape[1], -1)]
    for k in range(40):
        X.append(model.step(X[-1], U[:, :, k]))
    speeds = torch.stack([(b - a)[..., at].norm(dim=-1) for a, b in pairwise(X)])
    assert bool((U.abs() <= 1.0).all())
    assert bool((speeds[-1].amin(1) <= left * speeds[0].amax(1).clamp(min=0.02)).all())


def test_a_period_is_the_limit_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of all but the first, which compiles."""
    seen, whole = [], torchgco.Compiled.call

    def call(self: Any, *args: Any, **more: Any) -> Any:
        seen.append(more.get("max_seconds"))
        return whole(self, *args, **more | {"max_seconds": None})

    monkeypatch.setattr(torchgco.Compiled, "call", call)
    inf = float("inf")
    for more, want in (
        ({"period": 0.05}, [None, 0.05]), ({}, [None, None]), ({"period": 0.05, "max_seconds": inf}, [None, None]),
        ({"period": 0.05, "max_seconds": 0.02}, [0.02, 0.02]), ({"max_seconds": 0.02}, [0.02, 0.02]),
    ):  # fmt: skip
        mpc = MPC(drives(), "interior_point", **more)
        for again in range(2):
            seen.clear()
            mpc.step(np.zeros(4)), mpc.step(np.zeros(4)), mpc.step(np.zeros(4), max_seconds=0.5)
            assert seen == [*want, 0.5], (more, again)
            mpc.reset()


def test_what_comes_to_rest_is_no_faster_than_states_may_be_and_turns_as_before() -> None:
    problem = drives(2).started_at(torch.tensor([[0.0, 0, 0, -0.25], [0.0, 0, 0, 0.9]]).double(), drives(2).constraints)
    U = stopping(problem, None)  # (2, C, N, 2)
    x, found = problem.x0.unsqueeze(1).expand(-1, U.shape[1], -1), []
    for k in range(N):
        x = Unicycle(dt=DT).step(x, U[:, :, k])
        found.append(x)
    X = torch.stack(found, 2)
    assert float(X[..., 3].min()) >= -0.3 - 1e-9 and float(X[..., 3].max()) <= 1.0 + 1e-9
    turned, back = X[0, :, -1, 2].abs() > 0.5, X[0, :, -1, :2].norm(dim=-1) > 0.15  # at 0.3 m/s, for 0.7 s
    assert bool((turned & back).any()) and bool((X[1, :, -1, 0] > 0.9).any())


@pytest.mark.sampled(2)
@pytest.mark.parametrize("form", ["rates", "rates from others", "two bounds", "free time"])
def test_bounds_of_states_hold_in_the_form_that_solvers_work_on(form: str) -> None:
    """Whose states are followed by further ones: the controls before, or the length of a stage."""
    draw, place, stated = torch.Generator().manual_seed(0), drives(64), form.startswith("rates")
    x0 = torch.rand(64, 4, generator=draw, dtype=torch.float64) * torch.tensor([1.0, 1.0, 6.0, 1.25]).double()
    x0[:, 3] -= 0.25
    parts = [*place.constraints, StateBounds([-9e9] * 4, [9e9] * 3 + [0.9])]
    parts += [RateBounds(-0.5, 0.5, previous=[0.0, 0.0] if "others" in form else None)] if stated else []
    time = FreeTime(0.5, 2.0) if form == "free time" else None
    problem = Problem(place.dynamics, place.cost, parts, x0, N, goal=Goal([3.0, 1.0], 0.2), time=time)
    U = stopping(for_solvers(problem), None)
    assert U is not None and bool((U[..., :2].abs() <= torch.tensor([1.0, 1.5]) + 1e-9).all())
    if time is None:
        torch.testing.assert_close(U, stopping(problem, None), rtol=0.0, atol=1e-6)
    if not stated:  # else a speed is left only as fast as rates let it
        x = x0.unsqueeze(1).expand(-1, U.shape[1], -1)
        for k in range(N):
            x = place.dynamics.step(x, U[:, :, k, :2])
            assert bool((x[..., 3] <= x0[:, 3:].clamp(min=0.9) + 1e-9).all())


def test_a_robot_speeds_up_in_a_bend_where_only_that_serves() -> None:
    """Further candidates have controls half-way beside others at their bounds; they are tried where no other serves."""
    problem = drives()
    first, mixed = stopping(problem, None), stopping(problem, None, mixed=True)
    assert first is not None and mixed is not None
    # Before braking, at full acceleration and half of the largest rate of turn: none of the first ones does so.
    bend = torch.tensor([1.0, 0.75], dtype=torch.float64)
    begins = lambda U: (U[0, :, :3] - bend).abs().amax((1, 2)) < 1e-9
    assert not bool(begins(first).any()) and bool(begins(mixed).any())
    assert float((problem.dynamics.step(problem.x0, mixed[:, 0, -1])).abs().max()) < 1.0
    one = Problem(PULLED, QuadraticCost([1.0] * 4, [0.1] * 2, [1.0] * 4), [], [[0.0, 0, 1, 0]], N)
    assert stopping(one, None, mixed=True) is None, "no bounds, no shares of them"


def test_feasible_speaks_of_what_lies_between_the_knots() -> None:
    """Of a vehicle that passes thin poles with long stages, in every period what a dense look at the plan says."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.4, "rk4", slice(0, 2))
    cost = QuadraticCost(Q=[0.3, 1.0, 0.05, 0.05], R=[0.05, 0.05], Qf=[5.0, 5.0, 0.5, 0.5], x_ref=[8.0, 0.0, 0.0, 0.0])
    poles = Spheres([[1.5, 0.05], [3.0, -0.1], [4.6, 0.1], [6.1, -0.05]], 0.05, 0.1)
    start = torch.tensor([[0.0, 0.0, 2.0, 0.0]], dtype=torch.float64)
    problem = Problem(model, cost, [ControlBounds([-2.0] * 2, [2.0] * 2), poles], start, 12)
    loop, x, said, seen = MPC(problem), start, [], []
    for _ in range(12):
        u = loop.step(x)
        now = problem.started_at(x, problem.constraints)
        said.append(bool(loop.feasible))
        seen.append(float(torchgco.judge(now, loop.plan.moved_to(loop.t).U).clearance) >= 0)
        x = model.step(x, u)
    assert said == seen and set(said) == {True, False}
