"""Controls of any solver, from an npz file or a CSV file: read as data, their size known before memory is taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from torchgco.base.errors import InputError, first_line, shown
from torchgco.base.files import regular
from torchgco.base.memory import limited
from torchgco.experiments.results.limits import LARGEST_FILE, NUMBER_BYTES, read_npz, refuse
from torchgco.scenarios import Layouts, Vehicle

ARRAYS = ("U", "solver", "layout", "times", "seconds")
KEYS = ("layout", "k")  # columns of a CSV file that name a stage; u1, u2, ... are its controls
LETTERS = 2  # of a number in a CSV file, at least: a digit and a comma
NAME_LETTERS = 64


@dataclass(frozen=True)
class Controls:
    """What one solver gives for all layouts of a file.

    Args:
        name: of the solver.
        U: (L, N, m), NaN where nothing is given.
        lacking: (L,) stages that are missing; N of a layout that is missing as a whole.
        times: (L, N+1) of the knots, s, where the time is free; else None.
        seconds: (L,) that the solver took, by its own account, NaN where it doesn't say.
    """

    name: str
    U: np.ndarray
    lacking: np.ndarray
    times: np.ndarray | None
    seconds: np.ndarray

    @property
    def digest(self) -> str:
        """Of all that is judged."""
        arrays = [self.U] if self.times is None else [self.U, self.times]
        return sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:16]


@dataclass(frozen=True)
class Form:
    """The form of controls for some layouts: their ids, the stages of each and the most of all, and controls."""

    ids: np.ndarray
    stages: np.ndarray
    N: int
    m: int
    rest: np.ndarray
    free: bool

    @classmethod
    def of(cls, layouts: Layouts, vehicle: Vehicle) -> Form:
        stages = vehicle.completed(layouts).stages
        of_each = np.broadcast_to(np.asarray(stages, np.int64), layouts.count)
        rest = np.array(list(vehicle.control_reference), np.float64)
        free = layouts.free_time is not None
        return cls(layouts.ids, of_each, int(of_each.max()), vehicle.dynamics.m, rest, free)

    @property
    def L(self) -> int:
        return len(self.ids)

    def places(self, numbers: Sequence[Any] | np.ndarray, path: Path) -> np.ndarray:
        """The places of layouts by their numbers; InputError where one isn't among them."""
        order = np.argsort(self.ids)
        ranks = np.searchsorted(self.ids, numbers, sorter=order).clip(max=self.L - 1)
        places = order[ranks]
        if (wrong := self.ids[places] != numbers).any():
            first = ", ".join(map(str, self.ids[:8].tolist())) + (", ..." if self.L > 8 else "")
            raise _wrong(path, f"layouts of the file, {first}", f"layout {np.asarray(numbers)[wrong][0]}")
        return places

    def controls(self, name: str, U: np.ndarray, lengths: np.ndarray | None, seconds: np.ndarray) -> Controls:
        """Controls from arrays of all layouts, NaN where nothing is given; at rest beyond the stages of each."""
        beyond = np.arange(self.N) >= self.stages[:, None]
        if lengths is not None:  # a stage without its length is missing
            U = np.where(np.isnan(lengths)[..., None], np.nan, U)
        U = np.where(beyond[..., None], self.rest, U)
        lacking = (np.isnan(U).all(-1) & ~beyond).sum(1)
        times = None
        if lengths is not None:
            lengths = np.where(beyond, 0.0, lengths)
            times = np.concatenate((np.zeros((self.L, 1)), np.cumsum(lengths, axis=1)), axis=1)
        if (wrong := (seconds < 0) | np.isinf(seconds)).any():
            raise InputError("CONTROLS", "seconds of at least 0, NaN where unknown", f"{seconds[wrong][0]:g} of {name}")
        name = " ".join(name.split())
        if not name or len(name) > NAME_LETTERS:
            raise InputError("CONTROLS", f"a solver's name of 1 to {NAME_LETTERS} letters", shown(name))
        return Controls(name, U, lacking, times, seconds)

    def check_size(self, path: Path, solvers: int, trust: bool) -> None:
        """InputError where the controls of so many solvers take more than a file's may."""
        size = solvers * self.L * self.N * (self.m + 1) * NUMBER_BYTES
        if size > LARGEST_FILE and not trust:
            refuse(path, f"controls of {solvers} solvers, {size / 1e9:.3g} GB", "CONTROLS")


