"""Any layout file is flown, or refused in one clear line; a layout that can't be flown is a status."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.fuzz.tally import accepted_or_refused, examples
from torchgco import Hold, Status, judge
from torchgco.experiments.config.build import compose
from torchgco.scenarios.files import LayoutFile

pytestmark = pytest.mark.slow

LENGTHS = st.one_of(
    st.floats(-3, 3), st.sampled_from([0.0, np.nan, np.inf, -np.inf, 1e-300, 1e9, 1e200, 1e308, -1e308])
)
KINDS = st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.complex128, "U3", "M8[s]", object])
FIELDS = (
    "centers", "radii", "velocities", "start", "goal", "vehicle_radius", "goal_radius", "dt", "stages",
    "control_lower", "control_upper", "best_cost", "box_centers", "box_half_sizes", "box_rotations", "ids", "name",
)  # fmt: skip


def sound(draw: Any) -> dict[str, np.ndarray]:
    """The arrays of a file as it should be, whose layouts may well be impossible to fly."""
    L, M, K = draw(st.integers(1, 3)), draw(st.integers(0, 4)), draw(st.integers(0, 2))
    places = st.floats(-2, 2)
    held = {
        "centers": draw(arrays.arrays(float, (L, M, 2), elements=places)),
        "radii": draw(arrays.arrays(float, (L, M), elements=st.floats(0, 0.5))),
    }
    if draw(st.booleans()):
        held["velocities"] = draw(arrays.arrays(float, (L, M, 2), elements=places))
    if K:
        held["box_centers"] = draw(arrays.arrays(float, (L, K, 2), elements=places))
        held["box_half_sizes"] = draw(arrays.arrays(float, (L, K, 2), elements=st.floats(0.01, 1)))
    return held | {"stages": np.array(draw(st.integers(1, 8)))}


@st.composite
def files(draw: Any) -> dict[str, np.ndarray]:
    """A sound file, or one in which some fields are damaged, too many, or gone."""
    held = sound(draw)
    for name in draw(st.lists(st.sampled_from(FIELDS), max_size=2)):
        shape = draw(arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
        if draw(st.booleans()) and name in held:
            shape = held[name].shape
        values = draw(arrays.arrays(float, shape, elements=LENGTHS))
        with np.errstate(all="ignore"):
            held[name] = values.astype(draw(KINDS))
    for name in draw(st.lists(st.sampled_from(FIELDS), max_size=1)):
        held.pop(name, None)
    return held


VEHICLE = compose(["model=planar", "scenario=planar_random", "solver=hold"]).vehicle


def fly(path: Path) -> None:
    """Load the layouts, make the problems, and judge the vehicle at rest."""
    task = VEHICLE.task(LayoutFile(path).layouts)
    solution = Hold().solve(task.problem, task.U0)
    verdict = judge(task.problem, solution.U, task.goal, task.goal_radius)
    assert len(solution.statuses) == task.layouts.count and Status.RUNNING not in solution.statuses
    assert verdict.cost.shape == (task.layouts.count,)


@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
@settings(max_examples=examples(500), suppress_health_check=list(HealthCheck))
@given(held=files())
def test_any_arrays(held: dict[str, np.ndarray], tmp_path: Path) -> None:
    path = tmp_path / "layouts.npz"
    np.savez(path, allow_pickle=True, **held)
    accepted_or_refused("arrays in layout files", lambda: fly(path))


@settings(max_examples=examples(300), suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_bytes(data: st.DataObject, tmp_path: Path) -> None:
    """A whole file with some bytes changed, cut or added."""
    raw = io.BytesIO()
    np.savez(raw, centers=np.zeros((2, 3, 2)) + 1.0, radii=np.full((2, 3), 0.1), stages=np.array(4))
    text = bytearray(raw.getvalue())
    for _ in range(data.draw(st.integers(1, 3))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    text = text[: data.draw(st.one_of(st.just(len(text)), st.integers(0, len(text))))]
    path = tmp_path / "layouts.npz"
    path.write_bytes(bytes(text))
    accepted_or_refused("damaged layout files", lambda: fly(path))
