"""The planning problems of a study's layouts, which are made once: solvers, judge, tables and pictures share them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch

from torchgco.experiments.config.build import Setup
from torchgco.scenarios import Layouts, Task


class Tasks:
    """Makes the problems of layouts that can be a batch together when they are first asked for.

    Args:
        layouts: of which places are told.
    """

    def __init__(self, setup: Setup, layouts: Layouts) -> None:
        self.setup, self.layouts = setup, layouts
        self._made = dict[tuple[int, bool], Task]()

    @cached_property
    def groups(self) -> list[np.ndarray]:
        """The places of layouts that can be a batch; see `Layouts.alike`."""
        return self.layouts.alike()

    @property
    def is_exact(self) -> bool:
        """Whether the study computes as the judge does."""
        return (self.setup.device.type, self.setup.dtype) == ("cpu", torch.float64)

    def of(self, places: Sequence[int] | np.ndarray, exact: bool = False) -> Task:
        """The problems of layouts of one group, in ascending order.

        Args:
            exact: on a CPU in double precision, as the judge takes them; else as the study computes.

        Raises:
            InputError: as `Vehicle.task`.
        """
        number = next(i for i, group in enumerate(self.groups) if places[0] in group)
        group, exact = self.groups[number], exact or self.is_exact
        if (number, exact) not in self._made:
            layouts = self.layouts.take(group)
            self._made[number, exact] = self.setup.vehicle.task(layouts) if exact else self.setup.task(layouts)
        task = self._made[number, exact]
        return task if len(places) == len(group) else task.take(np.searchsorted(group, places))

    def part(self, places: Sequence[int]) -> Tasks:
        """Those of some layouts alone, for another process."""
        return Tasks(self.setup, self.layouts.take(places))

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_made": {}}
