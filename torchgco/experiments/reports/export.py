"""`torchgco-export RUN`: the trajectories of a finished study, as CSV with names and units or as bags of ROS 2; or the
controller of its problems as C."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError
from torchgco.base.options import Positive, check_value
from torchgco.dynamics import QuadrotorPlant
from torchgco.dynamics.names import controls_of, states_of
from torchgco.experiments.config.build import compose
from torchgco.experiments.ending import RunParser, say
from torchgco.experiments.reports.bags import Storage, write_bag
from torchgco.experiments.reports.finished import Study
from torchgco.experiments.results import durations
from torchgco.experiments.results.files import write
from torchgco.experiments.statistics.statistics import PAIR, swept_columns
from torchgco.experiments.statistics.tables import csv_text
from torchgco.export import export_c
from torchgco.export.files import Build
from torchgco.problem.times import TIME_COLUMN, sample_times, sampled, times

FOLDER = "export"
ATTITUDE_STATES, VELOCITY = slice(6, 10), slice(3, 6)  # of the plant's states
Table = tuple[str, int, str, pd.DataFrame]  # solver, layout, what its name ends with, columns


def write_export(
    folder: Path,
    output: Path | None = None,
    rate: float | None = None,
    layouts: Sequence[int] = (),
    solvers: Sequence[str] = (),
    trust: bool = False,
    bag: Storage | None = None,
) -> list[Path]:
    """Write a CSV file, or a bag, per solver and layout of a finished study; returns where they lie.

    Single trajectories have the columns of `Solution.trajectories`. Missions have those of the plant: states, the
    acceleration (differences of the velocities), the joint thrust, and the rotor speeds that are commanded; they are as
    they were logged, at the plant's time steps where the study kept these (up to four missions), else at its control
    steps. The last columns of every row name the layout, the solver and the keys that the study's sweep changed.

    Args:
        output: a folder; None: `export` in that of the study.
        rate: samples per second; None: the knots of a trajectory, the rows of a mission's log.
        layouts, solvers: which; none: all.
        bag: the container of bags, see `write_bag`; None: CSV.

    Raises:
        InputError: as `Study.read` and `write_bag`, a layout or solver that the study hasn't, or a rate that isn't
            above 0.
    """
    check_value(rate, Positive | None, "--rate")
    study, target = Study.read(folder, trust), folder / FOLDER if output is None else output
    ids, names = study.layouts.ids.tolist(), list(study.manifest.solvers)
    for option, chosen, known in (("--layout", layouts, ids), ("--solver", solvers, names)):
        if missing := [item for item in chosen if item not in known]:
            raise InputError(option, f"among {', '.join(map(str, known[:20]))} of the study", missing[0])
    if target.exists() and not target.is_dir():
        raise InputError("--output", "a folder", target)
    trials = study.trials.set_index(["solver", "layout"], drop=False)
    named = trials[[*PAIR, "solver", *swept_columns(trials)]]
    rows: dict[Any, Any] = dict(zip(named.index, named.to_dict("records"), strict=True))
    tables, written = _missions if study.missions else _trajectories, list[Path]()
    for solver, number, ending, columns in tables(study, rate, lambda solver, number: number in (layouts or ids)):
        if solver in (solvers or names):
            label = f"{solver}-{number}{ending}"
            written.append(target / (label if bag else f"{label}.csv"))
            target.mkdir(parents=True, exist_ok=True)
            if bag:
                write_bag(written[-1], {name: columns[name].to_numpy() for name in columns}, _position(study), bag)
            else:
                text = csv_text(columns.assign(**rows[solver, number]))
                write(written[-1], lambda file, text=text: file.write(text.encode()))
    return written


def _position(study: Study) -> list[str]:
    """The labels of the position's columns."""
    dynamics = QuadrotorPlant() if study.missions else study.vehicle.dynamics
    position = dynamics.position
    return [] if position is None else [state.label for state in states_of(dynamics)[position]]


