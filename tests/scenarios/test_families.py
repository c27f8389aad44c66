"""The random families: their rules, their seeding, and agreement with the public layouts drawn by the same rules."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from torchgco import compose
from torchgco.base.errors import InputError
from torchgco.scenarios import Forest, ForestMoving, Layouts, PlanarRandom, PlanarTrap, Scenario, Walls, Yard
from torchgco.scenarios.base import generator
from torchgco.scenarios.planar import TRAP

DATA = Path(__file__).parents[2] / "benchmarks" / "data"
FAMILIES = [PlanarTrap(), PlanarRandom(), Forest(), ForestMoving(), Walls(), Yard()]
PUBLIC = {
    "planar_trap": PlanarTrap(),
    "planar_random": PlanarRandom(),
    "forest30": Forest(),
    "forest60": Forest(num_obstacles=60),
    "walls": Walls(),
}


def names(scenario) -> str:
    return scenario.name


def present(layouts: Layouts) -> np.ndarray:
    """Centres (count, d) of all present obstacles."""
    return layouts.centers[~np.isnan(layouts.radii)]


def nearest(layouts: Layouts, state: np.ndarray) -> float:
    """Smallest distance of a centre from the position in `state` (L, n), over all layouts."""
    position = state[:, None, : layouts.dimension]
    return float(np.nanmin(np.linalg.norm(layouts.centers - position, axis=-1)))


@pytest.mark.parametrize("scenario", FAMILIES, ids=names)
class TestSeeding:
    def test_independent_of_other_layouts(self, scenario):
        many = scenario.draw(range(20), seed=3)
        assert many.ids.tolist() == list(range(20)) and many.name == scenario.name
        assert scenario.draw([17], seed=3) == many.take([17])
        assert scenario.draw([9, 2, 9], seed=3) == many.take([9, 2, 9])

    def test_seed_and_number_matter(self, scenario):
        drawn = scenario.draw([0, 1], seed=0)
        assert not np.array_equal(drawn.centers[0], drawn.centers[1], equal_nan=True)
        assert not np.array_equal(drawn.centers, scenario.draw([0, 1], seed=1).centers, equal_nan=True)

    def test_unlimited_and_checked(self, scenario):
        assert scenario.available is None
        assert scenario.dimension == scenario.draw([10**9], seed=2**40).dimension
        for ids, seed, message in (
            ([], 0, "ids: expected a list of at least one integer >= 0, got []"),
            ([-1], 0, "ids: expected a list"),
            ([0.5], 0, "ids: expected a list"),
            ([0], -1, "seed: expected a whole number of at least 0 and at most 1e+18, got -1"),
            ([0], None, "seed: expected a whole number of at least 0 and at most 1e+18, got None"),
        ):
            with pytest.raises(InputError) as caught:
                scenario.draw(ids, seed)
            assert message in str(caught.value)


def test_stream_of_a_number():
    expected = np.random.Generator(np.random.Philox(np.random.SeedSequence(4, spawn_key=(2,)))).random(5)
    assert (generator(4, 2).random(5) == expected).all()
    trap = PlanarTrap().draw([2], seed=4).centers[0]
    noise = generator(4, 2).standard_normal((6, 2))
    assert trap == pytest.approx(np.array(TRAP) + 0.03 * noise, abs=1e-15)


@pytest.mark.parametrize(("family", "scenario"), PUBLIC.items(), ids=PUBLIC)
def test_task_is_the_public_one(family, scenario):
    """Start, goal, radii and horizon are equal; the rest of the states, and control bounds, in space the model's."""
    file, drawn = Layouts.load(DATA / f"{family}.npz"), scenario.draw(range(32), seed=0)
    stated = drawn if scenario.dimension == 2 else compose(["model=quadrotor"]).vehicle.at_rest(drawn)
    for name in ("start", "goal", "vehicle_radius", "goal_radius", "dt", "stages"):
        assert np.array_equal(getattr(stated, name), getattr(file, name)), name
    assert np.nanmin(drawn.radii) == pytest.approx(np.nanmax(file.radii)) == pytest.approx(np.nanmin(file.radii))
    for name in ("control_lower", "control_upper"):
        ours = getattr(drawn, name)
        assert np.array_equal(ours, getattr(file, name)) if scenario.dimension == 2 else ours is None
    assert drawn.best_cost is None


@pytest.mark.parametrize("family", ["planar_trap", "planar_random", "forest30", "forest60"])
def test_centres_are_distributed_as_the_public_ones(family):
    """Means and spreads of all coordinates agree within five standard errors."""
    file = present(Layouts.load(DATA / f"{family}.npz"))
    drawn = present(PUBLIC[family].draw(range(200), seed=1))
    error = file.std(axis=0) / np.sqrt(len(file))
    assert (np.abs(file.mean(axis=0) - drawn.mean(axis=0)) < 5 * error).all()
    assert file.std(axis=0) == pytest.approx(drawn.std(axis=0), rel=5 / np.sqrt(len(file)))


