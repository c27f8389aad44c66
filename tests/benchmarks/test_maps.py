"""Pictures of worlds as cells and as shapes."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from benchmarks.causes.maps import main


def test_a_world_in_the_plane_is_drawn(tmp_path: Path) -> None:
    assert main(["planar_random:0:0.2", "--path", str(tmp_path / "maps.png")]) == 0
    with Image.open(tmp_path / "maps.png") as picture:
        colors = picture.convert("RGB").getcolors(2**20)
    assert colors is not None and len(colors) > 20
