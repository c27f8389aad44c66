"""The five families: where their layouts are, and how new ones are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

DATA = Path(__file__).resolve().parent / "data"


@dataclass(frozen=True)
class Family:
    """A family of layouts: 32 in a file, and as many as are wanted from its generator."""

    name: str
    model: str
    drawn: tuple[str, ...]  # overrides of the generator

    def file(self, fresh: int = 0, seed: int = 0) -> Path:
        """Where the public layouts are, or the first drawn ones of a seed, with the best costs known."""
        return DATA / (f"drawn/{self.name}-seed{seed}.npz" if fresh else f"{self.name}.npz")

    def overrides(self, fresh: int = 0, seed: int = 0) -> list[str]:
        """Overrides for `torchgco`: the file's layouts, or `fresh` new ones of a seed."""
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
