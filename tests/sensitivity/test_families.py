"""`differentiable` of the general families is right: what it says True of agrees with differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.families.general_problems import FAMILIES
from benchmarks.families.gradient_families import WRONG, errors
from tests.engines import compiled

SMOOTH = "pendulum", "cartpole", "gates", "tilt_limit", "acrobot"
FLAGGED = "landing", "bryson_denham", "hang_glider"  # weakly active and dependent rows


@compiled
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.StepWarning")
@pytest.mark.parametrize("name", [*SMOOTH, *FLAGGED])
def test_what_is_said_to_be_differentiable_is(name: str) -> None:
    torch.manual_seed(3)
    solution, worst = errors(replace(FAMILIES[name], B=2).problem(3))
    told = solution.differentiable
    assert bool(told.all()) or name in FLAGGED
    assert not bool((worst[told] > WRONG).any())
