"""Paths of one class count once: in the plane by their winding, in space by their distance."""

import torch

from tests.search.scenes import NONE, first_of_class, inflated
from torchgco.roadmap.geometry import Inflated


def balls(centers: list[list[float]], radii: list[float], B: int = 1) -> Inflated:
    return inflated([centers] * B, [radii] * B)


def through(*corners: list[float]) -> torch.Tensor:
    """A path (P, d) through some corners, padded with its goal."""
    d = len(corners[0])
    ends = [[-1.0] + [0.0] * (d - 1)], [[1.0] + [0.0] * (d - 1)] * (4 - len(corners))
    return torch.tensor([*ends[0], *corners, *ends[1]], dtype=torch.float64)


def test_in_the_plane_paths_on_different_sides_differ() -> None:
    paths = torch.stack([
        through([0.0, 0.5]), through([-0.2, 0.9], [0.4, 0.8]),  # over both discs
        through([0.0, -0.5]),  # under both
        through([-0.5, 0.5], [0.0, 0.0], [0.5, -0.5]),  # over the first, under the second
        through([0.0, -2.0], [0.5, -1.0]),  # under both, from farther below
    ])  # fmt: skip
    two = balls([[-0.5, 0.0], [0.5, 0.0]], [0.2, 0.2], B=2)
    assert first_of_class(paths.expand(2, -1, -1, -1), two).tolist() == [[True, False, True, True, False]] * 2
    one = balls([[-0.5, 0.0], [0.5, 0.0]], [0.2, NONE])  # the second is absent
    assert first_of_class(paths[None], one).tolist() == [[True, False, True, False, False]]


def test_a_loop_around_a_disc_is_another_class() -> None:
    straight = through([0.0, 0.5])
    loop = through([0.5, 0.5], [0.0, -0.5], [-0.5, 0.5])
    assert first_of_class(torch.stack([straight, loop])[None], balls([[0.0, 0.0]], [0.2])).tolist() == [[True, True]]


def test_in_space_paths_far_from_each_other_are_different() -> None:
    ball = balls([[0.0, 0.0, 0.0]], [0.3])
    over, left, near = through([0.0, 0.0, 0.5]), through([0.0, 0.5, 0.0]), through([0.0, 0.1, 0.5])
    assert first_of_class(torch.stack([over, near, left, over])[None], ball).tolist() == [[True, False, True, False]]
