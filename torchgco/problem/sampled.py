"""A trajectory as a table over time, at the knots or at any rate: names, units, and what follows from states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from torchgco.base.autodiff import slope_along
from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.names import Quantity, controls_of, states_of
from torchgco.problem.between import between

TIME_COLUMN = "t [s]"
RATE_OF_POSITION, SECOND_RATE = "d{}/dt", "d2{}/dt2"  # of the position, where states have the usual names
ROUNDING = 1e-9  # of a sample: an end this close after one is that sample's


def sampled(dynamics: Dynamics | None, X: Tensor, U: Tensor, t: Tensor, rate: float | None) -> dict[str, np.ndarray]:
    """Columns by label: times, states, controls, and what the model knows beside them.

    Controls hold from their knot to the next one; the last row has the last ones. Of models that integrate a
    derivative, states between the knots are the integrator's, and of their position come the acceleration and, where it
    isn't a state, the velocity. Of others there are straight lines between the knots.

    Args:
        dynamics: None: not known, and numbers stand for names.
        X, U, t: of one trajectory, (N+1, n), (N, m), (N+1,) s.
        rate: samples per second; None: the knots.
    """
    k, h, lengths = _places(t, rate)
    x, u = X[k].clone(), U[k]
    if bool((h > 0).any()):
        path = X.unsqueeze(0), U.unsqueeze(0), k, h, lengths
        x = between(dynamics, *path)[0] if dynamics is not None else x + (h / lengths).unsqueeze(-1) * (X[k + 1] - x)
    ends = h >= lengths * (1 - ROUNDING)  # a whole stage leads to the knot after it, which may not obey the model
    x[ends] = X[k[ends] + 1]
    if dynamics is None:
        named = [Quantity(f"x[{i}]") for i in range(X.shape[-1])], [Quantity(f"u[{i}]") for i in range(U.shape[-1])]
    else:
        named = states_of(dynamics), controls_of(dynamics)
    columns = {TIME_COLUMN: t[k] + h}
    columns |= {state.label: x[:, i] for i, state in enumerate(named[0])}
    if dynamics is not None:
        states = {s.name.partition(" [")[0]: x[:, i] for i, s in enumerate(named[0])}  # a unit may stand in a name
        columns |= _of_position(dynamics, x, u, k, states) | dynamics.derived(x, u)
    columns |= {control.label: u[:, i] for i, control in enumerate(named[1])}
    return {label: values.detach().cpu().numpy() for label, values in columns.items()}


def sample_times(first: float, last: float, rate: float) -> np.ndarray:
    """Times from `first` on, s, `rate` a second, and the `last` one, which may come sooner after the one before."""
    times = first + np.arange(int((last - first) * rate + ROUNDING) + 1) / rate
    return times if (last - times[-1]) * rate <= ROUNDING else np.append(times, last)


def _places(t: Tensor, rate: float | None) -> tuple[Tensor, Tensor, Tensor]:
    """Stages k (T,), times h since their knots and lengths of stages, s, of the samples from t[0] to t[-1]."""
    N = len(t) - 1
    if rate is None:
        k = torch.arange(N + 1, device=t.device).clamp(max=N - 1)
        h = torch.zeros_like(t)
        h[-1] = t[-1] - t[-2]
    else:
        times = torch.from_numpy(sample_times(float(t[0]), float(t[-1]), rate)).to(t)
        k = (torch.searchsorted(t.contiguous(), times + ROUNDING / rate, right=True) - 1).clamp(0, N - 1)
        h = (times - t[k]).clamp(min=0.0)
    return k, h, t[k + 1] - t[k]


def _of_position(
    dynamics: Dynamics, x: Tensor, u: Tensor, k: Tensor, states: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Velocity and acceleration of the position, (T,) each, of models that integrate a derivative.

    Their names are `vx` and `ax`; where states have such names, but are something else, in the vehicle's axes for
    instance, `dx/dt` and `d2x/dt2`.
    """
    xyz = dynamics.position
    if xyz is None or xyz.stop - xyz.start > 3 or not dynamics.is_integrated:
        return {}
    model, x, u = dynamics.at(k), x.unsqueeze(0), u.unsqueeze(0)
    rates = model.field(x, u)
    change = slope_along(lambda z: model.field(z, u), (x,), (rates,))
    columns = {}
    for name, other, unit, values in (("v{}", RATE_OF_POSITION, "m/s", rates), ("a{}", SECOND_RATE, "m/s^2", change)):
        new = {name.format(axis): values[0, :, xyz.start + i] for i, axis in enumerate("xyz"[: xyz.stop - xyz.start])}
        if all(torch.allclose(states[key], new[key]) for key in new if key in states):
            columns |= {f"{key} [{unit}]": new[key] for key in new if not new.keys() & states.keys()}
        else:
            columns |= {f"{other.format(key[-1])} [{unit}]": values for key, values in new.items()}
    return columns
