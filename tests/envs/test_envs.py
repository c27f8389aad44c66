"""Missions as environments: Gymnasium's own checks, its own autoreset, and the loop that missions fly in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.engines import compiled
from tests.missions.missions import SOLVER, far, mission, scene, varied
from torchgco import Airframe, InputError, Problem
from torchgco.exploration import SensorMission
from torchgco.missions import Disturbance, Flight, Outcome, Planner, RotorPlant
from torchgco.missions.planning_problem import planning_state
from torchgco.scenarios import Mazes, Vehicle

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402

from torchgco.envs import MissionEnv, MissionVectorEnv, PlannerPolicy  # noqa: E402
from torchgco.envs.episodes import rotation, surroundings  # noqa: E402

REST = np.array([0.0, 0.0, 0.0, 9.81], np.float32)


def between() -> Problem:
    """Goals 0.31 m away, which vehicles that tilt reach, and spheres that they touch on the other side."""
    centers = torch.tensor([[[-0.48, 0.0, 0.0]], [[0.0, -0.48, 0.0]]], dtype=torch.float64)
    return scene(centers, goal=0.4, N=10)


def driven(env: Any, steps: int, seed: int = 3) -> list[Any]:
    """What an environment returns for a reset and for actions of a seed."""
    rng, results = np.random.default_rng(seed), [env.reset(seed=[seed] * env.num_envs)]
    for _ in range(steps):
        results.append(env.step(REST + rng.normal(size=(env.num_envs, 4)).astype(np.float32) * [3, 3, 1, 3]))
    return results


def same(mine: Any, theirs: Any) -> bool:
    """Whether two results of an environment are equal in every bit."""
    if isinstance(mine, dict):
        return set(mine) == set(theirs) and all(same(mine[name], theirs[name]) for name in mine)
    if isinstance(mine, tuple):
        return len(mine) == len(theirs) and all(map(same, mine, theirs))
    if mine.dtype == object:
        return all(a is b is None or np.array_equal(a, b) for a, b in zip(mine, theirs, strict=True))
    return mine.dtype == theirs.dtype and np.array_equal(mine, theirs)


@pytest.mark.parametrize("control", ["rates", "rotors"])
@pytest.mark.filterwarnings("ignore:.*(symmetric and normalized|infinity)")  # ours have units, and no bounds
def test_gymnasium_finds_no_fault(control: Any) -> None:
    check_env(MissionEnv(problem=far(), mission=mission(duration=0.5), control=control), skip_render_check=True)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_autoreset_is_gymnasiums(mode: AutoresetMode) -> None:
    """Bit by bit as single environments in Gymnasium's own vector, with episodes that end in every way."""
    options: dict[str, Any] = {
        "problem": between(),
        "mission": mission(duration=0.45, goal_radius=0.3, disturbance=Disturbance(gust=3.0, position_noise=0.01)),
    }
    mine = driven(MissionVectorEnv(3, autoreset_mode=mode, **options), 12)
    single = [lambda i=i: MissionEnv(i, **options) for i in range(3)]
    theirs = driven(SyncVectorEnv(single, autoreset_mode=mode), 12)
    assert all(map(same, mine, theirs))
    infos = [info.get("final_info", info) for *_, info in mine]
    ended = {int(outcome) for info in infos for outcome in info["outcome"][info["_outcome"]]}
    assert ended >= {-1, Outcome.REACHED, Outcome.COLLISION, Outcome.TIMEOUT}