def test_trap_jitter():
    offsets = PlanarTrap().draw(range(400), seed=0).centers - np.array(TRAP)
    assert abs(offsets.mean()) < 0.003 and offsets.std() == pytest.approx(0.03, rel=0.05)
    offsets = Layouts.load(DATA / "planar_trap.npz").centers - np.array(TRAP)
    assert offsets.std() == pytest.approx(0.03, rel=0.15)
    still = PlanarTrap(jitter=0, centers=[[0.5, 0.5]], obstacle_radius=0.2).draw([0], seed=0)
    assert still.centers.tolist() == [[[0.5, 0.5]]] and still.radii.tolist() == [[0.2]]


def test_random_discs_keep_clear():
    drawn = PlanarRandom().draw(range(300), seed=0)
    assert drawn.start is not None and drawn.goal is not None
    assert drawn.radii.shape == (300, 15) and (drawn.radii == 0.08).all()
    assert 0.22 < nearest(drawn, drawn.start) < 0.23 and nearest(drawn, drawn.goal) > 0.19
    for low, high, axis in ((-0.8, 0.9, 0), (-0.8, 0.9, 1)):
        assert low <= drawn.centers[..., axis].min() < low + 0.01
        assert high >= drawn.centers[..., axis].max() > high - 0.01


@pytest.mark.parametrize("scenario", [Forest(), ForestMoving()], ids=names)
def test_forest_fills_its_region(scenario):
    drawn = scenario.draw(range(200), seed=0)
    assert drawn.radii.shape == (200, 30) and (drawn.radii == 0.6).all()
    for axis, (low, high) in enumerate(scenario.region):
        assert low <= drawn.centers[..., axis].min() < low + 0.05
        assert high >= drawn.centers[..., axis].max() > high - 0.05


def test_forest_keeps_clear_of_start_and_goal():
    drawn = Forest(region=[[-3, 22], [-1, 3], [-1, 1]], clearance=2.0).draw(range(100), seed=0)
    assert drawn.start is not None and drawn.goal is not None
    assert 2.0 < nearest(drawn, drawn.start) < 2.1 and 2.0 < nearest(drawn, drawn.goal) < 2.1


def test_density_overrides_the_number():
    assert Forest(density=0.5).draw([0], seed=0).radii.shape == (1, 56)  # 14 x 4 x 2 = 112 m^3
    assert Forest(density=0.0).draw([0], seed=0).radii.shape == (1, 0)
    assert Forest(num_obstacles=7).draw([0], seed=0).radii.shape == (1, 7)


def test_moving_forest():
    still, moving = Forest().draw(range(100), seed=5), ForestMoving(speed=2.0).draw(range(100), seed=5)
    assert np.array_equal(still.centers, moving.centers) and still.velocities is None
    assert moving.velocities is not None
    assert (moving.velocities[..., 2] == 0.0).all()
    speed = np.linalg.norm(moving.velocities, axis=-1)
    assert 1.95 < speed.max() <= 2.0 and speed.mean() == pytest.approx(1.0, abs=0.05)
    direction = moving.velocities[..., :2] / speed[..., None]
    assert np.abs(direction.mean(axis=(0, 1))).max() < 0.05
    quadrants = np.signbit(direction).reshape(-1, 2) @ [1, 2]
    assert np.bincount(quadrants, minlength=4).min() > 600  # of 3000
    assert (np.linalg.norm(ForestMoving(speed=0).draw([0], 5).velocities, axis=-1) == 0.0).all()  # type: ignore


def grid_of(layouts: Layouts) -> list[np.ndarray]:
    """The distinct values of each coordinate."""
    return [np.unique(np.round(present(layouts)[:, axis], 9)) for axis in range(3)]


def test_walls_are_on_the_public_grid():
    file, drawn = Layouts.load(DATA / "walls.npz"), Walls().draw(range(64), seed=0)
    for ours, theirs in zip(grid_of(drawn), grid_of(file), strict=True):
        assert ours == pytest.approx(theirs)
    counts = [(~np.isnan(layouts.radii)).sum(axis=1) for layouts in (drawn, file)]
    assert counts[0].mean() == pytest.approx(counts[1].mean(), abs=5 * counts[1].std() / np.sqrt(32))
    assert drawn.radii.shape == (64, 196)  # two full grids, holes as NaN


