"""python -m benchmarks.causes.unknown "WORLD:NUMBER" ...: missions of benchmarks.families.unknown, as they ended.

Each is flown again and drawn from above at its last control step, or with "WORLD:NUMBER:SECONDS" at a time: what the
vehicle knows at its height, the way that it flew, and the plan that it holds. With --write the pictures go into
results/unknown.png, one below the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import torch
from PIL import Image

from benchmarks.causes.seen import seen_figure
from benchmarks.families.unknown import CASES
from benchmarks.lib import RESULTS
from benchmarks.lib.command import parser_of
from torchgco import compose
from torchgco.plotting.bodies import bodies
from torchgco.plotting.course import Course

DPI = 100
WIDTH = 900  # pixels


def picture(world: str, number: int, until: float | None = None) -> Image.Image:
    """Mission `number` of a world, flown now, at its last control step, that of `until`, s, at the latest."""
    ends = [] if until is None else [f"mission.duration={until:g}"]
    setup = compose(["experiment=mission_unknown", *CASES[world].overrides, *ends, f"study.layouts={number + 1}"])
    layouts = setup.layouts(number + 1).take([number])
    assert setup.mission is not None
    mission = replace(setup.mission, planner=replace(setup.mission.planner, solver=setup.solver))
    task = setup.vehicle.task(layouts)
    log = mission.fly(task.problem, seed=setup.seed, ids=torch.as_tensor(layouts.ids))
    goal = task.problem.goal
    assert goal is not None
    radius = mission.goal_radius or float(goal.radius[0])
    vehicle = float(task.problem.obstacles[0].vehicle_radius[0])
    course = Course(bodies(layouts.arrays(), 0), goal.position[0].numpy(), radius, vehicle, layouts.map)
    figure = seen_figure(log, 0, course, int(log.steps()[0]) - 1)
    ax = figure.axes[0]
    ax.set_title(f"{world}, {number}: {ax.get_title(loc='left')}", loc="left")
    held = BytesIO()
    figure.savefig(held, dpi=DPI)
    return Image.open(held).convert("RGB")


def below(pictures: Sequence[Image.Image]) -> Image.Image:
    """Pictures of one width, one below the other."""
    scaled = [one.resize((WIDTH, round(one.height * WIDTH / one.width))) for one in pictures]
    whole = Image.new("RGB", (WIDTH, sum(one.height for one in scaled)), "white")
    top = 0
    for one in scaled:
        whole.paste(one, (0, top))
        top += one.height
    return whole


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/unknown.png")
    parser.add_argument("missions", nargs="+", metavar="WORLD:NUMBER[:SECONDS]")
    parser.add_argument("--path", type=Path, help="another file for the pictures")
    asked = parser.parse_args(words)
    torch.set_num_threads(1)
    named = [mission.split(":") for mission in asked.missions]
    whole = below([picture(world, int(number), *map(float, until)) for world, number, *until in named])
    if asked.write or asked.path:
        whole.save(asked.path or RESULTS / "unknown.png", optimize=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
