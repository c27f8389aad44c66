"""Operations that are written out in others: values, slopes and curvatures are those of PyTorch."""

from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchgco import InputError
from torchgco.tracing import Traced

D = torch.float64
torch.manual_seed(0)
A = torch.randn(4, 4, dtype=D)
LEFT, PLACES = A[:2, :2], torch.tensor([[1, 0, 0, 3]])
LAYER, GROUPS, RMS, BATCH = nn.LayerNorm(4), nn.GroupNorm(2, 4), nn.RMSNorm(4), nn.BatchNorm1d(4)
for norm in (LAYER, GROUPS, BATCH):
    nn.init.uniform_(norm.weight), nn.init.uniform_(norm.bias)
CELLS = nn.GRUCell(4, 3), nn.LSTMCell(4, 3), nn.RNNCell(4, 3)
LINE, PLANE, BILINEAR = nn.Conv1d(1, 2, 3), nn.Conv2d(1, 2, 2, padding=1), nn.Bilinear(4, 4, 3)
LOOKING = nn.MultiheadAttention(4, 2, batch_first=True)
for module in (LAYER, GROUPS, RMS, BATCH, *CELLS, LINE, PLANE, BILINEAR, LOOKING):
    module.double().eval().requires_grad_(False)
Function = Callable[[Tensor], Tensor]

SMOOTH: dict[str, Function] = {
    "softmax": lambda x: (3.0 * x).softmax(-1),
    "log_softmax": lambda x: F.log_softmax(x, -1),
    "softmin": lambda x: F.softmin(x, -1),
    "attention": lambda x: LOOKING(x[:, None], x[:, None], x[:, None])[0][:, 0],
    "layer norm": lambda x: LAYER(x),
    "group norm": lambda x: GROUPS(x),
    "RMS norm": lambda x: RMS(x),
    "batch norm": lambda x: BATCH(x),
    "instance norm": lambda x: F.instance_norm(x.reshape(-1, 2, 2)).flatten(1),
    "GRU cell": lambda x: CELLS[0](x, x[..., :3]),
    "LSTM cell": lambda x: CELLS[1](x, (x[..., :3], x[..., 1:]))[0],
    "RNN cell": lambda x: CELLS[2](x, x[..., :3]),
    "convolution": lambda x: LINE(x[:, None]).flatten(1),
    "convolution in 2-D": lambda x: PLANE(x.reshape(-1, 1, 2, 2)).flatten(1),
    "convolution of groups": lambda x: F.conv1d(
        x.reshape(-1, 2, 2), LEFT.reshape(2, 1, 2), stride=2, padding=1, groups=2
    ).flatten(1),
    "bilinear": lambda x: BILINEAR(x, x.flip(-1)),
    "mean pool": lambda x: F.avg_pool1d(x[:, None], 2)[:, 0],
    "pad": lambda x: F.pad(x.square(), (1, 2), value=0.3),
    "std": lambda x: x.std(-1, keepdim=True),
    "var": lambda x: torch.cat((x.var(-1, keepdim=True), x.var(-1, correction=0, keepdim=True)), -1),
    "var_mean": lambda x: torch.cat(torch.var_mean(x, -1, keepdim=True), -1),
    "norm of order 3": lambda x: x.norm(p=3, dim=-1, keepdim=True),
    "norm of order 1": lambda x: x.norm(p=1, dim=-1, keepdim=True),
    "largest norm": lambda x: x.norm(p=torch.inf, dim=-1, keepdim=True),
    "cosine similarity": lambda x: F.cosine_similarity(x, x.flip(-1) + A[0], dim=-1).unsqueeze(-1),
    "sort": lambda x: x.sin().sort(-1)[0],
    "sort of three, downwards": lambda x: x[..., :3].sort(-1, descending=True).values.square(),
    "topk": lambda x: x.square().topk(2, -1)[0],
    "smallest of two": lambda x: x.kthvalue(2, -1, keepdim=True)[0],
    "median": lambda x: x.square().median(-1, keepdim=True)[0],
    "max and min": lambda x: torch.cat((x.max(-1, keepdim=True)[0], x.square().min(-1, keepdim=True)[0]), -1),
    "cumprod": lambda x: x.cumprod(-1),
    "cummax": lambda x: x.cummax(-1)[0] + x.cummin(-1)[0].square(),
    "logcumsumexp": lambda x: x.logcumsumexp(-1),
    "scatter": lambda x: x.scatter(-1, PLACES[:, [3, 1, 0]], x[..., 1:].square()) + x.scatter(-1, PLACES[:, :1], 2.0),
    "scatter_add": lambda x: x.scatter_add(-1, PLACES, x.square()),
    "unfold": lambda x: x.square().unfold(-1, 2, 1).flatten(1),
    "exp2": lambda x: torch.exp2(x) + torch.ldexp(x, A[0]),
    "xlogy": lambda x: torch.xlogy(x, x.square()) + torch.special.xlog1py(x, x.abs()),
    "copysign": lambda x: torch.copysign(x, x.flip(-1)) + torch.copysign(x.square(), -2.0),
    "fmax": lambda x: torch.fmax(x, x.square()) + torch.fmin(x.sin(), x),
    "fraction": lambda x: x.frac() * x,
    "jvp": lambda x: torch.func.jvp(lambda z: z.sin() * z.flip(-1), (x,), (x.square(),))[1],
}  # fmt: skip
VALUES: dict[str, Function] = {  # steps, and those whose derivatives PyTorch has wrong, as NaN or not at all
    "jvp of a norm": lambda x: torch.func.jvp(LAYER, (x,), (x.square(),))[1],
    "nan_to_num": lambda x: x.sqrt().nan_to_num(7.0) + x,
    "nansum": lambda x: x.log().nansum(-1, keepdim=True),
    "nanmean": lambda x: x.log().nanmean(-1, keepdim=True),
    "round": lambda x: (10.0 * x).round() + torch.tensor([0.5, 1.5, -2.5, -0.5], dtype=D).round(),
    "halves": lambda x: (2.0 * x).trunc().add(0.5).round() + (2.0 * x).trunc().sub(0.5).round(),
    "round to a digit": lambda x: x.round(decimals=1) + (100.0 * x).round(decimals=-1),
    "trunc": lambda x: (3.0 * x).trunc() + torch.div(x, 0.3, rounding_mode="trunc"),
    "isnan": lambda x: x.sqrt().isnan().to(D) + (1.0 / x.trunc()).isinf().to(D),
    "signbit": lambda x: x.signbit().to(D),
    "xor": lambda x: torch.logical_xor(x > 0, x.flip(-1) > 0.3).to(D),
    "heaviside": lambda x: torch.heaviside(x, A[0]),
    "cdist": lambda x: torch.cdist(x.reshape(-1, 2, 2), LEFT).flatten(1),
    "softshrink": lambda x: F.softshrink(x, 0.3) + F.softshrink(x.sqrt()),
    "one of four": lambda x: F.one_hot(torch.tensor([2]), 4).to(x) * x.sign(),
}
AT_ZERO: dict[str, tuple[Function, bool]] = {  # where PyTorch's slope is 0, and whether it has a curvature there
    "std": (lambda x: x.std(-1, keepdim=True), True),
    "std_mean": (lambda x: torch.cat(torch.std_mean(x, -1, correction=0, keepdim=True), -1), True),
    **{
        f"norm of order {p}": (lambda x, p=p: torch.linalg.vector_norm(x, p, -1, keepdim=True), p == 3)
        for p in (-1, 0.5, 1.5, 2.5, 3)
    },
}
POINTS = 1.5 * torch.randn(6, 4, dtype=D, generator=torch.Generator().manual_seed(1))


