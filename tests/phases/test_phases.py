"""Phases against closed forms, single problems that are the same, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

import torchgco
from tests.engines import compiled
from torchgco import (
    Boxes,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InputError,
    Integral,
    Jump,
    Link,
    NormBounds,
    Phases,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
)
from torchgco.constraints.base import Constraint
from torchgco.phases.lowered import PhaseRows, Span, Whole

pytestmark = compiled
D = torch.float64
G = 9.81
NOTHING = FunctionCost(lambda x, u: u.square().sum(-1))
CART = FunctionDynamics(
    lambda x, u: torch.cat((x[..., 2:], u), -1), n=4, m=2, dt=0.1, integrator="rk4", position=slice(0, 2)
)
HEAVY = FunctionDynamics(
    lambda x, u: torch.cat((x[..., 2:], 0.5 * u - 0.2 * x[..., 2:]), -1), n=4, m=2, dt=0.1, integrator="rk4",
    position=slice(0, 2),
)  # fmt: skip


def to(goal: list[float], **weights: Any) -> QuadraticCost:
    return QuadraticCost(
        **{"Q": [0.0] * 4, "R": [0.1, 0.1], "Qf": [50.0, 50, 1, 1], "x_ref": [*goal, 0.0, 0.0]} | weights
    )


def drive(x0: Any, there: list[float], *rows: Constraint, model: FunctionDynamics = CART, N: int = 15, **more: Any):
    return Problem(model, to(there), [ControlBounds(-3.0, 3.0), *rows], x0, N, **more)


def solved(phases: Phases, **options: Any) -> torchgco.PhasesSolution:
    """A solution that all problems have, and that the judge sees the same."""
    solution = torchgco.solve(phases, **options)
    assert solution.statuses == [Status.CONVERGED] * phases.B, solution
    verdict = torchgco.judge(phases, solution)
    assert bool(verdict.feasible.all())
    torch.testing.assert_close(verdict.cost, solution.cost, rtol=1e-9, atol=1e-9)
    assert float((verdict.violation - solution.violation).abs().max()) < 1e-6
    return solution


def bounces(height: float, B: int = 1) -> Phases:
    """A ball that is shot up, and after two bounces reaches a height: rockit's example."""
    ball = FunctionDynamics(
        lambda x, u: torch.stack((x[..., 1], 0.0 * x[..., 1] - G), -1), n=2, m=1, dt=0.05, integrator="rk4"
    )
    ground = FunctionConstraint(lambda x: x[..., :1], "equality", knots=[-1], name="ground")
    top = FunctionConstraint(lambda x: x - x.new_tensor([height, 0.0]), "equality", knots=[-1], name="top")
    arc = lambda row, **more: Problem(ball, NOTHING, [row], torch.tensor([[0.0, 3.0]], dtype=D).repeat(B, 1), 20,
                                      time=FreeTime(0.05, 4.0), **more)  # fmt: skip
    bounce = Jump(lambda x: torch.stack((x[..., 0], -0.9 * x[..., 1]), -1))
    return Phases([arc(ground, free_start=[False, True]), arc(ground), arc(top)], [bounce, bounce])


@pytest.mark.slow
def test_a_ball_is_shot_so_that_it_reaches_a_height_after_two_bounces() -> None:
    solution = solved(bounces(0.5))
    launch = math.sqrt(2.0 * G * 0.5) / 0.81
    assert float(solution[0].X[0, 0, 1]) == pytest.approx(launch, rel=1e-8)
    expected = torch.tensor([[2.0 * launch / G, 1.8 * launch / G, 0.81 * launch / G]], dtype=D)
    torch.testing.assert_close(solution.begins.diff(dim=1), expected, rtol=1e-7, atol=0.0)
    assert [one.X.shape for one in solution] == [(1, 21, 2)] * 3 and len(solution) == 3
    torch.testing.assert_close(solution[1].X[:, 0, 1], -0.9 * solution[0].X[:, -1, 1], rtol=1e-12, atol=0.0)


@pytest.mark.slow
def test_two_impulses_at_free_times_are_hohmanns() -> None:
    from benchmarks.families.phases_problems import impulses

    solution = solved(impulses(1))
    first = math.sqrt(2.0 * 1.5 / 2.5) - 1.0
    second = math.sqrt(1.0 / 1.5) - math.sqrt(2.0 / (1.5 * 2.5))
    sizes = [float(v.norm()) for v in solution.jumps]
    assert sizes == pytest.approx([first, second], abs=1e-4) and float(solution.cost) == pytest.approx(
        sum(sizes), abs=1e-6
    )
    assert float(solution[1].duration) == pytest.approx(math.pi * 1.25**1.5, rel=1e-3)


