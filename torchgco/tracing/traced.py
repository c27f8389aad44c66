"""A function of PyTorch tensors, recorded once and replayed with CasADi expressions.

PyTorch itself computes the parts that don't depend on the variables: constants once, numbers that all problems share
whenever they are asked for, and a problem's own numbers for each problem. Only the rest needs a counterpart in CasADi.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.base.errors import InputError
from torchgco.base.tree import PerElement
from torchgco.tracing.arrays import NoCounterpart, boxed
from torchgco.tracing.dtypes import replay
from torchgco.tracing.fingerprint import fingerprint
from torchgco.tracing.nets import MOST_WEIGHTS, Call, Nets
from torchgco.tracing.operations import OPERATIONS
from torchgco.tracing.picks import followers, indices, needed, picks_of
from torchgco.tracing.recorder import Operation, Recording, Slot, name_of, record, replay_all
from torchgco.tracing.roots import Equations, Roots

STRUCTURAL = 0.0, 1.0, -1.0  # numbers that change the form of expressions


class Traced:
    """function(index, *variables), where index (1,) int64 selects the problem of the batch.

    Of the other floating tensors that the function reads (it captures them, or they are a module's parameters) the
    numbers stay inputs of the expressions, `shared_numbers`. Where one is 0, 1 or -1 this is part of the form, as a
    matrix's zeros are, except in tensors that need a gradient: those are about to change. Integers and booleans, what
    is made of Python's numbers, and all that is used as an index are constants.

    Args:
        field: the function's name in errors.
        function: tensors in, one tensor out.
        examples: variables of the shapes and types that the function is called with; their numbers don't matter.
        own: tensors, objects that nothing else holds (`base.tree.apart`), that are treated as one problem's own even
            where all problems of the batch share them: the expressions, and with them the last bits, then don't depend
            on the other problems of the batch.

    Attributes:
        looked: whether Python code of the function has read values of tensors, which it may branch on.
        outside: the tensors that it has read, other than its arguments and `own`.
        shared: the `shared_numbers` when it was traced.
        pattern: see `shared_numbers`.
        is_mixed: whether numbers that differ between problems depend on `outside` tensors, too.
        reads_own: whether Python code has read numbers that differ between problems: the trace has those of the first.

    Raises:
        InputError: the function can't be traced (it branches on values of its arguments, say), or holds an operation
            that can't be compiled; the error names it.
    """

    def __init__(
        self, field: str, function: Callable[..., Tensor], *examples: Tensor, own: Sequence[Tensor] = ()
    ) -> None:
        self.field = field
        self._precision = max((example.dtype for example in examples), key=lambda dtype: torch.finfo(dtype).bits)
        self._shapes = [tuple(example.shape) for example in examples]
        index = torch.zeros(1, dtype=torch.int64, device=examples[0].device)
        recording = record(field, function, index, *map(scattered, examples))
        self._index, *self._variables = recording.inputs
        self._result, self._captured = recording.result, recording.captured
        before = self._split(recording)
        places = {id(tensor): i for i, tensor in enumerate(own)}
        self._named = {slot: places[id(tensor)] for slot, tensor in self._captured.items() if id(tensor) in places}
        self._of_one_row = [_one_row(tensor) for tensor in own]
        outer = [slot for slot in recording.outside if slot not in self._named]
        self.looked, self.outside = recording.looked, [self._captured[slot] for slot in outer]
        self._sort(recording, [slot for slot in outer if slot.dtype.is_floating_point], index)
        self._fix(recording, before, followers(self._plain, outer))

    def _split(self, recording: Recording) -> list[Operation]:
        """CasADi's operations, which depend on the variables, and PyTorch's; returns all that come before the former.

        Raises:
            InputError: see the class.
        """
        operations = needed(recording.operations, self._result)
        symbolic = followers(recording.operations, self._variables)
        for operation in recording.operations:
            if not operation.outputs and not symbolic.isdisjoint(operation.inputs):
                what = f"one that fails for some values of its arguments: {operation.title}"
                raise InputError(self.field, "a function that can be traced", what)
        self._symbolic = [op for op in operations if symbolic.issuperset(op.outputs)]
        self._plain = [op for op in operations if not symbolic.issuperset(op.outputs)]
        for operation in self._symbolic:
            if name_of(operation.function) not in OPERATIONS:
                raise _unknown(self.field, operation)
        # Where PyTorch's part ends and CasADi's begins.
        border = dict.fromkeys(slot for op in self._symbolic for slot in op.inputs) | {self._result: None}
        self._border = [slot for slot in border if slot not in symbolic]
        self._indexed = {slot for op in self._plain if self._index in op.inputs for slot in op.inputs}
        return [op for op in recording.operations if op.outputs and not symbolic.issuperset(op.outputs)]

    def _sort(self, recording: Recording, read: list[Slot], index: Tensor) -> None:
        """What is between PyTorch's part and CasADi's: a problem's own numbers, shared ones, weights, and constants.

        Args:
            read: floating tensors that the function has read, other than its arguments and `own`.
            index: of a first problem, (1,).
        """
        varying = followers(self._plain, [self._index, *self._named])
        reached = followers(self._plain, read) - varying
        shared = [slot for slot in self._border if slot in reached and slot.dtype.is_floating_point]
        self._roots = Roots(self._symbolic)
        # A network within an equation is evaluated wherever the equation is: as scalars, with it.
        layered = [] if self._roots else self._symbolic
        self._nets = Nets(layered, recording.shapes, shared, self._result)
        if self._nets.size > MOST_WEIGHTS:
            expected = f"networks of at most {MOST_WEIGHTS} weights in native kernels"
            raise InputError(self.field, expected, self._nets.size)
        computed = self._computed(index)
        self._own = [slot for slot in self._border if slot in varying]
        self._own_shapes = [tuple(computed[slot].shape) for slot in self._own]
        self._shared_shapes = {slot: tuple(computed[slot].shape) for slot in shared if slot not in self._nets.alone}
        constant = {slot: computed[slot] for slot in self._border if slot not in varying and slot not in shared}
        self._constants = {slot: _array(value) for slot, value in constant.items()}
        self._weights = {slot: _array(computed[slot]) for slot in self._nets.alone}
        places = indices(self._symbolic)
        self._replaceable = [slot for slot, a in self._constants.items() if a.dtype == object or slot not in places]
        numbers = [computed[slot] for slot in self._shared_shapes]
        self._numbers = _flat(numbers)
        self.shared = torch.cat((self._numbers, self._nets.numbers(computed, self._numbers.numel())))
        learned = followers(self._plain, [slot for slot in read if self._captured[slot].requires_grad])
        is_learned = np.repeat([slot in learned for slot in self._shared_shapes], [value.numel() for value in numbers])
        self.pattern = _pattern(self._numbers, is_learned)
        if (alike := _earlier(self.field, self.pattern.shape)) is not None:
            self.pattern = np.where(np.isnan(alike.pattern), np.nan, self.pattern)

    def _fix(self, recording: Recording, before: list[Operation], outside: set[Slot]) -> None:
        """What has to stay as it is, or the function is traced again: constants from outside, and what Python has read.

        Of problems' own numbers Python has read a first problem's.

        Args:
            before: all operations that don't depend on the variables.
            outside: what depends on tensors from outside.
        """
        of_problems = followers(before, [self._index, *self._named])
        self.reads_own = not of_problems.isdisjoint(recording.read)
        self.is_mixed = not outside.isdisjoint(self._own)
        kept = [slot for slot in self._constants if slot in outside]
        self._fixed = self._replayed(before, [*kept, *(slot for slot in recording.read if slot not in of_problems)])
        self._again = needed(before, *self._shared_shapes, *self._nets.alone, *self._fixed)

    def _replayed(self, operations: list[Operation], wanted: Sequence[Slot]) -> dict[Slot, Tensor]:
        """What slots hold that depend on no argument, as tensors that nobody changes."""
        known: dict[Slot, Any] = dict(self._captured)
        replay_all(needed(operations, *wanted), known)
        return {slot: known[slot].detach().clone() for slot in wanted}

    @property
    def count(self) -> int:
        """Number of the values that differ from problem to problem."""
        return sum(int(np.prod(shape)) for shape in self._own_shapes)

    @property
    def constants(self) -> np.ndarray:
        """The numbers (c,) that all problems share, except those used as indices."""
        return np.concatenate([np.zeros(0), *(self._constants[s].astype(float).reshape(-1) for s in self._replaceable)])

    def shared_numbers(self) -> Tensor | None:
        """The numbers (s + w,) float64 that all problems share and that the expressions leave open, as they are now;
        the last w are weights of networks.

        `pattern` (s,) has those of them that belong to the expressions' form, NaN for all others. None where such a
        number, an index, what Python code has read, or the shape or type of a tensor has changed: the function is to be
        traced again.
        """
        if not self._shared_shapes and not self._fixed and not self._nets.shapes:
            return self.shared
        known: dict[Slot, Any] = dict(self._captured)
        shapes = (self._shared_shapes | self._nets.shapes).items()
        try:
            replay_all(self._again, known)
            same = all(_is_same(known[slot], then) for slot, then in self._fixed.items())
        except (RuntimeError, IndexError, TypeError, ValueError):  # shapes or types that don't fit each other any more
            return None
        if not same or any((known[s].shape, known[s].dtype) != (torch.Size(shape), s.dtype) for s, shape in shapes):
            return None
        shared, pattern = _flat([known[slot] for slot in self._shared_shapes]), torch.from_numpy(self.pattern)
        same = (shared == pattern) & (shared.signbit() == pattern.signbit())
        if not bool((same | pattern.isnan()).all()):
            return None
        return torch.cat((shared, self._nets.numbers(known, shared.numel())))

    def parameters(self, index: Tensor) -> np.ndarray:
        """The numbers (count,) that differ between problems, for the problem that index (1,) int64 selects."""
        computed = self._computed(index)
        return _flat([computed[slot] for slot in self._own]).numpy()

    def parameters_of(self, index: Tensor) -> Tensor:
        """`parameters` for many problems at once: (B, count) float64 for index (B,) int64, on its device.

        A problem's numbers don't depend on the other problems in `index`.
        """
        if not self._own:
            return torch.zeros(len(index), 0, dtype=torch.float64, device=index.device)
        if self.picks is not None:
            rows = [self._captured[slot].double() for slot in self._named]
            rows = [row.expand(len(index), *row.shape[1:]) if len(row) == 1 else row[index] for row in rows]
            flat = [row.reshape(len(row), math.prod(row.shape[1:])) for row in rows]
            return torch.cat(flat, dim=1)[:, self.picks.to(index.device)].detach()

        def one(i: Tensor) -> Tensor:
            computed = self._computed(i.unsqueeze(0))
            return torch.cat([computed[slot].double().flatten() for slot in self._own]).detach()

        try:
            return torch.func.vmap(one)(index)
        except RuntimeError:  # an operation that vmap can't batch
            return torch.stack([one(i) for i in index])

    @cached_property
    def picks(self) -> Tensor | None:
        """Where each of the `count` numbers stands in a problem's row of its own tensors, (count,) int64.

        These are the ones at the places `named`, in turn. None where a number is computed, or chosen by others.
        """
        own = {slot: self._captured[slot] for slot in self._named}
        operations = needed(self._plain, *self._own)
        return picks_of(operations, own, self._own, self._index, self._captured, self._indexed)

    @property
    def has_roots(self) -> bool:
        """Whether roots of equations are among its operations: only with `calls` it can be replayed."""
        return bool(self._roots)

    @property
    def named(self) -> list[int]:
        """The places of the tensors in `own` that the function reads."""
        return list(self._named.values())

    def rebound(self, own: Sequence[Tensor], B: int) -> Traced | None:
        """The same function of B problems with other tensors in the place of its `own`; None: trace it again.

        A new trace is needed where a row that all problems share, and that isn't indexed, becomes a row per problem.
        """
        if len(own) != len(self._of_one_row):
            return None
        tensors, indexed = [], {self._named[slot] for slot in self._indexed if slot in self._named}
        for i, (tensor, was_row) in enumerate(zip(own, self._of_one_row, strict=True)):
            if was_row and not _one_row(tensor) and i not in indexed:
                return None
            # The row of a single problem stands for all of its repetitions.
            is_spread = _one_row(tensor) and not was_row
            tensors.append(tensor.expand(B, *tensor.shape[1:]) if is_spread else tensor)
        _ = self.picks  # once for all copies
        copy = object.__new__(type(self))
        copy.__dict__.update(self.__dict__)
        copy._captured = self._captured | {slot: tensors[i] for slot, i in self._named.items()}
        return copy

    def forget_values(self) -> None:
        """Let go of the numbers of all problems but the first in `own`: it is `rebound` where others are asked for."""
        rows = {slot: self._captured[slot] for slot in self._named if self._captured[slot].dim() > 0}
        self._captured |= {slot: tensor[:1].clone().expand_as(tensor) for slot, tensor in rows.items()}

    def fingerprint(self) -> str:
        """A hexadecimal digest of the computation of `__call__`, the same in every process, made without CasADi.

        It doesn't depend on the values of the numbers that differ from problem to problem, and of those that all share
        only on the `pattern`.
        """
        variables = dict(zip(self._variables, self._shapes, strict=True))
        own = dict(zip(self._own, self._own_shapes, strict=True))
        shared = self._shared_shapes | self._nets.shapes, self.pattern
        return fingerprint(variables, own, shared, self._constants, self._symbolic, self._result)

    @property
    def kin(self) -> str:
        """A text that functions share which differ in numbers alone, and few others."""
        shapes = self._shapes, self._own_shapes, [*self._shared_shapes.values(), *self._nets.shapes.values()]
        return f"{shapes} {' '.join(name_of(op.function) for op in self._symbolic)}"

    def __call__(
        self,
        parameters: np.ndarray,
        *variables: np.ndarray,
        constants: np.ndarray | None = None,
        shared: np.ndarray | None = None,
        calls: list[Call] | None = None,
    ) -> np.ndarray:
        """The function on arrays of numbers or expressions.

        Args:
            parameters: (count,).
            variables: shaped as the examples.
            constants: (c,), used in place of `self.constants`, which are the default.
            shared: (s,), used in place of the first `shared_numbers` when it was traced, which are the default.
            calls: networks and roots stay whole and are added to it, in order; None: networks are computed like all
                else, with the weights that they had when it was traced.

        Raises:
            InputError: an operation that CasADi has no counterpart for with these arguments.
        """
        known: dict[Slot, Any] = dict(zip(self._variables, variables, strict=True)) | self._constants
        known |= _placed(parameters, dict(zip(self._own, self._own_shapes, strict=True)))
        known |= _placed(self._numbers.numpy().astype(object) if shared is None else shared, self._shared_shapes)
        if constants is not None:
            known |= _placed(constants, {slot: self._constants[slot].shape for slot in self._replaceable})
        if calls is None:
            known |= self._weights
        equations = Equations()
        for net, operation in self._nets.steps(self._symbolic, calls is not None):
            try:
                if net is not None and calls is not None:
                    self._nets.call(net, known, len(self.pattern), self._precision, calls)
                elif calls is not None and operation in self._roots:
                    self._roots.take(operation, known, equations, calls)
                else:
                    replay(operation, known, self._precision)
            except NoCounterpart as error:
                raise _unknown(self.field, operation, str(error)) from None
            except Exception:  # any error of CasADi or NumPy with these arguments
                raise _unknown(self.field, operation) from None
        return boxed(known[self._result])

    def _computed(self, index: Tensor) -> dict[Slot, Any]:
        """PyTorch's part, for one problem."""
        known: dict[Slot, Any] = {self._index: index} | self._captured
        replay_all(self._plain, known)
        return known


@contextmanager
def traced_like(traces: Sequence[Traced]) -> Iterator[None]:
    """What is traced within leaves open the numbers that earlier traces of the same functions left open.

    By itself a number that has become 0 or 1 since then is part of the form, and the form another one, though the
    earlier one computes the same.
    """
    before = _EARLIER.set(list(traces))
    try:
        yield
    finally:
        _EARLIER.reset(before)


_EARLIER: ContextVar[list[Traced]] = ContextVar("earlier")


def _earlier(field: str, shape: tuple[int, ...]) -> Traced | None:
    """The first of the earlier traces that is of this function, each once."""
    left = _EARLIER.get([])
    trace = next((trace for trace in left if trace.field == field and trace.pattern.shape == shape), None)
    if trace is not None:
        left.remove(trace)
    return trace


def _one_row(value: Tensor) -> bool:
    return value.shape[:1] == (1,)


def own_tensors(part: PerElement) -> list[Tensor]:
    """The tensors of a part of a problem, and of parts within it, that may differ from problem to problem."""
    tensors: list[Tensor] = []
    for value in (getattr(part, name) for name in (*part.batched, *part.per_element)):
        for leaf in value if isinstance(value, tuple) else (value,):
            if isinstance(leaf, PerElement):
                tensors += own_tensors(leaf)
            elif isinstance(leaf, Tensor):
                tensors.append(leaf)
    return tensors


def _pattern(numbers: Tensor, learned: np.ndarray) -> np.ndarray:
    """Numbers (s,) where they are structural, and NaN for the others, and for learned ones, (s,) bool."""
    pattern = numbers.numpy().copy()
    structural = (pattern[:, None] == np.array(STRUCTURAL)).any(1) & ~((pattern == 0.0) & np.signbit(pattern))
    pattern[learned.astype(bool) | ~structural] = np.nan
    return pattern


def _is_same(a: Tensor, b: Tensor) -> bool:
    """Whether two tensors have the same shape and numbers, be they NaN."""
    if torch.equal(a, b):
        return True
    known = torch.where(a == b, a, torch.nan) if a.shape == b.shape and a.is_floating_point() else None
    return known is not None and torch.equal(known.isnan(), a.isnan()) and torch.equal(a.isnan(), b.isnan())


def _flat(values: Sequence[Tensor]) -> Tensor:
    """All numbers of some tensors (s,) float64."""
    parts = [value.detach().cpu().to_dense().double().flatten() for value in values]
    return torch.cat([torch.zeros(0, dtype=torch.float64, device="cpu"), *parts])


def _placed(numbers: np.ndarray, shapes: Mapping[Slot, tuple[int, ...]]) -> dict[Slot, np.ndarray]:
    """One array per slot, cut from `numbers` in turn."""
    arrays, start = {}, 0
    for slot, shape in shapes.items():
        size = int(np.prod(shape))
        arrays[slot] = numbers[start : start + size].reshape(shape)
        start += size
    return arrays


def _array(value: Tensor) -> np.ndarray:
    """Floating-point numbers as objects; integers and booleans keep their type, so that they can index."""
    plain = value.detach().cpu().to_dense()
    return plain.double().numpy().astype(object) if value.is_floating_point() else plain.numpy().copy()


def _unknown(field: str, operation: Operation, why: str = "") -> InputError:
    expected = "operations that can be compiled (torchgco.tracing.operations.OPERATIONS lists them)"
    return InputError(field, expected, f"{operation.title}{': ' if why else ''}{why}")
