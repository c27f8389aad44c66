"""One solver flies a batch of layouts, whose problems all share, and every flight becomes a row."""

from __future__ import annotations

import sys
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from torchgco.base import clock
from torchgco.base.errors import InputError
from torchgco.base.options import Count, Within, check_options
from torchgco.base.status import Status
from torchgco.base.version import VERSION
from torchgco.experiments.config.build import MAX_PROCESSES, Setup
from torchgco.experiments.config.launching import allotted_cores, jobs_at_once
from torchgco.experiments.flying.metrics import metric_columns
from torchgco.experiments.flying.progress import Bar
from torchgco.experiments.results.durations import judged_columns, with_lengths
from torchgco.judging.certificate import Certificate, certify
from torchgco.judging.certificate import frame_columns as certificate_columns
from torchgco.kernels import use_native
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem
from torchgco.scenarios import Layouts, Task
from torchgco.search.reach import short_horizons
from torchgco.solution import Solution
from torchgco.solvers.contracts import CHOOSING_TIME, Progress
from torchgco.solvers.memory import is_out_of_memory, plan_batch


class Tasks:
    """Makes the problems of layouts that can be a batch together when they are first asked for.

    Args:
        layouts: of which places are told.
    """

    def __init__(self, setup: Setup, layouts: Layouts) -> None:
        self.setup, self.layouts = setup, layouts
        self._made = dict[tuple[int, bool], Task]()

    @cached_property
    def groups(self) -> list[np.ndarray]:
        """The places of layouts that can be a batch; see `Layouts.alike`."""
        return self.layouts.alike()

    @property
    def is_exact(self) -> bool:
        """Whether the study computes as the judge does."""
        return (self.setup.device.type, self.setup.dtype) == ("cpu", torch.float64)

    def of(self, places: Sequence[int] | np.ndarray, exact: bool = False) -> Task:
        """The problems of layouts of one group, in ascending order.

        Args:
            exact: on a CPU in double precision, as the judge takes them; else as the study computes.

        Raises:
            InputError: as `Vehicle.task`.
        """
        number = next(i for i, group in enumerate(self.groups) if places[0] in group)
        group, exact = self.groups[number], exact or self.is_exact
        if (number, exact) not in self._made:
            layouts = self.layouts.take(group)
            self._made[number, exact] = self.setup.vehicle.task(layouts) if exact else self.setup.task(layouts)
        task = self._made[number, exact]
        return task if len(places) == len(group) else task.take(np.searchsorted(group, places))

    def part(self, places: Sequence[int]) -> Tasks:
        """Those of some layouts alone, for another process."""
        return Tasks(self.setup, self.layouts.take(places))

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_made": {}}


Flown = tuple[str, Any]  # a solver's name, and what its batch returned
REDRAW = 0.5  # s between two drawings of the bar
PROVEN = 1e-6  # a KKT residual up to which nobody asks for a smaller one: that of a solve that ended by itself
NOT_FLOWN = (Status.INVALID_START.name, Status.NON_FINITE.name)


