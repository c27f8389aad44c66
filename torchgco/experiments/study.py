"""A study: several solvers fly the same layouts, and every flight becomes a row."""

from __future__ import annotations

import multiprocessing
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from tqdm import tqdm

import torchgco
from torchgco.certificate import certify
from torchgco.certificate import frame_columns as certificate_columns
from torchgco.experiments.build import Setup, allotted_cores, build, solver_of
from torchgco.experiments.records import COLUMNS, Records
from torchgco.experiments.report import write_report
from torchgco.judge import SUCCESS_COST, frame_columns, judge
from torchgco.kernels import compile_kernels, compiling
from torchgco.problem import Problem
from torchgco.rollout import open_loop
from torchgco.scenarios import Layouts
from torchgco.shapes import InputError
from torchgco.solution import Solution
from torchgco.solvers.memory import is_out_of_memory, plan_batch
from torchgco.solvers.state import Progress
from torchgco.status import Status

# How the configuration of a baseline is found: its name in, the whole configuration with that solver out.
Recompose = Callable[[str], DictConfig]
WARM_UP = 8  # problems that are solved once for what they compile
NOT_FLOWN = (Status.INVALID_START.name, Status.NON_FINITE.name)


def run_study(config: DictConfig, folder: Path, recompose: Recompose, show: Callable[[str], None] = print) -> int:
    """Fly, judge, write and report; returns how many trials could be flown at all.

    Starting it again on the same folder goes on where it was stopped; finished, it only shows the table.

    Raises:
        InputError: malformed configuration, or a folder that holds another study.
    """
    setup = build(config)
    layouts = setup.layouts()
    setup.vehicle.task(layouts.take([0]))  # a misfit is said before anything is written
    solvers = _solvers(setup, recompose)
    records = Records(folder)
    records.claim(_described(config), layouts)
    if records.finished():
        show(f"Already done in {folder}: nothing was computed anew.\n")
    else:
        rows, U = _fly_all(setup, layouts, solvers, records)
        trials = with_success(rows, layouts, len(solvers))
        records.finish(trials, U, list(solvers), layouts)
    show(write_report(folder, lambda held, flown: _trajectories(setup, layouts, flown)))
    records.close()
    show(f"\nTable, arrays and figures: {folder}")
    trials = pd.read_parquet(folder / "trials.parquet")
    return int((trials["status"] != Status.INVALID_START.name).sum())


def _described(config: DictConfig) -> dict[str, Any]:
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return {"version": torchgco.__version__, **{str(key): value for key, value in plain.items()}}


def _solvers(setup: Setup, recompose: Recompose) -> dict[str, Any]:
    """The solver under study first, then the baselines; one that is the solver itself is dropped."""
    baselines = setup.config.study.baselines
    if isinstance(baselines, str) or not all(isinstance(name, str) for name in baselines or ()):
        raise InputError("study.baselines", "a list of solver names, as [al_ilqr]", repr(baselines))
    solvers = {setup.solver_name: setup.solver}
    for name in baselines or ():
        if name not in solvers:
            solvers[name] = solver_of(recompose(name))
    return solvers


def _fly_all(
    setup: Setup, layouts: Layouts, solvers: Mapping[str, Any], records: Records
) -> tuple[pd.DataFrame, np.ndarray]:
    """Rows and controls of every solver on every layout, shard by shard, from the files where they exist."""
    size = _shard_size(setup)
    rows: list[pd.DataFrame] = []
    controls: list[np.ndarray] = []
    with tqdm(total=layouts.count * len(solvers), unit="trial", dynamic_ncols=True) as bar:
        bar_knows = _fly_side_by_side(setup, layouts, solvers, records, bar)
        for name, solver in solvers.items():
            bar.set_description(name)
            flown = []
            for start in range(0, layouts.count, size):
                shard = records.shard(name, start)
                batch = layouts.take(range(start, min(start + size, layouts.count)))
                if not shard.is_file():
                    records.write_shard(shard, *_Flight(setup, batch, name, solver, bar).fly())
                elif shard not in bar_knows:
                    bar.update(batch.count)
                table, U = records.read_shard(shard)
                rows.append(table)
                flown.append(U)
            controls.append(np.concatenate(flown))
    return pd.concat(rows, ignore_index=True), np.stack(controls)


