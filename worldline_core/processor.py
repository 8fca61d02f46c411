"""Name and bfloat16 support of the processor, read without importing torch."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any


def processor_name() -> str:
    """Return the processor's model name, or its architecture where the system states none."""
    named = re.search(r"^model name\s*: (.*)$", _first_core(), re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()


def processor_has_bfloat16() -> bool:
    """Return true for native bfloat16 instructions (x86 with AVX-512 BF16 or AMX).

    PyTorch emulates them on other processors: matrix products and convolutions are about 80 times slower than in float32.
    """
    return re.search(r"\b(avx512_bf16|amx_bf16)\b", _first_core()) is not None


def bfloat16_by_default(given: Mapping[str, Any]) -> bool:
    """Default of a config field: true if the device computes in bfloat16 natively, or the weights are in bfloat16.

    Args:
        given: the fields declared before it: ``device``, and ``weights`` where the config has them.
    """
    return (
        not given["device"].startswith("cpu")
        or given.get("weights") in ("bf16", "bfloat16")
        or processor_has_bfloat16()
    )


@cache
def _first_core() -> str:
    """Linux's description of the first core; empty on other systems."""
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").partition("\n\n")[0] if path.is_file() else ""
