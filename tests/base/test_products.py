"""Products of small matrices: those of PyTorch, whatever the batch, and where rows depend on each other."""

import pytest
import torch
from torch import Tensor

from torchgco.base.products import exponential, least_squares, product

D = torch.float64


@pytest.mark.parametrize(("n", "q"), [(1, 3), (4, 20), (18, 40)])
def test_they_are_those_of_matrix_libraries_and_keep_their_bits_alone(n: int, q: int) -> None:
    draws = torch.Generator().manual_seed(n)
    drawn = lambda *shape: torch.randn(*shape, generator=draws, dtype=D)
    A, W, b = drawn(9, n, n), drawn(9, n, q), drawn(9, n)
    A = A * torch.logspace(-9, 1, 9, dtype=D).view(-1, 1, 1)
    u = least_squares(W, b)
    torch.testing.assert_close(product(A, W), A @ W)
    torch.testing.assert_close(exponential(A), torch.linalg.matrix_exp(A), rtol=1e-9, atol=0)
    torch.testing.assert_close(u, (torch.linalg.pinv(W) @ b.unsqueeze(-1)).squeeze(-1))
    one = slice(4, 5)
    pairs: list[tuple[Tensor, Tensor]] = [
        (product(A, W), product(A[one].clone(), W[one].clone())),
        (exponential(A), exponential(A[one].clone())),
        (u, least_squares(W[one].clone(), b[one].clone())),
    ]
    assert all(torch.equal(many[one], alone) for many, alone in pairs)


def test_rows_that_say_the_same_count_once() -> None:
    W = torch.tensor([[[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 3.0]]], dtype=D)
    u = least_squares(W, torch.tensor([[5.0, 10.0, 0.0, 3.0]], dtype=D))
    torch.testing.assert_close(u, torch.tensor([[1.0, 2.0, 1.0]], dtype=D))


def test_what_is_nilpotent_is_exact_at_any_size_and_what_is_no_number_stays_none() -> None:
    A = torch.tensor([[0.0, 1e9], [0.0, 0.0]], dtype=D)
    found = exponential(torch.stack((A, torch.full_like(A, torch.nan), torch.zeros_like(A))))
    assert found[0].tolist() == [[1.0, 1e9], [0.0, 1.0]] and bool(found[1].isnan().all())
    assert torch.equal(found[2], torch.eye(2, dtype=D))
