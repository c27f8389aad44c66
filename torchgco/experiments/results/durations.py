"""Free times beside controls: in the arrays of a flight, the length of each stage is a column behind its controls."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.dynamics.rollout import open_loop
from torchgco.judging.judge import Verdict, frame_columns, judge, more_columns
from torchgco.problem.horizons import within_horizons
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem
from torchgco.scenarios import Task


def with_lengths(U: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Controls (..., N, m) and times (..., N+1) of their knots, s, as one array (..., N, m+1)."""
    return np.concatenate((U, np.diff(times, axis=-1)[..., None]), axis=-1)


def parted(flown: np.ndarray) -> dict[str, np.ndarray]:
    """The same as `U` and `times`."""
    lengths = flown[..., -1]
    times = np.concatenate((np.zeros_like(lengths[..., :1]), np.cumsum(lengths, axis=-1)), axis=-1)
    return {"U": flown[..., :-1], "times": times}


def judged_columns(task: Task, U: Tensor, times: Tensor | None) -> tuple[Verdict, dict[str, Any]]:
    """The verdict on controls (B, N, m), with times (B, N+1) of the knots where these are free, and its columns."""
    verdict = judge(task.problem, U, task.goal, task.goal_radius, times=times)
    free = {} if times is None else {"duration": times[:, -1].cpu().numpy()}  # s
    return verdict, frame_columns(verdict) | free | more_columns(task.problem, verdict)


def states_of(problem: Problem, U: Tensor, times: Tensor | None) -> Tensor:
    """The states (B, N+1, n) to which controls (B, N, m) lead, with times (B, N+1) of the knots where it is free."""
    if problem.time is None:
        return open_loop(within_horizons(problem).dynamics, problem.x0, U)
    start = problem.x0.unsqueeze(1).expand(-1, problem.N + 1, -1)
    whole, _, controls = at_times(problem, start, U, times)
    return open_loop(whole.dynamics, whole.x0, controls)[..., : problem.n].contiguous()


def times_at(times: np.ndarray | None, places: Any, N: int) -> Tensor | None:
    """The times (B, N+1) of some layouts of all (L, N'+1); None where there are none."""
    return None if times is None else torch.from_numpy(np.ascontiguousarray(times[places, : N + 1]))
