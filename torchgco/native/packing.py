"""The structures of the C library (problem.c), filled from the parts of a problem."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from torchgco.constraints.base import Constraint
from torchgco.constraints.bounds import ControlBounds, StateBounds
from torchgco.obstacles.base import marked
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.problem import Problem

BOUNDS, SPHERES, FUNCTION, BOXES = range(4)
# All other constraints, subclasses of these too, are traced.
KINDS = {ControlBounds: BOUNDS, StateBounds: BOUNDS, BoundSpheres: SPHERES, BoundBoxes: BOXES}
BOUND_SLACK = 1.0 + 1e-4  # so that rounding, in single precision too, can't make a row active beyond its box's bounds
NO_GUIDE, REGION, PATH = range(3)


class Array(ctypes.Structure):
    _fields_ = [(name, kind) for name, kind in (
        ("data", ctypes.c_void_p), ("element", ctypes.c_int64), ("knot", ctypes.c_int64), ("size", ctypes.c_int64),
    )]  # fmt: skip


class Rows(ctypes.Structure):
    _fields_ = [
        ("kind", ctypes.c_int32), ("equality", ctypes.c_int32), ("rows", ctypes.c_int32), ("place", ctypes.c_void_p),
        ("knots", ctypes.c_int64), ("lam", ctypes.c_void_p), ("variable", ctypes.c_void_p), ("sign", ctypes.c_void_p),
        ("bound", Array), ("squares", Array), ("velocities", Array), ("dt", ctypes.c_double),
    ]  # fmt: skip


COUNTS = ("N", "elements", "constraints", "rungs", "back", "limit", "max_iterations")
TENSORS = (
    "X", "U", "cost", "merit", "regularisation", "alpha", "used", "gains", "slopes", "curvatures", "mu", "inner",
    "iterations", "rung",
)  # fmt: skip
FLAGS = ("status", "converged", "refused", "lost")
QUADRATIC = ("Q", "R", "Qf", "x_ref", "xf_ref", "u_ref", "q", "r", "qf", "H")  # in the order of quadratic.c
COST_ARRAYS = len(QUADRATIC)
CHOICES = ("guide", "phr", "accept_last", "replicas", "optimality")
NUMBERS = (
    "tolerance", "absolute_tolerance", "ratio_min", "ratio_max", "smallest", "first", "growth", "most", "damping",
    "rounding", "lost_beyond", "damp_below",
)  # fmt: skip


class Packed(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in COUNTS),
        *((name, ctypes.c_void_p) for name in (*TENSORS, *FLAGS)),
        ("parameters", Array),
        ("cost_data", Array * COST_ARRAYS),
        ("constraint", ctypes.POINTER(Rows)),
        *((name, ctypes.c_int32) for name in CHOICES),
        *((name, Array) for name in ("center", "radius", "weight")),
        ("ladder", ctypes.c_void_p),
        *((name, ctypes.c_double) for name in (*NUMBERS, "gain")),
    ]


def pack_rows(c: Rows, constraint: Constraint, numbers: Tensor | None, problem: Problem, keep: list[Any]) -> None:
    """Fill `c` from a constraint; `numbers` (B|1, K|1, count) are those of a traced constraint."""
    one = problem.take(slice(0, 1))
    shape = (
        constraint.take(slice(0, 1))
        .value(one.x0.unsqueeze(1).expand(-1, problem.N + 1, -1), one.x0.new_zeros(1, problem.N, problem.m))
        .shape
    )
    place = torch.full((problem.N + 1,), -1, dtype=torch.int32)
    if shape[2] > 0:
        place[constraint.knots] = torch.arange(shape[1], dtype=torch.int32)
    keep.append(place)
    c.equality, c.knots, c.rows = constraint.sense == "equality", shape[1], shape[2]
    c.place, c.kind = place.data_ptr(), KINDS.get(type(constraint), FUNCTION)
    if c.kind == FUNCTION:
        c.bound = array(numbers, keep, knots=True)
    elif isinstance(constraint, ControlBounds | StateBounds):
        size = problem.m if constraint.of == "u" else problem.n
        variables = torch.arange(size, dtype=torch.int32) + (problem.n if constraint.of == "u" else 0)
        above, below = variables[constraint.above], variables[constraint.below]
        variable = torch.cat((above, below))
        sign = torch.cat((torch.ones(above.numel()), -torch.ones(below.numel()))).double()
        upper, lower = constraint.limits()
        B = max(len(upper), len(lower))  # one may be shared by all problems
        bound = torch.cat((upper.expand(B, -1), lower.expand(B, -1)), dim=1)
        keep += [variable, sign]
        c.variable, c.sign = variable.data_ptr(), sign.data_ptr()
        c.bound = array(bound, keep, knots=False)
    elif isinstance(constraint, BoundSpheres):
        c.dt = constraint.dt
        c.bound = array(constraint.centers.flatten(1), keep, knots=False)
        c.squares = array(marked(constraint.inflated_radii.square(), constraint.absent), keep, knots=False)
        if constraint.velocities is not None:
            c.velocities = array(constraint.velocities.flatten(1), keep, knots=False)
    elif isinstance(constraint, BoundBoxes):
        c.bound = array(_box_numbers(constraint), keep, knots=False)


def _box_numbers(boxes: BoundBoxes) -> Tensor:
    """The numbers (B, ...) that boxes.c reads: bounds of all boxes, axis by axis, factors, all numbers of each."""
    absent, radius = boxes.absent.unsqueeze(-1), boxes.inflated_radii.unsqueeze(-1)
    reach = marked(BOUND_SLACK * (boxes.inflated().extent + radius), absent)
    bounds = torch.stack((boxes.centers, reach), dim=-1).transpose(1, 2)
    numbers = torch.cat((boxes.centers, boxes.axes.flatten(2), boxes.half_sizes, marked(radius, absent)), dim=-1)
    return torch.cat((bounds.flatten(1), 2.0 * boxes.depths, numbers.flatten(1)), dim=1)


def array(value: Tensor | None, keep: list[Any], knots: bool) -> Array:
    """A tensor (B|1, [N|1,] ...) with strides of 0 where an axis has length 1."""
    if value is None or value.numel() == 0:
        return Array(None, 0, 0, 0)
    value = value.to(torch.float64).contiguous()
    keep.append(value)
    per_knot = value[0, 0].numel() if knots else value[0].numel()
    many = value.shape[1] if knots else 1
    return Array(value.data_ptr(), 0 if value.shape[0] == 1 else many * per_knot, per_knot if many > 1 else 0, per_knot)