def _fly_side_by_side(
    setup: Setup, layouts: Layouts, solvers: Mapping[str, Any], records: Records, bar: tqdm
) -> set[Path]:
    """The shards that are missing, by as many processes as `study.workers` says; returns those written."""
    size, missing = _shard_size(setup), []
    for name, solver in solvers.items():
        for start in range(0, layouts.count, size):
            batch = layouts.take(range(start, min(start + size, layouts.count)))
            if not records.shard(name, start).is_file():
                missing.append((records.shard(name, start), setup, batch, name, solver))
    workers = min(_workers(setup), len(missing))
    if workers < 2:
        return set()  # one after the other, in this process, with a bar that moves inside a batch
    bar.set_description(f"{workers} processes")
    with multiprocessing.get_context("spawn").Pool(
        workers, _prepare_worker, (torch.get_num_threads(), compiling())
    ) as pool:
        for shard, rows, U in pool.imap_unordered(_fly_batch, missing):
            records.write_shard(shard, rows, U)
            bar.update(len(rows))
        pool.close()  # workers that end by themselves leave nothing behind; those that are terminated do
        pool.join()
    return {shard for shard, *_ in missing}


def _shard_size(setup: Setup) -> int:
    size = setup.config.study.shard_size
    if isinstance(size, bool) or not isinstance(size, int) or size < 1:
        raise InputError("study.shard_size", "at least 1", repr(size))
    return size


def _slots(setup: Setup, problem: Problem) -> int:
    """How many problems of a shard are worked on at once."""
    wanted = setup.config.study.batch_size
    if wanted == "auto":
        return min(problem.B, plan_batch(problem, setup.device, _workers(setup)))
    if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted < 1:
        raise InputError("study.batch_size", "at least 1, or auto", repr(wanted))
    return min(problem.B, wanted)


