"""What a study draws is what was judged, whether a number stands in the layouts or in the vehicle."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.plotting import straight
from tests.trials import flights, trials
from torchgco import Boxes, Ellipsoids, Moved
from torchgco.dynamics import Dynamics, Unicycle
from torchgco.experiments.flying.flight import Tasks
from torchgco.experiments.reports import report
from torchgco.plotting.layouts import flights_of, layout_grid
from torchgco.plotting.scene import scene_of
from torchgco.plotting.study_figure import study_figure
from torchgco.scenarios import Layouts, Task, Vehicle

L = 6
NUMBERS = ("start", "goal", "vehicle_radius", "goal_radius", "dt", "stages")


@dataclass(frozen=True)
class Backwards(Dynamics):
    """A point whose state begins with its velocity."""

    n, m, integrator, position = 4, 2, "rk4", slice(2, 4)
    dt: float = 0.1

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((u, x[..., :2]), dim=-1)


class Elsewhere(Vehicle):
    """One whose problems begin and end elsewhere than layouts say, among further obstacles of all kinds."""

    def task(self, layouts: Layouts, *where: Any) -> Task:
        task = super().task(layouts, *where)
        problem, radius = task.problem, float(task.problem.obstacles[0].vehicle_radius[0])
        t = torch.linspace(0.0, 1.0, problem.N + 1, dtype=torch.float64)
        moved = Moved(torch.stack((5.0 - 2.0 * t, 5.0 * t), -1).unsqueeze(1), 0.3, radius)
        further = [Boxes([[2.0, 3.0]], [[0.2, 1.0]], radius), Ellipsoids([[3.5, 1.0]], [[0.3, 1.0]], radius), moved]
        parts = [*problem.constraints, *(further if self.name == "further" else [])]
        return replace(task, problem=replace(problem, x0=problem.x0 + 0.5, constraints=parts), goal=task.goal - 1.5)


def drawn(seed: int) -> tuple[Vehicle, Layouts]:
    """A vehicle with numbers of its own, and discs, one of which moves; the layouts have some of the numbers."""
    rng = np.random.default_rng(seed)
    kind, model = (Vehicle, Unicycle) if seed % 2 == 0 else (Elsewhere, Backwards)
    vehicle = kind(
        name="further" if seed >= 4 else "own", dynamics=model(dt=rng.uniform(0.05, 0.3)), state_weight=[1] * 4,
        control_weight=[1, 1], terminal_weight=[1] * 4, control_reference=[0, 0], control_lower=[-2, -2],
        control_upper=[2, 2], start=rng.uniform(-1, 1, 4).tolist(), goal=rng.uniform(4, 6, 4).tolist(),
        radius=rng.uniform(0.1, 0.5), goal_radius=rng.uniform(0.2, 1), stages=int(rng.integers(10, 20)),
    )  # fmt: skip
    given: dict[str, Any] = {
        "start": rng.uniform(-1, 1, (L, 4)), "goal": rng.uniform(4, 6, (L, 4)), "dt": rng.uniform(0.05, 0.3),
        "vehicle_radius": rng.uniform(0.1, 0.5), "goal_radius": rng.uniform(0.2, 1),
        "stages": int(rng.integers(10, 20)),
    }  # fmt: skip
    kept = {name: given[name] for name in NUMBERS if rng.random() < 0.5}
    centers, velocities = rng.uniform(0, 5, (L, 3, 2)), np.zeros((L, 3, 2))
    velocities[:, 0] = rng.uniform(-2, 2, (L, 2))
    return vehicle, Layouts(centers, rng.uniform(0.1, 0.6, (L, 3)), velocities=velocities, **kept)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5, 7])
def test_a_study_draws_what_was_judged(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle, layouts = drawn(seed)
    setup = replace(torchgco.compose(["model=unicycle", "scenario=yard"]), vehicle=vehicle)
    task = vehicle.task(layouts)
    problem, (spheres, *_) = task.problem, task.problem.obstacles
    U = torch.randn(L, problem.N, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    verdict = torchgco.judge(problem, U)
    X = [problem.x0]
    for k in range(problem.N):
        X.append(problem.dynamics.step(X[-1], U[:, k]))
    states = {"gco": straight.ways(torch.stack(X, 1).numpy(), problem.dynamics.dt)}

    layouts.save(tmp_path / "layouts.npz")
    rows = flights("gco", verdict.reached.tolist())
    table = trials(*(row | {"feasible": ok} for row, ok in zip(rows, verdict.feasible.tolist(), strict=True)))
    table.to_parquet(tmp_path / "trials.parquet", index=False)
    np.savez(tmp_path / "solutions.npz", U=U.numpy()[None], solver=np.array(["gco"]))
    shown = []
    for name, draw in (("layout_grid", layout_grid), ("study_figure", study_figure)):

        def keep(arrays: Any, *words: Any, draw: Any = draw, **more: Any) -> Any:
            shown.append((scene_of(arrays, **more), draw(arrays, *words, **more)))
            return shown[-1][1]

        monkeypatch.setattr(report, name, keep)
    monkeypatch.setattr(report, "_draw", lambda folder, name, figure: name[:5] in ("layou", "study") and figure())
    report.write_report(tmp_path, lambda flown, count: states, printed="one", tasks=Tasks(setup, layouts))

    assert len(shown) == 3  # one of them as a png and as a pdf
    at = vehicle.dynamics.position
    for scene, figure in shown:
        np.testing.assert_array_equal(scene.start, problem.x0[:, at])
        np.testing.assert_array_equal(scene.goal, task.goal)
        assert scene.margin == float(spheres.vehicle_radius[0]) and scene.goal_radius == task.goal_radius
        (paths,) = flights_of(scene, states, table).values()
        assert all((flight.path == states["gco"][i].X[:, at]).all() for i, flight in enumerate(paths))
        touching = [len(flight.contacts) > 0 for flight in paths]
        assert touching == (verdict.clearance < 0).tolist()
        words = {text.get_text() for box in figure.legends for text in box.get_texts()}
        assert {"start", "goal and its radius", "contact"} <= words or not any(touching)
        seen = [(len(here), len(scene.others(i))) for i, here in enumerate(scene.bodies)]
        assert seen == [(5, 1) if vehicle.name == "further" else (3, 0)] * L


def test_what_is_unknown_is_not_claimed() -> None:
    """Of layouts alone, without a vehicle, nobody knows what is in contact, nor where a flight was to end."""
    layouts = Layouts(np.array([[[0.0, 0.4]]]), np.array([[0.3]]))
    states = {"gco": np.linspace([[-5.0, 0]], [[5.0, 0]], 9).transpose(1, 0, 2)}
    rows = trials({"solver": "gco", "feasible": False, "reached": False})
    figure = straight.layout_grid(layouts.arrays(), states, rows)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["gco", "infeasible", "obstacle"]
    more = {"vehicle_radius": np.array(0.05), "start": np.array([-5.0, 0]), "goal": np.array([5.0, 0])}
    known = straight.layout_grid(layouts.arrays() | more, states, rows)
    assert "infeasible without contact" in [text.get_text() for text in known.legends[0].get_texts()]
