"""CUDA C++ without a device: what g++ makes of it has the bits of C, and NVRTC compiles it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import torchgco
from tests.dynamics.test_implicit import oscillator
from tests.export.kinds import KINDS
from tests.native import users
from tests.native.shim import FLAGS, Shim
from tests.native.test_overruns import ROOT, sanitizer
from tests.native.test_sampler import PROBLEMS as SAMPLED
from tests.native.test_sampler import SAMPLERS, key
from tests.other_device import OTHER, SecondDevice
from tests.slow import mostly
from tests.test_elsewhere import learned, numbers, problem_of
from torchgco import DeviceWarning, Problem
from torchgco.kernels import choice
from torchgco.native.compiler import NativeError, find_compiler
from torchgco.native.cuda import compiler, launch
from torchgco.native.cuda.engine import OnDevice, working_on
from torchgco.native.cuda.source import INTERIOR, SAMPLER, SOLVER, Program, source
from torchgco.native.engine import Engine
from torchgco.native.structures import Array, Constraint
from torchgco.native.structures import Problem as Packed

needs_gxx = pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
pytestmark = [needs_gxx, pytest.mark.skipif(find_compiler() is None, reason="no C compiler")]
FORMS: dict[str, Callable[[], Problem]] = {
    **users.PROBLEMS, **KINDS, "implicit steps": lambda: oscillator(B=3).cast(torch.float64),
}  # fmt: skip
BITS = "X", "U", "cost", "K", "status", "iterations"
# Of these forms each way of interleaving is tried, by one solver each; all others take turns.
QUICK = [("smooth", "al_ilqr", 1), ("a body", "al_ilqr", 4), ("constraints", "interior_point", 32), ("a map", "gco", 4)]
TURNS = [(name, solver, (1, 4, 32)[i % 3]) for i, name in enumerate(FORMS) for solver in ("al_ilqr", "interior_point")]


class Shims:
    """Modules of the device that g++ stands for."""

    def __init__(self, **options: int) -> None:
        self.made: list[Shim] = []
        self._options = options

    def __call__(self, text: str) -> Shim:
        self.made.append(Shim(text, **self._options))
        return self.made[-1]

    @property
    def launched(self) -> set[str]:
        return {kernel for shim in self.made for kernel in shim.launched}


@contextmanager
def shimmed(least: int = 1, **options: int) -> Iterator[Shims]:
    """A block in which the shim serves from so many problems on."""
    shims = Shims(**options)
    with working_on(OnDevice(shims, least)):
        yield shims


@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning", "ignore::torchgco.HorizonWarning")
@pytest.mark.parametrize(("name", "solver", "stride"), [*QUICK, *mostly(TURNS, *TURNS, several=True)])
def test_solves_have_the_bits_of_c(name: str, solver: str, stride: int) -> None:
    expected = torchgco.solve(FORMS[name](), solver=solver, verbose=False)
    with shimmed(stride=stride) as shims:
        found = torchgco.solve(FORMS[name](), solver=solver, verbose=False)
    assert shims.launched
    for bits in BITS:
        assert torch.equal(getattr(found, bits), getattr(expected, bits)), bits


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("made", mostly(SAMPLED, *(set(SAMPLED) - {"quadrotor"})))
def test_rounds_of_mppi_have_the_bits_of_c(made: str, dtype: str) -> None:
    for how in SAMPLERS.values():
        sampler, expected = replace(how, dtype=dtype), []
        for block in (partial(working_on, None), shimmed):
            problem, U = SAMPLED[made]()
            with block() as shims:
                expected.append(sampler.improved(problem, U, key(problem.B)))
        assert "sample_fly" in shims.launched and torch.equal(*expected)


def test_gradients_are_those_of_c() -> None:
    """The systems that they need are solved there, too."""
    grads = []
    for block in (partial(working_on, None), shimmed):
        problem, _ = problem_of("cpu")
        x0 = problem.x0.clone().requires_grad_()
        with block() as shims:
            torchgco.solve(replace(problem, x0=x0), solver="interior_point", verbose=False).X.square().sum().backward()
        grads.append(x0.grad)
    assert "kernel_tgco_kkt" in shims.launched and torch.equal(*grads)


def test_a_problem_of_a_device_is_served_there(monkeypatch) -> None:
    """Without a warning, and back where it came from."""
    problem, U0 = problem_of("cpu")
    expected, shims = torchgco.solve(problem, U0, "interior_point", verbose=False), Shims()
    served = OnDevice(shims, 1)
    monkeypatch.setattr(choice, "on_device", lambda device: served if device.type == OTHER.type else None)
    with SecondDevice():
        solution = torchgco.solve(*problem_of(OTHER), "interior_point", verbose=False)
        assert solution.X.device == OTHER and numbers(solution) == numbers(expected)
        assert [one.account and one.account.kernels for one in (expected, solution)] == ["native", "cuda"]
    assert "kernel_tgco_interior" in shims.launched


@pytest.mark.parametrize("solver", mostly(["al_ilqr", "interior_point"], "interior_point"))
def test_a_network_of_a_device_is_served_there(solver: str, monkeypatch) -> None:
    """Its weights are numbers of the device, which the kernels read in the order of C's sums."""
    expected, shims = numbers(torchgco.solve(learned("cpu")[0], solver=solver, verbose=False)), Shims()
    served = OnDevice(shims, 1)
    monkeypatch.setattr(choice, "on_device", lambda device: served if device.type == OTHER.type else None)
    with SecondDevice():
        solution = torchgco.solve(learned(OTHER)[0], solver=solver, verbose=False)
        assert solution.to_frame()["kernels"].tolist() == ["cuda"] * 2 and numbers(solution) == expected
    assert shims.launched & {"kernel_tgco_outer", "kernel_tgco_interior"}


