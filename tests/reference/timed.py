"""The least cost of ways through space and time, state by state in plain Python: cells, moves and layers are tuples."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Place = tuple[int, ...]


@dataclass
class Ways:
    """A lattice of `counts` cells and moves from `least` to `most`, with arrays over layers, cells and moves."""

    counts: Place
    least: Place
    most: Place
    parts: int
    margin: float
    clearance: Array  # (layers * parts + 1, *counts)
    cell_cost: Array  # (layers, *counts), paid when a cell is left; infinite where barred
    end_cost: Array  # (some, *counts), at the last layers; infinite where no way ends
    move_cost: dict[Place, float]
    last_cost: dict[Place, float]
    change: Place | tuple[float, ...]
    toll: Array  # (layers * parts + 1, *counts), of being there at a part

    @property
    def layers(self) -> int:
        return len(self.cell_cost)

    @property
    def moves(self) -> list[Place]:
        return list(itertools.product(*(range(a, b + 1) for a, b in zip(self.least, self.most, strict=True))))

    def between(self, values: Array, row: int, point: Array) -> float:
        """What is at a point between cells, multilinear."""
        low = np.minimum(np.floor(point).astype(int), np.array(self.counts) - 1)
        share, total = point - low, 0.0
        for corner in itertools.product((0, 1), repeat=len(self.counts)):
            weight = np.prod([s if c else 1 - s for s, c in zip(share, corner, strict=True)])
            if weight > 0:
                total += weight * values[(row, *(low + corner))]
        return total

    def leads(self, layer: int, cell: Place, move: Place) -> Place | None:
        """The cell to which a move leads clear of obstacles; None where it doesn't."""
        to = tuple(c + m for c, m in zip(cell, move, strict=True))
        if any(not 0 <= c < n for c, n in zip(to, self.counts, strict=True)):
            return None
        for s in range(1, self.parts + 1):
            point = np.array(cell) + s / self.parts * np.array(move)
            if self.between(self.clearance, layer * self.parts + s, point) < self.margin:
                return None
        is_last = layer + 1 == self.layers
        return to if is_last or np.isfinite(self.cell_cost[(layer + 1, *to)]) else None

    def paid(self, layer: int, cell: Place, move: Place) -> float:
        """What a move and its way cost."""
        points = (np.array(cell) + s / self.parts * np.array(move) for s in range(1, self.parts + 1))
        return self.move_cost[move] + sum(
            self.between(self.toll, layer * self.parts + s, point) for s, point in enumerate(points, 1)
        )

    def ending(self, layer: int, cell: Place, move: Place) -> float:
        """What it costs to end there after a move."""
        late = layer - (self.layers + 1 - len(self.end_cost))
        return float(self.end_cost[(late, *cell)]) + self.last_cost[move] if late >= 0 else np.inf

    def changed(self, before: Place, after: Place) -> float:
        more = [abs(a - b) for a, b in zip(after, before, strict=True)]
        return np.inf if max(more) > 1 else float(sum(c * n for c, n in zip(self.change, more, strict=True)))

    def through(self, start: Place, first: Place) -> Array:
        """The least cost of a way through every cell at every layer, (layers + 1, *counts); infinite without one."""
        there: list[dict[tuple[Place, Place], float]] = [{(start, first): 0.0}]
        for layer in range(self.layers):
            new: dict[tuple[Place, Place], float] = {}
            for (cell, before), cost in there[-1].items():
                for move in self.moves:
                    more = self.changed(before, move)
                    to = self.leads(layer, cell, move) if np.isfinite(more + self.move_cost[move]) else None
                    if to is not None:
                        total = cost + more + self.paid(layer, cell, move) + self.cell_cost[(layer, *cell)]
                        new[to, move] = min(new.get((to, move), np.inf), total)
            there.append(new)
        onward: list[dict[tuple[Place, Place], float]] = [
            {(cell, move): self.ending(self.layers, cell, move) for cell, move in there[-1]}
        ]
        for layer in reversed(range(self.layers)):
            new = {}
            for cell, before in there[layer]:
                new[cell, before] = self.ending(layer, cell, before)
                for move in self.moves:
                    more = self.changed(before, move)
                    to = self.leads(layer, cell, move) if np.isfinite(more + self.move_cost[move]) else None
                    if to is not None and (to, move) in onward[0]:
                        total = (
                            more + self.paid(layer, cell, move) + self.cell_cost[(layer, *cell)] + onward[0][to, move]
                        )
                        new[cell, before] = min(new[cell, before], total)
            onward.insert(0, new)
        found = np.full((self.layers + 1, *self.counts), np.inf)
        for layer in range(self.layers + 1):
            for (cell, move), cost in there[layer].items():
                total = cost + onward[layer].get((cell, move), np.inf)
                found[(layer, *cell)] = min(found[(layer, *cell)], total)
        return found
