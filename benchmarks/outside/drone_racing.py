"""python -m benchmarks.outside.drone_racing: the races of lsy_drone_racing at level 2, flown with plans of torchgco.

It runs in the environment that drone_racing_setup.sh makes. Their script flies the same class, `RacePilot`, with
`control_mode = "attitude"` in config/level2.toml: python scripts/sim.py --config level2.toml --controller THIS_FILE.
Flights are kept in a CSV file, and those that it has aren't flown again. With --write the table goes into
benchmarks/results/drone_racing.md.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from lsy_drone_racing.control import Controller  # before torchgco: it wants to be there before scipy
from numpy.typing import NDArray

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from benchmarks.outside.drone_racing_pilot import Pilot, nominal_plan, tracker
from benchmarks.outside.drone_racing_plan import Limits, Plan

GATES, LONGEST = 4, 1500  # periods: their longest episode
COLUMNS = "seed", "gates", "seconds", "mass", "stray"


@cache
def _tracker() -> torchgco.MPC:
    return tracker()


_PLANS: dict[str, Plan] = {}


class RacePilot(Controller):
    """`Pilot` as their interface wants it."""

    def __init__(self, obs: dict[str, NDArray[np.floating]], info: dict, config: Any) -> None:
        super().__init__(obs, info, config)
        limits, track = Limits(), config.env.track
        nominal = _PLANS.get(str(track)) or nominal_plan(track, limits)
        _PLANS[str(track)] = nominal
        self.pilot = Pilot(nominal, _tracker(), limits)

    def compute_control(self, obs: dict[str, NDArray[np.floating]], info: dict | None = None) -> NDArray[np.floating]:
        """Roll, pitch, yaw, rad, and thrust, N."""
        return self.pilot.command_of(obs).astype(np.float32)

    def step_callback(self, *args: Any) -> bool:
        """Goes on until the environment ends the race."""
        return False


def flown(repository: Path, seeds: range, kept: Path) -> list[dict[str, str]]:
    """The flights of some seeds, read from a file or flown and written there."""
    found = {int(row["seed"]): row for row in _rows(kept)}
    left = [seed for seed in seeds if seed not in found]
    if left:
        env, config = _environment(repository)
        for seed in left:
            found[seed] = {name: str(value) for name, value in _flight(env, config, seed).items()}
            new = not kept.exists()
            with kept.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                if new:
                    writer.writeheader()
                writer.writerow(found[seed])
    return [found[seed] for seed in seeds]


def _rows(kept: Path) -> list[dict[str, str]]:
    if not kept.exists():
        return []
    with kept.open(newline="") as file:
        return list(csv.DictReader(file))


def _environment(repository: Path) -> tuple[Any, Any]:
    """Theirs at level 2, steered by attitudes, and its configuration."""
    import gymnasium
    from lsy_drone_racing.utils import load_config

    config = load_config(repository / "config" / "level2.toml")
    own = config.env
    env = gymnasium.make(
        own.id, freq=own.freq, sim_config=config.sim, sensor_range=own.sensor_range, control_mode="attitude",
        track=own.track, disturbances=own.disturbances, randomizations=own.randomizations, seed=1,
    )  # fmt: skip
    return env, config


def _flight(env: Any, config: Any, seed: int) -> dict[str, Any]:
    """One race: gates passed, its time as their script counts it, s, the mass, and how far it strayed from plans, m."""
    obs, info = env.reset(seed=seed)
    mass = float(np.ravel(env.unwrapped.data.sim_data.params.mass)[0])
    obs = {name: np.asarray(value) for name, value in obs.items()}
    pilot, step, over = RacePilot(obs, info, config), 0, False
    while True:
        obs, _, over, cut, info = env.step(pilot.compute_control(obs, info))
        obs = {name: np.asarray(value) for name, value in obs.items()}
        if over or cut or step == LONGEST:
            break
        step += 1
    target = int(obs["target_gate"])
    return {
        "seed": seed, "gates": GATES if target < 0 else target, "seconds": f"{step / config.env.freq:.2f}",
        "mass": f"{mass:.4f}", "stray": f"{pilot.pilot.stray:.3f}",
    }  # fmt: skip


def table(repository: str, first: int, count: int, flights: str) -> str:
    """How many races end, and how fast."""
    rows = flown(Path(repository), range(first, first + count), Path(flights))
    ended = [float(row["seconds"]) for row in rows if int(row["gates"]) == GATES]
    crashed = ", ".join(str(sum(int(row["gates"]) == gates for row in rows)) for gates in range(GATES))
    stray = [float(row["stray"]) for row in rows]
    line = [
        f"{share(len(ended), len(rows))} %", *(f"{np.mean(ended):.2f}, {min(ended):.2f}, {max(ended):.2f}",),
        crashed, f"{np.median(stray):.3f}, {max(stray):.3f}",
    ] if ended else [f"{share(0, len(rows))} %", "-", crashed, "-"]  # fmt: skip
    head = [
        "races ended", "seconds: mean, least, most", f"crashed after {', '.join(map(str, range(GATES)))} gates",
        "strayed from plans: median, most, m",
    ]  # fmt: skip
    return markdown(head, [line])


main = Command(
    __doc__, "drone_racing", table, "{count} seeds from {first} on",
    repository=("lsy_drone_racing", "their repository, at eb891d0"), first=(0, "the first seed"),
    count=(200, "how many seeds"), flights=("drone_racing.csv", "the file of the flights"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