def _trajectories(study: Study, rate: float | None, wanted: Callable[[str, int], bool]) -> Iterator[Table]:
    """Single trajectories, rolled out from the controls that the study kept; of fleets one of each vehicle."""
    if study.layouts.vehicles is None:
        yield from _of_one(study, rate, wanted, slice(None), "")
    m = study.vehicle.dynamics.m
    for v in range(study.layouts.vehicles or 0):
        one = replace(study, layouts=study.layouts.of_vehicle(v))
        yield from _of_one(one, rate, wanted, slice(v * m, (v + 1) * m), f"-{v}")


def _of_one(
    study: Study, rate: float | None, wanted: Callable[[str, int], bool], columns_of: slice, ending: str
) -> Iterator[Table]:
    """The trajectories of one vehicle, whose controls are some of those that the study kept."""
    for places, task in study.tasks():
        problem = task.problem
        for name in study.controls:
            every, knot_times = study.flight(name, places, problem.N)
            U = every[..., columns_of].contiguous()
            X = durations.states_of(problem, U, knot_times)
            t = times(problem).expand(problem.B, -1) if knot_times is None else knot_times
            for b, number in enumerate(study.layouts.ids[places].tolist()):
                last = problem.N if problem.horizon is None else int(problem.horizon[b])
                if wanted(name, number) and bool(torch.isfinite(U[b, :last]).all()):
                    dynamics = problem.take(slice(b, b + 1)).dynamics
                    columns = sampled(dynamics, X[b, : last + 1], U[b, :last], t[b, : last + 1], rate)
                    yield name, number, ending, pd.DataFrame(columns)


def _missions(study: Study, rate: float | None, wanted: Callable[[str, int], bool]) -> Iterator[Table]:
    """Missions as they were flown."""
    fine = study.time_steps
    kept = {} if fine is None else dict(iter(fine.groupby(["solver", "mission"], sort=False)))
    for (name, number), steps in study.log.groupby(["solver", "mission"], sort=False):  # type: ignore[misc]
        if wanted(name, number):
            yield name, number, "", _flown(kept.get((name, number), steps), rate)


def _flown(log: pd.DataFrame, rate: float | None) -> pd.DataFrame:
    """The columns of a mission, from its log."""
    plant = QuadrotorPlant()
    t, x, u = (log[names].to_numpy(float) for names in (["t"], _numbered("x", plant.n), _numbered("u", plant.m, 1)))
    moments = t[:, 0] if rate is None else sample_times(t[0, 0], t[-1, 0], rate)
    if rate is not None:
        u = u[np.clip(np.searchsorted(t[:, 0], moments + 1e-9, side="right") - 1, 0, len(u) - 1)]  # they hold
    rates = np.gradient(x[:, VELOCITY], t[:, 0], axis=0) if len(t) > 1 else np.zeros((1, 3))
    x = x.copy()
    q = x[:, ATTITUDE_STATES]  # a view; q and -q are the same attitude: neighbours are to have the same sign
    q[1:] *= np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0).cumprod()[:, None]
    x, rates = _between(moments, t[:, 0], x), _between(moments, t[:, 0], rates)
    x[:, ATTITUDE_STATES] /= np.linalg.norm(x[:, ATTITUDE_STATES], axis=1, keepdims=True)
    columns: dict[str, Any] = {TIME_COLUMN: moments}
    columns |= {component.label: x[:, i] for i, component in enumerate(states_of(plant))}
    columns |= {f"a{axis} [m/s^2]": rates[:, i] for i, axis in enumerate("xyz")}
    columns["thrust [N]"] = x[:, 13:].sum(1)
    return pd.DataFrame(columns | {component.label: u[:, i] for i, component in enumerate(controls_of(plant))})


def _numbered(letter: str, count: int, first: int = 0) -> list[str]:
    return [f"{letter}{i}" for i in range(first, first + count)]


def _between(moments: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(moments, t, column) for column in values.T], axis=1)


