"""Which kernels serve a problem, one choice and one warning per form: C's where they can, for a GPU too, or PyTorch's.

PyTorch's kernels start hundreds of small operations for each stage: on a GPU a solve takes some hundred times as long
as in C on one core.
"""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from typing import Any

import torch
from torch import Tensor

from torchgco.base.errors import DeviceWarning, InputError
from torchgco.base.gradients import is_forward, nodes
from torchgco.base.memory import trim
from torchgco.base.shapes import CPU, computing_on
from torchgco.base.together import Together
from torchgco.base.tree import PerElement, field_names, mapped
from torchgco.kernels.in_c import NativeKernels
from torchgco.kernels.in_pytorch import Kernels
from torchgco.native.codegen.knot import JoinedKnots
from torchgco.native.compiler import NativeError, find_compiler
from torchgco.native.cuda.compiler import Loaded, available
from torchgco.native.cuda.engine import OnDevice, has_served, working_on
from torchgco.native.cuda.engine import at_once as at_once
from torchgco.native.cuda.engine import current_device as current_device
from torchgco.native.engine import Engine
from torchgco.native.identity import signature
from torchgco.native.interior import begin_interior
from torchgco.problem.border import check_eager
from torchgco.problem.problem import Problem
from torchgco.tracing import CAPTURED, Facts

ENGINES_KEPT = 64  # engines, the most recent ones
ON_DEVICE = "cuda"  # kernels of which some have run on a GPU
CURRENT, OWN = "current", "own tensors"  # what a problem keeps of its solves: see `current`


_uses_native = True


def use_native(on: bool) -> None:
    """Use native kernels where they can be used (the default), or PyTorch's everywhere, in this process.

    Native kernels solve several problems side by side; PyTorch's are the reference for them: the two differ in the last
    bits. What evaluates no function of the problem, as the search for paths, is C in either case. `device.kernels`
    chooses for a study.
    """
    global _uses_native
    _uses_native = on


def native() -> bool:
    """Whether this process uses native kernels where they can be used."""
    return _uses_native


class EagerWarning(UserWarning):
    """Native kernels can't be used for a problem; PyTorch's are, which takes longer."""


def current(problem: Problem) -> Problem:
    """The problem as its parts are now: nothing is kept from an earlier solve but what can't have changed since.

    Every solve begins with this call: the tensors, numbers and modules that a user's code captures may have changed,
    and then code of the same computation alone is kept. While neither they nor the problem's own numbers have changed,
    all stays that was made of them: forms, scales, structures that C reads. Within a solve, subsets and other forms of
    the problem share the kernels of its beginning.
    """
    if problem.known.current:
        return problem
    facts, (then, before) = _standing(problem), problem.derived.get(CURRENT, (None, problem))
    if facts is not None and facts == then and before.known.in_c is not False and _has_code(before):
        return before
    fresh = problem.renewed()
    fresh.known.current, fresh.known.warned = True, problem.known.warned
    if facts is not None:
        problem.derived[CURRENT] = facts, fresh
    return fresh


def _standing(problem: Problem) -> tuple[Hashable, ...] | None:
    """What says whether the numbers of a problem of torchgco's own parts are as they were; None of others.

    Those that it was given are looked at by `Problem.current`; into what it has made of them PyTorch alone writes.
    """
    if problem.given is None:
        return None
    own = problem.derive(OWN, lambda: _own_tensors(problem))
    return None if own is None else (find_compiler(), *(tensor._version for tensor in own))


def _own_tensors(problem: Problem) -> tuple[Tensor, ...] | None:
    """All tensors of a problem; None where a part is of a user's class, which may hold others, or one is of inference
    mode, which counts no writes."""
    parts = problem.dynamics, problem.cost, problem.constraints
    every = nodes((parts, problem.x0, problem.goal, problem.horizon, problem.free_start, problem.time))
    own = [node for node in every if isinstance(node, Tensor)]
    foreign = (isinstance(node, PerElement) and not type(node).__module__.startswith("torchgco.") for node in every)
    return None if any(foreign) or any(tensor.is_inference() for tensor in own) else tuple(own)


def _has_code(problem: Problem) -> bool:
    """Whether functions in the problem's parts, if any, do what they did when its kernels were made, and capture the
    same numbers."""
    known = problem.known
    if not problem.users:
        return True
    if known.code is None or not known.in_c:
        return False
    engine, now = known.in_c.engine, signature(problem)
    if now is None or now.key != known.code.key or not known.code.facts.hold:
        return False
    captured = engine.captured.read()
    return captured is not None and captured.is_same(engine.shared)


def kernels_of(problem: Problem) -> Kernels:
    """The kernels for problems of this form; those in C are compiled at the first call.

    PyTorch's are used on a GPU, in single precision, where the process has chosen them (`use_native`), and where a part
    can't be traced or nothing compiles, which an EagerWarning explains.

    Raises:
        InputError: rows of a knot that read other knots, where the trace alone shows that they do.
    """
    known = problem.known
    if _uses_native and known.in_c is None and problem.x0.dtype == torch.float64 and problem.x0.device.type == "cpu":
        known.in_c = _natively(problem) or False
    if _uses_native and known.in_c:
        return known.in_c
    if known.in_pytorch is None:
        _check_eager(problem)
        known.in_pytorch = Kernels()
    return known.in_pytorch


def serves(problem: Problem) -> bool:
    """Whether C serves problems of this form, on the CPU in float64; no warning says where it doesn't."""
    known = problem.known
    if known.in_c is None:
        try:
            known.in_c = _in_c(problem)
        except (InputError, NativeError):
            known.in_c = False
    return bool(known.in_c)


