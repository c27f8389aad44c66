"""What states and controls are called, and in which units: for tables, figures and texts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchgco.base.errors import InputError, shown
from torchgco.dynamics.base import Dynamics


class Quantity(NamedTuple):
    """A state or a control."""

    name: str
    unit: str = ""

    @property
    def label(self) -> str:
        """The name with its unit, as titles and heads of columns have it."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def states_of(dynamics: Dynamics) -> list[Quantity]:
    """The n states: by the model's own names, else coordinates of the position by letter and others by number.

    Raises:
        InputError: names or units that aren't one text for each.
    """
    if len(dynamics.state_names) > 0 or len(dynamics.state_units) > 0:
        return _named(dynamics.state_names, dynamics.state_units, dynamics.n, "state", "x")
    span = dynamics.position
    axes = range(0) if span is None or span.stop - span.start > 3 else range(span.start, span.stop)
    return [Quantity("xyz"[i - axes.start], "m") if i in axes else Quantity(f"x[{i}]") for i in range(dynamics.n)]


def controls_of(dynamics: Dynamics) -> list[Quantity]:
    """The m controls.

    Raises:
        InputError: as `states_of`.
    """
    return _named(dynamics.control_names, dynamics.control_units, dynamics.m, "control", "u")


def _named(names: Sequence[str], units: Sequence[str], count: int, kind: str, letter: str) -> list[Quantity]:
    """Quantities with names and units; without names they are numbered."""
    for field, texts in ((f"{kind}_names", names), (f"{kind}_units", units)):
        whole = isinstance(texts, Sequence) and not isinstance(texts, str)
        if not whole or len(texts) not in (0, count) or not all(isinstance(text, str) for text in texts):
            raise InputError(f"dynamics.{field}", f"{count} texts, one per {kind}", shown(texts))
    if len(set(names)) < len(names):
        raise InputError(f"dynamics.{kind}_names", "a name of its own for each", shown(names))
    labels = names if len(names) else [f"{letter}[{i}]" for i in range(count)]
    return [Quantity(*pair) for pair in zip(labels, units if len(units) else [""] * count, strict=True)]
