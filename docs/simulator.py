"""A simulator of one's own for missions, in NumPy alone: `python docs/simulator.py`, then `torchgco ... plant=remote`.

It answers the messages that `torchgco.missions.remote` describes, and needs nothing of torchgco: any language will do.
What it flies is a rigid body with four rotors, the paper's quadrotor; put your own simulator in the place of `step`.
"""

from __future__ import annotations

import argparse
import socket
import struct
from contextlib import suppress

import numpy as np

HEAD = struct.Struct("<4sHHQd")  # letters, version, vehicles, number of the message, time step in s
MASS, GRAVITY, ARM, TORQUE, DRAG = 1.608, 9.81, 0.216, 0.016, 0.01  # kg, m/s^2, m, m, N m s/rad
INERTIA = np.array([[0.0366, 0, 0.0065], [0, 0.0327, 0.0046], [0.0065, 0.0046, 0.0187]])  # kg m^2
LIMITS, TIME_CONSTANT = (0.1046, 6.0), 0.1  # N per rotor, s
SPEED = 5000.0  # rpm at which four rotors carry the weight
COEFFICIENT = MASS * GRAVITY / (4 * SPEED**2)  # N/rpm^2
h = ARM / np.sqrt(2)
ALLOCATION = np.array([[h, -h, -h, h], [-h, -h, h, h], [TORQUE, -TORQUE, TORQUE, -TORQUE]])


def rates(x: np.ndarray, speed: np.ndarray, force: np.ndarray) -> np.ndarray:
    """How states (B, 17) change, for rotor speeds (B, 4), rpm, and forces (B, 3), N."""
    v, q, w, F = np.split(x[:, 3:], (3, 7, 10), axis=1)
    q0, q1, q2, q3 = q.T
    axis = np.stack((2 * (q1 * q3 + q0 * q2), 2 * (q2 * q3 - q0 * q1), q0**2 - q1**2 - q2**2 + q3**2), axis=1)
    a = (F.sum(1, keepdims=True) * axis + force) / MASS - [0, 0, GRAVITY]
    turning = -(q[:, 1:] * w).sum(1, keepdims=True), q[:, :1] * w + np.cross(q[:, 1:], w)
    torque = F @ ALLOCATION.T - np.cross(w, w @ INERTIA.T) - DRAG * w * [0, 0, 1]
    root = np.sqrt(np.maximum(F, 0))
    F_rate = 2 / TIME_CONSTANT * root * (np.sqrt(COEFFICIENT) * speed - root)
    return np.concatenate((v, a, *(0.5 * part for part in turning), torque @ np.linalg.inv(INERTIA).T, F_rate), axis=1)


def step(number: np.ndarray, x: np.ndarray, speed: np.ndarray, force: np.ndarray, dt: float) -> np.ndarray:
    """States (B, 17) of the vehicles with these numbers (B,) a time step later: a step of Runge and Kutta's."""
    speed = np.clip(speed, *np.sqrt(np.array(LIMITS) / COEFFICIENT))
    k1 = rates(x, speed, force)
    k2 = rates(x + dt / 2 * k1, speed, force)
    k3 = rates(x + dt / 2 * k2, speed, force)
    k4 = rates(x + dt * k3, speed, force)
    x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x[:, 6:10] /= np.linalg.norm(x[:, 6:10], axis=1, keepdims=True)
    x[:, 13:] = np.clip(x[:, 13:], *LIMITS)
    return x


def main() -> None:
    """Answer until Ctrl-C."""
    parser = argparse.ArgumentParser(description="A quadrotor that is simulated in NumPy, for plant=remote.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=9870)
    options = parser.parse_args()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind((options.host, options.port))
        print(f"simulator: listens at {options.host}:{line.getsockname()[1]}", flush=True)
        while True:
            data, sender = line.recvfrom(65_536)
            letters, version, count, number, dt = HEAD.unpack_from(data)
            if letters != b"TGCO" or version != 1:
                continue
            rows = np.frombuffer(data, "<f8", offset=HEAD.size).reshape(count, 25)
            vehicle, x, speed, force = np.split(rows, (1, 18, 22), axis=1)
            after = step(vehicle[:, 0], x, speed, force, dt)
            line.sendto(HEAD.pack(letters, version, count, number, dt) + after.astype("<f8").tobytes(), sender)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main()
