"""Where compiled code and the user's model part, what is returned is the model's."""

import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost, TraceWarning


class Drifting:
    """A model with a memory: after the first solve's outer iteration, states beyond 5 drift by another speed."""

    drift = 0.0

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        return u + self.drift * (x > 5.0)

    def change(self, *_: object) -> None:
        self.drift = 0.5


def test_the_states_and_figures_are_the_models_and_no_other_problem_is_touched() -> None:
    model, starts = Drifting(), torch.tensor([[1.0], [9.0]], dtype=torch.float64)
    cost = QuadraticCost([1.0], [0.1], [1.0])
    problem = Problem(FunctionDynamics(model, 1, 1, 0.1, "euler"), cost, [ControlBounds(-1.0, 1.0)], starts, 6)
    U0 = torch.zeros(2, 6, 1, dtype=torch.float64)
    plain = torchgco.AugmentedLagrangian().solve(problem, U0)
    with pytest.warns(TraceWarning, match=r"for problems \[1\]"):
        found = torchgco.AugmentedLagrangian().solve(problem, U0, callback=model.change)
    for name in ("X", "U", "cost", "status"):
        assert torch.equal(getattr(found, name)[0], getattr(plain, name)[0])
    speeds = (found.X[1, 1:] - found.X[1, :-1]) / 0.1 - found.U[1]
    assert torch.allclose(speeds, 0.5 * (found.X[1, :-1] > 5.0).double()), "what the model does now"
    assert torch.allclose(found.cost, problem.cost.total(found.X, found.U))
    assert found.statuses[1] is torchgco.Status.FEASIBLE
