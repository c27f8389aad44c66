"""Images of floor plans and of heights: png, pgm, ppm, bmp, jpg and tif, read by Pillow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from torchgco.maps.files.source import MOST_CELLS, Source, check_far, made
from torchgco.maps.grid import OccupancyGrid

MOST_PIXELS = 2**26  # 8192 x 8192
IMAGE_FILE = "a png, pgm, ppm, bmp, jpg or tif image"
DECODERS = ("PNG", "PPM", "BMP", "JPEG", "TIFF")  # Pillow tries no other decoder
PHOTOMETRIC = 262  # TIFF's tag of what 0 means
DARK = 0.5  # of a floor plan: darker pixels are occupied


def read_image(
    source: Source, resolution: float | None, origin: np.ndarray | None, height: float | None
) -> OccupancyGrid:
    """A floor plan, dark where it is occupied; with `height`, the heights of the ground, white at `height` metres.

    The lower left pixel is the first cell, x goes to the right and y up, as viewers show the image: a camera's
    orientation counts.
    """
    source.needs("resolution", resolution, "the side of a pixel, m")
    brightness, alpha = load(source, upright=True)
    if height is not None:
        return above_ground(source, turned(brightness).astype(np.float64) * height, resolution, origin)
    if alpha is not None:
        brightness = brightness * alpha + (1.0 - alpha)  # on white paper
    return made(source, turned(brightness < DARK), np.zeros(2) if origin is None else origin, resolution)


def turned(rows: np.ndarray) -> np.ndarray:
    """Pixels (rows, columns) from the top as cells (X, Y) from the lower left."""
    return rows[::-1].T


def load(source: Source, upright: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """Brightness (rows, columns) in [0, 1], the mean of the colours, float32, and opacity likewise or None.

    Args:
        upright: whether the image is turned as its metadata say, which map_server doesn't.

    Raises:
        InputError: no such image, a damaged one, or one of more than `MOST_PIXELS`.
    """
    from PIL import Image, ImageOps

    source.size(IMAGE_FILE)
    with source.library(IMAGE_FILE), open(source.path, "rb") as file, Image.open(file, formats=DECODERS) as image:
        source.limit(image.width * image.height, MOST_PIXELS, f"pixels ({image.width:,} x {image.height:,} here)")
        image.load()
        if image.format == "TIFF" and image.mode.startswith("I"):
            _check_levels(source, image)
        return _levels(source, ImageOps.exif_transpose(image) if upright else image)


def _check_levels(source: Source, image: Any) -> None:
    """Pillow gives numbers of 32 bits as they are, of which 65535 needn't be white, and doesn't turn white at 0."""
    if image.mode == "I":
        source.refuse(f"{IMAGE_FILE} of 8 or 16 bits, unsigned", "another kind of numbers")
    if image.tag_v2.get(PHOTOMETRIC) == 0:
        source.refuse(f"{IMAGE_FILE} whose black is 0", "16 bits with white at 0")


def _levels(source: Source, image: Any) -> tuple[np.ndarray, np.ndarray | None]:
    if image.mode.startswith("I"):  # 16 bits
        numbers = np.asarray(image)
        if numbers.size and (numbers.min() < 0 or numbers.max() > 65535):
            source.refuse(f"{IMAGE_FILE} of 8 or 16 bits", f"a brightness of {numbers.max()}")
        return numbers.astype(np.float32) / np.float32(65535.0), None
    if image.mode in ("1", "L") and "transparency" not in image.info:
        return np.asarray(image.convert("L")).astype(np.float32) / np.float32(255.0), None
    if image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        source.refuse(f"{IMAGE_FILE} of 8 or 16 bits", f"Pillow's mode {image.mode}")
    opaque = image.mode in ("RGB", "P") and "transparency" not in image.info
    colours = np.asarray(image.convert("RGB" if opaque else "RGBA"))
    brightness = colours[..., :3].mean(-1, dtype=np.float32) / np.float32(255.0)
    return brightness, None if opaque else colours[..., 3].astype(np.float32) / np.float32(255.0)


def above_ground(
    source: Source, heights: np.ndarray, resolution: float | None, origin: np.ndarray | None
) -> OccupancyGrid:
    """Cells that reach below the ground are occupied, those above are free.

    The lowest layer begins at `origin[2]`, by default at the lowest height, rounded down to a whole cell, and the
    highest, free layer lies above the highest ground. A column without a finite height is unknown.

    Args:
        heights: (X, Y), m.
        resolution: side of a cell along all axes, m.
        origin: lowest corner (2,) or (3,) of the first cell, m; by default 0 in x and y.
    """
    resolution = source.needs("resolution", resolution, "the side of a cell, m")
    known = np.isfinite(heights)
    if not known.any():
        source.refuse("at least one finite height", f"{heights.size:,}, none of them finite")
    check_far(source, heights[known])
    anchor = np.zeros(2) if origin is None else origin
    floor = anchor[2] if len(anchor) == 3 else math.floor(heights[known].min() / resolution) * resolution
    layers = max(math.ceil((heights[known].max() - floor) / resolution), 0) + 1
    source.limit(layers * heights.size, MOST_CELLS, "cells")
    bottoms = floor + resolution * np.arange(layers)
    with np.errstate(invalid="ignore"):
        below = bottoms < heights[:, :, None]
    below[..., -1] = False  # rounding
    corner = np.array([*anchor[:2], floor])
    if known.all():
        return made(source, below, corner, resolution)
    return made(source, np.where(known[:, :, None], below.astype(np.float32), np.float32("nan")), corner, resolution)
