"""The sizes of all measurements: the default, and a quick look."""

from __future__ import annotations

from dataclasses import dataclass

EVERY = ("forest30", "forest60", "walls", "planar_trap", "planar_random")


@dataclass(frozen=True)
class Sizes:
    """Numbers of problems, samples and stages of every section."""

    # families
    families: tuple[str, ...] = EVERY
    family_batch: int = 32
    large_batch: int | None = 256  # forests alone
    layouts: int = 32  # the first of the same layouts, flown by each peer, except:
    slow_layouts: int = 12  # where FATROP takes a second or more
    slow_families: tuple[str, ...] = ("walls", "planar_random")
    ipopt_layouts: int = 4
    ipopt_families: tuple[str, ...] = ("forest30", "planar_trap")
    # latency
    latency_layouts: int = 16
    # loop
    loop_periods: int = 400
    loop_disturbed: int = 2000
    loop_fleets: tuple[int, ...] = (8, 64, 256)
    loop_compiled: bool = True  # peers that are compiled, too
    # endless
    endless_steps: int = 3000
    endless_missions: int = 256
    # swing_up
    swing_seeds: int = 20
    # learned
    own_models: int = 6
    training_steps: int = 100
    # own_model
    own_layouts: int = 32
    # paper
    paper_layouts: int = 8
    # first_use
    models: int = 4
    # batch
    whole_batches: tuple[int, ...] = (1, 8, 64)
    limited_batches: tuple[int, ...] = (1, 16, 256, 2048)
    fewest_layouts: int = 8  # smaller batches are repeated until so many layouts are flown
    world_batch: int = 8
    # cores
    cores_batch: int = 256
    # growth, scaling
    growth_batch: int = 16
    peers_layouts: int = 4  # the first of them, flown by peers up to so many stages and obstacles:
    peers_stages: int = 500
    peers_obstacles: int = 100
    stages: tuple[int, ...] = (50, 100, 200, 500, 1000)
    obstacles: tuple[int, ...] = (10, 30, 100, 500)
    # mppi
    samples: tuple[int, ...] = (1000, 4000, 16384)
    mppi_repeats: int = 5
    # share
    share_batch: int = 32
    share_alone: int = 16  # problems that are solved one by one
    # all sections
    num_stages: int | None = None  # None: as the scenario says
    inner_iterations: int | None = None  # None: as the solver says


QUICK = Sizes(
    family_batch=4, large_batch=8, layouts=2, slow_layouts=1, ipopt_layouts=1, latency_layouts=2, loop_periods=24,
    loop_disturbed=40, loop_fleets=(8,), loop_compiled=False, endless_steps=200,
    endless_missions=4, swing_seeds=1, own_models=1, training_steps=3,
    own_layouts=4, paper_layouts=2, models=1, whole_batches=(1, 8), limited_batches=(1, 64), fewest_layouts=2,
    world_batch=2, cores_batch=16, growth_batch=8, peers_layouts=1, stages=(50, 100), obstacles=(10, 30),
    samples=(1000,), mppi_repeats=3, share_batch=8, share_alone=4,
)  # fmt: skip
