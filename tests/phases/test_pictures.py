"""One figure and one certificate of all phases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.patches import Circle
from torch import Tensor

import torchgco
from benchmarks.families.phases import CASES
from tests.engines import compiled
from tests.phases.test_phases import HEAVY, NOTHING, bounces, drive
from tests.view.browser import Tab
from tests.view.conftest import chromium as chromium
from torchgco import (
    ControlBounds,
    Dynamics,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Jump,
    Link,
    Phases,
    PhasesSolution,
    Problem,
    QuadraticCost,
    Spheres,
)

pytestmark = compiled
D = torch.float64


class Steps(Dynamics):
    n, m = 1, 1

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        return x + 0.1 * u


def driven() -> tuple[Phases, PhasesSolution]:
    """Two drives of two problems, each past a disc of its own, the second by another model."""
    first = drive(torch.zeros(2, 4, dtype=D), [1.0, 0.0], Spheres([[0.5, 0.15]], [0.15], 0.05), N=25)
    second = torch.tensor([[1.0, 0.0, 0.3, 0.3], [1.0, 0.1, 0.2, 0.1]], dtype=D)
    then = drive(second, [2.0, 1.0], Spheres([[1.5, 0.55]], [0.1], 0.05), model=HEAVY, N=25)
    phases = Phases([first, then], [Jump(lambda x: torch.cat((x[..., :2], 0.3 * x[..., 2:]), -1))])
    return phases, torchgco.solve(phases)


def take_off() -> tuple[Phases, PhasesSolution]:
    """A phase with a position and one without."""
    nowhere = replace(HEAVY, position=None)
    first, then = (drive(torch.zeros(1, 4, dtype=D), [1.0, 0.0], model=model, N=5) for model in (HEAVY, nowhere))
    phases = Phases([first, then])
    return phases, torchgco.solve(phases)


@pytest.mark.slow
def test_a_film_has_each_phase_with_its_own_obstacles_and_jumps_in_an_instant() -> None:
    phases, solution = driven()
    film = torchgco.animate(phases, solution, b=1)
    (scene,) = film._fig.axes
    end = float(solution.begins[1, 1])
    for t, phase in ((0.0, 0), (0.5 * end, 0), (end - 1e-6, 0), (end, 1), (1.4 * end, 1), (2.0 * end, 1)):
        (vehicle,) = (one for one in film.at(t) if isinstance(one, Circle))
        X = solution[phase].X[1, :, :2].numpy()
        own = np.linspace(0.0, end, 26) + phase * end
        np.testing.assert_allclose(vehicle.center, [np.interp(t, own, X[:, i]) for i in (0, 1)], atol=1e-9)
        seen = [one.get_paths()[0].vertices for one in scene.collections if one.get_visible()]
        centres = [0.5 * (corners.max(0) + corners.min(0)) for corners in seen]
        np.testing.assert_allclose(centres, [[[0.5, 0.15], [1.5, 0.55]][phase]] * 2, atol=1e-6)  # plain, and grown
        assert f"phase {phase + 1} of 2" in scene.get_title(loc="left")


@pytest.mark.slow
def test_a_page_has_the_phases_one_after_the_other(chromium: Callable[[], Tab], tmp_path: Path) -> None:
    phases, solution = driven()
    torchgco.show(phases, solution).save(tmp_path / "phases.html")
    tab, end = chromium(), float(solution.begins[1, 1])
    tab.size(600, 400)
    tab.open(tmp_path / "phases.html")
    page = "torchgcoView"
    tab.evaluate(f"{page}.choose(1)")
    assert tab.evaluate(f"{page}.flights.duration") == pytest.approx(2.0 * end, rel=1e-3)
    for t, phase in ((0.0, 0), (0.5 * end, 0), (1.001 * end, 1), (1.4 * end, 1), (2.0 * end, 1)):
        tab.evaluate(f"{page}.setTime({t})")
        shown = tab.evaluate(f"{page}.flights.all.map((one) => one.body.visible)")
        assert shown == [phase == 0, phase == 1]
        assert tab.evaluate(f"{page}.obstacles.group.children.map((one) => one.visible)") == shown
        x, y, _ = (float(word) for word in tab.evaluate("document.getElementById('picture').dataset.vehicle").split())
        X, own = solution[phase].X[1].numpy(), np.linspace(0.0, end, 26) + phase * end
        assert [x, y] == pytest.approx([float(np.interp(t, own, X[:, i])) for i in (0, 1)], abs=5e-3)


@pytest.mark.slow
def test_a_figure_has_the_phases_in_their_order_and_marks_the_jumps() -> None:
    phases, solution = driven()
    figure = torchgco.plot(phases, solution, b=1)
    scene, *histories = figure.axes
    assert len(histories) == 6  # the components of both models have the same names
    position = np.concatenate([one.X[1, :, :2].numpy() for one in solution])
    ways = [line.get_xydata() for line in scene.lines if len(line.get_xydata()) == 26]
    np.testing.assert_allclose(np.concatenate(ways[:2]), position)
    begins = solution.begins[1].tolist()
    for ax in histories:
        dotted = [line.get_xdata()[0] for line in ax.lines if line.get_linestyle() == ":"]
        assert dotted == pytest.approx(begins[1:2])
        assert max(line.get_xdata().max() for line in ax.lines if line.get_linestyle() == "-") <= begins[2] + 1e-9
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert f"problem 1: CONVERGED, cost {float(solution.cost[1]):.6g}" in texts and "the next phase begins" in texts


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["take-off to cruise", "bouncing ball"])
def test_phases_of_other_sizes_and_without_a_position_are_drawn_over_time(name: str) -> None:
    phases = CASES[name].phases(2)
    figure = torchgco.plot(phases, torchgco.solve(phases))
    sizes = max(one.n + one.m for one in phases.problems)
    assert len(figure.axes) == sizes


def test_a_model_without_a_time_step_is_drawn_by_knots() -> None:
    row = FunctionConstraint(lambda x: x - 1.0, "equality", knots=[-1])
    one = Problem(Steps(), NOTHING, [row], torch.zeros(1, 1, dtype=D), 4)
    phases = Phases([one, one], [Jump(lambda x: 0.5 * x)])
    figure = torchgco.plot(phases, torchgco.solve(phases))
    dotted = [line.get_xdata()[0] for line in figure.axes[0].lines if line.get_linestyle() == ":"]
    assert dotted == [4.0]


def test_a_certificate_of_all_phases_sees_each_mistake() -> None:
    phases, solution = driven()
    good = torchgco.certify(phases, solution)
    assert float(good.dynamics_residual.max()) < 1e-12 and float(good.kkt_residual.max()) < 1e-6
    assert float(good.bound_violation.max()) == 0.0 and bool((good.clearance > -1e-2).all())
    judged = torchgco.judge(phases, solution)
    assert float((judged.clearance - good.clearance).max()) < 1e-2  # a bound of it
    for knot, most in ((26, 1e-3), (40, 1e-3)):  # the first one after the jump, and one of the second phase
        X = solution.found.X.clone()
        X[0, knot, 2] += most
        moved = replace(solution, found=replace(solution.found, X=X))
        seen = torchgco.certify(phases, moved).dynamics_residual
        assert float(seen[0]) > 0.9 * most and float(seen[1]) < 1e-12
    lam = tuple(1.5 * z for z in solution.found.multipliers.lam)
    pushed = replace(solution.found, multipliers=replace(solution.found.multipliers, lam=lam))
    assert float(torchgco.certify(phases, replace(solution, found=pushed)).kkt_residual.min()) > 1e-3


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["two impulses", pytest.param("Delta III", marks=pytest.mark.slow), "gears"])
def test_free_times_and_impulses_are_stationary(name: str) -> None:
    case = CASES[name]
    phases = case.phases(2)
    rest = None if case.push is None else [one.x0.new_tensor(case.push).expand(2, one.N, -1) for one in phases.problems]
    certificate = torchgco.certify(phases, torchgco.solve(phases, rest))
    assert float(certificate.kkt_residual.max()) < 1e-3 and float(certificate.dynamics_residual.max()) < 1e-12
    assert float(certificate.step_error.max()) < 1e-3


@pytest.mark.slow
def test_free_starts_links_and_loops_are_stationary_and_some_are_asked_for() -> None:
    hop = bounces(0.5, B=2)
    asked = torch.tensor([False, True])
    certificate = torchgco.certify(hop, torchgco.solve(hop), asked=asked)
    assert bool(certificate.kkt_residual[0].isnan()) and float(certificate.kkt_residual[1]) < 1e-6
    free = [True, True, False, False]
    out = drive(torch.zeros(1, 4, dtype=D), [1.0, 0.0], free_start=free, N=8)
    back = drive(torch.zeros(1, 4, dtype=D), [0.0, 1.0], N=8)
    lap = Phases([out, back], [Link()], loop=Link(components=[0, 1]))
    found = torchgco.certify(lap, torchgco.solve(lap))
    assert float(found.kkt_residual) < 1e-6 and float(found.dynamics_residual) < 1e-12


def test_steps_of_two_phases_are_those_of_one_longer_problem() -> None:
    lag = FunctionDynamics(
        lambda x, u: torch.stack((x[..., 1], 9.0 * (u[..., 0] - x[..., 1])), -1), n=2, m=1, dt=0.1, integrator="rk4"
    )
    cost = lambda end: QuadraticCost([1.0, 0.1], [0.1], [end, end], x_ref=[1.0, 0.0])
    x0, rows = torch.tensor([[0.0, 0.0], [0.3, 1.0]], dtype=D), [ControlBounds(-0.9, 0.9)]
    whole = Problem(lag, cost(9.0), rows, x0, 20)
    found = torchgco.solve(whole, solver="interior_point")
    alone = torchgco.certify(whole, found.X, found.U, multipliers=found.multipliers.lam)
    phases = Phases([Problem(lag, cost(0.0), rows, x0, 8), Problem(lag, cost(9.0), rows, x0, 12)])
    solution = torchgco.solve(phases)
    of_all = torchgco.certify(phases, solution)
    # Of phases to first order without feedback, of one problem with it and to second order: alike to a percent here.
    torch.testing.assert_close(of_all.step_cost, alone.step_cost, rtol=1e-2, atol=0.0)
    # The range of a state is that of its own phase.
    parts = [torchgco.certify(one, part.X, part.U) for one, part in zip(solution.problems, solution, strict=True)]
    assert torch.equal(of_all.step_error, torch.maximum(parts[0].step_error, parts[1].step_error))
    some = torchgco.certify(phases, solution, asked=torch.tensor([False, True]))
    assert some.step_cost.isnan().tolist() == [True, False] and bool(some.step_cost[1] == of_all.step_cost[1])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_step_costs_of_all_phases_tell_what_half_of_dt_changes(seed: int) -> None:
    """A fall and a push back, with drag, in steps of Euler: those of the fall count through the jump and the push. They
    do to first order: what they miss falls as the square of dt."""
    random = np.random.default_rng(seed)
    drag, kept = random.uniform(0.1, 0.5), random.uniform(0.4, 0.8)
    rates = lambda x, u: torch.stack((x[..., 1], u[..., 0] - 9.81 - drag * x[..., 1]), -1)
    back = FunctionConstraint(lambda x: x - x.new_tensor([1.0, 0.0]), "equality", knots=[-1], name="back")
    ground = FunctionConstraint(lambda x: x[..., :1], "equality", knots=[-1], name="ground")
    start, hit = torch.tensor([[1.0, 0.0]], dtype=D), torch.tensor([[0.0, 2.0]], dtype=D)

    def flown(dt: float, halved: bool) -> tuple[float, float]:
        """The cost, and the step cost."""
        effort = FunctionCost(lambda x, u: dt * u[..., 0] ** 2)
        euler = lambda x, u, h: x + h * rates(x, u)
        twice = lambda x, u: euler(euler(x, u, 0.5 * dt), u, 0.5 * dt)
        model = FunctionDynamics(twice if halved else rates, 2, 1, dt, integrator="none" if halved else "euler")
        fall, rise = round(0.45 / dt), round(0.6 / dt)
        parts = Problem(model, effort, [ground], start, fall), Problem(model, effort, [back], hit, rise)
        phases = Phases(parts, [Jump(lambda x: torch.stack((x[..., 0], -kept * x[..., 1]), -1))])
        solution = torchgco.solve(phases)
        certificate = torchgco.certify(phases, solution)
        assert bool(certificate.step_cost.isnan()) == halved
        return float(solution.cost), float(certificate.step_cost)

    missed = []
    for dt in (0.0125, 0.00625):
        (cost, told), (finer, _) = flown(dt, False), flown(dt, True)
        missed.append(abs(told - abs(finer - cost) / cost))
        assert told > 0.004
    assert missed[1] < 0.35 * missed[0]


def test_wrong_use_gets_one_line() -> None:
    phases, solution = driven()
    with pytest.raises(InputError, match="solution: expected a PhasesSolution of 2 phases"):
        torchgco.certify(phases, solution[0].X)  # type: ignore[call-overload]
    with pytest.raises(InputError, match=r"certify\.times: expected None of phases"):
        torchgco.certify(phases, solution, times=solution[0].X)  # type: ignore[call-overload]
    with pytest.raises(InputError, match="solution: expected phases and their solution"):
        torchgco.plot(phases, solution[0])
    with pytest.raises(InputError, match="b: expected the place of a problem"):
        torchgco.plot(phases, solution, b=2)
    for picture in (torchgco.show, torchgco.animate):
        with pytest.raises(InputError, match="solution: expected phases and their solution"):
            picture(phases, solution[0])
    flat, flown = take_off()
    with pytest.raises(InputError, match="dynamics with a position in 2-D or 3-D, of all phases the same"):
        torchgco.animate(flat, flown)
    with pytest.raises(InputError, match=r"dynamics\.position: expected a model with a position"):
        torchgco.show(flat, flown)
