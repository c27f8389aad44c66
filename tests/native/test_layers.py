"""Networks in C, layer by layer, against torch.func: values, Jacobians and second derivatives."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tests.engines import engine_of
from tests.native.lanes import Emitted, Model
from tests.slow import mostly
from torchgco import FunctionConstraint, FunctionCost, FunctionDynamics, InteriorPoint, Problem, kernels
from torchgco.kernels import EagerWarning
from torchgco.native.codegen.curvature import curvature_code
from torchgco.native.codegen.dynamics import DynamicsSource, trace_dynamics
from torchgco.native.codegen.emit import SHARED_AT
from torchgco.native.compiler import find_compiler
from torchgco.tracing import Traced
from torchgco.tracing.nets import MOST_WEIGHTS, Call

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
Step = Callable[[Tensor, Tensor], Tensor]
ACTIVATIONS = (
    nn.Tanh(), nn.ReLU(), nn.Softplus(), nn.Sigmoid(), nn.SiLU(), nn.GELU(), nn.GELU("tanh"), nn.ELU(), nn.Mish(),
    torch.sin,
)  # fmt: skip


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(4)
    yield
    torch.set_default_dtype(default)
    kernels.use_native(True)


def together(x: Tensor, u: Tensor) -> Tensor:
    return torch.cat((x, u), dim=-1)


def perceptron(*sizes: int, activation: Callable[[Tensor], Tensor] = torch.tanh) -> Callable[[Tensor], Tensor]:
    layers = [nn.Linear(k, h) for k, h in pairwise(sizes)]

    def net(a: Tensor) -> Tensor:
        for layer in layers[:-1]:
            a = activation(layer(a))
        return layers[-1](a)

    return net


def of_all_activations() -> tuple[Step, int, int]:
    nets = [perceptron(5, 24, 1, activation=activation) for activation in ACTIVATIONS]
    return (lambda x, u: torch.cat([net(together(x[..., :3], u)) for net in nets], dim=-1)), len(nets), 2


def of_all_sizes() -> tuple[Step, int, int]:
    nets = [perceptron(6, h, g, 1) for h, g in ((8, 10), (16, 4), (17, 33), (70, 31))]
    return (lambda x, u: torch.cat([net(together(x, u)) for net in nets], dim=-1)), 4, 2


def of_many_states() -> tuple[Step, int, int]:
    net = perceptron(9, 20, 9)
    return (lambda x, u: net(x) * u[..., :1].cos()), 9, 1


def in_expressions() -> tuple[Step, int, int]:
    one, two = perceptron(4, 32, 3), perceptron(6, 20, 4)

    def step(x: Tensor, u: Tensor) -> Tensor:
        angle, speed = x[..., 2], x[..., 3]
        seen = torch.stack((angle.sin(), angle.cos(), speed, u[..., 0]), dim=-1)
        pull, side, turn = one(seen).unbind(-1)
        ahead, aside = speed * angle.cos() * pull, speed * angle.sin() + side**2
        moved = torch.stack((ahead, aside, u[..., 1] * turn, speed), dim=-1)
        return moved + 0.3 * two(together(moved, u)) * two(together(x, u)).sum(-1, keepdim=True)

    return step, 4, 2


def of_other_forms() -> tuple[Step, int, int]:
    """Residual and gated layers, weights that are used twice, products with matrices, vectors and numbers to learn."""
    into, again, out = nn.Linear(6, 16), nn.Linear(16, 16), nn.Linear(16, 4)
    W, scale, number = torch.randn(6, 16), torch.randn(16), torch.randn(1)

    def step(x: Tensor, u: Tensor) -> Tensor:
        z = together(x, u)
        first = torch.tanh(into(z))
        residual = first + torch.tanh(again(first))
        gated = torch.sigmoid(again(residual)) * residual
        other = torch.tanh(z @ W * scale + number) @ W.T[:, :4]
        return out(gated) + 0.2 * other

    return step, 4, 2


def of_rows() -> tuple[Step, int, int]:
    """As many rows as neurons, and weights of the rows, which aren't those of neurons."""
    net, out, gains = perceptron(2, 40, 4), nn.Linear(4, 2), torch.rand(4, 1)
    return (lambda x, u: out((net(x.reshape(-1, 4, 2)) * gains).tanh()).reshape(-1, 8) + u), 8, 1


