"""Several guesses per problem: what each leads to, which is kept, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionCost,
    FunctionDynamics,
    Goal,
    Guess,
    InputError,
    NormBounds,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    Status,
)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def pendulums(B: int = 3, N: int = 40) -> Problem:
    """Pendulums that swing up to either side; with B starts, of which none is like another."""
    field = lambda x, u: torch.stack((x[..., 1], 9.81 * torch.sin(x[..., 0]) + u[..., 0]), -1)
    model = FunctionDynamics(field, n=2, m=1, dt=0.05, integrator="rk4")
    stage = lambda x, u: 1.0 - torch.cos(x[..., 0]) + 0.05 * x[..., 1] ** 2 + 0.02 * u[..., 0] ** 2
    end = lambda x: 100.0 * (1.0 - torch.cos(x[..., 0])) + 10.0 * x[..., 1] ** 2
    x0 = torch.stack((math.pi + 0.3 * drawn(B), 0.3 * drawn(B, seed=1)), -1)
    return Problem(model, FunctionCost(stage, end), [ControlBounds(-5, 5)], x0, N)


def robot(heading: float = 0.0, blocked: bool = False) -> Problem:
    """A robot that can't reverse, whose goal lies behind it: held at rest it sees no way there."""
    ahead = lambda x: torch.stack((torch.cos(x[..., 2]), torch.sin(x[..., 2])), -1)
    field = lambda x, u: torch.cat((u[..., :1] * ahead(x), u[..., 1:]), -1)
    model = FunctionDynamics(field, n=3, m=2, dt=0.1, integrator="rk4", position=slice(0, 2))
    cost = QuadraticCost(Q=[0.1, 0.1, 0], R=[0.1, 0.1], Qf=[50, 50, 0], x_ref=[-3, 0, 0])
    parts: list[Any] = [ControlBounds([0, -2], [0.5, 2])]
    parts += [Spheres([[1.5, 1.0]], [0.3], vehicle_radius=0.2)] if blocked else []
    return Problem(model, cost, parts, [0, 0, heading], 80, goal=Goal([-3.0, 0.0], 0.2))


def turning() -> Tensor:
    U = torch.zeros(80, 2, dtype=torch.float64)
    U[:16, 1], U[16:, 0] = 1.96, 0.47
    return U


@pytest.mark.parametrize("solver", ["gco", "interior_point", "al_ilqr"])
def test_each_guess_leads_where_it_does_alone_and_the_best_is_kept(solver: str) -> None:
    problem = pendulums()
    U = 2.0 * drawn(4, 3, 40, 1, seed=2)
    best = torchgco.solve(problem, guesses=[{"U0": U[0]}, Guess(U0=U[1]), Guess(U[2]), Guess()], solver=solver)
    alone = [torchgco.solve(problem, U0, solver=solver) for U0 in (U[0], U[1], U[2], None)]
    assert best.guesses is not None and best.guess is not None
    for j, one in enumerate(alone):
        for name in ("cost", "violation", "status", "iterations"):
            assert torch.equal(getattr(best.guesses, name)[:, j], getattr(one, name)), (j, name)
    cost = torch.stack([one.cost for one in alone], -1)
    assert torch.equal(best.cost, cost.min(-1).values) and torch.equal(best.guess, cost.argmin(-1))
    for b, j in enumerate(best.guess.tolist()):
        for name in ("X", "U", "K", "status"):
            assert torch.equal(getattr(best, name)[b], getattr(alone[j], name)[b]), name
    assert torch.equal(best.iterations, sum(one.iterations for one in alone))
    assert float((cost.max(-1).values / cost.min(-1).values).max()) > 1.01  # guesses matter here


def test_a_problem_gets_the_same_alone_as_in_a_batch() -> None:
    problem, U = pendulums(), 2.0 * drawn(2, 3, 40, 1, seed=2)
    whole = torchgco.solve(problem, guesses=[Guess(U[0]), Guess(U[1])])
    for b in range(3):
        one = torchgco.solve(problem.take([b]), guesses=[Guess(U[0, b : b + 1]), Guess(U[1, b])], ids=torch.tensor([b]))
        assert torch.equal(one.X[0], whole.X[b]) and int(one.guess) == int(whole.guess[b])  # type: ignore[arg-type]


@pytest.mark.parametrize("blocked", [False, True])
def test_a_robot_that_sees_no_way_follows_the_guess_that_turns(blocked: bool) -> None:
    problem = robot(blocked=blocked)
    alone = torchgco.solve(problem, solver="al_ilqr")
    assert not bool(torchgco.judge(problem, alone.U).reached)
    solution = torchgco.solve(problem, guesses=[Guess(), {"U0": turning()}])
    assert bool(torchgco.judge(problem, solution.U).reached) and float(solution.cost) < 18.0
    assert solution.guess is not None and int(solution.guess) == 1


