"""A plant in another process, or on another machine: states and commands over UDP.

A message is one datagram, little-endian: a head of 24 bytes and a row of float64 for each of its vehicles.

| bytes | head |
|---|---|
| 0 to 3 | the letters `TGCO` |
| 4, 5 | unsigned: version of the message, 1 |
| 6, 7 | unsigned: vehicles in it, at most 32 |
| 8 to 15 | unsigned: number of the message, which the answer repeats |
| 16 to 23 | float64: the time step to be simulated, s |

A row that is sent has 25 numbers: the vehicle's number among the mission's; its state of 17, position (m), velocity
(m/s), quaternion from the body's axes to the world's (scalar first), body rates (rad/s), thrusts of the rotors (N); the
commanded rotor speeds (4, rpm); the force of the wind (3, N, in the world's axes). A row of the answer has the 17 of
the state a time step later.
"""

from __future__ import annotations

import socket
import struct
import time
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from typing import Annotated, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.options import Checked, Seconds, Within
from torchgco.base.tree import Rows

HEAD = struct.Struct("<4sHHQd")
LETTERS, PROTOCOL = b"TGCO", 1
AT_ONCE = 32  # vehicles in a datagram: 6.4 kB, which every system sends in one piece
ANSWERED = 17  # numbers of a row
LARGEST = 65_536  # bytes of a datagram
_numbers = count(1)


@dataclass(frozen=True)
class RemotePlant(Checked, named="plant"):
    """A simulator that answers at an address, as a `Plant`; the module says with what.

    The simulator may hold vehicles by their numbers, or compute each step from the state that it is sent. What it knows
    of a vehicle, such as mass and limits, is its own; it should be what the mission plans with.

    Args:
        host, port: where it listens.
        dt: time step, s.
        timeout: s of a step, after which it counts as gone.
        vehicles: their numbers, int64 (B,); None: 0 to B-1.

    Raises:
        InputError: a field out of its range; on `advance` where nobody answers in time, or with another message.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Within(1, 65_535)] = 9870
    dt: Seconds = 0.01
    timeout: Seconds = 1.0
    vehicles: Tensor | None = None

    def take(self, index: Rows) -> Self:
        """See `Plant`."""
        if self.vehicles is None and not isinstance(index, Tensor):
            raise InputError("plant", "vehicles with numbers, for a slice of them", "none")
        return replace(self, vehicles=index if self.vehicles is None else self.vehicles[index])

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        """See `Plant`."""
        numbers = torch.arange(len(x)) if self.vehicles is None else self.vehicles
        rows = torch.cat((numbers.to(x).unsqueeze(1), x, u, force), dim=1).detach().cpu().numpy().astype("<f8")
        waiting: dict[int, slice] = {}
        end, answer = time.monotonic() + self.timeout, np.empty((len(x), ANSWERED))
        try:
            line = _line(self.host, self.port)
            for first in range(0, len(rows), AT_ONCE):
                vehicles, number = rows[first : first + AT_ONCE], next(_numbers)
                line.send(HEAD.pack(LETTERS, PROTOCOL, len(vehicles), number, self.dt) + vehicles.tobytes())
                waiting[number] = slice(first, first + len(vehicles))
            while waiting:
                line.settimeout(max(end - time.monotonic(), 1e-6))
                number, states = self._read(line.recv(LARGEST))
                if (asked := waiting.pop(number, None)) is not None:  # None: it comes after its time was over
                    wanted = len(rows[asked])
                    if len(states) != wanted:
                        raise InputError("plant", f"an answer with {wanted} vehicles, as it was asked", len(states))
                    answer[asked] = states
        except OSError as error:  # nobody listens, no such host, or no answer in time
            reason = "none" if isinstance(error, TimeoutError) else error
            wanted = f"an answer of a simulator at {self.host}:{self.port} within {self.timeout:g} s"
            raise InputError("plant", wanted, reason) from None
        return torch.from_numpy(answer).to(x)

    def _read(self, data: bytes) -> tuple[int, np.ndarray]:
        """The number of an answer, and its states (b, 17)."""
        if len(data) < HEAD.size or data[:4] != LETTERS or (len(data) - HEAD.size) % (8 * ANSWERED):
            raise InputError("plant", "answers with a head of 24 bytes and 17 float64 a vehicle", f"{len(data)} bytes")
        _, version, _, number, _ = HEAD.unpack_from(data)
        if version != PROTOCOL:
            raise InputError("plant", f"answers of version {PROTOCOL}", version)
        return number, np.frombuffer(data, "<f8", offset=HEAD.size).reshape(-1, ANSWERED)


@cache
def _line(host: str, port: int) -> socket.socket:
    """A socket that talks to this address alone, kept for the process."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    line = socket.socket(family, kind, protocol)
    line.connect(address)
    return line
