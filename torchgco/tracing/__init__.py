"""Functions of PyTorch tensors, recorded once and replayed with CasADi expressions."""

from torchgco.tracing.facts import CAPTURED as CAPTURED
from torchgco.tracing.facts import Facts as Facts
from torchgco.tracing.facts import Unseen as Unseen
from torchgco.tracing.traced import Traced as Traced
from torchgco.tracing.traced import own_tensors as own_tensors
from torchgco.tracing.traced import traced_like as traced_like
from torchgco.tracing.watch import contents as contents
