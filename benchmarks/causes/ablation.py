"""python -m benchmarks.causes.ablation: what each constant, option and row of `gco` changes on drawn layouts.

One at a time is doubled (None, or the other value, where that is all there is) or left out, and drawn layouts of eleven
families are flown, until one family notices: until a layout has other controls. Where doubling changes nothing, it is
halved, too. What changes nothing on all layouts, these families don't need. Rows fly all families; with --all, so does
everything. Success counts against the best cost over all variants. Flights lie below outputs/ablation: a run that was
stopped resumes.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from benchmarks.lib import ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import EVERY, Family
from benchmarks.lib.page import markdown
from torchgco import compose, judge, presets
from torchgco.base.errors import InputError
from torchgco.judging.judge import near_best
from torchgco.scenarios.vehicle import Task
from torchgco.search import Passes

ROOMS = ("search", "guidance", "solvers", "lagrangian", "roadmap")
# Not changed: sizes of batches and what memory holds, codes, random keys, and what only PyTorch's kernels read.
SPARED = (
    "memory", "_AT_ONCE", "CHUNK", "PAIRS", "CLASS", "PARALLEL", "SIDE_BY_SIDE", "STOPPED", "STALLED", "STREAM",
    "SEED_STEP", "TRIAL_SAMPLES", "record", "slots", "as_printed",
)  # fmt: skip
NAMES = (
    "planar_trap", "mazes2", "walls", "forest60", "mazes3", "planar_random", "woods20", "forest30", "crossing10",
    "woods40",
)  # fmt: skip
MOVING = Family("forest_moving", "quadrotor", ("scenario=forest_moving",))  # where no path can be sought
FAMILIES = [*(EVERY[name] for name in NAMES), MOVING]
LAYOUTS, SEED, LIMIT = 8, 401, 600  # per family; and seconds of a variant
HEAD = ("what", "value", "change", "layouts", "other controls", "reached", "success", "within 1 %", "iterations")
Variant = tuple[str, str, str]  # kind, name, change


def changed(value: Any, change: str) -> Any:
    """A number, or all numbers of a tuple or table, after a change."""
    if change == "none":
        return not value if isinstance(value, bool) else None
    if isinstance(value, tuple):
        return tuple(changed(one, change) for one in value)
    if isinstance(value, dict):
        return {key: changed(one, change) for key, one in value.items()}
    if change == "nearer to 1":
        return 0.5 * (1.0 + value)
    return 2 * value if change == "doubled" else value // 2 if isinstance(value, int) else value / 2


def is_number(value: Any) -> bool:
    """Whether `changed` can double a value."""
    if isinstance(value, tuple | dict):
        return bool(value) and all(map(is_number, value.values() if isinstance(value, dict) else value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def constants() -> Iterator[tuple[str, Any]]:
    """The numbers that modules and classes of the rooms name in capitals, or as ClassVar, by their full name."""
    folder = ROOT / "torchgco"
    for path in sorted(path for room in ROOMS for path in (folder / room).glob("*.py")):
        module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Assign) and node.col_offset == 0:
                names = [one.id for target in node.targets for one in ast.walk(target) if isinstance(one, ast.Name)]
                yield from ((f"{module.__name__}.{name}", getattr(module, name)) for name in names if name.isupper())
            elif isinstance(node, ast.ClassDef):
                held = [one for one in node.body if isinstance(one, ast.AnnAssign) and "ClassVar" in ast.unparse(one)]
                for name in (ast.unparse(one.target) for one in held):
                    owner = f"{module.__name__}.{node.name}"
                    yield f"{owner}.{name}", getattr(getattr(module, node.name), name)


def with_constant(name: str, change: str) -> None:
    """Change a constant in its module, and in those that have imported it."""
    *path, last = name.removeprefix("torchgco.").split(".")
    owner = import_module("torchgco." + ".".join(path[:2]))
    owner = getattr(owner, path[2]) if len(path) > 2 else owner
    old = getattr(owner, last)
    for place in (owner, *(module for key, module in sys.modules.items() if key.startswith("torchgco."))):
        if vars(place).get(last) is old:
            setattr(place, last, changed(old, change))


def options(node: Any) -> Iterator[tuple[str, Any]]:
    """The options of a solver and of what it holds, by class and field."""
    for field in fields(node) if is_dataclass(node) else ():
        value = getattr(node, field.name)
        for part in value if isinstance(value, tuple) else (value,):
            yield from options(part)
        if not any(map(is_dataclass, value if isinstance(value, tuple) else (value,))):
            yield f"{type(node).__name__}.{field.name}", value


def with_option(node: Any, name: str, change: str) -> Any:
    """The solver with an option changed wherever it stands and admits the change."""
    if isinstance(node, Passes):
        return Passes({key: with_option(row, name, change) for key, row in node.items()})
    if isinstance(node, tuple):
        return tuple(with_option(part, name, change) for part in node)
    if not is_dataclass(node):
        return node
    for field in fields(node):
        value = getattr(node, field.name)
        if f"{type(node).__name__}.{field.name}" != name:
            node = replace(node, **{field.name: with_option(value, name, change)})
        elif change == "none" or is_number(value):
            for one in (change, "nearer to 1") if change == "doubled" else (change,):
                try:
                    node = replace(node, **{field.name: changed(value, one)})
                    break
                except InputError:
                    continue
    return node


def variants() -> dict[Variant, str]:
    """All variants, with the value before the change."""
    found: dict[Variant, str] = {("", "default", ""): ""}
    solvers: dict[int, Any] = {2: presets.gco(2), 3: presets.gco(3)}
    for name in solvers[3].passes.names:
        found["row", name, "left out"] = ""
    for solver in solvers.values():
        for name, value in options(solver):
            for change in ("doubled", "halved") if is_number(value) else ("none",):
                if with_option(solver, name, change) != solver:
                    held = found.get(("option", name, change))
                    known = [] if held is None else held.split(" / ")
                    found["option", name, change] = " / ".join(dict.fromkeys([*known, str(value)]))
    for name, value in constants():
        if is_number(value):
            found |= {("constant", name, change): str(value) for change in ("doubled", "halved")}
    return {key: value for key, value in found.items() if not any(word in key[1] for word in SPARED)}


def solver_of(dimension: int, variant: Variant) -> Any:
    """`gco` in the plane or in space, with an option or a row changed."""
    solver, (kind, name, change) = presets.gco(dimension), variant
    if kind == "option":
        return with_option(solver, name, change)
    if kind == "row":
        return replace(solver, passes=solver.passes.changed(**{name: None}))
    return solver


def fly(variant: Variant, tasks: dict[Family, Task], file: Path, every: bool) -> None:
    """Fly with one change, until a family notices, and write the flights."""
    if variant[0] == "constant":
        with_constant(*variant[1:])
    default = file.with_name("default.json")
    known = json.loads(default.read_text()) if default.exists() else []
    rows: list[dict[str, Any]] = []
    for family, task in tasks.items():
        solver = solver_of(2 if family.model == "planar" else 3, variant)
        end = solver.solve(task.problem, task.U0, seed=0, ids=torch.arange(LAYOUTS))
        seen = judge(task.problem, end.U, task.goal, task.goal_radius)
        for i in range(LAYOUTS):
            rows.append({
                "layout": f"{family.name}-{i}", "controls": hashlib.sha256(end.U[i].numpy().tobytes()).hexdigest(),
                "reached": bool(seen.reached[i]), "sound": bool(seen.sound[i]), "cost": float(seen.cost[i]),
                "iterations": int(end.iterations[i]),
            })  # fmt: skip
        if known and not every and variant[0] != "row" and noticed(rows, known):
            break
    file.write_text(json.dumps(rows))


def noticed(rows: list[dict[str, Any]], known: list[dict[str, Any]]) -> bool:
    """Whether flights have other controls than those known."""
    normal = {one["layout"]: one["controls"] for one in known}
    return any(one["controls"] != normal[one["layout"]] for one in rows)


def flights(variant: Variant, tasks: dict[Family, Task], folder: Path, every: bool) -> list[dict[str, Any]]:
    """The flights of a variant, from the file of an earlier run or from a process of its own; none where it failed."""
    file = folder / f"{' '.join(variant).strip().replace(' ', '_')}.json"
    if not file.exists():
        process = get_context("fork").Process(target=fly, args=(variant, tasks, file, every))
        process.start()
        process.join(LIMIT)
        process.kill()
    return json.loads(file.read_text()) if file.exists() else []


def table(flown: dict[Variant, list[dict[str, Any]]], values: dict[Variant, str]) -> str:
    """Markdown: a row per variant, the default's numbers on the same layouts in brackets."""
    frames = {key: pd.DataFrame(rows).set_index("layout") for key, rows in flown.items() if rows}
    normal = frames["", "default", ""]
    best = pd.concat([one["cost"].where(one["sound"]) for one in frames.values()], axis=1).min(axis=1)
    lines = []
    for key in flown:
        cells: list[Any] = ["-"] * 6
        if key in frames:
            one = frames[key]
            old, least = normal.loc[one.index], best[one.index]
            counts = [
                [int(part["reached"].sum()), int((part["sound"] & near_best(part["cost"], least)).sum()),
                 int((part["sound"] & (part["cost"] - least <= 0.01 * least.abs())).sum())]
                for part in (one, old)
            ]  # fmt: skip
            cells = [len(one), int((one["controls"] != old["controls"]).sum())]
            cells += [f"{new} ({was})" for new, was in zip(*counts, strict=True)]
            cells.append(f"{one['iterations'].sum() / old['iterations'].sum():.3f}")
        lines.append([key[1].removeprefix("torchgco."), values[key], key[2], *cells])
    return markdown(HEAD, lines)


def drawn() -> dict[Family, Task]:
    """The layouts as problems."""
    tasks = {}
    for family in FAMILIES:
        setup = compose([*family.overrides(LAYOUTS, SEED), "solver=hold", "device.threads=1"])
        tasks[family] = setup.task(setup.layouts(LAYOUTS))
    return tasks


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--folder", type=Path, default=ROOT / "outputs" / "ablation")
    parser.add_argument("--all", action="store_true", help="fly every family with every change")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    asked.folder.mkdir(parents=True, exist_ok=True)
    values, tasks = variants(), drawn()
    done: dict[Variant, list[dict[str, Any]]] = {}
    for number, key in enumerate(values, start=1):
        doubled = done.get((*key[:2], "doubled"), [])
        if key[2] != "halved" or not noticed(doubled, done["", "default", ""]):
            done[key] = flights(key, tasks, asked.folder, asked.all)
            print(number, "of", len(values), *key, len(done[key]), file=sys.stderr, flush=True)
    print(table(done, values))
    return 0


if __name__ == "__main__":
    sys.exit(main())
