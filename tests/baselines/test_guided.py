"""FATROP from a path proposal: around the trap, the same in any batch, and plain FATROP without a path."""

from dataclasses import replace

import pytest
import torch

from tests.problems import planar_batch
from tests.search.rows import rounds, varied
from torchgco import ControlBounds, InputError, Problem, Status, judge
from torchgco.baselines import CasADiSolver, GuidedCasADi
from torchgco.experiments.config.build import compose
from torchgco.roadmap import Roadmap
from torchgco.search import Follow, PathProposals

GUIDED = GuidedCasADi(
    passes=rounds(
        PathProposals(
            roadmaps=(Roadmap(num_halton=16),),
            num_paths=2,
            follow=(Follow(iterations=10),),
            relax_iterations=0,
            max_penetration=1.0,
        )
    )
)


@pytest.mark.slow
def test_the_trap_is_left_along_the_path() -> None:
    """From rest both problems end in the trap; with a path both reach the goal."""
    setups = [
        compose(["scenario=planar_trap", "model=planar", "seed=1000", f"solver={name}"])
        for name in ("fatrop", "fatrop_guided")
    ]
    task = setups[0].task(setups[0].layouts(2))
    reached = []
    for setup in setups:
        solution = setup.solver.solve(task.problem, task.U0)
        reached.append(judge(task.problem, solution.U, task.goal, task.goal_radius).reached.tolist())
    assert reached == [[False, False], [True, True]]
    guess = setup.solver.guess(task.problem, task.U0)
    alone = setups[0].solver.solve(task.problem, guess.U)
    assert torch.equal(solution.U, alone.U) and bool((guess.iterations > 0).all())
    assert torch.equal(solution.iterations, guess.iterations + alone.iterations)
    assert solution.guided.tolist() == [1, 1] and float(solution.violation.max()) < 1e-3


def test_the_rest_of_the_batch_changes_nothing() -> None:
    problem, U0 = planar_batch(B=3, N=30, obstacles=3, seed=2)
    whole = GUIDED.solve(problem, U0)
    for rows in ([1], [2, 0]):
        index = torch.tensor(rows)
        alone = GUIDED.solve(problem.take(index), U0[index])
        assert torch.equal(alone.U, whole.U[index]) and torch.equal(alone.status, whole.status[index])


def test_without_a_path_it_is_fatrop() -> None:
    """Without obstacles the given guess is used, to the bit."""
    plain, U0 = planar_batch(B=2, N=20)
    problem = Problem(plain.dynamics, plain.cost, [ControlBounds([-9.0] * 2, [9.0] * 2)], plain.x0, 20)
    guided, alone = GUIDED.solve(problem, U0), CasADiSolver("fatrop").solve(problem, U0)
    assert torch.equal(guided.U, alone.U) and guided.guided.tolist() == [0, 0]


def test_a_bad_start_affects_its_own_problem_alone() -> None:
    problem, U0 = planar_batch(B=4, N=12, obstacles=2, seed=1)
    x0 = problem.x0.clone()
    x0[1, 0] = torch.nan
    x0[2, :2] = problem.constraints[0].centers[2, 0]
    bad = Problem(problem.dynamics, problem.cost, problem.constraints, x0, problem.N)
    reports = []
    solution = GUIDED.solve(bad, U0, callback=reports.append)
    assert solution.statuses == [Status.CONVERGED, Status.NON_FINITE, Status.INVALID_START, Status.CONVERGED]
    good = GUIDED.solve(problem, U0)
    assert torch.equal(solution.U[[0, 3]], good.U[[0, 3]]) and solution.guided.tolist() == [1, 0, 0, 1]
    assert [p.finished for p in reports] == [1, 2, 3, 4]


@pytest.mark.parametrize(
    "change",
    [
        dict(solver=CasADiSolver("ipopt")),
        dict(passes=tuple(varied(row, arrive=0.5, iterations=1) for row in GUIDED.passes)),
    ],
)
def test_every_option_is_read(change: dict) -> None:
    problem, U0 = planar_batch(B=1, N=15, obstacles=3, seed=1)
    one, other = (solver.solve(problem, U0) for solver in (GUIDED, replace(GUIDED, **change)))
    assert not torch.equal(one.U, other.U)


@pytest.mark.parametrize("model", ["scenario=planar_trap model=planar", "scenario=forest model=quadrotor"])
def test_the_configuration_serves_every_model(model: str) -> None:
    """FATROP has the settings of `fatrop`, and the paths those of `gco`, but for the fields below."""
    solvers = [compose([*model.split(), f"solver={name}"]).solver for name in ("fatrop_guided", "fatrop", "gco")]
    guided, fatrop, gco = solvers
    first = gco.passes.paths.proposals
    plane = model.endswith("planar")  # each path once, so later and in two solves
    own = dict(
        num_paths=4, initial_offsets=(), arrive=0.8 if plane else 0.9, stiffness=(20.0, 200.0) if plane else (200.0,),
        relax_iterations=guided.passes[0].relax_iterations, relax_top=None, top=1, max_penetration=1.0, pace=None,
    )  # fmt: skip
    assert guided.solver == fatrop and guided.passes == rounds(varied(first, **own))


def test_bad_calls_are_named() -> None:
    problem, U0 = planar_batch(B=2, N=5)
    with pytest.raises(InputError, match="U0"):
        GUIDED.solve(problem, U0[:, :3])
    with pytest.raises(InputError, match="initial_offsets"):
        replace(GUIDED, passes=(varied(GUIDED.passes[0], initial_offsets=((1.0, 0.0, 0.0),)),)).prepare(problem)
