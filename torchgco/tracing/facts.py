"""What a function may read, as facts that can be compared: equal facts, and a trace of it still holds.

A function's code reads its arguments, what it closes over, its defaults, globals by name, and attributes of all these.
A walk follows them: numbers and texts are compared by value, code, functions and classes by identity, NumPy arrays by
place and content, tensors by identity, as traces read their numbers again. Whatever a walk can't see through (files,
clocks, random numbers, C extensions, names made at run time) ends it: such a function is traced at every solve.
"""

from __future__ import annotations

import collections
import dis
import functools
import hashlib
import sys
import types
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._device import DeviceContext
from torch.utils._python_dispatch import _get_current_dispatch_mode_stack

from torchgco.base.tree import PerElement

MOST = 50_000  # facts of a problem: with more of them a trace is as quick
FEW = 10_000  # numbers of a tensor of torchgco's own parts that are compared by content
PLAIN = {bool, int, str, bytes, complex, range, torch.dtype, torch.device, *map(type, (None, ..., NotImplemented))}
TENSORS = {Tensor, torch.nn.Parameter}
# Packages whose functions compute by their arguments alone, and whose classes keep what they know in `vars`.
TRUSTED = {
    "torch", "torchgco", "numpy", "math", "cmath", "operator", "builtins", "functools", "itertools", "collections",
    "dataclasses", "enum", "abc", "typing", "types", "copy", "contextlib", "numbers", "string", "warnings",
}  # fmt: skip
APART = "numpy.random", "torch.jit", "torch._C", "torch.hub"  # parts of them that do otherwise
# Names by which these packages' functions read from elsewhere, be it global or an attribute.
ELSEWHERE = {
    "globals", "locals", "eval", "exec", "compile", "open", "input", "breakpoint", "__import__", "__builtins__",
    "__globals__", "random", "rand", "seed", "initial_seed", "load", "loadtxt", "genfromtxt", "fromfile", "from_file",
    "memmap", "hub", "jit", "ctypes",
}  # fmt: skip
BY_NAME = {"getattr", "hasattr", "vars", "dir", "attrgetter", "methodcaller", "__dict__", "__getattribute__"}
BESIDES = {"__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__slots__", "_abc_impl"}
HISTORY = {"grad", "_grad", "grad_fn", "is_leaf", "_version"}
HEAP = 1 << 9  # the flag of classes that a program has made
ABSENT = "absent"


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
        self._tensors: dict[int, Tensor] = {}
        self._memory: list[tuple[int, int]] = []
        try:
            for root in roots:
                self.walk(root)
            self._walk_modules()
            self._walk_histories()
        except (RecursionError, AttributeError, TypeError, ValueError, RuntimeError) as error:
            raise Unseen(str(error)) from error
        self.key = tuple(self._found)
        del self._met, self._passed, self._found

    def know(self, tensor: Tensor) -> bool:
        """Whether the facts would differ if another tensor stood in this one's place."""
        if id(tensor) in self._tensors:
            return True
        return tensor.device.type == "cpu" and any(a <= tensor.data_ptr() < b for a, b in self._memory)

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
        elif kind in _WALKS or not isinstance(thing, (np.generic, Enum, np.ufunc, *_OPERATIONS)):
            if self._first(thing):
                _WALKS.get(kind, Facts._object)(self, thing)
        elif isinstance(thing, np.generic):
            self.note(kind, thing.tobytes())
        else:
            self.same(thing)

    def note(self, *facts: Hashable) -> None:
        self._found.append(facts)
        if len(self._found) > MOST:
            raise Unseen("too much")

    def same(self, thing: Any) -> None:
        """A fact by identity."""
        self.alive.append(thing)
        self.note(id(thing))

    def _first(self, thing: Any) -> bool:
        """Whether the walk comes here for the first time; a fact in itself."""
        place = self._met.setdefault(id(thing), len(self._met))
        self.note(type(thing), place)
        is_new = place == len(self._passed)
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
        self.note(tensor.shape, tensor.stride(), tensor.dtype, tensor.device, tensor.requires_grad)
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
        self.note(first, array.dtype.str, array.shape, array.strides, digest)

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
                self.note(ABSENT)
        self._all((function.__defaults__, function.__kwdefaults__))
        if is_trusted(function.__module__):
            return self.same(function)
        self.same(function.__code__)
        if vars(function):
            self._items(vars(function))
        known = function.__globals__
        usual: Any = known.get("__builtins__", {})
        usual = vars(usual) if isinstance(usual, types.ModuleType) else usual
        code = _code(function.__code__)
        self._names |= code.names
        for name in code.reads:
            if name in known or name in usual:
                self.walk(known[name] if name in known else usual[name])
            else:
                self.note(ABSENT)
        return None

    def _method(self, method: types.MethodType) -> None:
        self._all((method.__func__, method.__self__))

    def _builtin(self, function: types.BuiltinFunctionType) -> None:
        of = function.__self__
        name = of.__name__ if isinstance(of, (type, types.ModuleType)) else ""
        if of is None or isinstance(of, types.ModuleType):
            home = function.__module__ if of is None else name
            # What torch._C has is the functions of torch.
            if not (is_trusted(home) or str(home).startswith("torch._C")) or function.__name__ in ELSEWHERE:
                raise Unseen(function.__name__)
        elif isinstance(of, type):
            if of.__module__.partition(".")[0] not in TRUSTED:
                raise Unseen(function.__name__)
        else:
            self.walk(of)
            return self.note(function.__name__)
        return self.same(function)

    def _descriptor(self, found: Any) -> None:
        if found.__objclass__.__module__.partition(".")[0] not in TRUSTED:
            raise Unseen(found.__name__)
        self.same(found)

    def _partial(self, part: functools.partial) -> None:
        self._all((part.func, part.args, part.keywords, vars(part)))

    def _module(self, module: types.ModuleType) -> None:
        if is_trusted(module.__name__):
            return self.same(module)
        if not _is_python(module.__name__):
            raise Unseen(module.__name__)
        self._modules.append(module)
        return None

    def _walk_modules(self) -> None:
        """What code may read of modules: all attributes whose names it has."""
        done = set[tuple[int, str]]()
        while True:
            pairs = [(module, name) for module in self._modules for name in sorted(self._names)]
            new = [(module, name) for module, name in pairs if (id(module), name) not in done]
            if not new:
                break
            for module, name in new:
                done.add((id(module), name))
                if name in vars(module):
                    self.note(name)
                    self.walk(vars(module)[name])
        if self._names & ELSEWHERE or (self._modules and self._names & BY_NAME):
            raise Unseen(f"one of {sorted(self._names & (ELSEWHERE | BY_NAME))}")

    def _walk_histories(self) -> None:
        """What tensors know of their past, where code may ask for it: it changes without any change of theirs."""
        for name in sorted(HISTORY & self._names):
            for tensor in list(self._tensors.values()):
                value = getattr(tensor, name)
                self.walk(value if type(value) in (bool, int, *TENSORS) else value is None)

    def _class(self, cls: type) -> None:
        """A class by identity, and with its code where it is a user's."""
        if not self._first(cls):
            return
        self.same(cls)
        if is_trusted(cls.__module__) or issubclass(cls, Enum):
            return
        if not is_trusted(type(cls).__module__) or not _is_made(cls):
            raise Unseen(cls.__name__)
        for base in cls.__mro__[1:]:
            self.walk(base)
        for name, value in list(vars(cls).items()):
            special = name.startswith("__") and name.endswith("__") and not isinstance(value, _CODE)
            if name not in BESIDES and not special and not isinstance(value, _SLOTS):
                self.note(name)
                if name == "__repr__":  # that of a dataclass asks for the thread that it runs in
                    value = getattr(value, "__wrapped__", value)
                self.walk(value)

    def _object(self, thing: Any) -> None:
        kind = type(thing)
        self._class(kind)
        is_tuple = isinstance(thing, tuple)
        if any(not _is_made(base) for base in kind.__mro__ if base is not object and not (base is tuple and is_tuple)):
            raise Unseen(kind.__name__)
        if is_tuple:
            self._all(thing)
        of_torchgco = kind.__module__.partition(".")[0] == "torchgco"
        own = {*thing.batched, *thing.per_element} if isinstance(thing, PerElement) else set()
        values = {field.name: getattr(thing, field.name) for field in fields(thing)} if is_dataclass(thing) else {}
        if not of_torchgco or not values:
            slots = [name for base in kind.__mro__ for name, value in vars(base).items() if isinstance(value, _SLOT)]
            filled = {name: getattr(thing, name) for name in slots if hasattr(thing, name)}
            values = filled | dict(getattr(thing, "__dict__", {}))
        self.note(len(values))
        for name, value in values.items():
            self.note(name)
            if name in own:
                self._form(value)
            elif of_torchgco and isinstance(value, Tensor) and value.numel() <= FEW:
                self.note(value.dtype, value.shape, value.detach().cpu().contiguous().numpy().tobytes())
            else:
                self.walk(value)

    def _form(self, value: Any) -> None:
        """What a trace sees of values per problem: a row that all problems share is traced as such."""
        if isinstance(value, tuple):
            self.note(len(value))
            for part in value:
                self._form(part)
        elif isinstance(value, Tensor):
            self.note(value.dtype, value.dim(), value.shape[1:], value.shape[:1] == (1,))
        else:
            self.walk(value)


