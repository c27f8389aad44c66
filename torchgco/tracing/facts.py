"""What a function may read, as facts that can be compared: equal facts, and a trace of it still holds.

A function's code reads its arguments, what it closes over, its defaults, globals by name, and attributes of all these.
A walk follows them: numbers and texts are compared by value, code, functions and classes by identity, NumPy arrays by
place and content, tensors by identity, as traces read their numbers again. Whatever a walk can't see through (files,
clocks, random numbers, C extensions, names made at run time) ends it: such a function is traced at every solve.
"""

from __future__ import annotations

import abc
import collections
import functools
import hashlib
import types
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Hashable, Iterable
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.modules.module import _has_any_global_hook
from torch.nn.utils import parametrize
from torch.utils._device import DeviceContext
from torch.utils._python_dispatch import _get_current_dispatch_mode_stack

from torchgco.base.together import Together
from torchgco.base.tree import PerElement
from torchgco.tracing.trust import (
    BY_NAME,
    ELSEWHERE,
    HEAP,
    OPERATION_TYPES,
    is_fixed,
    is_library,
    is_made,
    is_python,
    is_trusted,
    read_by,
    tells_settings,
)

CAPTURED = 1 << 26  # bytes of tensors and arrays, at most, that are held for what was found with them
MOST_FACTS = 50_000  # facts of a problem: with more of them a trace is as quick
COMPARED_NUMBERS = 10_000  # numbers of a tensor of torchgco's own parts that are compared by content
PLAIN = {bool, int, str, bytes, torch.dtype, torch.device, *map(type, (None, ..., NotImplemented))}
TENSORS = {Tensor, torch.nn.Parameter}
# What Python and decorators write into a class; no code reads numbers there.
BESIDES = {
    "__dict__", "__weakref__", "__annotations__", "__slots__", "__orig_bases__", "__parameters__",
    "__dataclass_fields__", "__dataclass_params__", "__objclass__", "__slotnames__",
    "_abc_impl",
}  # fmt: skip
# What tensors know of their past, and what was asked of them: it changes without any change of theirs.
HISTORY = {"grad", "_grad", "grad_fn", "is_leaf", "_version", "retains_grad", "_backward_hooks", "_base"}
NO_ATTRIBUTE = "absent"


class Unseen(Exception):
    """A walk came to what it can't see through."""


