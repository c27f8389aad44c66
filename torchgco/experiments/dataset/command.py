"""`torchgco-dataset FOLDER`: layouts of a study's configuration, solved and kept in full; see docs/studies.md."""

from __future__ import annotations

import argparse
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from torchgco.base.errors import InputError
from torchgco.base.files import PART, regular
from torchgco.base.options import Count, check_value
from torchgco.base.version import VERSION
from torchgco.experiments.config.build import DEFAULT_LAYOUTS, Setup, compose
from torchgco.experiments.config.checks import check_once
from torchgco.experiments.dataset.rows import ABOUT, CARD, MAP, files_of, rows_of, write_card
from torchgco.experiments.ending import RunParser, say
from torchgco.experiments.flying.flight import Batch, Flown, Schedule, SolveBatch, Tasks, check_time, plan_of
from torchgco.experiments.flying.metrics import check_metrics
from torchgco.experiments.flying.workers import Shared, cut, fly_all, trial_bar
from torchgco.experiments.results.files import checksum, create, damaged, readable, write
from torchgco.experiments.results.folder import COLUMNS
from torchgco.experiments.results.identity import decisive, difference, layout_digests, settings_of
from torchgco.experiments.results.lock import held_or_freed
from torchgco.experiments.results.provenance import recorded, source
from torchgco.scenarios import Task
from torchgco.scenarios.layouts import MAP_ARRAYS, map_arrays

COMMAND = "torchgco-dataset"
LeftOut = Literal["X", "K", "multipliers"]
# How the names of files begin that a start leaves before it claims a folder.
BEFORE = ".", PART[0], "run.json", "run-"
UNKNOWN = "unknown"  # license of a data set whose maker says none
# Options of a study that have nothing to decide here, with the values that leave them alone.
UNUSED = {"explain": False, "view": False, "figure": None, "objective": None}


@dataclass
class Shard(Batch):
    """Layouts of a data set, which are drawn where they are solved: all of them needn't fit into memory.

    `tasks` are of the first layout alone, `places` the numbers of the layouts, `left_out` columns that aren't kept.
    """

    left_out: Sequence[str] = ()

    def fly(self) -> pa.Table:
        """The rows of the layouts, in their order."""
        setup = self.setup
        tasks = Tasks(setup, setup.vehicle.at_rest(setup.scenario.draw(self.places, setup.seed)))
        digests = layout_digests(tasks.layouts, setup.configuration["model"]["vehicle"])
        batch = SolveBatch(tasks, range(len(self.places)), self.name, self.solver, self.bar)
        parts = [rows_of(batch.solved(group), self.left_out) for group in tasks.groups]
        rows = pa.concat_tables(parts, promote_options="default").sort_by("layout")
        return rows.append_column("layout_digest", pa.array([digests[number] for number in self.places]))

    def compile(self) -> None:
        """See `Batch`."""
        SolveBatch(self.tasks, [0], self.name, self.solver, self.bar).compile()


def make(folder: Path, words: Sequence[str], left_out: Sequence[LeftOut] = (), license: str = UNKNOWN) -> int:
    """Make a data set in a folder, or go on with it where it was stopped; returns how many layouts it has.

    Args:
        words: KEY=VALUE and GROUP=OPTION as `torchgco` takes them; `study.layouts` says how many, and more of them
            later extend a data set.
        left_out: arrays that aren't kept.
        license: of the data, for its card.

    Raises:
        InputError: a configuration that a part refuses, missions or fleets, a folder with other files of a data set, or
            in which another process works, damaged files.
    """
    check_value(left_out, Sequence[LeftOut], "--without")
    setup = _composed(words)
    plan, available, count = plan_of(setup), setup.scenario.available, setup.configuration["study"]["layouts"]
    count = check_value(available or DEFAULT_LAYOUTS if count is None else count, Count, "study.layouts")
    setup.scenario.draw([count - 1], setup.seed)  # refused where a file has fewer
    tasks, first = Tasks(setup, setup.layouts(1)), setup.scenario.draw(range(min(2, available or 2)), setup.seed)
    task = _checked(tasks)
    command = [str(folder), *words]
    about = _about(setup, left_out)
    with held_or_freed(folder, plan.job, plan.jobs, partial(_free, folder, about)):
        _claim(folder, about)
        absent: list[str] = list(left_out)
        if first.map is not None and first.count > 1 and first.map.batch is None:  # of all: not in every row
            arrays, absent = map_arrays(first.map), [*left_out, *MAP_ARRAYS]
            create(folder / MAP, lambda file: np.savez_compressed(file, **arrays))  # type: ignore[arg-type]
        with recorded(folder, setup, plan, command, COMMAND):
            left = plan.share(_missing(folder, count, plan.repair).tolist(), count)
            _fly(folder, tasks, plan, left, absent, len(plan.share(range(count), count)))
            made = {**source(), "command": shlex.join([COMMAND, *command])}
            write_card(folder, setup, task.problem, count, made, license)
        for path in folder.glob(f"{PART[0]}*{PART[1]}") if plan.job is None else ():  # of a start that was killed
            path.unlink(missing_ok=True)
    return count - len(_missing(folder, count, False))


def _composed(words: Sequence[str]) -> Setup:
    """The configuration of a data set."""
    check_once(words)
    if others := [word for word in words if word.startswith("study.baselines=")]:
        raise InputError("study.baselines", "none: a data set is of one solver", others[0])
    setup = compose([*words, "study.baselines=[]"])
    for name, usual in UNUSED.items():
        if (value := setup.configuration["study"][name]) != usual:
            raise InputError(f"study.{name}", f"{usual} for a data set", value)
    if setup.mission is not None:
        raise InputError("mission", "null for a data set", "a mission")
    return setup


