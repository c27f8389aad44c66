"""MPPI, detection and guide region against the NumPy reference; statistics and keys of the draws."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from tests.native.lanes import drawn
from tests.problems import planar_batch, quadrotor_batch, reference_of
from tests.reference.guidance import active_spheres, cpuf, stuck_knots
from tests.reference.mppi import MppiSettings, mppi
from torchgco import GCO, MPPI, InputError
from torchgco.base.draws import DrawKey, standard_normal
from torchgco.dynamics.rollout import open_loop
from torchgco.eager.sampling import Noise, Rollouts, draw, fly
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.solvers.caught import active_counts, caught_knots

BATCHES = {"planar": planar_batch, "quadrotor": quadrotor_batch}


def key(B: int, seed: int = 0, outer: int = 1) -> DrawKey:
    return DrawKey(seed, torch.arange(B), torch.full((B,), outer))


def white_noise(problem, key_: DrawKey, samples: int, native: bool) -> np.ndarray:
    """z (B, S, N, m) as the sampler draws it."""
    rows = problem.N * problem.m
    z = drawn(key_, rows, samples) if native else standard_normal(key_, rows, range(samples), torch.float64)
    return z.unflatten(0, (problem.N, problem.m)).permute(2, 3, 0, 1).numpy()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("saturation", ["bounds", "symmetric"])
@pytest.mark.parametrize("batch", BATCHES)
def test_improve_equals_algorithm_3(batch: str, saturation: str, native: bool, monkeypatch) -> None:
    problem, U = BATCHES[batch](B=3, N=20)
    U = U + 0.2 * torch.randn(U.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    monkeypatch.setattr("torchgco.guidance.mppi.COLLISION_PENALTY", 50.0)
    sampler = MPPI(
        samples=30, covariance=torch.linspace(0.5, 9.0, problem.m).tolist(), temperature=5.0, saturation=saturation
    )
    X, mean = sampler.improve(problem, U, key(3))
    z = white_noise(problem, key(3), 30, native)
    for b in range(3):
        twin = reference_of(problem, b)
        lower = twin.u_lower if saturation == "bounds" else -twin.u_upper
        sigma = np.linspace(0.5, 9.0, problem.m)
        settings = MppiSettings(sigma=sigma, lower=lower, upper=twin.u_upper, temperature=5.0, rho_mp=50.0)
        expected = mppi(twin, U[b].numpy(), z[b], settings)
        # Scores of wild samples reach 1e7, so weights at temperature 5 carry some 1e-9 of rounding.
        np.testing.assert_allclose(mean[b], expected.U, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(X[b], expected.X, rtol=1e-6, atol=1e-6)


def flown(problem, V: torch.Tensor) -> Rollouts:
    """Rollouts of samples with the controls V (B, S, N, m)."""
    noise = Noise(V.permute(2, 0, 1, 3).contiguous(), torch.ones(1, 1, problem.m, dtype=V.dtype), None, None)
    return fly(problem, torch.zeros_like(noise.z[:, :, :1]), noise, None)


def through_the_obstacles(problem):
    """X (B, N+1, n) straight through the scene, which no dynamics can produce."""
    X = problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1)
    X[..., 0] += torch.linspace(0, 6 if problem.n == 14 else 2, problem.N + 1, dtype=torch.float64)
    return X


@pytest.mark.sampled(2)
@pytest.mark.parametrize("batch", BATCHES)
def test_detection_and_region_equal_algorithm_5(batch: str, native: bool) -> None:
    problem, U = BATCHES[batch](B=4, N=30, obstacles=14)
    X = through_the_obstacles(problem)
    counts, caught = active_counts(problem, X, U), caught_knots(problem, X, U)
    gco = GCO(sampler=MPPI(samples=20))
    start = GuideRegion.inactive(X, torch.full((4,), 20.0, dtype=torch.float64), problem.dynamics.position)
    guide = gco.update(problem, X, U, start, key(4)).penalty
    z = white_noise(problem, key(4), 20, native)
    for b in range(4):
        twin = reference_of(problem, b)
        active = [len(row) for row in active_spheres(twin, X[b].numpy())]
        assert counts[b].tolist() == active
        knots = stuck_knots(twin, X[b].numpy())
        assert caught[b].nonzero().flatten().tolist() == list(knots)
        settings = MppiSettings(sigma=np.ones(problem.m), lower=twin.u_lower, upper=twin.u_upper)
        vehicle = float(problem.constraints[0].vehicle_radius[b])
        expected = cpuf(twin, X[b].numpy(), U[b].numpy(), z[b], settings, vehicle)
        assert bool(guide.is_active[b]) == (expected is not None)
        if expected is not None:
            np.testing.assert_allclose(guide.center[b, caught[b]], expected.p[caught[b].numpy()], rtol=1e-7, atol=1e-8)
            assert torch.isinf(guide.radius[b, ~caught[b]]).all()
            np.testing.assert_allclose(guide.radius[b, caught[b]], expected.r[caught[b].numpy()])
    assert caught.any() and not caught[:, 1:-1].all()
    assert guide.weight.tolist() == [pytest.approx(20.0 * 4.84)] * 4


def test_a_sample_that_touches_nothing_replaces_the_iterate() -> None:
    """The iterate is caught, but a sample at rest is free: `start_from_sample` takes it, and no guide is left."""
    problem, U = planar_batch(B=4, N=30, obstacles=14)
    X = through_the_obstacles(problem)
    caught = caught_knots(problem, X, U).any(-1)
    start = GuideRegion.inactive(X, torch.full((4,), 20.0, dtype=torch.float64), problem.dynamics.position)
    still = MPPI(samples=3, covariance=1e-12)
    advice = GCO(sampler=still, start_from_sample=True).update(problem, X, U, start, key(4))
    assert torch.equal(advice.taken, caught) and not advice.penalty.is_active.any()
    torch.testing.assert_close(advice.U, U, rtol=0, atol=1e-4)
    drawn = GCO(sampler=still).update(problem, X, U, start, key(4))
    assert not drawn.taken.any() and torch.equal(drawn.penalty.is_active, caught)


def test_a_single_sphere_counts_after_some_iterations() -> None:
    problem, U = planar_batch(B=3, N=30, obstacles=1)
    X = through_the_obstacles(problem)
    X[..., 1] = problem.constraints[0].centers[:, :1, 1]
    start = GuideRegion.inactive(X, torch.full((3,), 20.0, dtype=torch.float64), problem.dynamics.position)
    gco = GCO(sampler=MPPI(samples=3)).in_search(2)
    assert not gco.update(problem, X, U, start, key(3, outer=1)).penalty.is_active.any()
    present = ~problem.constraints[0].absent[:, 0]
    assert torch.equal(gco.update(problem, X, U, start, key(3, outer=2)).penalty.is_active, present)


def test_smooth_noise_is_linear_between_its_knots_and_shrinks() -> None:
    problem, U = planar_batch(B=2, N=21)
    how = MPPI(samples=4, noise_knots=5).sampling(problem, key(2))
    noise = how.noise(problem, key(2), torch.ones(1, 1, 2, dtype=torch.float64), 0, range(4))
    V = draw(torch.zeros(21, 2, 1, 2, dtype=torch.float64), noise, None)
    torch.testing.assert_close(V[::5], noise.z)
    torch.testing.assert_close(V[2], 0.6 * noise.z[0] + 0.4 * noise.z[1])
    wide, narrow = (MPPI(samples=64, rounds=6, decay=d, covariance=4.0, noise_knots=5) for d in (1.0, 0.5))
    spread = [float((s.improve(problem, U, key(2))[1] - U).abs().mean()) for s in (wide, narrow)]
    assert spread[1] < spread[0]


def test_elite_temperature_is_the_gap_to_the_better_samples() -> None:
    S = torch.tensor([[3.0, 1.0, 2.0, 9.0]], dtype=torch.float64)
    expected = torch.softmax(-torch.tensor([[2.0, 0.0, 1.0, 8.0]]) / 2.0, dim=1).double()
    problem = planar_batch(B=1, N=6)[0]
    elite, plain = (MPPI(samples=4, elite=count).sampling(problem, key(1)) for count in (3, 0))
    torch.testing.assert_close(elite.weights(S), expected)
    torch.testing.assert_close(plain.weights(S), torch.softmax(-S, dim=1))


def test_dwelling_charges_where_a_sample_ends() -> None:
    problem, U = planar_batch(B=1, N=6)
    flight = flown(problem, U.unsqueeze(1) + torch.tensor([0.0, 4.0]).view(1, 2, 1, 1))
    V = flight.V
    sampling = [MPPI(samples=2, dwell_cost=dwell).sampling(problem, key(1)) for dwell in (0.0, 2.0)]
    plain, longer = (how.scores(problem, flight) for how in sampling)
    for s in range(2):
        controls = V[:, :, s].transpose(0, 1)
        X = open_loop(problem.dynamics, problem.x0, controls)
        last = problem.cost.stage(X[:, -1], controls[:, -1], 5)
        torch.testing.assert_close(longer[:, s] - plain[:, s], 12 * last, rtol=1e-9, atol=1e-9)


def test_single_precision_keeps_cost_apart_from_collisions(native: bool) -> None:
    """rho_mp = 1e8 next to costs of some thousands: added in float32, the costs would be lost."""
    problem, U = quadrotor_batch(B=3, N=30)
    sampler = MPPI(samples=64, noise_knots=4, elite=5, rounds=3)
    one, two = (replace(sampler, dtype=dtype).improve(problem, U, key(3)) for dtype in (None, "float32"))
    torch.testing.assert_close(one[1], two[1], rtol=0, atol=2e-2)
    assert two[1].dtype == torch.float64


@pytest.mark.parametrize("knots", [0, 4])
@pytest.mark.parametrize("native", ["eager"], indirect=True)
def test_many_samples_are_flown_in_blocks(knots: int, native: bool, monkeypatch) -> None:
    problem, U = planar_batch(B=3, N=12)
    sampler = MPPI(samples=23, noise_knots=knots, rounds=2, covariance=4.0)
    whole = sampler.improve(problem, U, key(3))[1]
    monkeypatch.setattr("torchgco.eager.sampling.SAMPLES_AT_ONCE", 10)
    torch.testing.assert_close(sampler.improve(problem, U, key(3))[1], whole, rtol=1e-12, atol=1e-12)


def test_draws_are_standard_normal_and_independent() -> None:
    z = standard_normal(key(40), 120, range(25))
    assert stats.kstest(z.flatten().numpy(), "norm").pvalue > 1e-3
    flat = z.movedim(1, 0).flatten(1)
    correlation = torch.corrcoef(flat) - torch.eye(40)
    assert float(correlation.abs().max()) < 5.0 / flat.shape[1] ** 0.5
    rows = torch.corrcoef(standard_normal(key(1), 60, range(500))[:, 0]) - torch.eye(60)  # Box-Muller pairs among them
    assert float(rows.abs().max()) < 5.0 / 500**0.5
    samples = torch.corrcoef(standard_normal(key(1), 500, range(60))[:, 0].T) - torch.eye(60)
    assert float(samples.abs().max()) < 5.0 / 500**0.5


def test_draws_are_keyed_by_problem_and_sample_not_by_position() -> None:
    whole = standard_normal(DrawKey(7, torch.tensor([3, 9, 4]), torch.tensor([1, 2, 1])), 9, range(5))
    mine = DrawKey(7, torch.tensor([9]), torch.tensor([2]))
    alone = standard_normal(mine, 9, range(5))
    assert torch.equal(whole[:, 1:2], alone)
    assert torch.equal(standard_normal(mine, 9, range(2, 5)), alone[..., 2:])
    for other in (
        DrawKey(8, torch.tensor([9]), torch.tensor([2])),
        DrawKey(7, torch.tensor([8]), torch.tensor([2])),
        DrawKey(7, torch.tensor([9]), torch.tensor([3])),
    ):
        assert not torch.equal(standard_normal(other, 9, range(5)), alone)
    assert not torch.equal(standard_normal(mine, 9, range(5), stream=1), alone)


@pytest.mark.parametrize("samples", [33, 100])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("batch", BATCHES)
def test_samples_are_the_same_in_every_batch(batch: str, dtype: str, samples: int, native: bool) -> None:
    """Bit by bit: the order of sums and products over samples must not depend on the batch."""
    problem, U = BATCHES[batch](B=7, N=12)
    sampler = MPPI(samples=samples, noise_knots=4, elite=3, rounds=2, dtype=dtype)
    whole = sampler.improve(problem, U, key(7))[1]
    for rows in ([2], [4, 1], [6, 5, 3]):
        index = torch.tensor(rows)
        assert torch.equal(sampler.improve(problem.take(index), U[index], key(7).take(index))[1], whole[index])


def test_a_diverging_sample_is_not_chosen() -> None:
    problem, U = planar_batch(B=1, N=5)
    V = U.unsqueeze(1).repeat(1, 3, 1, 1)
    V[0, 1] = torch.inf
    S = MPPI(samples=3).sampling(problem, key(1)).scores(problem, flown(problem, V))
    assert torch.isfinite(S).all() and S[0, 1] > 1e300


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: MPPI(samples=0), "mppi.samples"),
        (lambda: MPPI(temperature=0.0), "mppi.temperature"),
        (lambda: MPPI(rounds=0), "mppi.rounds"),
        (lambda: MPPI(noise_knots=1), "mppi.noise_knots"),
        (lambda: MPPI(decay=0.0), "mppi.decay"),
        (lambda: MPPI(elite=101), "mppi.elite"),
        (lambda: MPPI(dwell_cost=-1.0), "mppi.dwell_cost"),
        (lambda: MPPI(saturation="clip"), "mppi.saturation"),
        (lambda: MPPI(dtype="float16"), "mppi.dtype"),
        (lambda: MPPI(covariance=[1.0, 1.0, 1.0]).improve(*planar_batch(B=1, N=3), key(1)), "mppi.covariance"),
        (lambda: MPPI(covariance=0.0).improve(*planar_batch(B=1, N=3), key(1)), "mppi.covariance"),
        (lambda: GCO(initial_penalty=0.0), "gco.initial_penalty"),
        (lambda: GCO(penalty_growth=0.5), "gco.penalty_growth"),
    ],
)
def test_bad_options_are_named(make, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()