def test_one_phase_is_its_problem() -> None:
    problem = drive([[0.0] * 4, [0.5, 0, 0, 1]], [1.0, 0.5])
    alone = torchgco.solve(problem, solver="interior_point")
    torch.testing.assert_close(solved(Phases([problem]))[0].U, alone.U, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("solver", ["interior_point", "al_ilqr", "gco", "ipopt"])
def test_phases_of_the_same_model_are_one_longer_problem(solver: str) -> None:
    parts = [Problem(CART, to([1.0, 0.5], Q=[1.0, 1, 0, 0], Qf=weights), [ControlBounds(-1.0, 1.0)], [0.0] * 4, 12)
             for weights in ([0.0] * 4, [50.0, 50, 1, 1])]  # fmt: skip
    whole = Problem(CART, to([1.0, 0.5], Q=[1.0, 1, 0, 0]), [ControlBounds(-1.0, 1.0)], [0.0] * 4, 24)
    expected = torchgco.solve(whole, solver="interior_point")
    found = solved(Phases(parts), solver=solver)
    tolerance = 1e-3 if solver == "al_ilqr" else 1e-5
    torch.testing.assert_close(torch.cat([one.U for one in found], 1), expected.U, rtol=0.0, atol=tolerance)
    torch.testing.assert_close(found.cost, expected.cost, rtol=1e-4 if solver == "al_ilqr" else 1e-6, atol=0.0)


ROWS: dict[str, Callable[[], list[Constraint]]] = {
    "spheres": lambda: [Spheres([[0.5, 0.05]], [0.2], vehicle_radius=0.1)],
    "boxes": lambda: [Boxes([[0.5, 0.15]], [[0.1, 0.1]], vehicle_radius=0.1)],
    "rates": lambda: [RateBounds(-0.3, 0.3, previous=[0.0, 0.0])],
    "norms": lambda: [NormBounds("u", upper=2.0)],
    "states": lambda: [StateBounds([-9, -9, -1.0, -1.0], [9, 9, 1.0, 1.0])],
    "a budget": lambda: [Integral(lambda x, u: u.square().sum(-1), most=1.5)],
    "a link": lambda: [Link(components=[1])],
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ROWS)
def test_rows_of_a_second_phase_are_those_of_its_problem(kind: str) -> None:
    """The first phase stays where the second begins, so that this one alone has something to choose."""
    second = drive([0.0] * 4, [1.0, 0.0], *ROWS[kind](), N=30)
    still = Problem(HEAVY, QuadraticCost(Q=[1.0] * 4, R=[1.0, 1.0], Qf=[1e4] * 4), [], [0.0] * 4, 5)
    alone = torchgco.solve(second, solver="interior_point")
    found = solved(Phases([still, second]))
    torch.testing.assert_close(found[1].cost, alone.cost, rtol=1e-2, atol=0.0)
    assert float(found[1].violation) < 1e-6 and float(second.constraints[1].worst(found[1].X, found[1].U)) < 1e-6


def test_goals_and_other_sizes() -> None:
    """A cart stops at a place, loses half of its states, and goes on along a line."""
    line = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), n=2, m=1, dt=0.1, integrator="rk4")
    first = drive([0.0] * 4, [0.0, 0.0], goal=Goal([1.0, 0.5], 0.01, required=True))
    second = Problem(line, NOTHING, [FunctionConstraint(lambda x: x - 2.0, "equality", knots=[-1])], [1.0, 0.0], 8,
                     time=FreeTime(0.2, 5.0))  # fmt: skip
    found = solved(Phases([first, second], [Jump(lambda x: x[..., [0, 2]])]))
    assert bool(torchgco.judge(first, found[0].U).reached) and found[1].X.shape == (1, 9, 2)
    for problem, part in zip(found.problems, found, strict=True):
        certificate = torchgco.certify(problem, part.X, part.U, times=part.times)
        assert float(certificate.dynamics_residual) < 1e-9 and "CONVERGED" in str(part.explain())
    torch.testing.assert_close(found[1].X[:, -1], torch.full((1, 2), 2.0, dtype=D), rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_links_between_phases_leave_the_rest_to_the_solver() -> None:
    one, other = drive([0.0] * 4, [1.0, 0.0]), drive([1.0, 0, 0, 0], [2.0, 0.0], model=HEAVY)
    same, linked = solved(Phases([one, other])), solved(Phases([one, other], [Link()]))
    torch.testing.assert_close(linked.cost, same.cost, rtol=1e-7, atol=0.0)
    near = Link(lambda x, y, gap: (x - y).square().sum(-1, keepdim=True) - gap**2, sense="inequality",
                components=[0, 1], values={"gap": torch.tensor([[0.2]], dtype=D)})  # fmt: skip
    apart = solved(Phases([one, other], [near]))
    assert float(apart.cost) < float(same.cost) - 1e-3
    assert float((apart[0].X[0, -1, :2] - apart[1].X[0, 0, :2]).norm()) == pytest.approx(0.2, abs=1e-6)


@pytest.mark.slow
def test_a_lap_of_two_phases_is_closed() -> None:
    """As one problem with a Link is, where both phases have the same model."""
    wave = 0.2 * torch.arange(25, dtype=D)
    wanted = torch.stack((wave.sin(), wave.cos(), 0 * wave, 0 * wave), -1)[None]
    follow = lambda rows, Qf: QuadraticCost(Q=[1.0, 1, 0, 0], R=[0.1, 0.1], Qf=Qf, x_ref=rows)
    free, none = [True] * 4, [0.0] * 4
    whole = Problem(CART, follow(wanted, none), [Link()], torch.zeros(1, 4, dtype=D), 24, free_start=free)
    alone = torchgco.solve(whole, solver="interior_point")
    parts = [Problem(CART, follow(wanted[:, a : a + 13], none), [], torch.zeros(1, 4, dtype=D), 12, free_start=start)
             for a, start in ((0, free), (12, None))]  # fmt: skip
    found = solved(Phases(parts, loop=Link()))
    torch.testing.assert_close(found.cost, alone.cost, rtol=1e-7, atol=0.0)
    torch.testing.assert_close(found[0].X[:, 0], found[1].X[:, -1], rtol=0.0, atol=1e-7)
    assert float(torchgco.judge(Phases(parts, loop=Link(lambda a, b: a - b - 1.0)), found).violation) == pytest.approx(
        1.0
    )
    with pytest.raises(InputError, match=r"phases.loop: expected a Link"):
        Phases(parts, loop=3)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_problem_does_not_depend_on_its_batch() -> None:
    starts = torch.tensor([[0.0, 0, 0, 0], [0.2, 0.3, 0, 0], [-0.5, 0.1, 1, 0]], dtype=D)
    gains = torch.tensor([0.2, 0.5, 0.9], dtype=D)
    kick = Jump(lambda x, gain: torch.cat((x[..., :2], gain.unsqueeze(-1) * x[..., 2:]), -1), values={"gain": gains})
    first, second = drive(starts, [1.0, 0.0]), drive(starts, [2.0, 0.5], model=HEAVY, time=FreeTime(0.5, 2.0))
    all_three = solved(Phases([first, second], [kick]))
    for rows in ([0], [2, 1]):
        part = Jump(kick.function, values={"gain": gains[rows]})
        some = solved(Phases([first.take(rows), second.take(rows)], [part]))
        for mine, theirs in zip(some, all_three, strict=True):
            assert torch.equal(mine.X, theirs.X[rows]) and torch.equal(mine.U, theirs.U[rows])
            assert torch.equal(mine.t.expand(len(rows), -1), theirs.t.expand(3, -1)[rows])


@pytest.mark.slow
def test_a_bad_element_ends_by_itself() -> None:
    starts = torch.tensor([[0.0, 0, 0, 0], [0.0, 0, 1, 0]], dtype=D)
    lost, problem = {"lost": torch.tensor([1.0, 0.0], dtype=D)}, drive(starts, [1.0, 0.0])
    plain = Jump(lambda x, lost: x / lost.unsqueeze(-1), values=lost)
    pushed = Jump(lambda x, v, lost: (x + torch.cat((v, v), -1)) / lost.unsqueeze(-1), 2,
                  lambda x, v: v.square().sum(-1), values=lost)  # fmt: skip
    for wild in (plain, pushed):
        solution = torchgco.solve(Phases([problem, problem], [wild]))
        assert solution.statuses == [Status.CONVERGED, Status.NON_FINITE]
        assert torchgco.judge(Phases([problem, problem], [wild]), solution).feasible.tolist() == [True, False]


def test_rows_of_jumps() -> None:
    """An impulse that takes the speed along x away, within bounds, whatever it costs."""
    stop = FunctionConstraint(lambda x, v: x[..., 2:3] + v[..., :1], "equality", of="xu")
    kick = Jump(lambda x, v: x + torch.cat((0 * v, v), -1), 2, lambda x, v: v.square().sum(-1),
                constraints=[ControlBounds(-0.1, 0.1), stop])  # fmt: skip
    problem = drive([[0.0] * 4, [0.1] * 4], [1.0, 0.0])
    found = solved(Phases([problem, problem], [kick]))
    torch.testing.assert_close(found.jumps[0][:, 0], -found[0].X[:, -1, 2], rtol=0.0, atol=1e-7)
    assert float(found.jumps[0].abs().max()) <= 0.1 + 1e-9 and float(found[1].X[:, 0, 2].abs().max()) < 1e-7


def test_numbers_that_change_and_warm_starts() -> None:
    starts, problem = torch.zeros(1, 4, dtype=D), None
    problem = drive(starts, [1.0, 0.0])
    phases = Phases([problem, drive([1.0, 0, 0, 0], [2.0, 0.0])])
    before = solved(phases)
    starts[0, 1] = 0.2
    after = solved(phases, warm=before)
    assert float(after[0].X[0, 0, 1]) == 0.2 and float(after.cost) > float(before.cost)
    torch.testing.assert_close(after.cost, solved(phases).cost, rtol=1e-9, atol=0.0)
    again = solved(phases, warm=after)
    assert int(again.iterations) <= 2
    given = solved(phases, U0=[one.U for one in after], X0=[after[0].X, None])
    torch.testing.assert_close(given.cost, after.cost, rtol=1e-9, atol=0.0)


def test_single_precision() -> None:
    starts = torch.zeros(1, 4)
    phases = Phases([drive(starts, [1.0, 0.0]), drive(starts, [2.0, 0.0], model=HEAVY)])
    solution, double = (
        torchgco.solve(phases),
        Phases([drive(starts.double(), [1.0, 0.0]), drive(starts.double(), [2.0, 0.0], model=HEAVY)]),
    )
    assert solution[0].X.dtype == torch.float32 and bool(torchgco.judge(phases, solution).feasible.all())
    torch.testing.assert_close(solution.cost.double(), solved(double).cost, rtol=1e-5, atol=0.0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", range(2))
def test_a_loop_has_numbers_in_single_precision(seed: int) -> None:
    """The judge refused them."""
    draw = torch.Generator().manual_seed(seed)
    starts, gap = torch.zeros(2, 4), 1.0 + torch.rand(2, 1, generator=draw)
    loop = Link(lambda a, b, gap: a + gap - b, components=[0], values={"gap": gap})
    back = torch.ones(4, dtype=torch.bool)
    phases = Phases([drive(starts, [1.0, 0.0], free_start=back), drive(starts, [0.0, 1.0])], loop=loop)
    solution = torchgco.solve(phases)
    verdict = torchgco.judge(phases, solution)
    assert bool(verdict.feasible.all())
    torch.testing.assert_close(solution[1].X[:, -1, :1] - solution[0].X[:, 0, :1], gap, rtol=0, atol=1e-4)
    short = torchgco.judge(Phases(phases.problems, loop=replace(loop, values={"gap": gap + 0.01})), solution)
    assert not bool(short.feasible.any())
    torch.testing.assert_close(short.violation, torch.full((2,), 0.01, dtype=D), rtol=0, atol=1e-4)


def test_slopes_of_rows_are_those_of_autodiff() -> None:
    """`accumulate` of a phase's rows, which PyTorch's kernels call."""
    problem = drive([0.0] * 4, [1.0, 0.0], NormBounds("u", upper=2.0), N=6)
    whole = Whole(Phases([drive([0.0] * 4, [0.0, 1.0], N=3), problem]))
    row = PhaseRows(problem.constraints[1], Span(4, 6, 4, 2))
    draw = lambda *shape: torch.randn(*shape, generator=torch.Generator().manual_seed(4), dtype=D)
    X, U, g, h = draw(1, 11, 4), draw(1, 10, 2), draw(1, 6, 1), draw(1, 6, 1)
    mine, theirs = torch.zeros(1, 11, 7, 7, dtype=D), torch.zeros(1, 11, 7, 7, dtype=D)
    row.accumulate(X, U, g, h, mine)
    Constraint.accumulate(row, X, U, g, h, theirs)
    torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-12)
    assert whole.problem.N == 10 and whole.problem.m == 2


HERE = [0.0] * 4
CARTS = drive(HERE, [1.0, 0.0])
PAIR = [CARTS, CARTS]
WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: Phases(CARTS), "phases.problems: expected a list of problems"),
    (lambda: Phases([]), "phases.problems: expected at least one"),
    (lambda: Phases([CARTS, drive([HERE] * 2, [1.0, 0.0])]), r"phases.problems\[1\]: expected a batch of 1"),
    (lambda: Phases([CARTS, drive(torch.zeros(1, 4), [1.0, 0.0])]), r"phases.problems\[1\]: expected torch.float64"),
    (lambda: Phases([drive(HERE, [1.0, 0], horizon=torch.tensor([5]))]), r"problems\[0\].horizon: expected None"),
    (lambda: Phases([CARTS, drive(HERE, [1.0, 0], free_start=[True] * 4)]), r"problems\[1\].free_start: expected None"),
    (lambda: Phases(PAIR, []), "phases.jumps: expected 1, one between two of the 2 phases"),
    (lambda: Phases(PAIR, [3]), r"phases.jumps\[0\]: expected a Jump, a Link or None"),  # type: ignore[list-item]
    (lambda: Phases(PAIR, [Jump(3)]), r"jumps\[0\].function: expected a function"),  # type: ignore[arg-type]
    (lambda: Phases(PAIR, [Jump(lambda x: x[..., :2])]), r"jumps\[0\].function: expected values of shape \(1, 4\)"),
    (lambda: Phases(PAIR, [Jump(lambda x: x + torch.ones(7))]), r"jumps\[0\].function: expected .* RuntimeError"),
    (lambda: Phases(PAIR, [Jump(controls=-1)]), r"jumps\[0\].controls: expected"),
    (lambda: Phases(PAIR, [Jump(cost=lambda x, v: x[..., 0])]), r"jumps\[0\].controls: expected at least 1"),
    (lambda: Phases(PAIR, [Jump(controls=1, cost=lambda x, v: x)]), r"jumps\[0\].cost: .*of shape \(1,\)"),
    (
        lambda: Phases(PAIR, [Jump(lambda x, v: x, 1, constraints=[StateBounds(HERE, [1.0] * 4)])]),
        r"jumps\[0\].constraints\[0\]: expected rows of the controls",
    ),
    (lambda: Phases(PAIR, [Jump(lambda x, v: x, 1, constraints=[3])]), r"constraints\[0\]: expected a constraint"),  # type: ignore[list-item]
    (lambda: Phases(PAIR, [Jump(values={"a": torch.ones(1, dtype=D)})]), r"values\['a'\]: expected the name"),
    (lambda: Phases(PAIR, [Link(knots=(0, 3))]), r"jumps\[0\].knots: expected the default"),
    (
        lambda: Phases([drive([HERE] * 2, [1.0, 0.0])] * 2, [Jump(lambda x: x - x.mean(0))]),
        r"jumps\[0\].function: .*own row",
    ),
    (lambda: torchgco.solve(Phases(PAIR), U0=[None]), "U0: expected a list of 2"),
    (lambda: torchgco.solve(Phases(PAIR), X0=[torch.zeros(1, 3, 4, dtype=D), None]), r"X0\[0\]: expected shape"),
    (lambda: torchgco.solve(Phases(PAIR), U0=[torch.zeros(1, 3, 2, dtype=D), None]), r"U0\[0\]: expected a tensor"),
    (lambda: torchgco.solve(Phases(PAIR), warm=3), "warm: expected a PhasesSolution"),
    (lambda: torchgco.solve(Phases(PAIR), guesses=[]), "solve.guesses: expected None of phases"),
    (lambda: torchgco.solve(Phases(PAIR), smoothing=-0.1), "smoothing: expected"),
    (lambda: torchgco.solve(Phases([drive(HERE, [1.0, 0], time=FreeTime())]), solver="al_ilqr"), "solver: expected"),
    (lambda: torchgco.export_c(Phases(PAIR), "made"), "problem: expected a Problem"),  # type: ignore[arg-type]
    (lambda: torchgco.export_c(torchgco.compile(Phases(PAIR)), "made"), "problem: expected a Problem"),
    (lambda: torchgco.MPC(Phases(PAIR)), "problem: expected a Problem"),  # type: ignore[arg-type]
    (lambda: torchgco.judge(Phases(PAIR), 3), "solution: expected a PhasesSolution"),  # type: ignore[call-overload]
]  # fmt: skip


@pytest.mark.parametrize("i", range(len(WRONG)))
def test_wrong_use_gets_one_line(i: int) -> None:
    make, message = WRONG[i]
    with pytest.raises(InputError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_other_sizes_need_a_jump() -> None:
    line = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), n=2, m=1, dt=0.1)
    other = Problem(line, NOTHING, [], [0.0, 0.0], 5)
    with pytest.raises(InputError, match=r"jumps\[0\].function: expected a function from 4 states to 2, got None"):
        Phases([CARTS, other])
