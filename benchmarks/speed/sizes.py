"""How much is measured: the default, a quick look, and whatever a test asks for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sizes:
    """Numbers of problems, samples and stages of every section."""

    # families
    families: tuple[str, ...] = ("forest30", "forest60", "planar_trap", "planar_random")
    family_batches: tuple[int, ...] = (32, 256)
    fatrop_layouts: int = 16  # the first of the same layouts
    ipopt_layouts: int = 4
    # batch
    whole_batches: tuple[int, ...] = (1, 4, 16, 64)
    limited_batches: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096)
    fewest_layouts: int = 8  # batches smaller than this fly several times, until so many layouts are flown
    # growth
    growth_batch: int = 16
    stages: tuple[int, ...] = (50, 100, 200, 500, 1000)
    obstacles: tuple[int, ...] = (10, 30, 100, 500)
    # mppi
    samples: tuple[int, ...] = (1000, 4000, 16384)
    mppi_repeats: int = 5
    # latency
    latency_layouts: int = 5
    # share
    share_batch: int = 64
    # all sections
    num_stages: int | None = None  # None: as the scenario says
    inner_iterations: int | None = None  # None: as the solver says


QUICK = Sizes(
    families=("forest30", "planar_trap"), family_batches=(8, 32), fatrop_layouts=8, ipopt_layouts=2,
    whole_batches=(1, 8), limited_batches=(1, 8, 64, 256), fewest_layouts=2,
    growth_batch=8, stages=(50, 100, 200), obstacles=(10, 30, 100),
    samples=(1000, 4000), mppi_repeats=3, latency_layouts=2, share_batch=16,
)  # fmt: skip
