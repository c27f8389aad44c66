"""A user's kind of obstacles is checked when a problem is made: shapes, distances by separate code, growth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch
from torchgco import Body, Constraint, InputError, Problem
from torchgco.base.shapes import Dimensions
from torchgco.obstacles import Obstacles
from torchgco.obstacles.measured import segment_distance

D = torch.float64


@dataclass(frozen=True)
class Discs(Obstacles):
    """Two discs per problem, of which the second one may be absent."""

    centers: Tensor  # (B, 2, 2), m
    radii: Tensor  # (B, 2), m
    absent: Tensor  # (B, 2) bool
    vehicle_radius: Any  # (B,), m; or a `Body`
    knots: Any = None
    position: Any = None
    dt: Any = 0.0
    batched = ("centers", "radii", "absent", "vehicle_radius")
    margins = property(lambda self: self.radii + self.vehicle_radius.unsqueeze(-1))  # type: ignore[assignment]

    def bind(self, dims: Dimensions) -> Constraint:
        if isinstance(self.vehicle_radius, Body):
            return self.vehicle_radius.around(self, dims)
        return replace(self, knots=slice(1, dims.N + 1), position=dims.position, dt=dims.dt)

    def grown(self, by: Tensor) -> Self:
        return replace(self, vehicle_radius=self.vehicle_radius + by)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        away = p.unsqueeze(2) - self.centers.unsqueeze(1)
        return (away.square().sum(-1) + 1e-12).sqrt() - self.margins.unsqueeze(1)

    def segment_clearance(self, a: Tensor, b: Tensor) -> Tensor:
        centers = self.centers.unsqueeze(1)
        return segment_distance(a.unsqueeze(2) - centers, b.unsqueeze(2) - centers) - self.margins.unsqueeze(1)

    def measured(self, X: Tensor) -> tuple[Tensor, Tensor]:
        p = X[..., self.position]
        ends = torch.cdist(p, self.centers) - self.margins.unsqueeze(1)
        step = p.diff(dim=1).norm(dim=-1, keepdim=True)
        return ends, 0.5 * (ends[:, :-1] + ends[:, 1:] - step)


def made(kind: type[Discs], **changes: Any) -> Problem:
    base, _ = planar_batch(B=3, N=6, obstacles=1)
    centers = torch.tensor([[[2.0, 0.1], [3.0, -1.0]]], dtype=D).expand(3, 2, 2).contiguous()
    absent = torch.tensor([[False, False], [False, False], [False, True]])
    numbers = {"centers": centers, "radii": torch.full((3, 2), 0.4, dtype=D), "absent": absent}
    discs = kind(**(numbers | {"vehicle_radius": torch.full((3,), 0.1, dtype=D)} | changes))
    return Problem(base.dynamics, base.cost, [discs], base.x0, 6)


def other(**methods: Any) -> type[Discs]:
    return dataclass(frozen=True)(type("Own", (Discs,), methods))


signed, segment, measured, value = Discs.signed_distance, Discs.segment_clearance, Discs.measured, Discs.value
upright = lambda x: torch.eye(2, dtype=D).expand(*x.shape[:-1], 2, 2)
WRONG: dict[str, tuple[str, str, Callable[[], Problem]]] = {
    "nothing grows": ("Own.grown", "got none", lambda: made(other(grown=Obstacles.grown))),
    "smaller": (
        "constraints[0].grown",
        "signed_distance larger by 0.025 if grown by 0.025 m",
        lambda: made(other(grown=lambda self, by: replace(self, vehicle_radius=self.vehicle_radius - by))),
    ),
    "the same": ("constraints[0].grown", "larger by 0 ", lambda: made(other(grown=lambda self, by: self))),
    "one problem alone": (
        "constraints[0].grown",
        "larger by 0 ",
        lambda: made(other(grown=lambda self, by: replace(self, radii=self.radii + by[0] * (self.radii == 0.4))),
                     radii=torch.tensor([[0.4, 0.4], [0.4, 0.4], [0.3, 0.3]], dtype=D)),
    ),
    "rows that stay": (
        "constraints[0].grown",
        "minus `value` larger by 0 ",
        lambda: made(other(rows=lambda self, p, t: -torch.cdist(p, self.centers))),
    ),
    "one column": (
        "constraints[0].signed_distance",
        r"\(2, 7, 1\) instead of \(2, 7, 2\)",
        lambda: made(other(signed_distance=lambda self, p, t: signed(self, p, t)[..., :1])),
    ),
    "no columns": (
        "constraints[0].segment_clearance",
        r"\(2, 6\) instead of \(2, 6, 2\)",
        lambda: made(other(segment_clearance=lambda self, a, b: segment(self, a, b)[..., 0])),
    ),
    "a segment's radius": (
        "constraints[0].segment_clearance",
        "along a way at most",
        lambda: made(other(segment_clearance=lambda self, a, b: segment(self, a, b) + 0.1)),
    ),
    "all knots": (
        "constraints[0].measured",
        r"\(2, 7, 2\) instead of \(2, 6, 2\)",
        lambda: made(other(measured=lambda self, X: (measured(self, X)[0], measured(self, X)[0]))),
    ),
    "one tensor": (
        "constraints[0].measured",
        r"two|bounds between them \(2, 6, 2\)",
        lambda: made(other(measured=lambda self, X: measured(self, X)[0])),
    ),
    "no numbers": (
        "constraints[0].measured",
        "got nan where that gives",
        lambda: made(other(measured=lambda self, X: tuple(torch.nan * d for d in measured(self, X)))),
    ),
    "no numbers between": (
        "constraints[0].measured",
        "got nan where that gives",
        lambda: made(other(measured=lambda self, X: (measured(self, X)[0], torch.nan * measured(self, X)[1]))),
    ),
    "the radius": (
        "constraints[0].measured",
        "as of `signed_distance`",
        lambda: made(other(measured=lambda self, X: tuple(d + 0.1 for d in measured(self, X)))),
    ),
    "the radius between": (
        "constraints[0].measured",
        "along a way at most",
        lambda: made(other(measured=lambda self, X: (measured(self, X)[0], measured(self, X)[1] + 20.0))),
    ),
    "lengths per problem": (
        "constraints[0].margins",
        r"\(3, 2\) .* got torch.float64 \(3,\)",
        lambda: made(other(margins=property(lambda self: self.vehicle_radius))),
    ),
    "numbers for absent": (
        "constraints[0].absent",
        "got torch.float64",
        lambda: made(Discs, absent=torch.zeros(3, 2, dtype=D)),
    ),
    "a body's": (
        "constraints[0].measured",
        "as of `signed_distance`",
        lambda: made(
            other(measured=lambda self, X: tuple(d + 0.1 for d in measured(self, X))),
            vehicle_radius=Body([[0.1, 0.0], [-0.1, 0.0]], 0.1, upright),
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_in_a_kind_of_obstacles_is_named(mistake: str) -> None:
    field, words, make = WRONG[mistake]
    with pytest.raises(InputError, match=words) as told:
        make()
    assert told.value.field == field


def test_what_agrees_is_taken() -> None:
    made(Discs)
    nan = torch.tensor([[0.4, 0.4], [0.4, 0.4], [torch.nan, torch.nan]], dtype=D)
    made(Discs, radii=nan)  # one bad problem of a batch: a status, not an error
    made(Discs, absent=torch.tensor([[True, True]] * 3))
    loose = other(measured=lambda self, X: (measured(self, X)[0], measured(self, X)[1] - 0.2))
    made(loose)  # bounds between knots may be low
    unchorded = other(segment_clearance=Obstacles.segment_clearance, grown=Obstacles.grown)
    made(unchorded)  # nothing between knots is repaired


@pytest.mark.parametrize("sense", ["<=", "equals", None])
def test_a_sense_that_is_none_is_refused(sense: Any) -> None:
    with pytest.raises(InputError, match="expected inequality or equality") as told:
        made(other(sense=sense))
    assert told.value.field == "constraints[0].sense"


@pytest.mark.parametrize(
    ("methods", "words"),
    [
        ({"rows": lambda self, p, t: signed(self, p, t)[..., 0] * SINGLE}, "instead of"),
        ({"rows": lambda self, p, t: signed(self, p, t) + torch.zeros(3, 1, 2, dtype=D) * SINGLE}, "size of tensor"),
        ({"rows": lambda self, p, t: p @ torch.eye(2)}, r"torch.float32 \(2, 2\) beside torch.float64"),
    ],
)
def test_a_mix_of_types_is_named_only_where_it_fails(methods: dict[str, Any], words: str) -> None:
    """A float32 number beside a float64 tensor is no mistake, and not the reason of another one."""
    kind = other(grown=lambda self, by: self, segment_clearance=Obstacles.segment_clearance, **methods)
    with pytest.raises(InputError, match=words) as told:
        made(kind)
    assert told.value.field == "constraints[0].value" and ("float32" in str(told.value)) == ("beside" in words)


SINGLE = torch.ones(1)
