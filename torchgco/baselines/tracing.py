"""A function of PyTorch tensors, recorded once and replayed with CasADi expressions.

What doesn't depend on the variables, PyTorch computes itself: constants once, and what belongs to one problem of the
batch for each problem. Only the rest needs a counterpart in CasADi.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from itertools import count
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from torchgco.baselines.arrays import NoCounterpart, boxed
from torchgco.baselines.operations import OPERATIONS
from torchgco.shapes import InputError


class Traced:
    """function(index, *variables), where index (1,) int64 says which problem of the batch is meant.

    Args:
        field: what the function is, for errors.
        function: tensors in, one tensor out.
        examples: variables of the shapes that it is called with.
        own: tensors that are treated as one problem's own even where all problems of the batch share them: the
            expressions, and with them the last bits, then don't depend on who else is in the batch.

    Raises:
        InputError: the function can't be traced (it branches on values of its arguments, say), or holds an operation
            that CasADi has no counterpart for; the error names it.
    """

    def __init__(
        self, field: str, function: Callable[..., Tensor], *examples: Tensor, own: Iterable[Tensor] = ()
    ) -> None:
        self.field = field
        index = torch.zeros(1, dtype=torch.int64, device=examples[0].device)
        recorder = _record(field, function, index, *examples)
        self._index, *self._variables = recorder.inputs
        self._result, self._captured = recorder.result, recorder.captured
        calls = _needed(recorder.calls, self._result)
        followers = _followers(calls, self._variables)
        self._symbolic = [call for call in calls if followers.issuperset(call.outputs)]
        self._plain = [call for call in calls if not followers.issuperset(call.outputs)]
        for call in self._symbolic:
            if _name(call.operation) not in OPERATIONS:
                raise _unknown(field, call)
        # Where PyTorch's part ends and CasADi's begins.
        border = dict.fromkeys(slot for call in self._symbolic for slot in call.inputs) | {self._result: None}
        border = [slot for slot in border if slot not in followers]
        own_ids = {id(tensor) for tensor in own}
        named = [slot for slot, tensor in self._captured.items() if id(tensor) in own_ids]
        varying = _followers(self._plain, [self._index, *named])
        self._own = [slot for slot in border if slot in varying]
        computed = self._computed(index)
        self._own_shapes = [tuple(computed[slot].shape) for slot in self._own]
        self._constants = {slot: _array(computed[slot]) for slot in border if slot not in varying}

    @property
    def count(self) -> int:
        """How many numbers differ from problem to problem."""
        return sum(int(np.prod(shape)) for shape in self._own_shapes)

    def parameters(self, index: Tensor) -> np.ndarray:
        """Those numbers (count,) for the problem that index (1,) int64 names."""
        if not self._own:
            return np.zeros(0)
        computed = self._computed(index)
        return torch.cat([computed[slot].double().flatten() for slot in self._own]).detach().cpu().numpy()

    def __call__(self, parameters: np.ndarray, *variables: np.ndarray) -> np.ndarray:
        """The function on arrays of numbers or expressions: `parameters` (count,), variables shaped as the examples.

        Raises:
            InputError: an operation that CasADi has no counterpart for with these arguments.
        """
        known: dict[_Slot, Any] = dict(zip(self._variables, variables, strict=True)) | self._constants
        place = 0
        for slot, shape in zip(self._own, self._own_shapes, strict=True):
            known[slot] = parameters[place : place + int(np.prod(shape))].reshape(shape)
            place += int(np.prod(shape))
        for call in self._symbolic:
            try:
                call.replay(OPERATIONS[_name(call.operation)], known)
            except (NoCounterpart, TypeError) as error:
                raise _unknown(self.field, call) from error
        return boxed(known[self._result])

    def _computed(self, index: Tensor) -> dict[_Slot, Any]:
        """PyTorch's part, for one problem."""
        known: dict[_Slot, Any] = {self._index: index} | self._captured
        with torch.no_grad():
            for call in self._plain:
                call.replay(call.operation, known)
        return known


@dataclass(frozen=True)
class _Slot:
    """Stands for a tensor in what was recorded."""

    number: int


