"""`Solution.explain` says what the record, the judge and slow obvious maths say."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchgco
from tests.problems import planar_batch, quick_gco
from tests.search.gates import CLOSED, FREE, PASSES, SHORT, gates
from torchgco import (
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Problem,
    QuadraticCost,
    Solution,
    StateBounds,
    Status,
)
from torchgco.explaining.advice import BY_STATUS, Facts, advice
from torchgco.explaining.places import knots_told, lost_told
from torchgco.solution import Fate


@pytest.fixture(scope="module")
def recorded() -> Solution:
    problem, U0 = gates()
    return torchgco.solve(problem, U0, solver=quick_gco(problem), seed=3, record=True)


def block(text: str, title: str) -> list[str]:
    """The lines of a part of an explanation, wrapped ones joined."""
    _, _, rest = f"\n{text}".partition(f"\n{title}:\n")
    lines = list[str]()
    for line in rest.split("\n"):
        if not line.startswith("  "):
            break
        if line.startswith("    "):
            lines[-1] += f" {line.strip()}"
        else:
            lines.append(line.strip())
    return lines


@pytest.mark.slow
def test_it_tells_each_pass_that_worked_and_what_it_gave(recorded: Solution) -> None:
    search = recorded.search
    assert search is not None
    for b in (FREE, PASSES, SHORT, CLOSED):
        lines = block(recorded.explain(b), "Passes")
        worked = [number for number, _, rows in search.passes if b in rows]
        told = [int(line.split()[0]) for line in lines if line[0].isdigit()]
        assert told == worked
        idle = next(line for line in lines if line.startswith("nothing to do"))
        assert sorted([*told, *map(int, re.findall(r"\d+", idle))]) == list(range(1, len(search.passes) + 1))
        kept = int(re.findall(r"returned is the trajectory of pass (\d+)", "\n".join(lines))[0])
        after = [None if one is None else float(one.cost[one.rows.tolist().index(b)]) for one in search.standings]
        changes = [i + 1 for i in range(len(after)) if i == 0 or after[i] != after[i - 1]]
        assert kept == changes[-1]


def test_costs_in_the_record_are_the_users(recorded: Solution) -> None:
    search = recorded.search
    assert search is not None and search.standings[-1] is not None
    last = search.standings[-1]
    torch.testing.assert_close(last.cost, recorded.cost, rtol=1e-9, atol=0.0)
    torch.testing.assert_close(last.violation, recorded.violation, rtol=0.0, atol=1e-9)
    names = [name for _, name, _ in search.passes]
    after = search.standings[names.index("paths")]
    assert after is not None
    for one in search.comparisons:
        chosen = (one.fate == Fate.PROPOSED) & torch.isfinite(one.cost)
        for i, c in chosen.nonzero().tolist():
            if one.rows[i] == PASSES:
                assert float(one.cost[i, c]) == pytest.approx(float(after.cost[PASSES]), rel=0.02)


def test_it_counts_the_fates_of_the_candidates(recorded: Solution) -> None:
    assert recorded.search is not None
    one = recorded.search.comparisons[0]
    i = one.rows.tolist().index(PASSES)
    line = next(line for line in block(recorded.explain(PASSES), "Passes") if line.startswith(f"{one.number} "))
    candidates = int((one.fate[i] != Fate.ABSENT).sum())
    assert f"{one.paths.shape[1]} paths" in line and f"{candidates} candidates" in line
    counted = [int(n) for n in re.findall(r"(\d+) (?:proposed|refined|dropped|relaxed)", line.split(". Then")[0])]
    assert sum(counted) == candidates and "1 proposed" in line
    closed = block(recorded.explain(CLOSED), "Passes")
    assert any("found no path to the goal" in line for line in closed)
    assert "no path to the goal was found" in block(recorded.explain(CLOSED), "What to try")[0]
    assert not any("no path" in line for line in block(recorded.explain(SHORT), "What to try"))


def test_it_names_the_knots_and_obstacles_of_the_caught_trajectory(recorded: Solution) -> None:
    problem, _ = gates()
    assert recorded.search is not None and recorded.search.caught is not None
    rows, X = recorded.search.caught
    spheres = problem.constraints[0]
    centers, radii = spheres.centers[PASSES].numpy(), spheres.inflated_radii[PASSES].numpy()  # type: ignore[attr-defined]
    p = X[rows.tolist().index(PASSES), :, :2].numpy()
    inside = np.linalg.norm(p[:, None] - centers[:2], axis=-1) < radii[:2]
    inside[[0, -1]] = False
    knots = np.flatnonzero(inside.sum(1) >= 2)
    assert len(knots) > 0
    (line,) = block(recorded.explain(PASSES), "Caught")
    assert knots_told(knots.tolist(), recorded.t) in line
    assert "two obstacles or more" in line and "number 0, 1 of constraints[0] (Spheres)" in line
    assert "wasn't stopped" in block(recorded.explain(FREE), "Caught")[0]


def test_the_worst_row_the_goal_and_the_status_are_told(recorded: Solution) -> None:
    problem, _ = gates()
    for b in (PASSES, CLOSED):
        text = recorded.explain(b)
        status = recorded.statuses[b]
        assert text.startswith(f"Problem {b} of 4, solved by Restarts: {status.name}.")
        assert block(text, "Why it ended") == [status.sentence]
        judged = torchgco.judge(problem, recorded.U)
        away = f"the last knot is {float(judged.goal_distance[b]):.4g} m from it"
        (goal,) = (line for line in block(text, "Result") if line.startswith("goal"))
        assert away in goal and ("not reached" in goal) == (not bool(judged.reached[b]))
    held = torchgco.solve(problem, solver="hold")
    pushed = replace(held, X=held.X + torch.tensor([5.0, 0.35, 0, 0]).double(), account=held.account)
    worst = pushed.worst_rows(problem).loc[PASSES]
    (line,) = (line for line in block(pushed.explain(PASSES), "Result") if line.startswith("violated most"))
    told = f"constraints[0] (Spheres), obstacle {worst.row}, knot {worst.knot} (t = {0.1 * worst.knot:.3g} s)"
    assert told in line and f"by {worst.violation:.4g} m" in line


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", ["gco_fast", "gco_paper", "al_ilqr", "ilqr", "mppi", "interior_point", "hold"])
def test_every_solver_is_explained_with_and_without_a_record(name: str) -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=3)
    for record in (False, True):
        solution = torchgco.solve(problem, U0, solver=name, max_seconds=20, record=record)
        for b in range(2):
            text = solution.explain(b)
            assert text.startswith(f"Problem {b} of 2, solved by {name}: {solution.statuses[b].name}.")
            assert repr(text) == text and max(map(len, text.splitlines())) <= 120
        assert bool(block(solution.explain(0), "Passes")) == (record and name == "gco_fast")
        assert bool(block(solution.explain(0), "Iterations")) == (record and name in ("gco_paper", "al_ilqr"))
        advised = "record=True" in solution.explain(0)
        assert not (advised and (record or name in ("hold", "mppi", "ilqr", "interior_point")))


def test_outer_iterations_are_those_of_the_trace() -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=3)
    solution = torchgco.solve(problem, U0, solver="al_ilqr", record=True)
    assert solution.trace is not None
    rows = solution.trace[solution.trace.element == 1]
    lines = block(solution.explain(1), "Iterations")
    counts = [int(n) for line in lines for n in re.findall(r": (\d+) iteration", line)]
    assert counts == rows.groupby("outer").size().tolist()[-len(counts) :]
    assert f"cost {rows.cost.iloc[-1]:.4g}" in lines[-1]


def test_lost_states_are_located() -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=2)
    solution = torchgco.solve(problem, U0, solver="hold")
    X = solution.X.clone()
    X[1, 7:] = torch.nan
    lost = replace(solution, X=X, status=torch.tensor([int(Status.FEASIBLE), int(Status.NON_FINITE)]))
    assert any("knot 7 isn't finite" in line for line in block(lost.explain(1), "Result"))
    assert BY_STATUS[Status.NON_FINITE] in block(lost.explain(1), "What to try")


model = FunctionDynamics(lambda x, u: x + 0.1 * u, n=1, m=1, dt=0.1)
square = lambda x, u: (x.square() + u.square()).sum(-1)
last = lambda x: x.square().sum(-1)
rows = lambda k: FunctionConstraint(lambda x: torch.where(x > -9.0, torch.nan, x), knots=[k], name="own")
LOST = {
    "cost.stage is NaN at knot 0 (t = 0 s)": (FunctionCost(lambda x, u: torch.nan * square(x, u), last), []),
    "cost.stage is NaN at knot 3 (t = 0.3 s)": (
        FunctionCost(lambda x, u, k: square(x, u) + (2.5 - k + 0.0 * x[..., 0]).sqrt(), last), [],
    ),
    "cost.terminal is NaN at knot 5 (t = 0.5 s)": (FunctionCost(square, lambda x: (last(x) - 9.0).sqrt()), []),
    "constraints[1] (own) is NaN at knot 4 (t = 0.4 s)": (
        FunctionCost(square, last), [ControlBounds(-torch.inf, 1.0), rows(4)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("told", LOST)
def test_the_part_and_the_knot_that_are_lost_are_named(told: str) -> None:
    cost, parts = LOST[told]
    problem = Problem(model, cost, parts, torch.zeros(2, 1, dtype=torch.float64), N=5)
    solution = torchgco.solve(problem, solver="al_ilqr")
    assert solution.statuses[1] is Status.NON_FINITE
    assert f"{told}." in block(solution.explain(1), "Why it ended")
    assert block(solution.explain(1), "What to try")[0].startswith("Numbers and code of that part that are finite")


def test_a_derivative_that_is_lost_is_named() -> None:
    cost = FunctionCost(square, lambda x: x.square().sum(-1).sqrt())
    limit = FunctionConstraint(lambda x: x.square().sum(-1, keepdim=True).sqrt() - 1.0, knots=[2, 3], name="own")
    zero, stay = torch.zeros(1, 1, dtype=torch.float64), torch.zeros(1, 5, 1, dtype=torch.float64)
    at_rest = torch.zeros(1, 6, 1, dtype=torch.float64)
    told = lambda cost, parts: lost_told(Problem(model, cost, parts, zero, N=5), at_rest, stay, None)
    assert told(cost, []) == "the derivative of the cost is NaN at knot 5"
    assert told(FunctionCost(square, last), [limit]) == "the derivative of constraints[0] (own) is NaN at knot 2"
    assert told(FunctionCost(square, last), []) is None


def test_a_loaded_solution_says_what_is_known_and_takes_the_problem(tmp_path) -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=3)
    solution = torchgco.solve(problem, U0, solver="al_ilqr")
    solution.save(tmp_path / "s.npz")
    loaded = Solution.load(tmp_path / "s.npz")
    assert torch.equal(loaded.t, solution.t)
    assert "violated most" not in loaded.explain(0)
    assert block(loaded.explain(0), "Why it ended") == [loaded.statuses[0].sentence]
    assert block(loaded.explain(1, problem), "Result") == block(solution.explain(1), "Result")
    sent = pickle.loads(pickle.dumps(solution))  # with functions in a problem this would fail otherwise
    assert sent.explain(0).startswith("Problem 0 of 2, solved by al_ilqr") and torch.equal(sent.t, solution.t)
    part = solution.take(torch.tensor([1]))
    assert block(part.explain(0), "Result") == block(solution.explain(1), "Result")


def test_wrong_places_and_problems_are_refused() -> None:
    problem, U0 = planar_batch(B=2, N=10, obstacles=2)
    solution = torchgco.solve(problem, U0, solver="hold")
    for b in (2, -1, 0.0, True):
        with pytest.raises(InputError, match="b: expected the place of a problem, 0 to 1"):
            solution.explain(b)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"problem: solution\.X"):
        solution.explain(0, planar_batch(B=2, N=11)[0])
    with pytest.raises(InputError, match="record"):
        torchgco.solve(problem, U0, solver="hold", record=1)  # type: ignore[arg-type]


def test_a_problem_without_position_or_time_step_is_explained() -> None:
    class Counter(torchgco.Dynamics):
        n, m = 1, 1

        def step(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return x + u

    cost = FunctionCost(lambda x, u: u.square().sum(-1), lambda x: (x[..., 0] - 1.0).square())
    cap = FunctionConstraint(lambda u: u - 0.01, of="u", name="cap")
    problem = Problem(Counter(), cost, [cap], torch.zeros(1, 1).double(), 5)
    solution = torchgco.solve(problem, 0.5 * torch.ones(1, 5, 1).double(), solver="hold")
    with pytest.raises(InputError, match=r"dynamics\.dt"):
        _ = solution.t
    assert "constraints[0] (cap), row 0, knot 0, by 0.49" in solution.explain()


def test_advice_names_the_limits_of_the_solver_and_ends_where_nothing_is_amiss() -> None:
    solver = AugmentedLagrangian(max_outer_iterations=7)
    (line,) = advice(Facts(Status.MAX_ITERATIONS, solver, seeks_paths=False))
    assert "max_outer_iterations=7, inner.max_iterations=50" in line
    assert advice(Facts(Status.CONVERGED, solver, seeks_paths=True, among_obstacles=True, reached=True)) == []
    first, *_ = advice(Facts(Status.FEASIBLE, solver, seeks_paths=False, among_obstacles=True, reached=False))
    assert 'solver="gco"' in first
    touching = Facts(Status.INFEASIBLE, solver, True, True, reached=False, clearance=-0.1)
    assert any("smaller dt" in line for line in advice(touching))


def test_knots_are_told_in_runs() -> None:
    t = 0.1 * torch.arange(10)
    assert knots_told([3], t) == "knot 3 (t = 0.3 s)"
    assert knots_told([1, 2, 3, 7], None) == "knots 1 to 3, 7"
    assert knots_told([0, 2, 4, 6, 8], None).endswith("0, 2, 4, 6 and 1 more")


@pytest.mark.slow
def test_a_row_that_the_start_breaks_is_named_as_the_starts() -> None:
    """And only such a row: one that the controls could have kept isn't."""
    cart = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), dim=-1), 2, 1, 0.1)
    cost = QuadraticCost([1.0, 0.0], [0.1], [10.0, 1.0], [1.0, 0.0])
    slow = StateBounds([-torch.inf, 0.0], [torch.inf, 0.02], knots=slice(0, 21))
    wall = FunctionConstraint(lambda x: 5.0 - x[..., :1], knots=[20])
    start = Problem(cart, cost, [ControlBounds(-1, 1), slow], [[0.0, -0.05]], 20)
    told = " ".join(str(torchgco.solve(start).explain(0)).split())
    assert "lower bound of state 1, knot 0" in told and "No control moves" in told and "knots=slice(1" in told
    told = str(torchgco.solve(Problem(cart, cost, [ControlBounds(-1, 1), wall], [[0.0, 0.0]], 20)).explain(0))
    assert "No control moves" not in told and "Another guess" in told


@pytest.mark.slow
def test_a_row_without_a_slope_ends_infeasible_and_is_named() -> None:
    """It isn't a number that isn't finite; and a row that only may be flat elsewhere isn't named so."""
    cart = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), dim=-1), 2, 1, 0.1, "rk4")
    cost = QuadraticCost([1.0, 0.0], [0.2], [0.0, 0.0], [1.0, 0.0])
    jump = FunctionConstraint(lambda x: (x[..., :1] > 0).to(x.dtype) - 0.5, knots=[-1])
    steep = FunctionConstraint(lambda x: 50.0 - x[..., :1].relu(), knots=[-1])
    for row, is_flat in ((jump, True), (steep, False)):
        found = torchgco.solve(Problem(cart, cost, [ControlBounds(-3, 3), row], [[0.5, 0.3], [0.8, 0.2]], 20))
        assert all(status is Status.INFEASIBLE for status in found.statuses)
        told = str(found.explain(1))
        assert ("have no slope" in told and "change smoothly" in told) == is_flat
