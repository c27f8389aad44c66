"""The structures, enumerations and constants of the solver's library in C."""

from __future__ import annotations

from enum import IntEnum

from torch import Tensor

from torchgco.base.draws import MURMUR_1, MURMUR_2, WEYL
from torchgco.base.roots import BY_ROUNDING, MOST_EVALUATIONS, SERVES_AGAIN
from torchgco.base.status import STOPPED, Status
from torchgco.judging.steps import LEAST_SLACK
from torchgco.lagrangian.barrier import FILTERED, GOLDEN, LEAST_SIZE, LONGEST_FALL, NUDGE, ORDINARY, ROUNDINGS
from torchgco.native.declarations import Header, Structure, defines, enumerations
from torchgco.native.includes import C
from torchgco.obstacles.base import ABSENT

NOWHERE = -1  # the place of a knot at which a constraint has no rows

# How a constraint's rows are computed, FUNCTION: by traced code, BODY: as rows of the kind of its balls; the penalty of
# guidance, if any.
Kind = IntEnum("Kind", "BOUNDS SPHERES FUNCTION BOXES FIELD BODY", start=0)
Guide = IntEnum("Guide", "NO_GUIDE REGION PATH", start=0)
# How an inner solve is marked that ended, for a reason that `converged` and `refused` say. Others have a `Status`:
# RUNNING, or the one with which they failed.
End = IntEnum("End", {"ENDED": -1})
# The arrays of a quadratic cost and its fields; those of a traced cost: factor and shift, and the numbers of its code.
QUADRATIC = {
    "Q": "Q", "R": "R", "Q_LAST": "Qf", "X_REF": "x_ref", "X_REF_LAST": "xf_ref", "U_REF": "u_ref", "Q_LINEAR": "q",
    "R_LINEAR": "r", "Q_LINEAR_LAST": "qf", "CROSS": "H",
}  # fmt: skip
Quadratic = IntEnum("Quadratic", list(QUADRATIC), start=0)
TracedCost = IntEnum("TracedCost", "FACTOR STAGE LAST", start=0)
# What the interior point asks Python where C can't call a problem's functions: see Request.
Asked = IntEnum("Asked", "VALUES DERIVATIVES NEARBY", start=0)
ENUMERATIONS = Kind, Guide, Status, End, Quadratic, TracedCost, Asked
CONSTANTS = {
    "ABSENT": ABSENT, "NOWHERE": NOWHERE, "PAIRS": FILTERED, "LONGEST_FALL": LONGEST_FALL, "PARTS": 3,
    "COST_ARRAYS": len(Quadratic),
    "NUDGE": NUDGE, "GOLDEN": GOLDEN, "ROUNDINGS": ROUNDINGS, "ORDINARY": ORDINARY, "LEAST_SIZE": LEAST_SIZE,
    "STOPPED": STOPPED, "LEAST_SLACK": LEAST_SLACK,
    "NEWTON_MOST": MOST_EVALUATIONS, "NEWTON_SERVES_AGAIN": SERVES_AGAIN,
    "NEWTON_ROUNDED_DOUBLE": (2.0**-52) ** BY_ROUNDING, "NEWTON_ROUNDED_SINGLE": (2.0**-23) ** BY_ROUNDING,
    **{name: f"{value & 0xFFFFFFFF:#x}u" for name, value in (
        ("MURMUR_1", MURMUR_1), ("MURMUR_2", MURMUR_2), ("WEYL", WEYL),
    )},
}  # fmt: skip


# fmt: off
class Array(Structure): ...
class Constraint(Structure): ...
class Options(Structure): ...
class Problem(Structure): ...
class Outer(Structure): ...
class Sampling(Structure): ...
class Request(Structure): ...
class Interior(Structure): ...
class Kkt(Structure): ...
# fmt: on


HEADER = Header((C / "structures.h").read_text(), CONSTANTS)
HEADER.declare(Array, Constraint, Options, Problem, Outer, Sampling, Request, Interior, Kkt)


def constants() -> str:
    """The file constants.h; c/editor has it for editors."""
    return "#pragma once\n\n" + defines(CONSTANTS) + enumerations(ENUMERATIONS)


def array(value: Tensor | None, knots: bool) -> Array:
    """A tensor (B|1, [N|1,] ...) with strides of 0 where an axis has length 1."""
    if value is None or value.numel() == 0:
        return Array()
    value = value.double().contiguous()
    elements, many = value.shape[0], value.shape[1] if knots else 1
    size = value.numel() // (elements * many)
    element, knot = 0 if elements == 1 else many * size, size if many > 1 else 0
    return Array(data=value, element=element, knot=knot, size=size)