def _checked(tasks: Tasks) -> Task:
    """The problem of the first layout, with which solver and metrics can do something."""
    if tasks.layouts.vehicles is not None:
        raise InputError("scenario", "single vehicles for a data set", f"fleets of {tasks.setup.scenario.name}")
    task = tasks.of([0], exact=True)
    check_time(task, {tasks.setup.solver_name: tasks.setup.solver})
    check_metrics(tasks.setup.metrics, COLUMNS, task.problem, task.U0)
    return task


def _about(setup: Setup, left_out: Sequence[str]) -> dict[str, Any]:
    """What decides the rows of a data set."""
    configuration, solver = setup.configuration, {setup.solver_name: settings_of(setup.configuration)}
    about = {"version": VERSION, "seed": setup.seed, "left_out": sorted(left_out)} | decisive(configuration, solver)
    if os.path.isfile(path := configuration["scenario"].get("path") or ""):
        about["file"] = checksum(Path(path))  # it may be edited between two starts
    return json.loads(json.dumps(about, default=str))


def _claim(folder: Path, about: Mapping[str, Any]) -> None:
    """Make the folder that of this data set; InputError where it is another's, or holds other files."""
    text = json.dumps(about, indent=1).encode()
    expected, there = "an empty folder, or one of this very data set", folder / ABOUT
    others = [path.name for path in folder.iterdir() if not path.name.startswith(BEFORE)]
    if others and not there.is_file():
        raise damaged(there, "is missing") if files_of(folder) else InputError("FOLDER", expected, f"{others[0]} in it")
    if create(there, lambda file: file.write(text)):
        return
    if (stored := _stored(there)) != about:
        raise InputError("FOLDER", expected, f"{folder}, which holds another ({difference(stored, about)})")


def _stored(path: Path) -> dict[str, Any]:
    return readable(path, lambda path: json.loads(regular(path).read_bytes()))


def _free(folder: Path, about: Mapping[str, Any]) -> None:
    """Leave the folder to any data set, where this one has claimed it and nothing is solved."""
    if not files_of(folder) and _stored(folder / ABOUT) == about:
        for path in (*(folder / name for name in (ABOUT, MAP, CARD)), *folder.glob("run*.json")):
            path.unlink(missing_ok=True)


def _missing(folder: Path, count: int, repair: bool) -> np.ndarray:
    """The layouts that no file holds; InputError where a file is damaged, with `repair` it is removed."""
    left = np.ones(count, bool)
    for path, numbers in files_of(folder).items():
        try:
            whole = readable(path, pq.read_metadata).num_rows == len(numbers)
        except InputError:
            whole = False
        if whole:
            left[numbers.start : numbers.stop] = False
        elif not repair:
            raise damaged(path, "is damaged")
        else:
            path.unlink(missing_ok=True)
    return np.flatnonzero(left)


def _fly(folder: Path, tasks: Tasks, plan: Schedule, left: Sequence[int], left_out: Sequence[str], count: int) -> None:
    """Solve the layouts that are left, and write a file for each shard."""
    batches, setup = cut(left, plan.shard_size), tasks.setup
    if not batches:
        return
    if len(left) < count:
        say(f"Resumed in {folder}: {count - len(left)} of {count} layouts were solved before.")

    def keep(flown: Flown) -> None:
        rows: pa.Table = flown[1]
        first, last = rows["layout"][0].as_py(), rows["layout"][-1].as_py()
        path = folder / f"layouts-{first:09d}-{last:09d}.parquet"
        write(path, lambda file: pq.write_table(rows, file, compression="zstd"))

    with trial_bar(COMMAND, count, len(left)) as bar:
        workers = min(plan.workers or 1, len(batches))
        seen: Any = Shared() if workers > 1 else bar
        shards = [Shard(tasks, ids, setup.solver_name, setup.solver, seen, left_out) for ids in batches]
        fly_all(shards, workers, bar, keep)


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-dataset`. Returns the exit code, see `ended`."""
    what = (
        "Layouts of a study's configuration, solved by its solver: states, controls, gains and multipliers in parquet."
    )
    parser = RunParser(COMMAND, what, "FOLDER KEY=VALUE", trusts=False)
    parser.add_argument("folder", metavar="FOLDER", type=Path, help="new, or of the same data set, which goes on")
    words = "as torchgco takes them: scenario=forest solver=gco study.layouts=1000000 study.workers=8"
    parser.add_argument("words", metavar="KEY=VALUE", nargs="*", help=words)
    kinds = list(get_args(LeftOut))
    words = f"leave arrays out: {', '.join(kinds)}; K and multipliers take most of the room"
    parser.add_argument("--without", metavar="ARRAY", nargs="+", choices=kinds, default=[], help=words)
    parser.add_argument("--license", default=UNKNOWN, help=f"of the data, such as CC-BY-4.0; default: {UNKNOWN}")
    return parser.run(arguments, _run)


def _run(options: argparse.Namespace) -> int:
    folder = options.folder
    count = make(folder, options.words, options.without, options.license)
    size = sum(path.stat().st_size for path in files_of(folder))
    say(f"{folder}: {count} layout{'s' if count != 1 else ''}, {size / 1e6:.2f} MB")
    return 0
