"""Parts bound to a problem, and as their user gave them: from there they are bound again where numbers have changed.

A problem holds numbers alone: solvers, pictures and judges never meet a gradient. Where tensors that it was given ask
for gradients, its parts are bound once more, with gradients recorded, when a solution is to be differentiated.
"""

from __future__ import annotations

import inspect
import zlib
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from numbers import Number
from types import FunctionType
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torchgco.base.errors import InputError, shown
from torchgco.base.gradients import asking, leaves, recording, without_gradients
from torchgco.base.options import check_value
from torchgco.base.shapes import Dimensions, as_states, check_untransformed, describe
from torchgco.base.tree import is_users
from torchgco.constraints.base import Constraint, Sense
from torchgco.costs.base import Cost
from torchgco.dynamics.base import Dynamics
from torchgco.obstacles.base import Obstacles
from torchgco.problem.free_start import moved_inside
from torchgco.problem.goal import Goal, with_goal, without_goal

# A goal that is only stated changes no minimum: where its tensors ask for gradients they are refused when it is bound.
ALONE = FunctionType, slice  # whose objects are equal to themselves alone, or tell all there is to them
GIVEN_PARTS = "dynamics", "cost", "constraints", "x0", "time"


@dataclass(frozen=True)
class Given:
    """The parts of a problem.

    Attributes:
        fields: all of the problem's fields as they were given.
        facts: what tells of their numbers whether they have changed.
        asks: whether a tensor asks for gradients.
        whole, then: what was made of the problem `whole` afterwards, such as a part of its batch.
        renewed: the problem that was bound last, and the facts then; none where nothing has changed.
    """

    fields: Mapping[str, Any]
    facts: tuple[Hashable, ...]
    asks: bool
    whole: Any = None
    then: tuple[Callable[[Any], Any], ...] = ()
    renewed: list[tuple[Any, tuple[Hashable, ...]]] = field(default_factory=list)

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Given:
        """That of a problem's fields; InputError within a transform of torch.func or torch.compile."""
        check_untransformed("Problem")
        asks = bool(asking([fields[name] for name in _live(fields)]))
        return cls(dict(fields), _facts(fields), asks)

    @property
    def numbers(self) -> dict[str, Any]:
        """The fields that hold tensors that ask for gradients, without these."""
        return {name: without_gradients(self.fields[name]) for name in _live(self.fields)} if self.asks else {}

    def followed(self, whole: Any, by: Callable[[Any], Any]) -> Given:
        """The same of what is made of a problem, `whole`."""
        return replace(self, whole=self.whole or whole, then=(*self.then, by), renewed=[])

    def started(self, problem: Any, x0: Tensor, constraints: Sequence[Any], *others: Any) -> Given | None:
        """The same of `problem`, which is of these parts, with other starts, constraints, cost and dynamics."""
        if self.then:  # of a part of its batch
            return None
        stated = without_goal(self.fields["goal"], problem._dimensions(x0), constraints)  # whose row binds itself
        fields = {"x0": x0, "constraints": replaced(stated, problem.constraints, self.fields["constraints"])}
        fields |= {name: part for name, part in zip(("cost", "dynamics"), others, strict=True) if part is not None}
        return Given.of({**self.fields, **fields})

    def current(self, problem: Any) -> Any:
        """`problem`, which is of these parts; bound again where their numbers have changed since."""
        facts = _facts(self.fields)
        if facts == self.facts:
            return problem
        if not self.renewed or self.renewed[0][1] != facts:
            self.renewed[:] = [(self._applied(type(problem)(**self.fields)), facts)]
        return self.renewed[0][0]

    def recorded(self, problem: Any) -> Any:
        """`problem`, which is of these parts, with gradients recorded: its tensors lead to those that were given."""
        whole = self.whole or problem
        with recording():
            x0 = as_states(self.fields["x0"])
            dims = whole._dimensions(x0)
            parts = {name: self.fields[name].bind(dims) for name in ("dynamics", "cost")}
            goal = self.fields["goal"]
            rows = [constraint.bind(dims) for constraint in without_goal(goal, dims, self.fields["constraints"])]
            parts["constraints"] = with_goal(goal, rows, dims)
            if self.fields["time"] is not None:
                parts["time"] = self.fields["time"].bind(dims)
            parts["x0"] = moved_inside(x0, whole.free_start, parts["constraints"])
            return self._applied(whole._with(parts))

    def _applied(self, problem: Any) -> Any:
        """What was made of the problem."""
        for step in self.then:
            problem = step(problem)
        return problem