def test_feasible_counts_before_cheap_and_clear_between_knots_before_both() -> None:
    field = lambda x, u: u
    model = FunctionDynamics(field, n=2, m=2, dt=1.0, integrator="euler", position=slice(0, 2))
    cost = QuadraticCost(Q=[0, 0], R=[0.01, 0.01], Qf=[1, 1], x_ref=[3, 0])
    wall = Spheres([[1.5, 0.0]], [0.4], vehicle_radius=0.0)
    problem = Problem(model, cost, [wall, ControlBounds(-4, 4)], [0.0, 0.0], 3)
    straight = torch.tensor([[1.0, 0], [1, 0], [1, 0]]).double()  # between knots through the sphere
    around = torch.tensor([[1.5, 1.0], [1.5, -1], [0, 0]]).double()
    into = torch.tensor([[1.5, 0.0], [1.5, 0], [0, 0]]).double()  # a knot inside
    solution = torchgco.solve(problem, guesses=[Guess(straight), Guess(into), Guess(around)], solver="hold")
    assert solution.guesses is not None and solution.guess is not None
    costs = solution.guesses.cost[0]
    assert int(solution.guess) == 2 and float(costs[2]) > float(costs[0])
    two = torchgco.solve(problem, guesses=[Guess(into), Guess(around)], solver="hold")
    assert int(two.guess) == 1  # type: ignore[arg-type]


def thrust(angle: bool, N: int = 30) -> Problem:
    """Least time from rest to rest beside, by a thrust whose direction is an angle or two numbers."""
    push = (lambda u: torch.stack((torch.cos(u[..., 0]), torch.sin(u[..., 0])), -1)) if angle else (lambda u: u)
    field = lambda x, u: torch.cat((x[..., 2:], push(u)), -1)
    model = FunctionDynamics(field, n=4, m=1 if angle else 2, dt=0.1, integrator="rk4")
    part: Any = ControlBounds(-7.0, 7.0) if angle else NormBounds("u", upper=1.0)
    goal = Goal(state=[2.0, 1.0, 0, 0], required=True)
    none = FunctionCost(lambda x, u: 0.0 * u[..., 0])
    return Problem(model, none, [part], [0, 0, 0.5, 0], N, goal=goal, time=FreeTime(0.2, 5.0, weight=1.0))


@pytest.mark.slow
def test_states_and_times_of_earlier_solutions_are_guesses_in_free_time() -> None:
    vector = torchgco.solve(thrust(False))
    U = torch.atan2(vector.U[..., 1], vector.U[..., 0]).unsqueeze(-1)
    problem = thrust(True)
    told = Guess(U0=U, X0=vector.X, times=vector.t)
    still = problem.x0.unsqueeze(1).expand_as(vector.X)
    other = Guess(U0=torch.full_like(U, 2.0), X0=still, times=4.0 * vector.t / vector.duration)
    solution = torchgco.solve(problem, guesses=[other, told], solver="interior_point")
    assert solution.guess is not None and solution.guesses is not None
    costs = solution.guesses.cost[0]
    assert torch.equal(solution.cost[0], costs.min()) and int(solution.guess) == int(costs.argmin())
    assert float(solution.duration) <= float(vector.duration) * 1.001
    for j, (guess, duration) in enumerate(((other, 4.0), (told, float(vector.duration)))):
        timed = replace(problem, time=FreeTime(0.2, 5.0, weight=1.0, guess=duration / 3.0))
        alone = torchgco.solve(timed, guess.U0, X0=guess.X0, solver="interior_point")
        assert float(costs[j]) == pytest.approx(float(alone.cost), rel=1e-9)
    again = torchgco.solve(problem, guesses=[solution, other])  # gco, from solutions
    assert float(again.duration) <= float(solution.duration) * (1 + 1e-4)


def test_columns_files_and_parts_know_the_guess(tmp_path: Path) -> None:
    problem, U = pendulums(), 2.0 * drawn(2, 3, 40, 1, seed=2)
    solution = torchgco.solve(problem, guesses=[Guess(U[0]), Guess(U[1])], solver="al_ilqr")
    assert solution.guess is not None and solution.guesses is not None
    assert solution.to_frame()["guess"].tolist() == solution.guess.tolist()
    table = solution.guesses.to_frame()
    assert table.index.names == ["element", "guess"] and len(table) == 6
    kept = [table.loc[(b, j), "cost"] for b, j in enumerate(solution.guess.tolist())]
    assert kept == solution.cost.tolist()
    solution.save(tmp_path / "solution.npz")
    assert torch.equal(Solution.load(tmp_path / "solution.npz").guess, solution.guess)  # type: ignore[arg-type]
    last = solution.take([2])
    assert torch.equal(last.guesses.cost, solution.guesses.cost[2:])  # type: ignore[union-attr]
    assert solution.shifted().guess is None and "guess" not in torchgco.solve(problem).to_frame()
    assert solution.account is not None and solution.account.problem is problem


