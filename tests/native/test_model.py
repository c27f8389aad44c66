"""A model in C equals that in PyTorch: its step, its derivatives, and the parameters of each problem."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.native.lanes import Model
from tests.slow import mostly
from torchgco import (
    Dynamics,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    RotorTracking,
    Unicycle,
)
from torchgco.native.codegen import dynamics as made_by
from torchgco.native.codegen.dynamics import trace_dynamics
from torchgco.native.compiler import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

DOUBLE = dict(dtype=torch.float64)
B = 19  # two full groups of lanes and a partial one


def each(low: float, high: float) -> Tensor:
    return torch.linspace(low, high, B, **DOUBLE)


def users(x: Tensor, u: Tensor) -> Tensor:
    """A user's field, with common operations of PyTorch."""
    speed, angle, load = x.unbind(-1)
    return torch.stack(
        (
            torch.tanh(speed) + torch.atan2(u[..., 0], 1.0 + angle.square()) - torch.exp(-load.abs()) / 3.0,
            torch.where(angle > 0.0, angle.clamp(min=0.0).sqrt(), -angle) + u[..., 1].clamp(-0.5, 0.5),
            (0.1 + load.square()) ** 1.5 / (1.0 + speed.square()).sqrt()
            + 0.3 * (TABLE @ x.unsqueeze(-1)).sum((-2, -1)),
        ),
        dim=-1,
    )


TABLE = torch.tensor([[0.3, -1.0, 0.2], [0.0, 2.0, 1.0 / 3.0]], **DOUBLE)
KINDS = ("euler", "midpoint", "rk4")
MODELS: dict[str, Dynamics] = {
    **{f"planar {kind}": Planar(integrator=kind) for kind in KINDS},
    **{f"unicycle {kind}": Unicycle(integrator=kind) for kind in KINDS},
    **{f"quadrotor {kind}": QuadrotorPlanning(integrator=kind) for kind in KINDS},
    **{f"plant {kind}": QuadrotorPlant(integrator=kind) for kind in KINDS},
    **{f"rotors {kind}": RotorTracking(integrator=kind) for kind in KINDS},
    "planar, one each": Planar(
        drag=each(5.0, 10.0), turn_gain=each(0.1, 0.3), turn_drag=torch.tensor([0.01], **DOUBLE)
    ),
    "quadrotor, one each": QuadrotorPlanning(rate_time_constant=each(1.0, 2.0), thrust_time_constant=torch.tensor(1.2)),
    "user's": FunctionDynamics(users, n=3, m=2, dt=0.1, integrator="rk4"),
    "user's step": FunctionDynamics(users, n=3, m=2, dt=0.1, integrator="none"),
}


# Their integrators besides Euler's take seconds of a compiler.
LARGE = [f"{model} {kind}" for model in ("plant", "rotors", "quadrotor") for kind in KINDS if kind != "euler"]
ALONE = ["planar, one each", "quadrotor, one each", "plant rk4", "user's"]


def points(model: Dynamics, kind: str) -> tuple[Tensor, Tensor]:
    """States (B, n) and controls (B, m) near rest, tumbling, far away, or without thrust."""
    generator = torch.Generator().manual_seed(5)
    x = torch.randn(B, model.n, generator=generator, **DOUBLE)
    u = torch.randn(B, model.m, generator=generator, **DOUBLE)
    rotors = isinstance(model, (QuadrotorPlant, RotorTracking))
    if rotors:  # thrusts in N, rotor speeds in rpm
        x[:, -4:], u = 3.0 + 0.5 * x[:, -4:], 5000.0 + 300.0 * u
    if kind == "tumbling":
        x, u = 30.0 * x, 30.0 * u
        if rotors:
            x[:, -4:], u = x[:, -4:].abs() / 30.0, u / 30.0
    if kind == "far":
        x[:, 0] += 1e6
        x[:, 1] -= 1e6
    if "thrust" in kind:
        x[:, -4:], u = (0.0 if kind == "no thrust" else 1e-12), torch.zeros_like(u)
    return x, u


@pytest.mark.sampled(3)
@needs_compiler
@pytest.mark.parametrize("name", mostly(MODELS, *LARGE))
def test_steps_and_derivatives(name: str) -> None:
    model = MODELS[name]
    emitted = Model(trace_dynamics(model))
    for kind in ("near", "tumbling", "far", *(() if "user" in name else ("hardly any thrust", "no thrust"))):
        x, u = points(model, kind)
        assert_close(emitted.step(x, u), model.step(x, u))
        assert_close(emitted.jacobian(x, u), torch.cat(model.jacobians(x, u), dim=-1))


