"""Types and ranges of options, written as annotations of dataclass fields and checked in one place.

    @dataclass(frozen=True)
    class Sampler(Checked, named="sampler"):
        samples: Count = 100
        spread: Annotated[float, Above(0, "m")] = 0.25

A bool is no number, 5.0 is no whole number, and a number is finite unless its annotation says `UNBOUNDED`. Annotations
that can't be checked (`Any`, a name that isn't known at run time) admit everything. The library annotated-types has
limits alone: these have units, say themselves in errors, and are checked.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, reduce
from itertools import pairwise
from types import NoneType, UnionType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np
from torch import Tensor

from torchgco.base.errors import InputError, shown


@dataclass(frozen=True)
class Limit:
    """A range of numbers, closed or open at either end, with the unit that the error names."""

    text: str
    low: float = -math.inf
    high: float = math.inf
    open: bool = False

    def holds(self, value: float) -> bool:
        """Whether a number lies in the range."""
        if self.open:
            return self.low < value and (value < self.high or self.high == math.inf)
        return self.low <= value <= self.high


def AtLeast(low: float, unit: str = "") -> Limit:
    return Limit(f"of at least {low:g} {unit}".rstrip(), low=low)


def Above(low: float, unit: str = "") -> Limit:
    return Limit(f"above {low:g} {unit}".rstrip(), low=low, open=True)


def AtMost(high: float, unit: str = "") -> Limit:
    return Limit(f"at most {high:g} {unit}".rstrip(), high=high)


def Below(high: float, unit: str = "") -> Limit:
    return Limit(f"below {high:g} {unit}".rstrip(), high=high, open=True)


def Within(low: float, high: float, unit: str = "") -> Limit:
    return Limit(f"between {low:g} and {high:g} {unit}".rstrip(), low=low, high=high)


class Increasing(Limit):
    """A list whose numbers don't fall."""

    def holds(self, value: Any) -> bool:
        """Whether none is below the one before it."""
        return all(a <= b for a, b in pairwise(value))


LONG_INTEGER = 2**63  # integers from here on don't fit into 64 bits
UNBOUNDED = Limit("or infinity")  # admits infinity, but not NaN
INCREASING = Increasing("in increasing order")

Natural = Annotated[int, AtLeast(0)]
Count = Annotated[int, AtLeast(1)]
Positive = Annotated[float, Above(0)]
NonNegative = Annotated[float, AtLeast(0)]
Share = Annotated[float, Within(0, 1)]
Seconds = Annotated[float, Above(0, "s")]
Meters = Annotated[float, Above(0, "m")]
Extended = Annotated[float, UNBOUNDED]
PositiveOrInfinite = Annotated[float, Above(0), UNBOUNDED]
Seed = Annotated[int, AtLeast(0), AtMost(1e18)]  # the seeds that solvers derive from it fit into 64 bits, too


class Rule(NamedTuple):
    """What a value has to be: the test, and its description for one value and for several."""

    fits: Callable[[Any], bool]
    one: str
    many: str


def check_options(options: Any, prefix: str) -> None:
    """Check every field of a dataclass against its annotation: what `Checked` does, where `__post_init__` does more.

    NumPy's numbers become Python's.

    Raises:
        InputError: `prefix.field`, what the annotation expects, and the value.
    """
    for name, rule in _rules(type(options)):
        value = getattr(options, name)
        if not rule.fits(value):
            object.__setattr__(options, name, _plain(value, rule, f"{prefix}.{name}"))


class Checked:
    """Base of dataclasses: those made with `named`, and their subclasses, are checked with this prefix."""

    _named: ClassVar[str | None] = None

    def __init_subclass__(cls, named: str | None = None, **more: Any) -> None:
        super().__init_subclass__(**more)
        if named is not None:
            cls._named = named

    def __post_init__(self) -> None:
        if self._named is not None:
            check_options(self, self._named)


def check_value(value: Any, kind: Any, field: str) -> Any:
    """A single argument checked against an annotation; as `check_options`."""
    rule = _argument_rule(kind)
    return value if rule is None or rule.fits(value) else _plain(value, rule, field)


def _plain(value: Any, rule: Rule, field: str) -> Any:
    """The Python value of a NumPy number, the float of a long integer where one will do; InputError for all else."""
    if isinstance(value, np.generic) and rule.fits(value.item()):
        return value.item()
    if type(value) is int and abs(value) >= LONG_INTEGER:
        if abs(value) < sys.float_info.max and rule.fits(float(value)):
            return float(value)
        raise InputError(field, f"{rule.one} of 64 bits", shown(value))
    raise InputError(field, rule.one, shown(value))


@cache
def _rules(cls: type) -> tuple[tuple[str, Rule], ...]:
    """The fields of a dataclass that can be checked, with their rules."""
    hints = _hints(cls)
    rules = ((f.name, _rule(hints[f.name])) for f in fields(cls) if f.init and f.name in hints)
    return tuple((name, rule) for name, rule in rules if rule is not None)