def _surroundings() -> tuple[Hashable, ...]:
    """What operations of PyTorch depend on besides their arguments."""
    modes = map(torch._C._get_function_stack_at, range(torch._C._len_torch_function_stack()))
    if _get_current_dispatch_mode_stack() or any(type(mode) is not DeviceContext for mode in modes):
        raise Unseen("a mode of PyTorch")
    autocast = torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu")
    return torch.get_default_dtype(), torch.get_default_device(), autocast


def is_trusted(module: str | None) -> bool:
    """Whether the functions of a module compute by their arguments alone."""
    return module is not None and module.partition(".")[0] in TRUSTED and not module.startswith(APART)


@dataclass(frozen=True)
class _Code:
    """What a code object, with those within it, reads by name."""

    code: types.CodeType
    reads: tuple[str, ...]  # globals
    names: frozenset[str]  # these and attributes


_codes: dict[int, _Code] = {}


def _code(code: types.CodeType) -> _Code:
    known = _codes.get(id(code))
    if known is None:
        if len(_codes) > MOST:
            _codes.clear()
        reads, names = dict[str, None](), set(code.co_names)
        for step in dis.get_instructions(code):
            if step.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
                reads[step.argval] = None
            elif step.opname == "IMPORT_NAME" and not is_trusted(step.argval):
                names.add("__import__")
        for inner in code.co_consts:
            if isinstance(inner, types.CodeType):
                within = _code(inner)
                reads |= dict.fromkeys(within.reads)
                names |= within.names
        known = _codes[id(code)] = _Code(code, tuple(reads), frozenset(names))
    return known


