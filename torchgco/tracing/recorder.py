"""Records the operations that a function of PyTorch tensors consists of."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import count, groupby
from typing import Any

import torch
from torch import Tensor
from torch.overrides import resolve_name
from torch.utils._python_dispatch import TorchDispatchMode

from torchgco.base.autodiff import WithoutReading
from torchgco.base.errors import InputError, theirs
from torchgco.base.roots import roots_as_operations
from torchgco.base.shapes import MISTAKES
from torchgco.base.together import copy_to, leaves, mapped_arguments, together
from torchgco.tracing.decompositions import DECOMPOSITIONS
from torchgco.tracing.operations import OPERATIONS
from torchgco.tracing.watch import has_own_memory, overlap

OF_SHAPES = "aten.is_same_size", "aten._has_same_storage_numel"  # operations that look at shapes alone
READ_NUMBERS = 64  # numbers of a tensor, made by Python code, that are compared
SHAPED_BY_VALUES = torch.Tag.dynamic_output_shape


@dataclass(frozen=True)
class Slot:
    """Stands for a tensor in a recording."""

    number: int
    dtype: torch.dtype


@dataclass(frozen=True, eq=False)
class Operation:
    """One operation, with slots in the place of tensors."""

    function: Any
    args: tuple
    kwargs: dict[str, Any]
    result: Any  # a slot, or a sequence of them
    called: Any = None  # the function of PyTorch that the user called
    default: torch.dtype = torch.float32  # the type that PyTorch's quotients and roots of integers have

    @cached_property
    def inputs(self) -> list[Slot]:
        return [leaf for leaf in leaves((self.args, self.kwargs)) if isinstance(leaf, Slot)]

    @cached_property
    def outputs(self) -> list[Slot]:
        return [leaf for leaf in leaves(self.result) if isinstance(leaf, Slot)]

    @property
    def title(self) -> str:
        return title(self.function, self.called)

    def filled(self, known: dict[Slot, Any]) -> tuple[tuple, dict[str, Any]]:
        """The arguments with known values in the place of slots."""
        return mapped_arguments(lambda leaf: known[leaf] if isinstance(leaf, Slot) else leaf, (self.args, self.kwargs))

    def replay(self, known: dict[Slot, Any]) -> None:
        """Apply PyTorch's operation to known tensors, and add its result to `known`."""
        args, kwargs = self.filled(known)
        made = self.function(*args, **kwargs)
        for slot, value in zip(self.outputs, made if isinstance(made, (list, tuple)) else [made], strict=True):
            known[slot] = value


