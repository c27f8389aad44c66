"""Maps among the arrays of layouts, so that a study's files hold the map that was flown."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from torchgco.base.errors import InputError
from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid
from torchgco.maps.points import PointCloud

GRID = ("map_occupied", "map_origin", "map_resolution")
CLOUD = ("map_points", "map_radius")
MAP_ARRAYS = (*GRID, *CLOUD, "map_unknown")


def map_arrays(field: DistanceField) -> dict[str, np.ndarray]:
    """What a field is of, by the names of a file: the cells or the points, and what unknown cells count as."""
    source = field.source
    if isinstance(source, OccupancyGrid):
        values = (source.occupied, source.origin, source.resolution)
        return {name: np.asarray(value) for name, value in zip(GRID, values, strict=True)} | {
            "map_unknown": np.array(field.unknown)
        }
    return {name: np.asarray(value) for name, value in zip(CLOUD, (source.points, source.radius), strict=True)}


def map_of(arrays: Mapping[str, np.ndarray]) -> DistanceField | None:
    """The field of the map among these arrays; None where there is none.

    Raises:
        InputError: arrays of a map of which some are missing or malformed, named `layouts.<array>`.
    """
    stored = [name for name in MAP_ARRAYS if name in arrays]
    if not stored:
        return None
    kind = CLOUD if "map_points" in arrays else GRID
    if missing := [name for name in kind if name not in arrays]:
        raise InputError(f"layouts.{missing[0]}", f"this array beside {stored[0]}", "none")
    values = [arrays[name] for name in kind]
    if kind is CLOUD:
        return DistanceField.of(PointCloud(*values))
    unknown = arrays.get("map_unknown", np.array("occupied"))
    return DistanceField.of(OccupancyGrid(*values), str(unknown))  # type: ignore[arg-type]
