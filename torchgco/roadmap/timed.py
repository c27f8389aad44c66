"""The cheapest ways among obstacles that move: a lattice in space and time, searched in C (c/timed.c).

A state is a layer of time, a cell of space and the move that led there. A move differs from the one before by at most
one unit along each axis, which bounds speed and acceleration. Two sweeps of dynamic programming give the least cost
through every state; where that is least among the cells beside, a way of its own may begin. Two ways are of one class
where at all equal times the segment between them is clear: so windows of time count apart, which winding numbers don't
tell (compare de Groot et al., Topology-driven parallel trajectory optimization in dynamic environments, 2024).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.tree import cast, is_users, moved
from torchgco.native.declarations import Header, Structure
from torchgco.native.engine import run
from torchgco.obstacles.base import OwnKind, Solids
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.native_maps import C, library_of

PARTS = 3  # of a move, at whose ends it is looked at
LOOKS = 16  # layers, about, in which ways of their own are sought
TRIES = 400  # ways that are looked at for them
FAR = 1e30  # costs that stand for none


class Timed(Structure): ...


TIMED_HEADER = Header((C / "timed.h").read_text())
TIMED_HEADER.declare(Timed)


@dataclass(frozen=True, eq=False)
class TimedLattice:
    """Cells of space at layers of time, of one problem.

    Args:
        origin: the first cell, (d,), m.
        counts: cells along each axis, (d,).
        spacing: of the cells, m.
        tau: between layers, s.
        layers: after the first.
        least, most: the smallest and the largest move along each axis, (d,), in cells.
    """

    origin: Array
    counts: NDArray[np.int64]
    spacing: float
    tau: float
    layers: int
    least: NDArray[np.int64]
    most: NDArray[np.int64]

    @property
    def d(self) -> int:
        return len(self.origin)

    @property
    def cells(self) -> int:
        return int(self.counts.prod())

    @property
    def states(self) -> int:
        """How many there are: 8 bytes each while it is searched."""
        return (self.layers + 1) * self.cells * int((self.most - self.least + 1).prod())

    @property
    def points(self) -> Array:
        """The cells (cells, d), m."""
        return self.origin + self.spacing * np.indices(self.counts.tolist()).reshape(self.d, -1).T

    @property
    def velocities(self) -> Array:
        """Of all moves, (moves, d), m/s."""
        size = (self.most - self.least + 1).tolist()
        return (self.least + np.indices(size).reshape(self.d, -1).T) * (self.spacing / self.tau)

    def cell(self, point: Array) -> int:
        """The cell nearest to a point (d,), m."""
        at = np.clip(np.rint((point - self.origin) / self.spacing), 0, self.counts - 1).astype(np.int64)
        return int(np.ravel_multi_index(tuple(at), self.counts.tolist()))

    def move(self, velocity: Array) -> int:
        """The move whose velocity is nearest to one (d,), m/s."""
        at = np.clip(np.rint(velocity * (self.tau / self.spacing)), self.least, self.most) - self.least
        return int(np.ravel_multi_index(tuple(at.astype(np.int64)), (self.most - self.least + 1).tolist()))


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What keeps ways off: solids at the times of a lattice, and distances from all else.

    Args:
        away: from all else at `PARTS` times a layer, (layers PARTS + 1, cells), float32, m; infinite without any.
        center: of S solids at these times, (layers PARTS + 1, S, d), float32, m, from the first cell.
        half, axes: of rounded boxes, (S, d), (S, d, d), float32, m; rows of `axes` are sides' directions.
        radius: by which they are rounded, (S,), or at these times, (layers PARTS + 1, S), float32, m.
        resting: so many of them come first, and rest.
    """

    away: Tensor
    center: Tensor
    half: Tensor
    axes: Tensor
    radius: Tensor
    resting: int


@dataclass(frozen=True, eq=False)
class Others:
    """Balls that a way may meet at a price: of each `price` for a layer all the way inside, less where less deep.

    Args:
        center: of M balls at `PARTS` times a layer, (layers PARTS + 1, M, d), m.
        reach, price: (M,); m.
    """

    center: Tensor
    reach: Tensor
    price: Tensor


@dataclass(frozen=True, eq=False)
class TimedScene:
    """What a lattice is searched for.

    Args:
        field: what is in the way.
        cell_cost: of being at a cell from a layer to the next, (layers, cells), float32; `FAR` where nobody may be.
        end_cost: of ending at a cell, at the last so many layers, (at least 1, cells), float32; `FAR` where nobody may.
        move_cost, last_cost: of each move, and of the last one, (moves,), float32; `FAR` for what is too fast.
        change: of one unit more or less along each axis, (3,), float32.
        start: the cell at the first layer.
        first: the move before it.
        margin: the clearance that ways keep, m.
    """

    lattice: TimedLattice
    field: Surroundings
    cell_cost: Tensor
    end_cost: Tensor
    move_cost: Tensor
    last_cost: Tensor
    change: Tensor
    start: int
    first: int
    margin: float
    others: Others | None = None

    def arguments(self, most: int, dearer: float) -> Timed:
        """What C reads and writes of up to `most` ways."""
        a, field = self.lattice, self.field
        three = [np.ones(3, np.int64), np.zeros(3, np.int64), np.ones(3, np.int64)]
        for whole, part in zip(three, (a.counts, a.least, a.most - a.least + 1), strict=True):
            whole[: a.d] = part
        counts, least, moves = map(torch.from_numpy, three)
        return Timed(
            counts=counts, least=least, moves=moves, layers=a.layers, parts=PARTS, start=self.start, first=self.first,
            earliest=a.layers + 1 - len(self.end_cost), spacing=a.spacing, margin=self.margin, dearer=dearer,
            solids=len(field.half), resting=field.resting, center=field.center, half=field.half, axes=field.axes,
            radius=field.radius.expand(field.center.shape[:2]).contiguous(), **self._met(),
            clearance=field.away.clone(), cell_cost=self.cell_cost,
            end_cost=self.end_cost, move_cost=self.move_cost, last_cost=self.last_cost, change=self.change, most=most,
            tries=TRIES, found=0,
            way=torch.empty(most, a.layers + 1, dtype=torch.int32), end=torch.empty(most, dtype=torch.int32),
            cost=torch.empty(most, dtype=torch.float32),
        )  # fmt: skip

    def _met(self) -> dict[str, Any]:
        if self.others is None:
            return {"others": 0, "other": None, "reach": None, "price": None}
        center = self.others.center - torch.from_numpy(self.lattice.origin)
        other, reach, price = (part.float().contiguous() for part in (center, self.others.reach, self.others.price))
        return {"others": len(reach), "other": other, "reach": reach, "price": price}


