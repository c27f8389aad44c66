"""A study: several solvers fly the same layouts, every flight becomes a row, and what failed is explained in words."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError
from torchgco.base.status import Status
from torchgco.base.version import VERSION
from torchgco.experiments.config.build import Setup, build, solver_of
from torchgco.experiments.ending import say
from torchgco.experiments.flying.flight import Batch, Schedule, SolveBatch, Tasks, check_time, plan_of
from torchgco.experiments.flying.metrics import check_metrics
from torchgco.experiments.flying.mission_flight import PLANS_KEPT, FleetBatch, MissionBatch, check_fleets
from torchgco.experiments.flying.progress import Bar
from torchgco.experiments.flying.workers import Shared, cut, fly_all, trial_bar
from torchgco.experiments.reports.report import mission_table, write_fleet_report, write_mission_report, write_report
from torchgco.experiments.reports.view import write_view
from torchgco.experiments.results.durations import states_of, times_at
from torchgco.experiments.results.folder import COLUMNS, DONE, JUDGED, StudyFolder, with_success
from torchgco.experiments.results.identity import (
    Manifest,
    closed_loop,
    difference,
    digest,
    files_of,
    layout_digests,
    settings_of,
)
from torchgco.experiments.results.kinds import check_objective
from torchgco.experiments.results.lock import held_or_freed
from torchgco.experiments.results.merge import values_of
from torchgco.experiments.results.provenance import recorded
from torchgco.explaining.advice import Facts, advice
from torchgco.explaining.explain import LINE_WIDTH, explanation, map_facts
from torchgco.missions import Mission
from torchgco.plotting.ways import Way, ways_along
from torchgco.scenarios import Layouts, Task

EXPLAINED = 8  # layouts at most


def advised(tasks: Tasks, trials: pd.DataFrame) -> str:
    """What to try for the layouts whose goal the solver under study didn't reach; "" where it reached all.

    As `Solution.explain` has it, without solving again: of the first layouts, each sentence with those that it is for.
    """
    setup = tasks.setup
    flown = trials[trials["solver"] == setup.solver_name]
    short = flown[~flown["reached"].astype("boolean").fillna(False).astype(bool)]
    if len(short) == 0:
        return ""
    shown = short.head(EXPLAINED)
    sentences: dict[str, list[str]] = {}
    for row in shown.to_dict("records"):
        problem, status = tasks.of([row["layout"]]).problem, Status[str(row["status"])]
        facts = Facts(
            status, setup.solver, hasattr(setup.solver, "passes"), bool(problem.obstacles), False, None,
            float(row["clearance"]), **map_facts(problem, status, False),
        )  # fmt: skip
        for sentence in [*facts.told[1:], *advice(facts)]:
            sentences.setdefault(sentence, []).append(str(row["layout"]))
    more = f", the first {len(shown)} of them here" if len(short) > len(shown) else ""
    lines = [f"\n{setup.solver_name} did not reach {len(short)} of {len(flown)} goals{more}. What to try:"]
    for sentence, places in sentences.items():
        layouts_told = f"layout{'s' if len(places) > 1 else ''} {', '.join(places)}: "
        lines.append(textwrap.fill(layouts_told + sentence, LINE_WIDTH, initial_indent="  ", subsequent_indent="    "))
    return "\n".join([*lines, "study.explain=true tells what was tried."])


def where_to_start(tasks: Tasks) -> str:
    """What a study needs all of whose layouts begin inside an obstacle."""
    if tasks.layouts.vehicles is not None:
        return "a fleet whose vehicles start outside their obstacles, and apart"
    problem = tasks.of([0], exact=True).problem
    unknown = map_facts(problem, Status.INVALID_START, False)["in_unknown"]
    free = ", or scenario.unknown=free, as unknown cells count as occupied" if unknown else ""
    return f"a layout whose start is outside its obstacles{free}"


def explained(tasks: Tasks, trials: pd.DataFrame) -> str:
    """What happened to the first layouts that the solver under study failed on.

    Failed are those without success, where that is known, else those whose goal wasn't reached. They are solved again
    with a record, by which no bit of a result changes.
    """
    name = tasks.setup.solver_name
    flown = trials[trials["solver"] == name]
    failed = flown.loc[~flown["success"].fillna(flown["reached"]).astype(bool), "layout"].tolist()
    if not failed:
        return f"\n{name} failed on no layout: there is nothing to explain."
    shown = failed[:EXPLAINED]
    by_layout = dict[int, str]()
    for rows in tasks.layouts.take(shown).alike():
        by_layout |= _told(tasks, np.array(shown)[rows])
    texts = [by_layout[number] for number in shown]
    more = f", the first {len(shown)} of them here" if len(failed) > len(shown) else ""
    return "\n\n".join([f"\n{name} failed on {len(failed)} of {len(flown)} layouts{more}.", *texts])


def _told(tasks: Tasks, places: np.ndarray) -> dict[int, str]:
    """What happened to layouts with as many stages, by their numbers."""
    setup, task = tasks.setup, tasks.of(places)
    ids = torch.as_tensor(places, device=setup.device)
    solution = setup.solver.recording().solve(task.problem, task.U0, seed=setup.seed, ids=ids)
    solution = replace(solution, account=solution.account.asked(task.problem, setup.solver_name))
    return {number: explanation(solution, i, what=f"Layout {number}") for i, number in enumerate(places.tolist())}


# From a baseline's name to the whole configuration with that solver.
Recompose = Callable[[str], dict[str, Any]]


def run_study(
    configuration: dict[str, Any],
    folder: Path,
    recompose: Recompose,
    accepted: Callable[[], None] = lambda: None,
    command: Sequence[str] = (),
    collect: bool = False,
    swept: Sequence[str] = (),
) -> bool:
    """Fly, judge, write and report; returns False where a job flew its share of a study that others finish.

    Started again on the same folder it resumes where it was stopped; a finished study only shows its table. Started
    twice at once, the second waits for the first, and is refused where that takes too long. Whatever is raised before
    the first rows are kept leaves the folder to any study.

    Args:
        recompose: makes the configuration of a baseline.
        accepted: called once the folder is known to be this study's; before that nothing is written.
        command: the command line, for run.json.
        collect: fly nothing, only judge, write and report what jobs flew.
        swept: keys that the sweep of which this study is a part changes: columns of its trials.

    Raises:
        InputError: malformed configuration, a folder that holds another study or in which another process flies this
            one, damaged files, worker processes that die again and again, no layout that could be flown at all, missing
            trials where `collect` is set.
    """
    study = _study(configuration, recompose)
    store = StudyFolder(folder, study.manifest, study.plan.repair)
    with held_or_freed(folder, study.plan.job, study.plan.jobs, store.free):
        store.claim()
        accepted()
        with recorded(folder, study.setup, study.plan, command) as ending:
            if study.plan.job is not None:
                _fly_share(study, store)
                ending.append("share flown")
                return False
            _fly_and_report(study, store, collect, swept)
            return True


def _fly_share(study: _Study, store: StudyFolder) -> None:
    """Fly the share of a job, and leave the tables to the process that finishes the study."""
    name = f"Job {study.plan.job} of {study.plan.jobs}"
    if store.finished(study.layouts):
        say(f"{name}: already done in {store.path}")
        return
    missing = {solver: study.plan.share(store.missing(solver), study.layouts.count) for solver in study.solvers}
    _fly(study, store, missing, name)
    if (store.path / DONE).is_file():  # another process flew the rest, and this share, meanwhile
        store.drop_shards()
    say(f"{name}: {sum(map(len, missing.values()))} trials flown in {store.path}")


def _fly_and_report(study: _Study, store: StudyFolder, collect: bool, swept: Sequence[str]) -> None:
    folder = store.path
    if store.finished(study.layouts):
        say(f"Already done in {folder}: nothing was flown again.\n")
        _update(study, store, swept)
    else:
        missing = {name: store.missing(name) for name in study.solvers}
        count, left = study.layouts.count * len(study.solvers), sum(map(len, missing.values()))
        if collect and left:
            state = f"{left} of {count} trials missing in {folder} (the same command flies them)"
            raise InputError("study.jobs", "a share from every job", state)
        if left < count and not collect:
            say(f"Resumed in {folder}: {count - left} of {count} trials were flown before.\n")
        _fly(study, store, missing, study.setup.solver_name)
        flown = [store.flown(name) for name in study.solvers]
        rows = pd.concat([rows for rows, _ in flown], ignore_index=True)
        rows = rows.assign(**values_of(rows, study.manifest, swept))
        _finish(study, store, rows, np.stack([U for _, U in flown]))
    say(_report(study, folder))
    store.close()
    trials = store.table()
    if study.plan.explain:
        say(explained(study.tasks, trials))
    elif study.setup.mission is None and study.layouts.vehicles is None and (state := advised(study.tasks, trials)):
        say(state)
    say(f"\nTable, arrays and figures: {folder}")
    if study.plan.view:
        say(f"Page: {write_view(folder, trust=True)}")  # the folder is this very command's
    if (trials["status"] == Status.INVALID_START.name).all():
        raise InputError("scenario", where_to_start(study.tasks), "none")


@dataclass(frozen=True)
class _Study:
    """A configuration, checked and built."""

    plan: Schedule
    tasks: Tasks
    solvers: dict[str, Any]  # by name, the one under study first
    manifest: Manifest

    @property
    def setup(self) -> Setup:
        return self.tasks.setup

    @property
    def layouts(self) -> Layouts:
        return self.tasks.layouts

    @property
    def rivals(self) -> int:
        """How many solvers have costs to compare: none in missions."""
        return len(self.solvers) if self.setup.mission is None else 1


def _finish(study: _Study, store: StudyFolder, rows: pd.DataFrame, flown: np.ndarray) -> None:
    """Write the files of a study from its rows and what was flown, (solver, L, ...)."""
    results: np.ndarray | pd.DataFrame = flown
    if study.setup.mission is not None:
        results = mission_table(store.path, study.tasks, list(study.solvers), flown)
    store.finish(with_success(rows, study.layouts, study.rivals), results, study.layouts)


def _report(study: _Study, folder: Path) -> str:
    """Write the report of a finished study, and return it as text."""
    if study.setup.mission is not None:
        return write_mission_report(folder, study.tasks, figures=study.plan.figures)
    plan = study.plan
    if study.layouts.vehicles is not None:
        return write_fleet_report(folder, study.setup.vehicle, study.layouts, plan.figures)
    return write_report(folder, partial(_trajectories, study), plan.figures, plan.figure, study.tasks)


def _study(configuration: dict[str, Any], recompose: Recompose) -> _Study:
    setup = build(configuration)
    tasks = Tasks(setup, setup.layouts())
    plan, fleets = plan_of(setup), tasks.layouts.vehicles is not None
    if fleets:
        check_fleets(setup, tasks.layouts, plan)
    else:
        task = tasks.of([0], exact=True)  # raises where model and layouts don't fit
    if setup.metrics:
        if fleets or setup.mission is not None:
            raise InputError("study.metrics", "null for missions and fleets", ", ".join(setup.metrics))
        first = tasks.of(tasks.groups[0][:2], exact=True)
        check_metrics(setup.metrics, COLUMNS, first.problem, first.U0)
    if (objective := configuration["study"]["objective"]) is not None:
        check_objective(objective, setup.mission is not None)
        if plan.jobs is not None:
            raise InputError("study.objective", "null where jobs share a study: none of them has its number", objective)
    if setup.mission is not None:
        check_mission(setup.mission, task)
        if plan.explain:
            raise InputError("study.explain", "false in missions: single solves can be explained", True)
        if plan.figure is not None:
            raise InputError("study.figure", "null for missions, which have figures of their own", plan.figure)
    rivals = _rivals(configuration, recompose)
    solvers = {name: setup.solver if config is configuration else solver_of(config) for name, config in rivals.items()}
    if setup.mission is None and not fleets:
        check_time(task, solvers)
    plant = None if setup.mission is None else setup.mission.plant
    decided = {**configuration, **files_of(configuration, getattr(plant, "files", ()))}
    manifest = Manifest(
        configuration={"version": VERSION, **decided},
        solvers={name: settings_of(config) for name, config in rivals.items()},
        layouts=layout_digests(tasks.layouts, configuration["model"]["vehicle"], closed_loop(decided)),
    )
    return _Study(plan, tasks, solvers, manifest)


def check_mission(mission: Mission, task: Task) -> None:
    dynamics = task.problem.dynamics
    mission.check(dynamics)
    mission.check_stated(task.problem)
    if mission.duration < dynamics.dt:
        raise InputError("mission.duration", f"at least one control period, {dynamics.dt:g} s", mission.duration)


def _rivals(configuration: dict[str, Any], recompose: Recompose) -> dict[str, dict[str, Any]]:
    """The configurations of the solvers by name, the one under study first; a baseline that equals it is left out."""
    studied = configuration["solver"]["name"]
    rivals = {studied: configuration}
    for option in configuration["study"]["baselines"] or ():
        other = recompose(option)
        name = other["solver"]["name"]
        here, there = settings_of(rivals.get(name, other)), settings_of(other)
        if digest(here) != digest(there):
            if name != studied:
                raise InputError("study.baselines", "solvers with a `name` each", f"several {name}")
            expected = f"another name, as the baseline {option} has other settings: solver.name={studied}_changed"
            raise InputError("solver.name", expected, f"{studied} ({difference(there, here)})")
        rivals.setdefault(name, other)
    return rivals


def _fly(study: _Study, store: StudyFolder, missing: Mapping[str, Sequence[int]], name: str) -> None:
    """Fly the missing layouts of every solver, and keep them as shards."""
    batches = [(name, ids) for name, left in missing.items() for ids in cut(left, study.plan.shard_size)]
    if not batches:
        return
    count = len(study.plan.share(range(study.layouts.count), study.layouts.count)) * len(study.solvers)
    with trial_bar(name, count, sum(map(len, missing.values()))) as bar:
        workers = min(study.plan.workers or 1, len(batches))
        seen = Shared() if workers > 1 else bar
        flights = [_flight(study, name, ids, seen, alone=workers > 1) for name, ids in batches]
        fly_all(flights, workers, bar, lambda flown: store.keep(*flown))


def _flight(study: _Study, name: str, ids: Sequence[int], bar: Bar, alone: bool = False) -> Batch:
    """The flight of some layouts; `alone`: by another process, which makes their problems itself."""
    # A study's ids are positions, 0..L-1 (`Setup.layouts`).
    tasks, solver = study.tasks, study.solvers[name]
    tasks, places = (tasks.part(ids), range(len(ids))) if alone else (tasks, ids)
    if study.setup.mission is None:
        batch = SolveBatch if study.layouts.vehicles is None else FleetBatch
        most = None if study.layouts.stages is None else int(np.max(study.layouts.stages))
        return batch(tasks, places, name, solver, bar, most)
    return MissionBatch(tasks, places, name, solver, bar, plans=study.layouts.count <= PLANS_KEPT)


def _update(study: _Study, store: StudyFolder, swept: Sequence[str]) -> None:
    """Judge the rows of a finished study again where best costs have changed since; add columns of a sweep."""
    trials = store.table()
    missing = [key for key in swept if key not in trials.columns]
    new = with_success(trials, study.layouts, study.rivals).assign(**values_of(trials, study.manifest, missing))
    changed = not new[list(JUDGED)].astype(object).equals(trials[list(JUDGED)].astype(object))
    if changed or len(new.columns) > len(trials.columns):
        store.replace(new, study.layouts)
    if changed:
        say("The best costs of the layouts have changed: best_cost and success were computed again.\n")


def _trajectories(study: _Study, flown: Mapping[str, np.ndarray], count: int) -> dict[str, list[Way]]:
    """The trajectories of every solver through the first `count` layouts, for the pictures."""
    names, every, times = flown["solver"].tolist(), flown["U"], flown.get("times")
    ways = {name: dict[int, Way]() for name in names}
    for places in (shown for group in study.tasks.groups if len(shown := group[group < count])):
        problem = study.tasks.of(places, exact=True).problem
        for i, name in enumerate(names):
            U = torch.from_numpy(every[i][places, : problem.N])
            t = times_at(None if times is None else times[i], places, problem.N)
            along = ways_along(problem, states_of(problem, U, t), U, t, [])
            ways[name] |= dict(zip(places.tolist(), along, strict=True))
    return {name: [by_place[place] for place in sorted(by_place)] for name, by_place in ways.items()}
