"""The kinds of numbers in scenarios and layouts, as annotations of their fields, and checks of arrays.

Each check returns the value in one plain form or raises InputError. Letters as in `layouts`: L layouts,
M spheres, K boxes, d the dimension of space, n states, m controls.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.base.options import INCREASING, Above, AtMost, Within, check_value
from torchgco.base.shapes import bound_of
from torchgco.obstacles.inputs import UNIT_WITHIN

TOO_LARGE = 1e6  # m, m/s or s: beyond it, squares and sums lose the digits that obstacles are checked to
MOST_OBSTACLES = 100_000  # in a layout that is drawn
SHORTEST_HORIZON = 5.0  # s of a horizon, at least: to turn, to speed up and to stop
TENS = 10
MOST_STAGES = 10**9  # beyond any memory, and few enough for arithmetic on bytes


Coordinate = Annotated[float, Within(-TOO_LARGE, TOO_LARGE, "m")]
Length = Annotated[float, Within(0, TOO_LARGE, "m")]
Size = Annotated[float, Above(0, "m"), AtMost(TOO_LARGE, "m")]
Duration = Annotated[float, Within(0, TOO_LARGE, "s")]
TimeStep = Annotated[float, Above(0, "s"), AtMost(TOO_LARGE, "s")]
Speed = Annotated[float, Within(0, TOO_LARGE, "m/s")]
Pace = Annotated[float, Within(1e-3, TOO_LARGE, "m/s")]
Stages = Annotated[int, Within(1, MOST_STAGES)]
Number = Annotated[int, Within(0, MOST_OBSTACLES)]
Density = Annotated[float, Within(0, TOO_LARGE)]
Range = Annotated[tuple[Coordinate, Coordinate], INCREASING]
Sizes = Annotated[tuple[Size, Size], INCREASING]
Sizes2 = tuple[Length, Length]
Speeds = Annotated[tuple[Speed, Speed], INCREASING]
Point2 = tuple[Coordinate, Coordinate]
Point3 = tuple[Coordinate, Coordinate, Coordinate]
Region2 = tuple[Range, Range]
Region3 = tuple[Range, Range, Range]
# Numbers that layouts share, by field.
SCALARS: dict[str, Any] = {
    "vehicle_radius": Length, "goal_radius": Size, "dt": TimeStep, "stages": Stages, "apart": Size,
}  # fmt: skip


def stages_for(way: float, pace: float, dt: float) -> int:
    """Stages of `dt`, s, for a way, m, at a mean speed, m/s: in tens, so that many layouts have as many."""
    return max(1, math.ceil(max(way / pace, SHORTEST_HORIZON) / (TENS * dt)) * TENS)


def stages(value: Any, count: int) -> int | np.ndarray | None:
    """The number of stages, or where layouts differ (count,) int64 of them."""
    if value is None or np.ndim(value) == 0:
        number = scalar("stages", value)
        return None if number is None else int(number)
    numbers = array(value, "layouts.stages")
    whole = numbers.shape == (count,) and bool((numbers == np.round(numbers)).all())
    if not whole or not ((numbers >= 1) & (numbers <= MOST_STAGES)).all():
        raise InputError("layouts.stages", f"one whole number above 0, or {count} of them", shown(value))
    return int(numbers[0]) if (numbers == numbers[0]).all() else numbers.astype(np.int64)


def scalar(name: str, value: Any) -> float | int | None:
    """A number that layouts share, as a file holds it: also an array without axes, and stages as a float."""
    if value is None:
        return None
    number = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
    whole = name == "stages" and isinstance(number, float) and number.is_integer()
    number = check_value(int(number) if whole else number, SCALARS[name], f"layouts.{name}")
    return number if name == "stages" else float(number)


def plain(value: Any) -> Any:
    """Sequences, nested ones too, as tuples of floats, and any other value of a field as it is."""
    rows = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
    return tuple(float(item) if isinstance(item, int | float) else plain(item) for item in value) if rows else value


def indices(value: Any, field: str) -> np.ndarray:
    """A sequence of at least one integer >= 0, as int64 (count,)."""
    try:
        plain = [operator.index(item) for item in value]
    except TypeError:
        plain = []
    if not plain or min(plain) < 0:
        raise InputError(field, "a list of at least one integer >= 0", repr(value))
    return np.array(plain, np.int64)


def array(value: Any, field: str) -> np.ndarray:
    """A float64 copy of numbers of any shape."""
    try:
        if np.asarray(value).dtype.kind not in "iuf":
            raise TypeError
        return np.array(value, np.float64)
    except (TypeError, ValueError, RuntimeError):
        got = f"dtype {value.dtype}" if isinstance(value, np.ndarray) else repr(value)
        raise InputError(field, "an array of real numbers", got) from None


def obstacles(centers: Any, radii: Any) -> tuple[np.ndarray, np.ndarray]:
    """Centres (L, M, d) and radii (L, M) that are present or absent together."""
    centers, radii = array(centers, "layouts.centers"), array(radii, "layouts.radii")
    if centers.ndim != 3 or centers.shape[0] < 1 or centers.shape[2] not in (2, 3):
        raise InputError("layouts.centers", "shape (L, M, d), L >= 1, d = 2 or 3", f"shape {centers.shape}")
    if radii.shape != centers.shape[:2]:
        raise InputError("layouts.radii", f"shape (L, M) = {centers.shape[:2]} as in centers", radii.shape)
    absent = _absent(centers, "layouts.centers")
    _none_of(np.isinf(radii) | (radii < 0), "layouts.radii", "finite radii >= 0", radii)
    _none_of(absent & ~np.isnan(radii), "layouts.radii", "NaN where the centre is NaN", radii)
    _none_of(~absent & np.isnan(radii), "layouts.radii", "a radius where the centre is finite", radii)
    _bounded(radii, "layouts.radii")
    return centers, radii


def velocities(value: Any, centers: np.ndarray) -> np.ndarray | None:
    """Velocities (L, M, d), finite where there is an obstacle and NaN where there is none."""
    if value is None:
        return None
    moving = _of_each(value, "layouts.velocities", centers.shape, f"the shape {centers.shape} of centers")
    expected = "finite velocities where the centre is finite"
    return _present(moving, np.isfinite(moving).all(axis=2), centers, "layouts.velocities", expected)


def boxes(centers: Any, halves: Any, turns: Any, radii: Any, like: np.ndarray) -> tuple[np.ndarray | None, ...]:
    """Centres and half sides (L, K, d), turns (L, K) or (L, K, 4), radii (L, K): present or absent together; or None.

    `like` are the spheres' centres (L, M, d).
    """
    if centers is None:
        for name, value in (("half_sizes", halves), ("rotations", turns), ("radii", radii)):
            if value is not None:
                raise InputError(f"layouts.box_{name}", "none without box_centers", "some")
        return None, None, None, None
    middle = array(centers, "layouts.box_centers")
    count, _, d = like.shape
    if middle.ndim != 3 or middle.shape[0] != count or middle.shape[2] != d:
        raise InputError("layouts.box_centers", f"shape ({count}, K, {d})", f"shape {middle.shape}")
    absent = _absent(middle, "layouts.box_centers")
    if halves is None:
        raise InputError("layouts.box_half_sizes", "this array with box_centers", "none")
    half = _of_each(halves, "layouts.box_half_sizes", middle.shape, f"the shape {middle.shape} of box_centers")
    rounding = None
    if radii is not None:
        rounding = _of_each(radii, "layouts.box_radii", absent.shape)
        expected = "finite radii >= 0 where the centre is finite"
        rounding = _present(rounding, np.isfinite(rounding) & (rounding >= 0), middle, "layouts.box_radii", expected)
    rounded = np.zeros_like(absent) if rounding is None else rounding > 0
    good = np.isfinite(half).all(axis=2) & ((half > 0).all(axis=2) | rounded & (half >= 0).all(axis=2))
    expected = "finite half sides above 0 where the centre is finite; 0 too where the radius is above 0"
    _none_of(~absent & ~good, "layouts.box_half_sizes", expected, half)
    _none_of(absent & ~np.isnan(half).all(axis=2), "layouts.box_half_sizes", "NaN where the centre is NaN", half)
    _bounded(half, "layouts.box_half_sizes")
    return middle, half, None if turns is None else _turns(turns, middle), rounding


def sines(values: Sequence[Any], centers: np.ndarray | None) -> tuple[np.ndarray | None, ...]:
    """Amplitudes, rates and phases (L, K, S, d) of boxes, NaN where there is no box; or None."""
    names = ("layouts.box_amplitudes", "layouts.box_rates", "layouts.box_phases")
    present = [name for name, value in zip(names, values, strict=True) if value is not None]
    if not present:
        return None, None, None
    if centers is None:
        raise InputError(present[0], "none without box_centers", "some")
    arrays = []
    for name, value in zip(names, values, strict=True):
        if value is None:
            raise InputError(name, f"this array with {present[0].removeprefix('layouts.')}", "none")
        numbers, (count, boxes, d) = array(value, name), centers.shape
        if numbers.ndim != 4 or numbers.shape != (count, boxes, numbers.shape[2], d):
            raise InputError(name, f"shape ({count}, {boxes}, S, {d})", f"shape {numbers.shape}")
        if arrays and numbers.shape != arrays[0].shape:
            raise InputError(name, f"shape {arrays[0].shape} as box_amplitudes", f"shape {numbers.shape}")
        good = np.isfinite(numbers).all(axis=(2, 3))
        arrays.append(_present(numbers, good, centers, name, "finite numbers where the centre is finite"))
    return tuple(arrays)


def _turns(value: Any, centers: np.ndarray) -> np.ndarray:
    """Angles (L, K) in the plane, unit quaternions (L, K, 4) in space, NaN where there is no box."""
    field, (*shape, d) = "layouts.box_rotations", centers.shape
    if d == 2:
        turns = _of_each(value, field, tuple(shape), f"shape {tuple(shape)}: angles")
        good, expected = np.isfinite(turns), "finite angles where the centre is finite"
    else:
        turns = _of_each(value, field, (*shape, 4), f"shape {(*shape, 4)}: quaternions")
        good = np.abs(np.linalg.norm(turns, axis=2) - 1.0) <= UNIT_WITHIN
        expected = "unit quaternions [w, x, y, z] where the centre is finite"
    return _present(turns, good, centers, field, expected)


def states(value: Any, field: str, centers: np.ndarray, fleets: bool = False) -> np.ndarray | None:
    """Finite states (L, n), n >= d, from one state (n,) for all layouts or one each (L, n); of fleets (L, V, n)."""
    if value is None:
        return None
    rows = array(value, field)
    count, _, dimension = centers.shape
    axes = 2 + fleets
    fits = rows.ndim == axes - 1 or (rows.ndim == axes and rows.shape[0] == count)
    if not fits or rows.shape[-1] < dimension or (fleets and rows.shape[-2] < 2):
        of_each = "V, n" if fleets else "n"
        expected = f"shape ({of_each if fleets else 'n,'}) or ({count}, {of_each}) with n >= {dimension}"
        raise InputError(field, expected + (" and V >= 2" if fleets else ""), f"shape {rows.shape}")
    rows = np.tile(rows, (count, *[1] * (axes - 1))) if rows.ndim < axes else rows
    _none_of(~np.isfinite(rows).all(axis=-1), field, "finite states", rows)
    _bounded(rows, field)
    return rows


def gates(centers: Any, radii: Any, like: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Centres (L, G, d) and radii (L, G) of gates that are present or absent together, absent ones last; or None.

    `like` are the obstacles' centres (L, M, d).
    """
    if centers is None:
        if radii is not None:
            raise InputError("layouts.gate_radii", "none without gate_centers", "some")
        return None, None
    middle, (count, _, d) = array(centers, "layouts.gate_centers"), like.shape
    if middle.ndim != 3 or middle.shape[0] != count or middle.shape[2] != d or middle.shape[1] < 1:
        raise InputError("layouts.gate_centers", f"shape ({count}, G, {d}), G >= 1", f"shape {middle.shape}")
    absent = _absent(middle, "layouts.gate_centers")
    _none_of(absent[:, :-1] & ~absent[:, 1:], "layouts.gate_centers", "absent gates behind all others", middle)
    if radii is None:
        raise InputError("layouts.gate_radii", "this array with gate_centers", "none")
    sizes = array(radii, "layouts.gate_radii")
    if sizes.shape != middle.shape[:2]:
        raise InputError("layouts.gate_radii", f"shape (L, G) = {middle.shape[:2]} as in gate_centers", sizes.shape)
    sound = np.where(absent, np.isnan(sizes), np.isfinite(sizes) & (sizes > 0))
    _none_of(~sound, "layouts.gate_radii", "radii above 0, NaN where the centre is NaN", sizes)
    _bounded(sizes, "layouts.gate_radii")
    return middle, sizes