@dataclass(frozen=True)
class Schedule:
    """How a study is flown: options of `study` that decide no result.

    Args:
        batch_size: problems worked on at once by a process; "auto": as many as are fast and fit into memory.
        shard_size: layouts to a file.
        workers: processes; None: as many as the cores allow.
        repair: damaged files are redone.
        figures: figures are drawn when all is flown.
        figure: columns of a paper that a figure of the whole study spans, drawn then; None: no such figure.
        explain: layouts that the solver under study failed on are solved again with a record, and explained.
        view: a page of the study is written then.
        jobs: how many jobs share the layouts; None: one, which flies all.
        job: the one that this process is, 0..jobs-1; None where it flies all.

    Raises:
        InputError: an option that is malformed, and a share of no study.
    """

    batch_size: Count | Literal["auto"]
    shard_size: Count
    workers: Annotated[int, Within(1, MAX_PROCESSES)] | None
    repair: bool
    figures: bool
    figure: Literal["one", "two"] | None
    explain: bool
    view: bool
    jobs: Count | None
    job: Any

    def __post_init__(self) -> None:
        check_options(self, "study")
        whole = isinstance(self.job, int) and not isinstance(self.job, bool)
        one_of = whole and self.jobs is not None and 0 <= self.job < self.jobs
        if not one_of and not (self.job is None and self.jobs is None):
            raise InputError(
                "study.job", "one of 0 to study.jobs - 1, as in -m study.jobs=4 'study.job=range(0,4)'",
                f"study.job={self.job} study.jobs={self.jobs}",
            )  # fmt: skip

    def share(self, ids: Sequence[int], count: int) -> list[int]:
        """The part of `ids` that this process flies, of a study's layouts 0..count-1.

        A layout's share depends on nothing else: a job that is started again flies what it left.
        """
        return [number for number in ids if self.jobs is None or number * self.jobs // count == self.job]


def plan_of(setup: Setup) -> Schedule:
    """The plan of a configuration, with its number of processes.

    Raises:
        InputError: as Schedule.
    """
    plan = Schedule(**{field.name: setup.configuration["study"][field.name] for field in fields(Schedule)})
    if plan.workers is not None:
        return plan
    # On a GPU the batches of several processes would share one device.
    on_cpu = setup.device.type == "cpu"
    workers = allotted_cores() // torch.get_num_threads() if on_cpu else len(setup.devices)
    return replace(plan, workers=max(1, workers))


def check_time(task: Task, solvers: Mapping[str, Any]) -> None:
    """Refuse solvers that can't choose a free time before any of them flies."""
    if task.problem.time is None:
        return
    problem = for_solvers(task.problem)
    for index, (name, solver) in enumerate(solvers.items()):
        if solver.choosing_time(problem) is None:
            raise InputError("study.baselines" if index else "solver", f"{CHOOSING_TIME}, as it is free here", name)


@dataclass
class Batch(ABC):
    """A batch of a study's layouts that one solver flies, and how much of it the bar has shown."""

    tasks: Tasks
    places: Sequence[int]
    name: str
    solver: Any
    bar: Bar
    shown: float = field(default=0.0, kw_only=True)

    @property
    def setup(self) -> Setup:
        """Of the study."""
        return self.tasks.setup

    @property
    def shared(self) -> dict[str, Any]:
        """Columns that all rows of the batch share."""
        setup = self.setup
        return {
            "scenario": self.tasks.layouts.name, "seed": setup.seed, "model": setup.vehicle.name, "solver": self.name,
            "threads": torch.get_num_threads(), "device": setup.device.type,
            "dtype": str(setup.dtype).removeprefix("torch."), "version": VERSION,
        }  # fmt: skip

    @cached_property
    def layouts(self) -> Layouts:
        """Of this batch."""
        return self.tasks.layouts.take(self.places)

    @abstractmethod
    def fly(self) -> Any:
        """What is kept of the flights: of a study rows (without success), and an array (L, ...)."""

    def compile(self) -> None:
        """Compile what is known to be needed: where several processes fly, once for all, and beside no solve."""
        return  # a mission's problems are posed on the way

    def show(self, done: float) -> None:
        """Move the bar to so many layouts."""
        self.bar.update(max(0.0, done - self.shown))
        self.shown = max(self.shown, done)


@dataclass(frozen=True)
class Solved:
    """Layouts of a batch as a solver left them, and as they were judged."""

    task: Task
    solution: Solution
    rows: pd.DataFrame  # without success
    U: np.ndarray  # (L, N, m), float64, NaN where nothing was flown
    times: np.ndarray | None  # (L, N+1) of the knots, s, where the time is free


@dataclass
class SolveBatch(Batch):
    """Single trajectories."""

    stages: int | None = None  # N of the controls returned: the most of the study; None: of these layouts
    drawn: float = 0.0  # s, when the bar was drawn last

    def fly(self) -> tuple[pd.DataFrame, np.ndarray]:
        """Rows (without success) and controls (L, N, m), NaN where nothing was flown.

        Layouts with as many stages and gates are solved together; their controls end with those at rest. Where the time
        is free the lengths of the stages are a column more (`with_lengths`).
        """
        groups = self.layouts.alike()
        flown = [self._fly(np.array(self.places)[rows]) for rows in groups]
        order = np.argsort(np.concatenate(groups), kind="stable")
        rows = pd.concat([table for table, _ in flown], ignore_index=True).iloc[order].reset_index(drop=True)
        longest = max(self.stages or 0, *(U.shape[1] for _, U in flown))
        return rows, np.concatenate([self._lengthened(U, longest) for _, U in flown])[order]

    def compile(self) -> None:
        """See `Batch`; solvers of other libraries build what they need in the process that flies."""
        if self.solver.kernels is None:
            with warnings.catch_warnings(action="ignore"):  # the processes give them
                self.solver.prepare(self.tasks.of(np.array(self.places)[self.layouts.alike()[0]]).problem)

    def _lengthened(self, U: np.ndarray, stages: int) -> np.ndarray:
        """Controls (L, N, m) with those at rest after them, up to so many stages."""
        rest = np.array(self.setup.vehicle.control_reference, np.float64)
        rest = np.pad(rest, (0, U.shape[-1] - len(rest)))  # further stages take no time
        return np.concatenate((U, np.broadcast_to(rest, (len(U), stages - U.shape[1], len(rest)))), axis=1)

    def _fly(self, places: np.ndarray) -> tuple[pd.DataFrame, np.ndarray]:
        """The same of layouts with as many stages and gates."""
        solved = self.solved(places)
        return solved.rows, solved.U if solved.times is None else with_lengths(solved.U, solved.times)

    def solved(self, places: np.ndarray) -> Solved:
        """Layouts with as many stages and gates, solved and judged."""
        setup, self.shown = self.setup, 0
        task, layouts = self.tasks.of(places), self.tasks.layouts.take(places)
        ids = torch.as_tensor(layouts.ids, device=setup.device)
        if (warning := short_horizons(task.problem)) is not None:
            self.bar.write(f"{self.name}: {warning.replace('problem', 'layout')} (scenario.stages)", sys.stderr)
        solution, seconds, together = self._solve(task.problem, task.U0, ids)
        self.show(layouts.count)
        statuses = [status.name for status in solution.statuses]
        U = solution.U.detach().to("cpu", torch.float64)
        U[[status in NOT_FLOWN for status in statuses]] = torch.nan
        checked = self.tasks.of(places, exact=True)
        free = checked.problem.time is not None
        times = solution.t.detach().to("cpu", torch.float64) if free else None
        verdict, columns = judged_columns(checked, U, times)
        X = solution.X.detach().to("cpu", torch.float64)
        certificate = _certificate(checked.problem, X, U, verdict.feasible, solution, times)
        rows = pd.DataFrame(
            {
                **self.shared, "layout": layouts.ids, "status": statuses, **columns,
                **certificate_columns(certificate),
                **metric_columns(setup.metrics, checked.problem, U, times, layouts.ids),
                "iterations": solution.iterations.cpu().numpy(),
                "outer_iterations": solution.outer_iterations.cpu().numpy(),
                "guided": solution.guided.cpu().numpy(), "seconds": seconds, "batch_size": together,
                "kernels": (solution.account and solution.account.kernels) or "",
            }
        )  # fmt: skip
        return Solved(task, solution, rows, U.numpy(), None if times is None else times.numpy())

    def _solve(self, problem: Problem, U0: Tensor, ids: Tensor) -> tuple[Solution, float, np.ndarray]:
        """The solution, seconds per problem, and how many problems at most ran at the same time as each of them (L,).

        Each time memory runs out, half as many run at once. A solver that reports no pass runs all of them together.
        """
        # Building and compiling for a batch are set-up: the clock starts after them.
        solver, at_once = self.solver.prepare(problem), problem.B
        if solver.in_slots(1) is not None:
            plan = plan_of(self.setup)
            processes = -(-(plan.workers or 1) // len(self.setup.devices)) * jobs_at_once()  # of one device
            batch_size = None if plan.batch_size == "auto" else plan.batch_size
            at_once = min(problem.B, batch_size or plan_batch(problem, self.setup.device, processes))
            solver = solver.in_slots(at_once)
        while True:
            together = torch.zeros_like(ids)
            callback = partial(self._progress, together)
            began = _now(self.setup.device)
            try:
                solution = solver.solve(problem, U0, seed=self.setup.seed, ids=ids, callback=callback)
            except (RuntimeError, MemoryError) as error:
                smaller = solver.in_slots(max(1, at_once // 2))
                if at_once == 1 or smaller is None or not is_out_of_memory(error):
                    raise
                solver, at_once = smaller, at_once // 2
                self.bar.write(f"{self.name}: out of memory, on with {at_once} problems at once", sys.stderr)
                continue
            seconds = (_now(self.setup.device) - began) / problem.B
            if not bool(together.any()):
                together.fill_(problem.B)
            return solution, seconds, together.cpu().numpy()

    def _progress(self, together: Tensor, progress: Progress) -> None:
        """Show how far the batch is, and note in `together` how many problems ran together."""
        if progress.candidates is None:
            together[progress.rows] = together[progress.rows].clamp(min=progress.rows.numel())
            state = f"solved {progress.finished}/{progress.total}"
        else:
            state = "candidates {}/{}".format(*progress.candidates)
        self.show(progress.finished)
        now = time.monotonic()
        # A bar draws itself only where its count changes, and candidates may be solved for a minute.
        self.bar.set_postfix_str(state, refresh=now - self.drawn > REDRAW)
        self.drawn = now if now - self.drawn > REDRAW else self.drawn


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return clock.seconds()


# Functions of worker processes. They are here, not in `study`, so that no worker loads the report's figures.


_turn = 0  # of this process among the workers


def prepare(turn: int, threads: int, in_c: bool) -> None:
    """Give a worker process the threads and kernels of the study's own, and its turn among the devices."""
    global _turn
    _turn = turn
    torch.set_num_threads(threads)
    use_native(in_c)


def fly(flight: Batch) -> Flown:
    """The flight's rows and controls, under its solver's name."""
    flight.tasks.setup = replace(flight.setup, turn=_turn)
    return flight.name, flight.fly()


def _certificate(
    problem: Problem, X: Tensor, U: Tensor, asked: Tensor, solution: Solution, times: Tensor | None
) -> Certificate:
    """The certificate with the solver's multipliers, or with fitted ones where these show more.

    Either proves a stationary point; those of a solver without a dual step are no more than estimates.
    """
    multipliers = [lam.detach().to("cpu", torch.float64) for lam in solution.multipliers.lam]
    certificate = certify(problem, X, U, asked, multipliers, times)
    doubted = asked & ~(certificate.kkt_residual <= PROVEN)
    fitted = certify(problem, X, U, doubted, times=times).kkt_residual
    return replace(certificate, kkt_residual=torch.fmin(certificate.kkt_residual, fitted))
