"""The paper's planar problem, a thousand stages long, by the paper's method."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.speed.bench import Bench
from torchgco.judging.judge import judge

SECTION = "paper"
SOLVER = "gco_paper"


def run(bench: Bench) -> None:
    setup = bench.setup("experiment=planar_trap_paper", f"solver={SOLVER}")
    task = setup.task(setup.layouts(bench.sizes.paper_layouts))
    quick = replace(setup, solver=replace(setup.solver, max_outer_iterations=2))
    bench.warm(quick, task)
    solution, took = bench.timed(lambda: setup.solver.solve(task.problem, task.U0, seed=setup.seed))
    verdict, count = judge(task.problem, solution.U, task.goal, task.goal_radius), task.problem.B
    case = f"planar_trap_paper, N = {task.problem.N}, B = {count}"
    bench.row(SECTION, case, SOLVER, "all", took.seconds, "s")
    bench.row(SECTION, case, SOLVER, "wall", took.wall, "s")
    bench.row(SECTION, case, SOLVER, "seconds per problem", took.seconds / count, "s")
    bench.row(SECTION, case, SOLVER, "iterations", float(solution.iterations.double().mean()))
    bench.counts(SECTION, case, SOLVER, verdict)