def _natively(problem: Problem) -> NativeKernels | None:
    try:
        return _in_c(problem)
    except JoinedKnots:
        if not any(constraint.joins_knots for constraint in problem.constraints):
            raise
        return None  # as the user gives them, such rows are only measured: solvers have them in another form
    except (InputError, NativeError) as error:
        _check_eager(problem)
        _warn(problem.known.warned, error)
        return None


def _in_c(problem: Problem) -> NativeKernels:
    warned = problem.known.warned
    return NativeKernels(_engine(problem), lambda error: _warn(warned, error))


def _check_eager(problem: Problem) -> None:
    """Raise InputError for code that PyTorch's kernels can't differentiate, and where they would nest forward mode."""
    if is_forward():
        expected = "kernels in C within forward_ad.dual_level; torch.autograd.functional.jvp serves with others"
        raise InputError("solve", expected, "PyTorch's")
    check_eager(problem.dynamics, problem.cost, problem.constraints, problem.x0, problem.N)


def _warn(warned: set[str], error: Exception) -> None:
    """Say once why PyTorch's kernels are used."""
    reason = str(error).splitlines()[0]
    if reason not in warned:
        warned.add(reason)
        warnings.warn(f"solved by PyTorch's kernels, many times slower: {reason}", EagerWarning, stacklevel=5)


def used(problem: Problem) -> str:
    """The name of the kernels that have worked on problems of this form: `ON_DEVICE` if a GPU has served them, too."""
    if not problem.known.in_c or not native():
        return Kernels.name
    return ON_DEVICE if has_served() else NativeKernels.name


def expect_interior(problem: Problem) -> None:
    """Have the interior point's library compiled beside the first one, where that isn't made yet."""
    problem.known.expects_interior = True


def _engine(problem: Problem) -> Engine:
    """The engine of an earlier solve where nothing that its code depends on has changed, else a new one."""
    before, expects = signature(problem), problem.known.expects_interior
    problem.known.code = None
    ahead = begin_interior if expects else None
    if before is None:
        return Engine(problem, ahead)
    key = before.key, find_compiler()
    known = _engines.pop(key, None)
    if known is not None and known[1].hold and (shared := known[0].captured.read()) is not None:
        _engines[key] = known  # the most recent one is the last
        problem.known.code = before
        engine = known[0].with_shared(shared.copy())
        engine.serve(problem.B, ahead)
        return engine
    engine, after = Engine(problem, ahead), signature(problem)
    # Code that has changed what it reads, a counter for instance, does so at every solve.
    if after is not None and after.key == before.key and after.covers(engine.captured.traces):
        engine.forget_values()
        _engines[key] = engine, after.facts
        problem.known.code = after
        trim(_engines, ENGINES_KEPT, CAPTURED, lambda kept: kept[0].captured.nbytes)
    return engine.with_shared(engine.shared.copy())  # a compiled problem writes into it


_engines: dict[Hashable, tuple[Engine, Facts]] = {}  # the facts hold what their key names by identity


def on_cpu(problem: Problem) -> Problem | None:
    """The problem on the CPU in float64, where it lies on another device and C serves it on the CPU; else None.

    A DeviceWarning says so once in a process. A problem stays where the process has chosen PyTorch's kernels
    (`use_native`), and where code can't be traced on the CPU. What functions hold on its device is read from there.
    """
    device = problem.x0.device
    if device.type == CPU.type or problem.B == 0 or not native():
        return None
    there = _copied(problem)
    with computing_on(CPU), served_by(device, False):
        if not serves(there):
            return None
    global _said
    if not _said and on_device(device) is None:
        _said = True
        told = f"problems on {device} are solved by C on the CPU, with copies: PyTorch's kernels take far longer there"
        warnings.warn(told, DeviceWarning, stacklevel=4)
    return there


def held_on_cpu(problem: Problem) -> Problem:
    """The problem on the CPU: itself, or as `on_cpu` has it.

    Raises:
        InputError: C doesn't serve it there.
    """
    there = problem if problem.x0.device.type == CPU.type else on_cpu(problem)
    if there is None:
        raise InputError("problem", "one on the CPU", str(problem.x0.device))
    return there


@cache
def on_device(device: torch.device) -> OnDevice | None:
    """The kernels of a device; None where it has none, or the extra `cuda` isn't installed."""
    return OnDevice(partial(Loaded, device=device)) if device.type == "cuda" and available() else None


def is_mixed(problem: Problem) -> bool:
    """Whether functions of a problem on the CPU, which C serves, hold tensors of another device."""
    return bool(problem.known.in_c) and problem.known.in_c.engine.captured.is_elsewhere


@contextmanager
def served_by(device: torch.device, mixed: bool) -> Iterator[None]:
    """In this block what iterates on many problems runs on a device, if that has kernels.

    Args:
        mixed: of the problem on the CPU, see `is_mixed`.
    """
    kernels = on_device(device) if native() else None
    with Together(CPU) if mixed else nullcontext(), nullcontext() if kernels is None else working_on(kernels):
        yield


def _copied(problem: Problem) -> Problem:
    """The problem without gradients; what users' functions hold stays where it is, see `base.together`."""
    change = lambda leaf: leaf.detach().to(CPU, torch.float64 if leaf.is_floating_point() else leaf.dtype)
    parts = {name: mapped(getattr(problem, name), change) for name in field_names(type(problem))}
    return problem._with(parts)


def copied_to(tree: Any, like: Tensor) -> Any:
    """The same with every tensor on the device of another, numbers in its precision."""
    change = lambda leaf: leaf.to(like.device, like.dtype if leaf.is_floating_point() else leaf.dtype)
    return mapped(tree, change)


_said = False
