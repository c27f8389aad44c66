"""Derivatives of solutions with respect to everything that a problem is made of.

`attach` joins a solution to the tensors that a problem was made of, and predicts it at other numbers to first order;
`points` are the conditions whose implicit derivative this is. It imports `solvers`. Begin with `attach.py`.
"""

from torchgco.sensitivity.attach import asks_for_gradients as asks_for_gradients
from torchgco.sensitivity.attach import attached as attached
from torchgco.sensitivity.attach import check_smoothing as check_smoothing
from torchgco.sensitivity.attach import predicted as predicted
