"""What a vehicle saw is found again from the states of its flight, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.exploration.test_exploration import GOALS, mission, walled
from torchgco import InputError
from torchgco.exploration.mission import replayed
from torchgco.exploration.safety import safe_periods
from torchgco.missions import Disturbance

NOISY = Disturbance(position_noise=0.01, attitude_noise=0.005)


def test_the_map_and_the_safe_periods_are_found_again_from_the_states() -> None:
    problem, flight = walled(), mission(duration=1.5, disturbance=NOISY)
    ids = torch.tensor([3, 8])
    log = flight.fly(problem, seed=5, ids=ids)
    for b, number in enumerate(ids.tolist()):
        K = int(log.steps()[b])
        seen, sought = replayed(flight, problem.take(torch.tensor([b])), log.x[b, :K, 0], 5, number)
        assert len(seen.changes) == len(sought) == K == 30
        for (cells, states), (own, new) in zip(log.seen[b].changes, seen.changes, strict=True):
            np.testing.assert_array_equal(cells, own)
            np.testing.assert_array_equal(states, new)
        again = safe_periods(replace(seen, safe=log.seen[b].safe), 0.95 * 0.2, log.period)
        np.testing.assert_array_equal(again, safe_periods(log.seen[b], 0.95 * 0.2, log.period))
        for path, x in zip(sought, log.x[b, :K, 0].numpy(), strict=True):
            assert np.linalg.norm(path[0] - x[:3]) < 0.1 and np.allclose(path[-1], GOALS[b])
            assert np.linalg.norm(np.diff(path[1:-1], axis=0), axis=1).max() < 0.4 * 3**0.5 + 1e-6
        assert len(seen.changes[0][0]) > 100  # it sees something at once


def test_only_one_mission_with_a_sensor_is_replayed() -> None:
    problem, x = walled(), torch.zeros(2, 17).double()
    with pytest.raises(InputError, match="one mission"):
        replayed(mission(), problem, x, 0, 0)
    with pytest.raises(InputError, match=r"mission\.sensor"):
        replayed(mission(sensor="full"), problem.take(torch.tensor([0])), x, 0, 0)
