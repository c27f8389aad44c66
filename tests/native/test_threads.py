"""A library's functions run on all problems by threads that are kept: after a fork, an interrupt, other numbers."""

from __future__ import annotations

import ctypes
import multiprocessing
import threading
from collections.abc import Iterator

import pytest
import torch

from torchgco.native.engine import run


@pytest.fixture(autouse=True)
def usual() -> Iterator[None]:
    yield
    torch.set_num_threads(1)


class Nothing(ctypes.Structure):
    _fields_ = [("number", ctypes.c_int64)]


class Calls:
    """A function of a library that notes its problems and threads."""

    def __init__(self) -> None:
        self.spans: list[tuple[int, int]] = []
        self.threads: list[threading.Thread] = []

    def __call__(self, _: object, begin: ctypes.c_int64, end: ctypes.c_int64) -> int:
        self.spans.append((begin.value, end.value))
        self.threads.append(threading.current_thread())
        return 1


def test_every_problem_is_worked_on_once_in_whole_groups() -> None:
    for threads in (1, 2, 3, 5, 2):
        torch.set_num_threads(threads)
        for count in (1, 7, 8, 9, 16, 40, 41):
            calls = Calls()
            run(calls, count, 8, Nothing())
            spans = sorted(calls.spans)
            assert [begin for begin, _ in spans] == [0, *(end for _, end in spans[:-1])] and spans[-1][1] == count
            assert all(begin % 8 == 0 for begin, _ in spans) and len(spans) == min(threads, -(-count // 8))


def test_threads_are_kept() -> None:
    torch.set_num_threads(3)
    calls = Calls()
    for _ in range(4):
        run(calls, 24, 8, Nothing())
    assert len(calls.threads) == 12 and len(set(calls.threads)) <= 3 and threading.main_thread() in calls.threads


def in_child(sent) -> None:
    calls = Calls()
    run(calls, 24, 8, Nothing())
    sent.put(sorted(calls.spans))


def test_a_forked_process_has_threads_of_its_own() -> None:
    torch.set_num_threads(3)
    run(Calls(), 24, 8, Nothing())
    context = multiprocessing.get_context("fork")
    sent = context.Queue()
    child = context.Process(target=in_child, args=(sent,))
    child.start()
    assert sent.get(timeout=30) == [(0, 8), (8, 16), (16, 24)]
    child.join(timeout=30)
    assert child.exitcode == 0


def test_an_interrupt_waits_for_what_others_write() -> None:
    torch.set_num_threads(2)
    begun, ended = threading.Event(), threading.Event()

    def call(_: object, begin: ctypes.c_int64, end: ctypes.c_int64) -> int:
        if begin.value == 0:
            assert begun.wait(30)
            raise KeyboardInterrupt
        begun.set()
        ended.wait(0.2)
        ended.set()
        return 1

    with pytest.raises(KeyboardInterrupt):
        run(call, 16, 8, Nothing())
    assert ended.is_set()
    run(Calls(), 16, 8, Nothing())


def test_no_memory_is_said() -> None:
    torch.set_num_threads(2)
    with pytest.raises(MemoryError):
        run(lambda _, begin, end: int(begin.value == 0), 16, 8, Nothing())
