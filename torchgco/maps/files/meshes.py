"""stl, obj, and ply with faces: triangles of a surface as cells, read by trimesh."""

from __future__ import annotations

import math
import re
from io import BytesIO

import numpy as np

from torchgco.base.extras import imported
from torchgco.maps.files.source import MOST_CELLS, MOST_TEXT, Source, check_far, made
from torchgco.maps.grid import OccupancyGrid

MESH_FILE = "a mesh of triangles, stl, obj or ply"
LONGEST_EDGE = 0.5  # of a cell: triangles are divided until no edge is longer
MOST_PIECES = 2**25  # triangles after this
MOST_ASKED = 2**26  # angles of triangles
FOLDED = 1e-4  # rad


def read_mesh(source: Source, resolution: float | None, solid: bool | None) -> OccupancyGrid:
    """The cells that a surface passes through are occupied, and its inside: rooms between closed walls stay free.

    Args:
        resolution: side of a cell, m.
        solid: whether the inside is occupied, too; None: where the surface is closed.

    Raises:
        InputError: no such mesh, too fine a grid, faces with inner corners, a surface that isn't closed where `solid`
            is asked for.
    """
    resolution = source.needs("resolution", resolution, "the side of a cell, m, for a mesh")
    vertices, faces, closed = _loaded(source)
    if solid and not closed:
        source.refuse("a closed surface, or solid=False", "one with holes or edges of its own")
    low, high = (np.floor(end(0) / resolution).astype(np.int64) for end in (vertices.min, vertices.max))
    shape = high - low + 1
    source.limit(int(np.prod(shape, dtype=float)), MOST_CELLS, f"cells ({' x '.join(map(str, shape))})")
    cells = np.zeros(tuple(shape), bool)
    cells[tuple((_pieces(source, vertices, faces, resolution) - low).T)] = True
    if solid or (solid is None and closed):
        cells |= _enclosed(source, cells, vertices[faces] / resolution - low)
    return made(source, cells, low * resolution, resolution)


def _loaded(source: Source) -> tuple[np.ndarray, np.ndarray, bool]:
    """Vertices (V, 3), m, faces (F, 3), and whether the surface is closed."""
    raw, kind = source.bytes(MESH_FILE, MOST_TEXT), source.path.suffix.lower()[1:]
    trimesh = imported("trimesh", "maps", source.field)
    with source.library(MESH_FILE):  # no resolver: files that it names, such as materials, aren't read
        mesh = trimesh.load_mesh(BytesIO(raw), file_type=kind, force="mesh", skip_materials=True)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)  # textures and normals cut surfaces along their seams
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
        polygons = len(faces) > _declared(kind, raw)
        folded = polygons and _is_folded(vertices, faces, mesh.face_adjacency_angles)
        closed = bool(mesh.is_watertight)
        if closed and not mesh.is_winding_consistent:
            trimesh.repair.fix_winding(mesh)
            faces = np.asarray(mesh.faces)
    if vertices.shape[-1] != 3:
        source.refuse(MESH_FILE, f"vertices of {vertices.shape[-1]} coordinates")
    if not len(faces) or not np.isfinite(vertices).all():
        source.refuse(MESH_FILE, f"{len(faces):,} faces" if not len(faces) else "vertices that aren't finite")
    if folded:
        source.refuse("triangles (Blender: Triangulate Faces)", "faces with inner corners, which overlap as triangles")
    check_far(source, vertices)
    return vertices, faces, closed


def _declared(kind: str, raw: bytes) -> float:
    """How many faces a file has, before trimesh divides those with more corners into fans of triangles."""
    if kind == "obj":
        return len(re.findall(rb"(?m)^[ \t]*f[ \t]", raw))
    match = re.search(rb"(?m)^element[ \t]+face[ \t]+(\d+)", raw) if kind == "ply" else None
    return int(match[1]) if match else math.inf


def _is_folded(vertices: np.ndarray, faces: np.ndarray, angles: np.ndarray) -> bool:
    """Whether triangles of a face with an inner corner lie on each other: neighbours, or those of a fan.

    Args:
        angles: between the normals of neighbours, rad.
    """
    if (angles > np.pi - FOLDED).any():
        return True
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    goes_on = (faces[1:, 0] == faces[:-1, 0]) & (faces[1:, 1] == faces[:-1, 2])
    fan = np.concatenate(([0], (~goes_on).cumsum()))
    whole = np.zeros((fan[-1] + 1, 3))
    np.add.at(whole, fan, normals)
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(whole[fan], axis=1)
    return bool(((normals * whole[fan]).sum(1) < -np.cos(FOLDED) * lengths).any())


def _enclosed(source: Source, cells: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Free cells inside of a closed surface whose triangles (F, 3, 3), in cells, turn the same way.

    Cells that are connected lie on the same side, so one of each region is asked.
    """
    from scipy.ndimage import label

    regions, count = label(~cells)
    source.limit(
        count * len(corners), MOST_ASKED, "free regions times triangles: larger cells, or solid=False, take fewer"
    )
    _, first = np.unique(regions, return_index=True)
    inside = np.zeros(count + 1, bool)
    inside[regions.ravel()[first]] = [
        bool(cell) and abs(_turns(corners - (np.array(np.unravel_index(index, cells.shape)) + 0.5))) > 0.5
        for cell, index in zip(regions.ravel()[first], first, strict=True)
    ]
    return inside[regions]


def _turns(corners: np.ndarray) -> float:
    """How often triangles (F, 3, 3) wind around the origin: solid angles (van Oosterom, Strackee 1983) by 4 pi."""
    a, b, c = np.moveaxis(corners, 1, 0)
    na, nb, nc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    dot = lambda v, w: (v * w).sum(-1)
    below = na * nb * nc + dot(a, b) * nc + dot(b, c) * na + dot(c, a) * nb
    return float(np.arctan2(dot(a, np.cross(b, c)), below).sum() / (2.0 * np.pi))


def _pieces(source: Source, vertices: np.ndarray, faces: np.ndarray, resolution: float) -> np.ndarray:
    """The cells (P, 3), as whole numbers, that hold a corner of the triangles once these are small."""
    from trimesh.remesh import subdivide_to_size

    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(-1)
    halvings = np.ceil(np.log2(np.maximum(longest / (LONGEST_EDGE * resolution), 1.0)))
    source.limit(int((4.0**halvings).sum()), MOST_PIECES, "pieces of triangles: larger cells take fewer")
    divided = subdivide_to_size(vertices, faces, LONGEST_EDGE * resolution, max_iter=math.ceil(halvings.max()) + 1)
    return np.unique(np.floor(divided[0] / resolution).astype(np.int64), axis=0)
