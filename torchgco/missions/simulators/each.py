"""What plants have in common whose simulators hold one vehicle at a time."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.missions.plant import RotorPlant, column

FARTHEST_STATE = 1e6  # of any number of a state, in its unit: simulators stop the process, or begin anew, far beyond


@dataclass(frozen=True)
class EachPlant(RotorPlant):
    """A plant that computes every step of every vehicle by itself, from its state alone.

    A vehicle whose state isn't finite, or beyond all reason, is NaN from then on.
    """

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """See `Plant`."""
        states, speeds, push = (tensor.detach().cpu().double().numpy() for tensor in (x, u, force))
        errors = [column(tensor, x) for tensor in (self.mass_error, self.thrust_error, self.drag)]
        deviations = torch.cat([error.expand(len(x), 1) for error in errors], dim=1).tolist()
        after = np.full(states.shape, np.nan)
        for i, state in enumerate(states):
            if bool((np.abs(state) < FARTHEST_STATE).all()):  # false for NaN, too
                after[i] = self.one(state, speeds[i], push[i], (deviations[i][0], deviations[i][1], deviations[i][2]))
        return torch.from_numpy(after).to(x)

    @abstractmethod
    def one(self, x: np.ndarray, u: np.ndarray, force: np.ndarray, deviation: tuple[float, float, float]) -> np.ndarray:
        """A state (17,) one step later; deviation is (mass_error, thrust_error, drag) of this vehicle."""

    def names_own(self, field: str) -> bool:
        """Whether this field names a vehicle that the simulator has itself.

        Raises:
            InputError: errors of such a vehicle, which has its own.
        """
        if getattr(self, field) is None:
            return False
        for name in ("mass_error", "thrust_error", "drag"):
            if np.any(np.asarray(getattr(self, name)) != 0):
                raise InputError(f"plant.{name}", f"0 for a vehicle of plant.{field}", getattr(self, name))
        return True