def of_constants() -> tuple[Step, int, int]:
    """A recurrent network that begins at zero, and layers that the inputs cancel out of."""
    into, again, out = nn.Linear(5, 16), nn.Linear(16, 16), nn.Linear(16, 3)

    def step(x: Tensor, u: Tensor) -> Tensor:
        seen = into(together(x, u))
        state = torch.zeros_like(seen)
        for _ in range(2):
            state = torch.tanh(seen + again(state))
        return out(state) + out(seen - seen) + out(torch.ones_like(seen)) + torch.ones_like(state)[..., :3]

    return step, 3, 2


CASES: dict[str, tuple[Callable[[], tuple[Step, int, int]], str]] = {
    "activations": (of_all_activations, "none"),
    "sizes": (of_all_sizes, "none"),
    "many states": (of_many_states, "midpoint"),
    "expressions": (in_expressions, "midpoint"),
    "forms": (of_other_forms, "euler"),
    "rows": (of_rows, "none"),
    "constants": (of_constants, "none"),
}


MODEL = """
static void model_jacobian(const V *x, const V *u, const V *p, const double *w, V *f) { tgco_jacobian(x, u, p, w, f); }
"""


def compiled(model: FunctionDynamics) -> Callable[[Tensor, Tensor, Tensor], list[Tensor]]:
    """Step (B, n), Jacobian twice (B, n, n+m), and second derivatives (B, n+m, n+m) of y' step, of x, u, y in C."""
    source, n, s = trace_dynamics(model), model.n, model.n + model.m
    code = source.code + MODEL + curvature_code(source, [])
    wrapped = f"""
static void tgco_all(
    const V *x, const V *u, const V *p, const double *w, const V *y, V *next, V *first, V *f, V *H) {{
    tgco_step(x, u, p, w, next);
    tgco_jacobian(x, u, p, w, first);
    memset(H, 0, {s * s} * sizeof(V));
#ifdef TGCO_TOGETHER
    tgco_together(x, u, p, w, y, f, H);
#else
    tgco_jacobian(x, u, p, w, f);
    tgco_curve(x, u, p, w, y, H);
#endif
}}
"""
    sizes, count = [n, model.m, 0, int(shared(model).numel()), n], source.computed
    head = f"#define NX {n}\n#define NU {model.m}\n#include <string.h>\n"
    emitted = Emitted(head + code + wrapped, "tgco_all", sizes, [n, count, count, s * s], shared=SHARED_AT)

    def called(x: Tensor, u: Tensor, y: Tensor) -> list[Tensor]:
        arrays = x.numpy(), u.numpy(), np.zeros((len(x), 0)), shared(model).numpy(), y.numpy()
        ahead, first, again, H = (torch.from_numpy(out) for out in emitted(*arrays))
        return [ahead, *(whole(source, entries) for entries in (first, again)), H.reshape(-1, s, s)]

    return called


def whole(source: DynamicsSource, entries: Tensor) -> Tensor:
    """The Jacobian (B, n, n+m) of computed entries and constant ones."""
    J = torch.zeros(len(entries), source.n, source.n + source.m)
    for row, column, place, value in zip(source.rows, source.columns, source.places, source.values, strict=True):
        J[:, row, column] = entries[:, place] if place >= 0 else value
    return J


def shared(model: FunctionDynamics) -> Tensor:
    numbers = trace_dynamics(model).traced.shared_numbers()
    assert numbers is not None
    return numbers


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", mostly(CASES, "expressions", "activations", "many states"))
def test_derivatives_are_those_of_autodiff(name: str) -> None:
    make, integrator = CASES[name]
    function, n, m = make()
    model = FunctionDynamics(function, n, m, 0.1, integrator)  # type: ignore[arg-type]
    x, u, y = torch.randn(5, n), torch.randn(5, m), torch.randn(5, n)
    x[3], u[3] = x[1], u[1]  # two problems with the same numbers, and other multipliers

    def one(z: Tensor) -> Tensor:
        return model.step(z[:n].unsqueeze(0), z[n:].unsqueeze(0))[0]

    z, native = together(x, u), compiled(model)
    assert calls_of(function, n, m)
    J = torch.func.vmap(torch.func.jacfwd(one))(z)
    H = torch.func.vmap(torch.func.hessian(lambda z, y: (one(z) * y).sum()))(z, y).triu()
    found = native(x, u, y)
    for mine, theirs, near in zip(found, (model.step(x, u), J, J, H), (1e-13, 1e-12, 1e-12, 1e-11), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=near, atol=near)
    # The same bits in every lane and company.
    order = torch.tensor([3, 4, 0, 1, 2])
    for mine, again in zip(found, native(x[order], u[order], y[order]), strict=True):
        assert torch.equal(again, mine[order])
    for i in range(5):
        for mine, alone in zip(found, native(x[[i]], u[[i]], y[[i]]), strict=True):
            assert torch.equal(alone[0], mine[i])