def _parser() -> RunParser:
    parser = RunParser(
        prog="torchgco-export",
        description="The trajectories of a study as CSV, or as bags of ROS 2; or the controller of a problem as C.",
    )
    parser.add_argument(
        "run",
        metavar="RUN",
        nargs="+",
        help="the folder of a finished study; with --c also KEY=VALUE as torchgco takes them",
    )
    parser.add_argument(
        "--output", metavar="FOLDER", type=Path, help=f"default: {FOLDER} in RUN; of KEY=VALUE a folder NAME"
    )
    parser.add_argument("--rate", metavar="HZ", type=float, help="samples per second; default: as they were computed")
    parser.add_argument(
        "--layout", metavar="N", type=int, nargs="+", default=[], help="numbers of layouts; default: all"
    )
    parser.add_argument("--solver", metavar="NAME", nargs="+", default=[], help="default: all of the study")
    kinds = list(get_args(Storage))
    parser.add_argument("--bag", metavar="KIND", choices=kinds, help=f"bags of ROS 2 instead: {' or '.join(kinds)}")
    parser.add_argument(
        "--c", metavar="NAME", help="instead the C of this name that controls the first layout, or those of --layout"
    )
    parser.add_argument(
        "--changes",
        metavar="NAME",
        nargs="*",
        help="numbers that the C may be given between steps; default: all that can",
    )
    parser.add_argument("--single", action="store_true", help="the C has floats, for processors without doubles")
    builds = list(get_args(Build))
    parser.add_argument(
        "--build", metavar="KIND", choices=builds, help=f"what builds the C: {', '.join(builds)}; default: {builds[0]}"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-export`. Returns the exit code, see `ended`."""
    return _parser().run(arguments, _run)


def _run(options: argparse.Namespace) -> int:
    if options.c is not None:
        return _write_c(options)
    if options.build is not None:
        raise InputError("--build", "none without --c", options.build)
    if options.single:
        raise InputError("--single", "none without --c", "one")
    if len(options.run) > 1:
        raise InputError("RUN", "one folder; several words with --c", options.run[1])
    run = Path(options.run[0])
    files = write_export(
        run, options.output, options.rate, options.layout, options.solver, options.trust, options.bag
    )  # fmt: skip
    parts = [file for path in files for file in ([path] if path.is_file() else path.iterdir())]
    size = sum(file.stat().st_size for file in parts)
    say(f"{files[0].parent if files else run}: {len(files)} files, {size / 1e6:.2f} MB")
    return 0


def _write_c(options: argparse.Namespace) -> int:
    """The controller of problems, of a study or of a configuration: each layout is an element."""
    words, name = options.run, options.c
    if given := [word for word in ("rate", "solver", "bag") if getattr(options, word)]:
        raise InputError(f"--{given[0]}", "none beside --c", getattr(options, given[0]))
    if len(words) == 1 and "=" not in words[0]:
        folder, made = Path(words[0]), Study.read(Path(words[0]), options.trust)
        missions, layouts, vehicle, output = made.missions, made.layouts, made.vehicle, folder / FOLDER / name
    else:
        setup = compose(words)
        missions, vehicle, output = setup.mission is not None, setup.vehicle, Path(name)
        layouts = setup.layouts(1 + max(options.layout, default=0))
    if missions:
        raise InputError("RUN", "single trajectories: a mission's planner searches, which C doesn't", "missions")
    ids = layouts.ids.tolist()
    asked = list(dict.fromkeys(options.layout)) or ids[:1]
    if missing := [layout for layout in asked if layout not in ids]:
        raise InputError("--layout", f"one of {', '.join(map(str, ids[:20]))}", missing[0])
    problem = vehicle.task(layouts.take(np.array([ids.index(layout) for layout in asked]))).problem
    dtype = torch.float32 if options.single else torch.float64
    target, build = options.output or output, options.build or "cmake"
    written = export_c(problem, target, name, changes=options.changes, build=build, dtype=dtype)
    size = sum(path.stat().st_size for path in written.rglob("*") if path.is_file())
    say(f"{written}: {name}.c, {size / 1e6:.2f} MB")
    return 0