def free_time(value: Any, velocities: np.ndarray | None) -> np.ndarray | None:
    """(least, most, weight): factors of the stages' length, and the cost of a second; only where nothing moves."""
    if value is None:
        return None
    numbers = array(value, "layouts.free_time")
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError("layouts.free_time", "three numbers: least, most, weight", numbers.tolist())
    least, most, weight = numbers.tolist()
    if not 0 < least <= most or weight < 0:
        raise InputError("layouts.free_time", "0 < least <= most, and a weight of at least 0", numbers.tolist())
    if velocities is not None and bool(np.nan_to_num(velocities).any()):
        raise InputError("layouts.free_time", "None where spheres move: a study's pictures show given times", "a time")
    return numbers


def required(value: Any) -> bool | None:
    """Whether the goal is a constraint, as a file holds it: also an array without axes."""
    flag = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
    return None if flag is None else check_value(flag, bool, "layouts.goal_required")


def control_bounds(lower: Any, upper: Any) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Bounds (m,) of the controls, either of them possibly None, infinite or None where unbounded."""
    bounds: list[np.ndarray | None] = []
    both = (lower, "layouts.control_lower", -math.inf), (upper, "layouts.control_upper", math.inf)
    for value, field, none in both:
        bound = None if value is None else array(bound_of(value, none), field)
        if bound is not None and (bound.ndim != 1 or not bound.size or np.isnan(bound).any()):
            raise InputError(field, "shape (m,) without NaN", f"{bound.tolist()} of shape {bound.shape}")
        bounds.append(bound)
    low, high = bounds
    if low is not None and high is not None:
        if low.shape != high.shape:
            raise InputError("layouts.control_upper", f"the shape {low.shape} of control_lower", high.shape)
        if (low > high).any():
            raise InputError("layouts.control_lower", f"at most control_upper, {high.tolist()}", low.tolist())
    return low, high


def best_cost(value: Any, count: int) -> np.ndarray | None:
    """Costs (L,), NaN where none is known."""
    if value is None:
        return None
    costs = array(value, "layouts.best_cost")
    if costs.shape != (count,):
        raise InputError("layouts.best_cost", f"shape ({count},)", f"shape {costs.shape}")
    _none_of(np.isinf(costs), "layouts.best_cost", "finite costs, or NaN where none is known", costs)
    return costs


def ids(value: Any, count: int) -> np.ndarray:
    """Ids (L,) >= 0 as int64; None or an empty array stands for 0..L-1."""
    try:
        numbers = np.asarray(() if value is None else value)
    except ValueError:  # rows of unequal lengths
        numbers = np.asarray(None)
    if numbers.size == 0:
        return np.arange(count)
    if numbers.shape != (count,) or not np.issubdtype(numbers.dtype, np.integer) or numbers.min() < 0:
        numeric = numbers.dtype.kind in "iuf"
        got = f"{numbers.dtype} of shape {numbers.shape}" + (f", from {numbers.min()}" if numeric else "")
        raise InputError("layouts.ids", f"integers >= 0 of shape ({count},)", got)
    return numbers.astype(np.int64)


def _absent(centers: np.ndarray, field: str) -> np.ndarray:
    """Which rows (L, M) of centres (L, M, d) are NaN; all others are to be finite, and not too far."""
    absent = np.asarray(np.isnan(centers).all(axis=2))
    _none_of(~absent & ~np.isfinite(centers).all(axis=2), field, "finite rows or rows of NaN", centers)
    _bounded(centers, field)
    return absent


def _of_each(value: Any, field: str, shape: tuple[int, ...], expected: str | None = None) -> np.ndarray:
    """Numbers of this shape."""
    numbers = array(value, field)
    if numbers.shape != shape:
        raise InputError(field, expected or f"shape {shape}", numbers.shape)
    return numbers


def _present(values: np.ndarray, good: Any, centers: np.ndarray, field: str, expected: str) -> np.ndarray:
    """Values with rows that are `good` (L, M) where a centre (L, M, d) is there, and NaN elsewhere."""
    absent = np.isnan(centers).all(axis=2)
    _none_of(~absent & ~good, field, expected, values)
    values[absent] = np.nan
    _bounded(values, field)
    return values


def _bounded(values: np.ndarray, field: str) -> None:
    """Raise InputError where a value exceeds TOO_LARGE; NaN passes."""
    _none_of(np.abs(values) > TOO_LARGE, field, f"values of at most {TOO_LARGE:g} in size", values)


def _none_of(bad: Any, field: str, expected: str, values: np.ndarray) -> None:
    """Raise InputError that shows the first of `values` where `bad` is true."""
    if bad.any():
        index = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InputError(field, expected, f"{values[index].tolist()} at {list(index)}")
