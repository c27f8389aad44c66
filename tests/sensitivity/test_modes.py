"""Ways to differentiate: many right hand sides at once, forward mode, double backward, and what is refused."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad

import torchgco
from tests.engines import compiled
from tests.sensitivity.problems import D, along, discs, numbers, solved, weights
from tests.sensitivity.test_contract import COST, MODEL, small
from torchgco import ControlBounds, FreeTime, FunctionDynamics, Goal, InputError, Problem, QuadraticCost, Spheres
from torchgco.base.autodiff import jacobian as jacobian_of
from torchgco.base.autodiff import slope_along
from torchgco.kernels import use_native

X0 = torch.tensor([[1.0, 0.0], [-1.5, 1.0]], dtype=D)
V = torch.tensor([[0.3, -1.0], [0.7, 0.2]], dtype=D)


def ends(x0: Tensor) -> Tensor:
    """Controls, states, multipliers and costs."""
    found = small(x0)
    parts = found.U[:, :4], found.X[:, -1], found.multipliers.lam[0][:, :2], found.cost
    return torch.cat([part.flatten() for part in parts])


@pytest.fixture(scope="module")
def jacobian() -> Tensor:
    """Row by row; test_kinds compares such rows with differences."""
    rows = torch.autograd.functional.jacobian(ends, X0)
    assert isinstance(rows, Tensor)
    return rows


def test_jacobians_of_all_outputs_at_once_are_those_one_by_one(jacobian: Tensor) -> None:
    assert float(jacobian.abs().amax(dim=(1, 2)).max()) > 0.1
    assert torch.equal(torch.autograd.functional.jacobian(ends, X0, vectorize=True), jacobian)
    x0 = X0.clone().requires_grad_()
    out = ends(x0)
    slope = lambda v: torch.autograd.grad(out, x0, v, retain_graph=True)[0]
    basis = torch.eye(len(out)).to(D)
    assert torch.equal(torch.func.vmap(slope)(basis), jacobian)
    assert torch.equal(torch.autograd.grad(out, x0, basis, retain_graph=True, is_grads_batched=True)[0], jacobian)


@compiled
def test_products_with_tangents(jacobian: Tensor) -> None:
    want = torch.tensordot(jacobian, V, dims=2)
    _, twice = torch.autograd.functional.jvp(ends, X0, V)
    torch.testing.assert_close(twice, want, rtol=1e-12, atol=1e-12)
    with forward_ad.dual_level():
        found = forward_ad.unpack_dual(ends(forward_ad.make_dual(X0, V)))
        torch.testing.assert_close(found.tangent, want, rtol=1e-12, atol=1e-12)
        assert torch.equal(found.primal.detach(), ends(X0.clone().requires_grad_()).detach())
        with torch.no_grad():  # which says nothing of forward mode
            assert forward_ad.unpack_dual(ends(forward_ad.make_dual(X0, V))).tangent is not None
        assert forward_ad.unpack_dual(ends(X0)).tangent is None
    ahead = torch.autograd.functional.jacobian(ends, X0, vectorize=True, strategy="forward-mode")
    torch.testing.assert_close(ahead, jacobian, rtol=1e-12, atol=1e-12)


@compiled
def test_tangents_of_everything_that_a_problem_is_made_of() -> None:
    """In fields of all parts, in captured tensors and in weights of a net: products from both sides agree."""
    leaves, whole = solved(discs, numbers)
    aim = weights(whole)
    slopes = torch.autograd.grad(along(whole, aim).sum(), list(leaves.values()), retain_graph=True)
    torch.manual_seed(3)
    tangents = [torch.where(torch.isfinite(leaf), torch.randn_like(leaf), 0.0) for leaf in leaves.values()]
    want = sum(float((slope * tangent).sum()) for slope, tangent in zip(slopes, tangents, strict=True))
    with forward_ad.dual_level():
        made = (forward_ad.make_dual(leaf.detach(), by) for leaf, by in zip(leaves.values(), tangents, strict=True))
        problem = discs(dict(zip(leaves, made, strict=True)))
        found = torchgco.solve(problem, warm=whole, solver="interior_point", verbose=False)
        assert bool(found.differentiable.all())
        ahead = forward_ad.unpack_dual(along(found, aim).sum()).tangent
    assert ahead is not None and float(ahead.detach()) == pytest.approx(want, rel=1e-6)


def test_forward_mode_needs_kernels_in_c() -> None:
    use_native(False)
    try:
        with forward_ad.dual_level(), pytest.raises(InputError, match=r"functional\.jvp"):
            small(forward_ad.make_dual(X0, V))
    finally:
        use_native(True)


@pytest.mark.slow
@compiled
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
def test_a_solve_in_free_time_is_the_same_within_forward_mode() -> None:
    """Its search takes derivatives of its own, and PyTorch nests no forward mode."""
    ahead = lambda x, u: torch.cat((x[..., 2:], u), -1)
    problem = Problem(
        FunctionDynamics(ahead, n=4, m=2, dt=0.15, integrator="rk4", position=slice(0, 2)),
        QuadraticCost(Q=[0.0] * 4, R=[0.05] * 2, Qf=[0.0] * 4),
        [ControlBounds(-3.0, 3.0), Spheres([[1.0, -0.6]], 0.3, 0.1, velocities=[[0.0, 0.5]])],
        [0.0] * 4,
        12,
        Goal(state=[2.0, 0.3, 0.0, 0.0], required=True),
        time=FreeTime(0.2, 4.0, weight=1.0),
    )
    outside = torchgco.solve(problem, solver="interior_point", verbose=False)
    with forward_ad.dual_level():
        within = torchgco.solve(problem, solver="interior_point", verbose=False)
    torch.testing.assert_close(within.U, outside.U, rtol=1e-9, atol=1e-9)


def test_slopes_along_tangents_within_forward_mode() -> None:
    function = lambda x, u: torch.stack((x[..., 0] * u[..., 0].sin(), x[..., 1].exp() + u[..., 0] ** 3), -1)
    args, tangents = (X0, V[:, :1]), (V, X0[:, :1])
    outside = slope_along(function, args, tangents), *jacobian_of(function, *args)
    with forward_ad.dual_level():
        within = slope_along(function, args, tangents), *jacobian_of(function, *args)
    for one, other in zip(within, outside, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-14, atol=1e-14)


@compiled
def test_smoothed_solutions_have_tangents() -> None:
    """Of the cost, too, which isn't at its minimum there."""
    leaf = X0.clone().requires_grad_()
    make = lambda x0: Problem(MODEL, COST, [ControlBounds(-1.0, 1.0)], x0, 10)
    cost = torchgco.solve(make(leaf), smoothing=1e-3, verbose=False).cost.sum()
    (slope,) = torch.autograd.grad(cost, leaf)
    with forward_ad.dual_level():
        found = torchgco.solve(make(forward_ad.make_dual(X0, V)), smoothing=1e-3, verbose=False)
        tangent = forward_ad.unpack_dual(found.cost.sum()).tangent
    assert tangent is not None and float(tangent.detach()) == pytest.approx(float((slope * V).sum()), rel=1e-9)


