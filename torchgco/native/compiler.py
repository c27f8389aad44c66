"""C source to a loaded library, compiled for this processor and kept for the next process."""

from __future__ import annotations

import _ctypes
import ctypes
import functools
import itertools
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType

from torchgco.base.clock import setting_up
from torchgco.base.memory import trim
from torchgco.base.notices import notice
from torchgco.base.signals import handled
from torchgco.native import store

# NaN and infinity carry meaning here, so no -ffast-math: only options that leave them intact. Products and sums are
# fused where the code says so (lanes.h) and nowhere else: bits depend on no optimisation and on no division into units.
# Below -O2 gcc clears the upper halves of vector registers before calls of the C library only with
# -fexpensive-optimizations: otherwise such a call, a tanh for instance, takes many times as long on some processors.
FLAGS = (
    "-O3", "-std=c11", "-fPIC", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off",
    "-fexpensive-optimizations",
)  # fmt: skip
# No warning where a vector type is wider than the registers: within one library that does no harm.
_QUIET = ("-Wno-psabi",)
_ERROR_LINES = 5
_ERROR = re.compile(r"error|fail|cannot|can't|No space", re.IGNORECASE)
# What drivers add when the reason has been said, and lines of the source that are shown beside it.
_SUMMARY = re.compile(r"exit (code|status)|compilation terminated|errors? generated|^\d*\s*\|", re.IGNORECASE)
# What gcc 12 takes: s a line of the solvers' own text, loops over vectors; a line of the straight code of a model,
# twice as long where there are _LONG of these, and to begin with; and the share of it at other levels than -O3.
_LOOPS, _STRAIGHT, _BEGIN, _LONG = 1.0e-3, 0.2e-3, 0.2, 170_000
_SHARES = {"-O0": 0.2, "-Og": 0.3, "-O1": 0.5, "-O2": 0.7, "-O3": 1.0}
_BRIEF = 2.0  # s: compilations that are shorter are announced only to those who watch
_OBJECTS = 32  # in memory
_AMD_HALVES = 25  # family of AMD processors, at most, that compute vectors of 512 bits in two steps


class NativeError(RuntimeError):
    """No native kernel is available: no compiler, source that doesn't compile, or a library that doesn't load."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler: the command that calls it, and its path and version, which libraries depend on."""

    command: tuple[str, ...]
    identity: str
    further: tuple[str, ...] = ()  # flags of the user's, after all others

    @property
    def flags(self) -> tuple[str, ...]:
        is_zig = "ziglang" in self.command or Path(self.command[0]).stem == "zig"
        return (*FLAGS, "-mcpu=native" if is_zig else "-march=native", *_QUIET)


def find_compiler() -> Compiler | None:
    """The first that works of CC, cc, gcc, clang, and zig from the package ziglang; None where there is none.

    TORCHGCO_CC names the only compiler that is tried; a word such as "none" turns native kernels off. The words of
    TORCHGCO_CFLAGS are further flags: with -O1 compiling takes half of the time, and solves up to twice as long.
    """
    return _find_compiler(*map(os.environ.get, ("TORCHGCO_CC", "CC", "PATH", "TORCHGCO_CFLAGS")))


@dataclass(frozen=True)
class Unit:
    """A file of C that a library is linked from.

    Attributes:
        own: straight code of one model. The objects of all others are kept in the cache, for libraries to come.
    """

    source: str
    own: bool = False


def build(source: str | Sequence[Unit], flags: Sequence[str] = ()) -> ctypes.CDLL:
    """The library that `source` is compiled to; names it exports begin with tgco_.

    Args:
        source: one file of C11, or the units that are compiled, beside each other, and linked.
        flags: further flags, after those of `FLAGS`, so that -O2 here replaces its -O3.

    Raises:
        NativeError: there is no compiler, it refuses the source (its first errors are named), or the library can't be
            written or loaded.
    """
    compiler = find_compiler()
    units = (Unit(source, own=True),) if isinstance(source, str) else tuple(source)
    known = (units, tuple(flags), compiler)
    # No lock: two threads that compile the same source do no harm, and a lock held across a fork would.
    library = _loaded.pop(known, None)
    if library is None:
        if compiler is None:
            raise NativeError(
                "no C compiler found: install gcc or clang, or `pip install ziglang`, or name one in TORCHGCO_CC"
            )
        with setting_up():
            library = _load(compiler, units, (*compiler.flags, *flags, *compiler.further))
        weakref.finalize(library, _ctypes.dlclose, library._handle).atexit = False  # functions of it hold it, too
    _loaded[known] = library  # the most recent one is the last
    trim(_loaded, _KEPT)
    return library


