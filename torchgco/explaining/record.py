"""The record of a search: what every row of a solver's table did, kept where the local solver records."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchgco.base.status import Status

if TYPE_CHECKING:
    import pandas as pd


class Fate(IntEnum):
    """What became of a candidate trajectory along a path."""

    ABSENT = 0  # its path is of the same homotopy class as a shorter one, or there is none
    TRACKED = 1  # dropped as tracked: others were cheaper
    UNSOUND = 2  # relaxed, but too deep in an obstacle, or away from the goal
    RELAXED = 3  # dropped as relaxed: others were cheaper
    FAILED = 4  # refined, but without a good end
    REFINED = 5  # refined, but not the cheapest
    PROPOSED = 6


@dataclass(frozen=True)
class Comparison:
    """One comparison of candidates along paths for b problems, K paths and C candidates each."""

    number: int  # of the pass in the solver's table, from 1
    rows: Tensor  # (b,) int64: places in the batch
    paths: Tensor  # (b, K, P, d): corners, m
    classes: Tensor  # (b, K) int64: the first path of the same homotopy class
    path: Tensor  # (b, C) int64: which path each candidate follows
    fate: Tensor  # (b, C) int64, see Fate
    tracked: Tensor  # (b, C, N+1, n): states after tracking
    relaxed: Tensor  # (b, C, N+1, n): after relaxing; NaN for candidates dropped before
    refined: Tensor  # (b, C, N+1, n): after refining; NaN for candidates dropped before
    cost: Tensor  # (b, C): J_var as refined, infinite without a good end; NaN for candidates that weren't refined
    again: bool = False  # in a second search, with the obstacles that the first one left out


@dataclass(frozen=True)
class Standing:
    """The best trajectories of b problems after a pass."""

    rows: Tensor  # (b,) int64: places in the batch
    cost: Tensor  # (b,): J_var
    violation: Tensor  # (b,): metres for lengths
    goal_distance: Tensor  # (b,), m, of the last knot; NaN without a goal
    arrived: Tensor  # (b,) bool: feasible, and within the solver's tolerance of the goal


@dataclass(frozen=True)
class GuessRecord:
    """What became of every guess: of B problems and k guesses each."""

    cost: Tensor  # (B, k): J_var
    violation: Tensor  # (B, k): metres for lengths
    status: Tensor  # (B, k) int64, see Status
    iterations: Tensor  # (B, k) int64

    def to_frame(self) -> pd.DataFrame:
        """A row per problem (`element`) and guess, with its status, cost, violation and iterations."""
        import pandas as pd

        index = pd.MultiIndex.from_product([range(size) for size in self.cost.shape], names=["element", "guess"])
        columns = {name: getattr(self, name).flatten().cpu().numpy() for name in ("cost", "violation", "iterations")}
        return pd.DataFrame({"status": [Status(s).name for s in self.status.flatten().tolist()]} | columns, index)


@dataclass
class SearchRecord:
    """What the passes of a search did, kept where the local solver records.

    Attributes:
        passes: (number of the pass, its name, places in the batch of the problems that it worked on), in their order.
        caught: places in the batch (b,), and states (b, N+1, n) of the trajectories that were caught.
        comparisons: of candidates along paths.
        standings: of every entry of `passes`; None before the first solve. Where some problems were solved again with
            obstacles that a first search had left out, passes and standings of that second search follow.
    """

    passes: list[tuple[int, str, list[int]]] = field(default_factory=list)
    caught: tuple[Tensor, Tensor] | None = None
    comparisons: list[Comparison] = field(default_factory=list)
    standings: list[Standing | None] = field(default_factory=list)

    def of_first_states(self, n: int) -> SearchRecord:
        """The same with the first n states alone."""
        caught = None if self.caught is None else (self.caught[0], self.caught[1][..., :n])
        names = "tracked", "relaxed", "refined"
        each = [replace(trial, **{name: getattr(trial, name)[..., :n] for name in names}) for trial in self.comparisons]
        return replace(self, caught=caught, comparisons=each)

    def in_costs(self, unit: Tensor, constant: Tensor) -> SearchRecord:
        """The same with costs times a unit, plus a constant, both by place in the batch: those of the user."""
        standings = [s and replace(s, cost=s.cost * unit[s.rows] + constant[s.rows]) for s in self.standings]
        each = [
            replace(trial, cost=trial.cost * unit[trial.rows].unsqueeze(-1) + constant[trial.rows].unsqueeze(-1))
            for trial in self.comparisons
        ]
        return replace(self, comparisons=each, standings=standings)

    def followed_by(self, again: SearchRecord) -> SearchRecord:
        """Both as one, where `again` is of some of these problems, solved a second time."""
        caught, late = self.caught, again.caught
        if caught is not None and late is not None:
            solved = torch.cat([torch.as_tensor(rows) for _, _, rows in again.passes]).to(caught[0])
            stays = ~torch.isin(caught[0], solved)
            caught = torch.cat((caught[0][stays], late[0])), torch.cat((caught[1][stays], late[1]))
        more = [replace(trial, again=True) for trial in again.comparisons]
        return SearchRecord(
            self.passes + again.passes, caught, self.comparisons + more, self.standings + again.standings
        )
