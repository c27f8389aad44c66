"""Functions with a drag, in many ways, and what changes it: other code, which is compiled."""

from __future__ import annotations

import collections
import functools
import os
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tests.native.changes import LITTLE, MUCH, Case, D, Memory, Net, number

CODE = dict[str, Callable[[], Case]]()


def is_code(make: Callable[[], Case]) -> None:
    CODE[make.__name__] = make


class Slots:
    __slots__ = ("value",)


@dataclass(frozen=True)
class Frozen:
    value: Any = LITTLE


class Named(NamedTuple):
    value: Any


@is_code
def buffer() -> Case:
    net = Net()
    return net, lambda: net.buffer.fill_(MUCH)  # it was 1


@is_code
def zero_of_a_tensor() -> Case:
    drag = number(0.0)
    return lambda v: drag * v, lambda: drag.fill_(MUCH)


@is_code
def training_flag() -> Case:
    net = Net()
    return net, net.eval


@is_code
def hook() -> Case:
    net = Net()
    return net, lambda: net.layer.register_forward_hook(lambda module, args, out: 3.0 * out)


@is_code
def cell() -> Case:
    drag = LITTLE

    def change() -> None:
        nonlocal drag
        drag = MUCH

    return lambda v: drag * v, change


@is_code
def nested_cell() -> Case:
    drag = LITTLE

    def change() -> None:
        nonlocal drag
        drag = MUCH

    def outer(v: Tensor) -> Tensor:
        def inner() -> Tensor:
            return (lambda: drag * v)()

        return inner()

    return outer, change


GAIN: Any = LITTLE


def helper() -> Any:
    return GAIN


def set_global() -> None:
    global GAIN
    GAIN = MUCH


@is_code
def global_name() -> Case:
    globals()["GAIN"] = LITTLE
    return lambda v: GAIN * v, set_global


@is_code
def global_of_a_helper() -> Case:
    globals()["GAIN"] = LITTLE
    return lambda v: sum(helper() * v[..., i : i + 1] * torch.eye(2, dtype=D)[i] for i in range(2)), set_global


@is_code
def global_of_a_nested_function() -> Case:
    globals()["GAIN"] = LITTLE
    return lambda v: (lambda: GAIN * v)(), set_global


@is_code
def global_by_a_made_name() -> Case:
    globals()["GAIN"] = LITTLE
    return lambda v: globals()["GA" + "IN"] * v, set_global


@is_code
def helper_replaced() -> Case:
    return lambda v: helper() * v, lambda: globals().update(helper=lambda: MUCH)


@is_code
def name_that_comes_later() -> Case:
    globals().pop("LATER", None)

    def drag(v: Tensor) -> Tensor:
        try:
            return LATER * v  # type: ignore[name-defined]
        except NameError:
            return LITTLE * v

    return drag, lambda: globals().update(LATER=MUCH)


@is_code
def defaults() -> Case:
    def drag(v: Tensor, by: float = LITTLE) -> Tensor:
        return by * v

    return drag, lambda: setattr(drag, "__defaults__", (MUCH,))


@is_code
def keyword_defaults() -> Case:
    def drag(v: Tensor, *, by: float = LITTLE) -> Tensor:
        return by * v

    return drag, lambda: setattr(drag, "__kwdefaults__", {"by": MUCH})


@is_code
def list_as_default() -> Case:
    by = [LITTLE]

    def drag(v: Tensor, by: list[float] = by) -> Tensor:
        return by[0] * v

    return drag, lambda: by.__setitem__(0, MUCH)


@is_code
def code_replaced() -> Case:
    def drag(v: Tensor) -> Tensor:
        return LITTLE * v

    return drag, lambda: setattr(drag, "__code__", (lambda v: MUCH * v).__code__)


@is_code
def attribute_of_a_function() -> Case:
    def drag(v: Tensor) -> Tensor:
        return drag.by * v  # type: ignore[attr-defined]

    drag.by = LITTLE  # type: ignore[attr-defined]
    return drag, lambda: setattr(drag, "by", MUCH)


@is_code
def partial() -> Case:
    settings = {"by": LITTLE}

    def drag(settings: dict[str, float], v: Tensor) -> Tensor:
        return settings["by"] * v

    return functools.partial(drag, settings), lambda: settings.update(by=MUCH)


@is_code
def attribute() -> Case:
    memory = Memory()
    return lambda v: memory.value * v, lambda: setattr(memory, "value", MUCH)


@is_code
def attribute_of_an_attribute() -> Case:
    memory = Memory(Memory())
    return lambda v: memory.value.value * v, lambda: setattr(memory.value, "value", MUCH)


@is_code
def attribute_by_a_made_name() -> Case:
    memory = Memory()
    return lambda v: getattr(memory, "val" + "ue") * v, lambda: setattr(memory, "value", MUCH)


@is_code
def attribute_of_a_class() -> Case:
    class Own(Memory):
        shared = LITTLE

    memory = Own()
    return lambda v: memory.shared * v, lambda: setattr(Own, "shared", MUCH)


@is_code
def property_replaced() -> Case:
    class Own(Memory):
        hidden = property(lambda self: LITTLE)

    memory = Own()
    return lambda v: memory.hidden * v, lambda: setattr(Own, "hidden", property(lambda self: MUCH))


@is_code
def method_replaced() -> Case:
    class Own(Memory):
        pass

    memory = Own()
    return lambda v: memory.method() * v, lambda: setattr(Own, "method", lambda self: MUCH)


