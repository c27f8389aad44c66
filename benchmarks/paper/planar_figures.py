"""Figures 3 to 5 and A1 to A3 and Table A4 of paper.md: the paper's planar problem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.lib import page
from benchmarks.paper import drawing
from benchmarks.paper.runs import Solve, Step
from torchgco.plotting import trajectory as draw
from torchgco.plotting.style import INK, PALETTE, legend, panels, tidy

LOW, HIGH = (-1.15, -0.5), (1.3, 1.0)  # of the views, m
DOTS, SAMPLES = 100, 40  # shown of a trajectory, and of each call of MPPI
PANELS = 6  # of an evolution, the result included
REPORTED = {"1": (1364.08, 1.21e-4), "2": (1655.35, 2.26e-2)}  # Table A4: J_var and largest violation, by trial


def caught(alone: Solve, guided: Solve) -> Figure:
    """Figure 3: where AL-iLQR ends, and the first answer of guidance."""
    figure, (left, right) = panels(2, 2, (4.4, 3.1), share=True)
    _scene(left, alone, f"(a) al_ilqr: ends {float(alone.solution.violation[0]):.3f} m inside")
    _path(left, alone, alone.positions)
    step = next(step for step in guided.steps if step.guided.any())
    _scene(right, guided, f"(b) gco_paper: after outer iteration {step.outer}")
    _guide(right, step, samples=0)
    _path(right, guided, step.path)
    some = np.flatnonzero(step.guided)[np.linspace(0, step.guided.sum() - 1, 4).round().astype(int)]
    drawing.draw_pulls(right, step.path[some], step.centers[some])
    _finish(figure, [left, right], alone, "infeasible", "region", "plan", "pull")
    return figure


def result(guided: Solve) -> Figure:
    """Figure 4: the trajectory that the paper's method returns."""
    figure, axes = panels(1, 1, (6.0, 3.6))
    found = guided.solution
    _scene(axes[0], guided, f"gco_paper: {int(found.iterations[0])} iterations, $J_{{var}}$ {float(found.cost[0]):.1f}")
    _path(axes[0], guided, guided.positions)
    _finish(figure, axes, guided)
    return figure


def evolution(guided: Solve) -> Figure:
    """Figures 5 and A3: iterates after some outer iterations, with what guidance answered, and the result."""
    steps = _chosen(guided.steps)
    figure, axes = panels(len(steps) + 1, 2, (4.2, 2.6), share=True)
    counts = guided.solution.trace.groupby("outer").size().cumsum() if guided.solution.trace is not None else {}
    for ax, step in zip(axes, steps, strict=False):
        _scene(ax, guided, f"after outer iteration {step.outer}, {counts[step.outer - 1]} iterations")
        _guide(ax, step)
        _path(ax, guided, step.path)
    _scene(axes[-1], guided, f"result, {int(guided.solution.iterations[0])} iterations in all")
    _path(axes[-1], guided, guided.positions)
    _finish(figure, axes, guided, "infeasible", "samples", "plan", "region")
    return figure


def distinct(trials: Sequence[Solve]) -> Figure:
    """Figure A1: trials that end in different local solutions."""
    figure, axes = panels(len(trials), 2, (4.4, 3.1), share=True)
    for ax, trial, letter in zip(axes, trials, "abcdef", strict=False):
        _scene(ax, trial, f"({letter}) trial {ord(letter) - 96}, $J_{{var}}$ {float(trial.solution.cost[0]):.1f}")
        _path(ax, trial, trial.positions)
    _finish(figure, axes, trials[0])
    return figure


def histories(trials: Sequence[Solve]) -> Figure:
    """Figure A2: states and inputs over time, a column per trial, a row per kind; targets dotted."""
    rows = {
        "position [m]": (("X", 0), ("X", 1)),
        "heading [rad]": (("X", 2),),
        "velocity [m/s]": (("X", 3), ("X", 4)),
        "turn rate [rad/s]": (("X", 5),),
        "inputs [m/s²]": (("U", 0), ("U", 1)),
    }
    figure = Figure(figsize=(8.8, 7.6), layout="constrained")
    grid = figure.subplots(len(rows), len(trials), sharex=True, sharey="row", squeeze=False)
    targets = {"X": [1.0, 0.4, 0.0, 0.0, 0.0, 0.0], "U": [0.0, 0.0]}
    for j, trial in enumerate(trials):
        values = {"X": trial.solution.X[0].numpy(), "U": trial.solution.U[0].numpy()}
        for i, (ax, (name, shown)) in enumerate(zip(grid[:, j], rows.items(), strict=True)):
            for (kind, k), colour in zip(shown, PALETTE, strict=False):
                series = values[kind][:, k]
                ax.plot(np.arange(len(series)) * trial.dt, series, color=colour, linewidth=0.9)
                ax.axhline(targets[kind][k], color=colour, linestyle=":", linewidth=1.1)
            if j == 0:
                ax.set_ylabel(name)
            if i == len(rows) - 1:
                ax.set_xlabel("time [s]")
            tidy(ax, f"({'ab'[j]}) trial {j + 1}" if i == 0 else "")
    figure.align_ylabels(grid[:, 0])
    legend(
        figure,
        [
            Line2D([], [], color=PALETTE[0], label="x, heading, turn rate, left wheel"),
            Line2D([], [], color=PALETTE[1], label="y, right wheel"),
            Line2D([], [], color=INK, linestyle=":", label="target"),
        ],
    )
    return figure


