"""Libraries are compiled once, and no damage to the cache folder changes a result."""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from tests.engines import engine_of
from tests.problems import planar_batch
from tests.slow import mostly
from torchgco import kernels, presets
from torchgco.native import compiler, store
from torchgco.native.compiler import NativeError, Unit, build, find_compiler

pytestmark = pytest.mark.usefixtures("cache")

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def source(factor: int) -> str:
    return f"double tgco_times(double x) {{ return {factor}.0 * x; }}"


def times(factor: int, x: float = 3.0) -> float:
    """factor * x, computed by a compiled library."""
    function = build(source(factor)).tgco_times
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double]
    return function(x)


def next_process() -> None:
    """Forget what this process has loaded."""
    compiler._loaded.clear()
    compiler._objects.clear()


@pytest.fixture
def compiled(monkeypatch) -> list[str]:
    """The sources that were compiled."""
    seen, plain = [], compiler._start

    def counting(which, words, room):
        seen.extend([(room / "kernels.c").read_text()] if "-c" in words else [])
        return plain(which, words, room)

    monkeypatch.setattr(compiler, "_start", counting)
    return seen


@needs_compiler
def test_compiled_once(cache: Path, compiled: list[str]) -> None:
    assert times(2) == 6.0 and times(2, 4.0) == 8.0 and len(compiled) == 1
    next_process()
    assert times(2) == 6.0 and len(compiled) == 1
    assert times(5) == 15.0 and times(2) == 6.0 and len(compiled) == 2  # two libraries with one name inside
    assert len(list(cache.iterdir())) == 2


@needs_compiler
def test_flags_make_another_library(compiled: list[str]) -> None:
    text = "int tgco_fast(void) { return\n#ifdef FAST\n 1\n#else\n 0\n#endif\n; }"
    assert [build(text, flags).tgco_fast() for flags in ((), ("-DFAST", "-O2"), ())] == [0, 1, 0]
    assert len(compiled) == 2


