"""A kept trace is never one of other code: whatever a function reads, changes of it are seen at the next solve."""

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
import pytest
import torch
from torch import Tensor

from torchgco import FunctionDynamics, Problem, QuadraticCost
from torchgco.dynamics.rollout import open_loop as by_pytorch
from torchgco.native import compiler, dispatch
from torchgco.native.compiler import find_compiler
from torchgco.native.dispatch import current, engine_of

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
D, N = torch.float64, 4
X0, U = torch.tensor([[0.0, 0.0, 1.0, -1.0]], dtype=D), torch.ones(1, N, 2, dtype=D)
COST = QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4)
LITTLE, MUCH = 0.2, 2.0  # drag before and after a change
Drag = Callable[[Tensor], Any]
Case = tuple[Drag, Callable[[], object]]  # a function of the velocity, and what changes it

INPUTS = dict[str, Callable[[], Case]]()  # what changes is an input of the kernel
OTHERS = dict[str, Callable[[], Case]]()  # other code is compiled


def is_input(make: Callable[[], Case]) -> None:
    INPUTS[make.__name__] = make


def is_code(make: Callable[[], Case]) -> None:
    OTHERS[make.__name__] = make


def number(value: float = LITTLE) -> Tensor:
    return torch.tensor(value, dtype=D)


def filled(tensor: Tensor, value: float = MUCH) -> None:
    with torch.no_grad():
        tensor.fill_(value)


class Memory:
    shared: Any = LITTLE

    def __init__(self, value: Any = LITTLE, **more: Any) -> None:
        self.value = value
        vars(self).update(more)

    @property
    def hidden(self) -> Any:
        return self.value

    def method(self) -> Any:
        return self.value


class Slots:
    __slots__ = ("value",)


@dataclass(frozen=True)
class Frozen:
    value: Any = LITTLE


class Named(NamedTuple):
    value: Any


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


# What a kernel reads again -------------------------------------------------------------------------------------------


@is_input
def tensor_in_place() -> Case:
    drag = number()
    return lambda v: drag * v, lambda: drag.fill_(MUCH)


@is_input
def data() -> Case:
    drag = number()
    return lambda v: drag * v, lambda: setattr(drag, "data", number(MUCH))


@is_input
def view() -> Case:
    both = torch.tensor([LITTLE, 3.0], dtype=D)
    part = both[0]
    return lambda v: part * v, lambda: both.fill_(MUCH)


@is_input
def tensor_rebound() -> Case:
    drag = number()

    def change() -> None:
        nonlocal drag
        drag = number(MUCH)

    return lambda v: drag * v, change


@is_input
def attribute_rebound() -> Case:
    memory = Memory(number())
    return lambda v: memory.value * v, lambda: setattr(memory, "value", number(MUCH))


@is_input
def computed_before() -> Case:
    log, small = number(LITTLE).log(), torch.eye(2, dtype=D)
    return lambda v: (v.unsqueeze(-2) @ (log.exp() * small).T).squeeze(-2), lambda: log.copy_(number(MUCH).log())


@is_input
def array_in_place() -> Case:
    drag = np.array(LITTLE)
    return lambda v: torch.from_numpy(drag) * v, lambda: drag.fill(MUCH)


@is_input
def array_rebound() -> Case:
    memory = Memory(np.array(LITTLE))
    return lambda v: torch.as_tensor(memory.value) * v, lambda: setattr(memory, "value", np.array(MUCH))


@is_input
def weight() -> Case:
    net = Net()
    return net, lambda: filled(net.layer.weight)


@is_input
def zero_of_a_weight() -> Case:
    net = Net()
    filled(net.layer.weight, 0.0)
    return net, lambda: filled(net.layer.weight)


@is_input
def weight_replaced() -> Case:
    net = Net()
    return net, lambda: setattr(net.layer, "weight", torch.nn.Parameter(number(MUCH).view(1, 1)))


@is_input
def layer_replaced() -> Case:
    net, other = Net(), torch.nn.Linear(1, 1, bias=False, dtype=D)
    filled(other.weight)
    return net, lambda: setattr(net, "layer", other)


@is_input
def state_loaded() -> Case:
    net, other = Net(), Net()
    filled(other.layer.weight)
    return net, lambda: net.load_state_dict(other.state_dict())


@is_input
def trained() -> Case:
    net = Net()
    steps = torch.optim.SGD(net.parameters(), lr=1.0)

    def change() -> None:
        net(torch.ones(1, dtype=D)).sum().backward()
        steps.step()

    return net, change


# What is code --------------------------------------------------------------------------------------------------------


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
def property_of_an_object() -> Case:
    memory = Memory()
    return lambda v: memory.hidden * v, lambda: setattr(memory, "value", MUCH)


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


@pytest.fixture(autouse=True)
def usual() -> Any:
    before, names = torch.get_default_dtype(), dict(globals())
    yield
    torch.set_default_dtype(before)
    globals().update({name: names[name] for name in ("GAIN", "helper")})


def after(problem: Problem) -> tuple[Tensor, bool]:
    """The states of a rollout in C as of a solve's, which are those of PyTorch, and whether a trace was kept for it."""
    fresh = current(problem)
    engine = engine_of(fresh)
    assert engine is not None
    found = engine.open_loop(fresh, U)
    return found, any(engine.captured is kept.captured for kept, _ in dispatch._engines.values())


def made(drag: Drag) -> Problem:
    field = lambda x, u: torch.cat((x[..., 2:], u - drag(x[..., 2:])), dim=-1)
    return Problem(FunctionDynamics(field, 4, 2, 0.1), COST, [], X0, N)


@pytest.mark.parametrize("name", [*INPUTS, *OTHERS])
def test_a_change_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drag, change = (INPUTS | OTHERS)[name]()
    problem = made(drag)
    before, _ = after(problem)
    again, _ = after(problem)
    assert torch.equal(before, again)
    change()
    if name in INPUTS:
        monkeypatch.setattr(compiler, "_start", lambda *args: pytest.fail("a compiler was called"))
    found, _ = after(problem)
    assert not torch.allclose(found, before, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found, by_pytorch(problem.dynamics, X0, U).detach(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["tensor_in_place", "weight", "array_in_place", "cell", "attribute", "training_flag"])
def test_what_stays_isnt_traced_again(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = made((INPUTS | OTHERS)[name]()[0])
    after(problem)
    monkeypatch.setattr(dispatch, "Engine", lambda *args: pytest.fail("traced again"))
    assert after(problem)[1]
    assert after(problem.started_at(X0 + 1.0, ()))[1]
