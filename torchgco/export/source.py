"""A packed problem as C: its structures, its tables, and the solver's own files in one text."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchgco.compiled.numbers import KeptCarried
from torchgco.constraints.base import ADMITTED, CONTACT_FACTOR
from torchgco.constraints.bounds import LOOSE
from torchgco.export.beginning import Beginning
from torchgco.export.carried import Carried, carried_source
from torchgco.export.numbers import ABOVE_ZERO, AT_LEAST_ZERO, BOUND, Changing, Copies, fixed_radii
from torchgco.export.single import VIOLATION, options_in_single
from torchgco.export.tables import table
from torchgco.export.writer import Writer
from torchgco.lagrangian.barrier import FILTERED
from torchgco.native import structures as c
from torchgco.native.codegen.emit import literal
from torchgco.native.declarations import defines, kept_by
from torchgco.native.includes import C
from torchgco.native.interior import Kept
from torchgco.native.packing import kind_of
from torchgco.problem.problem import Problem
from torchgco.receding.plan import KNOT_ROUNDING, STAGE_ROUNDING
from torchgco.solvers.ending import STATIONARY
from torchgco.solvers.interior import FEW, ROUGH, SADDLE_STEPS, InteriorPoint
from torchgco.solvers.timing import HELD_FIRST

HERE = Path(__file__).parent / "c"
# Files of the kernels, and what takes their places.
REPLACED = {
    "vectors.h": C / "scalar" / "vectors.h", "wide.h": C / "scalar" / "wide.h",
    "allocation.h": HERE / "arena.h", "stack.h": HERE / "stack.h", "clock.h": HERE / "seconds.h",
}  # fmt: skip
FILES = "riccati.c", "interior.c", "sweep.h", "rollout.h"  # the interior point, sweeps and rollouts
POINTERS_OF_ROWS = 11  # of the structure Rows, of a single lane
ON_STACK = 128  # numbers of one stage that a step has on the stack, at most: 1 kB
HELD = 112  # doubles of the structures Barrier and Track, at most, beside the filter
SCALARS = 16  # numbers of the structure Solve beside its arrays, and what structures are padded with


@dataclass(frozen=True)
class Solver:
    """The C of a problem's solver.

    Attributes:
        solver: what serves problems of this form.
        controller: tables and structures of this one, and the controller, with marks (see `replaced`).
        room: numbers of a workspace that only a step needs.
        multipliers: of each constraint that has rows, by its place: how many there are.
        flash: bytes of constant tables.
    """

    solver: str
    controller: str
    room: int
    multipliers: dict[int, int]
    flash: int


def solver_source(
    kept: Kept, changing: Changing, interior: InteriorPoint, begin: Beginning, number: int, receding: bool
) -> Solver:
    """The C of a packed problem.

    Args:
        begin: with what solves begin that have no plan before.
        receding: whether steps are those of a loop, in which rates count from the controls of the step before.
        number: bytes of a number, 8 or 4. The text is of doubles in any case: see `single`.
    """
    problem, how = kept.problem, kept.how
    B, multipliers = problem.B, {i: lam[0].numel() for i, lam in enumerate(kept.lam) if lam.numel() > 0}
    writer = Writer(_tensors(kept), _places(kept, changing, multipliers), B, number=number)
    made = [
        _made(kept, j, writer.tensors[address], copies, number)
        for j, (address, copies) in enumerate(changing.copied.items())
    ]
    carried = carried_source(kept, changing, writer, receding)
    K = len(problem.constraints)
    rows = [writer.body(row) for row in _constraints(kept)]
    fields = writer.body(kept.packed, constraint="b->constraints", arena="&b->arena")
    options = writer.body(how, of="&b->problem", **({} if number == 8 else _other_options(interior)))
    lines = _bound(rows, fields, options, changing, made, _rest(changing, writer, begin), begin, carried)
    count = _count(kept)
    made_numbers = sum(writer.tensors[address].numel() // B for address in changing.copied)
    numbers = count + 2 * FILTERED + _solve_numbers(problem, begin) + made_numbers
    room = structure_numbers(K) + -(-numbers * number // 8)
    texts = {name: own.read_text() for name, own in REPLACED.items()}
    declared = "static int tgco_interior(const Interior *how, int64_t first, int64_t last);\n"
    declared += "static int64_t tgco_room(const Interior *how);\n"
    parts = {
        "CONTACT": "contact.c", "MEANS": "means.c", "FREE_TIME": "free_time.c" if begin.segments else None,
        "CARRIED": "carried.c" if carried.pointers else None,
    }  # fmt: skip
    text = (HERE / "controller.c").read_text()
    for mark, file in parts.items():
        text = text.replace(f"@{mark}@\n", "" if file is None else (HERE / file).read_text())
    own = [
        _constants(interior, bool(K), number), _sizes(B, begin, count, multipliers), defines(carried.sizes),
        *writer.tables,
        *(part.tables for part in made), *begin.tables(), *carried.tables, _numbers_table(changing, B), _depths(kept),
        _structure(K, [part.declared for part in made], begin, carried),
        _assertion(count, K), lines, _checks(changing), text,
    ]  # fmt: skip
    flash = writer.flash + number * sum(m.size * B for m in changing.members) + sum(part.flash for part in made)
    flash += number * begin.count
    sizes = {"KINDS": sum(1 << kind for kind in _kinds(kept)), "ON_STACK": ON_STACK}
    solver = kept.engine.form.alone(FILES, texts, declared, **sizes)
    return Solver(solver, "\n".join(own), room, multipliers, flash)


def _constraints(kept: Kept) -> list[c.Constraint]:
    """The constraints that a packed problem points to."""
    lists = (one for one in kept.packed.kept if isinstance(one, list) and one and isinstance(one[0], c.Constraint))
    return next(lists, [])


def _kinds(kept: Kept) -> set[c.Kind]:
    """The kinds of the constraints, and of the balls of bodies."""
    parts: Sequence[Any] = kept.problem.constraints
    balls = (part.balls[0] for part in parts if kind_of(part) is c.Kind.BODY)
    return {kind_of(part) for part in (*parts, *balls)}


def _tensors(kept: Kept) -> dict[int, Tensor]:
    """What C reads and writes, by address."""
    carried = [kept.carried] if isinstance(kept, KeptCarried) else []
    return {**kept_by(kept.how), **{tensor.data_ptr(): tensor for tensor in carried}}


def _count(kept: Kept) -> int:
    """How many numbers a solve needs room for beside those of its problem."""
    function = kept.library.tgco_room
    function.restype = ctypes.c_int64
    alone = kept.packed.fill({"arena": 1}, copied=True)
    return int(function(ctypes.byref(kept.how.fill({"of": alone}, copied=True))))


def structure_numbers(K: int) -> int:
    """The size of all structures of a step without arrays of numbers, in doubles, at most."""
    size = lambda kind: -(-ctypes.sizeof(kind) // 8)
    own = size(c.Interior) + 2 * size(c.Problem) + max(1, K) * size(c.Constraint)
    return own + (K + 1) * (POINTERS_OF_ROWS + 2) + HELD + SCALARS


def _solve_numbers(problem: Problem, begin: Beginning) -> int:
    """How many numbers the arrays of the structure Solve have, but for those that are made."""
    N, n, m = problem.N, problem.n, problem.m
    stage, free = (n + m) * (n + m) + (n + m) * n + n * n, begin.segments + n if begin.segments else 0
    return (stage if stage > ON_STACK else 0) + N * m * (n + 1) + free


def firsts(multipliers: dict[int, int]) -> dict[int, int]:
    """Where the multipliers of constraints begin, by their places: those of one come after those of the one before."""
    counts = list(multipliers.values())
    return {i: sum(counts[:j]) for j, i in enumerate(multipliers)}


def _places(kept: Kept, changing: Changing, multipliers: dict[int, int]) -> dict[int, str]:
    """Where what C reads and writes lies, by address."""
    at = lambda tensor: tensor.data_ptr()
    places = {at(kept.lam[i]): f"w->lam + {first}" for i, first in firsts(multipliers).items()}
    places |= {address: f"numbers + {first}" for address, first in changing.shared.items()}
    places |= {address: f"b->made_{j}" for j, address in enumerate(changing.copied)}
    scalars = {"mu": kept.barrier, "status": kept.status, "iterations": kept.iterations}
    places |= {at(tensor): f"&b->{name}" for name, tensor in scalars.items()}
    places |= {int(getattr(kept.how, name)): f"&b->{name}" for name in ("error", "theta", "falls")}
    return places | {at(kept.X): "w->x", at(kept.U): "w->u", at(kept.gains): "b->gains"}


@dataclass(frozen=True)
class Made:
    """An array that follows from numbers: constant tables, its member of the structure, and lines that fill it."""

    tables: str
    declared: str
    lines: list[str]
    flash: int


def _made(kept: Kept, j: int, base: Tensor, copies: Copies, number: int) -> Made:
    B = kept.problem.B
    size = base.numel() // B
    tables = [table(f"static const double base_{j}[]", base)]
    places = {"source": copies.source} | ({} if copies.squares else {"to": copies.to})
    tables += [table(f"static const int32_t {name}_{j}[]", map(int, values)) for name, values in places.items()]
    lines = [f"    memcpy(b->made_{j}, base_{j} + element * {size}, sizeof b->made_{j});"]
    if copies.squares:
        tables += [table(f"static const double fixed_{j}[]", fixed_radii(kept, base.data_ptr()))]
        at = f"fixed_{j}[element * {size + 1} + "
        fixed = f"{at}i], {at}{size}]"
        lines.append(f"    for (int i = 0; i < {size}; i++)")
        lines.append(f"        fill_square(b->made_{j} + i, numbers, exported, source_{j} + 2 * i, {fixed});")
    else:
        to = f"b->made_{j}[to_{j}[i]]"
        lines.append(f"    for (int i = 0; i < {len(copies.to)}; i++) {to} = numbers[source_{j}[i]];")
        if copies.bounds:
            lines.append(f"    for (int i = 0; i < {size}; i++) b->made_{j}[i] = limited(b->made_{j}[i]);")
    flash = number * base.numel() + 4 * (len(copies.to) + len(copies.source))
    return Made("\n".join(tables), f"    double made_{j}[{size}];", lines, flash)


def _rest(changing: Changing, writer: Writer, begin: Beginning) -> str:
    """Where the controls lie with which a solve without a guess begins: the cost's reference, where it may change."""
    rest, u_ref = begin.rest, next((m for m in changing.members if m.full == "cost.u_ref"), None)
    if u_ref is not None and u_ref.values.size == rest.numel() and bool((torch.from_numpy(u_ref.values) == rest).all()):
        return f"numbers + {u_ref.first}"
    return f"{writer.table(rest)} + element * {rest[0].numel()}"