@dataclass(frozen=True, eq=False)
class _Call:
    """One operation, with slots in the place of tensors."""

    operation: Any
    args: tuple
    kwargs: dict[str, Any]
    result: Any  # a slot, or a sequence of them

    @property
    def inputs(self) -> list[_Slot]:
        return [leaf for leaf in tree_leaves((self.args, self.kwargs)) if isinstance(leaf, _Slot)]

    @property
    def outputs(self) -> list[_Slot]:
        return [leaf for leaf in tree_leaves(self.result) if isinstance(leaf, _Slot)]

    def replay(self, operation: Callable, known: dict[_Slot, Any]) -> None:
        """Apply `operation` to what is known, which afterwards holds the result too."""
        args, kwargs = tree_map(lambda leaf: known[leaf] if isinstance(leaf, _Slot) else leaf, (self.args, self.kwargs))
        made = operation(*args, **kwargs)
        for slot, value in zip(self.outputs, made if isinstance(made, (list, tuple)) else [made], strict=True):
            known[slot] = value


class _Recorder(TorchDispatchMode):
    """Writes down every operation that reaches PyTorch's kernels, and takes apart those that CasADi doesn't know."""

    def __init__(self, inputs: Iterable[Tensor]) -> None:
        super().__init__()
        self._seen: dict[int, tuple[_Slot, Tensor]] = {}  # with the tensor, so that its id stays its own
        self._numbers = count()
        self.calls: list[_Call] = []
        self.captured: dict[_Slot, Tensor] = {}
        self.inputs = [self._new(tensor) for tensor in inputs]
        self._followers = set(self.inputs)
        self.result = self.inputs[0]

    def slot(self, tensor: Tensor) -> _Slot:
        """The slot of a tensor; one that no recorded operation made comes from outside, and is a constant."""
        if id(tensor) not in self._seen:
            self.captured[self._new(tensor)] = tensor
        return self._seen[id(tensor)][0]

    def _new(self, tensor: Tensor) -> _Slot:
        self._seen[id(tensor)] = _Slot(next(self._numbers)), tensor
        return self._seen[id(tensor)][0]

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.ops.aten._local_scalar_dense.default:
            if self.slot(args[0]) in self._followers:
                raise _LooksAtValues
            return func(*args, **kwargs)  # a constant's value may be looked at
        if _name(func) not in OPERATIONS:
            made_of: Any = _decompositions().get(func, func.decompose)
            with self:  # the parts come here in their turn
                parts = made_of(*args, **kwargs)
            if parts is not NotImplemented:
                return parts
        inputs, options = tree_map(lambda leaf: self.slot(leaf) if isinstance(leaf, Tensor) else leaf, (args, kwargs))
        out = func(*args, **kwargs)
        made = tree_map(lambda leaf: self._new(leaf) if isinstance(leaf, Tensor) else leaf, out)
        call = _Call(func, inputs, options, made)
        self.calls.append(call)
        if not self._followers.isdisjoint(call.inputs):
            self._followers.update(call.outputs)
        return out


class _LooksAtValues(Exception):
    def __str__(self) -> str:
        return "one that looks at the values of its arguments"


def _record(field: str, function: Callable[..., Tensor], *examples: Tensor) -> _Recorder:
    recorder = _Recorder(examples)
    # Writing in place becomes writing into a copy: PyTorch's part and CasADi's must not share memory.
    pure = torch.func.functionalize(function, remove="mutations")
    try:
        with torch.no_grad(), recorder:
            result = pure(*examples)
    except Exception as error:  # whatever a function runs into
        told = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise InputError(field, "a function that can be traced", told) from error
    recorder.result = recorder.slot(result)
    return recorder


@cache
def _decompositions() -> dict[Any, Callable]:
    from torch._decomp import core_aten_decompositions

    return dict(core_aten_decompositions())


def _needed(calls: list[_Call], result: _Slot) -> list[_Call]:
    """The calls that the result depends on."""
    wanted, kept = {result}, []
    for call in reversed(calls):
        if not wanted.isdisjoint(call.outputs):
            wanted.update(call.inputs)
            kept.append(call)
    return kept[::-1]


def _followers(calls: Iterable[_Call], sources: Iterable[_Slot]) -> set[_Slot]:
    """`sources`, and what depends on them."""
    reached = set(sources)
    for call in calls:
        if not reached.isdisjoint(call.inputs):
            reached.update(call.outputs)
    return reached


def _array(value: Tensor) -> np.ndarray:
    """Numbers as objects; whole numbers and truth values stay what they are, to index with."""
    plain = value.detach().cpu()
    return plain.double().numpy().astype(object) if value.is_floating_point() else plain.numpy()


def _name(operation: Any) -> str:
    return str(getattr(operation, "overloadpacket", operation))


def _unknown(field: str, call: _Call) -> InputError:
    return InputError(field, "operations that CasADi has a counterpart for", str(call.operation))
