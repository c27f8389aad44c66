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

D = torch.float64
LITTLE, MUCH = 0.2, 2.0
Patch = pytest.MonkeyPatch
Case = tuple[Callable[[Tensor], Any], Callable[[], object]]  # a function of the velocity, and what changes it
FAR = dict[str, Callable[[Patch], Case]]()


def is_far(make: Callable[[Patch], Case]) -> None:
    FAR[make.__name__] = make


GAIN = LITTLE
HERE = sys.modules[__name__]


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


@is_far
def global_of_a_parametrized_module(patch: Patch) -> Case:
    net = Weighted()
    parametrize.register_parametrization(net, "weight", Twice())  # its class is made by PyTorch then
    return net, lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
def class_of_a_parametrized_module(patch: Patch) -> Case:
    net = Weighted()
    parametrize.register_parametrization(net, "weight", Twice())
    return net, lambda: patch.setattr(Weighted, "gain", MUCH)


@is_far
def kept_parametrization(patch: Patch) -> Case:
    net = nn.Linear(2, 2, dtype=D)
    parametrize.register_parametrization(net, "weight", Twice())

    def change() -> None:
        patch.setattr(parametrize, "_cache_enabled", 1)
        patch.setattr(parametrize, "_cache", {(id(net), "weight"): torch.zeros(2, 2, dtype=D)})

    return net, change


@is_far
def hook_of_all_modules(patch: Patch) -> Case:
    hooks: Any = nn.modules.module._global_forward_hooks
    return nn.Linear(2, 2, dtype=D), lambda: patch.setitem(hooks, -1, lambda module, args, out: 3.0 * out)


@is_far
def module_that_says_it_is_pytorchs(patch: Patch) -> Case:
    class Own(Weighted):
        __module__ = "torch.nn"

    return Own(), lambda: patch.setattr(Own, "gain", MUCH)


@is_far
def function_that_says_it_is_pytorchs(patch: Patch) -> Case:
    @functools.wraps(nn.init.uniform_)
    def drag(v: Tensor) -> Tensor:
        return GAIN * v

    return drag, lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
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


@is_far
def method_of_an_enum(patch: Patch) -> Case:
    mode = Mode.SLOW
    return lambda v: mode.by_global() * v, lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
def attribute_of_a_member(patch: Patch) -> Case:
    return lambda v: Mode.SLOW.own * v, lambda: patch.setattr(Mode.SLOW, "own", MUCH)


@is_far
def value_of_a_member(patch: Patch) -> Case:
    return lambda v: sum(Mode.SLOW.value) * v, lambda: patch.setattr(Mode.SLOW, "_value_", (MUCH,))


@is_far
def property_of_a_whole_member(patch: Patch) -> Case:
    one = Number.ONE
    return lambda v: one.gain * v, lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
def attribute_with_underscores(patch: Patch) -> Case:
    class Own:
        __gain__ = LITTLE

    own = Own()
    return lambda v: own.__gain__ * v, lambda: setattr(Own, "__gain__", MUCH)


@is_far
def call_that_is_an_object(patch: Patch) -> Case:
    memory = {"by": LITTLE}

    class Own:
        __call__ = functools.partial(lambda memory, v: memory["by"] * v, memory)

    return Own(), lambda: memory.update(by=MUCH)


@is_far
def docstring(patch: Patch) -> Case:
    def drag() -> None:
        """0.2"""

    return lambda v: float(str(drag.__doc__)) * v, lambda: setattr(drag, "__doc__", "2.0")


@is_far
def name_of_a_class(patch: Patch) -> Case:
    class Own:
        pass

    return lambda v: len(Own.__name__) * v, lambda: setattr(Own, "__name__", "Longer")


@is_far
def annotations(patch: Patch) -> Case:
    def drag() -> None: ...

    drag.__annotations__ = {"by": LITTLE}
    return lambda v: drag.__annotations__["by"] * v, lambda: drag.__annotations__.update(by=MUCH)


@is_far
def metadata_of_a_field(patch: Patch) -> Case:
    about = {"by": LITTLE}

    @dataclasses.dataclass
    class Own:
        x: float = dataclasses.field(default=0.0, metadata=about)

    own = Own()
    return lambda v: dataclasses.fields(own)[0].metadata["by"] * v, lambda: about.update(by=MUCH)


@is_far
def subclasses(patch: Patch) -> Case:
    class Own: ...

    made: list[type] = []
    return lambda v: len(Own.__subclasses__()) * v, lambda: made.append(type("More", (Own,), {}))


@is_far
def class_registered_for_an_abstract_one(patch: Patch) -> Case:
    class Kind(ABC):  # noqa: B024
        pass

    class Own: ...

    own = Own()
    return lambda v: (MUCH if isinstance(own, Kind) else LITTLE) * v, lambda: Kind.register(Own)


