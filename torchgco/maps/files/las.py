"""las and laz: points of a laser scan from the air, read by laspy."""

from __future__ import annotations

import numpy as np

from torchgco.base.extras import imported
from torchgco.maps.files.source import MOST_BYTES, MOST_POINTS, Source, finite_points

LAS_FILE = "a las or laz file of points"
RECORDS_AT_ONCE = 2**20  # points: a header may promise more than there are


def read_las(source: Source) -> np.ndarray:
    """Points (P, 3), m, in the file's own frame: often far from its origin, as coordinates on the Earth are.

    Raises:
        InputError: another file, a damaged one, or one of too many points.
    """
    source.limit(source.size(LAS_FILE), MOST_BYTES, "bytes")
    laspy = imported("laspy", "maps", source.field)
    with source.library(LAS_FILE), laspy.open(source.path) as file:
        source.limit(file.header.point_count, MOST_POINTS, "points")
        parts = [np.stack([chunk.x, chunk.y, chunk.z], axis=-1) for chunk in file.chunk_iterator(RECORDS_AT_ONCE)]
    points = np.concatenate([np.empty((0, 3)), *parts])
    if len(points) != file.header.point_count:
        source.refuse(f"{LAS_FILE} with {file.header.point_count:,} of them", f"{len(points):,}")
    return finite_points(source, points)
