"""Figures 6 and 7 of paper.md: first plans of the quadrotor, and their costs iteration by iteration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper import drawing
from benchmarks.paper.runs import Solve
from torchgco.plotting import trajectory as draw
from torchgco.plotting.convergence import convergence_figure
from torchgco.plotting.style import legend, tidy

LOW, HIGH = (0.0, -2.6, -3.6), (21.5, 4.6, 3.6)  # of the views, m
SAMPLES = 30  # shown of a call of MPPI


def plans(solves: Sequence[Solve]) -> Figure:
    """Figure 6: the first plans, a row per solver, from above and from the side."""
    figure = Figure(figsize=(9.6, 1.85 * len(solves) + 0.6), layout="constrained")
    grid = figure.subplots(len(solves), 2, sharex=True, squeeze=False)
    for row, solve, letter in zip(grid, solves, "abcdef", strict=False):
        count = int(solve.infeasible(solve.positions).sum())
        outcome = f"{count} infeasible knots" if count else "feasible"
        for ax, plane, view in zip(row, (draw.ABOVE, draw.SIDE), ("from above", "from the side"), strict=True):
            _view(ax, solve, plane)
            tidy(ax, f"({letter}) {solve.name}: {outcome}" if plane == draw.ABOVE else view, grid=None)
    for ax in grid[:-1].flat:
        ax.set_xlabel("")
    draw.time_bar(figure, grid.flat, solves[0].dt * solves[0].problem.N)
    names = ("knot", "infeasible", "samples", "plan", "obstacle", "inflated", "start", "goal")
    legend(figure, drawing.handles(*names, plan="MPPI's result; in (c) a proposal along a path"))
    return figure


def costs(solves: Sequence[Solve]) -> Figure:
    """Figure 7: cost per iteration, a panel per solver."""
    traces = [solve.solution.trace for solve in solves]
    trace = pd.concat([part.assign(element=i) for i, part in enumerate(traces) if part is not None])
    figure = convergence_figure(trace, range(len(solves)))
    column = figure.add_gridspec(len(solves), 1)  # one below the other: two columns would leave a quarter blank
    figure.set_size_inches(7.6, 2.2 * len(solves) + 0.5)
    for i, (ax, solve) in enumerate(zip(figure.axes, solves, strict=True)):
        ax.set_subplotspec(column[i])
        ax.set_ylabel("cost $J_{var}$")
        tidy(ax, f"({'abcdef'[i]}) {solve.name}, $J_{{var}}$ {float(solve.solution.cost[0]):.0f}")
    for ax in figure.axes[:-1]:
        ax.set_xlabel("")
    return figure


def _view(ax: Axes, solve: Solve, plane: draw.Plane) -> None:
    drawing.draw_obstacles(ax, solve.centers, solve.radii, solve.margin, plane, opacity=0.5)
    last = next((step for step in reversed(solve.steps) if step.sampling is not None), None)
    if last is not None and last.sampling is not None:
        drawing.draw_samples(ax, last.sampling.samples(SAMPLES), plane)
        drawing.draw_plan(ax, last.sampling.plan.numpy(), plane)
    if solve.proposal is not None:
        drawing.draw_plan(ax, solve.proposal, plane, width=4.0)
    draw.draw_trajectory(ax, solve.positions, solve.infeasible(solve.positions), plane)
    start, goal = solve.ends
    draw.draw_ends(ax, start, goal, np.nan, plane)
    draw.frame(ax, LOW, HIGH, plane)
