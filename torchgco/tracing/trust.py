"""Which code computes by its arguments alone, and what other code reads by name."""

from __future__ import annotations

import dis
import functools
import sys
import types
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

MOST_CODES = 50_000  # code objects whose names are kept
# Packages whose functions compute by their arguments alone, and whose classes keep what they know in `vars`.
TRUSTED = {
    "torch", "torchgco", "numpy", "math", "cmath", "operator", "builtins", "functools", "itertools", "collections",
    "dataclasses", "enum", "abc", "typing", "types", "copy", "contextlib", "numbers", "string", "warnings",
}  # fmt: skip
UNTRUSTED_PARTS = "numpy.random", "torch.jit", "torch._C", "torch.hub"  # parts of them that do otherwise
# Names by which these packages' functions read from elsewhere, be it global or an attribute.
ELSEWHERE = {
    "globals", "locals", "eval", "exec", "compile", "open", "input", "breakpoint", "__import__", "__builtins__",
    "__globals__", "random", "rand", "seed", "initial_seed", "load", "loadtxt", "genfromtxt", "fromfile", "from_file",
    "memmap", "hub", "jit", "ctypes", "ops", "backends", "__subclasses__", "__annotations__",
}  # fmt: skip
BY_NAME = {"getattr", "hasattr", "vars", "dir", "attrgetter", "methodcaller", "__dict__", "__getattribute__"}
SURROUNDINGS = {"get_default_dtype", "get_default_device"}  # which facts have of themselves
SETTINGS = "geterr", "geterrcall", "getbufsize"  # those of NumPy that don't begin with get_
OWN_OPERATIONS = "aten", "prims", "prim"  # all others may be of a user's code
HEAP = 1 << 9  # the flag of classes that a program has made


def is_trusted(module: str | None) -> bool:
    """Whether the functions of a module compute by their arguments alone."""
    return module is not None and module.partition(".")[0] in TRUSTED and not module.startswith(UNTRUSTED_PARTS)


def is_library(thing: types.FunctionType | type | types.ModuleType) -> bool:
    """Whether a function, a class or a module is of the trusted packages, whatever it says of itself.

    A user's function may say the module of another one (`functools.wraps`), and a class that of a function of PyTorch's
    which made it of a user's (`register_parametrization`).
    """
    if isinstance(thing, types.ModuleType):
        return is_trusted(thing.__name__) and sys.modules.get(thing.__name__) is thing
    if isinstance(thing, types.FunctionType):
        home = str(thing.__globals__.get("__name__"))
        return is_trusted(home) and getattr(sys.modules.get(home), "__dict__", None) is thing.__globals__
    if not is_trusted(thing.__module__):
        return False
    if not thing.__flags__ & HEAP:
        return True
    named: Any = sys.modules.get(thing.__module__)
    for name in thing.__qualname__.split("."):
        named = getattr(named, "__dict__", {}).get(name)
    return named is thing


def tells_settings(name: str, function: Any) -> bool:
    """Whether a function of the trusted packages, with this name there, returns a setting of the process."""
    if isinstance(function, types.FunctionType) and function.__code__.co_argcount > 0:
        return False
    return (name.startswith("get_") and name not in SURROUNDINGS) or name.endswith("_enabled") or name in SETTINGS


def is_fixed(operation: Any) -> bool:
    """Whether an operation of NumPy's or PyTorch's is written in C, and not made of a user's function."""
    if isinstance(operation, np.ufunc):
        return any(set(kinds) - set("O->") for kinds in operation.types)
    return str(operation).partition(".")[0] in OWN_OPERATIONS


@functools.lru_cache(maxsize=4096)
def is_python(module: str) -> bool:
    """Whether a module is written in Python."""
    loaded = sys.modules.get(module)
    file = getattr(loaded, "__dict__", {}).get("__file__")
    in_c = module in sys.builtin_module_names if file is None else not str(file).endswith((".py", ".pyc"))
    return loaded is not None and not in_c


@functools.lru_cache(maxsize=4096)
def is_made(cls: type) -> bool:
    """Whether a class is made by a program in Python: its objects know nothing that `vars` and slots don't have."""
    if not cls.__flags__ & HEAP or not is_python(cls.__module__):
        return False
    slots = (value for value in vars(cls).values() if isinstance(value, _IN_C))
    return not any(value.__objclass__ is cls for value in slots)


@dataclass(frozen=True)
class Code:
    """What a code object, with those within it, reads by name."""

    code: types.CodeType
    reads: tuple[str, ...]  # globals
    names: frozenset[str]  # these and attributes


def read_by(code: types.CodeType) -> Code:
    """What a code object reads; looked at once for each."""
    known = _codes.get(id(code))
    if known is None:
        if len(_codes) > MOST_CODES:
            _codes.clear()
        reads, names = dict[str, None](), set(code.co_names)
        for step in dis.get_instructions(code):
            if step.opname in ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"):
                reads[step.argval] = None
            elif step.opname == "IMPORT_NAME" and not is_trusted(step.argval):
                names.add("__import__")
        for inner in code.co_consts:
            if isinstance(inner, types.CodeType):
                within = read_by(inner)
                reads |= dict.fromkeys(within.reads)
                names |= within.names
        known = _codes[id(code)] = Code(code, tuple(reads), frozenset(names))
    return known


_codes: dict[int, Code] = {}  # holds the code objects: their identities aren't used again
_IN_C = types.MethodDescriptorType, types.WrapperDescriptorType
OPERATION_TYPES = np.ufunc, torch._ops.OpOverload, torch._ops.OpOverloadPacket
