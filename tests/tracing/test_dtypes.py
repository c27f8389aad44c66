"""Compiled code has the values of PyTorch's types: each function in C against itself in PyTorch."""

import itertools
from collections.abc import Callable

import casadi as ca
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from tests.native.lanes import Emitted
from tests.tracing.test_traced import symbols
from torchgco import InputError
from torchgco.native.codegen.emit import emit
from torchgco.native.compiler import find_compiler
from torchgco.tracing import Traced

D = torch.float64
W32 = torch.tensor([[0.3, -1.7, 0.2], [1.1, 0.4, -0.6], [-0.9, 0.8, 0.5]])
MASK = torch.tensor([True, False, True])
HOLES = torch.tensor([torch.nan, 0.0, -1.0], dtype=D)
POINTS = torch.cat(
    (
        torch.randn(40, 3, generator=torch.Generator().manual_seed(7), dtype=D),
        torch.tensor(list(itertools.product((-1.0, 0.0, 0.5), repeat=3)), dtype=D),
        torch.tensor([[torch.nan, 0.5, -1.0], [0.2, torch.nan, torch.nan], [1e4, -1e4, 3.0]], dtype=D),
    )
)


def written(z: Tensor, dtype: torch.dtype, source: Tensor) -> Tensor:
    buffer = torch.zeros(z.shape, dtype=dtype)
    buffer[..., 1:] = source[..., 1:]
    return buffer


