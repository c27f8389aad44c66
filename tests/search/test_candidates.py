"""Candidates of a problem: their order, their penetration of obstacles, and those that are not live."""

from dataclasses import replace

import torch

from tests.search.cup import QUICK, controls, cup
from torchgco import Problem
from torchgco.dynamics.rollout import open_loop
from torchgco.kernels import chord_clearance
from torchgco.search.candidates import Candidates


def make_candidates(problem: Problem, U: torch.Tensor, *terms: torch.Tensor) -> Candidates:
    """Candidates with controls (1, count, N, m) and their rollouts."""
    candidates = Candidates.begin(problem, U, *terms)
    return replace(candidates, X=open_loop(problem.dynamics, problem.x0.repeat(candidates.count, 1), candidates.U))


def test_trajectories_that_are_alike_count_once() -> None:
    problem = cup(B=1)
    U, one = controls(problem).repeat(1, 3, 1, 1).view(1, 3, -1, 2), torch.ones(1, dtype=torch.float64)
    U[:, 2] = -1.0  # drives away, which costs more
    candidates = make_candidates(problem, U, one, one, torch.ones(1, 3, dtype=torch.bool))
    first = torch.ones(3, dtype=torch.bool)
    assert candidates.order(first).tolist() == [[0, 1, 2]]
    assert candidates.order(first, alike=1e-3).tolist() == [[0, 2, 1]]
    first[0] = False  # an unsound one does not represent the others
    assert candidates.order(first, alike=1e-3).tolist() == [[1, 2, 0]]


def test_obstacles_count_in_the_order(monkeypatch) -> None:
    """Of two trajectories that start inside a disc, only the penalty puts the one that leaves it first."""
    problem = cup(B=2, N=20)
    problem.x0[0, :2] = problem.constraints[0].centers[0, 2]
    U, one = controls(problem)[:, None].repeat(1, 2, 1, 1), torch.full((2,), 1e4, dtype=torch.float64)
    U[:, 1] = -0.2  # drives away, which costs more, but soon leaves the disc
    candidates = Candidates.begin(problem, U, torch.full_like(one, 0.2), one, torch.ones(2, 2, dtype=torch.bool))
    X = open_loop(problem.dynamics, problem.x0.repeat_interleave(2, dim=0), candidates.U)
    candidates, first = replace(candidates, X=X), torch.ones(4, dtype=torch.bool)
    with_penalty = candidates.order(first)
    monkeypatch.setattr("torchgco.search.candidates.CANDIDATE_PENALTY", 1e-12)
    assert with_penalty[1].tolist() == candidates.order(first)[1].tolist()
    assert with_penalty[0].tolist() != candidates.order(first)[0].tolist()


def test_candidates_that_are_not_live_are_unchanged_and_come_last() -> None:
    problem = cup(B=1, N=60)
    R, unit = torch.full((1,), 0.2, dtype=torch.float64), torch.full((1,), 1e4, dtype=torch.float64)
    U = controls(problem).repeat(1, 2, 1, 1).view(1, 2, -1, 2)
    U[:, 1] = -1.0  # drives away, which costs more
    candidates = make_candidates(problem, U, R, unit, torch.tensor([[False, True]]))
    assert candidates.order(torch.ones(2, dtype=torch.bool)).tolist() == [[1, 0]]
    relaxed, sound = replace(QUICK, relax_iterations=2).relax(candidates)
    assert 1 <= int(relaxed.iterations) <= 2
    assert torch.equal(relaxed.U[0], U[0, 0]) and not torch.equal(relaxed.U[1], U[0, 1]) and not bool(sound[0])
    assert float(candidates.penetration()[0]) == 0.0


def test_picked_candidates_stay_with_their_problem() -> None:
    problem = cup(B=2, N=10)
    U = torch.arange(6, dtype=torch.float64).view(2, 3, 1, 1).expand(2, 3, 10, 2)
    one = torch.ones(2, dtype=torch.float64)
    candidates = Candidates.begin(problem, U, one, 2.0 * one, torch.ones(2, 3, dtype=torch.bool))
    order = torch.tensor([[2, 0], [0, 1]])
    assert candidates.pick(order).U[:, 0, 0].tolist() == [2.0, 0.0, 3.0, 4.0]
    assert candidates.pick(order).count == 2 and candidates.rows(order).tolist() == [[2, 0], [3, 4]]
    assert candidates.lagrangian(torch.tensor([1, 5]), 3.0).multipliers.mu.tolist() == [6.0, 6.0]


def test_the_penetration_of_a_chord() -> None:
    """A step across a disc penetrates as deep as its deepest point; its end points do not matter."""
    problem = cup(B=1, N=2)
    X = torch.zeros(1, 3, 6, dtype=torch.float64)
    X[0, :, 0] = torch.tensor([-5.0, 5.0, 6.0])
    X[0, :, 1] = 0.1  # through the middle of the third disc
    torch.testing.assert_close(chord_clearance(problem, X, 0.0), torch.tensor([-0.2], dtype=torch.float64))
    X[0, :, 1] = 5.0
    assert float(chord_clearance(problem, X, 0.0)) > 0
