"""Whether a user's function keeps problems, and knots, apart: no row may change with the content of another one.

Content that a function reads without effect at the points that are tried (beneath a `relu`, say) shows itself where it
is no number, or infinite, or close to the row's own content; of code that refuses such content, or treats it apart,
where it is far away. Python code that then branches otherwise, as it reads the values of all rows, is exempt from this:
it can't be traced, is solved as it is, and what is found is evaluated row by row (`alone`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from torchgco.base.draws import scattered
from torchgco.base.shapes import MISTAKES
from torchgco.base.values import whole_numbers_become
from torchgco.tracing.recorder import take_same_branches

FOREIGN = (torch.nan, torch.inf, -torch.inf)
DRAWN_SIZES = (1.0, 1e3, 1e6)  # of drawn numbers
NEIGHBOUR_STEP = 1e-3  # by which a neighbour of a row differs, as a share of 1 + |x|

Rows = Callable[..., Tensor]  # of problems (b,) int64, knots (K,) int64 and arguments (b, K, ...): rows (b, K, ...)
Content = Callable[..., Iterator[list[Tensor]]]


def mixes_problems(function: Callable[..., Tensor], rows: Tensor, *arguments: Tensor) -> bool:
    """Whether a third problem between two changes function(rows, *arguments) of these."""
    of_two, three = function(rows, *arguments), rows[[0, 0, 1]]
    for content in (_foreign, _far):
        is_shown = True  # the function takes such content as any other
        for others in content(*arguments):
            strange = [torch.cat((z[:1], other, z[1:])) for z, other in zip(arguments, others, strict=True)]
            beside = _tried(function, three, *strange)
            if beside is not None and not bool(unlike(beside[::2], of_two).any()):
                continue
            if beside is not None and take_same_branches((function, rows, *arguments), (function, three, *strange)):
                return True
            is_shown = False
        if is_shown:
            break
    return False


def joined_knots(together: Rows, alone: Rows, rows: Tensor, k: Tensor, arguments: Sequence[Tensor]) -> int | None:
    """The place of a knot whose rows depend on other knots or problems, or on their number; None: none is found.

    Args:
        together: of all knots.
        alone: the same of each knot by itself.
        rows: two problems.
        k: the numbers of the knots (K,).
        arguments: (2, K, ...).
    """
    for sizes in (DRAWN_SIZES, DRAWN_SIZES[:2], DRAWN_SIZES[:1], ()):
        drawn = [torch.cat((z, *(size * scattered(z[:1]) for size in sizes))) for z in arguments]
        more = torch.cat((rows, rows[:1].expand(len(sizes))))
        joint, each = _tried(together, more, k, *drawn), _tried(alone, more, k, *drawn)
        if joint is not None and each is not None:
            break  # else it refuses such states
    else:
        joint, each = together(rows, k, *arguments), alone(rows, k, *arguments)
    exempt, alike, few = False, (together, more, k, *drawn), (together, rows, k, *arguments)
    for changed, values in (((alone, *alike[1:]), each), (few, _tried(*few))):
        if values is None or (index := _place(values, joint[: len(values)])) is None:
            continue
        if take_same_branches(changed, alike):
            return index
        exempt = True
    first = rows[:1]
    # Any two knots differ in a digit of their places, so that one of them is kept where the other is foreign. The last
    # two rows are kept as a whole, and foreign as a whole: another problem.
    K = len(k)
    digits = torch.arange(K, device=k.device) >> torch.arange((K - 1).bit_length(), device=k.device).unsqueeze(-1) & 1
    kept = torch.cat((digits == 0, digits == 1, torch.tensor([[True], [False]], device=k.device).expand(2, K)))
    for content in (_foreign, _far):
        is_shown = True
        for others in content(*(z[:1] for z in arguments)):
            strange = [
                torch.where(kept.view(*kept.shape, *[1] * (z.dim() - 2)), z[:1], other)
                for z, other in zip(arguments, others, strict=True)
            ]
            changed = together, first.expand(len(kept)), k, *strange
            other = _tried(*changed)
            if other is not None and (index := _place(other, joint[:1], kept)) is None:
                continue
            if other is not None and take_same_branches(alike, changed):
                return index
            is_shown, exempt = False, exempt or other is not None
        if is_shown:
            break
    # Of code that branches, where the solve begins.
    return _place(alone(rows, k, *arguments), together(rows, k, *arguments)) if exempt else None


def depends_on_axes(function: Rows, k: Tensor, arguments: Sequence[Tensor], takes_k: bool) -> bool:
    """Whether rows of one knot (b, ...), or of its samples (b, S, ...), differ from those of all knots (b, K, ...).

    Code that takes some of these forms alone is left to those who call it so.

    Args:
        function: of knots (K,) or one of them, an int, and arguments with these leading axes.
        k: the numbers of the knots (K,).
        arguments: (2, K, ...).
        takes_k: code that takes k is tried at every knot, as a number finds places that a tensor doesn't: those of a
            dict, for instance.
    """
    with whole_numbers_become(arguments[0].dtype):
        several = _tried(function, k, *arguments)
        if several is None or several.shape[:2] != arguments[0].shape[:2]:
            return False
        probes = [0, len(k) // 2, len(k) - 1]
        each = range(len(k)) if takes_k else probes
        forms = [(j, _tried(function, int(k[j]), *(z[:, j] for z in arguments))) for j in each]
        for j in probes:
            samples = [torch.stack((z, z, z), dim=1) for z in (z[:, j] for z in arguments)]
            sample_rows = _tried(function, int(k[j]), *samples)
            forms.append((j, None if sample_rows is None else sample_rows[:, 0]))
        known = [(j, form) for j, form in forms if form is not None and form.shape == several[:, 0].shape]
        if not known:
            return False
        places = torch.tensor([j for j, _ in known], device=k.device)
        due = several.transpose(0, 1)[places].flatten(0, 1)
        wrong = unlike(torch.cat([form for _, form in known]), due).reshape(len(known), -1).any(-1)
        for j in places[wrong].tolist():
            alone, of_all = _tried(function, k[j : j + 1], *(z[:, j : j + 1] for z in arguments)), several[:, j]
            if alone is not None and alone[:, 0].shape == of_all.shape and not bool(unlike(alone[:, 0], of_all).any()):
                return True  # else it joins knots, which is another matter
    return False


def _foreign(*rows: Tensor) -> Iterator[list[Tensor]]:
    """Content (1, ...) that is put beside rows (b, ...): no numbers, and a neighbour of each row."""
    for value in FOREIGN:
        yield [torch.full_like(z[:1], value) for z in rows]
    for z in zip(*(z.split(1) for z in rows), strict=True):
        yield [row + NEIGHBOUR_STEP * (1.0 + row.abs()) * scattered(row) for row in z]


def _far(*rows: Tensor) -> Iterator[list[Tensor]]:
    """Finite content (1, ...) far from rows (b, ...), on both sides of 0."""
    for size in DRAWN_SIZES:
        for signed in (size, -size):
            yield [signed * scattered(z[:1]) for z in rows]


def _tried(function: Callable[..., Tensor], *arguments: Tensor | int) -> Tensor | None:
    """The function's values; None where it refuses such arguments."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return function(*arguments)
    except MISTAKES:
        return None


def unlike(values: Tensor, others: Tensor) -> Tensor:
    """Where values (b, ...) differ by more than another order of sums explains; NaN is like infinity."""
    size = others.abs().nan_to_num(0.0, 0.0, 0.0).reshape(len(others), -1).amax(-1)
    near = torch.finfo(others.dtype).eps ** 0.5 * (1.0 + size.view(-1, *[1] * (others.dim() - 1)))
    finite = torch.isfinite(values)
    return ((values - others).abs() > near) & finite | (finite != torch.isfinite(others))


def _place(values: Tensor, others: Tensor, kept: Tensor | None = None) -> int | None:
    """The first place of the second axis at which values (b, K, ...) differ, among those `kept` (b, K)."""
    if values.dim() != others.dim() or values.shape[1:] != others.shape[1:]:
        return 0
    wrong = unlike(values, others.expand_as(values)).flatten(2).any(-1)
    indices = (wrong if kept is None else wrong & kept).any(0).nonzero()
    return int(indices[0]) if indices.numel() > 0 else None
