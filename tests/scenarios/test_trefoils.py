"""The trefoils follow their rule, layouts keep their sines, and a task moves the boxes as the formula says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchgco import Layouts, compose
from torchgco.base.errors import InputError
from torchgco.experiments.results.identity import layout_digests
from torchgco.obstacles.boxes import BoundOscillatingBoxes
from torchgco.scenarios import Trefoils, concatenate
from torchgco.scenarios.layouts import SINES


def drawn(count: int = 3, seed: int = 0, **options) -> Layouts:
    return Trefoils(**options).draw(range(count), seed=seed)


def test_a_layout_depends_on_seed_and_number_alone() -> None:
    many = drawn(5, seed=3)
    assert Trefoils().draw([4], seed=3) == many.take([4])
    assert Trefoils().draw([4], seed=2) != many.take([4]) != many.take([3])


def test_the_rule() -> None:
    layouts = drawn(60, num_obstacles=101)
    centers, half = layouts.box_centers, layouts.box_half_sizes
    assert centers is not None and half is not None and centers.shape == (60, 101, 3)
    cubes = 65  # int(0.65 * 101)
    assert (half[:, :cubes] == 0.4).all()
    for axis, (low, high) in enumerate(((5, 100), (-6, 6), (0.5, 4.5))):
        values = centers[:, :cubes, axis]
        assert low <= values.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < values.max() <= high
        assert values.mean() == pytest.approx(0.5 * (low + high), abs=0.02 * (high - low))
    bars = half[:, cubes:]
    assert (np.sort(bars, axis=-1) == (0.2, 0.2, 2.0)).all()
    shares = (bars == 2.0).mean(axis=(0, 1))
    assert shares == pytest.approx([0.325, 0.325, 0.35], abs=0.04)
    assert (centers[:, cubes:][bars[..., 2] == 2.0][:, 2] == 2.0).all()
    assert layouts.box_amplitudes is not None and (layouts.box_amplitudes[:, cubes:] == 0).all()


def test_cubes_move_on_trefoils() -> None:
    """Their motion agrees with the published formula, by letters that are read off the sines."""
    layouts = drawn(4)
    sines = [getattr(layouts, name) for name in SINES]
    for i in range(4):
        for k in (0, 13, 31):
            amplitudes, rates, phases = (part[i, k] for part in sines)
            sx, sy, sz = 6 * amplitudes[0, 0], 5 * amplitudes[0, 1], -2 * amplitudes[0, 2]
            slower, offset = 1 / rates[0, 0], phases[0, 0]
            assert all(2 <= s <= 4 for s in (sx, sy, sz)) and 4 <= slower <= 6 and 0 <= offset <= 3
            for t in np.linspace(0, 50, 7):
                s = t / slower + offset
                formula = [
                    sx / 6 * (np.sin(s) + 2 * np.sin(2 * s)), sy / 5 * (np.cos(s) - 2 * np.cos(2 * s)),
                    -sz / 2 * np.sin(3 * s),
                ]  # fmt: skip
                assert np.allclose((amplitudes * np.sin(rates * t + phases)).sum(axis=0), formula, atol=1e-12)


@pytest.mark.slow
def test_start_and_goal_are_clear_at_the_beginning() -> None:
    region = [[-3, 108], [-6, 6], [0.5, 4.5]]
    scenario = Trefoils(region=region, num_obstacles=100)
    layouts = scenario.draw(range(20), seed=0)
    centers, half, amplitudes, rates, phases = (
        getattr(layouts, f"box_{name}") for name in ("centers", "half_sizes", "amplitudes", "rates", "phases")
    )
    nearest = np.inf
    for t in np.linspace(0, 1, 30):
        places = centers + (amplitudes * np.sin(rates * t + phases)).sum(axis=2)
        nearest = min(nearest, np.linalg.norm(np.maximum(np.abs(places - (0, 0, 2)) - half, 0), axis=-1).min())
    assert 0.49 < nearest < 0.8
    for t in np.linspace(0, 60, 100):
        places = centers + (amplitudes * np.sin(rates * t + phases)).sum(axis=2)
        assert np.linalg.norm(np.maximum(np.abs(places - (105, 0, 2)) - half, 0), axis=-1).min() > 0.5
    with pytest.raises(InputError, match=r"scenario\.clearance: expected room for 50 boxes"):
        drawn(clearance=200.0)


def test_files_and_joined_layouts_keep_the_sines(tmp_path: Path) -> None:
    layouts = drawn(2)
    layouts.save(tmp_path / "trefoils.npz")
    again = Layouts.load(tmp_path / "trefoils.npz")
    assert all(np.array_equal(getattr(again, name), getattr(layouts, name)) for name in SINES)
    resting = Layouts(
        np.zeros((1, 0, 3)), np.zeros((1, 0)), box_centers=np.ones((1, 60, 3)), box_half_sizes=np.ones((1, 60, 3)),
        start=layouts.start[0] if layouts.start is not None else None, goal=(105, 0, 2), dt=0.05, stages=100,
        vehicle_radius=0.1, goal_radius=0.5,
    )  # fmt: skip
    short = Layouts(**{**vars(layouts), "goal": np.array([105.0, 0, 2]), "ids": np.empty(0, np.int64)})
    both = concatenate([short, resting])
    assert both.box_amplitudes is not None and layouts.box_amplitudes is not None
    assert np.array_equal(both.box_amplitudes[:2, :50], layouts.box_amplitudes)
    assert np.isnan(both.box_amplitudes[:2, 50:]).all() and (both.box_amplitudes[2] == 0).all()


def test_a_task_has_them_and_their_digest_differs() -> None:
    setup = compose(["scenario=trefoils", "scenario.num_obstacles=20"])
    layouts = setup.layouts(2)
    boxes = [part for part in setup.task(layouts).problem.constraints if isinstance(part, BoundOscillatingBoxes)]
    assert len(boxes) == 1 and boxes[0].moving and boxes[0].amplitudes.shape == (2, 20, 2, 3)
    assert layouts.box_centers is not None and layouts.box_phases is not None
    assert torch.equal(boxes[0].boxes.centers, torch.from_numpy(layouts.box_centers))
    other = Layouts(**{**vars(layouts), "box_phases": layouts.box_phases + 0.1})
    mine, theirs = (layout_digests(part, {"dynamics": {}}) for part in (layouts, other))
    assert all(mine[i] != theirs[i] for i in (0, 1))


SINE = np.zeros((2, 50, 2, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"box_rates": None}, "layouts.box_rates: expected this array with box_amplitudes, got none"),
        ({"box_rates": SINE[:, :, :1]}, r"layouts.box_rates: expected shape \(2, 50, 2, 3\) as box_amplitudes"),
        ({"box_amplitudes": SINE[:1]}, r"layouts.box_amplitudes: expected shape \(2, 50, S, 3\), got"),
        ({"box_phases": SINE + np.nan}, "layouts.box_phases: expected finite numbers where the centre is finite"),
        ({"box_centers": None, "box_half_sizes": None}, "layouts.box_amplitudes: expected none without box_centers"),
    ],
)
def test_wrong_sines_are_refused(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Layouts(**{**vars(drawn(2)), **change})