@needs_compiler
@pytest.mark.parametrize("harm", ["flipped", "truncated", "empty", "foreign", "renamed", "folder"])
def test_a_bad_entry_is_made_again(cache: Path, compiled: list[str], harm: str) -> None:
    times(7)
    (other,) = cache.iterdir()
    other_content = other.read_bytes()
    next_process()
    times(2)
    (entry,) = set(cache.iterdir()) - {other}
    content = entry.read_bytes()
    entry.unlink()  # the library mapped into this process keeps the old file
    if harm == "flipped":
        entry.write_bytes(content[:5000] + bytes([content[5000] ^ 1]) + content[5001:])
    elif harm == "truncated":
        entry.write_bytes(content[: len(content) // 2])
    elif harm == "empty":
        entry.touch()
    elif harm == "foreign":
        entry.write_bytes(other_content)
    elif harm == "renamed":  # an intact library under the key of another
        key, checksum = entry.name.split("-")[0], other.name.split("-")[1]
        (cache / f"{key}-{checksum}").write_bytes(other_content)
    else:
        entry.mkdir()
    next_process()
    assert times(2) == 6.0 and len(compiled) == 3
    if harm != "folder":
        next_process()  # finds the new entry
        assert times(2) == 6.0 and len(compiled) == 3


@needs_compiler
@pytest.mark.parametrize("place", ["file", "below a file", "nowhere"])
def test_without_a_folder_it_is_compiled_every_time(
    tmp_path: Path, monkeypatch, compiled: list[str], place: str
) -> None:
    (tmp_path / "file").write_text("mine")
    name = {"file": str(tmp_path / "file"), "below a file": str(tmp_path / "file" / "cache"), "nowhere": "/proc/no"}[
        place
    ]
    monkeypatch.setenv("TORCHGCO_CACHE", name)
    for count in (1, 2):
        next_process()
        assert times(2) == 6.0 and len(compiled) == count
    assert (tmp_path / "file").read_text() == "mine"


def disown(place: Path, monkeypatch) -> None:
    """Make another user's what is this one's."""
    if os.geteuid() == 0:
        os.chown(place, 12345, 12345)
    else:
        other = os.geteuid() + 1
        monkeypatch.setattr(store.os, "geteuid", lambda: other)


@needs_compiler
@pytest.mark.parametrize("whose", ["folder of another", "file of another", "open folder", "group folder", "open file"])
def test_what_others_may_have_written_is_not_loaded(cache: Path, monkeypatch, compiled: list[str], whose: str) -> None:
    monkeypatch.setattr(store, "_warned", set())
    times(2)
    (file,) = cache.iterdir()
    place = cache if "folder" in whose else file
    if "of another" in whose:
        disown(place, monkeypatch)
    else:
        place.chmod({"open folder": 0o757, "group folder": 0o775, "open file": 0o646}[whose])
    before = file.read_bytes()
    next_process()
    with pytest.warns(store.CacheWarning) as told:
        assert times(2) == 6.0 and len(compiled) == 2
    expected = "belongs to another user" if "of another" in whose else f"can be written by others (chmod go-w {place})"
    assert len(told) == 1 and str(place) in str(told[0].message) and expected in str(told[0].message)
    assert file.read_bytes() == before
    if "folder" in whose:  # nothing is written there
        assert list(cache.iterdir()) == [file] and times(3) == 9.0 and list(cache.iterdir()) == [file]


@needs_compiler
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_a_folder_that_root_shares_is_read(cache: Path, monkeypatch, compiled: list[str]) -> None:
    times(2)
    next_process()
    monkeypatch.setattr(store.os, "geteuid", lambda: 12345)
    assert times(2) == 6.0 and len(compiled) == 1


@needs_compiler
def test_a_full_disk(monkeypatch, cache: Path) -> None:
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store.os, "replace", full)
    assert times(2) == 6.0 and list(cache.iterdir()) == []


@needs_compiler
def test_a_folder_that_libraries_cannot_be_loaded_from(monkeypatch, cache: Path) -> None:
    plain = ctypes.CDLL

    def forbidding(name: str) -> ctypes.CDLL:
        if name.startswith(str(cache)):
            raise OSError("failed to map segment from shared object")
        return plain(name)

    monkeypatch.setattr(compiler.ctypes, "CDLL", forbidding)
    for _ in range(2):
        next_process()
        assert times(2) == 6.0


def at_once(barrier, results) -> None:
    barrier.wait()
    results.put((times(2), times(3)))


@pytest.mark.slow
@needs_compiler
def test_eight_processes_at_once(cache: Path, compiled: list[str]) -> None:
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(8), context.Queue()
    processes = [context.Process(target=at_once, args=(barrier, results)) for _ in range(8)]
    for process in processes:
        process.start()
    assert [results.get(timeout=60) for _ in processes] == [(6.0, 9.0)] * 8
    for process in processes:
        process.join()
    assert not list(cache.glob("*.part"))
    assert times(2) == 6.0 and times(3) == 9.0 and not compiled


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_in_children(method: str) -> None:
    assert times(2) == 6.0
    context = multiprocessing.get_context(method)
    with context.Pool(2) as pool:
        assert pool.starmap(times, [(2, 1.0), (3, 1.0), (2, 4.0), (3, 4.0)]) == [2.0, 3.0, 8.0, 12.0]
    assert times(3) == 9.0


# A compiler that starts a process, as gcc does, and waits for it; both write their numbers.
SLOW = """#!/bin/sh
case "$*" in *--version*) echo slow 1.0; exit;; esac
sleep 300 &
echo $$ $! > {numbers}.part
mv {numbers}.part {numbers}
wait
"""
COMPILING = "from torchgco.native.compiler import build; build('int tgco_one(void) { return 1; }')"
# On a busy machine the compiler may be at work before Python, which started it, goes on.
LATE = """import os, subprocess, time
class Late(subprocess.Popen):
    def __init__(self, words, **options):
        super().__init__(words, **options)
        while "kernels.c" in words and not os.path.exists({numbers!r}):
            time.sleep(0.01)
        if "kernels.c" in words:
            os.kill(os.getpid(), {how:d})
subprocess.Popen = Late
"""


def alive(number: int) -> bool:
    """Whether a process runs, and isn't just waiting to be collected."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc")
@pytest.mark.parametrize("how", mostly([signal.SIGINT, signal.SIGTERM], signal.SIGTERM))
@pytest.mark.parametrize("late", mostly([False, True], True), ids=["while it runs", "before Python goes on"])
def test_an_interrupt_ends_the_compiler_and_what_it_started(late: bool, how: signal.Signals, tmp_path: Path) -> None:
    """The signal reaches Python alone, as from a scheduler, a notebook or a test."""
    numbers, script = tmp_path / "numbers", tmp_path / "slow"
    script.write_text(SLOW.format(numbers=numbers))
    script.chmod(0o755)
    environment = {**os.environ, "TORCHGCO_CC": str(script), "TORCHGCO_CACHE": str(tmp_path / "cache")}
    code = (LATE.format(numbers=str(numbers), how=how) if late else "") + COMPILING
    process = subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, cwd=Path(__file__).parents[2]
    )
    while not numbers.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    started = [int(word) for word in numbers.read_text().split()]
    if not late:
        assert all(map(alive, started))
        process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode == -how
    deadline = time.monotonic() + 30
    while any(map(alive, started)) and time.monotonic() < deadline:
        time.sleep(0.01)
    left = [number for number in started if alive(number)]
    for number in left:
        os.kill(number, signal.SIGKILL)
    assert not left


@pytest.mark.parametrize("word", ["none", "/no/such/cc -O2", "false"])
def test_no_compiler(monkeypatch, word: str) -> None:
    monkeypatch.setenv("TORCHGCO_CC", word)
    assert find_compiler() is None
    with pytest.raises(NativeError, match="no C compiler"):
        build(source(2))


def test_where_compilers_are_looked_for(monkeypatch, tmp_path: Path) -> None:
    def script(name: str) -> str:
        path = tmp_path / name
        path.write_text(f"#!/bin/sh\necho {name} 1.0 $*\n")
        path.chmod(0o755)
        return str(path)

    monkeypatch.delenv("TORCHGCO_CC", raising=False)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    monkeypatch.setenv("CC", "missing")
    cc, own, usual = script("cc"), script("own"), script("usual")
    assert find_compiler().command == (cc,)
    monkeypatch.setenv("CC", "usual -m64")
    assert find_compiler().command == (usual, "-m64")
    assert find_compiler().identity.strip() == f"{usual}\nusual 1.0 -m64 --version"
    monkeypatch.setenv("TORCHGCO_CC", own)
    assert find_compiler().command == (own,)


@pytest.mark.skipif(find_spec("ziglang") is None, reason="no ziglang")
def test_zig(monkeypatch) -> None:
    monkeypatch.setenv("TORCHGCO_CC", f"{sys.executable} -m ziglang cc")
    assert times(2) == 6.0


# What the extra `native` promises: whole kernels, not only a line of C.
@pytest.mark.sampled(1)
@pytest.mark.parametrize("command", ["clang", f"{sys.executable} -m ziglang cc"])
def test_clang_and_zig_compile_the_kernels(monkeypatch, command: str) -> None:
    monkeypatch.setenv("TORCHGCO_CC", command)
    if find_compiler() is None:
        pytest.skip(f"no {command}")
    problem, U0 = planar_batch(B=3, N=12, obstacles=2)
    assert engine_of(problem) is not None
    solution, solver = presets.al_ilqr(problem).solve(problem, U0), presets.al_ilqr(problem)
    kernels.use_native(False)
    try:
        torch.testing.assert_close(solution.cost, solver.solve(problem, U0).cost, rtol=1e-6, atol=0.0)
    finally:
        kernels.use_native(True)


def test_old_files_go_and_used_ones_stay(cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(store, "FILES", 5)
    keys = [store.key_of(("key", str(i))) for i in range(8)]
    for i, key in enumerate(keys[:5]):
        path = store.save(key, ".json", b"%d" % i)
        os.utime(path, (1000.0 + i, 1000.0 + i))
    (cache / "mine-and-old.txt").write_text("")
    (cache / "torchgco-killed.part").write_text("")
    for name in ("mine-and-old.txt", "torchgco-killed.part"):
        os.utime(cache / name, (0.0, 0.0))
    assert store.read(keys[0], ".json") == b"0"  # now the most recently used
    store.save(keys[5], ".json", b"5")
    store.save(keys[6], ".json", b"6")
    assert [store.read(key, ".json") for key in keys] == [b"0", None, None, b"3", b"4", b"5", b"6", None]
    assert (cache / "mine-and-old.txt").exists() and not (cache / "torchgco-killed.part").exists()


def test_the_cache_folder(monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    monkeypatch.setenv("TORCHGCO_CACHE", "/here")
    assert store.folder() == Path("/here")
    monkeypatch.delenv("TORCHGCO_CACHE")
    assert store.folder() == Path("/somewhere/torchgco")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert store.folder() == Path.home() / ".cache/torchgco"


def test_keys_distinguish_their_parts() -> None:
    assert store.key_of(("ab", "c")) != store.key_of(("a", "bc")) != store.key_of(("abc",))


PROCESSOR = "vendor_id : {}\ncpu family : {}\nflags : fpu avx2{}\n"


@pytest.mark.parametrize(
    ("described", "expected"),
    [
        (PROCESSOR.format("GenuineIntel", 6, " avx512f"), 8),
        (PROCESSOR.format("GenuineIntel", 6, ""), 4),
        (PROCESSOR.format("AuthenticAMD", 25, " avx512f"), 4),
        (PROCESSOR.format("AuthenticAMD", 26, " avx512f"), 8),
        ("Features : fp asimd\n", 4),
        ("", 4),
    ],
)
def test_lanes_are_those_that_a_processor_computes_at_once(monkeypatch, described: str, expected: int) -> None:
    monkeypatch.delenv("TORCHGCO_LANES", raising=False)
    assert compiler.lanes(described) == expected
    monkeypatch.setenv("TORCHGCO_LANES", str(12 - expected))
    assert compiler.lanes(described) == 12 - expected


WIDTH = """
import dataclasses, hashlib, torch
from tests.problems import planar_batch
from torchgco import presets
from torchgco.native.codegen.source import LANES
torch.set_num_threads(1)
problem, U0 = planar_batch(5)
sampled = dataclasses.replace(presets.mppi(problem), iterations=3)
halved = dataclasses.replace(sampled, sampler=dataclasses.replace(sampled.sampler, dtype="float32"))
said = [LANES]
for solver in (presets.gco(problem), sampled, halved):
    solution = solver.solve(problem, U0, seed=3)
    said += [hashlib.sha256(solution.U.numpy().tobytes()).hexdigest(), solution.status.tolist()]
print(*said)
"""


@needs_compiler
@pytest.mark.slow
def test_results_have_the_same_bits_in_any_number_of_lanes() -> None:
    said = []
    for width in ("4", "8"):
        call = [sys.executable, "-c", WIDTH]
        done = subprocess.run(
            call, env={**os.environ, "TORCHGCO_LANES": width}, capture_output=True, text=True, check=True
        )
        said.append(done.stdout.split(" ", 1))
    assert [width for width, _ in said] == ["4", "8"] and said[0][1] == said[1][1]


NOTED = """#!/bin/sh
case "$*" in *--version*|*-shared*) exec {real} "$@";; esac
echo begin >> {log}
{real} "$@"
status=$?
echo end >> {log}
exit $status
"""
BOTH = """
import torch, torchgco
from tests.problems import planar_batch
problem, U0 = planar_batch(8, N=10)  # for fewer problems the interior point's library has fewer lanes
torchgco.solve(problem, U0, solver="interior_point")
"""


@pytest.mark.slow
@needs_compiler
def test_both_libraries_are_compiled_at_the_same_time(tmp_path: Path) -> None:
    """All units of both have begun before the first one has ended, and the model's is compiled once."""
    found = find_compiler()
    assert found is not None
    log, script = tmp_path / "log", tmp_path / "cc"
    script.write_text(NOTED.format(real=" ".join(found.command), log=log))
    script.chmod(0o755)
    environment = {**os.environ, "TORCHGCO_CC": str(script), "TORCHGCO_CACHE": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", BOTH], env=environment, check=True)
    assert log.read_text().split() == ["begin"] * 4 + ["end"] * 4


@needs_compiler
def test_a_compiler_that_has_begun_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, cache: Path, compiled: list[str]
) -> None:
    monkeypatch.setattr(compiler, "_begun", {})  # what other tests have begun may not have ended
    unit = Unit(source(7), own=True)
    compiler.begin((unit,))
    compiler.begin((unit,), (unit,))
    assert len(compiler._begun) == 1 and times(7) == 21.0 and len(compiled) == 1 and not compiler._begun
    compiler.begin((unit,))  # it is loaded
    next_process()
    compiler.begin((unit,))  # it is in the cache
    assert not compiler._begun and times(7) == 21.0 and len(compiled) == 1
    compiler.begin((Unit("no C", own=True),))
    with pytest.raises(NativeError, match="error"):
        build("no C")