def table(trials: Sequence[Solve], draws: Sequence[int]) -> pd.DataFrame:
    """Table A4: a row per trial, the paper's values next to ours."""
    rows = []
    for (name, (cost, violation)), trial, number in zip(REPORTED.items(), trials, draws, strict=True):
        found, (_, goal) = trial.solution, trial.ends
        assert found.trace is not None
        last = found.trace.iloc[-1]
        rows.append(
            {
                "trial": name, "draws": number, "cost_paper": cost, "cost": float(found.cost[0]),
                "largest_c_paper": violation, "largest_c": trial.largest, "violation_m": float(found.violation[0]),
                "cost_last": float(last["cost"]), "violation_last_m": float(last["violation"]),
                "to_goal_m": float(np.linalg.norm(trial.positions[-1] - goal)),
                "iterations": int(found.iterations[0]), "guided": int(found.guided[0]),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def markdown(rows: pd.DataFrame) -> str:
    """The same as a Markdown table."""
    heads = ("", *(f"trial {row.trial}, draws {row.draws}" for row in rows.itertuples()))
    lines = {
        "J_var, paper": [f"{x:.2f}" for x in rows.cost_paper],
        "J_var, ours": [f"{x:.2f}" for x in rows.cost],
        "largest violation, paper": [f"{x:.2e}" for x in rows.largest_c_paper],
        "largest c, ours (m² for circles)": [f"{x:.2e}" for x in rows.largest_c],
        "largest violation, ours (m)": [f"{x:.1e}" for x in rows.violation_m],
        "last iterate, ours: J_var": [f"{x:.2f}" for x in rows.cost_last],
        "last iterate, ours: violation (m)": [f"{x:.1e}" for x in rows.violation_last_m],
        "end to goal, ours (m)": [f"{x:.3f}" for x in rows.to_goal_m],
        "iterations, ours": [f"{x}" for x in rows.iterations],
        "outer iterations with guidance, ours": [f"{x}" for x in rows.guided],
    }
    return page.markdown(heads, ([name, *cells] for name, cells in lines.items()))


def _chosen(steps: Sequence[Step]) -> list[Step]:
    """About five steps: the first and last guided one, those where guidance goes on or off, and some guided between."""
    on = [i for i, step in enumerate(steps) if step.guided.any()]
    if not on:
        return list(steps[:1])
    guided = np.array([step.guided.any() for step in steps])
    picked = {on[0], on[-1], *(np.flatnonzero(np.diff(guided)) + 1).tolist()[-3:]}
    rest, missing = [i for i in on if i not in picked], PANELS - 1 - len(picked)
    if rest:
        picked |= {rest[k * len(rest) // (missing + 1)] for k in range(1, missing + 1)}
    return [steps[i] for i in sorted(picked)]


def _scene(ax: Axes, solve: Solve, title: str) -> None:
    drawing.draw_obstacles(ax, solve.centers, solve.radii, solve.margin)
    draw.draw_ends(ax, *solve.ends)
    draw.frame(ax, LOW, HIGH)
    tidy(ax, title, grid=None)


def _path(ax: Axes, solve: Solve, positions: np.ndarray) -> None:
    every = max(1, len(positions) // DOTS)
    draw.draw_trajectory(ax, positions, solve.infeasible(positions), every=every, cross_every=max(1, every // 3))


def _guide(ax: Axes, step: Step, samples: int = SAMPLES) -> None:
    if step.sampling is not None:
        if samples > 0:
            drawing.draw_samples(ax, step.sampling.samples(samples))
        drawing.draw_plan(ax, step.sampling.plan[:, :2].numpy())
        drawing.draw_region(ax, step.centers, step.radii)


def _finish(figure: Figure, axes: Sequence[Axes], solve: Solve, *names: str) -> None:
    """Legend, colours of time, and labels at the outer panels only."""
    for ax in axes:
        ax.label_outer()
    draw.time_bar(figure, axes, solve.dt * solve.problem.N)
    legend(figure, drawing.handles("knot", *names, "obstacle", "inflated", "start", "goal"))
