"""The record of a search: what it says is what the solver did."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.problems import quick_gco
from tests.search.gates import CLOSED, FREE, PASSES, SHORT, gates
from torchgco import Restarts, Solution
from torchgco.solution import Fate


@pytest.fixture(scope="module")
def solver() -> Restarts:
    solver = quick_gco(gates()[0])
    return replace(solver, local=replace(solver.local, record=True))


@pytest.fixture(scope="module")
def recorded(solver: Restarts) -> Solution:
    return solver.solve(*gates(), seed=3)


@pytest.mark.slow
def test_recording_changes_no_result(solver: Restarts, recorded: Solution) -> None:
    plain = replace(solver, local=replace(solver.local, record=False)).solve(*gates(), seed=3)
    assert plain.search is None and torch.equal(plain.U, recorded.U)
    assert torch.equal(plain.iterations, recorded.iterations)


def test_every_row_of_the_table_is_named_with_the_problems_it_worked_on(solver: Restarts, recorded: Solution) -> None:
    search = recorded.search
    assert search is not None and search.caught is not None
    names = [name for _, name, _ in search.passes]
    assert names == list(solver.passes.names)
    assert [number for number, _, _ in search.passes] == list(range(1, len(names) + 1))
    worked = {number: rows for number, _, rows in search.passes}
    by_name = dict(zip(names, worked.values(), strict=True))
    assert by_name["guess"] == [FREE, PASSES, SHORT, CLOSED] and by_name["maps"] == []
    assert search.caught[0].tolist() == [PASSES, SHORT, CLOSED]
    assert set(by_name["paths"]) <= {PASSES, SHORT, CLOSED} and by_name["paths"]
    assert FREE in by_name["tighten"] and not any(FREE in by_name[name] for name in names[1:-1])


def test_each_candidate_has_one_fate_and_the_states_of_the_steps_that_it_reached(recorded: Solution) -> None:
    assert recorded.search is not None
    for one in recorded.search.comparisons:
        assert one.fate.shape == one.path.shape == one.cost.shape
        fate, finite = one.fate, torch.isfinite
        assert torch.equal(finite(one.relaxed).flatten(2).all(-1), fate > Fate.TRACKED)
        refined = (fate == Fate.REFINED) | (fate == Fate.PROPOSED)
        assert torch.equal(finite(one.cost), refined & finite(one.refined).flatten(2).all(-1))
        assert bool((one.cost[fate == Fate.FAILED] == torch.inf).all())
        assert bool(((fate == Fate.PROPOSED).sum(-1) <= 1).all())
        proposed = (fate == Fate.PROPOSED).any(-1)
        cheapest = torch.where(finite(one.cost), one.cost, torch.inf).amin(-1, keepdim=True)
        chosen = one.cost[proposed].gather(1, (fate[proposed] == Fate.PROPOSED).int().argmax(-1, keepdim=True))
        assert torch.equal(chosen, cheapest[proposed])


def test_only_the_first_path_of_each_class_is_followed(recorded: Solution) -> None:
    assert recorded.search is not None
    one = recorded.search.comparisons[0]
    first = one.classes == torch.arange(one.classes.shape[1])
    followed = one.fate != Fate.ABSENT
    assert bool(first[0].sum() >= 2)  # a gate has a left and a right
    for b in range(len(one.rows)):
        assert {int(k) for k in one.path[b, followed[b]]} <= set(first[b].nonzero().flatten().tolist())
    assert bool((one.classes <= torch.arange(one.classes.shape[1])).all())


def test_the_problems_of_a_batch_have_the_record_of_each_alone(solver: Restarts, recorded: Solution) -> None:
    problem, U0 = gates()
    index = torch.tensor([SHORT])
    alone = solver.solve(problem.take(index), U0[index], seed=3, ids=index).search
    assert alone is not None and recorded.search is not None
    here = [one for one in recorded.search.comparisons if SHORT in one.rows.tolist()]
    assert len(here) == len(alone.comparisons) > 0
    for one, other in zip(here, alone.comparisons, strict=True):
        place = one.rows.tolist().index(SHORT)
        assert one.number == other.number and torch.equal(one.fate[place], other.fate[0])
        assert torch.equal(one.tracked[place].nan_to_num(0), other.tracked[0].nan_to_num(0))


def test_rows_leave_the_record_behind(recorded: Solution) -> None:
    assert recorded.take(torch.tensor([0])).search is None