@pytest.mark.slow
def test_a_network_in_a_branch_that_is_not_taken_spoils_nothing() -> None:
    """Its inputs, values and tangents are NaN or infinite there; one output is read in either branch."""
    net, potential = perceptron(3, 32, 3), perceptron(3, 32, 1, activation=nn.Softplus())

    def step(x: Tensor, u: Tensor) -> Tensor:
        found = net(torch.cat((x[..., :1].sqrt(), u), dim=-1))
        chained = net(found.exp()) ** 3 * u[..., :1]
        steep = torch.func.grad(lambda z: potential(1e4 * z).sum())(torch.cat((x[..., 1:2], u), dim=-1))
        return torch.where(x[..., :1] > 0, found**2 + chained, 0.1 * x**2) + steep

    x, u, y = torch.randn(6, 3), torch.randn(6, 2), torch.randn(6, 3)
    x[:3, 0], x[3:, 0] = -x[:3, 0].abs() - 0.1, x[3:, 0].abs() + 0.1
    model = FunctionDynamics(step, 3, 2, 0.1, "none")

    def one(z: Tensor) -> Tensor:
        return step(z[:3].unsqueeze(0), z[3:].unsqueeze(0))[0]

    # Forward over forward: PyTorch's reverse mode has NaN here.
    J = torch.func.vmap(torch.func.jacfwd(one))(together(x, u))
    H = torch.func.vmap(torch.func.jacfwd(torch.func.jacfwd(lambda z, y: (one(z) * y).sum())))(together(x, u), y)
    found = compiled(model)(x, u, y)
    for mine, theirs in zip(found, (model.step(x, u), J, J, H.triu()), strict=True):
        assert torch.isfinite(theirs).all()
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)