def _hints(cls: type) -> dict[str, Any]:
    """The annotations by field, without those of a user's subclass that name what isn't known at run time."""
    unknown: set[str] = set()
    for base in cls.__mro__:
        try:
            hints = get_type_hints(base, include_extras=True)
        except Exception:  # annotations are evaluated: a name under TYPE_CHECKING or of a function raises anything
            unknown |= set(vars(base).get("__annotations__", ()))
        else:
            return {name: hint for name, hint in hints.items() if name not in unknown}
    return {}


def _rule(kind: Any) -> Rule | None:
    """The rule of an annotation; None where it admits everything."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _limited(args[0], [limit for limit in args[1:] if isinstance(limit, Limit)])
    if origin in (Union, UnionType):
        return _either(args)
    if origin is Literal:
        text, types = " or ".join(map(str, args)), {type(word) for word in args}
        return Rule(lambda v: type(v) in types and v in args, text, text)
    if origin in (tuple, list, Sequence):
        return _row(args)
    kind = origin or kind
    if kind in PLAIN_RULES:
        return PLAIN_RULES[kind]
    try:
        isinstance(None, kind)
    except TypeError:  # a protocol that isn't checked at run time, or no class at all
        return None
    if kind is type:
        return None
    # A class in the place of its instance would have the methods of a protocol.
    text = f"of class {kind.__name__}"
    return Rule(lambda v: isinstance(v, kind) and not isinstance(v, type), f"an object {text}", f"objects {text}")


_argument_rule = cache(_rule)  # of the kinds that our own code names


def _limited(kind: Any, limits: list[Limit]) -> Rule | None:
    rule = _rule(kind)
    if rule is None or not limits:
        return rule
    fits, ranges = _is_number if UNBOUNDED in limits else rule.fits, [limit for limit in limits if limit != UNBOUNDED]
    text = " and ".join(limit.text for limit in ranges)
    if UNBOUNDED in limits:
        text = f"{text} {UNBOUNDED.text}".lstrip()
    for limit in ranges:
        fits = _both(fits, limit.holds)
    return Rule(fits, f"{rule.one} {text}", f"{rule.many} {text}")


def _either(kinds: Sequence[Any]) -> Rule | None:
    rules = [_rule(kind) for kind in kinds if kind is not NoneType]
    known = [rule for rule in rules if rule is not None]
    if len(known) < len(rules):
        return None
    joined = reduce(lambda a, b: Rule(_any_of(a.fits, b.fits), f"{a.one} or {b.one}", f"{a.many} or {b.many}"), known)
    if NoneType not in kinds:
        return joined
    return Rule(_any_of(lambda v: v is None, joined.fits), f"{joined.one}, or null", f"{joined.many}, or null")


def _both(first: Callable[[Any], bool], second: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda v: first(v) and second(v)


def _any_of(first: Callable[[Any], bool], second: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda v: first(v) or second(v)


def _row(kinds: Sequence[Any]) -> Rule | None:
    """A sequence: of any length for `tuple[float, ...]` and `Sequence[float]`, else of one item per kind."""
    item, length = _rule(kinds[0]), None if len(kinds) == 1 or kinds[1] is ... else len(kinds)
    if item is None or (length is not None and any(kind != kinds[0] for kind in kinds)):
        return None
    of = item.many if length is None else f"{length} {item.many}"

    def fits(value: Any) -> bool:
        if not isinstance(value, (Sequence, np.ndarray)) or isinstance(value, (str, bytes)):
            return False
        return (length is None or len(value) == length) and all(map(item.fits, value))

    return Rule(fits, f"a list of {of}", f"lists of {of}")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and -LONG_INTEGER < value < LONG_INTEGER


def _is_number(value: Any) -> bool:
    """Infinity included, NaN left out."""
    return (isinstance(value, float) and value == value) or _is_whole(value)


def _is_finite(value: Any) -> bool:
    return (isinstance(value, float) and -math.inf < value < math.inf) or _is_whole(value)


PLAIN_RULES: dict[Any, Rule] = {
    int: Rule(_is_whole, "a whole number", "whole numbers"),
    float: Rule(_is_finite, "a number", "numbers"),
    bool: Rule(lambda v: isinstance(v, bool), "true or false", "true or false"),
    str: Rule(lambda v: isinstance(v, str), "text", "texts"),
    Callable: Rule(callable, "a function", "functions"),
    Tensor: Rule(lambda v: isinstance(v, Tensor), "a tensor", "tensors"),
}


def option_places(part: Any, inside: str = "") -> list[str]:
    """The options of an object and of its parts, such as "passes.paths.num_paths"; parts have fields or keys."""
    values = dict[str, Any]()
    if is_dataclass(part) and not isinstance(part, type):
        values = {field.name: getattr(part, field.name) for field in fields(part) if field.init}
    elif hasattr(part, "keys"):
        rows: Any = part
        values = dict(rows)
    here = {f"{inside}{name}": value for name, value in values.items()}
    return [path for name, value in here.items() for path in (name, *option_places(value, f"{name}."))]
