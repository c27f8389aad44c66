"""The roadmap's search in C, the counterpart of search.graph: each step is one call for all problems of a batch."""

from __future__ import annotations

import ctypes
import functools
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchgco.base.kernels import native
from torchgco.native.compiler import Compiler, NativeError, build, find_compiler
from torchgco.native.dispatch import EagerWarning
from torchgco.obstacles.box_geometry import Cuboids, beside, between

AT_ONCE = 64  # problems searched together
HOPS = 64  # edges of a path, at most
CLEAR = 0.001  # smallest gap between a point and all obstacles, as a share of the largest r_obs + r_veh
MIDWAY = 4  # nearest neighbours of an obstacle: each gap to one gets a point
SHELLS = {2: (1.05, 1.3), 3: (1.15,)}  # radii of the circles of points around a sphere, by the number of coordinates
RAYS = 8  # points of a circle
TIE = 1e-12  # share of the cost by which equally cheap paths may differ
LEAST = 1e-6  # share of the distance from start to goal that is added to every edge: no edge may cost nothing

POINTS, PATHS, BOXES = (
    Path(__file__).parent / "c" / name for name in ("points.c", "paths.c", "boxes.h")
)
# Fused products and sums would be rounded once where PyTorch rounds twice.
FLAGS = ("-ffp-contract=off",)
SIZES = (
    "problems", "spheres", "spread", "candidates", "points", "edges", "neighbours", "hubs", "corners", "directions",
    "shells", "midway",
)  # fmt: skip
NUMBERS = ("margin", "least", "clear", "factor", "tie")
TENSORS = (
    "centers", "distances", "start", "goal", "cube", "rays", "shell", "nodes", "ends", "lengths", "price", "path",
    "string", "cost", "arrives", "box", "beside", "exists", "reach", "largest",
)  # fmt: skip


class Graph(NamedTuple):
    """Points and the edges that lead from each to some others."""

    points: Tensor  # (B, V, d): start, goal and others; m
    ends: Tensor  # (B, V, K): the points at which edges end
    lengths: Tensor  # (B, V, K), m: infinite where there is no edge


class Packed(ctypes.Structure):
    """The structure `Search` of points.c."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in SIZES),
        *((name, ctypes.c_double) for name in NUMBERS),
        *((name, ctypes.c_void_p) for name in TENSORS),
        *((name, ctypes.c_int64) for name in ("boxes", "extras")),
    ]


@dataclass(frozen=True)
class NativeSearch:
    """The methods of search.graph.Search, documented there, in a C library."""

    library: ctypes.CDLL
    o: Tensor
    R: Tensor
    margin: float
    boxes: Cuboids | None = None

    def graph(self, start: Tensor, goal: Tensor, cube: Tensor, nodes: int, neighbours: int, hubs: int) -> Graph:
        (B, d), M = start.shape, self.R.shape[1]
        rays, shell = directions(start, goal), start.new_tensor(SHELLS[d])
        count, more = M * (RAYS * len(shell) + min(MIDWAY, M)), {}
        if self.boxes is not None:
            more["beside"], more["exists"] = around_boxes(self.boxes, self.o, self.R, start, goal)
            low, high = self.boxes.reach(torch.stack((start, goal), dim=1))
            more["reach"] = torch.stack((low, high), dim=1)
            count += more["beside"].shape[1]
        V, K = 2 + len(cube) + min(nodes, count), neighbours + hubs + 1
        made = Graph(start.new_empty(B, V, d), torch.empty(B, V, K, dtype=torch.int32), start.new_empty(B, V, K))
        self._run(
            "tgco_graph", {"start": start, "goal": goal, "cube": cube, "rays": rays, "shell": shell, **more},
            {"nodes": made.points, "ends": made.ends, "lengths": made.lengths},
            spread=len(cube), candidates=count, points=V, edges=K, neighbours=neighbours, hubs=hubs, directions=RAYS,
            shells=len(shell), midway=MIDWAY, extras=more["beside"].shape[1] if more else 0,
        )  # fmt: skip
        return made

    def cheapest(self, graph: Graph, price: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        (B, V, K), d, P = graph.ends.shape, self.o.shape[2], HOPS + 1
        path, string = self.o.new_empty(B, P, d), self.o.new_empty(B, 2 * P - 1, d)
        arrives, ends = torch.zeros(B, dtype=torch.bool), graph.ends.to(torch.int32)
        self._run(
            "tgco_cheapest",
            {"nodes": graph.points, "ends": ends, "lengths": graph.lengths, "price": self._prices(price, V)},
            {"path": path, "string": string, "arrives": arrives}, points=V, edges=K,
        )  # fmt: skip
        return path, string, arrives

    def taut(self, path: Tensor, string: Tensor, price: Tensor) -> Tensor:
        tight = path.clone()
        self._run("tgco_taut", {"string": string, "cost": self._prices(price, string.shape[1])}, {"path": tight})
        return tight

    def raised(self, price: Tensor, points: Tensor, path: Tensor, factor: float) -> Tensor:
        V = points.shape[1]
        price = self._prices(price, V).clone(memory_format=torch.contiguous_format)
        self._run("tgco_raise", {"nodes": points, "path": path}, {"price": price}, points=V, factor=factor)
        return price

    def _prices(self, price: Tensor, points: int) -> Tensor:
        return price.to(self.o).expand(self.o.shape[0], points)

    def _run(self, name: str, read: dict[str, Tensor], written: dict[str, Tensor], **numbers: float) -> None:
        """Call a function of the library on all problems."""
        read = {**read, "centers": self.o, "distances": self.R}
        if self.boxes is not None:
            numbers["boxes"] = self.boxes.radius.shape[1]
            read |= {"box": _numbers(self.boxes), "largest": self.boxes.sizes.amax(-1)}
        read = {field: tensor.contiguous() for field, tensor in read.items()}  # kept until the call returns
        places: dict[str, Any] = {field: tensor.data_ptr() for field, tensor in (read | written).items()}
        B, M = self.R.shape
        numbers |= {"margin": self.margin, "clear": CLEAR, "least": LEAST, "tie": TIE}
        packed = Packed(problems=B, spheres=M, corners=HOPS + 1, **places, **numbers)
        if not getattr(self.library, name)(ctypes.byref(packed)):
            raise MemoryError("native kernels: no memory")


def around_boxes(boxes: Cuboids, o: Tensor, R: Tensor, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Points (B, C, d) around boxes, and midway to spheres and other boxes; and whether each exists (B, C).

    Args:
        o, R: centres (B, M, d) and radii (B, M) of the spheres.
    """
    first, here = beside(boxes, start, goal, SHELLS[start.shape[1]])
    second, there = between(boxes, start, goal, o, R, MIDWAY)
    return torch.cat((first, second), dim=1), torch.cat((here, there), dim=1)


