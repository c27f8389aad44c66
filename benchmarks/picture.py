"""README's first picture: a mission through a wood in perspective, taken from its page by a headless Chromium.

python -m benchmarks.picture          # flies the mission, and writes benchmarks/woods.jpg
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from benchmarks.lib.studies import torchgco
from torchgco.experiments.reports.view import write_view

PICTURE = Path(__file__).parent / "woods.jpg"
MISSION = ("experiment=mission", "scenario=woods", "study.figures=false")
# Behind the vehicle after 3 s: azimuth, elevation (degrees), distance (share of the scene), and where the camera looks.
ADDRESS = "picture&time=3&cut=0.72&camera=212,24,0.40,9.5,2.2,0.4"
SIZE, SCALE = (1400, 640), 2  # pixels of the picture, and how much finer it is drawn before it is made smaller
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
    "--hide-scrollbars", "--virtual-time-budget=30000",
)  # fmt: skip


def take(page: Path, address: str, picture: Path, size: tuple[int, int] = SIZE) -> None:
    """Take a picture of a page that `torchgco-view` wrote; raises where there is no Chromium."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        raise FileNotFoundError("no Chromium, which draws the page")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        shot = Path(folder) / "shot.png"
        size_flags = [f"--window-size={size[0]},{size[1]}", f"--force-device-scale-factor={SCALE}"]
        command = [browser, *FLAGS, *size_flags, f"--user-data-dir={folder}/profile", f"--screenshot={shot}"]
        subprocess.run([*command, f"{page.resolve().as_uri()}#{address}"], check=True, capture_output=True)
        with Image.open(shot) as drawn:
            drawn.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(picture, quality=88, optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.picture", description="README's first picture.")
    parser.add_argument("--run", metavar="DIR", type=Path, help="a mission that was flown before; default: fly it")
    parser.add_argument("--output", metavar="FILE", type=Path, default=PICTURE)
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or Path(folder)
        if options.run is None:
            torchgco(*MISSION, f"hydra.run.dir={run}")
        take(write_view(run, Path(folder) / "page.html"), ADDRESS, options.output)
    print(f"{options.output}: {options.output.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
