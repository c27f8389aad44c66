"""world and sdf: the boxes, cylinders and spheres that stand in a Gazebo world, as cells."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from torchgco.base.errors import shown
from torchgco.maps.files.source import FARTHEST_AT, MOST_CELLS, Source, check_far, made
from torchgco.maps.grid import OccupancyGrid

WORLD_FILE = "a Gazebo world or model in SDF"
MOST_XML = 2**24  # bytes
MOST_SHAPES = 2**14
MOST_WORK = 2**29  # cells that are looked at, all shapes together
MODEL_DEPTH = 16  # of models within models
EMPTY = {"model://sun", "model://ground_plane"}  # what many worlds include, and nothing stands in the way of


@dataclass(frozen=True)
class Frame:
    """A place and the axes there: a point p of it lies at R p + t."""

    R: np.ndarray
    t: np.ndarray

    def then(self, other: Frame) -> Frame:
        """The frame `other`, which is given in this one."""
        return Frame(self.R @ other.R, self.R @ other.t + self.t)


@dataclass(frozen=True)
class Shape:
    """A box, or a cylinder or sphere, m: half its sides; `round` axes are measured together, as a radius."""

    frame: Frame
    half: np.ndarray  # (3,)
    round: int  # 0: a box, 2: a cylinder along z, 3: a sphere

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distances (...) of points (..., 3) from the shape, 0 inside, m."""
        p = (points - self.frame.t) @ self.frame.R
        beside = [np.linalg.norm(p[..., : self.round], axis=-1) - self.half[0]] if self.round else []
        beside += [np.abs(p[..., i]) - self.half[i] for i in range(self.round, 3)]
        return np.linalg.norm(np.maximum(np.stack(beside, axis=-1), 0.0), axis=-1)

    @property
    def reach(self) -> np.ndarray:
        """Half the sides of the box along the axes that holds the shape, (3,), m."""
        return self.half if self.round == 3 else np.abs(self.frame.R) @ self.half


def read_world(source: Source, resolution: float | None) -> OccupancyGrid:
    """Cells whose centre lies within half a diagonal of a static model's box, cylinder or sphere are occupied.

    So every cell that a shape touches is, and some beside it. Planes, the sun and models that move are left out. Models
    stand where the world's <state> has them, which Gazebo writes when a world is saved: their own poses may be older.

    Raises:
        InputError: another file, no shape, geometry of other kinds, models that are included from elsewhere, drawn,
            inserted or scaled afterwards, poses that are relative to named frames.
    """
    resolution = source.needs("resolution", resolution, "the side of a cell, m")
    shapes = list(_shapes(source, _root(source)))
    if not shapes:
        source.refuse(f"{WORLD_FILE} with a box, cylinder or sphere in a static model", "none")
    source.limit(len(shapes), MOST_SHAPES, "shapes")
    ends = np.array([(shape.frame.t - shape.reach, shape.frame.t + shape.reach) for shape in shapes])
    check_far(source, ends)
    near = 0.5 * math.sqrt(3.0) * resolution
    first, last = (np.floor((ends[:, i] + sign * near) / resolution).astype(np.int64) for i, sign in ((0, -1), (1, 1)))
    low, sides = first.min(0), last.max(0) - first.min(0) + 1
    for count, most, what in (
        (int(np.prod(sides, dtype=float)), MOST_CELLS, f"cells ({' x '.join(map(str, sides))})"),
        (int(np.prod(last - first + 1.0, axis=-1).sum()), MOST_WORK, "cells around all shapes"),
    ):
        source.limit(count, most, what)
    cells = np.zeros(tuple(sides), bool)
    for shape, begin, end in zip(shapes, first, last, strict=True):
        for k in range(begin[2], end[2] + 1):  # layer by layer: a large shape would take much memory
            axes = [resolution * (np.arange(a, b + 1) + 0.5) for a, b in zip(begin[:2], end[:2], strict=True)]
            points = np.stack(np.meshgrid(*axes, [resolution * (k + 0.5)], indexing="ij"), axis=-1)[:, :, 0]
            columns = tuple(slice(a, b + 1) for a, b in zip((begin - low)[:2], (end - low)[:2], strict=True))
            cells[(*columns, k - low[2])] |= shape.distance(points) <= near
    return made(source, cells, low * resolution, resolution)


def _root(source: Source) -> Element:
    raw = source.bytes(WORLD_FILE, MOST_XML)
    if re.search(rb"<!(DOCTYPE|ENTITY)", raw, re.IGNORECASE):
        source.refuse(f"{WORLD_FILE} without definitions of its own", "a DOCTYPE or ENTITY")
    with source.library(WORLD_FILE):
        root = ElementTree.fromstring(raw)
    if root.tag not in ("sdf", "gazebo"):
        source.refuse(WORLD_FILE, f"<{root.tag[:40]}>")
    return root