class Facts:
    """Facts of what functions, or objects with such, may read.

    Attributes:
        key: equal for equal facts.
        alive: what the key names by identity; while it is held, nothing else gets these identities.

    Raises:
        Unseen: the walk doesn't see all.
    """

    def __init__(self, *roots: Any) -> None:
        self.alive: list[Any] = []
        self._found: list[Hashable] = [*_surroundings()]
        self._met: dict[int, int] = {}
        self._passed: list[Any] = []  # what the walk has met: meanwhile nothing else gets these identities, either
        self._names: set[str] = set()
        self._modules: list[types.ModuleType] = []
        self._libraries: list[Any] = [Tensor]
        self._tensors: dict[int, Tensor] = {}
        self._contents: dict[int, tuple[Tensor, bytes]] = {}
        self._memory: list[tuple[int, int]] = []
        try:
            for root in roots:
                self.walk(root)
            self._walk_modules()
            self._walk_histories()
        except Unseen:
            raise
        except Exception as error:  # of a user's `__getattr__`, say
            raise Unseen(str(error)) from error
        self.key = tuple(self._found)
        del self._met, self._passed, self._found

    def know(self, tensor: Tensor) -> bool:
        """Whether the facts would differ if another tensor stood in this one's place."""
        if id(tensor) in self._tensors or id(tensor) in self._contents:
            return True
        return tensor.device.type == "cpu" and any(a <= tensor.data_ptr() < b for a, b in self._memory)

    @property
    def hold(self) -> bool:
        """Whether the tensors that the key has by content have it still: a trace reads those that it has met."""
        return all(_bytes(tensor) == content for tensor, content in self._contents.values())

    @property
    def nbytes(self) -> int:
        """The size of the tensors and arrays that are held, of sparse ones as if they were dense."""
        sized = (thing for thing in self.alive if isinstance(thing, (Tensor, np.ndarray)))
        return sum(int(np.prod(thing.shape)) * thing.dtype.itemsize for thing in sized)

    def walk(self, thing: Any) -> None:
        kind = type(thing)
        if kind in PLAIN:
            self._found.append((kind, thing))
        elif kind is float:
            self._found.append(thing.hex())
        elif kind in TENSORS:
            self._tensor(thing)
        elif kind is tuple or kind is torch.Size:
            self._all(thing)
        elif isinstance(thing, type):
            self._class(thing)
        elif isinstance(thing, np.generic):
            self._scalar(thing)
        elif isinstance(thing, OPERATION_TYPES):
            if not is_fixed(thing):
                raise Unseen(str(thing))
            self.same(thing)
        elif self._first(thing):
            walk = Facts._member if isinstance(thing, Enum) else _WALKS.get(kind, Facts._object)
            walk(self, thing)

    def note(self, *facts: Hashable) -> None:
        self._found.append(facts)
        if len(self._found) > MOST_FACTS:
            raise Unseen("too much")

    def same(self, thing: Any) -> None:
        """A fact by identity."""
        self.alive.append(thing)
        self._found.append((id(thing),))

    def _first(self, thing: Any) -> bool:
        """Whether the walk comes here for the first time; a fact in itself."""
        index = self._met.setdefault(id(thing), len(self._met))
        self._found.append((type(thing), index))
        is_new = index == len(self._passed)
        if is_new:
            self._passed.append(thing)
        return is_new

    def _all(self, things: Iterable[Any]) -> None:
        things = list(things)
        self.note(tuple, len(things))
        for thing in things:
            self.walk(thing)

    def _tensor(self, tensor: Tensor) -> None:
        self._tensors[id(tensor)] = tensor
        self.same(tensor)
        self.note(tensor.shape, tensor.stride(), tensor.storage_offset())
        self.note(tensor.dtype, tensor.device, tensor.requires_grad)
        if vars(tensor):
            self._items(vars(tensor))

    def _array(self, array: np.ndarray) -> None:
        if array.dtype.hasobject:
            raise Unseen("an array of objects")
        first = array.__array_interface__["data"][0]
        if array.size > 0:
            steps = [(size - 1) * stride for size, stride in zip(array.shape, array.strides, strict=True)]
            low, high = (sum(step for step in steps if (step > 0) == up) for up in (False, True))
            self._memory.append((first + low, first + high + array.itemsize))
        self.same(array)
        digest = hashlib.blake2b(array.tobytes()).digest()
        self.note(first, str(array.dtype), array.shape, array.strides, digest)

    def _scalar(self, number: np.generic) -> None:
        if number.dtype.hasobject:
            raise Unseen("an object in a NumPy scalar")
        self.note(type(number), str(number.dtype), number.tobytes())

    def _items(self, items: Any) -> None:
        self.note(len(items))
        for name, value in list(items.items()):
            self.walk(name)
            self.walk(value)
        if isinstance(items, defaultdict):
            self.walk(items.default_factory)

    def _set(self, items: Iterable[Any]) -> None:
        if any(type(item) not in PLAIN for item in items):
            raise Unseen("a set of objects")
        self.note(*sorted(map(repr, items)))

    def _function(self, function: types.FunctionType) -> None:
        for cell in function.__closure__ or ():
            try:
                self.walk(cell.cell_contents)
            except ValueError:  # not filled yet
                self.note(NO_ATTRIBUTE)
        self._all((function.__defaults__, function.__kwdefaults__))
        self.same(function.__code__)
        if vars(function):
            self._items(vars(function))
        if is_library(function):
            if tells_settings(function.__name__, function):
                raise Unseen(function.__name__)
            return self.same(function)
        self.note(function.__name__, function.__doc__)
        known = function.__globals__
        usual: Any = known.get("__builtins__", {})
        usual = vars(usual) if isinstance(usual, types.ModuleType) else usual
        code = read_by(function.__code__)
        self._names |= code.names
        for name in code.reads:
            if name in known or name in usual:
                self.walk(known[name] if name in known else usual[name])
            else:
                self.note(NO_ATTRIBUTE)
        return None

    def _builtin(self, function: types.BuiltinFunctionType) -> None:
        of = function.__self__
        name = of.__name__ if isinstance(of, (type, types.ModuleType)) else ""
        if of is None or isinstance(of, types.ModuleType):
            home = function.__module__ if of is None else name
            # What torch._C has is the functions of torch.
            by_arguments = is_trusted(home) or str(home).startswith("torch._C")
            if not by_arguments or function.__name__ in ELSEWHERE or tells_settings(function.__name__, function):
                raise Unseen(function.__name__)
        elif isinstance(of, type):
            if not is_trusted(of.__module__) and not of.__module__.startswith("torch._C"):
                raise Unseen(function.__name__)
        else:
            self.walk(of)
            return self.note(function.__name__)
        return self.same(function)

    def _descriptor(self, method: Any) -> None:
        if not is_trusted(method.__objclass__.__module__) and not method.__objclass__.__module__.startswith("torch._C"):
            raise Unseen(method.__name__)
        self.same(method)

    def _module(self, module: types.ModuleType) -> None:
        if is_library(module):
            self._libraries.append(module)
            return self.same(module)
        if not is_python(module.__name__):
            raise Unseen(module.__name__)
        self._modules.append(module)
        return None

    def _walk_modules(self) -> None:
        """What code may read of modules, and of tensors' class: all attributes whose names it has."""
        done = set[tuple[int, str]]()
        while True:
            names = sorted(self._names)
            pairs = [(module, name, False) for module in self._modules for name in (*names, "__getattr__")]
            pairs += [(module, name, True) for module in self._libraries for name in names]
            new = [pair for pair in pairs if (id(pair[0]), pair[1]) not in done]
            if not new:
                break
            for module, name, of_library in new:
                done.add((id(module), name))
                if name in vars(module):
                    self.note(name)
                    self._of_library(name, vars(module)[name]) if of_library else self.walk(vars(module)[name])
        if self._names & ELSEWHERE or (self._modules and self._names & BY_NAME):
            raise Unseen(f"one of {sorted(self._names & (ELSEWHERE | BY_NAME))}")

    def _of_library(self, name: str, value: Any) -> None:
        """What stands under a name in a trusted package, where a program may have put another thing."""
        if tells_settings(name, value):
            raise Unseen(name)
        kind = type(value)
        if isinstance(value, types.ModuleType):
            if is_library(value):
                self._module(value)
        elif (kind is types.FunctionType and not is_library(value)) or kind in PLAIN or kind is float:
            self.walk(value)
        else:
            self.same(value)

    def _walk_histories(self) -> None:
        """What code may ask tensors for that changes without any change of theirs."""
        for name in sorted(HISTORY & self._names):
            for tensor in list(self._tensors.values()):
                value = getattr(tensor, name)
                self.walk(value if type(value) in (bool, int, *TENSORS) else value is None)

    def _class(self, cls: type) -> None:
        """A class by identity, with what stands in it: a program may put other methods there, by names or from afar."""
        if not self._first(cls):
            return
        self.alive.append(cls)
        # Classes that were registered for an abstract one.
        others = len(abc._get_dump(cls)[0]) if "_abc_impl" in vars(cls) else 0  # type: ignore[attr-defined]
        if is_library(cls):
            body = [value for name, value in vars(cls).items() if name not in BESIDES] if cls.__flags__ & HEAP else []
            self.alive += body
            self.note(id(cls), others, *map(id, body))
            for base in cls.__bases__:
                self._class(base)
            return
        self.note(id(cls), others)
        if not is_library(type(cls)) or not is_made(cls):
            raise Unseen(cls.__name__)
        self._all(cls.__mro__[1:])
        self.note(cls.__name__)
        for name, value in list(vars(cls).items()):
            if name not in BESIDES and not isinstance(value, _SLOTS):
                self.note(name)
                if name == "__repr__":  # that of a dataclass asks for the thread that it runs in
                    value = getattr(value, "__wrapped__", value)
                self.walk(value)
        if is_dataclass(cls):
            self._all([dict(field.metadata) for field in fields(cls)])

    def _member(self, member: Enum) -> None:
        self.same(member)
        self._class(type(member))
        self._items(vars(member))

    def _object(self, thing: Any) -> None:
        kind = type(thing)
        self._class(kind)
        is_tuple = isinstance(thing, tuple)
        if any(not is_made(base) for base in kind.__mro__ if base is not object and not (base is tuple and is_tuple)):
            raise Unseen(kind.__name__)
        if is_tuple:
            self._all(thing)
        of_torchgco = kind.__module__.partition(".")[0] == "torchgco"
        varying = {*thing.batched, *thing.per_element} if isinstance(thing, PerElement) else set()
        values = {field.name: getattr(thing, field.name) for field in fields(thing)} if is_dataclass(thing) else {}
        if not of_torchgco or not values:
            slots = [name for base in kind.__mro__ for name, value in vars(base).items() if isinstance(value, _SLOT)]
            filled = {name: getattr(thing, name) for name in slots if hasattr(thing, name)}
            values = filled | dict(getattr(thing, "__dict__", {}))
        self.note(len(values))
        for name, value in values.items():
            self.note(name)
            if name in varying:
                self._form(value)
            elif of_torchgco and isinstance(value, Tensor) and value.numel() <= COMPARED_NUMBERS:
                content = _bytes(value)
                self._contents[id(value)] = value, content
                self.note(value.dtype, value.shape, content)
            else:
                self.walk(value)

    def _form(self, value: Any) -> None:
        """What a trace sees of values per problem: a row that all problems share is traced as such."""
        if isinstance(value, tuple):
            self.note(len(value))
            for member in value:
                self._form(member)
        elif type(value) is dict:
            self._all(value)
            self._form(tuple(value.values()))
        elif isinstance(value, Tensor):
            self.note(value.dtype, value.dim(), value.shape[1:], value.shape[:1] == (1,))
        else:
            self.walk(value)