def begin(*libraries: tuple[Unit, ...]) -> None:
    """Start to compile what `build` will ask for, of several libraries at once; an error is left to `build`."""
    compiler = find_compiler()
    if compiler is None:
        return
    flags = (*compiler.flags, *compiler.further)
    missing = [
        units for units in libraries
        if (units, (), compiler) not in _loaded and store.find(_key(compiler, units, flags), ".so") is None
    ]  # fmt: skip
    _begin(compiler, [unit for units in missing for unit in units], flags)


@dataclass(frozen=True)
class _Begun:
    """A compiler that runs in a room of its own, started by the process `owner`: forks can't wait for it."""

    owner: int
    room: TemporaryDirectory[str]
    process: subprocess.Popen[str]


_KEPT = 256  # libraries with their sources, the most recent ones; what still runs keeps its own
_loaded: dict[tuple[tuple[Unit, ...], tuple[str, ...], Compiler | None], ctypes.CDLL] = {}
_begun: dict[str, _Begun] = {}  # by the key of the object
_objects: dict[str, bytes] = {}  # the most recent ones: both libraries of a form have its model's


def _key(compiler: Compiler, units: Sequence[Unit], flags: tuple[str, ...]) -> str:
    # Libraries are of a kin whose sources differ in numbers alone, decimal or hexadecimal, be it in names.
    sources = [unit.source for unit in units]
    every = "".join(sources).encode(errors="surrogateescape")
    kin = every.translate(None, b"0123456789abcdefxp.+-").decode(errors="replace")
    return store.key_of(("library 2", *sources, *_circumstances(compiler, flags)), kin)


def _object_key(compiler: Compiler, unit: Unit, flags: tuple[str, ...]) -> str:
    return store.key_of(("object 1", unit.source, *_circumstances(compiler, flags)))


def _circumstances(compiler: Compiler, flags: tuple[str, ...]) -> tuple[str, ...]:
    return (*flags, *compiler.command[1:], compiler.identity, _processor())


def _load(compiler: Compiler, units: tuple[Unit, ...], flags: tuple[str, ...]) -> ctypes.CDLL:
    key = _key(compiler, units, flags)
    content = store.read(key, ".so")
    if content is not None:
        with suppress(OSError):  # a full disk, or one mounted without execution rights
            return _own(content)
        with suppress(OSError):
            return ctypes.CDLL(str(store.find(key, ".so")))
    try:
        with TemporaryDirectory(prefix="torchgco-") as room:
            made = _linked(compiler, units, flags, Path(room))
            kept = store.save(key, ".so", made.read_bytes())
            try:
                return ctypes.CDLL(str(made))  # stays loaded when its file is deleted
            except OSError:
                return ctypes.CDLL(str(kept or made))
    except OSError as error:
        raise NativeError(f"a compiled library can't be written or loaded: {error}") from error


def _own(library: bytes) -> ctypes.CDLL:
    """Load a library that was read, out of a folder that nobody else can look into.

    By its path in the cache another file could be loaded than was read, where others may write to a folder above.
    """
    with TemporaryDirectory(prefix="torchgco-") as room:
        path = Path(room) / "kernels.so"
        path.write_bytes(library)
        return ctypes.CDLL(str(path))


def _linked(compiler: Compiler, units: tuple[Unit, ...], flags: tuple[str, ...], room: Path) -> Path:
    """The library of these units, made in a room of its own."""
    _begin(compiler, units, flags)
    objects = [_object(compiler, unit, flags) for unit in units]
    for i, content in enumerate(objects):
        (room / f"{i}.o").write_bytes(content)
    words = ["-shared", "-o", "kernels.so", *(f"{i}.o" for i in range(len(units))), "-lm"]
    _check(compiler, *_finished(lambda: _start(compiler, (*flags, *words), room)))
    return room / "kernels.so"


def _begin(compiler: Compiler, units: Sequence[Unit], flags: tuple[str, ...]) -> None:
    """Start a compiler for each of these units that has no object yet, all at the same time."""
    keys = {_object_key(compiler, unit, flags): unit for unit in units}
    missing = {key: unit for key, unit in keys.items() if _known(key, unit) is None and not _runs(key)}
    if missing:
        _announce(list(missing.values()), flags)
    for key, unit in missing.items():
        with suppress(OSError), _ending([]), _held():
            room = TemporaryDirectory(prefix="torchgco-")
            _begun[key] = _Begun(os.getpid(), room, _compiling(compiler, unit, flags, Path(room.name)))