def _numbers(boxes: Cuboids) -> Tensor:
    """The numbers that C reads per box, (B, K, ...): centre, directions of its sides, half their lengths, radius."""
    parts = boxes.centers, boxes.axes.flatten(-2), boxes.half_sizes, boxes.radius.unsqueeze(-1)
    return torch.cat(parts, dim=-1)


def directions(start: Tensor, goal: Tensor) -> Tensor:
    """Unit vectors (B, RAYS, d): all around in the plane, across the line from start to goal (B, d) in space."""
    angle = torch.arange(RAYS, dtype=start.dtype, device=start.device).view(-1, 1) * (2.0 * math.pi / RAYS)
    cos, sin = angle.cos(), angle.sin()
    if start.shape[1] == 2:
        return torch.cat((cos, sin), dim=-1).expand(start.shape[0], -1, -1)
    along = goal - start
    first = torch.linalg.cross(along, along.new_tensor((0.0, 0.0, 1.0)).expand_as(along))
    straight_up = first.square().sum(-1, keepdim=True) < 1e-12
    first = _unit(torch.where(straight_up, along.new_tensor((1.0, 0.0, 0.0)), first)).unsqueeze(1)
    return cos * first + sin * _unit(torch.linalg.cross(along.unsqueeze(1), first))


def _unit(v: Tensor) -> Tensor:
    return v / v.square().sum(-1, keepdim=True).sqrt().clamp(min=1e-12)


def library_for(like: Tensor, boxes: bool = False) -> ctypes.CDLL | None:
    """The library for spheres with centres like `like` (..., d), and boxes; None where PyTorch searches.

    PyTorch searches on a GPU, in single precision, where the process has chosen it (`kernels.use_native`), where there
    is no compiler (the solver itself warns of that), and where the source doesn't compile (an EagerWarning explains).
    """
    if not native() or find_compiler() is None or like.dtype != torch.float64 or like.device.type != "cpu":
        return None
    return _library(like.shape[-1], boxes, find_compiler())


@functools.cache
def _library(dimension: int, boxes: bool, compiler: Compiler | None) -> ctypes.CDLL | None:
    # Without boxes their code is left out, so that it can't change how the spheres' code is compiled.
    head = f"#define DIM {dimension}\n#define BOXES {int(boxes)}\n{BOXES.read_text() if boxes else ''}"
    try:
        return build(f"{head}\n{POINTS.read_text()}\n{PATHS.read_text()}", FLAGS)
    except NativeError as error:
        reason = str(error).splitlines()[0]
        warnings.warn(f"solved by PyTorch's kernels where paths are sought: {reason}", EagerWarning, stacklevel=3)
        return None
