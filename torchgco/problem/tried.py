"""Which of a user's parts have passed the checks of `border`: they aren't tried twice for the same dimensions."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, MutableMapping
from contextlib import suppress
from typing import Any, TypeAlias

from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torchgco.base.memory import trim
from torchgco.base.shapes import Dimensions
from torchgco.base.tree import is_users
from torchgco.obstacles.base import Obstacles
from torchgco.problem.border import check_constraint, check_cost, check_dynamics
from torchgco.problem.distances import check_distances
from torchgco.tracing import CAPTURED, Facts, Unseen

Given: TypeAlias = tuple[Any, Any]  # a part as the user gave it, and bound to a problem
# The parts that have passed, by identity, and for which problems.
_passed: MutableMapping[Any, set[Hashable]] = WeakIdKeyDictionary()
# The same by what their code may read; facts hold what their keys name by identity.
_alike: dict[Hashable, Facts] = {}
ALIKE_KEPT = 64  # parts, the most recent ones


def check_code(
    dims: Dimensions, x0: Tensor, dynamics: Given | None, cost: Given | None, constraints: Iterable[Given]
) -> None:
    """Try what the code of a user's parts does, once for problems of these dimensions.

    A part that has passed isn't tried again, nor is another one that may read the same (`tracing.Facts`): a loop that
    makes a problem per period, of the same objects or of new ones over the same functions, would spend most of its time
    here. What an object's code reads may have changed since, such as captured tensors, attributes, the mode of a
    module, or x0: a mistake that arises so is found later, where the part is traced again (operations that draw at
    random or leave PyTorch, other shapes) or by its result (`certify` compares derivatives). All parts are tried again
    for another number of problems, stages, states or controls, time step, position, dtype or device. Parts without weak
    references are always tried.

    Args:
        x0: the starts (B, n).
        dynamics, cost, constraints: each as the user gave it and bound to the problem; those that are new.

    Raises:
        InputError: as `check_dynamics`, `check_cost`, `check_constraint`, `check_distances`.
    """
    where = dims.position and (dims.position.start, dims.position.stop)
    about = dims.B, dims.N, dims.n, dims.m, dims.dt, where, dims.obstacles_from, x0.dtype, x0.device
    if dynamics is not None:
        _check_once(dynamics, about, lambda bound: check_dynamics(bound, x0, dims.N))
    if cost is not None:
        _check_once(cost, about, lambda bound: check_cost(bound, x0, dims.N, dims.m))
    for i, constraint in enumerate(constraints):
        name = getattr(constraint[1], "name", None)
        field = f"{name}.function" if isinstance(name, str) else f"constraints[{i}].value"
        _check_once(constraint, about, lambda bound, i=i, field=field: _check_row(bound, i, field, x0, dims))


def _check_row(bound: Any, i: int, field: str, x0: Tensor, dims: Dimensions) -> None:
    if isinstance(bound, Obstacles) and is_users(bound.inscribed):
        check_distances(bound.inscribed, f"constraints[{i}]", x0, dims.N)
    check_constraint(bound, field, x0, dims.N, dims.m)


def _check_once(pair: Given, about: Hashable, check: Callable[[Any], None]) -> None:
    if not is_users(pair[1]) and not is_users(getattr(pair[1], "inscribed", pair[1])):
        return
    if not any(part in _passed and about in _passed[part] for part in pair):
        facts = _facts_of(pair[0])
        known = facts is not None and _alike.pop((about, facts.key), None) is not None
        if not known:
            check(pair[1])
        if facts is not None:
            _alike[about, facts.key] = facts  # the most recent one is the last
            trim(_alike, ALIKE_KEPT, CAPTURED, lambda kept: kept.nbytes)
    for part in pair:
        with suppress(TypeError):  # no weak reference to it
            _passed.setdefault(part, set()).add(about)


def _facts_of(part: Any) -> Facts | None:
    """What the code of a part may read; None where that can't be seen."""
    try:
        return Facts(part)
    except Unseen:
        return None