@pytest.mark.parametrize("plant", [RotorPlant(), RotorPlant(mass_error=torch.tensor([0.1, -0.1]))])
def test_the_loop_is_the_missions(plant: RotorPlant) -> None:
    """Bit by bit as a flight along plans of two knots, with wind and noise."""
    problem, flown = varied(2), mission(duration=0.4, plant=plant, disturbance=Disturbance(wind=1.0, rate_noise=0.01))
    env = MissionVectorEnv(6, problem, flown, ids=range(4, 10))
    env.reset(seed=8, options={"layout": np.array([1, 0, 1, 1, 1, 0])})
    episodes, rows = env.episodes, torch.tensor([1, 3])  # one of each problem
    seeds = torch.Generator().manual_seed(0)
    episodes._noise[rows], episodes._force[rows] = (torch.randn(2, 9, n, generator=seeds).double() for n in (13, 3))
    episodes._noise *= 0.01
    flight = Flight(flown, problem)
    flight.noise, flight.force = episodes._noise[rows], episodes._force[rows]
    for action in np.random.default_rng(1).normal(size=(8, 6, 4)).astype(np.float32):
        action += REST
        X = planning_state(episodes.measured()[rows], episodes.airframe).unsqueeze(1).repeat(1, 2, 1)
        X[..., 10:] = torch.from_numpy(action[rows]).unsqueeze(1)
        seen, *_ = env.step(action)
        flight.step(X)
        assert torch.equal(episodes.x[rows], flight.x)
        way = (flight.goal - flight.x[:, :3]).float().numpy()
        np.testing.assert_allclose(seen[rows, :3], way, atol=0.2)  # as measured, with noise


def test_episodes_end_as_missions_are_judged() -> None:
    """In contact, at the goal, at the end of the time and lost; observations stay finite, rewards say which."""
    centers = torch.tensor([[[0.0, 0, 0.7]], [[9.0, 0, 9]], [[9.0, 0, 9]], [[9.0, 0, 9]]], dtype=torch.float64)
    problem = scene(centers, goal=0.5, N=10)
    env = MissionVectorEnv(4, problem, mission(duration=0.6, goal_radius=0.3), ids=range(4))
    env.reset(seed=0, options={"layout": np.arange(4)})
    env.episodes.x[1, 3] = 5.0  # m/s, towards the goal
    ended, rewards = np.full(4, -1), np.zeros(4)
    for k in range(12):
        if k == 3:
            env.episodes.x[3, 4] = 1e6  # m/s
        flying = ended == -1
        seen, reward, terminated, truncated, info = env.step(REST + np.float32([[0, 0, 0, 5]] + [[0] * 4] * 3))
        assert np.isfinite(seen).all() and np.array_equal(terminated | truncated, flying & (info["outcome"] != -1))
        ended, rewards = np.where(flying, info["outcome"], ended), rewards + np.where(flying, reward, 0)
    assert ended.tolist() == [Outcome.COLLISION, Outcome.REACHED, Outcome.TIMEOUT, Outcome.DIVERGED]
    assert rewards == pytest.approx([-10, 10.3, 0, -10], abs=0.35)


def test_without_autoreset_what_has_ended_rests() -> None:
    """It repeats how it has ended, until it is reset; the others fly on."""
    env = MissionVectorEnv(2, far(2), mission(duration=0.2, goal_radius=0.3), autoreset_mode="Disabled")
    env.reset(seed=0)
    env.episodes.x[0, 0] = 1.9  # m, in the goal
    results = [env.step(np.tile(REST, (2, 1))) for _ in range(6)]
    assert [terminated.tolist() for _, _, terminated, _, _ in results] == [[True, False]] * 6
    assert [truncated.tolist() for _, _, _, truncated, _ in results] == [[False, k >= 3] for k in range(6)]
    assert results[5][4]["outcome"].tolist() == [Outcome.REACHED, Outcome.TIMEOUT]
    assert results[5][1].tolist() == [0, 0] and np.array_equal(results[5][0], results[3][0])
    _, info = env.reset(options={"reset_mask": np.array([True, False])})
    assert info["_outcome"].tolist() == [True, False] and info["outcome"][0] == -1
    *_, terminated, truncated, _ = env.step(np.tile(REST, (2, 1)))
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [False, True])


