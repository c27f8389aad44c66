"""CasADi computes the same from a traced function as PyTorch from the function."""

from collections.abc import Iterable

import casadi as ca
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from tests.problems import planar_batch, random_trajectory
from torchgco import (
    Airframe,
    Dynamics,
    FirstStepRates,
    FunctionConstraint,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    Spheres,
    StateBounds,
    Unicycle,
)
from torchgco.base.autodiff import gradient_and_hessian
from torchgco.tracing import Traced

DOUBLE = dict(dtype=torch.float64)


def symbols(name: str, shape: tuple[int, ...]) -> tuple[ca.SX, np.ndarray]:
    """A column of symbols, and the same as an array of that shape."""
    column = ca.SX.sym(name, int(np.prod(shape)))
    elements = np.empty(column.numel(), dtype=object)
    elements[:] = ca.vertsplit(column) if column.numel() else []
    return column, elements.reshape(shape)


def by_casadi(function, bs: Iterable[int], *values: Tensor) -> Tensor:
    """function(index, *values) for the problems bs of a batch, by a CasADi function of symbols."""
    shapes = [(1, *v.shape[1:]) for v in values]
    traced = Traced("field", function, *(v.new_zeros(shape) for v, shape in zip(values, shapes, strict=True)))
    parameters, arrays = symbols("p", (traced.count,)), [symbols(f"z{i}", shape) for i, shape in enumerate(shapes)]
    result = traced(parameters[1], *(array for _, array in arrays))
    made = ca.Function("made", [parameters[0], *(c for c, _ in arrays)], [ca.vertcat(*result.reshape(-1))])
    numbers = [made(traced.parameters(torch.tensor([b])), *(v[b].flatten().numpy() for v in values)) for b in bs]
    return torch.cat([torch.from_numpy(np.array(row)).reshape(result.shape) for row in numbers])


def check(part, method: str, *values: Tensor) -> None:
    """Compare `method` of a part, traced and in PyTorch, for every problem of the batch."""
    made = by_casadi(lambda i, *z: getattr(part.take(i), method)(*z), range(len(values[0])), *values)
    torch.testing.assert_close(made, getattr(part, method)(*values), rtol=1e-12, atol=1e-12)


def in_place(x: Tensor, u: Tensor) -> Tensor:
    """A field with in-place writes, elementwise branches and indexing."""
    rate = torch.zeros(3, 3, **DOUBLE)
    rate[0, 1] = 2.0
    out = x.new_zeros(x.shape)
    out[..., 0] = torch.where(x[..., 1] > 0, x[..., 1].sqrt(), -x[..., 1])
    out[..., 1:] = u.clamp(-0.5, 0.5) * x[..., torch.tensor([2, 0])]
    out[..., 2] += torch.atan2(x[..., 0], 1.0 + x[..., 1].square())
    return out + x @ rate


NETWORK = torch.nn.Sequential(torch.nn.Linear(5, 4, **DOUBLE), torch.nn.Tanh(), torch.nn.Linear(4, 3, **DOUBLE))


def network(x: Tensor, u: Tensor) -> Tensor:
    return NETWORK(torch.cat((x, u), dim=-1)) + F.softplus(x)


MODELS: dict[str, Dynamics] = {
    "planar": Planar(),
    "planar, one drag each": Planar(drag=torch.tensor([1.0, 2.0, 3.0], **DOUBLE), integrator="midpoint"),
    "unicycle": Unicycle(integrator="rk4"),
    "quadrotor": QuadrotorPlanning(rate_time_constant=torch.tensor([1.0, 1.5, 2.0], **DOUBLE)),
    "plant": QuadrotorPlant(integrator="rk4"),
    "in place": FunctionDynamics(in_place, n=3, m=2, dt=0.1),
    "network": FunctionDynamics(network, n=3, m=2, dt=0.1, integrator="none"),
}


