"""The glossary of dimensions, and the checks of input.

Dimensions, always these letters in this order:

    B  problems in the batch      S  samples of a problem      N  stages (controls); knots are 0..N
    n  states                     m  controls                  p  rows of a constraint      d  space (2 or 3)
    k  index of a stage or knot   s  = n + 1 + m, the size of the homogeneous vector [x, 1, u]

    X  (B, N+1, n) states         U  (B, N, m) controls        c <= 0 is feasible
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._C._dynamo.eval_frame import get_eval_frame_callback  # type: ignore[import]
from torch._C._functorch import TransformType, peek_interpreter_stack  # type: ignore[import]

from torchgco.base.errors import InputError, shown
from torchgco.base.gradients import asks, is_recording, not_recording

CPU = torch.device("cpu")
# What a user's function raises where it doesn't fit the problem.
MISTAKES = (RuntimeError, TypeError, ValueError, LookupError, AttributeError, ArithmeticError, AssertionError)


def tensor(value: Any, field: str, like: Tensor) -> Tensor:
    """`value` (tensor, array, nested sequence or number) as a floating tensor of the dtype and device of `like`.

    Raises InputError where it isn't numeric, and where a tensor is refused by `check_tensor`.
    """
    if isinstance(value, Tensor):
        return check_tensor(value, field, like)
    try:
        plain = np.array(value) if isinstance(value, np.ndarray) else value  # a copy: it may be read-only or reversed
        plain = list(plain) if isinstance(plain, Sequence) else plain
        if isinstance(plain, (bool, complex)) or (isinstance(plain, np.ndarray) and plain.dtype.kind not in "iuf"):
            raise TypeError
        return torch.as_tensor(plain, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(field, "numbers", shown(value)) from None


def bound_of(value: Any, none: float) -> Any:
    """A bound as it was given, with the number `none` in the place of each None: no bound."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [bound_of(entry, none) for entry in value]
    return none if value is None else value


def as_states(x0: Any) -> Tensor:
    """States (B, n) from a tensor, an array or lists of numbers; a single state (n,) is a batch of one.

    Floating tensors and arrays keep their dtype, whole numbers and lists become float64.

    Raises InputError (`x0`) where it isn't numeric.
    """
    check_untransformed("Problem")
    if isinstance(x0, Tensor):
        whole = not x0.is_floating_point() and not x0.is_complex() and x0.dtype != torch.bool
        states = x0.double() if whole else x0
    else:
        single = isinstance(x0, np.ndarray) and x0.dtype == np.float32
        states = tensor(x0, "x0", torch.empty(0, dtype=torch.float32 if single else torch.float64))
    return states.unsqueeze(0) if states.dim() == 1 else states


def check_tensor(value: Any, field: str, like: Tensor | None = None) -> Tensor:
    """`value`, a dense tensor of float64 or float32 without gradients, of the dtype and device of `like`.

    Raises InputError for all else. Converting another dtype or device silently would hide a mistake, and so would
    leaving out gradients that a tensor asks for, where nothing is differentiated with respect to it.
    """
    if not isinstance(value, Tensor):
        raise InputError(field, "a tensor", type(value).__name__)
    if value.dtype not in (torch.float64, torch.float32):
        raise InputError(field, f"a {'float64 or float32' if like is None else like.dtype} tensor", describe(value))
    if value.layout != torch.strided:
        raise InputError(field, "a dense tensor", value.layout)
    if not is_recording() and asks(value):
        expected = "a tensor without gradients, `.detach()`: no solution is differentiated with respect to it"
        raise InputError(field, expected, describe(value))
    if like is not None and value.dtype != like.dtype:
        raise InputError(field, f"dtype {like.dtype} as in x0", value.dtype)
    if like is not None and value.device != like.device:
        raise InputError(field, f"device {like.device} as in x0", value.device)
    return value


# What to write instead of a transform of torch.func over a solve.
INSTEAD = {
    TransformType.Vmap: "one call takes a whole batch",
    TransformType.Grad: "torch.autograd.grad and torch.autograd.functional.jacobian serve",
    TransformType.Jvp: "torch.autograd.functional.jvp and jacobian serve",
}


def check_untransformed(what: str) -> None:
    """Raise InputError inside torch.compile, and inside transforms of torch.func such as vmap and grad.

    Kernels in C read memory, which tensors there don't have; and a batch is solved at once anyway.
    """
    innermost = peek_interpreter_stack()
    traced = torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.PROXY) is not None  # as by torch.func.linearize
    if innermost is not None or traced:
        kind = TransformType.Jvp if innermost is None else innermost.key()
        instead = INSTEAD.get(kind, "it reads and writes memory")
        raise InputError(what, f"a call outside of torch.func: {instead}", f"one inside ({kind.name.lower()})")
    if get_eval_frame_callback():
        raise InputError(what, "a call outside of torch.compile: it makes kernels of its own", "one inside")