def test_the_vehicle_as_it_is_observed() -> None:
    """Its components have names and units; the rotation turns the body's axes as SciPy's does."""
    env = MissionVectorEnv(3, varied(3), mission(), nearest=2)
    seen, _ = env.reset(seed=1)
    assert len(env.observation_names) == len(env.observation_units) == seen.shape[1] == 27
    assert env.observation_names[-1] == "obstacle 2 distance" and env.observation_units[3:6] == ("m/s",) * 3
    named = dict(zip(env.observation_names, seen[0].tolist(), strict=True))
    assert named["goal x"] == 2.0 and named["Rxx"] == named["Rzz"] == 1.0 and named["a"] == pytest.approx(9.81)
    assert (env.action_names, env.action_units) == (("wx", "wy", "wz", "a"), ("rad/s", "rad/s", "rad/s", "m/s^2"))
    q = torch.randn(5, 4, generator=torch.Generator().manual_seed(0)).double()
    q = q / q.norm(dim=1, keepdim=True)
    np.testing.assert_allclose(rotation(q), Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix(), atol=1e-12)


def test_obstacles_as_they_are_observed() -> None:
    """Nearest first, where spheres are by hand; absent and far ones have the direction 0."""
    p = torch.tensor([[0.3, 0.2, -0.1], [1.0, 0.0, 0.0]], dtype=torch.float64)
    problem = varied(2)
    seen = surroundings(p, [problem.constraints[0]], 4, sight=1.5)
    for b in range(2):
        spheres = [c for c in problem.constraints[0].centers[b][~problem.constraints[0].absent[b]]]
        found = sorted(((float((c - p[b]).norm()) - 0.5, c - p[b]) for c in spheres), key=lambda pair: pair[0])
        for k in range(4):
            distance, way = found[k] if k < len(found) else (9.0, torch.zeros(3))
            near = distance < 1.5
            assert float(seen[b, k, 3]) == pytest.approx(distance if near else 1.5)
            toward = way / way.norm() if near else torch.zeros(3)
            torch.testing.assert_close(seen[b, k, :3], toward.double(), atol=1e-6, rtol=0)
    assert surroundings(p, [], 1, 3.0).tolist() == [[[0, 0, 0, 3]]] * 2


def test_walls_are_observed() -> None:
    """Boxes of a maze: the direction leads to the surface, whose distance is then the vehicle's radius."""
    problem = Vehicle.quadrotor().among(Mazes(), range(2)).problem
    obstacles = [part for part in problem.constraints if hasattr(part, "signed_distance") and part.absent.shape[1] > 0]
    p = problem.x0[:, :3] + torch.tensor([1.0, 0.3, 0.2])
    seen = surroundings(p, obstacles, 3, 30.0)
    there = p.unsqueeze(1) + seen[..., :3] * seen[..., 3:]
    for b in range(2):
        d = torch.cat([part.signed_distance(there, torch.zeros(3).double()) for part in obstacles], -1)[b]
        assert bool((d.abs().amin(-1) < 1e-4).all()), d


def test_the_planner_is_a_policy() -> None:
    """Its first action is what its plan has two periods later; where an episode begins anew, it plans anew."""
    problem, flown = varied(3), mission(duration=0.3)
    env = MissionVectorEnv(3, problem, flown, autoreset_mode="Disabled")
    policy = PlannerPolicy(env)
    env.reset(seed=2, options={"layout": np.arange(3)})
    plan = Flight(flown, problem).step().plan
    action = policy()
    np.testing.assert_allclose(action, plan.X[:, 2, 10:], rtol=1e-6)
    away = np.linalg.norm(problem.x0[:, :3] - env.episodes.goal, axis=1)
    for _ in range(5):
        *_, info = env.step(action)
        action = policy()
    assert (info["distance"] < away - 1e-3).all() and not env.waiting.any()
    env.reset(options={"reset_mask": np.array([False, True, False]), "layout": np.arange(3)})
    again = policy()
    np.testing.assert_allclose(again[1], plan.X[1, 2, 10:], rtol=1e-6)
    assert not np.allclose(again[0], plan.X[0, 2, 10:])