@pytest.mark.parametrize("name", MODELS)
def test_steps(name: str) -> None:
    model, generator = MODELS[name], torch.Generator().manual_seed(1)
    x = torch.randn(3, model.n, generator=generator, **DOUBLE)
    u = torch.randn(3, model.m, generator=generator, **DOUBLE)
    if name == "plant":
        x[:, -4:], u = 3.0 + x[:, -4:], 5000.0 + 300.0 * u
        x[0, -1], u[0, -1] = 0.105, 0.0  # ends at the limit
    with torch.no_grad():
        check(model, "step", x, u)


def flown(**parts) -> tuple[Problem, Tensor, Tensor]:
    """Three planar problems of 7 stages with some parts replaced, and a random trajectory."""
    plain, _ = planar_batch(B=3, N=7)
    known = dict(dynamics=Planar(dt=0.1), cost=plain.cost, constraints=plain.constraints, x0=plain.x0, N=7)
    problem = Problem(**{**known, **parts})
    return problem, *random_trajectory(problem)


def test_costs() -> None:
    generator = torch.Generator().manual_seed(2)
    x_ref, H = torch.randn(3, 8, 6, generator=generator, **DOUBLE), 0.1 * torch.ones(2, 6, **DOUBLE)
    weights = dict(Q=[5.0] * 6, R=[0.7, 0.6], Qf=[50.0] * 6)
    full = QuadraticCost(**weights, x_ref=x_ref, u_ref=[1.0, 2.0], q=torch.arange(6, **DOUBLE), qf=[1.0] * 6, H=H)
    per_stage = QuadraticCost(**weights, x_ref=x_ref[0], r=torch.ones(7, 2, **DOUBLE))
    for cost in (full, per_stage):
        problem, X, U = flown(cost=cost)
        check(problem.cost, "total", X, U)


def test_constraints() -> None:
    generator = torch.Generator().manual_seed(3)
    centers, radii = torch.randn(3, 4, 2, generator=generator, **DOUBLE), torch.full((3, 4), 0.2, **DOUBLE)
    centers[1, 2:], radii[1, 2:] = torch.nan, torch.nan
    lower = torch.tensor([[-1.0, -torch.inf, -1, -1, -1, -1]] * 2 + [[-2.0] * 6], **DOUBLE)
    problem, X, U = flown(
        constraints=[
            Spheres(centers, radii, torch.tensor([0.1, 0.2, 0.3], **DOUBLE), torch.full((3, 4, 2), 0.1, **DOUBLE)),
            Spheres(centers[0], radii[0], knots=[2, -1]),
            StateBounds(lower, [1.0] * 6, knots=[1, 4, 6]),
            FunctionConstraint(lambda x: x[..., :2].norm(dim=-1, keepdim=True) - 1.0, "equality", knots=[-1]),
            FunctionConstraint(lambda x, u: torch.stack((x[..., 0] * u[..., 1], u.prod(-1)), -1), of="xu"),
        ]
    )
    for constraint in problem.constraints:
        check(constraint, "value", X, U)


def test_the_first_step_of_each_quadrotor() -> None:
    x0 = torch.randn(2, 14, generator=torch.Generator().manual_seed(4), **DOUBLE)
    rates = FirstStepRates(torch.tensor([[3.0, 4, 3, 4], [4.0, 3, 4, 4]], **DOUBLE), airframe=Airframe(mass=2.0))
    cost = QuadraticCost(Q=[1.0] * 14, R=[1.0] * 4, Qf=[1.0] * 14)
    problem = Problem(QuadrotorPlanning(), cost, [rates], x0, 3)
    X, U = random_trajectory(problem)
    check(problem.constraints[0], "value", X, U)


