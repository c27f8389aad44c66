"""Learning through solves: weights that demonstrations determine, and trainings that take the steps asked for."""

from __future__ import annotations

import pytest
import torch

from benchmarks.families import learning, learning_nets, learning_weights
from benchmarks.families.learning_nets import Residual, Zigzag
from benchmarks.families.learning_weights import Recovered


def test_a_row_counts_the_errors_of_identifiable_weights() -> None:
    start, found = torch.tensor([3.0, 0.5, 1.0]), torch.tensor([1.02, 0.99, 4.0])
    one = Recovered(start, found, torch.tensor([True, True, False]), 7, 2.0, 1e-9)
    assert one.largest == pytest.approx(0.02) and one.of_all == pytest.approx(3.0)
    assert learning.cells(one)[:2] == ["2 of 3", "2.0"]
    row = learning.summary([one, one])
    assert row[0].startswith("2 of 2 [") and row[4] == "4 of 6"


def test_a_distance_has_its_quantile() -> None:
    assert learning.distance(torch.tensor([0.12345])) == "0.1235 m"
    assert learning.distance(torch.arange(11) / 10) == "0.500 m (0.900)"


def test_the_zigzag_returns_the_way_it_came() -> None:
    task = Zigzag(1000)
    assert task.cycle.shape == (40, 3) and torch.equal(task.target(torch.tensor(43)), task.cycle[3])
    corners = task.cycle[::4]
    assert corners[3].tolist() == pytest.approx([-0.1, 0.15, 0.15])
    assert torch.equal(corners[1:4], corners[[9, 8, 7]]) and torch.equal(corners[4], corners[6])
    with torch.no_grad():
        assert bool((task.net(torch.randn(3, 6, dtype=torch.float64)) == 0.0).all()), "it begins with the usual weights"


def test_true_water_agrees_with_the_model_that_has_learned_it() -> None:
    task = Residual(1000)
    x0, U = task.starts[0], torch.ones(8, task.N, 2, dtype=torch.float64)
    flown = task.fly(x0, U)
    assert flown.shape == (8, task.N + 1, 4) and torch.equal(flown[:, 0], x0)
    still = task.model.step(x0, U[:, 0])  # of a net that begins at 0: no current, no drag
    assert not torch.allclose(still, flown[:, 1]) and torch.allclose(still, flown[:, 1], atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(learning_nets.TASKS))
def test_a_training_step_changes_the_net(kind: str) -> None:
    task = learning_nets.TASKS[kind](1000)  # type: ignore[call-arg]
    if isinstance(task, Zigzag):
        with torch.no_grad():  # as TurboMPC's record of its training, outputs/pointmass_apg_500.csv, begins
            assert float(task.missed()) == pytest.approx(1.202163e-01, abs=5e-8)
    before = [part.detach().clone() for part in task.net.parameters()]
    generator, adam = torch.Generator().manual_seed(1000), torch.optim.Adam(task.net.parameters(), task.rate)
    means = learning_nets.stepped(task, generator, adam), learning_nets.stepped(task, generator, adam)
    assert all(share == 1.0 for share in means)
    assert any(not torch.equal(old, new) for old, new in zip(before, task.net.parameters(), strict=True))


@pytest.mark.slow
def test_weights_are_found() -> None:
    found = learning_weights.recovered(1000, 2)
    assert bool(found.identifiable.any()) and found.largest < 1e-4 < float((found.start - 1).abs().max())
