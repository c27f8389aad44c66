"""A map from a bag of ROS 1 or ROS 2."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.files.bags import mcap, ros1, sqlite
from torchgco.maps.files.bags.messages import decoded
from torchgco.maps.files.source import Source
from torchgco.maps.grid import OccupancyGrid

CONTAINERS = {".bag": ros1.last_message, ".mcap": mcap.last_message, ".db3": sqlite.last_message}


def read_bag(source: Source, topic: str | None) -> OccupancyGrid | np.ndarray:
    """The last point cloud or occupancy grid of a topic, in its own frame: no transforms are applied.

    Raises:
        InputError: no such bag, damage, several topics with maps and none of them chosen.
    """
    if topic is not None and not isinstance(topic, str):
        raise InputError(f"{source.name}.topic", "the name of a topic", shown(topic))
    if source.path.is_dir():
        source = replace(source, path=source.path / _only_file(source))
    return decoded(source, CONTAINERS[source.path.suffix.lower()](source, topic))


def _only_file(source: Source) -> str:
    try:
        names = sorted(entry.name for entry in source.path.iterdir())
    except OSError as error:
        source.refuse("a bag's folder", error.strerror or type(error).__name__)
    files = [name for name in names if name.lower().endswith((".mcap", ".db3"))]
    if len(files) != 1:
        got = ", ".join(files[:5]) + (", ..." if len(files) > 5 else "")
        packed = any(name.endswith(".zstd") for name in names)
        source.refuse(
            "a bag's folder with one mcap or db3 file, or the path of one of them",
            got or ("files packed by zstd (`zstd -d` unpacks them)" if packed else "none"),
        )
    return files[0]
