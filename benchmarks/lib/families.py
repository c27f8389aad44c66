"""Families of layouts: their files, and the overrides that draw new ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from benchmarks.lib import DATA


@dataclass(frozen=True)
class Family:
    """A family of layouts: 32 in a file, and any number from its generator."""

    name: str
    model: str
    drawn: tuple[str, ...]  # overrides of the generator
    folder: str = ""  # below data

    def file(self, fresh: int = 0, seed: int = 0) -> Path:
        """The file of the public layouts, or of the first layouts drawn under a seed, with the best known costs."""
        return DATA / "drawn" / f"{self.name}-seed{seed}.npz" if fresh else DATA / self.folder / f"{self.name}.npz"

    @property
    def generated(self) -> list[str]:
        """Overrides that compose the model and the generator."""
        return [*self.drawn, f"model={self.model}"]

    def overrides(self, fresh: int = 0, seed: int = 0) -> list[str]:
        """Overrides for `torchgco`: the file's layouts, or `fresh` new layouts drawn under a seed."""
        if fresh == 0:
            source = ["scenario=layouts", f"scenario.path={self.file()}"]
        else:
            source = [*self.drawn, f"study.layouts={fresh}"]
        return [*source, f"model={self.model}", f"seed={seed}"]


FAMILIES = {
    family.name: family
    for family in (
        Family("forest30", "quadrotor", ("scenario=forest",)),
        Family("forest60", "quadrotor", ("scenario=forest", "scenario.num_obstacles=60")),
        Family("walls", "quadrotor", ("scenario=walls",)),
        Family("planar_trap", "planar", ("scenario=planar_trap",)),
        Family("planar_random", "planar", ("scenario=planar_random",)),
    )
}

# Worlds: woods by trunks per 100 m^2, mazes by walls, crossing spheres by their number.
WORLDS = {
    family.name: family
    for family in (
        *(
            Family(f"woods{d}", "quadrotor", ("scenario=woods", f"scenario.density={d / 100:g}"), "worlds")
            for d in (20, 40, 60)
        ),
        *(Family(f"mazes{w}", "quadrotor", ("scenario=mazes", f"scenario.walls={w}"), "worlds") for w in (2, 3, 4)),
        *(
            Family(f"crossing{m}", "quadrotor", ("scenario=crossing", f"scenario.num_obstacles={m}"), "worlds")
            for m in (10, 30)
        ),
    )
}
EVERY = FAMILIES | WORLDS
