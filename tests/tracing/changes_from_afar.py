"""Functions with a drag that reach it in roundabout ways, and what changes it."""

from __future__ import annotations

import dataclasses
import enum
import functools
import math
import sys
import types
from abc import ABC
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import parametrize

from tests.native.changes import LITTLE, MUCH, Case, D, of, put

Patch = pytest.MonkeyPatch
GAIN = LITTLE
HERE = sys.modules[__name__]


def by_global(patch: Patch, drag: Any) -> Case:
    return drag, lambda: patch.setattr(HERE, "GAIN", MUCH)


def replaced(patch: Patch, drag: Any, where: Any, name: str) -> Case:
    """A drag by a function of PyTorch, which is replaced."""
    return drag, lambda: patch.setattr(where, name, lambda *given: 3.0 * given[-1])


class Weighted(nn.Module):
    gain = LITTLE

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(1, dtype=D))

    def forward(self, v: Tensor) -> Tensor:
        return GAIN * self.gain * self.weight * v


class Twice(nn.Module):
    def forward(self, weight: Tensor) -> Tensor:
        return 2.0 * weight


def parametrized(net: nn.Module) -> nn.Module:
    parametrize.register_parametrization(net, "weight", Twice())  # its class is made by PyTorch then
    return net


def kept_parametrization(patch: Patch) -> Case:
    net = parametrized(nn.Linear(2, 2, dtype=D))

    def change() -> None:
        patch.setattr(parametrize, "_cache_enabled", 1)
        patch.setattr(parametrize, "_cache", {(id(net), "weight"): torch.zeros(2, 2, dtype=D)})

    return net, change


def hook_of_all_modules(patch: Patch) -> Case:
    hooks: Any = nn.modules.module._global_forward_hooks
    return nn.Linear(2, 2, dtype=D), lambda: patch.setitem(hooks, -1, lambda module, args, out: 3.0 * out)


def module_that_says_it_is_pytorchs(patch: Patch) -> Case:
    class Own(Weighted):
        __module__ = "torch.nn"

    return Own(), lambda: patch.setattr(Own, "gain", MUCH)


def code_run_under_pytorchs_name(patch: Patch) -> Case:
    known: dict[str, Any] = {"__name__": "torch.own", "gain": LITTLE}
    exec("def drag(v): return gain * v", known)
    return known["drag"], lambda: known.update(gain=MUCH)


class Mode(enum.Enum):
    SLOW = (LITTLE,)

    def __init__(self, value: float) -> None:
        self.own = LITTLE

    def by_global(self) -> float:
        return GAIN


class Number(enum.IntEnum):
    ONE = 1

    @property
    def gain(self) -> float:
        return GAIN


class Plain:
    __gain__ = LITTLE


def call_that_is_an_object(patch: Patch) -> Case:
    memory = {"by": LITTLE}

    class Own:
        __call__ = functools.partial(lambda memory, v: memory["by"] * v, memory)

    return Own(), lambda: memory.update(by=MUCH)


def documented() -> None:
    """0.2"""


def metadata_of_a_field(patch: Patch) -> Case:
    about = {"by": LITTLE}

    @dataclasses.dataclass
    class Own:
        x: float = dataclasses.field(default=0.0, metadata=about)

    own = Own()
    return lambda v: dataclasses.fields(own)[0].metadata["by"] * v, lambda: about.update(by=MUCH)


def subclasses(patch: Patch) -> Case:
    class Own: ...

    made: list[type] = []
    return lambda v: len(Own.__subclasses__()) * v, lambda: made.append(type("More", (Own,), {}))


def class_registered_for_an_abstract_one(patch: Patch) -> Case:
    class Kind(ABC):  # noqa: B024
        pass

    own = Plain()
    return lambda v: (MUCH if isinstance(own, Kind) else LITTLE) * v, lambda: Kind.register(Plain)


def module_with_getattr(patch: Patch) -> Case:
    settings: Any = types.ModuleType("lazy_settings")
    patch.setitem(sys.modules, "lazy_settings", settings)
    exec("known = {'gain': 0.2}\ndef __getattr__(name): return known[name]", vars(settings))
    return lambda v: settings.gain * v, lambda: settings.known.update(gain=MUCH)


def number_put_into_pytorch(patch: Patch) -> Case:
    patch.setattr(torch, "own_gain", LITTLE, raising=False)
    return lambda v: torch.own_gain * v, lambda: patch.setattr(torch, "own_gain", MUCH)  # type: ignore[attr-defined]


def method_put_into_pytorch(patch: Patch) -> Case:
    patch.setattr(Tensor, "own_drag", lambda v: LITTLE * v, raising=False)
    change = lambda: patch.setattr(Tensor, "own_drag", lambda v: MUCH * v)
    return lambda v: v.own_drag(), change  # type: ignore[attr-defined]


def operation_of_a_users(patch: Patch) -> Case:
    library = torch.library.Library("torchgco_tests", "FRAGMENT")
    name = f"drag{len(dir(torch.ops.torchgco_tests))}"
    library.define(f"{name}(Tensor v) -> Tensor")
    library.impl(name, lambda v, library=library: GAIN * v, "CompositeImplicitAutograd")
    drag = getattr(torch.ops.torchgco_tests, name)
    return by_global(patch, lambda v: drag(v))