EXACT: dict[str, Callable[[Tensor], Tensor]] = {
    "masks added": lambda z: z * ((z > 0) + (z > 0.4)),
    "masks added in place": lambda z: z + (z > 0).add_(z > 0.4),
    "masks multiplied": lambda z: z * ((z > 0) * (z > -0.7)),
    "mask of numbers": lambda z: torch.ones_like(z) * z.bool(),
    "boolean buffer": lambda z: torch.ones_like(z) * written(z, torch.bool, z),
    "boolean sum": lambda z: torch.ones_like(z) * torch.sum(z > 0, -1, keepdim=True, dtype=torch.bool),
    "any of numbers": lambda z: torch.ones_like(z) * z[..., :1].any(-1, keepdim=True),
    "filled masks": lambda z: z * torch.full_like(z > 0, 3) + (z > 0).new_full((3,), 2),
    "filled integers": lambda z: (
        z * torch.full_like(z, 2.7, dtype=torch.int64) + z.new_full((3,), -2.7, dtype=torch.int32)
    ),
    "filled with integers": lambda z: z * torch.zeros_like(z, dtype=torch.int64).fill_(2.5),
    "integer buffer": lambda z: z + written(z, torch.int64, (z > 0) * 3),
    "counts": lambda z: z * ((z > 0).sum(-1, keepdim=True) % 2 + (z > 0).cumsum(-1) // 2 - ~(z > 0.4).int()),
    "bytes": lambda z: z * (torch.where(z > 0, 100, 1).to(torch.int8) * 2 + (z > 0.4).to(torch.int8)),
    "bytes without sign": lambda z: z * (torch.where(z > 0, 3, 1).to(torch.uint8) - 2),
    "powers": lambda z: z * torch.where(z > 0, 3, -2) ** 3,
    "single": lambda z: z.float().to(D) + z.to(torch.float32),
    "computed in single": lambda z: (z.float() * 0.1 + 3.0 / (z.float().abs() + 0.7)).to(D),
    "single buffer": lambda z: torch.zeros(z.shape).copy_(z).square().to(D),
    "thirds": lambda z: z * (torch.where(z > 0, 1, 2) / 3),
    "limit in single": lambda z: z * (z.float() <= 0.1),
    "greatest": lambda z: torch.maximum(z.sqrt(), z) + torch.maximum(z, z.log()),
    "least": lambda z: torch.minimum(z.sqrt(), z) + torch.minimum(z, z.log()),
    "greatest of all": lambda z: z.sqrt().amax(-1, keepdim=True) + z.log().amin(-1, keepdim=True) + z,
    "sign": lambda z: z.sqrt().sign() + z.sign(),
    "finite": lambda z: torch.where(z.log().isfinite(), z, -1.0),
    "equal to itself": lambda z: (lambda y: torch.where(y == y, y, z) + torch.where(y != y, 2.0, z))(z.sqrt()),
    "a square": lambda z: torch.where(z.sqrt().square() >= 0.0, z, 5.0) + torch.where(z <= z, z, 0.0),
    "grid": lambda z: torch.div(z, 0.1, rounding_mode="floor") + z // -0.7 + z // W32[0, 0],
    "wrapped": lambda z: z % 0.1 + z % -0.7 + (z + torch.pi) % (2.0 * torch.pi),
    "limits without a number": lambda z: z.clamp(min=HOLES) + z.clamp(max=HOLES) + z.clamp(max=z.sqrt()),
    "log of a sigmoid": lambda z: (30.0 * z).sigmoid().log() + 1e-9 / (15.0 * z).sigmoid(),
    "bytes as a mask": lambda z: z * z[..., MASK.byte()].sum(-1, keepdim=True),
    "any of bytes": lambda z: z * torch.where(z > 0.0, 5, 0).byte()[..., :1].any(-1, keepdim=True),
    "fewer gathered": lambda z: (z.unsqueeze(-1) * z.unsqueeze(-2)).gather(-1, MASK.long().expand(len(z), 1, 3)).sum(1),
    "quotients of whole numbers": lambda z: z * (torch.arange(1, 4) / 7) + torch.arange(3).sqrt(),
}  # fmt: skip
ROUNDED: dict[str, Callable[[Tensor], Tensor]] = {  # sums in single precision, whose order isn't PyTorch's
    "network": lambda z: F.silu(z.float() @ W32).to(D),
    "sum in single": lambda z: z * z.sum(-1, keepdim=True, dtype=torch.float32),
}


@pytest.mark.filterwarnings("ignore:indexing with dtype torch.uint8")
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_values_in_c_are_those_of_pytorch() -> None:
    names = [*EXACT, *ROUNDED]
    x, elements = symbols("x", (1, 3))
    made = [Traced(name, lambda i, z, name=name: (EXACT | ROUNDED)[name](z), POINTS[:1] * 0.0) for name in names]
    column = ca.densify(ca.vertcat(*(one(np.zeros(0), elements).reshape(-1)[j] for one in made for j in range(3))))
    code = emit("tgco_made", ca.Function("made", [x], [column]))
    (values,) = Emitted(code, "tgco_made", [3], [3 * len(names)])(POINTS.numpy())
    for at, name in enumerate(names):
        expected, tolerance = (EXACT | ROUNDED)[name](POINTS), 1e-14 if name in EXACT else 3e-7
        mine = torch.from_numpy(values[:, 3 * at : 3 * at + 3])
        scale = max(1.0, float(expected.nan_to_num().abs().amax())) if name in ROUNDED else 1.0
        torch.testing.assert_close(
            mine,
            expected,
            rtol=tolerance,
            atol=tolerance * scale,
            equal_nan=True,
            msg=lambda m, name=name: f"{name}: {m}",
        )


BUFFER = np.zeros(3)


def written_by_numpy(z: Tensor) -> Tensor:
    for i in range(3):
        BUFFER[:] = i
        z = z * (1.0 + torch.from_numpy(BUFFER))
    return z


def caught(z: Tensor, look: Callable[[Tensor], object]) -> Tensor:
    try:
        return z if look(z) else 2.0 * z
    except Exception:
        return 3.0 * z


def sampled(z: Tensor) -> Tensor:
    return F.grid_sample(W32.double()[None, None], z[:, None, None, :2], align_corners=True)[:, 0, 0]


REFUSED: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "equal": (lambda z: z if torch.equal(z, torch.zeros_like(z)) else 2.0 * z, "looks at.*torch.equal"),
    "allclose": (lambda z: z if torch.allclose(z, torch.zeros_like(z)) else 2.0 * z, "looks at.*torch.allclose"),
    "is_nonzero": (lambda z: z if torch.is_nonzero(z.sum()) else 2.0 * z, "looks at the values"),
    "numel of a mask": (lambda z: z * z[z > 0].numel(), "shapes that depend on the values"),
    "nonzero": (lambda z: z * len(z.nonzero()), "shapes that depend on the values"),
    "where": (lambda z: z * torch.where(z > 0)[0].numel(), "shapes that depend on the values"),
    "masked_select": (lambda z: z * z.masked_select(z > 0).numel(), "shapes that depend on the values"),
    "unique": (lambda z: z * z.unique().numel(), "shapes that depend on the values"),
    "str": (lambda z: z if "0." in str(z) else 2.0 * z, "__repr__"),
    "format": (lambda z: z if "0." in f"{z}" else 2.0 * z, "__format__"),
    "circular pad": (lambda z: F.pad(z[:, None], (1, 1), mode="circular")[..., 0], "written by way of another"),
    "bits": (lambda z: z * ((z > 0).sum(-1, keepdim=True) & 1), "bits of integers"),
    "integers made of numbers": (lambda z: z + torch.zeros(z.shape, dtype=torch.int64).copy_(4 * z), "other numbers"),
    "sum to integers": (lambda z: z * z.sum(-1, keepdim=True, dtype=torch.int64), "other numbers"),
    "half": (lambda z: z.half().to(z.dtype), "float16"),
    "written by NumPy": (written_by_numpy, "changes the memory of a captured tensor or array"),
    "caught number": (lambda z: caught(z, lambda z: float(z.sum()) > 0.0), "looks at.*Tensor.__float__"),
    "caught array": (lambda z: caught(z, lambda z: z.numpy().any()), "Tensor.numpy"),
    "caught failure": (lambda z: caught(z, lambda z: torch.linalg.cholesky(z * torch.eye(3))), "fails for some values"),
    "grid_sample": (lambda z: sampled(z), "torch.nn.functional.grid_sample.*to_copy"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_code_that_a_trace_would_change_is_refused(name: str) -> None:
    function, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as caught:
        Traced("field", lambda i, z: function(z), torch.zeros(1, 3, dtype=D))(np.zeros(0), symbols("x", (1, 3))[1])
    assert "\n" not in str(caught.value)


def test_constants_may_decide_branches_and_shapes() -> None:
    own = torch.tensor([1.0, 0.0, 2.0], dtype=D)

    def function(z: Tensor) -> Tensor:
        assert torch.equal(own, own) and "2." in str(own)
        return z[:, own > 0] * len(own.nonzero())

    traced = Traced("field", lambda i, z: function(z), torch.zeros(1, 3, dtype=D))
    assert traced(np.zeros(0), np.array([[3.0, 4.0, 5.0]], object)).tolist() == [[6.0, 10.0]]