def check_device(device: Any) -> torch.device:
    """The device by its name; InputError, which tells those that there are, where PyTorch can't use it."""
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError, ValueError):
        count = torch.cuda.device_count()
        of_cuda = f"cuda:0{f' to cuda:{count - 1}' if count > 1 else ''}, {count} in all" if count else "no CUDA device"
        raise InputError("device", f"a device that is there, such as cpu ({of_cuda})", str(device)) from None


def computing_on(device: torch.device) -> AbstractContextManager[None]:
    """No gradients are recorded, and new tensors lie on `device`, whatever the process's default device is."""
    if torch.get_default_device() == device:
        return not_recording()
    return _elsewhere(device)


@contextmanager
def _elsewhere(device: torch.device) -> Iterator[None]:
    with not_recording(), device:
        yield


def describe(value: object) -> str:
    """The kind of a value: dtype and shape of a tensor, else its type."""
    if not isinstance(value, Tensor):
        return type(value).__name__
    return f"{value.dtype} {tuple(value.shape)}" + (" with requires_grad" if value.requires_grad else "")


@dataclass(frozen=True)
class Dimensions:
    """The facts about a problem that a part needs to check and shape its tensors."""

    B: int
    N: int
    n: int
    m: int
    dt: float | None  # s, None for dynamics without a time step
    position: slice | None
    like: Tensor  # x0: dtype and device of everything
    obstacles_from: int = 1  # the first knot at which obstacles hold: 0 where the position may be chosen there
    goal: Tensor | None = None  # (B, d), m: the goal's position, where one is known
    horizon: Tensor | None = None  # (B,) int64: stages of each problem, where they differ
    state_names: tuple[str, ...] = ()  # of the model's states, where it names them
    free_time: bool = False  # whether stages last a multiple of dt that is chosen
    model: Any = None  # the dynamics, bound


def space_of(dims: Dimensions, field: str) -> int:
    """d of the position in the dynamics; InputError, naming `field`, where they have none."""
    if dims.position is None:
        wanted = "dynamics with a position: set `position = slice(0, 2)`, or whichever states are metres"
        raise InputError(field, wanted, "dynamics without one")
    return dims.position.stop - dims.position.start


def check_shape(value: Tensor, shape: tuple[int | str, ...], field: str) -> None:
    """Raise InputError unless `value` is a tensor of `shape`; a letter stands for any length, named by it."""
    if not isinstance(value, Tensor):
        raise InputError(field, f"a tensor ({', '.join(map(str, shape))})", type(value).__name__)
    fits = value.dim() == len(shape) and all(
        isinstance(want, str) or want == got for want, got in zip(shape, value.shape, strict=True)
    )
    if not fits:
        raise InputError(field, f"shape ({', '.join(map(str, shape))})", tuple(value.shape))


def per_row(value: Any, field: str, dims: Dimensions, *size: int | str) -> Tensor:
    """Numbers (B, *size), given so, or as (*size) for all problems.

    Raises:
        InputError: not numbers, or of another shape.
    """
    values = tensor(value, field, dims.like)
    values = values.expand(dims.B, *values.shape) if values.dim() == len(size) else values
    check_shape(values, (dims.B, *size), field)
    return values


def check_finite(value: Tensor, field: str, expected: str = "finite numbers") -> None:
    """Raise InputError where a number isn't finite."""
    if not bool(torch.isfinite(value).all()):
        raise InputError(field, expected, "NaN or infinity")


def repeated(values: Tensor, count: int) -> Tensor:
    """Values (B, ...) once for each of some knots or points, (B, count, ...), in memory of their own."""
    every = values.unsqueeze(1).expand(-1, count, *values.shape[1:])
    return every.clone(memory_format=torch.contiguous_format)  # several times as fast as `repeat`


def lead(parameter: Tensor | float, component: Tensor) -> Tensor | float:
    """A model parameter shaped to multiply a component (B, ...) of states with leading batch axis.

    A number or a tensor without axes is returned as it is; one of shape (B,) gets the axes that the component has.
    """
    if isinstance(parameter, Tensor) and parameter.dim() == 1:
        return parameter.view(-1, *([1] * (component.dim() - 1)))
    return parameter


def components(z: Tensor) -> tuple[Tensor, ...]:
    """The components (...) of vectors (..., n), each of them contiguous: arithmetic on strided ones takes longer."""
    return z.movedim(-1, 0).contiguous().unbind(0)


def vectors(*parts: Tensor) -> Tensor:
    """Vectors (..., n) of n components (...), each of which stays contiguous in memory."""
    return torch.stack(parts).movedim(0, -1)