def test_walls_have_one_round_hole_each():
    rows = Walls().draw(range(40), seed=1)
    grid = np.stack(np.meshgrid(*grid_of(rows)[1:], indexing="ij"), axis=-1).reshape(-1, 2)
    for layout in range(rows.count):
        centers = present(rows.take([layout]))
        for x in (7.0, 13.0):
            wall = centers[centers[:, 0] == x][:, 1:]
            gone = grid[np.linalg.norm(grid[:, None] - wall, axis=-1).min(axis=1) > 1e-6]
            assert 6 <= len(gone) <= 12  # a disc of radius 1.5 holds about 8.7 cells of 0.9 x 0.9
            assert np.linalg.norm(gone[:, None] - gone, axis=-1).max() < 3.0
            middle = gone.mean(axis=0)
            assert -2.0 < middle[0] < 4.0 and -1.5 < middle[1] < 1.5


def test_walls_by_other_parameters():
    def count(**changes) -> int:
        return len(present(Walls(**changes).draw([0], seed=0)))

    assert count(holes=0) == 2 * 14 * 7
    assert count(holes=0, positions=[5.0]) == 14 * 7
    assert count(holes=0, pitch=1.0) == 2 * 13 * 7  # a grid includes both ends of an axis
    assert count(holes=0, extent=[[0.0, 0.3], [0.0, 0.0]], pitch=0.1) == 2 * 4  # 0.3 / 0.1 is just under 3
    assert count(holes=3) < count(holes=1) < count(holes=1, hole_radius=0.5)
    pinned = present(Walls(hole_region=[[1.0, 1.0], [0.0, 0.0]]).draw([0], seed=0))
    assert np.linalg.norm(pinned[:, 1:] - [1.0, 0.0], axis=1).min() >= 1.5


def test_a_yard_holds_discs_and_turned_boxes():
    drawn = Yard().draw(range(200), seed=0)
    assert drawn.centers.shape == (200, 8, 2) and drawn.start is not None and drawn.goal is not None
    assert drawn.box_centers is not None and drawn.box_half_sizes is not None and drawn.box_rotations is not None
    assert drawn.box_centers.shape == (200, 6, 2) and drawn.start.shape == (200, 4)
    for values, low, high in (
        (drawn.radii, 0.3, 0.6),
        (drawn.box_half_sizes[..., 0], 0.5, 1.1),
        (drawn.box_half_sizes[..., 1], 0.15, 0.3),
        (drawn.box_rotations, 0.0, np.pi),
        (drawn.box_centers[..., 0], -3.5, 3.5),
        (drawn.centers[..., 1], -2.5, 2.5),
    ):
        assert low <= values.min() < low + 0.02 * (high - low) and high >= values.max() > high - 0.02 * (high - low)
    middles = np.concatenate((drawn.centers, drawn.box_centers), axis=1)
    for state in (drawn.start, drawn.goal):
        assert 1.5 < np.linalg.norm(middles - state[:, None, :2], axis=-1).min() < 1.6


def test_a_yard_may_lack_discs_or_boxes():
    assert Yard(num_boxes=0).draw([0, 1], seed=0).box_centers is None
    bare = Yard(num_discs=0).draw([0, 1], seed=0)
    assert bare.centers.shape == (2, 0, 2) and bare.box_centers is not None


@pytest.mark.sampled(2)
@pytest.mark.parametrize("scenario", FAMILIES, ids=names)
def test_a_family_knows_the_number_of_its_states(scenario):
    start = compose([f"scenario={scenario.name}"]).vehicle.at_rest(scenario.draw([0], seed=0)).start
    assert start is not None and start.shape == (1, scenario.states)


