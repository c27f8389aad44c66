"""Any file of a map is read, or refused in one clear line; what is read is a grid or a cloud within the limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.fuzz.tally import accepted_or_refused, examples
from tests.maps.files import samples
from torchgco.maps import OccupancyGrid, PointCloud, read

pytestmark = pytest.mark.slow

WORDS = st.sampled_from(
    ["0", "1", "-1", "4", "1e9", "999999999999", "nan", "F", "U", "x", "", "3.5", "ascii", "binary"]
)
VALUES = st.one_of(
    st.floats(),
    st.integers(-300, 300),
    st.booleans(),
    st.text(max_size=5),
    st.none(),
    st.lists(st.floats(), max_size=4),
)
LENGTHS = st.one_of(st.none(), st.sampled_from([0.1, 1.0]), st.floats())
KINDS = [np.float64, np.float32, np.int64, np.uint8, np.bool_, np.complex128, "U3", "M8[s]", ">i2"]


def check(found: Any) -> None:
    """A grid or a cloud can be used, or nothing was read."""
    if isinstance(found, OccupancyGrid):
        assert np.isfinite(found.origin).all() and found.resolution > 0
        known = found.occupied[~found.is_unknown]
        assert ((known >= 0) & (known <= 1)).all()
    elif found is not None:
        assert isinstance(found, PointCloud) and np.isfinite(found.points).all() and len(found.points)


def attempt(kind: str, path: Path, options: dict[str, Any]) -> None:
    check(accepted_or_refused(kind, lambda: read(path, **options)))


@settings(max_examples=examples(1000), suppress_health_check=list(HealthCheck))
@given(data=st.data(), name=st.sampled_from(sorted(samples.SAMPLES)))
def test_any_bytes(data: st.DataObject, name: str, tmp_path: Path) -> None:
    """A sound file with bytes changed, moved, cut or added."""
    held, options = bytearray(samples.SAMPLES[name][0]), samples.SAMPLES[name][1]
    for _ in range(data.draw(st.integers(1, 8))):
        at, to = sorted(data.draw(st.tuples(*[st.integers(0, len(held))] * 2)))
        held[at : to if data.draw(st.booleans()) else at] = data.draw(st.binary(max_size=8))
    attempt("bytes of map files", samples.write(tmp_path, name, bytes(held)), options)


@settings(max_examples=examples(500), suppress_health_check=list(HealthCheck))
@given(
    data=st.data(), name=st.sampled_from([n for n in sorted(samples.SAMPLES) if n.endswith((".pcd", ".ply", ".bt"))])
)
def test_any_header(data: st.DataObject, name: str, tmp_path: Path) -> None:
    """Words of a header replaced, lines gone or twice."""
    raw, options = samples.SAMPLES[name]
    lines = raw.split(b"\n", 14)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 2))
        words = lines[at].split(b" ")
        words[data.draw(st.integers(0, len(words) - 1))] = data.draw(WORDS).encode()
        lines[at : at + 1] = data.draw(st.sampled_from([[b" ".join(words)], [], [lines[at]] * 2]))
    attempt("headers of map files", samples.write(tmp_path, name, b"\n".join(lines)), options)


@settings(max_examples=examples(500), suppress_health_check=list(HealthCheck))
@given(
    changed=st.dictionaries(
        st.sampled_from(["image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode"]), VALUES
    )
)
def test_any_keys_of_map_server(changed: dict[str, Any], tmp_path: Path) -> None:
    attempt(
        "keys of map_server", samples.write(tmp_path, "map.yaml", samples.yaml(**{"image": "plan.pgm"} | changed)), {}
    )


@settings(max_examples=examples(500), suppress_health_check=list(HealthCheck))
@given(data=st.data(), height=LENGTHS, resolution=LENGTHS)
@pytest.mark.filterwarnings("ignore:.*:RuntimeWarning")
def test_any_array(data: st.DataObject, height: float | None, resolution: float | None, tmp_path: Path) -> None:
    shape = data.draw(arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
    with np.errstate(all="ignore"):
        array = data.draw(arrays.arrays(float, shape, elements=st.one_of(st.floats(-9, 9), st.floats()))).astype(
            data.draw(st.sampled_from(KINDS))
        )
    options = {"height": height, "resolution": resolution, "radius": data.draw(st.sampled_from([None, 0.1]))}
    attempt("arrays of maps", samples.write(tmp_path, "a.npy", samples.npy(array)), options)
    raw = samples.npz(occupied=array, resolution=resolution or 1.0)
    attempt("arrays of maps", samples.write(tmp_path, "a.npz", raw), {})
