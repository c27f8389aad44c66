"""CUDA C++ to a program on a device, by NVRTC through cuda-core; the cache keeps it for the next process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.util import find_spec

import torch

from torchgco.base.clock import setting_up
from torchgco.base.notices import notice
from torchgco.native import store
from torchgco.native.compiler import NativeError
from torchgco.native.cuda.source import THREADS

# No product is fused with a sum but where the code says so: bits are those of C (lanes.h).
OPTIONS = {"std": "c++20", "fma": False, "device_as_default_execution_space": True}
_ERROR_LINES = 5


@cache
def available() -> bool:
    """Whether the extra `cuda` is installed, and PyTorch sees a device."""
    try:
        return torch.version.cuda is not None and find_spec("cuda.core") is not None and torch.cuda.is_available()
    except ModuleNotFoundError:  # there is no package `cuda` at all
        return False


def cubin(text: str, arch: str) -> bytes:
    """A program for devices of an architecture, such as sm_90.

    Raises:
        NativeError: NVRTC is missing or refuses the text; its first errors are named.
    """
    version = _version()
    kin = text.encode().translate(None, b"0123456789abcdefxp.+-").decode(errors="replace")
    key = store.key_of(("cubin 1", text, arch, version, str(OPTIONS)), kin)
    known = store.read(key, ".cubin")
    if known is not None:
        return known
    with setting_up():
        notice("compiling kernels for the GPU (once for this form of problem) ...", brief=False)
        made = _compiled(text, arch)
    store.save(key, ".cubin", made)
    return made


def _version() -> str:
    try:
        return ".".join(map(str, import_module("cuda.bindings.nvrtc").nvrtcVersion()[1:]))
    except (ImportError, RuntimeError) as error:  # the latter: its library isn't found
        raise NativeError(f"no NVRTC found: {str(error).splitlines()[0]}; `pip install torchgco[cuda]`") from error


def _compiled(text: str, arch: str) -> bytes:
    core = import_module("cuda.core")
    with _refusals():
        return bytes(core.Program(text, "c++", core.ProgramOptions(arch=arch, **OPTIONS)).compile("cubin").code)


@contextmanager
def _refusals() -> Iterator[None]:
    """What NVRTC or the driver refuses is a NativeError."""
    try:
        yield
    except Exception as error:
        kind = type(error).__name__
        if kind not in ("NVRTCError", "CUDAError"):  # which cuda-core exports nowhere
            raise
        said = [line for line in str(error).splitlines() if "error" in line] or str(error).splitlines()
        raise NativeError("\n".join([f"{kind}: {said[0]}", *said[1:_ERROR_LINES]])) from error


class Loaded:
    """A program on a device; see `launch.Module`.

    Raises:
        NativeError: NVRTC is missing or refuses the text.
    """

    def __init__(self, text: str, device: torch.device) -> None:
        self._core = import_module("cuda.core")
        index = torch.cuda.current_device() if device.index is None else device.index
        self.device = torch.device("cuda", index)
        torch.zeros(1, device=self.device)  # PyTorch's context, which its tensors are in
        self._device = self._core.Device(index)
        with torch.cuda.device(self.device), _refusals():
            self._device.set_current()
            self.multiprocessors = int(self._device.properties.multiprocessor_count)
            self._code = self._core.ObjectCode.from_cubin(cubin(text, f"sm_{self._device.arch}"))

    def free_bytes(self) -> int:
        free, _ = torch.cuda.mem_get_info(self.device)
        return free + torch.cuda.memory_reserved(self.device) - torch.cuda.memory_allocated(self.device)

    def launch(self, kernel: str, blocks: int, *arguments: int) -> None:
        config = self._core.LaunchConfig(grid=blocks, block=THREADS)
        with torch.cuda.device(self.device), _refusals():
            self._device.set_current()
            stream = torch.cuda.current_stream(self.device)
            self._core.launch(stream, config, self._code.get_kernel(kernel), *arguments)
