"""Identification: airframes that are known come back from flights, beside the ways in which plants may differ."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.slow import mostly
from torchgco import Airframe, InputError
from torchgco.missions import RotorPlant
from torchgco.missions.identification import identify, record

PLAIN = Airframe(
    mass=1.2, inertia=((0.02, 0.001, 0), (0.001, 0.018, 0), (0, 0, 0.03)), rotor_torque=0.02, rotational_drag=0.02,
    rotor_time_constant=0.05, thrust_min=0.2, thrust_max=8.0, hover_speed=4000.0, drag=0.3,
)  # fmt: skip


@dataclass
class Late:
    """A plant to which commands come so many time steps late."""

    steps: int
    plant: RotorPlant
    dt: float = 0.01
    heard: list[Any] = field(default_factory=list)

    def take(self, index):
        return self

    def advance(self, x, u, force):
        self.heard.append(u)
        return self.plant.advance(x, self.heard[max(0, len(self.heard) - 1 - self.steps)], force)


@pytest.mark.parametrize(
    ("late", "rotor_inertia"), mostly([(0, 0.0), (3, 0.0), (0, 2e-4)], (0, 0.0), (3, 0.0), several=True)
)
def test_another_airframe_comes_back(late: int, rotor_inertia: float) -> None:
    """Measured 1e-4 of each, 1e-2 of rotors that are heavy; the search begins at the paper's."""
    other = replace(PLAIN, rotor_inertia=rotor_inertia)
    plant = Late(late, RotorPlant(other))
    found = identify(*record(plant, Airframe(), seed=1), plant.dt, Airframe())
    assert found.delay == pytest.approx(0.01 * late) and found.limits_met == (True, True)
    for one in fields(other):
        wanted = np.array(getattr(other, one.name)) + (0.01 * late if one.name == "rotor_time_constant" else 0)
        np.testing.assert_allclose(getattr(found.airframe, one.name), wanted, rtol=2e-3, atol=1e-5, err_msg=one.name)
    assert max(found.thrust_error, found.force_error, found.torque_error) < 1e-3 and found.samples > 500


def test_errors_of_a_plant_are_shares_of_the_airframe() -> None:
    frame = Airframe()
    x, u = record(RotorPlant(mass_error=0.2, thrust_error=-0.1, drag=0.2), frame)
    generator = torch.Generator().manual_seed(0)
    x[:, :, 3:6] += 1e-3 * torch.randn(x[:, :, 3:6].shape, generator=generator).double()  # m/s: measured
    x[:, :, 10:13] += 1e-3 * torch.randn(x[:, :, 3:6].shape, generator=generator).double()  # rad/s
    x[3, 60:], u[3, 60:] = torch.nan, torch.nan  # a flight that ended
    found = identify(x, u, 0.01, frame).airframe
    assert found.mass == pytest.approx(1.2 * frame.mass, rel=0.01) and found.drag == pytest.approx(0.2, rel=0.05)
    assert found.thrust_coefficient == pytest.approx(0.9 * frame.thrust_coefficient, rel=1e-3)
    assert found.thrust_max == pytest.approx(0.9 * frame.thrust_max, rel=1e-2)
    diagonal = [found.inertia[i][i] / frame.inertia[i][i] for i in range(3)]
    np.testing.assert_allclose(diagonal, 1.0, atol=0.03)


def test_a_limit_that_no_command_met_is_the_greatest_one() -> None:
    x, u = record(RotorPlant(Airframe(thrust_min=0.01, thrust_max=20.0)), Airframe())
    found = identify(x[:8], u[:8], 0.01, Airframe())
    b = Airframe().thrust_coefficient
    assert found.limits_met == (False, False)
    assert found.airframe.thrust_max == pytest.approx(b * float(u[:8].max()) ** 2, rel=1e-3)


def test_wrong_flights() -> None:
    x, u = record(RotorPlant(), Airframe())
    for wrong, line in (
        ((x[..., :3], u), "x: expected states (B, K+1, 17)"), ((x, u[:, 1:]), "u: expected commands (12, 120, 4)"),
        ((torch.full_like(x, torch.nan), u), "x: expected at least 50 finite thrusts"),
        ((x * (1 + 99 * (torch.arange(17) == 3)), u), "x: expected at least 50 time steps within 8 m/s and 10 rad/s"),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            identify(*wrong, 0.01, Airframe())
        assert str(error.value).startswith(line)
