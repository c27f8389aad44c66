"""Functions of PyTorch tensors, recorded once and replayed with CasADi expressions.

`traced.Traced` is such a function: `recorder` sees what PyTorch is asked to do, `operations` says the same in CasADi,
and `facts` knows what a trace rests on, so that it is used again only where it holds. `native/codegen` makes C of it,
and `baselines/nlp.py` programs for IPOPT. It imports `base`. Begin with `traced.py`.
"""

from torchgco.tracing.facts import CAPTURED as CAPTURED
from torchgco.tracing.facts import Facts as Facts
from torchgco.tracing.facts import Unseen as Unseen
from torchgco.tracing.traced import Traced as Traced
from torchgco.tracing.traced import own_tensors as own_tensors
from torchgco.tracing.traced import traced_like as traced_like
from torchgco.tracing.watch import contents as contents
