"""Maps of ROS's map_server: a yaml file and the image that it names."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchgco.base.errors import InputError, shown
from torchgco.maps.files.images import load, turned
from torchgco.maps.files.rotated import rotated
from torchgco.maps.files.source import Source, check_far, made
from torchgco.maps.grid import OccupancyGrid

MOST_YAML = 2**14  # bytes
YAML = "a map_server yaml file with image, resolution, origin, negate, occupied_thresh and free_thresh"
MODES = ("trinary", "scale", "raw")
FULL = 2.0 * math.pi + 1e-3  # rad
NUMBER_PATTERN = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?", re.ASCII)


def beside(source: Source) -> Source | None:
    """The yaml file in an image's folder that describes it as a map of map_server; None where there is none.

    Raises:
        InputError: several do, none of them with the image's stem.
    """
    yamls = [path for path in sorted(source.path.parent.glob("*.y*ml")) if _names(replace(source, path=path), source)]
    fit = [path for path in yamls if path.stem == source.path.stem] or yamls
    if len(fit) > 1:
        source.refuse("an image that one yaml file describes, or that file", f"{', '.join(path.name for path in fit)}")
    return replace(source, path=fit[0]) if fit else None


def _names(by: Source, source: Source) -> bool:
    """Whether a yaml file is small, and a mapping whose image is this one."""
    try:
        if by.size(YAML) > MOST_YAML or source.path.name.encode() not in by.bytes(YAML, MOST_YAML):
            return False
        image = _mapping(by).get("image")
    except InputError:  # of another program
        return False
    return isinstance(image, str) and Path(image).name == source.path.name


def read_described(source: Source, by: Source, resolution: float | None, origin: np.ndarray | None) -> OccupancyGrid:
    """An image as the yaml file `by` describes it: with thresholds, unknown cells and the origin.

    Raises:
        InputError: another resolution or origin than the file's, and as `read_map_server`.
    """
    keys = _keys(by)
    side = _number(by, keys, "resolution")
    if resolution is not None and not math.isclose(resolution, side, rel_tol=1e-9):
        raise InputError(f"{source.name}.resolution", f"{side:g}, as {by.path} says of this image", resolution)
    grid = read_map_server(by, source.path)
    there = keys["origin"][:2]
    if origin is not None and not np.allclose(origin[:2], np.array(there, float), rtol=1e-9, atol=1e-9):
        raise InputError(f"{source.name}.origin", f"{there}, as {by.path} says of this image", origin.tolist())
    return grid


def read_map_server(source: Source, image: Path | None = None) -> OccupancyGrid:
    """The map as map_server publishes it, turned by the origin's yaw into cells along the axes.

    A pixel's darkness in [0, 1] (brightness where `negate`) is occupied from `occupied_thresh`, free below
    `free_thresh`, and in between unknown (`mode: trinary`) or a probability that grows evenly (`scale`: transparent
    pixels are unknown). In `raw`, brightness 0 to 100 of 255 is a probability in percent, and above unknown.

    Args:
        image: read in place of the one that the yaml file names.

    Raises:
        InputError: a yaml or an image that can't be read, keys that are missing or out of range.
    """
    keys = _keys(source)
    mode = keys.get("mode", "trinary")
    if mode not in MODES:
        source.refuse(f"mode, one of {', '.join(MODES)}", shown(mode))
    resolution = _number(source, keys, "resolution")
    if not 0.0 < resolution < math.inf:
        source.refuse("resolution > 0, m", resolution)
    origin = keys["origin"]
    if not isinstance(origin, list) or len(origin) != 3:
        source.refuse("origin [x, y, yaw]", shown(origin))
    x, y, yaw = (_number(source, {"origin": value}, "origin") for value in origin)
    if abs(yaw) > FULL:
        source.refuse("a yaw of the origin in radians, at most a full turn", f"{yaw:g}")
    named = keys["image"]
    if not isinstance(named, str) or not named:
        source.refuse("image, the path of an image file", shown(named))
    brightness, alpha = load(replace(source, path=source.path.parent / named if image is None else image))
    negate = keys["negate"]
    if negate not in (0, 1):
        source.refuse("negate 0 or 1", shown(negate))
    cells = _occupancy(source, keys, mode, bool(negate), brightness, alpha)
    corner = np.array([x, y])
    check_far(source, corner)
    cells, corner = rotated(source, turned(cells), corner, yaw, resolution) if yaw else (turned(cells), corner)
    return made(source, cells, corner, resolution)


def _occupancy(
    source: Source, keys: dict[str, Any], mode: str, negate: bool, brightness: np.ndarray, alpha: np.ndarray | None
) -> np.ndarray:
    """Probabilities (rows, columns), float32, NaN where unknown."""
    unknown = np.float32("nan")
    if mode == "raw":
        if negate:
            source.refuse("negate 0 with mode raw, which ROS 1 and 2 read differently", 1)
        percent = np.round(brightness * 255.0)
        return np.where(percent <= 100.0, percent / np.float32(100.0), unknown)
    occupied, free = (_number(source, keys, name) for name in ("occupied_thresh", "free_thresh"))
    if not 0.0 <= free <= occupied <= 1.0:
        source.refuse("0 <= free_thresh <= occupied_thresh <= 1", f"{free:g} and {occupied:g}")
    if mode == "trinary" and alpha is not None:
        brightness = (3.0 * brightness + alpha) / 4.0  # as map_server does
    darkness = brightness if negate else 1.0 - brightness
    # At the thresholds ROS 1 and 2 differ: here the cautious one of both.
    between = unknown
    if mode == "scale":
        width = np.float32(max(occupied - free, 1e-6))
        between = np.float32(0.01) + np.float32(0.98) * (darkness - np.float32(free)) / width
        between = between if alpha is None else np.where(alpha < 1.0, unknown, between)
    result = np.where(darkness >= occupied, np.float32(1.0), np.where(darkness < free, np.float32(0.0), between))
    return result.astype(np.float32)


def _keys(source: Source) -> dict[str, Any]:
    """The mapping of the yaml file, with the keys of map_server."""
    keys = _mapping(source)
    needed = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
    if missing := [name for name in needed if name not in keys]:
        source.refuse(YAML, f"none of {', '.join(missing)}" if len(missing) > 1 else f"no {missing[0]}")
    return keys


def _mapping(source: Source) -> dict[str, Any]:
    """The mapping of the yaml file: no tags beyond the plain ones, no aliases, which can multiply without end."""
    import yaml

    class Plain(yaml.loader.SafeLoader):
        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise yaml.YAMLError("an alias")
            return super().compose_node(parent, index)

    text = source.bytes(YAML, MOST_YAML)
    with source.library(YAML):
        keys = yaml.load(text, Plain)
    if not isinstance(keys, dict):
        source.refuse(YAML, type(keys).__name__)
    return keys


def _number(source: Source, keys: dict[str, Any], name: str) -> float:
    """A finite number; `1e-2` is one, too, which YAML 1.1 reads as text."""
    value = keys[name]
    if isinstance(value, str) and NUMBER_PATTERN.fullmatch(value):
        value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not -1e300 < value < 1e300:
        source.refuse(f"{name}, a finite number", shown(value))
    return float(value)
