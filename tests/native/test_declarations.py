"""What Python and C share has one declaration: changed in Python, it changes what C does, or C's library is refused."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import IntEnum
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.engines import engine_of
from tests.native.test_engine import running_state
from tests.problems import boxed_batch, planar_batch
from tests.reference.graph_search import searched_by_torch
from tests.slow import mostly
from torchgco import ILQR, MPPI, LineSearch, Problem, kernels
from torchgco.base.draws import DrawKey
from torchgco.base.status import Status
from torchgco.exploration.sensing.library import C_FOLDER as SENSING
from torchgco.guidance import mppi
from torchgco.ilqr import step as iteration
from torchgco.ilqr.step import iterate, lifted_search
from torchgco.kernels import kernels_of
from torchgco.kernels.in_c import native_options
from torchgco.lagrangian.lagrangian import State
from torchgco.native import structures
from torchgco.native.codegen.source import INTERIOR, LANES, SAMPLER, SOLVER_LIBRARY
from torchgco.native.compiler import NativeError, build, find_compiler
from torchgco.native.declarations import Header, Structure, defines, enumerations
from torchgco.native.includes import C, included, joined
from torchgco.native.structures import CONSTANTS, End, Options
from torchgco.roadmap import cheapest as roadmap
from torchgco.roadmap import native_maps
from torchgco.roadmap.geometry import scene_of
from torchgco.roadmap.roadmap import Roadmap

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture(autouse=True)
def native_again() -> Iterator[None]:
    yield
    kernels.use_native(True)


PAIR = """
typedef struct {
    int32_t count; /* of the others; not double first; */
    double first, bounds[TWO];
    const double *others;
} Pair;
"""


def pair_of(text: str) -> tuple[Header, type[Structure]]:
    class Pair(Structure):
        """Numbers and where others lie."""

    header = Header(text, {"TWO": 2})
    header.declare(Pair)
    return header, Pair


SUM = """
double tgco_sum(const Pair *pair) {
    double sum = pair->first + pair->bounds[1];
    for (int i = 0; i < pair->count; i++) sum += FACTOR * pair->others[i];
    return sum;
}
"""


def test_a_structure_of_another_size_is_refused() -> None:
    (header, Pair), source = pair_of(PAIR), "#include <stdint.h>\n" + defines({"TWO": 2, "FACTOR": 3.0}) + PAIR + SUM
    library = build(source + header.layout)
    library.tgco_sum.restype = ctypes.c_double
    others, bounds = torch.tensor([1.0, 2.0], dtype=torch.float64), (ctypes.c_double * 2)(5.0, 7.0)
    assert library.tgco_sum(ctypes.byref(Pair(count=2, first=0.5, others=others, bounds=bounds))) == 16.5
    longer, _ = pair_of(PAIR.replace("} Pair", "    int32_t one_more;\n} Pair"))
    with pytest.raises(NativeError, match="Pair has another size in Python"):
        build(source + longer.layout)


@pytest.mark.parametrize(
    ("folder", "name", "header"),
    [(C, "structures.h", structures.HEADER), (roadmap.C, "cheapest.h", roadmap.SEARCH_HEADER),
     (roadmap.C, "lattice.h", native_maps.LATTICE_HEADER)],
)  # fmt: skip
def test_each_field_lies_where_python_writes_it(folder: Path, name: str, header: Header) -> None:
    fields = [(kind, field) for kind in header.made.values() for field in kind.declared]
    places = ", ".join(f"offsetof({kind.__name__}, {field})" for kind, field in fields)
    code = f"int64_t tgco_place(int i) {{ static const int64_t all[] = {{{places}}}; return all[i]; }}"
    text = joined("#include <stddef.h>\n" + included(name), folder, {"constants.h": structures.constants()})
    place = build(text + header.layout + code).tgco_place
    assert [place(i) for i in range(len(fields))] == [getattr(kind, field).offset for kind, field in fields]
    assert set(header.made) == set(header._fields)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("folder", "flags"),
    [(C, []), (C, ["-UDIM", "-DDIM=0"]), (roadmap.C, []), (roadmap.C, ["-UBOXES", "-DBOXES=0"]), (SENSING, [])],
)  # fmt: skip
def test_every_file_of_c_compiles_by_itself(folder: Path, flags: list[str]) -> None:
    """With the flags that editors read, and others that problems have. Where sizes are known, no array has another."""
    flags = [*(folder / "compile_flags.txt").read_text().split(), *flags]
    flags += ["-Werror=implicit-function-declaration", "-Werror=vla", "-Wno-psabi", "-fsyntax-only", "-x", "c"]
    files = sorted(path.name for path in folder.glob("*.[ch]"))
    subprocess.run([*find_compiler().command, *flags, *files], cwd=folder, check=True)


def test_an_editor_sees_the_constants_of_python() -> None:
    """Where this fails: write `constants()` there."""
    assert (C / "editor" / "constants.h").read_text() == structures.constants()


def test_no_value_is_lost_by_a_wrong_name_or_type() -> None:
    _, Pair = pair_of(PAIR)
    with pytest.raises(AttributeError, match="Pair has no field forst"):
        Pair(forst=1.0)
    with pytest.raises(TypeError, match=r"Pair lacks bounds, first, others"):
        Pair.complete(count=1)
    for wrong in (torch.zeros(2), torch.zeros(2, dtype=torch.int64), torch.zeros(4, dtype=torch.float64)[::2]):
        with pytest.raises(TypeError, match=r"others: expected a contiguous tensor of torch.float64"):
            Pair(others=wrong)
    with pytest.raises(TypeError, match="Options lacks"):
        Options.complete(rungs=1)


def test_an_end_is_no_status() -> None:
    assert End.ENDED not in set(Status)


@pytest.mark.parametrize("name", CONSTANTS)
def test_a_constant_changes_what_is_compiled(name: str, monkeypatch) -> None:
    engine = engine_of(boxed_batch(2, B=1, N=3)[0])
    assert engine is not None
    vectors = {"REAL": "double", "LANES": LANES}
    for library in (SOLVER_LIBRARY, SAMPLER, INTERIOR):
        usual = engine.form._written(library, vectors)
        with monkeypatch.context() as patch:
            patch.setitem(CONSTANTS, name, 7)
            changed = engine.form._written(library, vectors)
        for now, before in zip(changed, usual, strict=True):
            own = defines({name: CONSTANTS[name]})
            assert now.source == before.source.replace(own, f"#define {name} 7\n") != before.source
    assert any(name in path.read_text() for path in C.glob("*.[ch]")), "no line of C uses it"


@pytest.mark.parametrize("kind", structures.ENUMERATIONS)
def test_an_enumeration_has_the_values_of_python(kind: type[IntEnum]) -> None:
    name = kind.__name__.lower()
    values = ", ".join(member.name for member in kind)
    code = f"int tgco_{name}(int i) {{ static const int all[] = {{{values}}}; return all[i]; }}"
    function = getattr(build(enumerations([kind]) + code), f"tgco_{name}")
    assert [function(i) for i in range(len(kind))] == [member.value for member in kind]


class Choosy(LineSearch):
    """Refuses all steps."""

    ratio_min = 5.0


def run(inner: ILQR, prepare: Callable[[State], None], problem: Problem, native: bool, count: int) -> State:
    """The state after `count` iterations, one by one; a backward pass that fails is tried again until it succeeds."""
    state, lagrangian = running_state(problem)
    prepare(state)
    for _ in range(count):
        end = (
            kernels_of(lagrangian.problem).descend(lagrangian, state, inner.descent, 1)
            if native
            else iterate(inner.descent, state, lagrangian)
        )
        while not native and bool((end.failed & (end.status == Status.RUNNING)).all()):
            end = iterate(inner.descent, state, lagrangian)
    return state


def damped(state: State) -> None:
    state.regularisation = torch.full_like(state.merit, 0.5)


def unchanged(state: State) -> None:
    pass


def planar() -> Problem:
    return planar_batch(B=3, N=8)[0]


def concave() -> Problem:
    free = planar_batch(B=2, N=6)[0]
    return free._with({"cost": replace(free.cost, R=-free.cost.R), "constraints": ()})


CHOOSY = ILQR(line_search=Choosy())
# Constant: another value, the solver, the start, the problem, iterations.
OF_ILQR: dict[str, tuple[float, ILQR, Callable[[State], None], Callable[[], Problem], int]] = {
    "REGULARISATION_FIRST": (3e-6, ILQR(), unchanged, concave, 1),
    "REGULARISATION_GROWTH": (7.0, ILQR(), unchanged, concave, 1),
    "REGULARISATION_MAX": (0.7, CHOOSY, damped, planar, 1),
    "DAMPING": (0.05, CHOOSY, unchanged, planar, 1),
    "DAMPING_GROWTH": (7.0, CHOOSY, damped, planar, 2),
    "DAMPING_DECAY": (2.0, ILQR(), damped, planar, 1),
    "ROUNDED_OFF": (1e6, ILQR(), unchanged, planar, 1),
}
PRINTED = ILQR(as_printed=True, line_search=Choosy())  # takes the last step length
OF_LINE_SEARCH = {
    "shrink": (0.3, PRINTED), "smallest": (0.3, PRINTED), "ratio_min": (2.0, ILQR()), "ratio_max": (0.5, ILQR()),
}  # fmt: skip


@pytest.mark.parametrize("name", OF_ILQR)
def test_a_constant_of_ilqr_changes_both_kernels(name: str, monkeypatch) -> None:
    value, inner, prepare, problem, count = OF_ILQR[name]
    usual = run(inner, prepare, problem(), True, count)
    monkeypatch.setattr(iteration, name, value)
    mine, theirs = (run(inner, prepare, problem(), native, count) for native in (True, False))
    assert not same(mine, usual) and same(mine, theirs)


@pytest.mark.parametrize("name", OF_LINE_SEARCH)
def test_a_constant_of_the_line_search_changes_both_kernels(name: str, monkeypatch) -> None:
    value, inner = OF_LINE_SEARCH[name]
    usual = run(inner, unchanged, planar(), True, 1)
    monkeypatch.setattr(LineSearch, name, value)
    mine, theirs = (run(inner, unchanged, planar(), native, 1) for native in (True, False))
    assert not same(mine, usual) and same(mine, theirs)


def same(a: State, b: State) -> bool:
    names = ("regularisation", "merit", "U")
    return all(torch.allclose(getattr(a, name), getattr(b, name), rtol=1e-7, atol=1e-10) for name in names)


@pytest.mark.parametrize("B", [1, 3])
def test_iterates_are_lost_where_python_says(B: int, monkeypatch) -> None:
    """With LOST_BY = 0 every refused iterate counts as lost, and a lifted search follows, in both kernels."""
    problem = planar().take(torch.arange(B))
    usual = run(CHOOSY, unchanged, problem, True, 1)
    monkeypatch.setattr(iteration, "LOST_BY", 0.0)
    mine, theirs = (run(CHOOSY, unchanged, problem, native, 1) for native in (True, False))
    assert not same(mine, usual) and same(mine, theirs)


@pytest.mark.parametrize(("name", "value"), [("LIFTED_STEPS", 1), ("GAIN", 0.9999)])
def test_a_constant_of_the_lifted_search_changes_both_kernels(name: str, value: float, monkeypatch) -> None:
    state, lagrangian = running_state(planar())
    searches = (kernels_of(lagrangian.problem).lifted, lifted_search)
    usual = [search(lagrangian, state.X, state.U, state.merit).accepted for search in searches]
    monkeypatch.setattr(iteration, name, value)
    changed = [search(lagrangian, state.X, state.U, state.merit).accepted for search in searches]
    assert bool(usual[0].any()) and torch.equal(*usual)
    assert not bool(changed[0].all()) and torch.equal(*changed) and not torch.equal(usual[0], changed[0])


def test_every_option_reaches_the_library() -> None:
    """Each field has the value of the option, or of the constant, that bears its name."""
    inner = ILQR(tolerance=0.011, max_iterations=13, line_search=LineSearch(back=2))
    options, search = native_options(inner.descent), inner.line_search
    want = {
        "rungs": len(search.ladder(False)), "back": 2, "max_iterations": 13, "accept_last": 0, "tolerance": 0.011,
        "absolute_tolerance": 0.0, "ratio_min": search.ratio_min, "ratio_max": search.ratio_max,
        "smallest": search.smallest, "rounding": iteration.ROUNDED_OFF, "lost": iteration.LOST_BY,
        "regularisation_first": iteration.REGULARISATION_FIRST,
        "regularisation_growth": iteration.REGULARISATION_GROWTH,
        "regularisation_max": iteration.REGULARISATION_MAX, "damping": iteration.DAMPING,
        "damping_growth": iteration.DAMPING_GROWTH, "damping_decay": iteration.DAMPING_DECAY,
    }  # fmt: skip
    assert {name: getattr(options, name) for name in Options.declared if name != "ladder"} == want
    ladder = (ctypes.c_double * options.rungs).from_address(options.ladder)
    assert list(ladder) == search.ladder(False)
    printed = native_options(replace(inner, as_printed=True).descent)
    assert (printed.tolerance, printed.absolute_tolerance, printed.damping, printed.accept_last) == (0.0, 0.011, 0, 1)


def test_the_collision_penalty_changes_both_kernels(monkeypatch) -> None:
    problem, U = planar_batch(B=3, N=20, obstacles=10)
    drawing, key = MPPI(samples=60, covariance=20.0, temperature=50.0), DrawKey(7, torch.arange(3), torch.arange(3))
    made = {}
    for penalty in (mppi.COLLISION_PENALTY, 20.0):
        monkeypatch.setattr(mppi, "COLLISION_PENALTY", penalty)
        for native in (True, False):
            kernels.use_native(native)
            made[penalty, native] = drawing.improve(problem, U, key)[1]
        torch.testing.assert_close(made[penalty, True], made[penalty, False], rtol=1e-4, atol=1e-4)
    assert not torch.allclose(*(made[penalty, True] for penalty, native in made if native), rtol=1e-3)


OF_ROADMAP = {
    "SHELLS": {2: (1.4,)}, "CIRCLE": 5, "MIDWAY": 1, "LEAST_GAP": 0.4, "EDGE_COST": 0.3, "HOPS": 1, "TIE": 0.5,
    "AROUND": 4.0, "TINY": 3.0, "UNIT": 30.0,
}  # fmt: skip


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", mostly(OF_ROADMAP, "TIE", "HOPS"))
def test_a_constant_of_the_roadmap_changes_both_searches(name: str, monkeypatch) -> None:
    usual = searched()
    for path, module in list(sys.modules.items()):
        own = path.startswith(("torchgco.roadmap", "torchgco.obstacles", "tests.reference.graph_search"))
        if own and hasattr(module, name):
            monkeypatch.setattr(module, name, OF_ROADMAP[name])
    changed = searched()
    for native, plain in (usual, changed):
        torch.testing.assert_close(native, plain, rtol=1e-9, atol=1e-9)
    assert usual[0].shape != changed[0].shape or not torch.allclose(usual[0], changed[0], rtol=1e-6)


def searched() -> tuple[Tensor, Tensor]:
    """Different paths of several problems, by the library and by PyTorch."""
    problem, U0 = planar_batch(B=8, N=10, obstacles=8)
    scene = scene_of(problem, U0)
    assert scene is not None
    found = Roadmap(num_halton=16).paths(scene, 3)[0]
    with searched_by_torch():
        return found, Roadmap(num_halton=16).paths(scene, 3)[0]
