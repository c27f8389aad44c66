"""`torchgco-identify`: from test flights of a plant, or from a study of missions, to a vehicle that missions take."""

from __future__ import annotations

import pytest

from torchgco import Airframe, compose
from torchgco.experiments.config.build import build, compose_config
from torchgco.experiments.reports.identify import main


def test_the_command_writes_a_vehicle_that_missions_take(tmp_path, capsys) -> None:
    path = tmp_path / "vehicle" / "mine.yaml"
    words = ["plant.mass_error=0.25", "vehicle=crazyflie", "solver=hold"]
    assert main([*words, "--output", str(path), "--seed", "2"]) == 0
    out = capsys.readouterr().out
    assert "mass" in out and f"--config-dir {tmp_path} vehicle=mine" in out and "thrust_max" in out
    setup = build(compose_config(["vehicle=mine", "solver=hold"], [f"file://{tmp_path}"]))
    frame, given = setup.vehicle.dynamics.airframe, compose(["vehicle=crazyflie"]).vehicle.dynamics.airframe  # type: ignore[attr-defined]
    assert frame.mass == pytest.approx(1.25 * given.mass, rel=1e-3)
    assert (frame.radius, frame.arm) == (given.radius, given.arm)


@pytest.mark.slow
def test_a_study_of_missions_says_it_too(run, tmp_path, capsys) -> None:
    words = ("experiment=mission", "solver=al_ilqr", "mission.duration=0.6", "plant.mass_error=0.2")
    assert run(*words, "study.figures=false", "hydra.run.dir=study")[0] == 0
    path = tmp_path / "vehicle" / "mine.yaml"
    assert main(["--run", str(tmp_path / "study"), "--output", str(path)]) == 0
    (line,) = (line for line in path.read_text().splitlines() if line.startswith("mass:"))
    assert float(line.split()[1]) == pytest.approx(1.2 * Airframe().mass, rel=0.01)


@pytest.mark.parametrize(("words", "line"), [
    (["--output", "mine.yaml"], "--output: expected FOLDER/vehicle/NAME.yaml"),
    (["--run", "none"], "RUN: expected the folder of a study"),
    (["--run", "none", "plant=rotors"], "command line: expected --run RUN or KEY=VALUE, not both"),
    (["plant.mass_error=-2"], "plant.mass_error: expected a share above -1"),
])  # fmt: skip
def test_mistakes_on_the_command_line(words: list[str], line: str, capsys) -> None:
    assert main(words) == 2 and capsys.readouterr().err.startswith(f"torchgco-identify: {line}")