class Recording(TorchDispatchMode):
    """Records every operation that reaches PyTorch's kernels, and decomposes those that CasADi doesn't know."""

    def __init__(self, inputs: Iterable[Tensor], calls: WithoutReading) -> None:
        super().__init__()
        self._calls = calls
        self._seen: dict[int, tuple[Slot, Tensor]] = {}  # holds the tensor: its id isn't reused
        self._numbers = count()
        self._stale: set[int] = set()  # the same of tensors whose memory was written by way of another one
        self.operations: list[Operation] = []
        self.lenient = False  # whether what can't be followed is recorded nevertheless
        self.unfit: _Unfit | None = None  # why the function can't be recorded; its own code may have caught it
        self.captured: dict[Slot, Tensor] = {}
        self.looked = False  # whether Python code reads values of tensors from outside, which it may branch on
        self.read: list[Slot] = []  # what it reads of them, where that is a tensor
        self._made: set[Slot] = set()  # captured tensors that the function itself makes of Python's numbers
        self._outer: set[Slot] = set()  # what depends on the others
        self._brought: dict[Slot, Tensor] = {}  # copies of captured tensors that lie on another device than the inputs
        self.examples = list(inputs)
        self.inputs = [self._new(tensor) for tensor in self.examples]
        self._followers = set(self.inputs)
        self.result = self.inputs[0]

    def slot(self, tensor: Tensor) -> Slot:
        """The slot of a tensor; a tensor that no recorded operation made comes from outside, and is a constant."""
        if id(tensor) in self._stale:
            raise self._unfit("one that reads what was written by way of another tensor", self._calls.called)
        if id(tensor) not in self._seen:
            self.captured[self._new(tensor)] = tensor
        return self._seen[id(tensor)][0]

    @property
    def outside(self) -> list[Slot]:
        """The tensors that the function reads from outside, other than its arguments."""
        return [slot for slot in self.captured if slot not in self._made]

    @property
    def shapes(self) -> dict[Slot, tuple[int, ...]]:
        """Of all tensors."""
        return {slot: tuple(tensor.shape) for slot, tensor in self._seen.values()}

    def _new(self, tensor: Tensor) -> Slot:
        self._seen[id(tensor)] = Slot(next(self._numbers), tensor.dtype), tensor
        return self._seen[id(tensor)][0]

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # True would load PyTorch's compiler, which takes seconds, only to exclude this mode from it

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        args, kwargs = together(func, args, kwargs or {}, self.examples[0].device, self._copy)
        if torch.Tag.nondeterministic_seeded in func.tags and not self.lenient:
            raise self._unfit("one that draws at random", func)
        if torch.Tag.inplace_view in func.tags and (out_of_place := _out_of_place(func)) and self._is_own(args[0]):
            return self._turned(func, out_of_place, args, kwargs)
        if func._schema.is_mutable and not self.lenient:  # all that can be a write into a copy has become one
            if (out_of_place := _out_of_place(func)) and self._is_own(args[0]):  # but those of PyTorch's own functions
                return self._written(func, out_of_place, args, kwargs)
            raise self._unfit("one that writes in place where that can't be followed", func)
        if name_of(func) in OF_SHAPES:
            return func(*args, **kwargs)
        if not _makes_tensors(func):
            if self._follows(args, kwargs):
                raise self._unfit("one that looks at the values of its arguments", func, _Looks)
            self.look(args, kwargs)
            return func(*args, **kwargs)  # a constant's value may be read
        if SHAPED_BY_VALUES in func.tags and self._follows(*_shaping(func, args), kwargs):
            raise self._unfit("one with shapes that depend on the values of its arguments", func, _Looks)
        if SHAPED_BY_VALUES in func.tags:
            self.look(*_shaping(func, args), kwargs)
        if (parts := self._decomposed(func, args, kwargs)) is not NotImplemented:
            return parts
        if name_of(func) == "aten.lift_fresh" and has_own_memory(args[0]):
            self._made.add(self.slot(args[0]))
        inputs, options = mapped_arguments(
            lambda leaf: self.slot(leaf) if isinstance(leaf, Tensor) else leaf, (args, kwargs)
        )
        if not func._schema.returns:  # it raises where values don't suit it, which the function may catch
            self.operations.append(Operation(func, inputs, options, (), self._calls.called, torch.get_default_dtype()))
            return func(*args, **kwargs)
        out = func(*args, **kwargs)
        made = mapped_arguments(lambda leaf: self._new(leaf) if isinstance(leaf, Tensor) else leaf, out)
        operation = Operation(func, inputs, options, made, self._calls.called, torch.get_default_dtype())
        self.operations.append(operation)
        if not self._followers.isdisjoint(operation.inputs):
            self._followers.update(operation.outputs)
        if self._is_outer(args, kwargs):
            self._outer.update(operation.outputs)
        return out

    def _decomposed(self, func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        """The result by operations that are dispatched here in turn; NotImplemented: the operation stays whole."""
        name = name_of(func)
        rule = DECOMPOSITIONS.get(name)
        if rule is not None and self._follows(args, kwargs):
            with self:
                parts = rule(*args, **kwargs)
            if parts is not NotImplemented:
                return parts
        if name in OPERATIONS:
            return NotImplemented
        with self:
            parts = func.decompose(*args, **kwargs)
            # The table takes half a second to load, and an operation that PyTorch computes itself may stay whole.
            if parts is NotImplemented and self._follows(args, kwargs) and func in _decompositions():
                parts = _decompositions()[func](*args, **kwargs)
        return parts

    def _copy(self, tensor: Tensor, device: torch.device) -> Tensor:
        """A captured tensor on the inputs' device, copied by an operation of the recording."""
        slot = self.slot(tensor)
        if slot not in self._brought:
            with self:
                self._brought[slot] = copy_to(tensor, device)
        return self._brought[slot]

    def _is_own(self, tensor: Tensor) -> bool:
        """Whether a recorded operation has made a tensor."""
        slot = self.slot(tensor)
        return slot not in self.captured and slot not in self.inputs

    def _turned(self, func: Any, out_of_place: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Tensor:
        """A tensor whose own shape changes, as a product with a vector does it: recorded as a view of what it was."""
        tensor: Tensor = args[0]
        before, as_it_was = self.slot(tensor), torch.ops.aten.alias(tensor)
        with self:
            view = out_of_place(*args, **kwargs)
        func(*args, **kwargs)
        self._seen[id(as_it_was)] = before, as_it_was
        self._seen[id(tensor)] = self.slot(view), tensor
        return tensor

    def _written(self, func: Any, out_of_place: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Tensor:
        """A tensor that is written in place: from here on it is another one, and what shares its memory is unknown."""
        tensor: Tensor = args[0]
        before, as_it_was = self.slot(tensor), torch.ops.aten.alias(tensor)
        with self:
            after = out_of_place(*args, **kwargs)
        if (after.shape, after.dtype) != (tensor.shape, tensor.dtype):
            raise self._unfit("one that writes in place where that can't be followed", func)
        func(*args, **kwargs)
        self._stale |= {id(other) for _, other in self._seen.values() if overlap(other, tensor)}
        self._stale.discard(id(tensor))
        self._seen[id(as_it_was)] = before, as_it_was
        self._seen[id(tensor)] = self.slot(after), tensor
        return tensor

    def _unfit(self, what: str, operation: Any, kind: type[_Unfit] | None = None) -> _Unfit:
        error = (kind or _Unfit)(f"{what}: {title(operation, self._calls.called)}")
        self.unfit = self.unfit or error
        return error

    def _follows(self, *tree: Any) -> bool:
        """Whether a tensor in `tree` depends on the function's arguments."""
        return any(isinstance(leaf, Tensor) and self.slot(leaf) in self._followers for leaf in leaves(tree))

    def look(self, *tree: Any) -> None:
        """Note that Python code reads values in `tree`, or sees a shape that depends on them."""
        slots = [self.slot(leaf) for leaf in leaves(tree) if isinstance(leaf, Tensor) and self._is_outer(leaf)]
        self.looked |= bool(slots)
        self.read += slots

    def _is_outer(self, *tree: Any) -> bool:
        """Whether a tensor in `tree` depends on one from outside that isn't an argument."""
        slots = (self.slot(leaf) for leaf in leaves(tree) if isinstance(leaf, Tensor))
        return any(slot in self._outer or (slot in self.captured and slot not in self._made) for slot in slots)


class _Unfit(RuntimeError):
    """A function does what a recording can't hold."""


class _Looks(_Unfit):
    """A function's Python code reads the values of its arguments."""


def looks_at_values(function: Callable[..., Tensor], *examples: Tensor) -> bool:
    """Whether Python code or NumPy reads values of tensors that depend on the arguments, to branch on them, say."""
    calls = WithoutReading()
    recording = Recording(examples, calls)
    recording.lenient = True
    try:
        with torch.no_grad(), roots_as_operations(), recording, calls:
            torch.func.functionalize(function, remove="mutations")(*examples)
    except MISTAKES:
        pass
    return isinstance(recording.unfit, _Looks) or calls.refused is not None


class _Reading(TorchDispatchMode):
    """Keeps what Python code reads of tensors, and with which numbers it calls which operations.

    Numbers that are shapes or places aren't kept: two calls may be of other numbers of rows.
    """

    def __init__(self, arguments: Iterable[Any]) -> None:
        super().__init__()
        self.values, self.path = list[Any](), list[Any]()
        self._known = {id(argument): argument for argument in arguments}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        out = func(*args, **kwargs)
        if not _makes_tensors(func):
            self.values.append(out)
        elif SHAPED_BY_VALUES in func.tags:
            self.values.append(tuple(out.shape) if isinstance(out, Tensor) else None)
        kinds = {argument.name: str(argument.type) for argument in func._schema.arguments}
        typed = [*zip(kinds.values(), args, strict=False), *((kinds[name], value) for name, value in kwargs.items())]
        self.path.append((str(func), *(self._number(kind, leaf) for kind, value in typed for leaf in leaves(value))))
        self._known |= {id(leaf): leaf for leaf in leaves(out)}
        return out

    def _number(self, kind: str, leaf: Any) -> Any:
        if isinstance(leaf, Tensor) and id(leaf) not in self._known:
            return leaf.tolist() if leaf.numel() <= READ_NUMBERS else id(leaf)
        return leaf if isinstance(leaf, (bool, float)) or (isinstance(leaf, int) and "int" not in kind) else None

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False


def take_same_branches(call: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Whether Python code reads the same of tensors in two calls (function, *arguments), or then does the same.

    One of the calls may consist of several, one for each knot.
    """
    (values, path), (others, other_path) = _read(*call), _read(*other)
    return (None not in values and _repeat(values, others)) or _repeat(path, other_path)


def _read(function: Callable[..., Tensor], *arguments: Any) -> tuple[list[Any], list[Any]]:
    """What Python code reads, None for what can't be followed; and the operations with numbers that it calls."""
    calls, reading = WithoutReading(), _Reading(arguments)
    with torch.no_grad(), roots_as_operations(), reading, calls:
        function(*arguments)
    return [*reading.values, *(tensor.tolist() for tensor in calls.read)], reading.path


def _repeat(values: list[Any], others: list[Any]) -> bool:
    """Whether one of two lists is the other one, once or several times."""
    few, many = sorted((values, others), key=len)
    return many == len(many) // max(1, len(few)) * few


def record(field: str, function: Callable[..., Tensor], *examples: Tensor) -> Recording:
    """The recorded operations of function(*examples); `field` names the function in errors.

    Raises:
        InputError: the function can't be traced.
    """
    calls = WithoutReading()
    recording = Recording(examples, calls)
    # Writes in place become writes into a copy: PyTorch's part and CasADi's must not share memory.
    pure = torch.func.functionalize(function, remove="mutations")
    try:
        with torch.no_grad(), roots_as_operations(), recording, calls:
            result = pure(*examples)
        if (caught := recording.unfit or calls.refused) is not None:
            raise caught
    except InputError:
        raise  # the function itself says what is wrong
    except Exception as error:  # any error of the function
        message = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise InputError(field, "a function that can be traced", message) from theirs(error)
    if not isinstance(result, Tensor):
        got = f"one that gives no tensor where it is recorded, but {type(result).__name__}"
        raise InputError(field, "a function that can be traced", got)
    recording.looked |= bool(calls.seen)
    recording.look(calls.read)
    recording.result = recording.slot(result)
    if not _is_reproduced(recording, result):
        what = "one that changes the memory of a captured tensor or array while it runs"
        raise InputError(field, "a function that can be traced", what)
    return recording


def replay_all(operations: Iterable[Operation], known: dict[Slot, Any]) -> None:
    """Apply PyTorch's operations in order, each with the default type that it was recorded with."""
    with torch.no_grad():
        for default, group in groupby(operations, key=lambda operation: operation.default):
            usual = torch.get_default_dtype()
            if default is not usual:  # it was changed since
                torch.set_default_dtype(default)
            try:
                for operation in group:
                    operation.replay(known)
            finally:
                if default is not usual:
                    torch.set_default_dtype(usual)


def _is_reproduced(recording: Recording, result: Tensor) -> bool:
    """Whether the recorded operations give the function's result: what they read may have other content by now."""
    known = dict(zip(recording.inputs, recording.examples, strict=True)) | recording.captured
    replay_all((operation for operation in recording.operations if operation.outputs), known)
    again = known[recording.result]
    if not result.is_floating_point():
        return torch.equal(again, result)
    # Not to the last bit, which may depend on where memory lies.
    near, size = torch.finfo(result.dtype).eps ** 0.5, float(result.abs().nan_to_num(0.0, 0.0, 0.0).sum())
    return torch.allclose(again, result, rtol=near, atol=near * size, equal_nan=True)


def title(operation: Any, called: Any) -> str:
    """What the user called, and the operation of PyTorch's that it came to."""
    name = None if called is None else resolve_name(called)
    return f"{name} ({operation})" if name else str(operation)


@cache
def _out_of_place(operation: Any) -> Any:
    """The operation that makes a tensor of what this one does in place; None where there is none."""
    name, overload = name_of(operation).removesuffix("_"), operation._overloadname
    packet = getattr(torch.ops.aten, name.removeprefix("aten."), None)
    variant = getattr(packet, overload, None) if name_of(operation).endswith("_") else None
    return None if variant is None or variant._schema.is_mutable else variant


@cache
def _makes_tensors(operation: Any) -> bool:
    """Whether an operation returns tensors alone; `torch.equal`, say, returns what Python code may branch on."""
    returns = operation._schema.returns
    return all("Tensor" in str(value.type) for value in returns)


def _shaping(operation: Any, args: Sequence[Any]) -> Sequence[Any]:
    """The arguments whose values may decide the result's shape: of an indexed tensor, the masks."""
    if name_of(operation) != "aten.index":
        return args
    return [index for index in args[1] if index is not None and index.dtype in (torch.bool, torch.uint8)]


@cache
def _decompositions() -> dict[Any, Callable]:
    from torch._decomp import core_aten_decompositions, decomposition_table

    # Those of the whole table that aren't made of the primitives of PyTorch's compiler.
    rules = {op: rule for op, rule in decomposition_table.items() if rule.__module__ == "torch._decomp.decompositions"}
    return rules | dict(core_aten_decompositions())


@cache
def name_of(operation: Any) -> str:
    """An ATen operation's name without its overload, as `OPERATIONS` has it."""
    return str(getattr(operation, "overloadpacket", operation))
