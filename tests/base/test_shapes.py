"""States from whatever a user has: tensors, arrays, lists, a single state."""

import numpy as np
import pytest
import torch

from torchgco import InputError
from torchgco.base.shapes import as_states

TWO = [[-1.0, 0.5], [2.0, 3.0]]


@pytest.mark.parametrize(
    ("x0", "dtype"),
    [
        (TWO, torch.float64),
        (tuple(map(tuple, TWO)), torch.float64),
        (np.array(TWO), torch.float64),
        (np.array(TWO)[::-1][::-1], torch.float64),  # negative strides on the way
        (np.array(TWO, np.float32), torch.float32),
        (torch.tensor(TWO, dtype=torch.float32), torch.float32),
        (torch.tensor(TWO, dtype=torch.float64), torch.float64),
    ],
)
def test_numbers_become_states(x0, dtype: torch.dtype) -> None:
    states = as_states(x0)
    assert states.dtype == dtype and states.tolist() == TWO
    single = as_states(x0[0])
    assert single.dtype == dtype and single.tolist() == TWO[:1]  # one problem


def test_whole_numbers_become_float64() -> None:
    for x0 in ([1, 2], np.array([1, 2]), torch.tensor([1, 2]), torch.tensor([[1, 2]], dtype=torch.int32)):
        assert as_states(x0).dtype == torch.float64 and as_states(x0).tolist() == [[1.0, 2.0]]


def test_a_tensor_is_not_copied() -> None:
    x0 = torch.zeros(2, 3)
    assert as_states(x0) is x0


@pytest.mark.parametrize(
    "x0",
    ["far", None, [[1.0], [1.0, 2.0]], ["a", "b"], {"x": 1.0}, True, 1j, np.array(["a"]), object()],
    ids=lambda x0: type(x0).__name__,
)
def test_what_is_not_numeric_is_refused_in_one_line(x0) -> None:
    with pytest.raises(InputError, match=r"^x0: expected numbers, got ") as caught:
        as_states(x0)
    assert "\n" not in str(caught.value)