def read_controls(path: Path, layouts: Layouts, vehicle: Vehicle, trust: bool = False) -> list[Controls]:
    """The controls in a file, of one solver or of several.

    An npz file holds `U` (L, N, m), or (S, L, N, m) beside the solvers' names `solver` (S,); `layout` (L,), the numbers
    of the layouts where they aren't all in order; `times` (..., L, N+1), s, where the time is free; and `seconds`
    (..., L). So does solutions.npz of a study. A CSV file has a row per stage: `layout`, `k` from 0, controls `u1`,
    `u2`, ..., and if wanted `solver`, `seconds`, and `dt`, s, the length of a stage where the time is free.

    Raises:
        InputError: a file that can't be read, with Python objects, of another form, of other layouts, or one that takes
            more memory than it may without `trust`.
    """
    form = Form.of(layouts, vehicle)
    try:
        read = _from_csv if regular(path).suffix.lower() == ".csv" else _from_npz
        return read(path, form, trust)
    except InputError:
        raise
    except FileNotFoundError:
        raise _wrong(path, "an npz or CSV file", "none") from None
    except Exception as error:  # damaged bytes make NumPy, zipfile and pandas raise nearly anything
        reason = first_line(error)
        reason = "of another format, or with Python objects" if "pickle" in reason else reason
        raise _wrong(path, "a readable npz file without pickles, or a CSV file", reason) from None


def _wrong(path: Path, expected: str, got: Any) -> InputError:
    return InputError("CONTROLS", expected, f"{got} in {path}")


def _from_npz(path: Path, form: Form, trust: bool) -> list[Controls]:
    arrays = read_npz(path, trust)
    if unknown := sorted(set(arrays) - set(ARRAYS)):
        raise _wrong(path, f"arrays of the names {', '.join(ARRAYS)}", unknown[0])
    if "U" not in arrays:
        raise _wrong(path, "an array U", f"only {', '.join(sorted(arrays)) or 'none'}")
    numbers = {name: _numbers(path, name, array) for name, array in arrays.items() if name not in ("solver", "layout")}
    several = numbers["U"].ndim == 4
    names = [str(name) for name in np.atleast_1d(arrays.get("solver", np.array([path.stem])))]
    form.check_size(path, len(names), trust)
    ids = np.asarray(arrays.get("layout", form.ids))
    if ids.ndim != 1 or ids.dtype.kind not in "iu" or len(np.unique(ids)) < len(ids):
        raise _wrong(path, "layout: whole numbers (L,), each once", f"{ids.dtype} {ids.shape}")
    places, lead = form.places(ids, path), (*((len(names),) if several else ()), len(ids))
    shapes = {"U": (*lead, form.N, form.m), "times": (*lead, form.N + 1), "seconds": lead}
    for name, array in numbers.items():
        if array.shape != shapes[name]:
            raise _wrong(path, f"{name} {shapes[name]}", array.shape)
    if not several and len(names) > 1:
        raise _wrong(path, "U of as many solvers as `solver` names", f"{len(names)} names")
    _check_times(path, form, "times" in numbers, "times")
    made = []
    for i, name in enumerate(names):
        of_solver = {key: array[i] if several else array for key, array in numbers.items()}
        U, lengths, seconds = _empty(form, "times" in of_solver)
        U[places] = of_solver["U"]
        if lengths is not None:
            lengths[places] = np.diff(of_solver["times"], axis=1)
        if "seconds" in of_solver:
            seconds[places] = of_solver["seconds"]
        made.append(form.controls(name, U, lengths, seconds))
    return made


