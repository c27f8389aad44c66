"""How much memory is left, before anything large is read or solved."""

import os


def free_memory() -> int:
    """Bytes that can be allocated without swapping: the kernel's own estimate, else unused pages."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