def _bound(
    rows: list[str], problem: str, how: str, changing: Changing, made: list[Made], rest: str, begin: Beginning,
    carried: Carried,
) -> str:  # fmt: skip
    """The function `bind`, which fills the structures that the solver reads."""
    lines = [
        UNKNOWN,
        SQUARES if any(copies.squares for copies in changing.copied.values()) else "",
        LIMITED if any(copies.bounds for copies in changing.copied.values()) else "",
        "static void bind(NAME_workspace *w, Solve *b) {",
        "    const double *numbers = (const double *)(const void *)&w->numbers;",
        "    const int element = unknown(ELEMENT(w));",
        "    const double *exported = (const double *)(const void *)(exported_numbers + element);",
        "    (void)numbers; (void)exported; (void)element;",
        "    memset(b, 0, sizeof *b);",
        *(line for part in made for line in part.lines),
        *(f"    b->constraints[{i}] = (Constraint){row};" for i, row in enumerate(rows)),
        f"    b->problem = (Problem){problem};",
        f"    b->how = (Interior){how};",
        "    b->follow = b->problem;",
        "    b->follow.gains = b->gains;",
        f"    b->rest = {rest};",
        "    b->contact_depth = contact_depth + element * " + str(max(1, len(rows))) + ";",
        "    b->most = MAX_SOLVE_ITERATIONS;",
        *(FREE_TIME if begin.segments else []),
        *(f"    b->{name} = {place};" for name, place in carried.pointers.items()),
        "    b->arena_begin = (unsigned char *)(b + 1);",
        "    b->arena.next = b->arena_begin;",
        "    b->arena_end = (unsigned char *)w->room + sizeof w->room;",
        "    b->X = (double *)(void *)b->arena_end - ((N + 1) * NX + 2 * N * NU);",
        "    b->U = b->X + (N + 1) * NX; b->beside = b->U + N * NU;",
        "    b->arena.end = (unsigned char *)b->X;",
        "    b->arena.seconds = w->clock;",
        "}",
    ]
    return "\n".join(line for line in lines if line)


