"""What holds for every test: one thread, as the workers of a parallel run share the cores."""

import os

import torch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for processes that tests start
torch.set_num_threads(1)
