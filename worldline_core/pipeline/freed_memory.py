"""Freed memory stays with the process.

glibc gives large freed blocks back to the kernel at once; the next tensor of that size has every page mapped and zeroed
anew. Models on a CPU make such tensors all the time: benchmarks/freed_memory.py measures what that costs.
"""

from __future__ import annotations

import ctypes
import os

_TRIM_THRESHOLD, _MMAP_MAX, _ARENA_MAX = -1, -4, -8  # malloc.h
_NEVER = 2**31 - 1


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed blocks for the next allocation; true where it does.

    Peak memory stays what it is, but is given back only when the process ends. A choice made in the environment
    (MALLOC_..., GLIBC_TUNABLES, another allocator in LD_PRELOAD) is left alone, and other C libraries know no such thing.
    """
    if any(name.startswith("MALLOC_") or name in ("GLIBC_TUNABLES", "LD_PRELOAD") for name in os.environ):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    # Threads share one arena: those of threads are small, and what does not fit into them is mapped and unmapped again.
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, _NEVER), (_ARENA_MAX, 1))
    done = [bool(mallopt(parameter, value)) for parameter, value in settings]
    return all(done)
