"""Animations as GIFs: a mission as it is flown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from torchgco.plotting import trajectory as draw
from torchgco.plotting.course import VEHICLE_COLOUR, VIEWS, Course, draw_instant, draw_still, flight, handles
from torchgco.plotting.maps import UNSEEN
from torchgco.plotting.missions import check_plans
from torchgco.plotting.style import DPI, INK, PALETTE, TITLE, legend, tidy

FPS = 5
MAX_FRAMES = 100  # frames of a mission
PALE = "#C8C8C8"  # of what has been before


def mission_animation(
    frame: pd.DataFrame, plans: np.ndarray, course: Course, period: float, path: Path, title: str = ""
) -> Path:
    """Write a GIF of a mission from above and from the side, 5 pictures per second, in real time where 100 suffice.

    Args:
        frame: with columns t and x0 to x2, a row per control step.
        plans: planned positions (K, N+1, 3), m, K at least the frame's rows.
        period: of control steps and of the plan's knots, s.
        title: before the time.

    Raises:
        InputError: as `snapshots_figure`.
    """
    t, track = flight(frame, "t")["t"], course.track(frame)
    check_plans(plans, len(t))
    low, high = course.limits(track)
    spans = (high - low)[1:] / (high - low)[0]
    figure = Figure(figsize=(7.0, 6.2 * float(spans.sum()) + 1.1), layout="constrained")
    axes = list(figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": spans.tolist()}))

    for ax, plane in zip(axes, VIEWS, strict=True):
        draw_still(ax, course, plane)
        draw.frame(ax, low.tolist(), high.tolist(), plane)
        tidy(ax, "", grid=None)
    axes[0].set_xlabel("")
    if more := handles(course, len(course.contacts(track, period)) > 0):
        legend(figure, more)

    def show(step: int) -> str:
        for ax, plane in zip(axes, VIEWS, strict=True):
            draw_instant(ax, course, t[step], track[: step + 1], plans[step], period, plane)
        return f"{title}  {t[step]:.1f} s".strip()

    return write_gif(axes, show, frames_of(len(t), period), path)


def frames_of(count: int, period: float) -> list[int]:
    """Which of `count` instants, each a period after the one before, s, are pictures; the end stays for a second."""
    every = max(1, round(1.0 / (FPS * period)), ceil((count - 1) / (MAX_FRAMES - 2)))
    steps = sorted({*range(0, count, every), count - 1})
    return [*steps, *steps[-1:] * min(FPS, MAX_FRAMES - len(steps))]


def write_gif(
    axes: Sequence[Axes],
    show: Callable[[int], str],
    frames: Sequence[int],
    path: Path,
    colours: Sequence[str] = PALETTE,
) -> Path:
    """Write a GIF of `show(i)` for i in frames, which adds what changes to axes and returns the title of the first.

    What the axes hold before is drawn once; equal neighbours are drawn once. All pictures have one palette without
    dithering: neighbours then differ only where something moved. `colours` are among its colours.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = axes[0].figure
    assert isinstance(figure, Figure)
    figure.set_dpi(DPI)
    canvas, title = FigureCanvasAgg(figure), axes[0].set_title("Mg", fontsize=TITLE, loc="left", color=INK)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the axes stay where they are
    title.set_animated(True)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette(colours))
    pictures = list[Image.Image]()
    for i, before in zip(frames, [None, *frames], strict=False):
        if i == before:
            pictures.append(pictures[-1])
            continue
        canvas.restore_region(still)
        children = [set(ax.get_children()) for ax in axes]
        title.set_text(show(i))
        for ax, known in zip(axes, children, strict=True):
            new = [artist for artist in ax.get_children() if artist not in known]
            for artist in sorted(new, key=lambda artist: artist.get_zorder()):
                ax.draw_artist(artist)
                artist.remove()
        axes[0].draw_artist(title)
        drawn = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
        pictures.append(drawn.quantize(palette=palette, dither=Image.Dither.NONE))
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=1000 // FPS, loop=0, optimize=True)
    return path


def _palette(more: Sequence[str]) -> list[int]:
    """The colours of the drawings, full and paler, as bytes of red, green and blue; the rest is white."""
    times = [draw.NEAR_TO_FAR(share)[:3] for share in np.linspace(0.0, 1.0, 16)]
    full = np.array(
        [to_rgb(colour) for colour in (INK, VEHICLE_COLOUR, draw.CROSS, draw.EDGE, draw.STONE, UNSEEN, PALE, *more)]
    )
    full = np.concatenate((full, times))
    shades = [1.0 - share * (1.0 - full) for share in (1.0, 0.6, 0.3)]
    colours = np.round(255 * np.concatenate((np.ones((1, 3)), *shades))).astype(int)
    return colours.ravel().tolist() + [255] * (3 * (256 - len(colours)))