def assert_close(made: Tensor, expected: Tensor) -> None:
    """Equal to 1e-12 of the largest finite entry of a problem, and non-finite at the same entries."""
    scale = torch.where(expected.isfinite(), expected.abs(), 1.0).flatten(1).amax(1).clamp(min=1.0)
    scale = scale.view(-1, *[1] * (expected.dim() - 1))
    torch.testing.assert_close(made / scale, expected / scale, rtol=1e-12, atol=1e-12, equal_nan=True)


@needs_compiler
def test_single_precision() -> None:
    model = MODELS["quadrotor, one each"]
    x, u = points(model, "near")
    emitted = Model(trace_dynamics(model), "float", lanes=16)
    torch.testing.assert_close(emitted.step(x, u), model.step(x, u).float(), rtol=1e-5, atol=1e-5)


@needs_compiler
@pytest.mark.parametrize("name", mostly(ALONE, "plant rk4"))
def test_a_problem_depends_on_no_other(name: str) -> None:
    model = MODELS[name]
    emitted = Model(trace_dynamics(model))
    x, u = points(model, "near")
    whole = emitted.step(x, u), emitted.jacobian(x, u)
    ill = x.clone()
    ill[3], ill[12] = torch.nan, torch.inf
    rest = [b for b in range(B) if b not in (3, 12)]
    for before, after in zip(whole, (emitted.step(ill, u), emitted.jacobian(ill, u)), strict=True):
        assert torch.equal(before[rest], after[rest])
        assert not after[3].isfinite().all()
    alone = Model(trace_dynamics(model.take(torch.tensor([7]))))
    assert torch.equal(alone.step(x[7:8], u[7:8]), whole[0][7:8])
    assert torch.equal(alone.jacobian(x[7:8], u[7:8]), whole[1][7:8])


def test_constant_entries_are_not_computed() -> None:
    source = trace_dynamics(Planar(dt=0.1, drag=2.0))
    pattern = {
        (r, c): (p, v) for r, c, p, v in zip(source.rows, source.columns, source.places, source.values, strict=True)
    }
    fixed = {place: value for place, (at, value) in pattern.items() if at < 0}
    assert fixed.keys() == {(0, 0), (1, 1), (2, 2), (0, 3), (1, 4), (2, 5), (3, 3), (4, 4), (5, 5), (5, 6), (5, 7)}
    assert fixed[3, 3] == pytest.approx(0.8) and fixed[0, 3] == 0.1 and fixed[0, 0] == 1.0
    assert sorted(at for at, _ in pattern.values() if at >= 0) == list(range(source.computed))
    assert {place for place, (at, _) in pattern.items() if at >= 0} == {(3, 2), (4, 2), (3, 6), (3, 7), (4, 6), (4, 7)}
    assert source.count == 0 and source.parameters(torch.arange(4)).shape == (4, 0)


def test_parameters_of_each_problem() -> None:
    source = trace_dynamics(MODELS["planar, one each"])
    assert source.count == 3
    whole = source.parameters(torch.arange(B))
    assert whole.dtype == torch.float64
    columns = sorted(whole.T.tolist())
    assert columns == sorted([each(5.0, 10.0).tolist(), each(0.1, 0.3).tolist(), [0.01] * B])
    assert torch.equal(source.parameters(torch.tensor([7, 2])), whole[[7, 2]])


def test_parameters_that_must_be_computed() -> None:
    """PyTorch may compute the parameters in any way; their bits do not depend on the number of problems."""

    class Own(Planar):
        def step(self, x: Tensor, u: Tensor) -> Tensor:
            turns = torch.stack((self.drag.cos(), self.drag.exp()), dim=-1) @ torch.ones(2, 6, **DOUBLE)
            return x * turns + torch.linalg.inv(torch.diag_embed(turns + 3.0)).sum(-1)

    source = trace_dynamics(Own(drag=each(0.1, 0.9)))
    whole = source.parameters(torch.arange(B))
    assert whole.shape == (B, 12)
    one_by_one = [torch.from_numpy(source.traced.parameters(torch.tensor([b]))) for b in range(B)]
    assert torch.equal(whole, torch.stack(one_by_one))