def _shapes(source: Source, root: Element) -> Iterator[Shape]:
    for world in root.findall("world") or [root]:
        for include in world.iter("include"):
            uri = (include.findtext("uri") or "").strip()
            if uri not in EMPTY:
                expected = "a world whose models stand in the file: `gz sdf -p FILE` writes included ones out"
                source.refuse(expected, f"an include of {shown(uri[:60])}")
        if world.find("population") is not None:
            source.refuse("a world whose models stand in the file", "a population, drawn by Gazebo")
        here, state = Frame(np.eye(3), np.zeros(3)), _state(source, world)
        yield from _of_models(source, world, here, state, static=False, depth=0)


def _state(source: Source, world: Element) -> Element | None:
    """What a saved world says of where its models were by then."""
    state = world.find("state")
    for element in () if state is None else state:
        if element.tag in ("insertions", "deletions") and len(element):
            source.refuse("a world whose models stand in the file", f"{element.tag} in its state")
    return state


def _of_models(
    source: Source, parent: Element, frame: Frame, state: Element | None, static: bool, depth: int
) -> Iterator[Shape]:
    if depth > MODEL_DEPTH:
        source.refuse(f"models within models {MODEL_DEPTH} deep at most", "more")
    for model in parent.findall("model"):
        kept = _kept(state, model)
        if model.get("placement_frame"):
            source.refuse("models placed by their own frame", f"placement_frame {shown(model.get('placement_frame'))}")
        scaled = kept is not None and kept.find("scale") is not None
        if kept is not None and scaled and any(scale != 1.0 for scale in _numbers(source, kept, "scale", 3)):
            source.refuse("models of the size in which they were saved", f"<scale> {shown(kept.findtext('scale'))}")
        model_frame = _placed(source, model, frame, kept)
        fixed = static or (model.findtext("static") or "").strip().lower() in ("1", "true")
        yield from _of_models(source, model, model_frame, kept, fixed, depth + 1)
        for link in model.findall("link") if fixed else ():
            here = _placed(source, link, model_frame, _kept(kept, link))
            for collision in link.findall("collision"):
                shape = _shape(source, collision.find("geometry"), here.then(_pose(source, collision)))
                if shape is not None:
                    yield shape


def _kept(state: Element | None, element: Element) -> Element | None:
    """What a state says of a model or link; None where it says nothing."""
    states = () if state is None else state.findall(element.tag)
    return next((kept for kept in states if kept.get("name") == element.get("name")), None)


def _placed(source: Source, element: Element, around: Frame, kept: Element | None) -> Frame:
    """The frame of a model or link in the world: its own pose is one in `around`, that of a state in the world."""
    if kept is not None and (kept.findtext("pose") or "").strip():
        return _pose(source, kept)
    return around.then(_pose(source, element))


def _shape(source: Source, geometry: Element | None, frame: Frame) -> Shape | None:
    """None of a plane, or of nothing."""
    shape = None if geometry is None else next(iter(geometry), None)
    if shape is None or shape.tag in ("plane", "empty"):
        return None
    if shape.tag == "box":
        half, round = 0.5 * np.array(_numbers(source, shape, "size", 3)), 0
    elif shape.tag == "sphere":
        half, round = np.full(3, _numbers(source, shape, "radius", 1)), 3
    elif shape.tag == "cylinder":
        (radius,), (length,) = (_numbers(source, shape, name, 1) for name in ("radius", "length"))
        half, round = np.array([radius, radius, 0.5 * length]), 2
    else:
        source.refuse("static models of boxes, cylinders or spheres", f"<{shape.tag[:40]}>")
    if not (half > 0).all():
        source.refuse("shapes of sizes above 0 m", f"half sides {half.tolist()}")
    return Shape(frame, half, round)


def _pose(source: Source, element: Element) -> Frame:
    """x, y, z, m, and the angles of Rz Ry Rx, rad; the parent's frame where there is no pose."""
    from scipy.spatial.transform import Rotation

    pose = element.find("pose")
    if pose is None or not (pose.text or "").strip():
        return Frame(np.eye(3), np.zeros(3))
    if pose.get("relative_to") or pose.get("frame"):
        source.refuse("poses relative to what is around them", f"one relative to {shown(dict(pose.attrib))}")
    x, y, z, *angles = _numbers(source, element, "pose", 6)
    degrees = (pose.get("degrees") or "").strip().lower() in ("1", "true")
    return Frame(Rotation.from_euler("xyz", angles, degrees).as_matrix(), np.array([x, y, z]))


def _numbers(source: Source, element: Element, name: str, count: int) -> list[float]:
    text = (element.findtext(name) or "").strip()
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(abs(number) <= FARTHEST_AT for number in numbers):
        source.refuse(f"<{name}> of {count} numbers", shown(text[:60]))
    return numbers
