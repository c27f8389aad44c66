"""Distance fields: at the nodes of a lattice, how far the nearest occupied cell or point is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.notices import AFTER
from torchgco.base.options import check_value
from torchgco.maps.grid import OccupancyGrid, PointCloud
from torchgco.maps.lookup import Lattice, lengths, squares

FINE_NODES = 2**23  # nodes, at most, of fields with two nodes per cell and axis where `refine` doesn't say
FIELD_NODES, OF_CLOUDS = 2**30, 2**26  # of one field, and of one over clouds, whose distances are looked up one by one
ALL_FREE = 1e6  # m: the distance where nothing is occupied
CLOUD_MARGIN = 2  # nodes around the points of a cloud
NODES_AT_ONCE = 2**17  # nodes whose distances are looked up together: Ctrl-C and SIGTERM wait for one such piece

Unknown = Literal["occupied", "free"]


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Euclidean signed distances from what a map holds, at the nodes of a lattice; made by `DistanceField.of`.

    The nodes lie at the corners of the cells, and `refine - 1` between them along each axis. There the distances are
    exact: from the nearest point of an occupied cell, a closed box; inside of occupied cells minus the distance to the
    nearest free one. Outside of the grid nothing is occupied.

    Attributes:
        values: distances (G, nodes along x, y[, z]), m, as an array of float32; G is 1 where all problems share a map.
        origin: the first node, (G, d), m.
        spacing: of the nodes, m.
        source: the map.
        unknown: what unknown cells count as.
        thickness: half the size of the smallest obstacle, m: half a cell, or a point's radius.
    """

    values: np.ndarray
    origin: np.ndarray
    spacing: float
    source: OccupancyGrid | PointCloud
    unknown: Unknown = "occupied"

    @classmethod
    def of(
        cls,
        source: OccupancyGrid | PointCloud,
        unknown: Unknown = "occupied",
        refine: int | None = None,
        resolution: float | None = None,
    ) -> DistanceField:
        """The distances from a map.

        Args:
            source: a grid, or a cloud.
            unknown: what the unknown cells of a grid count as.
            refine: steps of the lattice per cell of a grid, along each axis. None: 2 where that gives at most
                `FINE_NODES` nodes, else 1. With 1, walls of a single cell have no inside: a trajectory that crosses one
                isn't pushed out of it.
            resolution: spacing of the lattice over a cloud, m. None: its radius.

        Raises:
            InputError: another kind of map, an option out of range or that the kind of map doesn't take, too many
                nodes.
        """
        check_value(unknown, Unknown, "field.unknown")
        if isinstance(source, OccupancyGrid):
            if resolution is not None:
                raise InputError("field.resolution", "none for a grid, which has its own", resolution)
            return _of_grid(source, unknown, refine)
        if not isinstance(source, PointCloud):
            raise InputError("field.source", "an OccupancyGrid or a PointCloud", shown(source))
        if refine is not None:
            raise InputError("field.refine", "none for a cloud, which has no cells", refine)
        return _of_cloud(source, unknown, resolution)

    @property
    def d(self) -> int:
        """Dimension of space, 2 or 3."""
        return self.origin.shape[-1]

    @property
    def batch(self) -> int | None:
        """How many problems have a map of their own; None for one map that all share."""
        return self.source.batch

    @property
    def thickness(self) -> float:
        if isinstance(self.source, OccupancyGrid):
            return 0.5 * self.source.resolution
        return self.source.radius

    @property
    def upper(self) -> np.ndarray:
        """The last node, (G, d), m."""
        return self.origin + self.spacing * (np.array(self.values.shape[1:]) - 1)

    def single(self, which: int) -> DistanceField:
        """The field of one of the maps alone, which all problems share."""
        if self.batch is None:
            return self
        here = slice(which, which + 1)
        source = self.source.single(which)
        return DistanceField(self.values[here], self.origin[here], self.spacing, source, self.unknown)

    def take(self, index: np.ndarray) -> DistanceField:
        """The fields of the maps in `index`, one per problem; the same field where all problems share a map.

        The maps are a grid's: clouds of different size stay together.
        """
        source = self.source
        if self.batch is None or not isinstance(source, OccupancyGrid):
            return self
        origins = source.origin if source.origin.ndim == 1 else source.origin[index]
        grid = OccupancyGrid(source.occupied[index], origins, source.resolution)
        return DistanceField(self.values[index], self.origin[index], self.spacing, grid, self.unknown)

    @classmethod
    def joined(cls, fields: Sequence[DistanceField]) -> DistanceField:
        """One field with the maps of grids in order, each for one problem or, in a field of several, for as many.

        Raises:
            InputError: fields of clouds, or of grids with other sizes, resolutions or meanings of unknown cells.
        """
        forms = {(type(f.source), f.values.shape[1:], f.spacing, f.unknown) for f in fields}
        if len(forms) > 1 or not all(isinstance(f.source, OccupancyGrid) for f in fields):
            raise InputError("layouts.map", "the same in all parts, or grids of the same size", "others")
        grids = [f.source for f in fields]
        cells = np.concatenate([g.occupied if g.batch is not None else g.occupied[None] for g in grids])  # type: ignore
        origin = np.concatenate([f.origin for f in fields])
        grid = OccupancyGrid(cells, origin, grids[0].resolution)  # type: ignore[union-attr]
        return cls(np.concatenate([f.values for f in fields]), origin, fields[0].spacing, grid, fields[0].unknown)

    def nodes(self, device: torch.device) -> Tensor:
        """`values` as a tensor; on a CPU it shares their memory."""
        kept = _nodes.setdefault(self, {})
        if device not in kept:
            kept[device] = torch.from_numpy(self.values).to(device)
        return kept[device]

    def distance(self, points: Any, smooth: bool = True) -> Tensor:
        """Distances (...) at points (..., d), m: lower bounds of the true ones; see `Field`.

        Of the map that all problems share; points (G, ..., d) of maps per problem.

        Raises:
            InputError: points of another space, or another number of maps.
        """
        device = points.device if isinstance(points, Tensor) else torch.device("cpu")
        p = torch.as_tensor(points, dtype=torch.float64, device=device)
        G = len(self.values)
        if p.dim() < 1 or p.shape[-1] != self.d or (G > 1 and p.shape[0] != G):
            expected = f"({'' if G == 1 else f'{G}, '}..., {self.d})"
            raise InputError("points", expected, tuple(p.shape))
        flat = p.reshape(G, -1, self.d)
        origins, maps = torch.from_numpy(self.origin).to(p.device), torch.arange(G, device=p.device)
        lattice = Lattice(self.nodes(p.device), maps, origins, self.spacing, smooth)
        cores = torch.full((G,), 0.5 * self.spacing, dtype=p.dtype, device=p.device)
        return lengths(squares(lattice, flat, cores), cores.unsqueeze(-1)).reshape(p.shape[:-1])