def _live(fields: Mapping[str, Any]) -> tuple[str, ...]:
    """The fields whose tensors may ask for gradients."""
    goal = fields["goal"]
    return (*GIVEN_PARTS, "goal") if isinstance(goal, Goal) and goal.required is True else GIVEN_PARTS


def place(part: Any, parts: Sequence[Any]) -> int | None:
    """The place of this very part among others; None where it isn't there."""
    return next((i for i, other in enumerate(parts) if other is part), None)


def replaced(parts: Sequence[Any], old: Sequence[Any], new: Sequence[Any]) -> list[Any]:
    """Parts, with those among `old` replaced by those that stand at their places in `new`."""
    places = [place(part, old) for part in parts]
    return [part if index is None else new[index] for part, index in zip(parts, places, strict=True)]


@dataclass(frozen=True, eq=False)
class _Itself:
    """An object that is equal to itself alone; what it holds is looked at elsewhere, or read again."""

    held: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and other.held is self.held

    def __hash__(self) -> int:
        return id(self.held)


def _facts(fields: Mapping[str, Any]) -> tuple[Hashable, ...]:
    """Parts and functions; numbers, how often tensors were written into, and sums over the bytes of tensors and arrays:
    `.data` and NumPy write unseen."""
    parts = fields["constraints"]
    facts: list[Hashable] = [_Itself(row) for row in (parts if isinstance(parts, (list, tuple)) else (parts,))]
    return *facts, *(_Itself(fields[name]) for name in ("dynamics", "cost")), *facts_of(fields)


def facts_of(tree: Any) -> list[Hashable]:
    """What tells whether functions and numbers in nested parts have changed."""
    facts = list[Hashable]()
    for leaf in leaves(tree):
        if isinstance(leaf, Tensor):
            facts.append(0 if leaf.is_inference() else leaf._version)
            plain = type(leaf) in (Tensor, torch.nn.Parameter) and leaf.layout == torch.strided
            if plain and leaf.device.type == "cpu" and leaf.numel() > 0:
                facts.append(_sum(leaf.detach()))
        elif leaf is None or isinstance(leaf, (int, float, str, bytes, Number)) or type(leaf) in ALONE:
            facts.append(leaf)
        elif callable(leaf):
            facts.append(_Itself(leaf))
        elif isinstance(leaf, np.ndarray) or hasattr(leaf, "__array__") or isinstance(leaf, (Collection, memoryview)):
            facts.append(_sum(leaf))
    return facts


def _sum(numbers: Any) -> int | None:
    """A sum over the bytes of numbers; None of other things."""
    try:
        if isinstance(numbers, Tensor):
            array = numbers.numpy()
        else:
            array = np.asarray(list(numbers) if isinstance(numbers, deque) else numbers)
    except (TypeError, ValueError, RuntimeError):
        return None
    return zlib.crc32(np.ascontiguousarray(array).data) if array.dtype.kind in "biuf" else None


Part = TypeVar("Part")
# Of bound parts, by identity, the ones that were given.
_given: MutableMapping[Any, Any] = WeakIdKeyDictionary()
# What a class says of its own fields, which a bound part of another class has no use for.
OF_FIELDS = {"bind", "batched", "per_element"}
# Methods that say what a part is, and those that a class of ours computes beside them from its own fields alone.
SAID = "stage", "terminal", "total", "value", "at", "signed_distance", "field", "step"
COMPUTED = (
    "expand", "scaled", "value", "rows", "accumulate", "violation", "worst", "at", "signed_distance",
    "segment_clearance", "chord_clearance", "jacobians",
)  # fmt: skip
RESERVED = "bare", "body", "has_chords", "inscribed", "kernel", "map"  # names that no user's class may have
INTERFACES = Cost, Constraint, Obstacles, Dynamics  # what these compute, they compute by a part's own methods


def bound(part: Any, dims: Dimensions, field: str, kind: type[Part]) -> Part:
    """The part for one problem, by its own `bind`.

    Raises:
        InputError: `bind` returns another kind of thing, or one of torchgco's own classes that doesn't do what the
            user's class does: a subclass of `QuadraticCost`, say, whose `stage` would never be called. Or a user's
            class has one method of its own and inherits another that doesn't know it, such as `stage` and `expand`. Or
            it has something else by a name that torchgco's class has, such as a number by that of a method.
    """
    by_user = not _is_ours(type(part))
    for name, heir, meant in _shadowed(part) if by_user else ():
        expected = f"another name: by this one {heir} means {meant}"
        raise InputError(f"{field}.{name}", expected, f"one of {type(part).__name__}")
    result = part.bind(dims)
    if not isinstance(result, kind):
        raise InputError(f"{field}.bind", f"a method that returns a {kind.__name__}", describe(result))
    if by_user or is_users(result):
        _check_bound(part, result, field)
    return result


