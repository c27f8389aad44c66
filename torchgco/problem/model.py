"""Checks of a model's time step, position, parameters and first step when a problem is made."""

from __future__ import annotations

from torch import Tensor

from torchgco.base.errors import InputError, theirs
from torchgco.base.mixing import foreign, why
from torchgco.base.options import Seconds, check_value
from torchgco.base.shapes import MISTAKES, check_tensor, describe
from torchgco.dynamics.base import Dynamics, Integrator


def check_model(dynamics: Dynamics, x0: Tensor) -> None:
    """Check a model's time step, position, parameters and first step, for starts x0 (B, n).

    Raises:
        InputError: names what is at fault.
    """
    check_value(getattr(dynamics, "dt", None), Seconds | None, "dynamics.dt")
    if type(dynamics).step is Dynamics.step:
        check_value(dynamics.integrator, Integrator, "dynamics.integrator")
    where, n = dynamics.position, dynamics.n
    if where is not None and where not in [slice(i, j) for j in range(1, n + 1) for i in range(j)]:
        raise InputError("dynamics.position", f"a slice of states within 0..{n}, or None", repr(where))
    for name in dynamics.per_element:
        _check_parameter(getattr(dynamics, name), f"dynamics.{name}", x0)
    step, start = dynamics.at(0).step, (x0, x0.new_zeros(x0.shape[0], dynamics.m))
    expected = f"a step for {x0.dtype} states {tuple(x0.shape)}, as x0"
    try:
        after = step(*start)
    except MISTAKES as error:
        raise InputError("dynamics.step", expected, why(error, step, *start)) from theirs(error)
    if not isinstance(after, Tensor) or after.shape != x0.shape or after.dtype != x0.dtype:
        got = foreign(x0.dtype, step, *start) if isinstance(after, Tensor) else None
        raise InputError("dynamics.step", f"{x0.dtype} states {tuple(x0.shape)}", got or describe(after))


def _check_parameter(value: object, field: str, x0: Tensor) -> None:
    B = x0.shape[0]
    if not isinstance(value, Tensor):
        check_value(value, float, field)
    elif value.dim() > 0:
        if tuple(value.shape) not in ((B,), (1,)):
            raise InputError(field, f"a number or a tensor ({B},)", tuple(value.shape))
        if value.dtype != x0.dtype or value.device != x0.device:
            raise InputError(field, f"{x0.dtype} on {x0.device} as x0", f"{value.dtype} on {value.device}")
        check_tensor(value, field)
