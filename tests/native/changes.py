"""Functions with a drag, in many ways, and what changes it: inputs of the kernel, which are read again, and code."""

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

D = torch.float64
LITTLE, MUCH = 0.2, 2.0  # drag before and after a change
Drag = Callable[[Tensor], Any]
Case = tuple[Drag, Callable[[], object]]  # a function of the velocity, and what changes it


def number(value: float = LITTLE) -> Tensor:
    return torch.tensor(value, dtype=D)


def filled(tensor: Tensor, value: float = MUCH) -> None:
    with torch.no_grad():
        tensor.fill_(value)


def of(thing: Any, read: Callable[[Any], Any], change: Callable[[Any], object]) -> Case:
    """A drag that is read of a thing, and what changes the thing."""
    return lambda v: read(thing) * v, lambda: change(thing)


def put(name: str, value: Any = MUCH) -> Callable[[Any], None]:
    return lambda thing: setattr(thing, name, value)


class Memory:
    def __init__(self, value: Any = LITTLE) -> None:
        self.value = value

    def method(self) -> Any:
        return self.value


class Net(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(1, 1, bias=False, dtype=D)
        self.buffer: Tensor
        self.register_buffer("buffer", torch.ones(1, dtype=D))
        filled(self.layer.weight, LITTLE)

    def forward(self, v: Tensor) -> Tensor:
        drag = self.layer(v.unsqueeze(-1)).squeeze(-1) * self.buffer
        return drag if self.training else 2.0 * drag


def of_net(change: Callable[[Net], object], weight: float = LITTLE) -> Case:
    net = Net()
    filled(net.layer.weight, weight)
    return net, lambda: change(net)


def other_net() -> Net:
    net = Net()
    filled(net.layer.weight)
    return net


def rebound() -> Case:
    drag = number()

    def change() -> None:
        nonlocal drag
        drag = number(MUCH)

    return lambda v: drag * v, change


def view() -> Case:
    both = torch.tensor([LITTLE, 3.0], dtype=D)
    part = both[0]
    return lambda v: part * v, lambda: both.fill_(MUCH)


def computed_before() -> Case:
    log, small = number(LITTLE).log(), torch.eye(2, dtype=D)
    return lambda v: (v.unsqueeze(-2) @ (log.exp() * small).T).squeeze(-2), lambda: log.copy_(number(MUCH).log())


def trained() -> Case:
    net = Net()
    steps = torch.optim.SGD(net.parameters(), lr=1.0)

    def change() -> None:
        net(torch.ones(1, dtype=D)).sum().backward()
        steps.step()

    return net, change


INPUTS: dict[str, Callable[[], Case]] = {
    "tensor in place": lambda: of(number(), lambda drag: drag, lambda drag: drag.fill_(MUCH)),
    "data": lambda: of(number(), lambda drag: drag, put("data", number(MUCH))),
    "view": view,
    "tensor rebound": rebound,
    "attribute rebound": lambda: of(Memory(number()), lambda memory: memory.value, put("value", number(MUCH))),
    "computed before": computed_before,
    "array in place": lambda: of(np.array(LITTLE), torch.from_numpy, lambda drag: drag.fill(MUCH)),
    "array rebound": lambda: of(
        Memory(np.array(LITTLE)), lambda memory: torch.as_tensor(memory.value), put("value", np.array(MUCH))
    ),
    "weight": lambda: of_net(lambda net: filled(net.layer.weight)),
    "zero of a weight": lambda: of_net(lambda net: filled(net.layer.weight), 0.0),
    "weight replaced": lambda: of_net(lambda net: setattr(net.layer, "weight", other_net().layer.weight)),
    "layer replaced": lambda: of_net(lambda net: setattr(net, "layer", other_net().layer)),
    "state loaded": lambda: of_net(lambda net: net.load_state_dict(other_net().state_dict())),
    "trained": trained,
}


class Slots:
    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value = LITTLE


@dataclass(frozen=True)
class Frozen:
    value: Any = LITTLE


class Named(NamedTuple):
    value: Any


def cell() -> Case:
    drag = LITTLE

    def change() -> None:
        nonlocal drag
        drag = MUCH

    return lambda v: (lambda: drag * v)(), change


GAIN: Any = LITTLE


def helper() -> Any:
    return GAIN


def by_global(drag: Drag) -> Case:
    globals()["GAIN"] = LITTLE
    return drag, lambda: globals().update(GAIN=MUCH)


def name_that_comes_later() -> Case:
    globals().pop("LATER", None)

    def drag(v: Tensor) -> Tensor:
        try:
            return LATER * v  # type: ignore[name-defined]
        except NameError:
            return LITTLE * v

    return drag, lambda: globals().update(LATER=MUCH)


def of_function(change: Callable[[Any], object]) -> Case:
    """A function that reads its defaults and its attribute, of which `change` changes one."""

    def drag(v: Tensor, by: float = LITTLE, *, more: float = 1.0) -> Tensor:
        return by * more * drag.factor * v  # type: ignore[attr-defined]

    drag.factor = 1.0  # type: ignore[attr-defined]
    return drag, lambda: change(drag)


def code_replaced() -> Case:
    drag = lambda v: LITTLE * v
    return drag, lambda: setattr(drag, "__code__", (lambda v: MUCH * v).__code__)


def partial() -> Case:
    held = {"by": LITTLE}
    return functools.partial(lambda held, v: held["by"] * v, held), lambda: held.update(by=MUCH)


def wrapped_by_pytorch() -> Case:
    memory = [LITTLE]
    return torch.func.vmap(lambda v: memory[0] * v), lambda: memory.__setitem__(0, MUCH)


def own() -> Any:
    """An object of a class of its own."""
    return type("Own", (Memory,), {"shared": LITTLE, "hidden": property(lambda self: LITTLE)})()


def place_of_a_cut() -> Case:
    place = torch.tensor([1])

    def drag(v: Tensor) -> Tensor:
        first, second = torch.tensor_split(v, place, dim=-1)
        return torch.cat((LITTLE * first, second), dim=-1)

    return drag, lambda: place.fill_(0)


def settings() -> Any:
    """A module of the user's."""
    made: Any = types.ModuleType("settings")
    sys.modules["settings"], made.gain = made, LITTLE
    return made


def import_within() -> Case:
    made = settings()

    def drag(v: Tensor) -> Tensor:
        from settings import gain  # type: ignore[import-not-found]

        return gain * v

    return drag, lambda: setattr(made, "gain", MUCH)


def environment() -> Case:
    os.environ["TORCHGCO_TEST_DRAG"] = str(LITTLE)
    change = lambda: os.environ.update(TORCHGCO_TEST_DRAG=str(MUCH))
    return lambda v: float(os.environ["TORCHGCO_TEST_DRAG"]) * v, change


def generator() -> Case:
    memory = [LITTLE]
    drags = (memory[0] for _ in iter(int, 1))
    return lambda v: next(drags) * v, lambda: memory.__setitem__(0, MUCH)


def kept_result() -> Case:
    memory = [LITTLE]
    read = functools.lru_cache(lambda: memory[0])

    def change() -> None:
        memory[0] = MUCH
        read.cache_clear()

    return lambda v: read() * v, change


def parts(thing: Any, drag: Callable[[Any, Tensor], Any], change: Callable[[Any], object]) -> Case:
    """As `of`, for a drag that isn't a number times the velocity."""
    return lambda v: drag(thing, v), lambda: change(thing)


CODE: dict[str, Callable[[], Case]] = {
    "buffer": lambda: of_net(lambda net: net.buffer.fill_(MUCH)),  # it was 1
    "zero of a tensor": lambda: of(number(0.0), lambda drag: drag, lambda drag: drag.fill_(MUCH)),
    "training flag": lambda: of_net(lambda net: net.eval()),
    "hook": lambda: of_net(lambda net: net.layer.register_forward_hook(lambda module, args, out: 3.0 * out)),
    "cell": cell,
    "global": lambda: by_global(lambda v: GAIN * v),
    "global of a helper": lambda: by_global(lambda v: sum(
        helper() * v[..., i : i + 1] * torch.eye(2, dtype=D)[i] for i in range(2)
    )),
    "global of a nested function": lambda: by_global(lambda v: (lambda: GAIN * v)()),
    "global by a made name": lambda: by_global(lambda v: globals()["GA" + "IN"] * v),
    "helper replaced": lambda: (lambda v: helper() * v, lambda: globals().update(helper=lambda: MUCH)),
    "name that comes later": name_that_comes_later,
    "defaults": lambda: of_function(put("__defaults__", (MUCH,))),
    "keyword defaults": lambda: of_function(put("__kwdefaults__", {"more": MUCH})),
    "code replaced": code_replaced,
    "attribute of a function": lambda: of_function(put("factor")),
    "partial": partial,
    "attribute": lambda: of(Memory(), lambda memory: memory.value, put("value")),
    "attribute by a made name": lambda: of(Memory(), lambda memory: getattr(memory, "val" + "ue"), put("value")),
    "attribute of a class": lambda: of(own(), lambda it: it.shared, lambda it: put("shared")(type(it))),
    "property replaced": lambda: of(
        own(), lambda it: it.hidden, lambda it: put("hidden", property(lambda self: MUCH))(type(it))
    ),
    "method replaced": lambda: of(
        own(), lambda it: it.method(), lambda it: put("method", lambda self: MUCH)(type(it))
    ),
    "bound method": lambda: of(Memory().method, lambda read: read(), lambda read: put("value")(read.__self__)),
    "slots": lambda: of(Slots(), lambda memory: memory.value, put("value")),
    "frozen dataclass": lambda: of(
        Frozen(), lambda memory: memory.value, lambda memory: object.__setattr__(memory, "value", MUCH)
    ),
    "namespace": lambda: of(types.SimpleNamespace(value=LITTLE), lambda memory: memory.value, put("value")),
    "named tuple": lambda: of(
        [Named(LITTLE)], lambda memory: memory[0].value, lambda memory: memory.__setitem__(0, Named(MUCH))
    ),
    "nested dict": lambda: of(
        {"deep": [{"value": LITTLE}]}, lambda memory: memory["deep"][0]["value"],
        lambda memory: memory["deep"][0].update(value=MUCH),
    ),
    "deque": lambda: of(collections.deque([LITTLE]), lambda memory: memory[0], lambda memory: memory.appendleft(MUCH)),
    "array read as a number": lambda: of(
        np.array([LITTLE, 1.0]), lambda drag: float(drag.min()), lambda drag: drag.fill(MUCH)
    ),
    "tensor read as a number": lambda: of(number(), lambda drag: drag.item(), lambda drag: drag.fill_(MUCH)),
    "branch on a tensor": lambda: of(
        number(), lambda drag: LITTLE if drag < 1.0 else MUCH, lambda drag: drag.fill_(MUCH)
    ),
    "tensor read by NumPy": lambda: of(
        number().view(1), lambda drag: float(np.mean(drag.numpy())), lambda drag: drag.fill_(MUCH)
    ),
    "length of a choice": lambda: of(
        torch.tensor([LITTLE, -1.0], dtype=D), lambda drag: len(drag[drag > 0.0]), lambda drag: drag.fill_(MUCH)
    ),
    "place of a cut": place_of_a_cut,
    "shape": lambda: of(
        torch.ones(2, dtype=D), lambda drag: float(drag.numel()), put("data", torch.ones(5, dtype=D))
    ),
    "index": lambda: parts(
        torch.tensor([0, 1]), lambda first, v: v[..., first] * LITTLE, lambda first: first.copy_(first.flip(0))
    ),
    "mask": lambda: parts(
        torch.tensor([True, False]), lambda on, v: torch.where(on, v, LITTLE * v), lambda on: on.logical_not_()
    ),
    "needs gradient": lambda: of(
        number(), lambda drag: MUCH if drag.requires_grad else LITTLE, lambda drag: drag.requires_grad_()
    ),
    "gradient": lambda: of(
        torch.nn.Parameter(number()), lambda weight: LITTLE if weight.grad is None else MUCH, put("grad", number())
    ),
    "version": lambda: of(number(), lambda drag: float(drag._version), lambda drag: drag.mul_(1.0)),
    "module of the user's": lambda: of(settings(), lambda made: made.gain, put("gain")),
    "import within": import_within,
    "environment": environment,
    "generator": generator,
    "kept result": kept_result,
    "wrapped by PyTorch": wrapped_by_pytorch,
    "default type": lambda: parts(
        torch.tensor(3), lambda third, v: (1 / third) * v, lambda _: torch.set_default_dtype(D)
    ),
}  # fmt: skip