def _check_bound(part: Any, result: Any, field: str) -> None:
    """Raise InputError for what a user's class has bound a part to, as `bound` says."""
    if isinstance(result, Constraint) and is_users(result):
        knots = getattr(result, "knots", None)
        if not isinstance(knots, slice) and not (isinstance(knots, Tensor) and knots.dtype == torch.int64):
            raise InputError(f"{field}.knots", "a slice or an int64 tensor (K,), which `bind` sets", shown(knots))
        check_value(result.sense, Sense, f"{field}.sense")
    for name in _lost(part, result):
        expected = f"a class whose own methods are called: {type(result).__name__} takes its place"
        raise InputError(f"{field}.{name}", expected, f"one of {type(part).__name__}")
    for users, name, heir in _torn(result):
        expected = f"a method of {type(result).__name__}, which has a `{users}` of its own, or a class without {heir}'s"
        raise InputError(f"{field}.{name}", expected, f"the one of {heir}, which doesn't call this `{users}`")


def remember(pairs: Iterable[tuple[Any, Any]]) -> None:
    """Keep what was given with each bound part, for `as_given`."""
    for part, result in pairs:
        if result is not part:
            with suppress(TypeError):  # no weak reference to it
                _given[result] = part


def as_given(fields: Mapping[str, Any]) -> dict[str, Any]:
    """A problem's fields with the parts that were given in place of ones that are bound to another problem.

    These have that one's knots, numbers and shapes: with another N, say, they would be other constraints.
    """
    parts, rows = {name: _origin(fields[name]) for name in ("dynamics", "cost")}, fields["constraints"]
    if isinstance(rows, list | tuple) and any(_origin(row) is not row for row in rows):
        parts["constraints"] = [_origin(row) for row in rows]
    return {**fields, **parts}


def _origin(part: Any) -> Any:
    """What was given where `part` is bound; itself elsewhere."""
    with suppress(TypeError):  # no weak reference to it
        return _given.get(part, part)
    return part


def _lost(part: Any, result: Any) -> Iterator[str]:
    """Names that a user's class redefines and that are other ones in the class of what its `bind` returned."""
    inner = result.inscribed if isinstance(result, Obstacles) else result  # a body's balls meet obstacles of the class
    if isinstance(inner, type(part)) or not _is_ours(type(result)):
        return
    values = {field.name for field in fields(part)} if is_dataclass(part) else set[str]()
    for cls in type(part).__mro__:
        if _is_ours(cls):
            return
        for name, value in vars(cls).items():
            if name.startswith("__") or name in OF_FIELDS or name in values:
                continue
            if hasattr(type(result), name) and getattr(type(result), name) is not value:
                yield name


def _shadowed(part: Any) -> Iterator[tuple[str, str, str]]:
    """Names of a user's class by which one of ours means something else: this class, and what it means."""
    line = type(part).__mro__
    named = {name: None for cls in line if not _is_ours(cls) for name in (*vars(cls), *inspect.get_annotations(cls))}
    for name in named:
        ours = next((cls for cls in line if _is_ours(cls) and name in vars(cls)), None)
        if ours is None or name.startswith("_"):
            continue
        if name in RESERVED:
            yield name, ours.__name__, "something of its own"
        meant, used = vars(ours)[name], inspect.getattr_static(part, name)
        if meant is not None and _is_method(meant) != _is_method(used):
            yield name, ours.__name__, "a method" if _is_method(meant) else "a property or a value"


def _is_method(value: object) -> bool:
    return callable(value) or isinstance(value, (staticmethod, classmethod))


def _torn(result: Any) -> Iterator[tuple[str, str, str]]:
    """A user's own method, one that is inherited from a class of ours and computes without it, and this class."""
    if _is_ours(type(result)):
        return
    line = type(result).__mro__
    for name in COMPUTED:
        index = next((i for i, cls in enumerate(line) if name in vars(cls)), None)
        unused = name == "at" and isinstance(result, Constraint) and not result.geometric
        unused |= name == "rows" and getattr(type(result), "value", None) is not Obstacles.value
        if index is None or unused or line[index] in INTERFACES or not _is_ours(line[index]):
            continue
        users = [cls for cls in line[:index] if not _is_ours(cls)]
        method = next((method for method in SAID if method != name and any(method in vars(cls) for cls in users)), None)
        if method is not None:
            yield method, name, line[index].__name__


def _is_ours(cls: type) -> bool:
    return cls.__module__.partition(".")[0] == "torchgco"