def test_seeds() -> None:
    """Missions are drawn from (seed, id): in any vector the same, and others for other ids and seeds."""
    options: dict[str, Any] = {"problem": far(50), "mission": mission()}
    whole, part = MissionVectorEnv(6, **options), MissionVectorEnv(2, ids=[4, 1], **options)
    single = MissionEnv(4, **options)
    assert single.reset(seed=0)[1]["layout"] == whole.reset(seed=0)[1]["layout"][4]
    assert single.reset(options={"layout": 7})[1]["layout"] == 7
    layouts = [[env.reset(seed=seed)[1]["layout"].tolist() for seed in (0, 1)] for env in (whole, part)]
    assert [[found[4], found[1]] for found in layouts[0]] == layouts[1]
    assert len(set(layouts[0][0])) > 3 and layouts[0][0] != layouts[0][1]
    first = whole.reset(seed=0)[1]["layout"].tolist()
    assert whole.reset()[1]["layout"].tolist() != first == layouts[0][0]
    assert whole.reset(seed=[0, 0, 0, 0, 7, 0])[1]["layout"].tolist()[:4] == first[:4]


def test_by_name() -> None:
    """What is made by name, in the bounds of an own vehicle."""
    task = Vehicle.quadrotor(Airframe(mass=1.2, thrust_max=4.5)).among(Mazes(), range(2))
    env = gymnasium.make_vec("torchgco.envs:torchgco/Mission-v0", num_envs=2, problem=task.problem, control="rotors")
    assert isinstance(env, MissionVectorEnv) and env.spec is not None and env.spec.id == "torchgco/Mission-v0"
    assert env.single_action_space.high == pytest.approx(5000 * np.sqrt(4.5 / (1.2 * 9.81 / 4)), rel=1e-6)
    assert isinstance(gymnasium.make("torchgco/Mission-v0", problem=task.problem).unwrapped, MissionEnv)


def _stepped(**options: Any) -> MissionVectorEnv:
    env = MissionVectorEnv(2, problem=far(2), mission=mission(), **options)
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        (lambda: MissionVectorEnv(2, problem=varied(2, moving=True), mission=mission()), "problem.constraints"),
        pytest.param(
            lambda: MissionVectorEnv(2, problem=far(), mission=SensorMission(Planner(SOLVER), sensor="lidar")),
            "mission",
            marks=compiled,
        ),
        (lambda: MissionVectorEnv(2, problem=far(), mission=mission(latency=1)), "mission"),
        (lambda: MissionVectorEnv(2, problem=scene(torch.zeros(1, 1, 3).double())), "problem.x0"),
        (lambda: MissionVectorEnv(0, problem=far()), "num_envs"),
        (lambda: MissionVectorEnv(2, problem=far(), ids=[1]), "ids"),
        (lambda: MissionVectorEnv(2, problem=far(), control="thrusts"), "control"),  # type: ignore[arg-type]
        (lambda: MissionVectorEnv(2, problem=far(), nearest=-1), "nearest"),
        (lambda: MissionVectorEnv(2, problem=far()).step(np.tile(REST, (2, 1))), "step"),
        (lambda: _stepped().step(REST), "actions"),
        (lambda: _stepped().step(np.full((2, 4), np.nan)), "actions"),
        (lambda: _stepped().reset(seed=[1]), "seed"),
        (lambda: _stepped().reset(options={"reset_mask": np.zeros(2, bool)}), "options.reset_mask"),
        (lambda: _stepped().reset(options={"layout": np.array([0, 2])}), "options.layout"),
        (lambda: _stepped().reset(options={"layout": np.array([0.0, 1.0])}), "options.layout"),
        (lambda: PlannerPolicy(_stepped(control="rotors")), "env"),
        (lambda: PlannerPolicy(MissionVectorEnv(2, problem=far(), mission=mission()))(), "env"),
    ],
)
def test_wrong_input(wrong: Any, field: str) -> None:
    with pytest.raises(InputError) as error:
        wrong()
    assert error.value.field == field
