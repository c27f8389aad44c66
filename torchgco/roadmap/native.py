"""The search of search.py in C: each step is one call for all problems of a batch."""

from __future__ import annotations

import ctypes
import functools
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from torchgco.kernels import EagerWarning, native
from torchgco.native.compiler import Compiler, NativeError, build, find_compiler
from torchgco.native.declarations import Header, Structure, defines
from torchgco.native.engine import run
from torchgco.native.includes import included, joined
from torchgco.obstacles.base import TINY, marked
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.roadmap.cheapest import EDGE_COST, HOPS, LEAST_GAP, TIE, UNIT, Beside, Graph
from torchgco.roadmap.geometry import Inflated
from torchgco.roadmap.points import CIRCLE, MIDWAY, SHELLS, directions, of_boxes

SEARCHES_AT_ONCE = 64  # problems searched together
GROUP = 4  # of them, at least so many by each thread
BLOCK, EDGES_AT_ONCE = 32, 8  # edges measured side by side; of those near a box, so many at once

C = Path(__file__).parent / "c"


class Arguments(Structure): ...


SEARCH_HEADER = Header((C / "cheapest.h").read_text())
SEARCH_HEADER.declare(Arguments)


@dataclass(frozen=True)
class NativeSearch:
    """The methods of search.TorchSearch, documented there, in a C library."""

    library: ctypes.CDLL
    obstacles: Inflated
    margin: float

    def graph(
        self, start: Tensor, goal: Tensor, cube: Tensor, nodes: int, neighbours: int, hubs: int, beside: Beside = None
    ) -> Graph:
        (B, d), (spheres, boxes, _) = start.shape, self.obstacles
        M = spheres.radii.shape[1]
        rays, shell = directions(start, goal), start.new_tensor(SHELLS[d])
        count, more = M * (CIRCLE * len(shell) + min(MIDWAY, M)), {}
        reach = torch.stack(self.obstacles.region(start, goal), dim=1)
        if boxes is not None:
            more["beside"], more["exists"] = beside or of_boxes(boxes, spheres, start, goal)
            count += more["beside"].shape[1]
        V, K = 2 + len(cube) + min(nodes, count), neighbours + hubs + 1
        made = Graph(start.new_empty(B, V, d), torch.empty(B, V, K, dtype=torch.int32), start.new_empty(B, V, K))
        self._run(
            "tgco_graph",
            {"start": start, "goal": goal, "reach": reach, "cube": cube, "rays": rays, "shell": shell, **more},
            {"nodes": made.points, "ends": made.ends, "lengths": made.lengths},
            spread=len(cube), candidates=count, points=V, edges=K, neighbours=neighbours, hubs=hubs, directions=CIRCLE,
            shells=len(shell), midway=MIDWAY, extras=more["beside"].shape[1] if more else 0,
        )  # fmt: skip
        return made

    def cheapest(self, graph: Graph, price: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        (B, V, K), p, P = graph.ends.shape, graph.points, HOPS + 1
        path, string = p.new_empty(B, P, p.shape[2]), p.new_empty(B, 2 * P - 1, p.shape[2])
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
        o = self.obstacles.spheres.centers
        return price.to(o).expand(o.shape[0], points)

    def _run(self, name: str, read: dict[str, Tensor], written: dict[str, Tensor], **numbers: float) -> None:
        """Call a function of the library on all problems, by as many threads as PyTorch uses."""
        arguments = self._shared.copy()
        arguments.fill({**{field: tensor.contiguous() for field, tensor in read.items()}, **written, **numbers})
        run(getattr(self.library, name), self.obstacles.spheres.radii.shape[0], GROUP, arguments)

    @cached_property
    def _shared(self) -> Arguments:
        """The arguments of all calls: the obstacles, and constants."""
        spheres, boxes, _ = self.obstacles
        M, more = spheres.radii.shape[1], {}
        if boxes is not None:
            more = {"boxes": boxes.radii.shape[1], "box": _numbers(boxes), "largest": boxes.sizes.amax(-1).contiguous()}
        return Arguments(
            spheres=M, corners=HOPS + 1, margin=self.margin, clear=LEAST_GAP, least=EDGE_COST, tie=TIE,
            centers=spheres.centers.contiguous(), distances=marked(spheres.radii, spheres.absent).contiguous(), **more,
        )  # fmt: skip


def _numbers(boxes: Cuboids) -> Tensor:
    """The numbers that C reads per box, (B, K, ...): centre, directions of its sides, half their lengths, radius."""
    parts = boxes.centers, boxes.axes.flatten(-2), boxes.half_sizes, marked(boxes.radii, boxes.absent).unsqueeze(-1)
    return torch.cat(parts, dim=-1)


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
    constants = {
        "DIM": dimension, "BOXES": int(boxes), "TINY": TINY, "SMALL": UNIT, "BLOCK": BLOCK, "REAL": "double",
        "LANES": EDGES_AT_ONCE,
    }  # fmt: skip
    try:
        return build(joined(defines(constants) + included("cheapest.c"), C) + SEARCH_HEADER.layout)
    except NativeError as error:
        reason = str(error).splitlines()[0]
        warnings.warn(f"solved by PyTorch's kernels where paths are sought: {reason}", EagerWarning, stacklevel=3)
        return None