FREE_TIME = (
    "    b->first_factor = first_factor + element * SEGMENTS;",
    "    memcpy(b->free_start, b->how.free_start, sizeof b->free_start);",
    "    b->how.free_start = b->free_start; /* that of the time may be held */",
)
UNKNOWN = """
/* A value that no compiler knows: gcc 12.2 with AVX-512 copies small constant arrays {5, 5, 0, 0} as {5, 5, 5, 5}. */
static int unknown(int value) {
    volatile int kept = value;
    return kept;
}
"""
SQUARES = """
/* The square of a radius and the vehicle's, of which one may change; what was exported stays to the last bit. */
static void fill_square(double *square, const double *numbers, const double *exported, const int32_t *source,
    double radius, double vehicle) {
    double r = source[0] < 0 ? radius : numbers[source[0]], v = source[1] < 0 ? vehicle : numbers[source[1]];
    int same = (source[0] < 0 || r == exported[source[0]]) && (source[1] < 0 || v == exported[source[1]]);
    if (!same) *square = (r + v) * (r + v);
}
"""
LIMITED = """
static double limited(double bound) { return bound > LOOSE ? LOOSE : bound < -LOOSE ? -LOOSE : bound; }
"""


def _other_options(interior: InteriorPoint) -> dict[str, str]:
    """Options that differ in single precision, as C."""
    options = interior.options(warm=True)
    pairs = zip(vars(options).items(), vars(options_in_single(options)).values(), strict=True)
    return {name: literal(new) if isinstance(new, float) else str(new) for (name, old), new in pairs if new != old}


