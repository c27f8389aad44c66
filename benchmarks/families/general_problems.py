"""48 families of constrained problems, drawn by seed: classics, obstacles, constraints that bind, scale."""

from __future__ import annotations

from benchmarks.families.general_problems_base import Family
from benchmarks.families.general_problems_classics import CLASSICS
from benchmarks.families.general_problems_constraints import CONSTRAINTS
from benchmarks.families.general_problems_literature import KNOWN, LITERATURE
from benchmarks.families.general_problems_obstacles import OBSTACLES
from benchmarks.families.general_problems_scale import SCALE

SETS = {1: "classics", 2: "obstacles", 3: "constraints", 4: "scale"}
FEWER = {"springs30": 2, "springs30_long": 1, "unicycle_long": 1}  # problems per seed
FAMILIES: dict[str, Family] = {
    make.__name__: Family(make.__name__, number, FEWER.get(make.__name__, 8), make, KNOWN.get(make))
    for number, makes in ((1, CLASSICS), (2, OBSTACLES), (3, (*LITERATURE, *CONSTRAINTS)), (4, SCALE))
    for make in makes
}
