"""Loops without an end: the memory of an `MPC` over thousands of steps, and the steps of an environment per second."""

from __future__ import annotations

import os
import resource
import time

import numpy as np
import torch

import torchgco
from benchmarks.endurance.memory import resident
from benchmarks.speed.bench import SEED, Bench
from benchmarks.speed.loop import CAR, CENTERS, DT, START, problem, reference

SECTION = "endless"
FIRST = 100  # steps after which memory is compared
FLOWN = 50  # steps of the environment that are timed


def run(bench: Bench) -> None:
    _controller(bench, bench.sizes.endless_steps)
    try:
        import gymnasium as _  # noqa: F401
    except ImportError:
        bench.row(SECTION, "environment", "torchgco.envs", "left out", "gymnasium is not installed")
        return
    for control in ("rates", "rotors"):
        _environment(bench, control, bench.sizes.endless_missions)


def _controller(bench: Bench, steps: int) -> None:
    """A car follows a reference by `MPC`, disturbed in each step."""
    mpc = torchgco.MPC(problem(START[None], reference(0.0)[None], CENTERS))
    x, random = START.copy(), np.random.default_rng(SEED)
    compilers = memory = 0.0
    for k in range(steps):
        u = mpc.step(x, x_ref=reference(DT * k)).numpy()
        x = CAR.step(torch.tensor(x[None]), torch.tensor(u[None]))[0].numpy() + 0.01 * random.standard_normal(4)
        if k == 0:
            compilers = _of_children()
        if k == FIRST:
            memory = resident(os.getpid())
    case = f"car, {steps:,} steps"
    bench.row(SECTION, case, "MPC", f"memory after {FIRST} steps", memory, "MiB")
    bench.row(SECTION, case, "MPC", "memory at the end", resident(os.getpid()), "MiB")
    bench.row(SECTION, case, "MPC", "compilers after the first step", _of_children() - compilers, "s")


def _of_children() -> float:
    """Processor time of all processes that this one has started, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _environment(bench: Bench, control: str, missions: int) -> None:
    """Missions in forests that hover by the same action."""
    from torchgco.envs import MissionVectorEnv

    env = MissionVectorEnv(missions, control=control)  # type: ignore[arg-type]
    env.reset(seed=SEED)
    low, high = env.single_action_space.low, env.single_action_space.high  # type: ignore[attr-defined]
    hover = np.tile((low + high) / 2, (missions, 1)).astype(np.float32)
    env.step(hover)
    began = time.process_time()
    for _ in range(FLOWN):
        env.step(hover)
    rate = missions * FLOWN / (time.process_time() - began)
    bench.row(SECTION, f"{missions} missions, control={control}", "torchgco.envs", "steps per second", rate)