def _constants(interior: InteriorPoint, constrained: bool, number: int) -> str:
    violation = interior.violation_tolerance if number == 8 else max(interior.violation_tolerance, VIOLATION)
    values: dict[str, Any] = {
        "WARM_MU": interior.warm_barrier, "WARM_PUSH": interior.warm_barrier, "COLD_MU": interior.initial_barrier,
        "COLD_PUSH": interior.bound_push, "VIOLATION": violation, "ADMITTED": ADMITTED,
        "LAST_BIT": 2.0**-52 if number == 8 else 2.0**-23,
        "MAX_SOLVE_ITERATIONS": interior.max_iterations, "LOOSE": LOOSE, "CONTACT": CONTACT_FACTOR,
        "STATIONARY": STATIONARY, "CONSTRAINED": int(constrained), "STAGE_ROUNDING": STAGE_ROUNDING,
        "SADDLE_FIRST": SADDLE_STEPS[0], "SADDLE_LAST": SADDLE_STEPS[1],
        "AT_LEAST_ZERO": AT_LEAST_ZERO, "ABOVE_ZERO": ABOVE_ZERO, "BOUND": BOUND,
    }  # fmt: skip
    return defines(values)


def _sizes(B: int, begin: Beginning, count: int, multipliers: dict[int, int]) -> str:
    """What the controller knows of the problem beside the solver's own sizes."""
    of_many = {"ELEMENT(w)": f"((unsigned)(w)->element < {B}u ? (w)->element : 0)"}
    of_many["HAS_ELEMENT(w)"] = f"((unsigned)(w)->element < {B}u)"
    words = of_many if B > 1 else {"ELEMENT(w)": 0, "HAS_ELEMENT(w)": 1}
    values: dict[str, Any] = {"SEGMENTS": begin.segments, "HAS_PLAN": int(begin.plan is not None)}
    if begin.segments:
        values |= {
            "STAGE": begin.stage,
            "USER_CONSTRAINTS": begin.constraints,
            "KNOT_ROUNDING": KNOT_ROUNDING,
            "LONGER": HELD_FIRST,
            "FEW": FEW,
            "ROUGH": ROUGH,
        }
        values |= {"ROOM_NUMBERS": count, "MOST_MULTIPLIERS": max(multipliers.values())}
    return defines(words | values) + "enum { N = NAME_N, USER_NX = NAME_NX, USER_NU = NAME_NU };"


