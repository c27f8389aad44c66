"""Derivatives of solutions with respect to everything that a problem is made of."""

from torchgco.sensitivity.attach import asks_for_gradients as asks_for_gradients
from torchgco.sensitivity.attach import attached as attached
from torchgco.sensitivity.attach import check_smoothing as check_smoothing
from torchgco.sensitivity.predict import predicted as predicted