@is_code
def bound_method() -> Case:
    memory = Memory()
    read = memory.method
    return lambda v: read() * v, lambda: setattr(memory, "value", MUCH)


@is_code
def slots() -> Case:
    memory = Slots()
    memory.value = LITTLE
    return lambda v: memory.value * v, lambda: setattr(memory, "value", MUCH)


@is_code
def frozen_dataclass() -> Case:
    memory = Frozen()
    return lambda v: memory.value * v, lambda: object.__setattr__(memory, "value", MUCH)


@is_code
def namespace() -> Case:
    memory = types.SimpleNamespace(value=LITTLE)
    return lambda v: memory.value * v, lambda: setattr(memory, "value", MUCH)


@is_code
def named_tuple() -> Case:
    memory = [Named(LITTLE)]
    return lambda v: memory[0].value * v, lambda: memory.__setitem__(0, Named(MUCH))


@is_code
def nested_dict() -> Case:
    memory = {"deep": [{"value": LITTLE}]}
    return lambda v: memory["deep"][0]["value"] * v, lambda: memory["deep"][0].update(value=MUCH)


@is_code
def deque() -> Case:
    memory = collections.deque([LITTLE])
    return lambda v: memory[0] * v, lambda: memory.appendleft(MUCH)


@is_code
def array_read_as_a_number() -> Case:
    drag = np.array([LITTLE, 1.0])
    return lambda v: float(drag.min()) * v, lambda: drag.fill(MUCH)


@is_code
def tensor_read_as_a_number() -> Case:
    drag = number()
    return lambda v: drag.item() * v, lambda: drag.fill_(MUCH)


@is_code
def branch_on_a_tensor() -> Case:
    drag = number()
    return lambda v: LITTLE * v if drag < 1.0 else MUCH * v, lambda: drag.fill_(MUCH)


@is_code
def tensor_read_by_numpy() -> Case:
    drag = torch.tensor([LITTLE], dtype=D)
    return lambda v: float(np.mean(drag.numpy())) * v, lambda: drag.fill_(MUCH)


@is_code
def length_of_a_choice() -> Case:
    drag = torch.tensor([LITTLE, -1.0], dtype=D)
    return lambda v: len(drag[drag > 0.0]) * v, lambda: drag.fill_(MUCH)


@is_code
def place_of_a_cut() -> Case:
    place = torch.tensor([1])

    def drag(v: Tensor) -> Tensor:
        first, second = torch.tensor_split(v, place, dim=-1)
        return torch.cat((LITTLE * first, second), dim=-1)

    return drag, lambda: place.fill_(0)


@is_code
def shape() -> Case:
    drag = torch.ones(2, dtype=D)
    return lambda v: float(drag.numel()) * v, lambda: setattr(drag, "data", torch.ones(5, dtype=D))


@is_code
def index() -> Case:
    first = torch.tensor([0, 1])
    return lambda v: v[..., first] * LITTLE, lambda: first.copy_(torch.tensor([1, 0]))


@is_code
def mask() -> Case:
    on = torch.tensor([True, False])
    return lambda v: torch.where(on, v, LITTLE * v), lambda: on.logical_not_()


@is_code
def needs_gradient() -> Case:
    drag = number()
    return lambda v: (MUCH if drag.requires_grad else LITTLE) * v, drag.requires_grad_


@is_code
def gradient() -> Case:
    weight = torch.nn.Parameter(number())
    return lambda v: (LITTLE if weight.grad is None else MUCH) * v, lambda: setattr(weight, "grad", number())


@is_code
def version() -> Case:
    drag = number()
    return lambda v: float(drag._version) * v, lambda: drag.mul_(1.0)


@is_code
def module_of_the_users() -> Case:
    settings: Any = types.ModuleType("settings")
    sys.modules["settings"], settings.gain = settings, LITTLE
    return lambda v: settings.gain * v, lambda: setattr(settings, "gain", MUCH)


@is_code
def import_within() -> Case:
    settings: Any = types.ModuleType("settings")
    sys.modules["settings"], settings.gain = settings, LITTLE

    def drag(v: Tensor) -> Tensor:
        from settings import gain  # type: ignore[import-not-found]

        return gain * v

    return drag, lambda: setattr(settings, "gain", MUCH)


@is_code
def environment() -> Case:
    os.environ["TORCHGCO_TEST_DRAG"] = str(LITTLE)
    change = lambda: os.environ.update(TORCHGCO_TEST_DRAG=str(MUCH))
    return lambda v: float(os.environ["TORCHGCO_TEST_DRAG"]) * v, change


@is_code
def generator() -> Case:
    memory = [LITTLE]
    drags = (memory[0] for _ in iter(int, 1))
    return lambda v: next(drags) * v, lambda: memory.__setitem__(0, MUCH)


@is_code
def kept_result() -> Case:
    memory = [LITTLE]
    read = functools.lru_cache(lambda: memory[0])

    def change() -> None:
        memory[0] = MUCH
        read.cache_clear()

    return lambda v: read() * v, change


@is_code
def wrapped_by_pytorch() -> Case:
    memory = [LITTLE]
    return torch.func.vmap(lambda v: memory[0] * v), lambda: memory.__setitem__(0, MUCH)


@is_code
def default_type() -> Case:
    third = torch.tensor(3)

    def change() -> None:
        torch.set_default_dtype(D)

    return lambda v: (1 / third) * v, change