def _bytes(tensor: Tensor) -> bytes:
    return tensor.detach().cpu().contiguous().numpy().tobytes()


def _surroundings() -> tuple[Hashable, ...]:
    """What operations of PyTorch depend on besides their arguments."""
    modes = map(torch._C._get_function_stack_at, range(torch._C._len_torch_function_stack()))
    others = any(type(mode) is not Together for mode in _get_current_dispatch_mode_stack())
    if others or any(type(mode) is not DeviceContext for mode in modes):
        raise Unseen("a mode of PyTorch")
    if _has_any_global_hook() or parametrize._cache_enabled:
        raise Unseen("hooks of all modules, or parametrizations that are kept")
    autocast = torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu")
    return torch.get_default_dtype(), torch.get_default_device(), autocast


_SLOT = types.MemberDescriptorType
_SLOTS = _SLOT, types.GetSetDescriptorType, type(collections.namedtuple("_", "x").x)  # type: ignore[attr-defined]
_WALKS: dict[type, Callable[[Facts, Any], object]] = {
    np.ndarray: Facts._array,
    **dict.fromkeys((dict, OrderedDict, defaultdict, types.MappingProxyType), Facts._items),
    **dict.fromkeys((list, collections.deque), Facts._all),
    **dict.fromkeys((set, frozenset), Facts._set),
    complex: lambda facts, number: facts.note(number.real.hex(), number.imag.hex()),
    range: lambda facts, span: facts.note(span.start, span.stop, span.step),
    slice: lambda facts, span: facts._all((span.start, span.stop, span.step)),
    types.SimpleNamespace: lambda facts, space: facts._items(vars(space)),
    types.FunctionType: Facts._function,
    types.MethodType: lambda facts, method: facts._all((method.__func__, method.__self__)),
    types.BuiltinFunctionType: Facts._builtin,
    types.MethodWrapperType: lambda facts, method: facts._all((method.__self__, method.__name__)),
    **dict.fromkeys(
        (types.MethodDescriptorType, types.WrapperDescriptorType, types.ClassMethodDescriptorType), Facts._descriptor
    ),
    **dict.fromkeys((staticmethod, classmethod), lambda facts, method: facts.walk(method.__func__)),
    property: lambda facts, accessor: facts._all((accessor.fget, accessor.fset, accessor.fdel)),
    functools.cached_property: lambda facts, accessor: facts.walk(accessor.func),
    functools.partial: lambda facts, call: facts._all((call.func, call.args, call.keywords, vars(call))),
    types.ModuleType: Facts._module,
}
