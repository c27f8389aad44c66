"""Trajectories as tables: names with units, samples at any rate by NumPy's own integration, what states imply."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    Airframe,
    ControlBounds,
    Dynamics,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    RotorTracking,
    Solution,
    StateBounds,
    Unicycle,
)
from torchgco.dynamics.names import controls_of, states_of

DT, N = 0.1, 20


@dataclass(frozen=True)
class Ball(Dynamics):
    """A ball in the air: x = [height, climb], u = [push], with its drag per problem."""

    drag: Any = 0.3
    dt: float = DT
    integrator: str = "rk4"
    n, m, position = 2, 1, slice(0, 1)
    per_element = ("drag",)
    state_names: ClassVar[tuple[str, ...]] = ("height", "climb")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s")
    control_names: ClassVar[tuple[str, ...]] = ("push",)
    control_units: ClassVar[tuple[str, ...]] = ("N",)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        drag = self.drag.view(-1, *[1] * (x.dim() - 2)) if isinstance(self.drag, Tensor) else self.drag
        return torch.stack((x[..., 1], u[..., 0] - 9.81 - drag * x[..., 1] * x[..., 1].abs()), -1)

    def derived(self, x: Tensor, u: Tensor) -> dict[str, Tensor]:
        return {"energy [J]": 9.81 * x[..., 0] + 0.5 * x[..., 1].square()}


DRAGS = np.array([0.1, 0.5])


def thrown(model: Dynamics | None = None) -> Problem:
    model = Ball(torch.tensor(DRAGS)) if model is None else model
    cost = QuadraticCost([1, 0.1], [0.01], [10, 1], x_ref=[3.0, 0.0], u_ref=[9.81])
    return Problem(model, cost, [ControlBounds([0.0], [20.0])], [[0.0, 0.0], [1.0, -1.0]], N)


def rk4(x: np.ndarray, u: float, drag: float, h: float) -> np.ndarray:
    rates = lambda x: np.array([x[1], u - 9.81 - drag * x[1] * abs(x[1])])
    a = rates(x)
    b = rates(x + 0.5 * h * a)
    c = rates(x + 0.5 * h * b)
    return x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c))


@pytest.mark.parametrize("rate", [None, 10.0, 37.0, 250.0])
def test_a_table_at_any_rate(rate: float | None, tmp_path: Path) -> None:
    solution = torchgco.solve(thrown())
    solution.to_csv(tmp_path / "thrown.csv", rate)
    table = pd.read_csv(tmp_path / "thrown.csv")
    heads = ["problem", "t [s]", "height [m]", "climb [m/s]", "vx [m/s]", "ax [m/s^2]", "energy [J]", "push [N]"]
    assert list(table.columns) == heads
    times = np.arange(N + 1) * DT if rate is None else np.arange(int(N * DT * rate + 1e-6) + 1) / rate
    times = times if times[-1] > N * DT - 1e-9 else np.append(times, N * DT)  # the state at the end is there, too
    for b in (0, 1):
        rows = table[table["problem"] == b].to_numpy()[:, 1:]
        X, U = solution.X[b].numpy(), solution.U[b, :, 0].numpy()
        np.testing.assert_allclose(rows[:, 0], times, atol=1e-12)
        np.testing.assert_allclose(rows[-1, 1:3], X[-1], atol=1e-12)
        for t, height, climb, vx, ax, energy, push in rows:
            k = min(int(t / DT + 1e-9), N - 1)
            state = rk4(X[k], U[k], DRAGS[b], t - k * DT)
            np.testing.assert_allclose([height, climb], state, atol=1e-9)
            np.testing.assert_allclose(push, U[k], atol=1e-12)
            force = U[k] - 9.81 - DRAGS[b] * climb * abs(climb)
            np.testing.assert_allclose([vx, ax, energy], [climb, force, 9.81 * height + climb**2 / 2], atol=1e-9)


def test_what_a_solution_doesnt_know_stands_as_numbers(tmp_path: Path) -> None:
    """A loaded one has straight lines between its knots, unless it is told the problem."""
    problem, solution = thrown(), torchgco.solve(thrown())
    solution.save(tmp_path / "solution.npz")
    loaded = Solution.load(tmp_path / "solution.npz")
    bare = loaded.trajectories(20.0)
    assert list(bare.columns) == ["problem", "t [s]", "x[0]", "x[1]", "u[0]"]
    half = bare[bare["problem"] == 1].iloc[5][["x[0]", "x[1]"]].to_numpy(float)
    np.testing.assert_allclose(half, 0.5 * (solution.X[1, 2] + solution.X[1, 3]).numpy(), atol=1e-12)
    pd.testing.assert_frame_equal(loaded.trajectories(20.0, problem), solution.trajectories(20.0))


def test_models_without_a_derivative_have_straight_lines() -> None:
    """And no acceleration; an unnamed position has letters."""
    model = FunctionDynamics(Ball().step, 2, 1, DT, "none", position=slice(0, 1))
    solution = torchgco.solve(thrown(model))
    table = solution.trajectories(20.0)
    assert list(table.columns) == ["problem", "t [s]", "x [m]", "x[1]", "u[0]"]
    np.testing.assert_allclose(table["x [m]"][5], 0.5 * float(solution.X[0, 2, 0] + solution.X[0, 3, 0]), atol=1e-12)


def test_a_horizon_ends_its_rows() -> None:
    solution = torchgco.solve(replace(thrown(), horizon=torch.tensor([5, 20])))
    table = solution.trajectories()
    assert table.groupby("problem")["t [s]"].max().tolist() == pytest.approx([0.5, 2.0])
    np.testing.assert_allclose(table[table["problem"] == 0]["height [m]"], solution.X[0, :6, 0], atol=1e-12)


def test_a_quadrotors_thrust_and_acceleration() -> None:
    """Flying straight up, with drag."""
    frame = Airframe(mass=1.2, drag=0.5)
    X, U = torch.zeros(1, 3, 14).double(), torch.zeros(1, 2, 4).double()
    X[..., 6], X[..., 5], X[..., 13] = 1.0, 2.0, 12.0
    U[..., 3] = 12.0
    model = QuadrotorPlanning(airframe=frame)
    problem = Problem(model, QuadraticCost([1] * 14, [1] * 4, [1] * 14), [], X[:, 0], 2)
    found = replace(torchgco.solve(problem, solver="hold"), X=X, U=U).trajectories()
    np.testing.assert_allclose(found["thrust [N]"], 14.4)
    np.testing.assert_allclose(found["az [m/s^2]"], 12.0 - 9.81 - 0.5 / 1.2 * 2.0)
    assert "vx [m/s]" in found and list(found.columns).count("vz [m/s]") == 1


@pytest.mark.parametrize("units", [("m", "m", "rad", "m/s", "m/s"), ()])
def test_velocities_in_the_vehicles_axes_are_not_those_of_its_position(units: tuple[str, ...]) -> None:
    """States named vx and vy: the position's own rates have other names."""

    def slips(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        cosine, sine, ahead, left = x[..., 2].cos(), x[..., 2].sin(), x[..., 3], x[..., 4]
        rates = ahead * cosine - left * sine, ahead * sine + left * cosine, u[..., 1], u[..., 0], 0.0 * left
        return torch.stack(rates, -1)

    names = ("x", "y", "heading", "vx", "vy") if units else ("x [m]", "y [m]", "heading [rad]", "vx [m/s]", "vy [m/s]")
    model = FunctionDynamics(
        slips, 5, 2, DT, "rk4", position=slice(0, 2), state_names=names, state_units=units or ("",) * 5
    )
    problem = Problem(model, QuadraticCost([0] * 5, [1] * 2, [0] * 5), [], [[0.0, 0.0, 1.0, 2.0, 0.5]], 4)
    found = torchgco.solve(problem, solver="hold").trajectories()
    ahead, left = 2 * np.cos(1.0) - 0.5 * np.sin(1.0), 2 * np.sin(1.0) + 0.5 * np.cos(1.0)
    assert found["vx [m/s]"][0] == 2.0 and "ax [m/s^2]" in found
    np.testing.assert_allclose(found[["dx/dt [m/s]", "dy/dt [m/s]"]].iloc[0].astype(float), [ahead, left])


@pytest.mark.parametrize("kind", [Planar, QuadrotorPlanning, QuadrotorPlant, RotorTracking, Unicycle])
def test_the_librarys_models_have_names(kind: type[Any]) -> None:
    model = kind()
    for named, count in ((states_of(model), model.n), (controls_of(model), model.m)):
        assert len({one.label for one in named}) == count and not any("[0]" in one.name for one in named)
    at = model.position
    assert at is None or [one.label for one in states_of(model)[at]] == ["x [m]", "y [m]", "z [m]"][: at.stop]


def test_names_reach_figures_and_explanations() -> None:
    problem = thrown()
    figure = torchgco.plot(problem, torchgco.solve(problem))
    titles = {ax.get_title() for ax in figure.axes} | {ax.get_title(loc="left") for ax in figure.axes}
    assert {"height [m]", "climb [m/s]", "push [N]"} <= titles
    sinking = replace(problem, constraints=[*problem.constraints, StateBounds([-9.0, 5.0], [9.0, 6.0])])
    told = str(torchgco.solve(sinking, solver="interior_point").explain())
    assert "lower bound of state 1 (climb [m/s])" in " ".join(told.split())


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"state_names": ["height"]}, r"dynamics.state_names: expected 2 texts, one per state, got \['height'\]"),
        ({"state_names": "ab"}, "dynamics.state_names: expected a list of texts"),
        ({"state_names": ["a", "a"]}, "dynamics.state_names: expected a name of its own for each"),
        ({"control_units": [3]}, "dynamics.control_units: expected a list of texts"),
    ],
)
def test_names_that_dont_fit_get_one_line(given: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError, match=line):
        thrown(FunctionDynamics(lambda x, u: x * u, 2, 1, DT, **given))


def test_a_rate_that_is_none_gets_one_line() -> None:
    solution = torchgco.solve(thrown(), solver="hold")
    with pytest.raises(InputError, match="rate: expected a number above 0"):
        solution.to_csv(Path("never.csv"), rate=0.0)
    with pytest.raises(InputError, match=r"problem: solution\.X"):
        solution.trajectories(problem=thrown().take(slice(0, 1)))
    text = io.StringIO(solution.trajectories().to_csv())
    assert len(pd.read_csv(text)) == 2 * (N + 1)