def _compiling(compiler: Compiler, unit: Unit, flags: tuple[str, ...], room: Path) -> subprocess.Popen[str]:
    """A compiler that makes kernels.o of a unit in its room."""
    (room / "kernels.c").write_text(unit.source)
    return _start(compiler, (*flags, "-c", "-o", "kernels.o", "kernels.c"), room)


def _runs(key: str) -> bool:
    return key in _begun and _begun[key].owner == os.getpid()


def _known(key: str, unit: Unit) -> bytes | None:
    """The object under a key, of this process or from the cache."""
    content = _objects.get(key)
    if content is None and not unit.own:
        content = store.read(key, store.OBJECT)
        if content is not None:
            _remember(key, content)
    return content


def _remember(key: str, content: bytes) -> None:
    _objects[key] = content
    trim(_objects, _OBJECTS)


def _object(compiler: Compiler, unit: Unit, flags: tuple[str, ...]) -> bytes:
    """The object of a unit; its compiler has begun unless another thread waits for that one."""
    key = _object_key(compiler, unit, flags)
    begun = _begun.pop(key, None) if _runs(key) else None
    if begun is None:
        content = _known(key, unit)
        if content is not None:
            return content
    with TemporaryDirectory(prefix="torchgco-") if begun is None else begun.room as name:
        room = Path(name)
        _check(compiler, *_finished(lambda: begun.process if begun else _compiling(compiler, unit, flags, room)))
        content = (room / "kernels.o").read_bytes()
    _remember(key, content)
    if not unit.own:
        store.save(key, store.OBJECT, content)
    return content


def _check(compiler: Compiler, returncode: int, errors: str) -> None:
    """Raise what a compiler says that has failed."""
    if returncode == 0:
        return
    said = [line.strip() for line in errors.splitlines() if line.strip()] or [_ended(returncode)]
    telling = [line for line in said if _ERROR.search(line) and not _SUMMARY.search(line)] or said
    # The first line stands alone in warnings: it has the error that ended the compiler, the last one.
    lines = [f"{shlex.join(compiler.command)} failed: {telling[-1]}", *telling[:-1][:_ERROR_LINES]]
    raise NativeError("\n".join(lines))


def _announce(units: Sequence[Unit], flags: Sequence[str]) -> None:
    """A line on compilers that are to be started; none where others run, which have been announced."""
    if any(begun.owner == os.getpid() and begun.process.poll() is None for begun in _begun.values()):
        return
    seconds = _expected(units, flags)
    about = f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} minutes"
    known = f"about {about}" if seconds >= 1.0 else "a moment"
    notice(f"compiling native kernels (once for this form of problem, {known}) ...", brief=seconds <= _BRIEF)


def _expected(units: Sequence[Unit], flags: Sequence[str]) -> float:
    """Seconds that gcc takes for units, within a factor of two on an AMD EPYC that has nothing else to do."""
    level = next((flag for flag in reversed(flags) if flag in _SHARES), "-O3")
    each = [_SHARES[level] * _took(unit) for unit in units]
    return max(*each, sum(each) / (os.cpu_count() or 1)) if len(each) > 1 else each[0]


def _took(unit: Unit) -> float:
    lines = unit.source.count("\n")
    if not unit.own:
        return _LOOPS * lines
    return _BEGIN + _STRAIGHT * lines * (1.0 + lines / _LONG)


def _start(compiler: Compiler, words: Sequence[str], room: Path) -> subprocess.Popen[str]:
    """A compiler that works in its room. It has a process group of its own, as it starts other processes."""
    # Run in its folder: no path gets into the library, which then has the same bytes wherever it is made.
    return subprocess.Popen(
        [*compiler.command, *words], cwd=room, env={**os.environ, "LC_ALL": "C"}, process_group=0,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace",
    )  # fmt: skip


def _finished(start: Callable[[], subprocess.Popen[str]]) -> tuple[int, str]:
    """Start a compiler, or take one that has begun, and wait for it; returns its exit code and what it says on stderr.

    Ctrl-C and SIGTERM end it here, with its group and the compilers that have begun: they would go on.
    """
    started: list[subprocess.Popen[str]] = []
    with _ending(started):
        with _held():  # a signal before the compiler is known would leave it running
            started.append(start())
        _, said = started[0].communicate()
    return started[0].returncode, said


