"""OpenSCvx's examples: their statement, the judge of both solvers' flights, and what is said where the peer isn't."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchgco
from benchmarks.outside import openscvx
from benchmarks.outside.openscvx_problems import CENTERS, ELLIPSOIDS, EXAMPLES, GRAVITY, WINDOW, flying
from tests.engines import compiled
from torchgco import Status


def test_the_field_is_that_of_rotation_matrices() -> None:
    draws = np.random.default_rng(0)
    x, u = draws.normal(size=(5, 13)), draws.normal(size=(5, 4))
    x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)  # others turn at another pace, as published
    for a, b in zip(x, u, strict=True):
        w, p, q, r = a[6:10] / np.linalg.norm(a[6:10])
        turn = np.array([
            [1 - 2 * (q * q + r * r), 2 * (p * q - r * w), 2 * (p * r + q * w)],
            [2 * (p * q + r * w), 1 - 2 * (p * p + r * r), 2 * (q * r - p * w)],
            [2 * (p * r - q * w), 2 * (q * r + p * w), 1 - 2 * (p * p + q * q)],
        ])  # fmt: skip
        rates = flying(a, b)
        np.testing.assert_allclose(rates[:6], [*a[3:6], *(turn @ [0, 0, b[0]] - [0, 0, GRAVITY])], atol=1e-12)
        h, faster = 1e-6, a + 1e-6 * rates
        w, p, q, r = faster[6:10] / np.linalg.norm(faster[6:10])
        axis = np.array([2 * (p * r + q * w), 2 * (q * r - p * w), 1 - 2 * (p * p + q * q)])
        np.testing.assert_allclose((axis - turn[:, 2]) / h, turn @ np.cross(a[10:13], [0.0, 0.0, 1.0]), atol=1e-5)
        np.testing.assert_allclose(rates[10:], b[1:])
    both = flying(torch.tensor(x), torch.tensor(u)).numpy()
    np.testing.assert_allclose(both, flying(x, u), atol=1e-14)


def test_rows_and_gates_are_those_of_the_files() -> None:
    x = np.random.default_rng(1).normal(size=(20, 13)) * 4.0
    inside = [max(1.0 - (p - c) @ A @ (p - c) for c, A in zip(CENTERS, ELLIPSOIDS, strict=True)) for p in x[:, :3]]
    drone, race = EXAMPLES["drone past ellipsoids"], EXAMPLES["race through ten gates"]
    np.testing.assert_allclose(drone.rows(x)["ellipsoids"], inside, rtol=1e-12)
    assert race.gate_knots == [20 * (i + 1) for i in range(10)]
    row = race.problem(True).constraints[-3]  # the last gate, before what is free in the start
    np.testing.assert_allclose(row.upper.flatten()[:3], race.gates[-1] + WINDOW)  # type: ignore[attr-defined]


@pytest.mark.parametrize("linear", [False, True])
def test_both_judges_see_a_violation_between_nodes(linear: bool) -> None:
    """A car along a circle around the disc's centre, whose radius is too small by 1 mm."""
    example = EXAMPLES["car, disc in the way"]
    K, speed, radius, turn = 6, 2.0, 0.999, 1.2
    angle = np.linspace(0.0, turn, K + 1)
    x = np.stack((0.5 - radius * np.cos(angle), radius * np.sin(angle), angle), -1)
    u = np.tile([speed, speed / radius], (K + linear, 1))
    seconds = radius * turn / speed
    flight = openscvx.Flight.linear(x, u, np.full(K + 1, seconds)) if linear else (
        openscvx.Flight.held(x, u, np.linspace(0.0, seconds, K + 1))
    )  # fmt: skip
    assert flight.duration == pytest.approx(seconds)
    assert openscvx.dense(example, flight) == pytest.approx(1e-3, abs=1e-9)
    worst, _, missed = openscvx.independent(example, flight)
    assert worst == pytest.approx(1e-3, abs=1e-9)
    assert missed == pytest.approx(np.linalg.norm(x[-1, :2] - [0.0, 2.0]), abs=1e-8)


def test_a_pace_that_changes_is_flown_as_the_peer_does() -> None:
    """Its controls reach the next node's after K / (K + 1) of an interval."""
    example, x = EXAMPLES["car, disc aside"], np.array([[0.0, -2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    flight = openscvx.Flight.linear(x, np.array([[4.0, 0.0], [6.0, 0.0], [2.0, 0.0]]), np.array([1.0, 1.0, 1.0]))
    _, _, missed = openscvx.independent(example, flight)
    driven = 0.5 * (0.5 * (4.0 + 7.0) + 0.5 * (6.0 + 0.0))  # 4 + 1.5 * 2 and 6 - 1.5 * 4 at the ends
    assert missed == pytest.approx(abs(-2.0 + driven - 2.0), abs=1e-9)


@compiled
def test_ours_ends_near_what_is_published_and_keeps_the_disc_between_the_knots() -> None:
    example = EXAMPLES["car, disc in the way"]
    problem = example.problem(True)
    found = torchgco.solve(problem, solver="interior_point", X0=example.states(), verbose=False)
    closer = torchgco.tightened(problem, found)
    final = torchgco.solve(closer, solver="interior_point", warm=found, X0=found.X, verbose=False)
    left = [openscvx.dense(example, openscvx.flown(one)) for one in (found, final)]
    assert final.statuses == [Status.CONVERGED] and 0.40 < float(final.duration) < 0.42
    assert left[1] < 0.5 * left[0] < 1e-4


def test_without_the_peer_it_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENSCVX_PYTHON", raising=False)
    with pytest.raises(SystemExit, match="OpenSCvx isn't here: set OPENSCVX_PYTHON"):
        openscvx.peers_flights()
