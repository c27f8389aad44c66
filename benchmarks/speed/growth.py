"""Milliseconds per problem and iteration as stages, obstacles and states grow."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.speed.bench import Bench

SECTION = "growth"
FLIGHT = 5.0  # s: the same for any number of stages
ITERATIONS = 5
REPEATS = 3


def run(bench: Bench) -> None:
    for stages in bench.sizes.stages:
        times = f"scenario.stages={stages}", f"scenario.dt={FLIGHT / stages}"
        _measure(bench, f"{stages} stages", "scenario=forest", *times)
    # For comparison with the forest of as many obstacles, which comes next.
    planar = "scenario=planar_random", "model=planar", f"scenario.stages={bench.sizes.num_stages or 100}"
    _measure(bench, "10 discs, planar vehicle", *planar, "scenario.num_obstacles=10")
    for obstacles in bench.sizes.obstacles:
        _measure(bench, f"{obstacles} spheres", "scenario=forest", f"scenario.num_obstacles={obstacles}")


def _measure(bench: Bench, case: str, *overrides: str) -> None:
    """Time a fixed number of iterations of `al_ilqr`; the fastest repeat counts."""
    setup = bench.setup(*overrides, "solver=al_ilqr")
    inner = replace(setup.solver.inner, max_iterations=ITERATIONS, tolerance=0.0)
    solver = replace(setup.solver, inner=inner, max_outer_iterations=1)
    task = setup.task(setup.layouts(bench.sizes.growth_batch))
    solve = lambda: solver.solve(task.problem, task.U0)
    solve()  # traces, compiles, and touches memory first
    flights = [bench.timed(solve) for _ in range(REPEATS)]
    solution, took = min(flights, key=lambda flight: flight[1].seconds)
    # Problems that end before the limit count with their own number of iterations.
    count = max(1, int(solution.iterations.sum()))
    bench.row(SECTION, case, "al_ilqr", "per problem and iteration", 1000 * took.seconds / count, "ms")