def test_commands_of_a_device_are_sampled_there(monkeypatch) -> None:
    """From states of the device, and controls are there, too."""
    sampler, shims = SAMPLERS["rounds of smooth noise"], Shims()
    controller = torchgco.MPPIController(problem_of("cpu")[0], sampler)
    states = [problem_of("cpu")[0].x0 + 0.01 * i for i in range(2)]
    expected = [controller.command(x).tolist() for x in states]
    served = OnDevice(shims, 1)
    monkeypatch.setattr(choice, "on_device", lambda device: served if device.type == OTHER.type else None)
    with SecondDevice():
        controller = torchgco.MPPIController(problem_of(OTHER)[0], sampler)
        controls = [controller.command(x.to(OTHER)) for x in states]
        assert [u.tolist() for u in controls] == expected and controls[0].device == OTHER
    assert "sample_fly" in shims.launched


def test_compiled_problems_of_a_device_are_solved_there(monkeypatch) -> None:
    """By calls and by a control loop; their answers lie on the CPU."""
    found, shims = [], Shims()
    served = OnDevice(shims, 1)
    monkeypatch.setattr(choice, "on_device", lambda device: served if device.type == OTHER.type else None)
    for device in ("cpu", OTHER):
        with SecondDevice():
            problem, _ = problem_of(device)
            call, loop = (
                torchgco.compile(problem, "interior_point", receding=True),
                torchgco.MPC(problem, "interior_point"),
            )
            x = problem_of("cpu")[0].x0
            answers = [call(x0=x + 0.01 * i) for i in range(2)]
            found.append([answer.U.tolist() for answer in answers] + [loop.step(x).tolist(), loop.step(x).tolist()])
            assert not shims.made or device == OTHER
    assert found[0] == found[1] and "kernel_tgco_interior" in shims.launched


def test_without_a_device_there_are_no_kernels() -> None:
    assert choice.on_device(torch.device("cpu")) is None
    if not torch.cuda.is_available():
        assert not compiler.available() and choice.on_device(torch.device("cuda")) is None


def test_few_problems_are_solved_by_the_cpu() -> None:
    problem, U0 = problem_of("cpu")
    with shimmed(least=3) as shims:
        solution = torchgco.solve(problem, U0, "interior_point", verbose=False)
    assert not shims.made and solution.to_frame()["kernels"].tolist() == ["native"] * 2
    with shimmed(least=8) as shims:  # as many threads as samples, of which there is one of the CPU for a problem
        SAMPLERS["free"].improved(problem, U0, key(2))
    assert "sample_fly" in shims.launched


def refused(text: str) -> Any:
    raise NativeError("NVRTC failed:\nsomething")


@pytest.mark.parametrize(("load", "told"), [(refused, "NVRTC failed"), (Shims(free=1000), "no .* bytes")])
def test_the_cpu_solves_what_a_device_cannot(load: Any, told: str) -> None:
    problem, U0 = problem_of("cpu")
    expected = torchgco.solve(problem, U0, "interior_point", verbose=False)
    with working_on(OnDevice(load, 1)), pytest.warns(DeviceWarning, match=told):
        found = torchgco.solve(*problem_of("cpu"), "interior_point", verbose=False)
    assert numbers(found) == numbers(expected)