@pytest.mark.slow
def test_made_once(monkeypatch) -> None:
    """Another process reads the stored code without CasADi; another parameter makes another model."""
    first, other = trace_dynamics(Planar(drag=2.0)), trace_dynamics(Planar(drag=2.5))
    each_own = trace_dynamics(Planar(drag=each(1.0, 2.0)))
    assert len({first.key, other.key, each_own.key}) == 3
    assert first.code != other.code
    root = Path(__file__).parents[2]
    code = (
        "import sys, torch; from torchgco import Planar; from torchgco.native.codegen.dynamics import trace_dynamics;"
        "source = trace_dynamics(Planar(drag=2.0)); print(source.key, 'casadi' in sys.modules, len(source.code))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.split() == [first.key, "False", str(len(first.code))]
    monkeypatch.setattr(made_by, "step_parts", None)
    assert trace_dynamics(Planar(drag=2.0)) == first
    again = trace_dynamics(Planar(drag=each(3.0, 4.0)))
    assert again == each_own  # the same code, other parameters
    assert torch.equal(again.parameters(torch.arange(B))[:, 0], each(3.0, 4.0))


def test_damaged_code_is_made_again(cache: Path) -> None:
    source = trace_dynamics(Planar())
    (entry,) = cache.iterdir()
    entry.write_bytes(entry.read_bytes()[:-40])
    assert trace_dynamics(Planar()) == source
    assert [path.name for path in cache.iterdir()] == [entry.name]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (lambda x, u: x + u, lambda x, u: x - u),
        (lambda x, u: x + 0.1, lambda x, u: x + 0.1000000000000001),
        (lambda x, u: x * 0.0, lambda x, u: x * -0.0),
        (lambda x, u: x + u * torch.tensor(2.0), lambda x, u: x + u * torch.tensor(3.0)),
        (lambda x, u: x[..., [0, 1]] * u, lambda x, u: x[..., [1, 0]] * u),
        (lambda x, u: x * u[..., :1], lambda x, u: x * u[..., 1:]),
        (lambda x, u: x.clamp(min=1.0), lambda x, u: x.clamp(max=1.0)),
    ],
)
def test_different_functions_have_different_keys(one, other) -> None:
    sources = [trace_dynamics(FunctionDynamics(f, n=2, m=2, dt=0.1, integrator="none")) for f in (one, other, one)]
    assert sources[0].key == sources[2].key != sources[1].key


def test_functions_that_cannot_be_traced() -> None:
    for function, message in ((torch.erfinv, "erfinv"), (lambda x: x if x.sum() > 0 else -x, "traced")):
        with pytest.raises(InputError, match=message):
            trace_dynamics(FunctionDynamics(lambda x, u, f=function: f(x), n=2, m=1, dt=0.1))


def test_parameters_of_a_part_of_the_batch() -> None:
    whole = Planar(drag=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), thrust_gain=2.0)
    source, rows = trace_dynamics(whole), torch.tensor([2, 0, 2])
    own = source.parameters(torch.arange(3), whole.take(rows))
    assert torch.equal(own, source.parameters(rows)) and own.shape == (3, 1)


def test_parameters_of_a_batch_of_which_one_problem_was_traced() -> None:
    whole = Planar(drag=torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    source = trace_dynamics(whole.take(torch.tensor([1])))
    assert source.parameters(torch.arange(3), whole).flatten().tolist() == [1.0, 2.0, 3.0]
    assert source.parameters(torch.arange(2), whole.take(torch.tensor([2, 0]))).flatten().tolist() == [3.0, 1.0]


A = torch.linspace(0.5, 1.5, B, **DOUBLE)
AFFINE = {
    "a sine": (lambda x, u, a: a.unsqueeze(-1) * x + u.sin(), False),
    "affine": (lambda x, u, a: a.unsqueeze(-1).square() * x - u / a.unsqueeze(-1) + 1.0, True),
    "bilinear": (lambda x, u, a: a.unsqueeze(-1) * x * u, False),
    "a jump": (lambda x, u, a: a.unsqueeze(-1) * x + u.floor(), False),
    "a bend": (lambda x, u, a: a.unsqueeze(-1) * x + u.abs(), False),
}


@pytest.mark.parametrize("name", AFFINE)
def test_affine_steps_are_known(name: str) -> None:
    function, affine = AFFINE[name]
    start = torch.zeros(B, 1, **DOUBLE)
    model = FunctionDynamics(function, 1, 1, 0.1, "none", values={"a": A})
    bound = Problem(model, QuadraticCost([1.0], [1.0], [1.0]), [], start, 2).dynamics
    assert trace_dynamics(bound).affine is affine