ONES = torch.ones(4, 4, **DOUBLE)
FUNCTIONS = {
    "arithmetic": lambda x: (2.0 - x) / (1.5 + x.abs()) - x.reciprocal() * x.sign() + torch.rsub(x, 1.0, alpha=3.0),
    "alpha": lambda x: torch.add(x, x, alpha=3.0) - torch.sub(x, 2.0 * x, alpha=0.5),
    "rounding": lambda x: x.floor() + x.ceil() + torch.div(x, 0.3, rounding_mode="floor") + x % 0.7 + x.fmod(0.4),
    "powers": lambda x: x**3 + x.abs() ** 0.5 + 2.0**x + x.square() + x.abs().rsqrt(),
    "circular": lambda x: x.tan() + (0.2 * x).asin() + (0.2 * x).acos() + x.atan() + x.sin() * x.cos(),
    "hyperbolic": lambda x: x.sinh() + x.cosh() - x.asinh() + (1.0 + x.abs()).acosh() + (0.2 * x).atanh(),
    "exponential": lambda x: x.exp() + x.expm1() + (x.abs() + 1).log() + x.abs().log1p() + x.abs().log2() + x.erf(),
    "activations": lambda x: x.sigmoid() + x.relu() + F.leaky_relu(x, 0.2) + F.gelu(x) + F.silu(x) + F.hardtanh(x),
    "softplus": lambda x: F.softplus(x) + F.softplus(x, beta=3.0, threshold=2.0) + torch.hypot(x, x + 1.0),
    "choices": lambda x: torch.where((x > 0) & (x.cos() <= 0.9) | ~(x < 1.5), x, torch.minimum(x * x, x + 1.0)),
    "limits": lambda x: torch.maximum(x, -x).clamp(min=0.2) + x.clamp(max=0.1) + x.clamp_min(0.0),
    "reductions": lambda x: x.mean(-1, keepdim=True) + x.prod(-1) + x.amax((0, 1)) - x.amin() + x.sum() + x.cumsum(-1),
    "norms": lambda x: x.norm(dim=-1) + torch.linalg.vector_norm(x) + torch.linalg.norm(x, dim=-1),
    "any": lambda x: (x > 0.5).any(-1, keepdim=True).to(x.dtype) * x + (x > -9.0).all() * 2.0 * x,
    "matrices": lambda x: (x.mT @ x) @ ONES[0] + torch.einsum("bi,ij,bj->b", x, ONES, x),
    "products": lambda x: torch.linalg.cross(x[..., :3], torch.ones_like(x[..., 1:])) + torch.outer(x[0], x[0])[:3, 1],
    "a matrix times vectors": lambda x: F.linear(x[0], ONES.cumsum(-1), ONES[0]) + F.linear(x[0], ONES[1:2]),
    "own shape changed": lambda x: (2.0 * x).unsqueeze_(-1).squeeze_(0).t_() + (2.0 * x).transpose_(0, 1).t_(),
    "shapes": lambda x: x.reshape(2, 2).T.flip(0).repeat(1, 2).unsqueeze(0).squeeze().expand(3, 2, 4).flatten(),
    "parts": lambda x: torch.cat((*x.split(2, dim=-1), torch.stack(x.unbind(-1), -1), *x.chunk(2, -1)), dim=-1),
    "places": lambda x: x[:, torch.tensor([3, 0])] + x.index_select(1, torch.tensor([1, 1])) + x[..., 1:-1:1],
    "gather": lambda x: x.gather(1, torch.tensor([[2, 1]])) + x[:, torch.tensor([True, False, True, False])],
    "diagonal": lambda x: (x.unsqueeze(-1) * x.unsqueeze(-2)).diagonal(dim1=-2, dim2=-1) + torch.diag_embed(x)[..., 0],
    "constants": lambda x: x + torch.linalg.inv(ONES + ONES.diag().diag()).sum(-1) + x.new_full((4,), 3.0),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_operations(name: str) -> None:
    x = torch.tensor([[0.3, -1.2, 1.7, 0.9]], **DOUBLE)
    made = by_casadi(lambda i, x: FUNCTIONS[name](x), [0], x)
    torch.testing.assert_close(made, FUNCTIONS[name](x), rtol=1e-12, atol=1e-12)


@pytest.mark.filterwarnings("ignore:Sparse CSR tensor support")
def test_a_captured_matrix_may_be_sparse() -> None:
    rates = torch.diag(torch.arange(1, 4, **DOUBLE), 1).to_sparse_csr()
    x = torch.tensor([[0.3, -1.2, 1.7, 0.9]], **DOUBLE)
    torch.testing.assert_close(by_casadi(lambda i, x: (rates @ x.mT).mT, [0], x), x @ rates.to_dense().mT)


KINKS = {
    "abs": lambda x: x.abs() * (1.0 + x),
    "clamp": lambda x: x.clamp(min=0.0).square() + x.clamp(max=0.0) + x.clamp_min(0.0),
    "hardtanh": lambda x: F.hardtanh(x, 0.0, 1.0) + F.hardtanh(x, -1.0, 0.0) * (1.0 + x),
    "relu": lambda x: x.relu().square() + x.relu(),
    "norm": lambda x: x.norm(dim=-1),
    "where": lambda x: torch.where(x.abs() < 1.0, x.square(), x.abs()),
    "softplus": F.softplus,
    "sigmoid": torch.sigmoid,
    "logsigmoid": F.logsigmoid,
}


@pytest.mark.parametrize("name", KINKS)
def test_at_a_kink_derivatives_are_those_of_pytorch(name: str) -> None:
    def function(x: Tensor) -> Tensor:
        return KINKS[name](x).sum(-1)

    x = torch.tensor([[0.0, 0.0, 0.0, 0.0]], **DOUBLE)
    traced, (column, elements) = Traced("field", lambda i, x: function(x), x), symbols("x", (1, 4))
    value = ca.vertcat(*traced(np.zeros(0), elements).reshape(-1))
    slope = ca.jacobian(value, column, {"allow_reverse": False})
    made = ca.Function("made", [column], [slope, ca.jacobian(slope, column, {"allow_reverse": False})])(x[0].numpy())
    for mine, theirs in zip(made, gradient_and_hessian(lambda x: KINKS[name](x).sum(-1), x), strict=True):
        torch.testing.assert_close(torch.from_numpy(np.array(mine)), theirs.reshape(mine.shape))


def test_a_clamped_nan_stays_one() -> None:
    x = torch.tensor([[torch.nan, 2.0]], **DOUBLE)
    made = by_casadi(lambda i, x: x.clamp(0.0, 1.0) + x.relu(), [0], x)
    torch.testing.assert_close(made, x.clamp(0.0, 1.0) + x.relu(), equal_nan=True)


def test_constants_may_be_replaced() -> None:
    """All constants but index tensors."""
    weights, picked = torch.tensor([2.0, 3.0], **DOUBLE), torch.tensor([1, 0])
    function = lambda i, x: x.new_tensor([2.0, 3.0]) * x[:, picked] + (weights > 2.5)
    traced = Traced("field", function, torch.zeros(1, 2, **DOUBLE))
    assert sorted(traced.constants) == [0.0, 1.0, 2.0, 3.0] and traced.pattern.size == 0
    x = np.array([[5.0, 7.0]], dtype=object)
    assert traced(np.zeros(0), x).tolist() == traced(np.zeros(0), x, constants=traced.constants).tolist() == [[14, 16]]
    assert traced(np.zeros(0), x, constants=np.zeros(4)).tolist() == [[0.0, 0.0]]


WEIGHTS = torch.tensor([[2.0, 0.0], [1.0, -1.0]], **DOUBLE)
LEARNED = torch.zeros(2, **DOUBLE, requires_grad=True)
ARRAY = np.array([4.0, 5.0])


def test_captured_numbers_are_read_again_and_a_structure_of_others_stays() -> None:
    def function(i: Tensor, x: Tensor) -> Tensor:
        return x @ WEIGHTS.T.exp().log() + LEARNED.tanh() + torch.from_numpy(ARRAY) + (WEIGHTS[0] > 1.0)

    weights, learned, array = WEIGHTS.clone(), LEARNED.detach().clone(), ARRAY.copy()
    traced = Traced("field", function, torch.zeros(1, 2, **DOUBLE))
    key, x = traced.fingerprint(), np.array([[5.0, 7.0]], dtype=object)
    try:
        # The exponentials are PyTorch's part: rounding may move 1 and -1, so the zero alone is structural.
        assert 1 <= (~np.isnan(traced.pattern)).sum() <= 3 and len(traced.pattern) == 8
        WEIGHTS[0, 0], ARRAY[1] = 3.0, 0.5
        with torch.no_grad():
            LEARNED.fill_(0.2)
        shared, again = traced.shared_numbers(), Traced("field", function, torch.zeros(1, 2, **DOUBLE))
        assert shared is not None and again.fingerprint() == key
        for one in (traced(np.zeros(0), x, shared=shared.numpy()), again(np.zeros(0), x)):
            expected = function(torch.zeros(1), torch.tensor(x.astype(float))).detach()
            np.testing.assert_allclose(one.astype(float), expected.numpy(), rtol=1e-14)
        WEIGHTS[0, 1] = 0.1
        assert traced.shared_numbers() is None
        assert Traced("field", function, torch.zeros(1, 2, **DOUBLE)).fingerprint() != key
        WEIGHTS[0, 1], WEIGHTS[0, 0] = 0.0, 0.9  # no longer above 1, which is a constant
        assert traced.shared_numbers() is None
        WEIGHTS[0, 0], WEIGHTS.data = 3.0, WEIGHTS.data.view(1, 4)
        assert traced.shared_numbers() is None
    finally:
        WEIGHTS.data = weights
        LEARNED.data.copy_(learned)
        ARRAY[:] = array


def test_writing_in_place() -> None:
    def function(i: Tensor, x: Tensor) -> Tensor:
        kept = x.clone()
        kept[:, 1:3] *= 2.0
        kept[:, torch.tensor([0, 3])] = x[:, :2]
        kept.index_put_((torch.tensor([0]), torch.tensor([1])), x[0, 3], accumulate=True)
        kept[..., -1].fill_(7.0)
        kept.view(1, 2, 2).diagonal(dim1=1, dim2=2).mul_(3.0)
        kept.view(2, 2).diagonal(1).add_(1.0)
        return kept

    x = torch.tensor([[0.3, -1.2, 1.7, 0.9]], **DOUBLE)
    torch.testing.assert_close(by_casadi(function, [0], x), function(torch.zeros(1), x))


def test_a_constant_may_be_read() -> None:
    """Only values that depend on the arguments cannot be converted to Python numbers."""
    size = torch.tensor(2.0)
    x = torch.rand(1, 4, **DOUBLE)
    made = by_casadi(lambda i, x: x[:, : int(size)] * float(size + 1.0), [0], x)
    torch.testing.assert_close(made, 3.0 * x[:, :2])


@pytest.mark.parametrize(
    ("function", "named"),
    [
        (torch.erfinv, "erfinv"),
        (lambda x: F.gelu(x, approximate="none") + torch.erfc(x), "erfc"),
        (lambda x: x.to(torch.int64).double(), "_to_copy"),
        (lambda x: x if float(x.sum()) > 0 else -x, "traced"),
    ],
)
def test_unsupported_operations_are_named(function, named: str) -> None:
    with pytest.raises(InputError, match=named) as caught:
        by_casadi(lambda i, x: function(x), [0], torch.rand(1, 4, **DOUBLE))
    assert caught.value.field == "field"


TABLE, OUTER = torch.tensor([2, 0, 1]), torch.randn(3, 4, dtype=torch.float64)
MOVES = {
    "a row": (lambda own, i: own[i], True),
    "part of a row": (lambda own, i: own[i][:, 1:3], True),
    "in another order": (lambda own, i: torch.cat((own[i][:, 2:], own[i][:, :1]), dim=-1), True),
    "computed": (lambda own, i: 2.0 * own[i], False),
    "always of the first problem": (lambda own, i: own[:1], False),
    "columns": (lambda own, i: own[:1, i], False),
    "through a table": (lambda own, i: own[TABLE[i]], False),
    "of others, too": (lambda own, i: torch.cat((own[i], OUTER[i]), dim=-1), False),
}


@pytest.mark.parametrize("name", MOVES)
def test_numbers_that_are_only_moved_are_those_that_are_computed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    move, is_picked = MOVES[name]
    own = torch.randn(3, 4, **DOUBLE)
    traced = Traced("f", lambda i, x: x.sum() * move(own, i), torch.zeros(1, 2, **DOUBLE), own=[own])
    index = torch.tensor([2, 0, 2, 1])
    found = traced.parameters_of(index)
    assert (traced.picks is not None) == is_picked
    monkeypatch.setitem(vars(traced), "picks", None)
    assert torch.equal(found, traced.parameters_of(index))
