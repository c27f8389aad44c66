"""Checks of a user's kind of obstacles when a problem is made: its shapes, and distances that agree with each other."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.base.errors import InputError
from torchgco.base.shapes import describe
from torchgco.constraints.base import ADMITTED
from torchgco.obstacles.base import Obstacles
from torchgco.problem.border import called, check_result, ends_of, states_near

SPREADS = (0.1, 1.0, 10.0)  # of the places that are tried about a start p, as shares of 1 + |p|
AS_SIGNED = "lengths in metres as of `signed_distance`, to within `contact_depths`"


def check_distances(obstacles: Obstacles, field: str, x0: Tensor, N: int) -> None:
    """Check a user's obstacles, bound to problems of N stages that start at x0 (B, n), at places about the starts.

    Distances are compared where `signed_distance` gives a number for an obstacle that is there.

    Raises:
        InputError: names the method, what was expected, and what it returned.
    """
    B, K = len(x0), N + 1
    absent = _attribute(obstacles, "absent", field, (B, None), torch.bool)
    shape = (2, K, M := absent.shape[1])
    for name in ("margins", "contact_depths", "sizes"):
        _attribute(obstacles, name, field, (B, M), x0.dtype)
    part, X = obstacles.take(ends_of(x0)), _places(x0, K, obstacles.position)
    p, t = X[..., obstacles.position], torch.arange(K, dtype=x0.dtype, device=x0.device) * (obstacles.dt or 0.0)
    signed = _distances(part, "signed_distance", field, (p, t), shape)
    if M == 0:
        return
    signed = signed.masked_fill(part.absent.unsqueeze(1) | ~torch.isfinite(signed), torch.nan)
    if type(part).segment_clearance is not Obstacles.segment_clearance:
        between = _distances(part, "segment_clearance", field, (p[:, :-1], p[:, 1:]), (2, N, M))
        if not part.moving:
            _check_bounds(part, "segment_clearance", field, between, signed)
    if type(part).measured is not Obstacles.measured:
        _check_measured(part, field, X, signed)
    if part.has_chords:
        _check_grown(part, field, X, t, signed)


def _check_measured(part: Obstacles, field: str, X: Tensor, signed: Tensor) -> None:
    K, M = signed.shape[1:]
    wanted = f"distances at states (2, {K}, {M}), and bounds between them (2, {K - 1}, {M}), in {X.dtype}"
    pair = called(f"{field}.measured", wanted, part.measured, X)
    if not isinstance(pair, tuple) or len(pair) != 2:
        raise InputError(f"{field}.measured", wanted, describe(pair))
    for distances, count in zip(pair, (K, K - 1), strict=True):
        check_result(f"{field}.measured", distances, (2, count, M), X.dtype, wanted)
    off = ~((pair[0] - signed).abs() <= _tolerance(part, signed)) & ~signed.isnan()
    _refuse(f"{field}.measured", AS_SIGNED, off, pair[0], signed)
    _check_bounds(part, "measured", field, pair[1], signed)


def _check_bounds(part: Obstacles, name: str, field: str, between: Tensor, signed: Tensor) -> None:
    """Check that distances (2, K - 1, M) of ways are no larger than those of their ends, (2, K, M)."""
    most = torch.minimum(signed[:, :-1], signed[:, 1:])
    off = ~(between <= most + _tolerance(part, most)) & ~most.isnan()
    _refuse(f"{field}.{name}", f"along a way at most the distances of its ends, {AS_SIGNED}", off, between, most)


def _check_grown(part: Obstacles, field: str, X: Tensor, t: Tensor, signed: Tensor) -> None:
    """Check that larger obstacles have smaller distances, and larger rows."""
    by, U, p = part.contact_depths.amax(-1).clamp(min=ADMITTED), X.new_zeros(2, len(t) - 1, 0), X[..., part.position]
    wanted, known = "the same obstacles with smaller distances, and larger rows", (~signed.isnan()).flatten(1).any(-1)
    larger = called(f"{field}.grown", wanted, part.grown, by)
    measures = {"signed_distance": lambda of: of.signed_distance(p, t), "minus `value`": lambda of: -of.value(X, U)}
    for name, measure in measures.items():
        change = called(f"{field}.grown", wanted, lambda of, m=measure: (m(of) - m(part)).flatten(1), larger)
        wrong = known & ((change > 0).any(-1) | ~((change < 0) | change.isnan()).any(-1))
        if bool(wrong.any()):
            b = int(wrong.nonzero()[0])
            most = float(change[b].nan_to_num(0.0, 0.0, 0.0).amax())
            raise InputError(f"{field}.grown", wanted, f"{name} larger by {most:.4g} if grown by {float(by[b]):.4g} m")


def _attribute(part: Any, name: str, field: str, shape: tuple[int | None, ...], dtype: torch.dtype) -> Tensor:
    size = "M" if shape[1] is None else shape[1]
    wanted = f"({shape[0]}, {size}) in {dtype}, a row per problem and a column per obstacle"
    value = called(f"{field}.{name}", wanted, getattr, part, name)
    check_result(f"{field}.{name}", value, shape, dtype, wanted)
    return value


def _distances(part: Any, name: str, field: str, arguments: Any, shape: tuple[int, ...]) -> Tensor:
    dtype = arguments[0].dtype
    wanted = f"distances {shape} in {dtype} of two problems' M = {shape[2]} (numbers per problem are `batched`)"
    distances = called(f"{field}.{name}", wanted, getattr(part, name), *arguments)
    check_result(f"{field}.{name}", distances, shape, dtype, wanted)
    return distances


def _places(x0: Tensor, K: int, position: slice) -> Tensor:
    """States (2, K, n) of the first and the last problem, whose positions lie about the start, near and far."""
    X = states_near(x0, K)
    p = X[..., position]
    spreads = torch.tensor(SPREADS, dtype=x0.dtype, device=x0.device).repeat(K)[:K].view(-1, 1)
    X[..., position] = p + spreads * (1.0 + p.abs()) * scattered(p)
    return X


def _tolerance(part: Obstacles, distances: Tensor) -> Tensor:
    """By how much distances may differ without contact where the others see none, and rounding."""
    rounding = torch.finfo(distances.dtype).eps ** 0.5 * (1.0 + distances.abs())
    return part.contact_depths.unsqueeze(1) + rounding


def _refuse(field: str, wanted: str, off: Tensor, distances: Tensor, due: Tensor) -> None:
    if bool(off.any()):
        b, k, m = off.nonzero()[0].tolist()
        got = f"{float(distances[b, k, m]):.4g} where that gives {float(due[b, k, m]):.4g} (obstacle {m})"
        raise InputError(field, wanted, got)