def _of_grid(grid: OccupancyGrid, unknown: Unknown, refine: int | None) -> DistanceField:
    if refine is None:
        fine = np.prod([2.0 * size + 1 for size in grid.shape])
        refine = 2 if fine <= FINE_NODES else 1
    else:
        check_value(refine, int, "field.refine")
    if not 1 <= refine <= 8:
        raise InputError("field.refine", "1 to 8 steps per cell", refine)
    _check_count([refine * size + 1 for size in grid.shape])
    spacing = grid.resolution / refine
    values = np.stack([_signed_distances(cells, refine, spacing) for cells in grid.held(unknown)])
    origin = np.broadcast_to(grid.origin, (len(values), grid.d)).copy()
    return DistanceField(values, origin, spacing, grid, unknown)


def _signed_distances(cells: np.ndarray, refine: int, spacing: float) -> np.ndarray:
    """Distances at the nodes from closed occupied cells, inside minus those from closed free ones, m.

    The nearest point of a box to a node is a node, as all corners of cells are nodes: a transform of nodes is exact.
    """
    from edt import edt

    if not cells.any():
        return np.full([refine * size + 1 for size in cells.shape], ALL_FREE, np.float32)
    for axis in range(cells.ndim):
        cells = cells.repeat(refine, axis)
    occupied, free = _touched(cells, False), _touched(~cells, True)
    values = edt(~occupied)  # float32; in steps, of which the squares are whole numbers
    if not free.all():
        values -= edt(~free)
    values *= np.float32(spacing)
    return values