@compiled
def test_a_second_derivative_is_refused() -> None:
    """By both modes in any order, and of tangents after their level, too; the error says what to write instead."""
    x0 = torch.tensor([[1.0, 0.0]], dtype=D, requires_grad=True)
    v, functional = torch.ones_like(x0), torch.autograd.functional
    found, loss = small(x0), lambda x: small(x).X.square().sum()
    refused = pytest.raises(RuntimeError, match=r"no second derivatives: take differences of gradients")
    for value in (found.U.sum(), found.cost.sum()):
        (slope,) = torch.autograd.grad(value, x0, create_graph=True)
        with refused:
            torch.autograd.grad(slope.sum(), x0)
    for call in (functional.hvp, functional.vhp):
        with refused:
            call(loss, x0.detach(), v)
    for outer in ("reverse-mode", "forward-mode"):
        with refused:
            functional.hessian(loss, x0.detach(), vectorize=True, outer_jacobian_strategy=outer)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(x0, v)
        tangents = [forward_ad.unpack_dual(part).tangent for part in (loss(dual), small(dual).U.sum())]
        with refused:
            torch.autograd.grad(loss(dual), x0)
        with refused:
            torch.autograd.grad(tangents[0], x0, retain_graph=True)
    for tangent in tangents:
        with refused:
            torch.autograd.grad(tangent, x0)


TRANSFORMS = {
    "grad": (lambda: torch.func.grad(lambda x: ends(x).sum())(X0), "torch.autograd.grad"),
    "vjp": (lambda: torch.func.vjp(ends, X0), "torch.autograd.grad"),
    "jacrev": (lambda: torch.func.jacrev(ends)(X0), "torch.autograd.functional.jacobian"),
    "hessian": (lambda: torch.func.hessian(lambda x: ends(x).sum())(X0), "torch.autograd.functional.jacobian"),
    "jvp": (lambda: torch.func.jvp(ends, (X0,), (V,)), "torch.autograd.functional.jvp"),
    "jacfwd": (lambda: torch.func.jacfwd(ends)(X0), "torch.autograd.functional.jvp"),
    "linearize": (lambda: torch.func.linearize(ends, X0), "torch.autograd.functional.jvp"),
    "vmap": (lambda: torch.func.vmap(ends)(X0.unsqueeze(1)), "one call takes a whole batch"),
    "a captured number": (lambda: torch.func.grad(lambda by: small(X0, by).U.sum())(V[:, :1]), "torch.autograd.grad"),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_transforms_of_torch_func_are_refused_in_one_line(name: str) -> None:
    call, instead = TRANSFORMS[name]
    with pytest.raises(InputError, match=r"Problem: expected a call outside of torch\.func") as caught:
        call()
    assert "\n" not in str(caught.value) and instead in str(caught.value)


def test_tangents_that_cannot_be_followed_are_refused() -> None:
    """A goal that is only stated changes no minimum."""
    model = torchgco.FunctionDynamics(lambda x, u: u, 1, 1, 0.1, position=slice(0, 1))
    cost = QuadraticCost([1.0], [1.0], [1.0])
    with forward_ad.dual_level(), pytest.raises(InputError, match=r"goal\.radius"):
        radius = forward_ad.make_dual(torch.ones((), dtype=D), torch.ones((), dtype=D))
        Problem(model, cost, [], torch.ones(1, 1, dtype=D), 10, Goal([1.0], radius))
