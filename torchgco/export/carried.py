"""What rows of two knots carry in exported C: with what it begins in each step, and the bounds of rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from torchgco.compiled.numbers import KeptCarried
from torchgco.compiled.stages import previous_of
from torchgco.constraints.bounds import RateBounds
from torchgco.export.numbers import Changing
from torchgco.export.tables import table
from torchgco.export.writer import Writer
from torchgco.native.interior import Kept


@dataclass(frozen=True)
class Carried:
    """That of one problem as C.

    Attributes:
        sizes: what the controller knows of it; 0 where nothing is carried.
        tables: constant arrays.
        pointers: members of the structure Solve, and what they point to.
    """

    sizes: dict[str, int]
    tables: Sequence[str]
    pointers: dict[str, str]


def carried_source(kept: Kept, changing: Changing, writer: Writer, receding: bool) -> Carried:
    """That of a packed problem.

    Args:
        receding: each step leaves its controls where those of the next one count from.
    """
    sizes, tables, numbers = {"CARRIED": 0, "RATED": 0}, list[str](), dict[str, Tensor]()
    if not isinstance(kept, KeptCarried) or kept.carried.shape[1] == 0:
        return Carried(sizes, tables, {})
    members = {member.full: member.first for member in changing.members}
    numbers["carried"], sizes["CARRIED"], first = kept.carried, kept.carried.shape[1], 0
    for i, part in enumerate(kept.user.constraints):
        if isinstance(part, RateBounds):
            tables.append(table("static const int rated[]", part.controls.tolist()))
            sizes |= {"RATED": len(part.controls), "FIRST_RATED": first, "RATES": i}
            for side, name in ((part.lower, "fall"), (part.upper, "rise")):
                numbers[name], by_knot = side, side.dim() > 2 and side.shape[1] > 1
                sizes[f"{name.upper()}_KNOT"] = side.shape[-1] if by_knot else 0
            for side, name in ((part.lower, "lower"), (part.upper, "upper")):
                if (place := members.get(f"constraints[{i}].{name}")) is not None:
                    writer.places[side.data_ptr()] = f"numbers + {place}"
        if part.joins_knots:
            first += len(part.carries(kept.user.x0, kept.user.N).taken)
    if receding and (previous := previous_of(kept.user)):
        sizes["PREVIOUS"] = members[previous[0]]
    writer.tensors |= {tensor.data_ptr(): tensor for tensor in numbers.values()}
    return Carried(sizes, tables, {name: writer.pointer(t.data_ptr(), True) for name, t in numbers.items()})
