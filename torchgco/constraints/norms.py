"""Bounds on the norm of states or controls, and cones that vectors or attitudes stay within."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import (
    Check,
    Number,
    above_zero_or_infinite,
    angles,
    crossed,
    directions,
    finite,
    lengths,
    numbers,
)
from torchgco.base.shapes import Dimensions, bound_of, check_finite, tensor
from torchgco.constraints.base import NO_ROW, Constraint, count_of, resolve_knots, whole
from torchgco.costs.base import add_blocks

# Length of a vector, in its units, at which a cone's row is smooth, too: smaller ones cost the interior point hundreds
# of iterations where a vector ends at the tip, as the way to a landing site does.
TIP = 1e-4
OF_ATTITUDE = "quaternion"


@dataclass(frozen=True)
class Vectors(Constraint):
    """A constraint on some components of the state, or of the control, at a knot."""

    components: Tensor | None = field(default=None, repr=False, kw_only=True)  # (c,) int64, once bound

    in_place: ClassVar[bool] = True
    label: ClassVar[str]  # in errors

    def _vectors(self, X: Tensor, U: Tensor) -> Tensor:
        """The components (B, K, c)."""
        return (X if self.of == "x" else U)[:, self.knots][..., self.components]  # type: ignore[attr-defined]

    def accumulate(self, X: Tensor, U: Tensor, g: Tensor, h: Tensor, H: Tensor) -> None:
        J = torch.zeros(*g.shape, (X if self.of == "x" else U).shape[-1], dtype=H.dtype, device=H.device)  # type: ignore[attr-defined]
        J[..., self.components] = self._slopes(X, U)
        gradient, curvature = (g.unsqueeze(-2) @ J).squeeze(-2), J.mT @ (h.unsqueeze(-1) * J)
        add = H.new_zeros(*g.shape[:2], *H.shape[2:])
        x, u = ((gradient, curvature), (None, None)) if self.of == "x" else ((None, None), (gradient, curvature))  # type: ignore[attr-defined]
        add_blocks(add, X.shape[-1], x[0], u[0], x[1], u[1])
        H[:, self.knots] += add

    def numbers(self, where: str, index: int) -> list[Number]:
        checks: dict[str, Check] = {
            "lower": lengths, "upper": above_zero_or_infinite, "center": finite, "apex": finite, "angle": angles,
            "axis": directions,
        }  # fmt: skip
        both = all(getattr(self, side, None) is not None for side in ("lower", "upper"))
        joint = crossed(self, where, np.greater_equal, "lower bounds below the upper ones") if both else None
        tensors = {field: getattr(self, field) for field in self.per_element if field in checks}
        fields = {field: (tensor, checks[field]) for field, tensor in tensors.items() if tensor is not None}
        return numbers(where, fields, index, joint=joint)

    def _components_told(self) -> str:
        places = ", ".join(map(str, self.components.tolist()))  # type: ignore[union-attr]
        return f"{'controls' if self.of == 'u' else 'states'} {places}"  # type: ignore[attr-defined]

    def _slopes(self, X: Tensor, U: Tensor) -> Tensor:
        """The derivatives (B, K, p, c) of the rows by the components."""
        raise NotImplementedError


@dataclass(frozen=True)
class NormBounds(Vectors):
    """lower <= |z - center| <= upper, with z some states or some controls of a knot.

        speed = NormBounds(("x", [3, 4, 5]), upper=5.0)  # m/s
        thrust = NormBounds("u", lower=4.0, upper=12.0)  # N: a thrust annulus

    Rows are (|z - center|^2 - upper^2) / (2 upper) and (lower^2 - |z - center|^2) / (2 lower): smooth everywhere, and
    near the bound as large as the distance to it. The second has no slope at the centre: a guess should lie elsewhere.

    Args:
        of: "x" or "u", all components; or a pair of that and which: ("x", [3, 4, 5]), ("u", range(3)), a slice.
        lower, upper: numbers in the units of z: one for all, (B,), or per knot (B|1, K) with a column for each of the K
            `knots` in their order; None, a lower bound of 0 or an upper one of infinity: no bound.
        knots: default 1..N for states (x_0 is given), 0..N-1 for controls.
        center: (c,), (B, c) or per knot (B|1, K, c); None: 0.

    Raises:
        InputError: on `Problem(...)`: components that the model doesn't have or that are given twice; bounds of another
            shape, NaN, negative, crossed, an upper bound of 0, or none; a centre that isn't finite.
    """

    of: Any
    lower: Any = None
    upper: Any = None
    knots: Any = None
    center: Any = None

    per_element: ClassVar[tuple[str, ...]] = ("lower", "upper", "center")
    label: ClassVar[str] = "norm_bounds"

    def bind(self, dims: Dimensions) -> Self:
        name = self.label
        kind, components = _chosen(self.of, self.components, ("x", "u"), dims, f"{name}.of")
        knots, K = _knots(self.knots, kind, dims, f"{name}.knots")
        lower, upper = (
            None if value is None else _per_knot(bound_of(value, none), f"{name}.{side}", dims, K)
            for side, value, none in (("lower", self.lower, 0.0), ("upper", self.upper, math.inf))
        )
        if lower is not None and not bool((torch.isfinite(lower) & (lower >= 0)).all()):
            raise InputError(f"{name}.lower", "finite numbers of at least 0", lower.tolist())
        if upper is not None and not bool((upper > 0).all()):
            raise InputError(f"{name}.upper", "numbers above 0, or infinity", upper.tolist())
        if lower is not None and upper is not None and not bool((lower < upper).all()):
            raise InputError(f"{name}.lower", "less than the upper bound", f"{lower.tolist()} and {upper.tolist()}")
        # A side that bounds no problem has no rows.
        lower = None if lower is None or not bool((lower > 0).any()) else lower
        upper = None if upper is None or not bool(torch.isfinite(upper).any()) else upper
        if lower is None and upper is None:
            raise InputError(name, "a lower bound above 0 or a finite upper bound", "neither")
        center = None if self.center is None else _points(self.center, f"{name}.center", dims, K, len(components))
        return replace(self, of=kind, components=components, knots=knots, lower=lower, upper=upper, center=center)

    def _away(self, X: Tensor, U: Tensor) -> Tensor:
        z = self._vectors(X, U)
        return z if self.center is None else z - self.center

    def _sides(self) -> list[tuple[float, Tensor, Tensor]]:
        """Of the upper and the lower bounds that there are: +-1, the bounds (B|1, K|1) or 1, where there are any."""
        sides = []
        for sign, bound in ((1.0, self.upper), (-1.0, self.lower)):
            if bound is not None:
                there = torch.isfinite(bound) & (bound > 0)
                sides.append((sign, torch.where(there, bound, 1.0), there.to(bound)))
        return sides

    @property
    def sides(self) -> list[str]:
        """Of which bound each row is."""
        return [side for side in ("upper", "lower") if getattr(self, side) is not None]

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"{self.sides[row]} bound of the norm of {self._components_told()}"

    @property
    def row_radii(self) -> Tensor:
        rows = [sign * bound for sign, bound, _ in self._sides()]
        return torch.stack(torch.broadcast_tensors(*rows), dim=-1)

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        square, rows = self._away(X, U).square().sum(-1), []
        for sign, bound, there in self._sides():
            rows.append(sign * there / (2.0 * bound) * (square - bound.square()) + (1.0 - there) * NO_ROW)
        return torch.stack(rows, dim=-1)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """By how much the norm is beyond each bound, in the units of z, (B, K, p)."""
        size = self._away(X, U).norm(dim=-1)
        rows = [there * (sign * (size - bound)).clamp(min=0.0) for sign, bound, there in self._sides()]
        return torch.stack(rows, dim=-1)

    def moved_inside(self, U: Tensor) -> Tensor:
        """The vectors (B, K, c) of controls U, those beyond a bound with the size in the middle of both.

        One in the centre goes along the diagonal; where there is one bound alone, its double or its half is the size.
        """
        away, center = self._away(U, U), 0.0 if self.center is None else self.center
        size = away.norm(dim=-1, keepdim=True)
        direction = torch.where(size > 0, normalize(away, dim=-1), away.shape[-1] ** -0.5)
        least = size.new_zeros(1, 1) if self.lower is None else self.lower
        most = size.new_full((1, 1), torch.inf) if self.upper is None else self.upper
        middle = torch.where(torch.isfinite(most), 0.5 * (least + most), 2.0 * least).unsqueeze(-1)
        beyond = (size < least.unsqueeze(-1)) | (size > most.unsqueeze(-1))
        return torch.where(beyond, center + middle * direction, self._vectors(U, U))

    def _slopes(self, X: Tensor, U: Tensor) -> Tensor:
        away = self._away(X, U)
        return torch.stack([(sign * there / bound).unsqueeze(-1) * away for sign, bound, there in self._sides()], -2)


@dataclass(frozen=True)
class Cone(Vectors):
    """A vector stays within `angle` of an axis: |v| cos(angle) <= axis . v.

        tilt = Cone([0, 0, 1], math.radians(30), ("quaternion", range(6, 10)))  # the body's z axis
        pointing = Cone([0, 0, 1], math.radians(20), "u")  # of a thrust vector
        glide_slope = Cone([0, 0, 1], math.radians(75), ("x", [0, 1, 2]), apex=pad)  # 15 degrees above ground, at least

    The row is (|v| cos(angle) - axis . v) / sin(angle), near the surface as large as the distance to it; of an attitude
    |q|^2 times that. At 0 it would have no slope: vectors of 1e-4 or less count as shorter than they are.

    Args:
        axis: (d,), (B, d) or per knot (B|1, K, d), of any length above 0.
        angle: between axis and surface, rad, above 0 and below pi: a number, (B,), or per knot (B|1, K).
        of: "x" or "u", or a pair of that and which components, as for `NormBounds`; or ("quaternion", four states), a
            quaternion (w, x, y, z) whose body's z axis, in the world, is v.
        knots: default 1..N for states, 0..N-1 for controls.
        apex: where v = z - apex begins, (d,), (B, d) or per knot (B|1, K, d); None: 0. Not for attitudes.

    Violations are distances from the cone in the units of v; of vectors up to 1e-4 those of the row, which such vectors
    meet outside, too; of attitudes angles beyond `angle`, rad.

    Raises:
        InputError: on `Problem(...)`: components that the model doesn't have or that are given twice, other than four
            of a quaternion; an axis of another length, 0 or not finite; an angle out of its range; a bad apex.
    """

    axis: Any
    angle: Any
    of: Any
    knots: Any = None
    apex: Any = None
    attitude: bool = field(default=False, repr=False, kw_only=True)  # set once bound

    per_element: ClassVar[tuple[str, ...]] = ("axis", "angle", "apex")
    label: ClassVar[str] = "cone"

    def bind(self, dims: Dimensions) -> Self:
        known = OF_ATTITUDE if self.attitude else self.of
        kind, components = _chosen(known, self.components, ("x", "u", OF_ATTITUDE), dims, "cone.of")
        attitude = kind == OF_ATTITUDE
        if attitude and len(components) != 4:
            raise InputError("cone.of", "the four states (w, x, y, z) of a quaternion", components.tolist())
        kind = "x" if attitude else kind
        knots, K = _knots(self.knots, kind, dims, "cone.knots")
        d = 3 if attitude else len(components)
        axis = _points(self.axis, "cone.axis", dims, K, d)
        if not bool((axis.norm(dim=-1) > 0).all()):
            raise InputError("cone.axis", "vectors other than 0", axis.tolist())
        angle = _per_knot(self.angle, "cone.angle", dims, K)
        if not bool(((angle > 0) & (angle < math.pi)).all()):
            raise InputError("cone.angle", "angles in rad, above 0 and below pi", angle.tolist())
        if self.apex is not None and attitude:
            raise InputError("cone.apex", "none for a quaternion", shown(self.apex))
        apex = None if self.apex is None else _points(self.apex, "cone.apex", dims, K, d)
        return replace(
            self, axis=axis, angle=angle, of=kind, components=components, knots=knots, apex=apex,
            attitude=attitude,
        )  # fmt: skip

    @property
    def _direction(self) -> Tensor:
        """The axis as a unit vector, (B|1, K|1, d)."""
        return self.axis / self.axis.norm(dim=-1, keepdim=True)

    def _directed(self, X: Tensor, U: Tensor) -> Tensor:
        """The vectors v (B, K, d)."""
        z = self._vectors(X, U)
        if not self.attitude:
            return z if self.apex is None else z - self.apex
        w, x, y, z = z.unbind(-1)
        columns = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z)
        return torch.stack(columns, dim=-1)

    def told(self, row: int, knot: int, dynamics: Any) -> str:
        return f"cone of {self._components_told()}"

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        v = self._directed(X, U)
        if self.attitude:
            size = self._vectors(X, U).square().sum(-1)
        else:
            square = v.square().sum(-1)
            size = square / (square + TIP**2).sqrt()
        row = (self.angle.cos() * size - (self._direction * v).sum(-1)) / self.angle.sin()
        return row.unsqueeze(-1)

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        """How far the vectors are outside, in their units, or rad of attitudes, (B, K, 1)."""
        v = self._directed(X, U)
        along = (self._direction * v).sum(-1)
        across = (v - along.unsqueeze(-1) * self._direction).norm(dim=-1)
        if self.attitude:
            return (torch.atan2(across, along) - self.angle).clamp(min=0.0).unsqueeze(-1)
        cosine, sine = self.angle.cos(), self.angle.sin()
        outside = across * cosine - along * sine
        # Behind the tip the nearest point of the cone is the tip.
        behind = (outside > 0) & (along * cosine + across * sine < 0)
        length = v.norm(dim=-1).unsqueeze(-1)
        outside = torch.where(behind.unsqueeze(-1), length, outside.unsqueeze(-1))
        # At the tip what meets the row is a solution: solvers, which see rows alone, can't come any nearer.
        row = torch.minimum(outside, self.value(X, U))
        return torch.where(length <= TIP, row, outside).clamp(min=0.0)

    def moved_inside(self, U: Tensor, turned: Tensor) -> Tensor:
        """The vectors (B, K, c) of controls U; those outside, and `turned` (B, K, 1) bool, along the axis."""
        v, apex = self._directed(U, U), 0.0 if self.apex is None else self.apex
        turned = turned | (self.violation(U, U) > 0)
        return torch.where(turned, apex + v.norm(dim=-1, keepdim=True) * self._direction, self._vectors(U, U))

    def _slopes(self, X: Tensor, U: Tensor) -> Tensor:
        z, v = self._vectors(X, U), self._directed(X, U)
        cosine, sine = self.angle.cos().unsqueeze(-1), self.angle.sin().unsqueeze(-1)
        if not self.attitude:
            square = v.square().sum(-1, keepdim=True)
            by_v = v * (square + 2.0 * TIP**2) / (square + TIP**2).pow(1.5)
            return ((cosine * by_v - self._direction) / sine).unsqueeze(-2)
        w, x, y, z_ = z.unbind(-1)
        by_axis = (
            torch.stack((y, z_, w, x), dim=-1),  # half the derivatives of v_x, v_y and v_z by (w, x, y, z)
            torch.stack((-x, -w, z_, y), dim=-1),
            torch.stack((w, -x, -y, z_), dim=-1),
        )
        along = sum(self._direction[..., i : i + 1] * vector for i, vector in enumerate(by_axis))
        return (2.0 * (cosine * z - along) / sine).unsqueeze(-2)


def within_norms(U: Tensor, constraints: Iterable[Constraint]) -> Tensor:
    """Controls (B, N, m) moved to where the bounds on their norms and their cones hold; itself where all do.

    Sizes move first, then directions: what had none, as a norm's lower bound has no slope there, takes the cone's.
    """
    parts = [row for row in constraints if isinstance(row, Vectors) and row.of == "u"]  # type: ignore[attr-defined]
    moved = U.clone()
    for row in (row for row in parts if isinstance(row, NormBounds)):
        _put(moved, row, row.moved_inside(moved))
    for row in (row for row in parts if isinstance(row, Cone)):
        began = row._vectors(U, U).abs().amax(-1, keepdim=True)
        _put(moved, row, row.moved_inside(moved, began == 0))
    return moved


def _put(U: Tensor, row: Vectors, vectors: Tensor) -> None:
    values = U[:, row.knots]  # type: ignore[attr-defined]
    values[..., row.components] = vectors
    U[:, row.knots] = values  # type: ignore[attr-defined]


def _chosen(
    of: Any, known: Tensor | None, kinds: tuple[str, ...], dims: Dimensions, field: str
) -> tuple[Literal["x", "u", "quaternion"], Tensor]:
    """Whose components, and which (c,) int64; `known` are those of a constraint that is bound already."""
    pair = of if isinstance(of, tuple | list) and len(of) == 2 else (of, slice(None) if known is None else known)
    kind, which = pair
    if not isinstance(kind, str) or kind not in kinds:
        words = ", ".join(f'"{word}"' for word in kinds)
        raise InputError(field, f"one of {words}, or a pair of that and which components", shown(of))
    size = dims.m if kind == "u" else dims.n
    try:
        places = list(range(size))[which] if isinstance(which, slice) else [whole(i) for i in which]
    except (TypeError, ValueError):
        raise InputError(field, "a slice, or a list of whole numbers", shown(which)) from None
    of_what = "controls" if kind == "u" else "states"
    if not places or len(set(places)) < len(places) or not all(0 <= i < size for i in places):
        raise InputError(field, f"some of the {of_what} 0..{size - 1}, none twice", shown(which))
    return kind, torch.tensor(places, device=dims.like.device)  # type: ignore[return-value]


def _knots(knots: Any, kind: str, dims: Dimensions, field: str) -> tuple[slice | Tensor, int]:
    """The knots at which a constraint holds, and how many."""
    last, first = (dims.N - 1, 0) if kind == "u" else (dims.N, 1)
    resolved = resolve_knots(knots, last, field, dims.like.device, first)
    return resolved, count_of(resolved, last + 1)


def _per_knot(value: Any, field: str, dims: Dimensions, K: int) -> Tensor:
    """Numbers (B|1, K|1): given as one, (B,), or (B|1, K)."""
    raw = tensor(value, field, dims.like)
    values = raw.view(1, 1) if raw.dim() == 0 else raw.unsqueeze(-1) if raw.dim() == 1 else raw
    if values.dim() != 2 or values.shape[0] not in (1, dims.B) or values.shape[1] not in (1, K):
        raise InputError(field, f"a number, shape ({dims.B},), or per knot ({dims.B} or 1, {K})", tuple(raw.shape))
    if bool(torch.isnan(values).any()):
        raise InputError(field, "numbers", "NaN")
    return values


def _points(value: Any, field: str, dims: Dimensions, K: int, size: int) -> Tensor:
    """Vectors (B|1, K|1, size): given as (size,), (B, size), or (B|1, K, size)."""
    raw = tensor(value, field, dims.like)
    rows = raw.view(1, 1, -1) if raw.dim() == 1 else raw.unsqueeze(1) if raw.dim() == 2 else raw
    fits = rows.dim() == 3 and rows.shape[0] in (1, dims.B) and rows.shape[1] in (1, K) and rows.shape[2] == size
    if not fits:
        expected = f"shape ({size},), ({dims.B}, {size}), or per knot ({dims.B} or 1, {K}, {size})"
        raise InputError(field, expected, tuple(raw.shape))
    check_finite(rows, field)
    return rows
