"""How far colours are apart for eyes: with all cones, and by simulation without one kind of them."""

from __future__ import annotations

import numpy as np

# Machado, Oliveira, Fernandes 2009, "A Physiologically-based Model for Simulation of Color Vision Deficiency", for a
# kind of cones that is missing (severity 1.0): https://doi.org/10.1109/TVCG.2009.113. They act on linear RGB.
VISION = {
    "trichromat": np.eye(3),
    "protanope": np.array([
        [0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998],
    ]),
    "deuteranope": np.array([
        [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881],
    ]),
    "tritanope": np.array([
        [1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900],
    ]),
}  # fmt: skip
# Petroff 2021, "Accessible Color Sequences for Data Visualization" (arXiv:2107.02270), asks for this distance of the
# same simulations for six colours, for less (18, 16) of more.
APART = 20.0
GRAPHIC, TEXT = 3.0, 4.5  # contrasts that WCAG 2.2 asks for in 1.4.11 and 1.4.3

TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
CAT02 = np.array([[0.7328, 0.4296, -0.1624], [-0.7036, 1.6975, 0.0061], [0.0030, 0.0136, 0.9834]])
CONES = np.array([[0.38971, 0.68898, -0.07868], [-0.22981, 1.18340, 0.04641], [0.0, 0.0, 1.0]])
WHITE = np.array([95.047, 100.0, 108.883])


def linear(colour: str) -> np.ndarray:
    """Linear RGB (3,) of "#rrggbb"."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def contrast(first: str, second: str) -> float:
    """Between 1 and 21, as WCAG defines it."""
    light = sorted(float(TO_XYZ[1] @ linear(colour)) for colour in (first, second))
    return (light[1] + 0.05) / (light[0] + 0.05)


def apart(first: str, second: str, vision: str) -> float:
    """The distance of two colours in CAM02-UCS."""
    seen = [np.clip(VISION[vision] @ linear(colour), 0, 1) for colour in (first, second)]
    return float(np.linalg.norm(_uniform(seen[0]) - _uniform(seen[1])))


def _uniform(rgb: np.ndarray) -> np.ndarray:
    """J', a', b' of linear RGB: CIECAM02 in the surround of sRGB's standard (La 64/5/pi cd/m^2, a background of 20)."""
    La, Yb, F, c, Nc = 64 / np.pi / 5, 20.0, 1.0, 0.69, 1.0
    n = Yb / WHITE[1]
    k = 1 / (5 * La + 1)
    FL = 0.2 * k**4 * 5 * La + 0.1 * (1 - k**4) ** 2 * np.cbrt(5 * La)
    Nbb, z = 0.725 * n**-0.2, 1.48 + np.sqrt(n)
    D = F * (1 - np.exp((-La - 42) / 92) / 3.6)
    sensed_white = CAT02 @ WHITE

    def response(xyz: np.ndarray) -> np.ndarray:
        adapted = (D * WHITE[1] / sensed_white + 1 - D) * (CAT02 @ xyz)
        cones = CONES @ np.linalg.inv(CAT02) @ adapted
        power = (FL * np.abs(cones) / 100) ** 0.42
        return np.sign(cones) * 400 * power / (power + 27.13) + 0.1

    r, g, b = response(100 * TO_XYZ @ rgb)
    achromatic = lambda r, g, b: (2 * r + g + b / 20 - 0.305) * Nbb
    a, b_ = r - 12 * g / 11 + b / 11, (r + g - 2 * b) / 9
    h = np.arctan2(b_, a)
    J = 100 * (max(achromatic(r, g, b), 0.0) / achromatic(*response(WHITE))) ** (c * z)
    t = 50000 / 13 * Nc * Nbb * (np.cos(h + 2) + 3.8) / 4 * np.hypot(a, b_) / (r + g + 1.05 * b)
    M = t**0.9 * np.sqrt(J / 100) * (1.64 - 0.29**n) ** 0.73 * FL**0.25
    M = np.log1p(0.0228 * M) / 0.0228
    return np.array([1.7 * J / (1 + 0.007 * J), M * np.cos(h), M * np.sin(h)])