def _numbers_table(changing: Changing, B: int) -> str:
    inner = [
        "".join(
            f"    .{member.name} = {{{', '.join(literal(value) for value in member.values[b].ravel().tolist())}}},\n"
            for member in changing.members
        )
        for b in range(B)
    ]
    rows = ",\n".join(f"{{\n{row or '    0'}\n}}" for row in inner)
    return f"static const NAME_numbers exported_numbers[] = {{{rows}}};"


def _depths(kept: Kept) -> str:
    """How deep beneath the full surface bodies touch, m, of each element and constraint."""
    B, depths = kept.problem.B, [torch.zeros(kept.problem.B, 1, dtype=torch.float64)]
    for part in kept.problem.constraints:
        own = getattr(part, "contact_depths", None) if part.geometric else None
        least = None if own is None or own.numel() == 0 else own.flatten(1).amin(1).double()
        depths.append(torch.zeros_like(depths[0]) if least is None else least.expand(B).unsqueeze(1))
    every = torch.cat(depths[1:] or depths, dim=1)
    return table("static const double contact_depth[]", every)


def _structure(K: int, made: list[str], begin: Beginning, carried: Carried) -> str:
    return "\n".join(
        [
            "/* What a step works with, at the beginning of a workspace's room. */",
            "typedef struct {",
            "    Arena arena;",
            "    unsigned char *arena_begin, *arena_end;",
            "    Interior how;",
            "    Problem problem, follow; /* follow: of rollouts, and of what they are worth */",
            f"    Constraint constraints[{max(1, K)}];",
            "    const double *rest; /* (N, NU) */",
            "    const double *contact_depth; /* of each constraint */",
            *(["    const double *first_factor; /* (SEGMENTS) */"] if begin.segments else []),
            *(f"    const double *{name};" for name in carried.pointers),
            *(["    double factor[SEGMENTS]; /* with which a solve from rest begins */"] if begin.segments else []),
            *(["    double free_start[NX];"] if begin.segments else []),
            "    double mu, error, theta, falls, cost;",
            "    int64_t iterations;",
            "    int32_t status, most; /* most: iterations of a solve */",
            "    double *X, *U, *beside; /* as x and u: the end of the room, while nothing is solved */",
            "    double gains[N * NU * NZ];",
            *made,
            "} Solve;",
        ]
    )


def _assertion(count: int, K: int) -> str:
    need = f"{count} * sizeof(V) + {K + 1} * (sizeof(Rows) + 2 * sizeof(int64_t)) + sizeof(Barrier) + sizeof(Track)"
    return f"typedef char NAME_has_room[sizeof(Solve) + {need} <= sizeof(((NAME_workspace *)0)->room) ? 1 : -1];"


def _checks(changing: Changing) -> str:
    """What is checked of the numbers."""
    spans = [f"{{{m.first}, {m.size}, {m.kind}}}" for m in changing.members] or ["{0, 0, 0}"]
    steady = [f"{{{m.first}, {m.steady}}}" for m in changing.members if m.steady] or ["{0, 0}"]
    return "\n".join(
        [
            "/* Of numbers the first, how many, and whether they are finite, at least 0, above 0, or bounds. */",
            f"static const struct {{ int first, count, kind; }} checks[] = {{{', '.join(spans)}}};",
            "/* Those of a free time that are the same at all stages: the first, and how many a stage has. */",
            f"static const struct {{ int first, width; }} steady[] = {{{', '.join(steady)}}};\n",
        ]
    )


def replaced(text: str, name: str, **parts: str) -> str:
    """A text with its marks @PART@ and the word NAME replaced."""
    for part, value in parts.items():
        text = text.replace(f"@{part}@", value)
    return re.sub(r"\bNAME(?=_|\b)", name, text)