def operation_by_its_names(patch: Patch) -> Case:
    library = torch.library.Library("torchgco_named", "FRAGMENT")
    if "by_names" not in dir(torch.ops.torchgco_named):
        library.define("by_names(Tensor v) -> Tensor")
        library.impl("by_names", lambda v, library=library: GAIN * v, "CompositeImplicitAutograd")
    return by_global(patch, lambda v: torch.ops.torchgco_named.by_names(v))


def operation_of_numpy_made_of_a_function(patch: Patch) -> Case:
    by = np.frompyfunc(lambda x: GAIN * x, 1, 1)
    return by_global(patch, lambda v: float(by(1.0)) * v)


def place_in_memory(patch: Patch) -> Case:
    both = torch.tensor([LITTLE, MUCH], dtype=D)
    drag = both[:1]
    change = lambda: drag.set_(both.untyped_storage(), 1, (1,), (1,))  # type: ignore[call-overload]
    return lambda v: float(drag.storage_offset()) * v, change


def listed(before: Any, after: Any, read: Callable[[Any], Any]) -> Case:
    """A number that is read of the only object of a list, which gets another one."""
    return of([before], lambda memory: read(memory[0]), lambda memory: memory.__setitem__(0, after))


SECOND, THOUSANDTH = np.timedelta64(1, "s"), np.timedelta64(1, "ms")
FAR: dict[str, Callable[[Patch], Case]] = {
    "global of a parametrized module": lambda patch: by_global(patch, parametrized(Weighted())),
    "class of a parametrized module": lambda patch: (
        parametrized(Weighted()), lambda: patch.setattr(Weighted, "gain", MUCH)
    ),
    "kept parametrization": kept_parametrization,
    "hook of all modules": hook_of_all_modules,
    "module that says it is PyTorch's": module_that_says_it_is_pytorchs,
    "function that says it is PyTorch's": lambda patch: by_global(
        patch, functools.wraps(nn.init.uniform_)(lambda v: GAIN * v)
    ),
    "code run under PyTorch's name": code_run_under_pytorchs_name,
    "method of an enum": lambda patch: by_global(patch, lambda v: Mode.SLOW.by_global() * v),
    "attribute of a member": lambda patch: (
        lambda v: Mode.SLOW.own * v, lambda: patch.setattr(Mode.SLOW, "own", MUCH)
    ),
    "value of a member": lambda patch: (
        lambda v: sum(Mode.SLOW.value) * v, lambda: patch.setattr(Mode.SLOW, "_value_", (MUCH,))
    ),
    "property of a whole member": lambda patch: by_global(patch, lambda v: Number.ONE.gain * v),
    "attribute with underscores": lambda patch: of(
        Plain(), lambda own: own.__gain__, lambda _: patch.setattr(Plain, "__gain__", MUCH)
    ),
    "call that is an object": call_that_is_an_object,
    "docstring": lambda patch: of(
        documented, lambda function: float(str(function.__doc__)),
        lambda function: patch.setattr(function, "__doc__", "2.0"),
    ),
    "name of a class": lambda patch: of(type("Own", (), {}), lambda cls: len(cls.__name__), put("__name__", "Longer")),
    "annotations": lambda patch: of(
        documented, lambda function: len(function.__annotations__),
        lambda function: patch.setitem(function.__annotations__, "by", MUCH),
    ),
    "metadata of a field": metadata_of_a_field,
    "subclasses": subclasses,
    "class registered for an abstract one": class_registered_for_an_abstract_one,
    "module with getattr": module_with_getattr,
    "function of PyTorch replaced": lambda patch: replaced(patch, lambda v: torch.tanh(v), torch, "tanh"),
    "function of a layer replaced": lambda patch: replaced(patch, lambda v: F.relu(v), F, "relu"),
    "layer of PyTorch replaced": lambda patch: replaced(patch, nn.Linear(2, 2, dtype=D), nn.Linear, "forward"),
    "number put into PyTorch": number_put_into_pytorch,
    "method put into PyTorch": method_put_into_pytorch,
    "operation of a user's": operation_of_a_users,
    "operation by its names": operation_by_its_names,
    "operation of NumPy made of a function": operation_of_numpy_made_of_a_function,
    "setting of NumPy": lambda patch: of(
        np.geterr()["over"], lambda by: LITTLE if np.geterr()["over"] == by else MUCH, lambda _: np.seterr(over="raise")
    ),
    "setting of PyTorch": lambda patch: of(
        torch.are_deterministic_algorithms_enabled, lambda read: MUCH if read() else LITTLE,
        lambda _: torch.use_deterministic_algorithms(True),
    ),
    "unit of time": lambda patch: listed(SECOND, THOUSANDTH, lambda time: float(time / THOUSANDTH)),
    "names in an array": lambda patch: of(
        [np.array([(LITTLE, MUCH)], dtype=[("a", float), ("b", float)])], lambda memory: float(memory[0]["a"][0]),
        lambda memory: put("dtype", [("b", float), ("a", float)])(memory[0]),
    ),
    "sign of a complex zero": lambda patch: listed(
        complex(1.0, 0.0), complex(1.0, -0.0), lambda number: math.copysign(1.0, number.imag)
    ),
    "end of a range": lambda patch: listed(range(0, 3, 2), range(0, 4, 2), lambda numbers: numbers.stop),
    "place in memory": place_in_memory,
    "hook of a tensor": lambda patch: of(
        nn.Parameter(torch.ones(1, dtype=D)), lambda weight: MUCH if weight._backward_hooks else LITTLE,
        lambda weight: weight.register_hook(lambda slope: slope),
    ),
}  # fmt: skip