def _touched(cells: np.ndarray, outside: bool) -> np.ndarray:
    """Which nodes, corners of cells, belong to a marked cell; `outside`: those outside of the grid are marked."""
    nodes = np.zeros([size + 1 for size in cells.shape], bool)
    for corner in np.ndindex(*([2] * cells.ndim)):
        nodes[tuple(slice(i, i + size) for i, size in zip(corner, cells.shape, strict=True))] |= cells
    for axis in range(cells.ndim) if outside else ():
        edges = np.moveaxis(nodes, axis, 0)
        edges[0] = edges[-1] = True
    return nodes


def _of_cloud(cloud: PointCloud, unknown: Unknown, resolution: float | None) -> DistanceField:
    spacing = cloud.radius if resolution is None else float(check_value(resolution, float, "field.resolution"))
    if not 0.0 < spacing < np.inf:
        raise InputError("field.resolution", "a length above 0 m, as the cloud's radius is 0", spacing)
    clouds, d = cloud.clouds(), cloud.d
    ends = [(c.min(0), c.max(0)) if len(c) else (np.zeros(d), np.zeros(d)) for c in clouds]
    room = cloud.radius + CLOUD_MARGIN * spacing
    origin = np.array([low - room for low, _ in ends])
    with np.errstate(over="ignore"):
        counts = np.max([np.ceil((high - low + 2 * room) / spacing) for low, high in ends], axis=0) + 1
    _check_count(counts.tolist(), OF_CLOUDS, "a larger radius, or `resolution`")
    shape = counts.astype(int)
    values = np.full((len(clouds), *shape), ALL_FREE, np.float32)
    for i, points in enumerate(clouds):
        if len(points):
            _write_distances(points, values[i], origin[i], spacing)
            values[i] -= np.float32(cloud.radius)
    return DistanceField(values, origin, spacing, cloud, unknown)


def _write_distances(points: np.ndarray, values: np.ndarray, origin: np.ndarray, spacing: float) -> None:
    """Distances of the nodes from the nearest of some points (P, d), into `values`."""
    from scipy.spatial import cKDTree
    from tqdm import tqdm

    # Halved at the middle, not at the median, and with larger leaves the tree answers in a third of the time.
    tree = cKDTree(points, leafsize=32, balanced_tree=False, compact_nodes=False)
    first, *others = (o + spacing * np.arange(size) for o, size in zip(origin, values.shape, strict=True))
    plane = np.stack(np.meshgrid(*others, indexing="ij"), axis=-1).reshape(-1, len(others))
    slabs = [(i, start) for i in range(len(first)) for start in range(0, len(plane), NODES_AT_ONCE)]
    for i, start in tqdm(slabs, "distances from points", delay=AFTER, leave=False, dynamic_ncols=True, disable=None):
        slab = plane[start : start + NODES_AT_ONCE]
        places = np.column_stack([np.full(len(slab), first[i]), slab])
        values[i].reshape(-1)[start : start + NODES_AT_ONCE] = tree.query(places, workers=torch.get_num_threads())[0]


def _check_count(counts: list[float], most: int = FIELD_NODES, way: str = "cells that are larger, or `refine`") -> None:
    if np.prod(np.asarray(counts, float)) > most:
        wanted = f"at most {most:,} nodes: {way}"
        raise InputError("field", wanted, " x ".join(f"{count:.0f}" for count in counts))


# No fields: what a problem holds is compared before each solve, and this comes with the first one.
_nodes: WeakKeyDictionary[DistanceField, dict[torch.device, Tensor]] = WeakKeyDictionary()