def _workers(setup: Setup) -> int:
    wanted = setup.config.study.workers
    if wanted is None:
        # On a GPU the batches would fight for one device.
        return 1 if setup.device.type == "cuda" else max(1, allotted_cores() // torch.get_num_threads())
    if isinstance(wanted, bool) or not isinstance(wanted, int) or wanted < 1:
        raise InputError("study.workers", "at least 1, or null for one a core", repr(wanted))
    return wanted


def _prepare_worker(threads: int, compiled: bool) -> None:
    torch.set_num_threads(threads)
    compile_kernels(compiled)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer


def _fly_batch(job: tuple[Path, Setup, Layouts, str, Any]) -> tuple[Path, pd.DataFrame, np.ndarray]:
    shard, setup, batch, name, solver = job
    return shard, *_Flight(setup, batch, name, solver, tqdm(disable=True)).fly()


@dataclass
class _Flight:
    """One shard of layouts flown by one solver."""

    setup: Setup
    layouts: Layouts
    name: str
    solver: Any
    bar: tqdm
    shown: int = 0

    def fly(self) -> tuple[pd.DataFrame, np.ndarray]:
        """Rows (without success) and controls (L, N, m), NaN where nothing was flown."""
        setup, layouts = self.setup, self.layouts
        task = setup.vehicle.task(layouts, setup.device, setup.dtype)
        ids = torch.as_tensor(layouts.ids, device=setup.device)
        solution, seconds, slots = self._solve(task.problem, task.U0, ids)
        self.bar.update(layouts.count - self.shown)
        statuses = [status.name for status in solution.statuses]
        U = solution.U.detach().to("cpu", torch.float64)
        U[[status in NOT_FLOWN for status in statuses]] = torch.nan
        checked = setup.vehicle.task(layouts)
        verdict = judge(checked.problem, U, checked.goal, checked.goal_radius)
        certificate = certify(checked.problem, solution.X.detach().to("cpu", torch.float64), U, verdict.feasible)
        rows = pd.DataFrame(
            {
                "scenario": layouts.name, "layout": layouts.ids, "seed": setup.seed, "model": setup.vehicle.name,
                "solver": self.name, "status": statuses, **frame_columns(verdict), "sound": verdict.sound.numpy(),
                **certificate_columns(certificate),
                "iterations": solution.iterations.cpu().numpy(),
                "outer_iterations": solution.outer_iterations.cpu().numpy(),
                "guided": solution.guided.cpu().numpy(), "seconds": seconds, "batch_size": slots,
                "threads": torch.get_num_threads(), "device": setup.device.type,
                "dtype": str(setup.dtype).removeprefix("torch."), "version": torchgco.__version__,
            }
        )  # fmt: skip
        return rows, U.numpy()

    def _solve(self, problem: Problem, U0: Tensor, ids: Tensor) -> tuple[Solution, float, int]:
        """The solution, seconds a problem, and slots; half as many slots wherever memory runs out."""
        slots, solver = _slots(self.setup, problem), self.solver
        # What a solver builds or compiles for a batch is set-up: the clock starts after it.
        solver = solver.prepare(problem) if hasattr(solver, "prepare") else solver
        if compiling():
            few = torch.arange(min(WARM_UP, problem.B), device=U0.device)
            self.solver.solve(problem.take(few), U0[few], seed=self.setup.seed, ids=ids[few])
        while True:
            solver = replace(solver, slots=slots) if hasattr(solver, "slots") else solver
            began = _now(self.setup.device)
            try:
                solution = solver.solve(problem, U0, seed=self.setup.seed, ids=ids, callback=self._progress)
            except (RuntimeError, MemoryError) as error:
                if slots == 1 or not hasattr(solver, "slots") or not is_out_of_memory(error):
                    raise
                slots //= 2
                self.bar.write(f"{self.name}: out of memory, on with {slots} problems at once", sys.stderr)
                continue
            return solution, (_now(self.setup.device) - began) / problem.B, slots

    def _progress(self, progress: Progress) -> None:
        self.bar.update(max(0, progress.finished - self.shown))
        self.bar.set_postfix({"pass": progress.passes}, refresh=False)
        self.shown = max(self.shown, progress.finished)


def with_success(rows: pd.DataFrame, layouts: Layouts, solvers: int) -> pd.DataFrame:
    """The rows with `best_cost` and `success`: against the file's best, else the best in the study.

    Where neither is known (a single solver, no best in the file) success is NA.
    """
    best_sound = rows["cost"].where(rows["sound"].astype(bool)).groupby(rows["layout"]).transform("min")
    best = pd.Series(np.nan, index=rows.index)
    if layouts.best_cost is not None:
        best = rows["layout"].map(dict(zip(layouts.ids.tolist(), layouts.best_cost, strict=True)))
    known = best.notna() | (solvers > 1)
    best = best.fillna(best_sound) if solvers > 1 else best
    success = (rows["sound"].astype(bool) & (rows["cost"] <= SUCCESS_COST * best)).astype("boolean")
    trials = rows.assign(best_cost=best.astype(float), success=success.where(known, pd.NA))
    return trials[list(COLUMNS)]


def _trajectories(setup: Setup, layouts: Layouts, flown: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """States (L, N+1, n) of every solver, for the pictures."""
    problem = setup.vehicle.task(layouts).problem
    names: Sequence[str] = flown["solver"].tolist()
    return {
        name: open_loop(problem.dynamics, problem.x0, torch.from_numpy(U)).numpy()
        for name, U in zip(names, flown["U"], strict=True)
    }


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
