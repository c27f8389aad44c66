"""What all benchmarks share: families of layouts, peers, pages and their origin."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA, RESULTS = ROOT / "benchmarks" / "data", ROOT / "benchmarks" / "results"