def _numbers(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "iuf":
        raise _wrong(path, f"{name} of numbers", array.dtype)
    return array.astype(np.float64)


def _check_times(path: Path, form: Form, timed: bool, name: str) -> None:
    if timed != form.free:
        raise _wrong(path, f"{name}, as the time is free" if form.free else f"no {name}: the time is given", name)


def _empty(form: Form, timed: bool) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Controls, lengths of stages and seconds of which nothing is given."""
    U, lengths = np.full((form.L, form.N, form.m), np.nan), np.full((form.L, form.N), np.nan)
    return U, lengths if timed else None, np.full(form.L, np.nan)


def _from_csv(path: Path, form: Form, trust: bool) -> list[Controls]:
    size = path.stat().st_size * NUMBER_BYTES // LETTERS
    if size > LARGEST_FILE and not trust:
        refuse(path, f"numbers of up to {size / 1e9:.3g} GB", "CONTROLS")
    heads = [f"u{i + 1}" for i in range(form.m)]
    try:
        with limited(np.inf if trust else LARGEST_FILE):
            table = pd.read_csv(path, compression=None, dtype={"solver": "string"}, skipinitialspace=True)
    except MemoryError:
        refuse(path, "a table that takes more", "CONTROLS")
    names = [*KEYS, *heads, "solver", "seconds", "dt"]
    if missing := [name for name in (*KEYS, *heads) if name not in table.columns]:
        raise _wrong(path, f"columns {', '.join((*KEYS, *heads))}", f"none called {missing[0]}")
    if unknown := [name for name in table.columns if name not in names]:
        raise _wrong(path, f"columns among {', '.join(names)}", unknown[0])
    _check_times(path, form, "dt" in table.columns, "dt")
    values = {name: _column(path, table, name) for name in table.columns if name != "solver"}
    places = form.places(_whole(path, "layout", values["layout"]), path)
    stages = _whole(path, "k", values["k"])
    if (outside := (stages < 0) | (stages >= form.N)).any():
        raise _wrong(path, f"k from 0 to {form.N - 1}", int(stages[outside][0]))
    solvers = table["solver"].fillna("") if "solver" in table.columns else pd.Series([path.stem] * len(table))
    form.check_size(path, solvers.nunique(), trust)
    made = []
    for name, rows in solvers.groupby(solvers, sort=False).indices.items():
        made.append(_of_rows(path, form, str(name), rows, places, stages, values))
    if not made:
        raise _wrong(path, "a row per stage", "no rows")
    return made


def _of_rows(
    path: Path, form: Form, name: str, rows: np.ndarray, places: np.ndarray, stages: np.ndarray, values: Mapping
) -> Controls:
    """The controls of one solver from its rows of a table."""
    layout_places, of_rows = places[rows], stages[rows]
    flat, counts = np.unique(layout_places * form.N + of_rows, return_counts=True)
    if (repeated := flat[counts > 1]).size:
        where = f"two for layout {form.ids[repeated[0] // form.N]}, k {repeated[0] % form.N}"
        raise _wrong(path, "one row per stage", where)
    U, lengths, seconds = _empty(form, "dt" in values)
    U[layout_places, of_rows] = np.stack([values[f"u{i + 1}"][rows] for i in range(form.m)], axis=-1)
    if lengths is not None:
        lengths[layout_places, of_rows] = values["dt"][rows]
    if "seconds" in values:  # of a layout, in all of its rows or in some
        most = seconds.copy()
        np.fmin.at(seconds, layout_places, values["seconds"][rows])
        np.fmax.at(most, layout_places, values["seconds"][rows])
        if (unlike := seconds < most).any():
            got = f"{seconds[unlike][0]:g} and {most[unlike][0]:g} for layout {form.ids[unlike][0]}"
            raise _wrong(path, "the same seconds in all rows of a layout", got)
    return form.controls(name, U, lengths, seconds)


def _column(path: Path, table: pd.DataFrame, name: str) -> np.ndarray:
    """A column of numbers; InputError with the line of one that is none."""
    try:
        return pd.to_numeric(table[name]).to_numpy(np.float64, na_value=np.nan)
    except (ValueError, TypeError):
        wrong = pd.to_numeric(table[name], errors="coerce").isna() & table[name].notna()
        line = int(np.flatnonzero(wrong.to_numpy())[0]) if wrong.any() else 0
        raise _wrong(
            path, f"a number in column {name}", f"{shown(table[name].iloc[line])} in line {line + 2}"
        ) from None


def _whole(path: Path, name: str, values: np.ndarray) -> np.ndarray:
    if len(values) and not (np.isfinite(values) & (values == np.floor(values)) & (np.abs(values) < 2**53)).all():
        raise _wrong(path, f"whole numbers in column {name}", "others")
    return values.astype(np.int64)