@contextmanager
def _ending(started: Sequence[subprocess.Popen[str]]) -> Iterator[None]:
    """An exception or SIGTERM in this block ends what is started by then, and the compilers that have begun."""
    try:
        with _ending_by_sigterm(started):
            yield
    except BaseException:
        for process in _kill_all(started):
            process.wait()
        _begun.clear()
        raise


@contextmanager
def _held() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait for the end of this block."""
    came: list[int] = []
    try:
        with handled(lambda number, frame: came.append(number), lambda handler: handler not in (signal.SIG_IGN, None)):
            yield
    finally:
        for number in came:
            signal.raise_signal(number)


def _kill_all(started: Sequence[subprocess.Popen[str]]) -> list[subprocess.Popen[str]]:
    """Kill what is started and the compilers that have begun, without waiting for their ends; returns them."""
    every = [*started, *(begun.process for begun in list(_begun.values()) if begun.owner == os.getpid())]
    for process in every:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    return every


@contextmanager
def _ending_by_sigterm(started: Sequence[subprocess.Popen[str]]) -> Iterator[None]:
    """In this block a SIGTERM that nobody handles, as in a study's workers, ends what is started by then first."""

    def end(number: int, frame: FrameType | None) -> None:
        # A handler may not wait: what it interrupts may hold the lock of a process that is waited for.
        _kill_all(started)
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    with handled(end, lambda handler: handler == signal.SIG_DFL, [signal.SIGTERM]):
        yield


def _ended(returncode: int) -> str:
    return f"signal {signal.Signals(-returncode).name}" if returncode < 0 else f"exit status {returncode}"


@functools.cache
@setting_up()
def _find_compiler(named: str | None, usual: str | None, path: str | None, further: str | None) -> Compiler | None:
    for words in _candidates(named, usual):
        program = shutil.which(words[0], path=path)
        if program is None:
            continue
        try:
            asked, quiet = [program, *words[1:], "--version"], subprocess.DEVNULL
            version = subprocess.run(asked, stdin=quiet, capture_output=True, text=True, errors="replace")
        except OSError:
            continue
        if version.returncode == 0:
            identity = f"{os.path.realpath(program)}\n{version.stdout}{version.stderr}"
            return Compiler((program, *words[1:]), identity, tuple(shlex.split(further or "")))
    return None


def _candidates(named: str | None, usual: str | None) -> Iterator[list[str]]:
    if named and named.strip():
        yield shlex.split(named)
        return
    if usual and usual.strip():
        yield shlex.split(usual)
    yield from (["cc"], ["gcc"], ["clang"])
    if find_spec("ziglang") is not None:
        yield [sys.executable, "-m", "ziglang", "cc"]


@functools.cache
def _processor() -> str:
    """The properties of this processor that -march=native depends on."""
    words = {platform.machine(), platform.processor()}
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    wanted = ("model name", "flags", "features", "cpu implementer", "cpu part", "cpu variant")
    words |= {line for line in lines if line.lower().startswith(wanted)}
    return "\n".join(sorted(words))


def lanes(cpuinfo: str | None = None) -> int:
    """Problems in the lanes of a vector of doubles: 8 where vectors of 512 bits are computed at once, else 4.

    Results are the same. Processors without units of 512 bits, and AMD's up to family 25, compute eight in two steps:
    four take no longer in large batches, and half of the time where fewer problems run. TORCHGCO_LANES overrides.

    Args:
        cpuinfo: the description of a processor; None: of this one.
    """
    if wanted := os.environ.get("TORCHGCO_LANES"):
        return 8 if wanted == "8" else 4
    words = _described(cpuinfo)
    halved = words.get("vendor_id") == "AuthenticAMD" and int(words.get("cpu family", "0")) <= _AMD_HALVES
    return 8 if "avx512f" in words.get("flags", "").split() and not halved else 4


def neurons() -> int:
    """Neurons of a network whose sums are made together, on which their last bits depend: as c/wide.h has it."""
    return 8 if "avx512f" in _described(None).get("flags", "").split() else 4


def _described(cpuinfo: str | None) -> dict[str, str]:
    """The description of a processor by words; None: of this one's first core, or nothing."""
    if cpuinfo is None:
        try:
            with open("/proc/cpuinfo", errors="replace") as file:
                cpuinfo = "".join(itertools.takewhile(str.strip, file))  # the first of its cores
        except OSError:
            return {}
    parts = (line.partition(":") for line in cpuinfo.splitlines())
    return {name.strip(): value.strip() for name, _, value in parts}
