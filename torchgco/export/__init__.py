"""Compiled problems as C that stands alone, from a microcontroller to a server, and loaded again into Python.

`exporting` checks what is asked for and writes the folder. `numbers` finds what may change, and how what C reads
follows from it; `beginning` has what first solves begin with, `carried` what rows of two knots carry; `source` joins a
problem's structures, which `writer` writes as C, with the solver's own files; `exported` knows what was made, `periods`
the steps in Python that its test compares with, and `files` has the example, the test and the README, as CMake, Arduino
or Zephyr take them. `c` holds the controller itself, what takes the place of heap and clock, and templates. `loaded`
compiles a folder and calls it, with the methods of `MPC`.
"""

from torchgco.export.exporting import export_c
from torchgco.export.loaded import LoadedController, load_c

__all__ = ["LoadedController", "export_c", "load_c"]
