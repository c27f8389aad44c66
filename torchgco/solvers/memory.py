"""How many problems fit into memory at once, estimated before anything runs."""

from __future__ import annotations

import torch

from torchgco.base.memory import free_memory
from torchgco.base.options import Count, check_value
from torchgco.base.shapes import check_device
from torchgco.kernels import kernels_of
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem, current_problem

CPU_LIMIT = 256  # a larger batch is no faster on a core: the overhead that problems share is negligible by then
FREE_MEMORY_SHARE = 0.5  # of the free memory; the rest is the system's and other processes'
BYTES_PER_NUMBER = 8  # bytes of float64


def least_bytes(N: int, n: int, m: int, rows: int) -> int:
    """Bytes that a problem of this size takes at least in a solve; `rows` of its constraints at all knots together."""
    gains = N * 2 * m * (n + 1)
    trajectories = N * (n + m) * 10  # iterate, best, last, result, and those tried by a line search
    return BYTES_PER_NUMBER * (gains + trajectories + 6 * rows)


def element_bytes(problem: Problem) -> int:
    """Bytes that one problem of this form takes in a solve, measured to be within a factor of 2 (tests)."""
    problem = for_solvers(problem)  # the form in which it is compiled, with states that rows of several knots carry
    N, n, m = problem.N, problem.n, problem.m
    z, s = n + 1, n + 1 + m
    single = problem.take(torch.zeros(1, dtype=torch.int64, device=problem.x0.device))
    rows = sum(lam.numel() for lam in Multipliers.zero(single, 0.0).lam)
    # F, H and the derivatives they are built from; native kernels hold them for eight problems only.
    expansion = 0 if kernels_of(problem).compiled else N * (2 * z * s + 2 * s * s)
    return least_bytes(N, n, m, rows) + BYTES_PER_NUMBER * expansion


def plan_batch(problem: Problem, device: str | torch.device | None = None, processes: int = 1) -> int:
    """How many problems of this form to solve at once on a device, at least 1.

    Args:
        problem: any batch of problems of this form; only the first problem is used.
        device: by default the problem's.
        processes: number of processes that share the device's memory.

    Raises:
        InputError: fewer than one process, or a device that isn't there.
    """
    problem = current_problem(problem)
    check_value(processes, Count, "processes")
    where = problem.x0.device if device is None else check_device(device)
    free = torch.cuda.mem_get_info(where)[0] if where.type == "cuda" else free_memory()
    fits = max(1, int(FREE_MEMORY_SHARE * free / processes) // element_bytes(problem))
    return fits if where.type == "cuda" else min(fits, CPU_LIMIT)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory ran out, on any device."""
    return isinstance(error, (MemoryError, torch.OutOfMemoryError)) or "can't allocate memory" in str(error)
