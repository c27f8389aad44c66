"""A problem compiled once and solved again and again: `compile`, and the numbers that calls may change."""

from torchgco.compiled.compiled import Answer as Answer
from torchgco.compiled.compiled import Compiled as Compiled
from torchgco.compiled.compiled import compile as compile
