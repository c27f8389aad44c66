"""Functions with a drag, in many ways, and what changes it: an input of the kernel, which is read again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

D = torch.float64
LITTLE, MUCH = 0.2, 2.0  # drag before and after a change
Drag = Callable[[Tensor], Any]
Case = tuple[Drag, Callable[[], object]]  # a function of the velocity, and what changes it
INPUTS = dict[str, Callable[[], Case]]()


def is_input(make: Callable[[], Case]) -> None:
    INPUTS[make.__name__] = make


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
