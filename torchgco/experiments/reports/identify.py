"""`torchgco-identify`: the airframe of a plant from a few recorded flights, as a file that `vehicle=` takes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchgco.base.errors import InputError
from torchgco.base.version import VERSION
from torchgco.dynamics.quadrotor import Airframe
from torchgco.experiments.config.build import compose
from torchgco.experiments.config.checks import NAME_PATTERN
from torchgco.experiments.ending import RunParser, say
from torchgco.experiments.reports.finished import Study
from torchgco.experiments.results.files import readable, write
from torchgco.experiments.results.folder import TIME_STEPS
from torchgco.experiments.results.limits import read_table
from torchgco.missions.identification import Identified, identify, record
from torchgco.missions.planning_problem import airframe_of

VEHICLE_FILE = Path("mine") / "vehicle" / "identified.yaml"
AIRFRAME_UNITS = {
    "mass": "kg", "inertia": "kg m^2", "arm": "m; given", "rotor_torque": "m", "rotational_drag": "N m s/rad",
    "rotor_inertia": "kg m^2", "rotor_time_constant": "s, the delay in it", "thrust_min": "N per rotor",
    "thrust_max": "N per rotor", "hover_speed": "rpm", "gravity": "m/s^2; given", "drag": "N s/m",
    "radius": "m; given",
}  # fmt: skip
Recorded = tuple[Tensor, Tensor, float, Airframe]  # states, commands, time step, the airframe that was planned with


def flights(overrides: Sequence[str], seed: int = 0) -> Recorded:
    """Test flights of the plant that a command line names; see `record`.

    Raises:
        InputError: as `compose` and the plant.
    """
    setup = compose(["experiment=mission", *overrides])
    if setup.mission is None:
        raise InputError("mission", "one with a plant", "none")
    plant, frame = setup.mission.plant, airframe_of(setup.vehicle.dynamics)
    return *record(plant, frame, seed), plant.dt, frame


def missions(folder: Path, trust: bool = False) -> Recorded:
    """The flights of a finished study of at most four missions, as its plant was logged.

    Raises:
        InputError: as `Study.read`, and a study without the time steps of its plant.
    """
    study = Study.read(folder, trust)
    path = folder / TIME_STEPS
    if not path.is_file():
        raise InputError("--run", f"a study of at most four missions, with {TIME_STEPS}", folder)
    return *readable(path, _logged, trust=trust), airframe_of(study.vehicle.dynamics)


def _logged(path: Path, trust: bool) -> tuple[Tensor, Tensor, float]:
    """States, commands and the time step of the flights in a file."""
    parts = [flight for _, flight in read_table(path, trust).groupby(["solver", "mission"], sort=False)]
    dt = float(parts[0]["t"].iloc[1] - parts[0]["t"].iloc[0])
    named = [f"x{i}" for i in range(17)], [f"u{i}" for i in range(1, 5)]
    sequences = ([torch.from_numpy(flight[names].to_numpy(float, copy=True)) for flight in parts] for names in named)
    x, u = (pad_sequence(flights, batch_first=True, padding_value=torch.nan) for flights in sequences)
    return x, u[:, :-1], dt


def document(fit: Identified, source: str) -> str:
    """The file of an airframe, for the group `vehicle`."""
    met = [name for name, was in zip(("least", "greatest"), fit.limits_met, strict=True) if was]
    lines = [
        f"# Identified by torchgco {VERSION} from {fit.samples} time steps: {source}.",
        f"# Delay {fit.delay:g} s; limits of thrust that were met: {' and '.join(met) or 'none'}; the fits leave",
        f"# {fit.thrust_error:.1%} of the roots of thrusts, {fit.force_error:.1%} of forces, "
        f"{fit.torque_error:.1%} of torques.",
        "_target_: torchgco.dynamics.Airframe",
    ]
    for field in fields(fit.airframe):
        value = getattr(fit.airframe, field.name)
        text = f"[{', '.join(str(list(row)) for row in value)}]" if field.name == "inertia" else str(value)
        lines.append(f"{field.name}: {text} # {AIRFRAME_UNITS[field.name]}")
    return "\n".join(lines) + "\n"


def table(before: Airframe, identified: Identified) -> str:
    """What differs from the vehicle that was planned with, a line each."""
    lines = []
    for field in fields(before):
        old, new = (getattr(frame, field.name) for frame in (before, identified.airframe))
        if field.name == "inertia":
            old, new = (tuple(row[i] for i, row in enumerate(J)) for J in (old, new))
        if old != new:
            shown = [", ".join(f"{v:.4g}" for v in (x if isinstance(x, tuple) else (x,))) for x in (old, new)]
            lines.append(f"{field.name:<20} {shown[0]:>24} -> {shown[1]} {AIRFRAME_UNITS[field.name].split(',')[0]}")
    return "\n".join([*lines, f"{'delay':<20} {'':>24} -> {identified.delay:g} s"])


def main(arguments: Sequence[str] | None = None) -> int:
    """`torchgco-identify`. Returns the exit code, see `ended`."""
    parser = RunParser(
        prog="torchgco-identify",
        description="Identify mass, inertia, rotors, limits, delay and drag of a plant; write them as a vehicle.",
    )
    parser.add_argument(
        "words", metavar="KEY=VALUE", nargs="*", help="as torchgco takes them: plant=mujoco vehicle=paper"
    )
    parser.add_argument("--run", metavar="RUN", type=Path, help="of a finished study: its missions, not test flights")
    parser.add_argument("--output", metavar="FILE", type=Path, default=VEHICLE_FILE, help=f"default: {VEHICLE_FILE}")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the test flights; default: 0")
    return parser.run(arguments, _run)


def _run(options: argparse.Namespace) -> int:
    path = options.output
    if path.suffix != ".yaml" or path.parent.name != "vehicle" or not NAME_PATTERN.fullmatch(path.stem):
        raise InputError("--output", "FOLDER/vehicle/NAME.yaml, as --config-dir FOLDER vehicle=NAME reads it", path)
    if options.run is not None and options.words:
        raise InputError("command line", "--run RUN or KEY=VALUE, not both", options.words[0])
    source = str(options.run) if options.run is not None else " ".join(options.words)
    recorded = flights(options.words, options.seed) if options.run is None else missions(options.run, options.trust)
    identified = identify(*recorded)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("--output", "a folder that can be made", error) from None
    write(path, lambda file: file.write(document(identified, source or "plant=rotors").encode()))
    say(f"{table(recorded[3], identified)}\n{path}: torchgco --config-dir {path.parent.parent} vehicle={path.stem} ...")
    return 0
