"""What solvers compute with: in PyTorch (`in_pytorch.Kernels`) and in C, chosen once per form of problems.

Solvers call the functions of `verbs`, which ask `choice.kernels_of` whose they are. `in_c` hands a problem to
`native`; where its code can't be traced, a warning names it, and `in_pytorch` computes the same. `choice` brings
problems of a GPU to the CPU, and has their loops run on the GPU. It imports `native` and `eager`. Begin with
`in_pytorch.py`, which says what kernels are asked.
"""

from torchgco.kernels.choice import EagerWarning as EagerWarning
from torchgco.kernels.choice import at_once as at_once
from torchgco.kernels.choice import copied_to as copied_to
from torchgco.kernels.choice import current as current
from torchgco.kernels.choice import current_device as current_device
from torchgco.kernels.choice import expect_interior as expect_interior
from torchgco.kernels.choice import held_on_cpu as held_on_cpu
from torchgco.kernels.choice import is_mixed as is_mixed
from torchgco.kernels.choice import kernels_of as kernels_of
from torchgco.kernels.choice import native as native
from torchgco.kernels.choice import on_cpu as on_cpu
from torchgco.kernels.choice import served_by as served_by
from torchgco.kernels.choice import use_native as use_native
from torchgco.kernels.choice import used as used
from torchgco.kernels.verbs import chord_clearance as chord_clearance
from torchgco.kernels.verbs import cost_scale as cost_scale
from torchgco.kernels.verbs import costates as costates
from torchgco.kernels.verbs import followed as followed
from torchgco.kernels.verbs import interior_of as interior_of
from torchgco.kernels.verbs import is_convex as is_convex
from torchgco.kernels.verbs import measured as measured
from torchgco.kernels.verbs import open_loop as open_loop
from torchgco.kernels.verbs import path_clearance as path_clearance
from torchgco.kernels.verbs import regulated as regulated
from torchgco.kernels.verbs import reproducible as reproducible
from torchgco.kernels.verbs import rolled_out as rolled_out
from torchgco.kernels.verbs import value as value