def test_structures_on_a_device_point_to_what_lies_there() -> None:
    """Tensors that share memory still do; what C doesn't write to isn't copied back."""
    both, given = torch.zeros(4, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    lam = torch.zeros(2, dtype=torch.float64)
    rows = [Constraint(rows=1), Constraint(rows=2, lam=lam, bound=Array(data=given, size=3))]
    packed = Packed(N=5, constraints=2, constraint=rows, X=both[:2], U=both[2:], mu=both).fill(
        {"limit": 7}, copied=True
    )
    placed = launch.Placed(packed, torch.device("cpu"))
    there = Packed.from_address(placed.address)
    assert (there.N, there.limit, there.constraints) == (5, 7, 2)
    assert there.X == there.mu == there.U - 16 and there.X not in (0, both.data_ptr())
    second = (Constraint * 2).from_address(there.constraint)[1]
    assert second.rows == 2 and second.bound.data != given.data_ptr()
    for address, count in ((there.X, 4), (second.lam, 2), (second.bound.data, 3)):
        (launch.ctypes.c_double * count).from_address(address)[:] = [8.0] * count
    placed.read_back()
    assert both.tolist() == [8.0] * 4 and lam.tolist() == [8.0] * 2 and given.tolist() == [1.0] * 3


OTHERS = "gains", "costates", "follow", "lift", "expand"  # functions that have no kernel, and could
ALL = replace(SOLVER, functions=SOLVER.functions | {f"tgco_{name}": "Problem" for name in OTHERS})
STRICT = "-std=c++20", "-pedantic-errors", "-Werror=vla", "-fsyntax-only"


def errors(program: Program, name: str, further: str = "") -> list[str]:
    """What g++ finds wrong in a program for a form, as strictly as CUDA C++ is read."""
    form = Engine(users.PROBLEMS["constraints"](), compiles=False).form
    words = ["g++", *FLAGS, *STRICT, "-x", "c++", "-"]
    text = source(form, program, name) + further
    said = subprocess.run(words, input=text, capture_output=True, text=True).stderr
    return [line for line in said.splitlines() if "error" in line]


@pytest.mark.parametrize(
    ("program", "name"),
    [(INTERIOR, "tgco_interior"), (INTERIOR, "tgco_kkt"), (SAMPLER, "tgco_sample")]
    + [(ALL, name) for name in ALL.functions],
)
def test_no_file_of_c_has_what_cuda_refuses(program: Program, name: str) -> None:
    assert not errors(program, name)


REFUSED = (
    "void f(int n) { double a[n]; a[0] = 0; }",
    "Array f(void) { return (Array){.size = 1}; }",
    "int *p = malloc(4);",
)


@pytest.mark.parametrize("line", REFUSED)
def test_what_cuda_refuses_is_seen(line: str) -> None:
    assert errors(SAMPLER, "tgco_sample", line)


@pytest.mark.slow
@pytest.mark.skipif(sanitizer() is None, reason="no GCC with its address sanitizer")
def test_no_thread_reads_or_writes_beyond_its_arrays() -> None:
    watched = {
        "LD_PRELOAD": str(sanitizer()), "ASAN_OPTIONS": "detect_leaks=0", "PYTHONPATH": str(ROOT),
        "SHIM_FLAGS": "-O1 -fsanitize=address",
    }  # fmt: skip
    words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(Path(__file__)), "-k", "bits"]
    done = subprocess.run(words, cwd=ROOT, env={**os.environ, **watched}, capture_output=True, text=True)
    assert done.returncode == 0 and "passed" in done.stdout, done.stdout[-3000:] + done.stderr[:3000]


try:
    from cuda.bindings import nvrtc

    NVRTC = str(nvrtc.nvrtcVersion())
except (ImportError, RuntimeError):  # the package, or its library
    NVRTC = ""
needs_nvrtc = pytest.mark.skipif(not NVRTC, reason="no NVRTC")
COMPILED = [
    ("quadrotor", SAMPLER, "tgco_sample"),
    ("smooth", SOLVER, "tgco_outer"),
    ("a network", SOLVER, "tgco_outer"),
    ("a body", INTERIOR, "tgco_interior"),
]


@needs_nvrtc
@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
@pytest.mark.parametrize(("form", "program", "name"), mostly(COMPILED, *COMPILED[1:], several=True))
def test_nvrtc_compiles_programs(form: str, program: Program, name: str, arch: str, cache, monkeypatch) -> None:
    problem = SAMPLED[form]()[0] if program is SAMPLER else FORMS[form]()
    text = source(Engine(problem, compiles=False).form, program, name)
    made = compiler.cubin(text, arch)
    assert made[:4] == b"\x7fELF"
    monkeypatch.setattr(compiler, "_compiled", lambda *words: pytest.fail("compiled again"))
    assert compiler.cubin(text, arch) == made


@needs_nvrtc
def test_what_nvrtc_refuses_is_told(cache) -> None:
    with pytest.raises(NativeError, match="nothing"):
        compiler.cubin("int f() { return nothing; }", "sm_90")