@pytest.mark.parametrize("pace", [-1.0, 0.0])
def test_times_that_do_not_rise_are_refused(pace: float) -> None:
    """They were moved into the bounds of the time without a word."""
    problem = pendulums()
    free = replace(problem, time=FreeTime(0.5, 2.0, weight=1.0))
    with pytest.raises(InputError, match=r"guesses\[0\]\.times: expected times that rise"):
        torchgco.solve(free, guesses=[Guess(times=pace * torch.linspace(0.0, 2.0, problem.N + 1).double())])


@pytest.mark.parametrize(
    "guesses, others, field",
    [
        ([], {}, "guesses"),
        (torch.zeros(3, 40, 1), {}, "guesses"),
        ([None], {}, "guesses[0]"),
        ([{"V0": 1}], {}, "guesses[0]"),
        ([{"U0": torch.zeros(39, 1).double()}], {}, "guesses[0].U0"),
        ([Guess(), Guess(X0=torch.zeros(3, 40, 2).double())], {}, "guesses[1].X0"),
        ([Guess(), Guess(times=torch.zeros(41).double())], {}, "guesses[1].times"),
        ([Guess(), Guess(X0=torch.zeros(41, 2).double())], {}, "guesses[0].X0"),
        ([Guess(), Guess()], {}, "guesses[1]"),
        ([Guess()], {"U0": torch.zeros(3, 40, 1).double()}, "solve.U0"),
        ([Guess()], {"record": True}, "solve.record"),
    ],
)
def test_wrong_guesses_are_refused_in_a_line(guesses: Any, others: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as error:
        torchgco.solve(pendulums(), guesses=guesses, **others)
    assert str(error.value).startswith(f"{field}:") and "\n" not in str(error.value)


def movers(is_free: bool) -> Problem:
    """Two problems of a mass on a line, in a given time or a free one."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), 2, 1, 0.1, "rk4", position=slice(0, 1))
    cost = FunctionCost(lambda x, u: 0.01 * u.square().sum(-1), lambda x: 9.0 * (x[..., 0] - 2.0).square())
    goal, time = (Goal([2.0], 0.1, required=True), FreeTime(1.0, 6.0)) if is_free else (None, None)
    return Problem(model, cost, [ControlBounds(-2, 2)], [[0.0, 0.0], [0.5, 0.0]], 20, goal, time=time)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("solver", ["gco", "interior_point", "al_ilqr", "ipopt"])
@pytest.mark.parametrize("is_free", [False, True])
@pytest.mark.filterwarnings("ignore")
def test_a_guess_that_is_not_finite_loses_its_problem_alone(is_free: bool, solver: str, value: float) -> None:
    """In free time, and of states anywhere, it was replaced without a word, and of controls by some solvers."""
    if is_free and solver == "al_ilqr":
        pytest.skip("it can't choose a time")
    problem, rest = movers(is_free), torch.zeros(2, 20, 1, dtype=torch.float64)
    states, U, X = problem.x0.unsqueeze(1).repeat(1, 21, 1), rest.clone(), problem.x0.unsqueeze(1).repeat(1, 21, 1)
    U[1, 3], X[1, 4, 0] = value, value
    cases: list[tuple[dict[str, Any], dict[str, Any]]] = [({"U0": U}, {"U0": rest})]
    if solver != "al_ilqr":
        cases.append(({"U0": rest, "X0": X}, {"U0": rest, "X0": states}))
    for given, finite in cases:
        found, due = (torchgco.solve(problem, solver=solver, verbose=False, **guess) for guess in (given, finite))
        assert found.statuses == [due.statuses[0], Status.NON_FINITE] and Status.CONVERGED in due.statuses
        assert torch.equal(found.U[0], due.U[0]) and not bool(torch.isfinite(found.X[1]).all())
        both = torchgco.solve(problem, solver=solver, verbose=False, guesses=[given, finite])
        assert Status.NON_FINITE not in both.statuses and int(both.guess[1]) == 1  # type: ignore[index]
        alone = torchgco.solve(problem, solver=solver, verbose=False, guesses=[given])
        assert alone.statuses[1] is Status.NON_FINITE