ERRORS = {
    "no room": (
        lambda: Forest(clearance=50.0).draw([0], 0),
        "scenario.region: expected room for 30 centres more than 50 m from",
    ),
    "region": (lambda: Forest(region=[[0, 1], [0, 1]]), "scenario.region: expected a list of 3 lists of 2 numbers"),
    "crossed region": (lambda: PlanarRandom(region=[[1, 0], [0, 1]]), "scenario.region: expected a list of 2 lists"),
    "position": (lambda: Forest(start=(0, 0)), "scenario.start: expected a list of 3 numbers between"),
    "not numbers": (lambda: PlanarTrap(goal=("a", 0)), "scenario.goal: expected a list of 2 numbers"),  # type: ignore
    "text": (lambda: PlanarTrap(goal="12"), "scenario.goal: expected a list of 2 numbers between"),  # type: ignore
    "infinite": (lambda: PlanarTrap(start=(np.inf, 0)), "scenario.start: expected a list of 2 numbers"),
    "radius": (
        lambda: Walls(obstacle_radius=-1),
        "scenario.obstacle_radius: expected a number between 0 and 1e+06 m, got -1",
    ),
    "vehicle": (
        lambda: Walls(vehicle_radius=np.nan),
        "scenario.vehicle_radius: expected a number between 0 and 1e+06 m",
    ),
    "goal radius": (
        lambda: Walls(goal_radius=0),
        "scenario.goal_radius: expected a number above 0 m and at most 1e+06 m, got 0",
    ),
    "dt": (lambda: Forest(dt=0.0), "scenario.dt: expected a number above 0 s and at most 1e+06 s, got 0.0"),
    "stages": (lambda: Forest(stages=0), "scenario.stages: expected a whole number between 1 and 1e+09, got 0"),
    "name": (lambda: Forest(name=""), "scenario.name: expected a name, got ''"),
    "number": (
        lambda: Forest(num_obstacles=-1),
        "scenario.num_obstacles: expected a whole number between 0 and 100000",
    ),
    "density": (lambda: Forest(density=-0.1), "scenario.density: expected a number between 0 and 1e+06, or null"),
    "clearance": (
        lambda: PlanarRandom(start_clearance=-1),
        "scenario.start_clearance: expected a number between 0 and 1e+06 m",
    ),
    "jitter": (lambda: PlanarTrap(jitter=-1), "scenario.jitter: expected a number between 0 and 1e+06 m, got -1"),
    "centres": (lambda: PlanarTrap(centers=[[1, 2, 3]]), "scenario.centers: expected a list of lists of 2 numbers"),
    "no centres": (
        lambda: PlanarTrap(centers=[]),
        "scenario.centers: expected at least one disc, got none",
    ),
    "bounds": (
        lambda: PlanarTrap(control_lower=11),
        "scenario.control_lower: expected at most control_upper",
    ),
    "bound": (
        lambda: PlanarTrap(control_lower=[1, 2, 3]),
        "scenario.control_lower: expected a number between -1e+06 and 1e+06 m/s^2 or a list of 2",
    ),
    "speed": (lambda: ForestMoving(speed=-1), "scenario.speed: expected a number between 0 and 1e+06 m/s, got -1"),
    "pitch": (lambda: Walls(pitch=0), "scenario.pitch: expected a number above 0 m and at most 1e+06 m, got 0"),
    "holes": (lambda: Walls(holes=1.5), "scenario.holes: expected a whole number between 0 and 1000, got 1.5"),  # type: ignore
    "discs": (lambda: Yard(num_discs=-1), "scenario.num_discs: expected a whole number between 0 and 100000, got -1"),
    "sides": (lambda: Yard(box_width=(0.5, 0.2)), "scenario.box_width: expected a list of 2 numbers above 0 m"),
    "radii": (lambda: Yard(disc_radius=[0.3]), "scenario.disc_radius: expected a list of 2 numbers"),
    "yard": (lambda: Yard(region=[[0, 1]]), "scenario.region: expected a list of 2 lists of 2 numbers"),
    "walls": (
        lambda: Walls(positions=[]),
        "scenario.positions: expected at least one wall, got none",
    ),
}


@pytest.mark.parametrize(("make", "message"), ERRORS.values(), ids=ERRORS.keys())
def test_refuses(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value)


def test_sequences_become_plain_tuples():
    """Lists, arrays and OmegaConf's lists become tuples of floats, so that a scenario can be hashed."""
    omegaconf = pytest.importorskip("omegaconf")
    config = omegaconf.OmegaConf.create({"region": [[2, 16], [-1, 3], [-1, 1]], "start": [-1, 1, 0]})
    forest = Forest(region=config.region, start=config.start, goal=np.array([20, 1, 0.2]))  # type: ignore
    assert forest == Forest() and hash(forest) == hash(Forest())
    assert repr(forest) == repr(Forest())
    assert PlanarTrap(control_upper=10) == PlanarTrap(control_upper=[10, 10])
    assert PlanarTrap(control_lower=None).draw([0], 0).control_lower is None


def test_a_users_own_scenario():
    @dataclass(frozen=True)
    class Pair(Scenario):
        name: str = "pair"

        @property
        def dimension(self) -> int:
            return 2

        def _draw_one(self, rng):
            return Layouts(centers=rng.uniform(size=(1, 2, 2)), radii=np.ones((1, 2)))

    drawn = Pair().draw([3, 1], seed=0)
    assert (drawn.name, drawn.ids.tolist(), drawn.count) == ("pair", [3, 1], 2)

    @dataclass(frozen=True)
    class Empty(Pair):
        _draw_one = Scenario._draw_one

    with pytest.raises(NotImplementedError, match="Empty overrides _draw_one or draw"):
        Empty().draw([0], seed=0)
