"""A plant over UDP: the documented message, the example's simulator, one that is gone or talks otherwise."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.missions.missions import mission, varied
from tests.missions.test_plants import random_states
from torchgco import InputError
from torchgco.missions import Disturbance, RotorPlant
from torchgco.missions.remote import RemotePlant

SIMULATOR = Path(__file__).resolve().parents[2] / "docs" / "simulator.py"
Answer = Callable[[bytes], list[bytes]]


@contextmanager
def answering(answer: Answer) -> Iterator[RemotePlant]:
    """A plant whose messages are answered by a function, in a thread."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        line.settimeout(0.05)
        stop = threading.Event()

        def work() -> None:
            while not stop.is_set():
                try:
                    data, sender = line.recvfrom(65_536)
                except TimeoutError:
                    continue
                for reply in answer(data):
                    line.sendto(reply, sender)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield RemotePlant(port=line.getsockname()[1], timeout=5.0)
        finally:
            stop.set()
            thread.join()


def rotors(data: bytes) -> list[bytes]:
    """What the paper's quadrotor answers, the message taken apart by the table of `remote`."""
    assert data[:4] == b"TGCO" and struct.unpack("<HH", data[4:8])[0] == 1
    count, dt = struct.unpack("<H", data[6:8])[0], struct.unpack("<d", data[16:24])[0]
    rows = torch.frombuffer(bytearray(data[24:]), dtype=torch.float64).reshape(count, 25)
    x = RotorPlant(dt=dt).advance(rows[:, 1:18], rows[:, 18:22], rows[:, 22:])
    return [data[:24] + x.numpy().tobytes()]


def test_a_mission_over_a_socket() -> None:
    """Bit by bit the mission of the same plant in this process, with wind, though answers come twice."""
    problem, windy = varied(3), {"duration": 0.2, "disturbance": Disturbance(wind=0.5)}
    with answering(lambda data: rotors(data) * 2) as plant:
        log = mission(plant=plant, **windy).fly(problem, seed=1)
    assert torch.equal(log.x, mission(**windy).fly(problem, seed=1).x)


def test_vehicles_keep_their_numbers() -> None:
    """In messages of at most 32, also of parts of a batch."""
    sizes, numbers = list[int](), list[float]()

    def heard(data: bytes) -> list[bytes]:
        rows = np.frombuffer(data, "<f8", offset=24).reshape(-1, 25)
        sizes.append(len(rows))
        numbers.extend(rows[:, 0])
        return [data[:24] + np.ascontiguousarray(rows[:, 1:18]).tobytes()]

    x, u, force = random_states(70)
    with answering(heard) as plant:
        assert torch.equal(plant.advance(x, u, force), x) and (sizes, numbers) == ([32, 32, 6], list(range(70)))
        part = plant.take(torch.tensor([5, 9, 33])).take(torch.tensor([0, 2]))
        assert torch.equal(part.advance(x[:2], u[:2], force[:2]), x[:2]) and numbers[70:] == [5, 33]


def test_the_examples_simulator() -> None:
    """A process of its own, which imports nothing of ours, flies as the paper's quadrotor does."""
    assert "import torchgco" not in SIMULATOR.read_text() and "from torchgco" not in SIMULATOR.read_text()
    process = subprocess.Popen([sys.executable, str(SIMULATOR), "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        port = int(process.stdout.readline().rpartition(":")[2])
        plant, (x, u, force) = RemotePlant(port=port, timeout=10.0), random_states(40)
        far = RotorPlant().advance(x, u, force)
        torch.testing.assert_close(plant.advance(x, u, force), far, rtol=1e-10, atol=1e-10)
    finally:
        process.kill()
        process.communicate()


def test_nobody_answers() -> None:
    """One line, within the time."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        port, began = silent.getsockname()[1], time.monotonic()
        with pytest.raises(InputError) as error:
            mission(plant=RemotePlant(port=port, timeout=0.1)).fly(varied(1))
    assert str(error.value) == f"plant: expected an answer of a simulator at 127.0.0.1:{port} within 0.1 s, got none"
    assert time.monotonic() - began < 30
    with pytest.raises(InputError, match="plant: expected an answer of a simulator at"):  # closed by now
        RemotePlant(port=port, timeout=0.1).advance(*random_states(1))


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (lambda data: [b"hello"], "answers with a head of 24 bytes and 17 float64 a vehicle, got 5 bytes"),
        (lambda data: [data[:24] + bytes(8 * 17)], "an answer with 2 vehicles, as it was asked, got 1"),
        (lambda data: [data[:4] + b"\2\0" + data[6:24]], "answers of version 1, got 2"),
    ],
)
def test_another_message(answer: Answer, line: str) -> None:
    with answering(answer) as plant, pytest.raises(InputError, match=line):
        plant.advance(*random_states(2))


@pytest.mark.parametrize("wrong", [{"port": 0}, {"timeout": 0.0}, {"dt": -1.0}])
def test_wrong_options(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError) as error:
        RemotePlant(**wrong)  # type: ignore[arg-type]
    assert error.value.field == f"plant.{next(iter(wrong))}"
