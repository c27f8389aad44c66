"""By the clock of solves, compiling takes no time: every library that is loaded takes an hour of the clocks here."""

import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import torchgco
from tests.problems import planar_batch, quick_gco
from torchgco import Status
from torchgco.base import clock
from torchgco.experiments.config.build import compose
from torchgco.experiments.flying.flight import SolveBatch, Tasks
from torchgco.experiments.flying.progress import NoBar
from torchgco.kernels import choice
from torchgco.native import compiler
from torchgco.roadmap import native_maps

HOUR = 3600.0


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The clocks, which move by loads alone, one entry a load; no library is loaded yet."""
    found, load = list[float](), compiler._load

    def slow(*words: object) -> object:
        found.append(HOUR)
        return load(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(clock, "_left", clock._Left())
    monkeypatch.setattr(clock, "_now", lambda: (sum(found), sum(found)))
    monkeypatch.setattr(compiler, "_load", slow)
    monkeypatch.setattr(compiler, "_loaded", {})
    monkeypatch.setattr(choice, "_engines", {})
    native_maps._library.cache_clear()
    return found


@pytest.mark.sampled(1)
@pytest.mark.parametrize("B", [1, 9])
def test_solves_and_their_limits(B: int, loads: list[float]) -> None:
    """Few problems have libraries of their own."""
    problem, U0 = planar_batch(B=B, N=30, obstacles=9, seed=B)
    began = clock.seconds(), clock.processor_seconds()
    solution = quick_gco(problem).solve(problem, U0, max_seconds=HOUR / 2)
    assert len(loads) >= 2 and (clock.seconds(), clock.processor_seconds()) == began
    assert Status.TIME_LIMIT not in solution.statuses


@pytest.mark.slow
def test_a_comparison(loads: list[float]) -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=5, seed=1)
    table = torchgco.compare(problem, ["gco", "al_ilqr", "mppi"], U0)
    assert len(loads) >= 3 and (table["seconds"] == 0.0).all()


def test_compiled_problems(loads: list[float]) -> None:
    problem, _ = planar_batch(B=2, N=20, obstacles=5, seed=2)
    answer = torchgco.compile(problem)(max_seconds=HOUR / 2)
    assert len(loads) >= 2 and answer.seconds == 0.0 and Status.TIME_LIMIT not in answer.statuses


@pytest.mark.slow
def test_the_rows_of_a_study(loads: list[float]) -> None:
    setup = compose(["scenario=planar_trap", "study.layouts=3"])
    flight = SolveBatch(Tasks(setup, setup.layouts()), range(3), "gco", setup.solver, NoBar())
    flight.compile()
    assert len(loads) >= 2  # the interior point's, too: no process compiles it while another one solves
    rows, _ = flight.fly()
    assert (rows["seconds"] == 0.0).all()


@pytest.mark.slow
def test_missions(loads: list[float]) -> None:
    setup = compose(["experiment=mission", "study.layouts=1", "mission.duration=0.2"])
    assert setup.mission is not None
    log = setup.mission.fly(setup.task().problem, seed=0)
    assert len(loads) >= 2
    for name in ("planner_seconds", "tracker_seconds"):
        assert float(getattr(log, name).nan_to_num(0.0).max()) == 0.0


FIRST_DERIVATIVES = """
import sys
from importlib.abc import MetaPathFinder
import torch
import torchgco
from torchgco import ControlBounds, FreeTime, FunctionCost, FunctionDynamics, Goal, Problem, StateBounds
from torchgco.base import clock

class Slow(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        loads.append(name)

cart = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), -1), n=2, m=1, dt=0.1, integrator="rk4")
limits = [ControlBounds(-1.0, 1.0), StateBounds([-9.0, -1.0], [9.0, 1.0])]
cost, end = FunctionCost(lambda x, u: 0.0 * u[..., 0]), Goal(state=[0.0, 0.0], required=True)
problem, loads = Problem(cart, cost, limits, [[2.0, 0.0]], 20, end, time=FreeTime(0.1, 5.0, 1.0)), []
sys.meta_path.insert(0, Slow())
clock._left, clock._now = clock._Left(), lambda: (3600.0 * len(loads),) * 2
solution = torchgco.solve(problem, max_seconds=1800.0)
print(solution.statuses[0].name, "torch._dynamo" in loads, clock.seconds(), clock.processor_seconds())
"""


@pytest.mark.slow
def test_modules_that_a_first_solve_loads() -> None:
    """PyTorch's first derivatives load some 800 modules: a limit isn't reached by that, in a process of its own."""
    words = [sys.executable, "-W", "ignore", "-c", FIRST_DERIVATIVES]
    done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.stdout.split() == ["CONVERGED", "True", "0.0", "0.0"], done.stderr


def test_blocks_that_load_modules(loads: list[float], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Blocks in each other are left out once, and blocks that load nothing count."""
    (tmp_path / "loaded_by_a_test.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))

    @clock.loading()
    def work(name: str) -> None:
        loads.append(HOUR)
        with clock.loading():
            __import__(name)
            loads.append(HOUR)
        with clock.setting_up(), clock.loading():
            loads.append(HOUR)

    began = clock.seconds()
    work("loaded_by_a_test")
    assert clock.seconds() == began
    work("loaded_by_a_test")
    assert clock.seconds() == began + 2 * HOUR == clock.processor_seconds()


def test_every_thread_has_its_own(loads: list[float]) -> None:
    """What one thread sets up, another one's clock counts; blocks may lie in each other and end with an error."""

    def in_thread(work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()

    def fails() -> None:
        with clock.setting_up(), clock.setting_up():
            loads.append(HOUR)
            raise ValueError

    began, other = clock.seconds(), list[float]()
    in_thread(lambda: other.append(clock.seconds()))
    with pytest.raises(ValueError):
        fails()
    assert clock.seconds() == began
    in_thread(lambda: other.append(clock.seconds()))
    assert other == [began, began + HOUR]
    with clock.setting_up():
        loads.append(HOUR)
        assert clock.seconds() == began
    loads.append(HOUR)
    assert clock.seconds() == began + HOUR
