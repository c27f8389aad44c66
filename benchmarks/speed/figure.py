"""Milliseconds per problem against batch size, stages and number of spheres, beside FATROP and acados."""

from __future__ import annotations

import re

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, ScalarFormatter

from benchmarks.speed.results import Row
from torchgco.plotting.style import legend, panels, solver_colours, tidy

# A panel's title, label, the cases of its points, and of a number there, and ms per unit of the row.
PANELS = (
    ("batch, 30 spheres, 100 stages", "problems in a batch", "batch", r"B = (\d+)", "per problem", 1.0),
    ("B = 16, 30 spheres", "stages", "scaling", r"(\d+) stages", "seconds per problem", 1000.0),
    ("B = 16, 100 stages", "spheres", "scaling", r"(\d+) spheres", "seconds per problem", 1000.0),
)
SOLVERS = ("gco", "fatrop", "acados")


def figure(rows: list[Row]) -> Figure:
    """The rows of `batch` and `scaling` on the CPU, a panel per axis, on logarithmic axes; dashed, the peers alone."""
    picture, axes = panels(len(PANELS), len(PANELS), (3.0, 2.8))
    colours = solver_colours(list(SOLVERS))
    for ax, (title, label, section, case, quantity, unit) in zip(axes, PANELS, strict=True):
        for solver in SOLVERS:
            found = [
                (int(match[1]), unit * float(row["value"]))
                for row in rows
                if (row["section"], row["solver"], row["quantity"], row["device"]) == (section, solver, quantity, "cpu")
                and (match := re.fullmatch(case, row["case"]))
            ]
            if found:
                ax.plot(*zip(*sorted(found), strict=True), color=colours[solver], marker="o", markersize=3)
        if section == "batch":  # the peers solve one problem after the other
            for row in rows:
                alone = re.fullmatch(r"forest30, first \d+", row["case"]) and row["quantity"] == "seconds per problem"
                if alone and row["solver"] in SOLVERS[1:]:
                    ax.axhline(1000.0 * float(row["value"]), color=colours[row["solver"]], linestyle="--", linewidth=1)
        ax.set_xscale("log")
        ax.set_yscale("log")
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_formatter(NullFormatter())
        ax.set_xlabel(label)
        tidy(ax, title)
    axes[0].set_ylabel("ms per problem")
    legend(picture, [Line2D([], [], color=colours[name], marker="o", label=name) for name in SOLVERS])
    return picture