@is_far
def module_with_getattr(patch: Patch) -> Case:
    settings: Any = types.ModuleType("lazy_settings")
    patch.setitem(sys.modules, "lazy_settings", settings)
    exec("known = {'gain': 0.2}\ndef __getattr__(name): return known[name]", vars(settings))
    return lambda v: settings.gain * v, lambda: settings.known.update(gain=MUCH)


@is_far
def function_of_pytorch_replaced(patch: Patch) -> Case:
    return lambda v: torch.tanh(v), lambda: patch.setattr(torch, "tanh", lambda v: 3.0 * v)


@is_far
def number_put_into_pytorch(patch: Patch) -> Case:
    patch.setattr(torch, "own_gain", LITTLE, raising=False)
    return lambda v: torch.own_gain * v, lambda: patch.setattr(torch, "own_gain", MUCH)  # type: ignore[attr-defined]


@is_far
def method_put_into_pytorch(patch: Patch) -> Case:
    patch.setattr(Tensor, "own_drag", lambda v: LITTLE * v, raising=False)
    change = lambda: patch.setattr(Tensor, "own_drag", lambda v: MUCH * v)
    return lambda v: v.own_drag(), change  # type: ignore[attr-defined]


@is_far
def layer_of_pytorch_replaced(patch: Patch) -> Case:
    return nn.Linear(2, 2, dtype=D), lambda: patch.setattr(nn.Linear, "forward", lambda layer, v: 3.0 * v)


@is_far
def operation_of_a_users(patch: Patch) -> Case:
    library = torch.library.Library("torchgco_tests", "FRAGMENT")
    name = f"drag{len(dir(torch.ops.torchgco_tests))}"
    library.define(f"{name}(Tensor v) -> Tensor")
    library.impl(name, lambda v, library=library: GAIN * v, "CompositeImplicitAutograd")
    drag = getattr(torch.ops.torchgco_tests, name)
    return lambda v: drag(v), lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
def operation_by_its_names(patch: Patch) -> Case:
    library = torch.library.Library("torchgco_named", "FRAGMENT")
    if "by_names" not in dir(torch.ops.torchgco_named):
        library.define("by_names(Tensor v) -> Tensor")
        library.impl("by_names", lambda v, library=library: GAIN * v, "CompositeImplicitAutograd")
    return lambda v: torch.ops.torchgco_named.by_names(v), lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
def operation_of_numpy_made_of_a_function(patch: Patch) -> Case:
    by = np.frompyfunc(lambda x: GAIN * x, 1, 1)
    return lambda v: float(by(1.0)) * v, lambda: patch.setattr(HERE, "GAIN", MUCH)


@is_far
def setting_of_numpy(patch: Patch) -> Case:
    by = np.geterr()["over"]
    return lambda v: (LITTLE if np.geterr()["over"] == by else MUCH) * v, lambda: np.seterr(over="raise")


@is_far
def setting_of_pytorch(patch: Patch) -> Case:
    read = torch.are_deterministic_algorithms_enabled
    return lambda v: (MUCH if read() else LITTLE) * v, lambda: torch.use_deterministic_algorithms(True)


@is_far
def unit_of_time(patch: Patch) -> Case:
    memory = [np.timedelta64(1, "s")]
    change = lambda: memory.__setitem__(0, np.timedelta64(1, "ms"))
    return lambda v: float(memory[0] / np.timedelta64(1, "ms")) * v, change


@is_far
def names_in_an_array(patch: Patch) -> Case:
    array = np.array([(LITTLE, MUCH)], dtype=[("a", float), ("b", float)])
    memory = [array]
    change = lambda: setattr(array, "dtype", [("b", float), ("a", float)])
    return lambda v: float(memory[0]["a"][0]) * v, change


@is_far
def sign_of_a_complex_zero(patch: Patch) -> Case:
    memory = [complex(1.0, 0.0)]
    change = lambda: memory.__setitem__(0, complex(1.0, -0.0))
    return lambda v: math.copysign(1.0, memory[0].imag) * v, change


@is_far
def end_of_a_range(patch: Patch) -> Case:
    memory = [range(0, 3, 2)]
    return lambda v: memory[0].stop * v, lambda: memory.__setitem__(0, range(0, 4, 2))


@is_far
def place_in_memory(patch: Patch) -> Case:
    both = torch.tensor([LITTLE, MUCH], dtype=D)
    drag = both[:1]
    change = lambda: drag.set_(both.untyped_storage(), 1, (1,), (1,))  # type: ignore[call-overload]
    return lambda v: float(drag.storage_offset()) * v, change


@is_far
def hook_of_a_tensor(patch: Patch) -> Case:
    weight = nn.Parameter(torch.ones(1, dtype=D))
    change = lambda: weight.register_hook(lambda slope: slope)
    return lambda v: (MUCH if weight._backward_hooks else LITTLE) * v, change


@is_far
def function_of_a_layer_replaced(patch: Patch) -> Case:
    return lambda v: F.relu(v), lambda: patch.setattr(F, "relu", lambda v: 3.0 * v)