@functools.lru_cache(maxsize=4096)
def _is_python(module: str) -> bool:
    """Whether a module is written in Python."""
    found = sys.modules.get(module)
    file = getattr(found, "__file__", None)
    in_c = module in sys.builtin_module_names if file is None else not str(file).endswith((".py", ".pyc"))
    return found is not None and not in_c


@functools.lru_cache(maxsize=4096)
def _is_made(cls: type) -> bool:
    """Whether a class is made by a program in Python: its objects know nothing that `vars` and slots don't have."""
    if not cls.__flags__ & HEAP or not _is_python(cls.__module__):
        return False
    own = (value for value in vars(cls).values() if isinstance(value, _IN_C))
    return not any(value.__objclass__ is cls for value in own)


_OPERATIONS = torch._ops.OpOverload, torch._ops.OpOverloadPacket
_CODE = types.FunctionType, classmethod, staticmethod, property
_IN_C = types.MethodDescriptorType, types.WrapperDescriptorType
_SLOT = types.MemberDescriptorType
_SLOTS = _SLOT, types.GetSetDescriptorType, type(collections.namedtuple("_", "x").x)  # type: ignore[attr-defined]
_WALKS: dict[type, Callable[[Facts, Any], object]] = {
    np.ndarray: Facts._array,
    **dict.fromkeys((dict, OrderedDict, defaultdict, types.MappingProxyType), Facts._items),
    **dict.fromkeys((list, collections.deque), Facts._all),
    **dict.fromkeys((set, frozenset), Facts._set),
    slice: lambda facts, part: facts._all((part.start, part.stop, part.step)),
    types.SimpleNamespace: lambda facts, space: facts._items(vars(space)),
    types.FunctionType: Facts._function,
    types.MethodType: Facts._method,
    types.BuiltinFunctionType: Facts._builtin,
    types.MethodWrapperType: lambda facts, method: facts._all((method.__self__, method.__name__)),
    **dict.fromkeys(
        (types.MethodDescriptorType, types.WrapperDescriptorType, types.ClassMethodDescriptorType), Facts._descriptor
    ),
    **dict.fromkeys((staticmethod, classmethod), lambda facts, method: facts.walk(method.__func__)),
    property: lambda facts, found: facts._all((found.fget, found.fset, found.fdel)),
    functools.cached_property: lambda facts, found: facts.walk(found.func),
    functools.partial: Facts._partial,
    types.ModuleType: Facts._module,
}