@dataclass(frozen=True, eq=False)
class TimedWays:
    """Ways of one problem, each of a class of its own, the cheapest first.

    Args:
        points: of each way at its layers, (its layers + 1, d), m.
        costs: (W,).
        tau: between the layers, s.
    """

    points: list[Array]
    costs: Array
    tau: float


def timed_ways(scenes: Sequence[TimedScene], most: int, dearer: float) -> list[TimedWays]:
    """Up to `most` ways of each scene that cost at most a share `dearer` more than its cheapest.

    There must be a library (`library_for`). As many threads as PyTorch uses search; what is found in one scene doesn't
    depend on the others.

    Raises:
        MemoryError: C could not allocate 8 bytes for each state.
    """
    if not scenes:
        return []
    library = library_for(scenes[0].lattice.d)
    assert library is not None
    own = [scene.arguments(most, dearer) for scene in scenes]
    every: Any = (Timed * len(own))(*own)
    run(library.tgco_timed, len(own), 1, every)
    found = []
    for scene, one, end in zip(scenes, own, every, strict=True):
        way, last, cost = (part[: end.found].numpy() for part in one.kept[-3:])
        points = scene.lattice.points
        ways = [points[cells[: layer + 1]] for cells, layer in zip(way, last, strict=True)]
        found.append(TimedWays(ways, cost.astype(np.float64), scene.lattice.tau))
    return found


def field_of(parts: Sequence[Any], lattice: TimedLattice) -> Surroundings:
    """What the obstacles of one problem are at the times of a lattice.

    Args:
        parts: of a batch of one; those of a body stand for the ball about the position that it holds.
    """
    count, d = lattice.layers * PARTS + 1, lattice.d
    times = torch.arange(count, dtype=torch.float64) * (lattice.tau / PARTS)
    solids: list[list[Tensor]] = []
    others = []
    for part in moved(list(parts), torch.device("cpu")):
        own = part.solids_at(times) if isinstance(part, OwnKind) and not is_users(part) else None
        others.append(part) if own is None else solids.append(_present(own, count))
    if not solids:
        solids = [[torch.empty(count, 0, d), torch.empty(0, d), torch.empty(0, d, d), torch.empty(0)]]
    columns = enumerate(zip(*solids, strict=True))
    center, half, axes, radius = (torch.cat(column, dim=int(i == 0)) for i, column in columns)
    rests = (center == center[:1]).all(-1).all(0)
    order = (~rests).to(torch.int8).argsort(stable=True)
    center = (center - torch.from_numpy(lattice.origin))[:, order]
    center, half, axes, radius = (p.float().contiguous() for p in (center, half[order], axes[order], radius[order]))
    return Surroundings(_away(others, lattice, times.float()), center, half, axes, radius, int(rests.sum()))


def _present(solids: Solids, count: int) -> list[Tensor]:
    """Centres (count, S, d), half sides (S, d), axes (S, d, d) and radii (S,) of those that aren't absent; all at once
    where they rest."""
    here, d = ~solids.absent[0], solids.centers.shape[-1]
    center, radius = solids.centers[:, here].double().expand(count, -1, -1), solids.radii[0, here].double()
    if not isinstance(solids, Cuboids):
        return [center, radius.new_zeros(len(radius), d), torch.eye(d).double().expand(len(radius), d, d), radius]
    return [center, solids.half_sizes[0, here].double(), solids.axes[0, here].double(), radius]


def _away(parts: Sequence[Any], lattice: TimedLattice, times: Tensor) -> Tensor:
    """Distances (T, cells), float32, m, of the cells at times (T,) from obstacles of any kinds."""
    found = torch.full((len(times), lattice.cells), torch.inf, dtype=torch.float32)
    points = torch.from_numpy(lattice.points).float().unsqueeze(0)
    for part in cast(list(parts), torch.float32):
        if part.absent.numel() > 0:
            for row, t in zip(found, times[: None if part.moving else 1].split(1), strict=False):
                # A user's kind may need as many times as there are points.
                away = part.signed_distance(points, t.expand(points.shape[1]) if is_users(part) else t)[0].amin(-1)
                torch.minimum(row if part.moving else found, away, out=row if part.moving else found)
    return found


def library_for(d: int) -> ctypes.CDLL | None:
    """The library for space of this dimension; None where there is none, see `library_of`."""
    constants = {"DIM": d, "LOOKS": LOOKS, "FAR": f"{FAR:g}f"}
    return library_of("timed.c", TIMED_HEADER, constants, "no ways are sought among what moves")
