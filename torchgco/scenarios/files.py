"""Layouts from a file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from torchgco.base.errors import InputError
from torchgco.scenarios import checks
from torchgco.scenarios.base import Scenario
from torchgco.scenarios.layouts import Layouts


@dataclass(frozen=True)
class LayoutFile(Scenario):
    """The layouts of an npz file (its arrays: see Layouts), read at once and numbered by their rows.

    Named by the file's stem; the dimension is the file's. Raises InputError where the file is missing
    (`scenario.path`) or malformed (`layouts.<array>`).
    """

    path: str | Path
    name: str = field(init=False)
    layouts: Layouts = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not isinstance(self.path, str | Path) or not str(self.path):
            raise InputError("scenario.path", "the path of a layout file", repr(self.path))
        object.__setattr__(self, "path", Path(os.path.expanduser(self.path)))
        object.__setattr__(self, "layouts", Layouts.load(self.path))
        object.__setattr__(self, "name", self.layouts.name)

    @property
    def dimension(self) -> int:
        """Dimension d of the file's layouts."""
        return self.layouts.dimension

    @property
    def states(self) -> int | None:
        """Number n of states in the file's start and goal; None where it has neither, or positions alone."""
        ends = (self.layouts.start, self.layouts.goal)
        return next((s.shape[-1] for s in ends if s is not None and s.shape[-1] != self.dimension), None)

    @property
    def available(self) -> int:
        """How many layouts the file holds."""
        return self.layouts.count

    def draw(self, ids: Sequence[int], seed: int = 0) -> Layouts:
        """Rows `ids` of the file, in that order; nothing is drawn, `seed` changes nothing.

        Raises InputError (`study.layouts`) where the file has fewer.
        """
        rows = checks.indices(ids, "ids")
        if rows.max() >= self.available:
            expected = f"at most the {self.available} layouts in {self.path}"
            raise InputError("study.layouts", expected, f"layout {rows.max()}, counted from 0")
        return replace(self.layouts.take(rows), ids=rows)
