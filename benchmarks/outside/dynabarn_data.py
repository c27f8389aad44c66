"""python -m benchmarks.outside.dynabarn_data CLONE: the 60 worlds of the BARN challenge in which cylinders move.

Reads a local clone of github.com/Daffan/the-barn-challenge (MIT, Copyright (c) 2022 Zifan Xu) and writes
benchmarks/data/dynabarn.npz. A world lists its cylinders; how each moves stands only in a compiled plugin of the
simulator, as constants that it hands to its animation. They are read from its disassembly (binutils' objdump), nothing
of it is run.
"""

from __future__ import annotations

import re
import struct
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.lib import DATA
from benchmarks.lib.command import parser_of

WORLDS = range(60)  # 300 to 359 of the challenge
RADIUS = 0.5  # of the cylinders, m: the worlds' only size
LISTED = re.compile(r"<plugin name='\w+' filename='(\w+\.so)'/>")
SIZES = re.compile(r"<radius>(.*?)</radius>")
LOADS = re.compile(r"^\w+ <gazebo::\w+::Load\(.*?\n\n", re.MULTILINE | re.DOTALL)
SECTION = re.compile(r"\.rodata\s+(\w+)\s+(\w+)\s+\w+\s+(\w+)")
INSTRUCTION = re.compile(r"\s+\w+:\s+(\w+)\s*(.*)")
CONSTANT = re.compile(r"(xmm0|rax),QWORD PTR \[rip[+-]0x\w+\]\s+# (\w+)")
STORED = re.compile(r"QWORD PTR \[(rbp-0x\w+)\],(xmm0|rax)")
READ = re.compile(r"(xmm0|rax),QWORD PTR \[(rbp-0x\w+)\]")
ADDRESS = re.compile(r"(\w+),\[(rbp-0x\w+)\]")


def listed(world: str) -> list[str]:
    """The plugins of a world's cylinders, one each.

    Raises:
        ValueError: other radii than the challenge's, or a plugin for more than one cylinder.
    """
    names, radii = LISTED.findall(world), {float(size) for size in SIZES.findall(world)}
    if radii != {RADIUS} or len(SIZES.findall(world)) != 2 * len(names):
        raise ValueError(f"expected a plugin for each cylinder of radius {RADIUS}, got {names} and radii {radii}")
    return names


def motion(plugin: Path) -> tuple[float, np.ndarray]:
    """Seconds after which a cylinder begins again, and rows (K, 3) of time, s, and place, m, between which it moves.

    Raises:
        ValueError: numbers that don't come from constants, or rows that don't go from 0 to the last second.
    """
    data = plugin.read_bytes()
    size, address, offset = (int(number, 16) for number in _found(SECTION, objdump("-h", plugin)).groups())

    def constant(at: int) -> float:
        if not address <= at <= address + size - 8:
            return float("nan")
        return struct.unpack_from("<d", data, at - address + offset)[0]

    text = objdump("-d", "-M", "intel", "--no-show-raw-insn", "-C", plugin)
    length, rows = followed(_found(LOADS, text).group(), constant)
    t = rows[:, 0]
    if not np.isfinite(rows).all() or t[0] != 0.0 or (np.diff(t) <= 0).any() or abs(t[-1] - length) > 0.01:
        raise ValueError(f"{plugin.name}: expected finite rows from 0 to {length} s, got {rows.tolist()}")
    return length, rows


def objdump(*words: str | Path) -> str:
    return subprocess.run(["objdump", *words], capture_output=True, text=True, check=True).stdout


def _found(pattern: re.Pattern[str], text: str) -> re.Match[str]:
    match = pattern.search(text)
    if match is None:
        raise ValueError(f"expected {pattern.pattern!r} in the disassembly, got none")
    return match


def followed(function: str, constant: Callable[[int], float]) -> tuple[float, np.ndarray]:
    """What a function without branches hands to its animation: the length, and rows of time and place (K, 3).

    Only what an unoptimised compiler writes for these calls is followed: a register is set from a constant, 0, a
    variable of the stack, or the address of one.
    """
    numbers: dict[str, float] = {}
    addresses: dict[str, str] = {}
    length, rows = float("nan"), list[list[float]]()
    for name, words in (match.groups() for match in map(INSTRUCTION.match, function.splitlines()) if match):
        if name == "pxor" and words.startswith("xmm0,xmm0"):
            numbers["xmm0"] = 0.0
        elif name == "lea" and (match := ADDRESS.match(words)):
            addresses[match[1]] = match[2]
        elif name in ("mov", "movsd"):
            if match := CONSTANT.match(words):
                numbers[match[1]] = constant(int(match[2], 16))
            elif (match := STORED.match(words)) or (match := READ.match(words)):
                target, source = (match[1], match[2])
                numbers[target] = numbers.get(source, float("nan"))
        elif "PoseAnimation::PoseAnimation(" in words:
            length = numbers["xmm0"]
        elif "PoseAnimation::CreateKeyFrame(" in words:
            rows.append([numbers["xmm0"]])
        elif "Vector3<double>::Vector3(double const&" in words:
            rows[-1] += [numbers[addresses[register]] for register in ("rsi", "rdx")]
    return length, np.array(rows)


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("clone", type=Path, help="folder of the repository Daffan/the-barn-challenge")
    helper = parser.parse_args(words).clone / "jackal_helper"
    texts = [(helper / "worlds" / "DynaBARN" / f"world_{number}.world").read_text() for number in WORLDS]
    worlds = [listed(text) for text in texts]
    names = sorted({name for world in worlds for name in world})
    motions = [motion(helper / "plugins" / name)[1] for name in names]
    rows = np.full((len(names), max(map(len, motions)), 3), np.nan)
    cylinders = np.full((len(worlds), max(map(len, worlds))), -1)
    for row, known in zip(rows, motions, strict=True):
        row[: len(known)] = known
    for row, world in zip(cylinders, worlds, strict=True):
        row[: len(world)] = [names.index(name) for name in world]
    np.savez_compressed(DATA / "dynabarn.npz", rows=rows, cylinders=cylinders)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