def traced(function: Function) -> tuple[ca.SX, ca.SX]:
    x = ca.SX.sym("x", 4)
    made = Traced("field", lambda i, z: function(z), torch.zeros(1, 4, dtype=D))
    elements = np.array(ca.vertsplit(x), dtype=object).reshape(1, 4)
    assert made.count == 0
    return x, ca.vertcat(*(ca.SX(element) for element in made(np.zeros(0), elements).reshape(-1)))


def compared(function: Function, curved: bool, points: Tensor = POINTS, sloped: bool = False) -> None:
    x, y = traced(function)
    weights = torch.cos(torch.arange(y.numel(), dtype=D))
    slopes, (H, _) = ca.jacobian(y, x), ca.hessian(ca.dot(ca.DM(weights.numpy()), y), x)
    mine = ca.Function("made", [x], [y, slopes, H])
    whole = lambda z: function(z[None])[0]
    for point in points:
        value, J, H = (torch.from_numpy(np.array(part)) for part in mine(point.numpy()))
        near = {"rtol": 1e-9, "atol": 1e-9, "equal_nan": True}
        torch.testing.assert_close(value.flatten(), whole(point), **near)
        if curved or sloped:
            torch.testing.assert_close(J, torch.autograd.functional.jacobian(whole, point), **near)
        if curved:
            total = lambda z: (weights * whole(z)).sum()
            torch.testing.assert_close(H, torch.autograd.functional.hessian(total, point), rtol=1e-8, atol=1e-8)


@pytest.mark.sampled(15)
@pytest.mark.parametrize("name", SMOOTH)
def test_values_and_derivatives_are_those_of_pytorch(name: str) -> None:
    compared(SMOOTH[name], True)


@pytest.mark.parametrize("name", VALUES)
def test_values_are_those_of_pytorch(name: str) -> None:
    compared(VALUES[name], False)


@pytest.mark.parametrize("name", AT_ZERO)
def test_slopes_at_zeros_and_of_equal_numbers_are_those_of_pytorch(name: str) -> None:
    function, curved = AT_ZERO[name]
    equal = torch.tensor([[0.0] * 4, [0.0, 1.0, 2.0, 0.0]] + [[0.5] * 4] * ("std" in name), dtype=D)
    compared(function, curved, equal, True)


def test_sorted_numbers_are_in_order_for_all_lengths() -> None:
    for n in range(1, 10):
        x = torch.rand(1, n, dtype=D, generator=torch.Generator().manual_seed(n))
        made = Traced("field", lambda i, z: z.sort(-1).values, torch.zeros(1, n, dtype=D))
        found = np.asarray(made(np.zeros(0), x.numpy().astype(object)), dtype=float)
        assert np.array_equal(found, np.sort(x.numpy()))


def test_what_was_written_by_way_of_another_tensor_is_not_read() -> None:
    """A cell writes into parts of one tensor, each of which it reads alone; another operation reads all of it."""
    with pytest.raises(InputError, match="written by way of another"):
        traced(lambda x: F.pad(x[:, None], (1, 1), mode="circular")[:, 0])


def test_places_that_depend_on_values_are_refused_by_name() -> None:
    for function in (lambda x: x.sort(-1)[1].to(D), lambda x: A[0][x.argmax(-1)]):
        with pytest.raises(InputError, match="argmax"):
            traced(function)