def test_powers_and_sinc_at_zero() -> None:
    exponents = torch.tensor([0.0, 1.0, 2.0, 3.0], requires_grad=True)
    model = FunctionDynamics(
        lambda x, u: torch.cat((x[..., :4] ** exponents, x[..., 4:].sinc()), -1), 5, 1, 0.1, "none"
    )
    z = torch.tensor([0.0, 1e-12, 1e-9, 1e-5, 0.09, 0.4, -1.7])
    native, x, u = compiled(model), z.unsqueeze(-1).expand(-1, 5).contiguous(), torch.zeros(7, 1)
    p, zero, t = exponents.detach(), torch.zeros_like(z), torch.pi * z
    slopes = torch.stack((zero, zero + 1.0, 2.0 * z, 3.0 * z**2), -1)
    bends = torch.stack((zero, zero, zero + 2.0, 6.0 * z), -1)
    # sinc' / pi = -t/3 + t^3/30 - ..., whose further terms count from 0.1 on
    far = z.abs() > 0.1
    slope = torch.where(far, (t.cos() - t.sin() / t) / z, torch.pi * (-t / 3 + t**3 / 30 - t**5 / 840 + t**7 / 45360))
    bend = torch.where(
        far,
        -(torch.pi**2) * (t.sin() / t + 2 * t.cos() / t**2 - 2 * t.sin() / t**3),
        torch.pi**2 * (-1 / 3 + t**2 / 10 - t**4 / 168 + t**6 / 6480),
    )
    for i, (first, second) in enumerate(zip((*slopes.T, slope), (*bends.T, bend), strict=True)):
        value, J, _, H = native(x, u, torch.eye(5)[i].expand(7, 5).contiguous())
        torch.testing.assert_close(value[:, i], z ** p[i] if i < 4 else z.sinc(), rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(J[:, i, i], first, rtol=1e-10, atol=1e-14)
        torch.testing.assert_close(H[:, i, i], second, rtol=1e-8, atol=1e-14)


def learned(B: int = 3) -> Problem:
    """Dynamics, cost, and constraint are networks."""
    drift, dislike, fence = perceptron(3, 16, 2), perceptron(2, 24, 16, 1), perceptron(2, 24, 8, 2)
    dynamics = FunctionDynamics(lambda x, u: 0.3 * drift(together(x, u)) + u, 2, 1, 0.1)
    cost = FunctionCost(
        lambda x, u: x.square().sum(-1) + 0.1 * u.square().sum(-1) + dislike(x)[..., 0] ** 2,
        lambda x: x.square().sum(-1) + dislike(x)[..., 0],
    )
    rows = FunctionConstraint(lambda x: fence(x) - 0.6, name="fence")
    x0 = torch.randn(B, 2, generator=torch.Generator().manual_seed(0))
    return Problem(dynamics, cost, [rows], x0, 8)


@pytest.mark.slow
def test_networks_anywhere_are_solved_as_by_pytorch() -> None:
    problem = learned()
    assert engine_of(problem) is not None
    U0, solver = torch.zeros(3, 8, 1), InteriorPoint()
    mine = solver.solve(problem, U0)
    parts = [solver.solve(problem.take(torch.tensor([i])), U0[:1]) for i in (2, 0)]
    assert all(torch.equal(part.U[0], mine.U[i]) for part, i in zip(parts, (2, 0), strict=True))
    kernels.use_native(False)
    theirs = solver.solve(learned_again(problem), U0)
    assert mine.status.tolist() == theirs.status.tolist()
    torch.testing.assert_close(mine.cost, theirs.cost, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(mine.U, theirs.U, rtol=1e-5, atol=1e-5)


def learned_again(problem: Problem) -> Problem:
    """The same problem, for which no kernels have been chosen."""
    return replace(problem)


def calls_of(function: Step, n: int, m: int, own: tuple[Tensor, ...] = ()) -> list[Call]:
    found: list[Call] = []
    x, u = torch.zeros(1, n), torch.zeros(1, m)
    traced = Traced("step", lambda index, x, u: function(x, u), x, u, own=own)
    import casadi as ca

    numbers = np.array([ca.SX.sym(f"x{i}") for i in range(n + m)], dtype=object)
    shared = traced.shared[: len(traced.pattern)].numpy().astype(object)
    traced(np.zeros(traced.count), numbers[None, :n], numbers[None, n:], shared=shared, calls=found)
    return found


def test_what_becomes_a_network() -> None:
    net, W = perceptron(5, 16, 3), torch.randn(16, 5)
    assert len(calls_of(lambda x, u: net(together(x, u)), 3, 2)) == 1
    # Not a linear system, whose zeros count; not a small network; not one with weights of each problem.
    assert not calls_of(lambda x, u: together(x, u) @ W.T @ W[:, :3], 3, 2)
    few = perceptron(5, 6, 3)
    assert not calls_of(lambda x, u: few(together(x, u)), 3, 2)
    own = torch.randn(1, 16, 5)
    assert not calls_of(lambda x, u: torch.tanh(together(x, u) @ own[0].T) @ W[:, :3], 3, 2, own=(own,))


def test_a_single_precision_network_is_rounded_as_by_pytorch() -> None:
    net = nn.Sequential(nn.Linear(5, 16, dtype=torch.float32), nn.Tanh(), nn.Linear(16, 3, dtype=torch.float32))
    model = FunctionDynamics(lambda x, u: net(together(x, u).float()).double(), 3, 2, 0.1, "none")
    x, u = torch.randn(4, 3), torch.randn(4, 2)
    torch.testing.assert_close(Model(trace_dynamics(model)).step(x, u), model.step(x, u), rtol=1e-5, atol=1e-6)


def test_sparse_weights_are_read_as_all_others() -> None:
    W, V = torch.randn(5, 32).relu().to_sparse(), torch.randn(32, 3)
    model = FunctionDynamics(lambda x, u: torch.tanh(together(x, u) @ W) @ V, 3, 2, 0.1, "none")
    x, u = torch.randn(4, 3), torch.randn(4, 2)
    torch.testing.assert_close(Model(trace_dynamics(model)).step(x, u), model.step(x, u), rtol=1e-13, atol=1e-13)


def test_pytorch_takes_over_where_a_network_is_large() -> None:
    h = int(MOST_WEIGHTS**0.5)
    net = perceptron(3, h, h, 2)
    problem = replace(learned(1), dynamics=FunctionDynamics(lambda x, u: net(together(x, u)), 2, 1, 0.1))
    with pytest.warns(EagerWarning, match="networks of at most 300000 weights"):
        assert engine_of(problem) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert engine_of(problem) is None
