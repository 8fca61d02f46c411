"""What the processor is and can do, without torch."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any


def processor_name() -> str:
    """The model of the processor."""
    named = re.search(r"^model name\s*: (.*)$", _first_core(), re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()


def processor_has_bfloat16() -> bool:
    """Whether the processor multiplies in bfloat16 itself (x86 with AVX-512 BF16 or AMX).

    Where it does not, PyTorch emulates it: products of matrices and convolutions take some 80 times as long as in float32.
    """
    return re.search(r"\b(avx512_bf16|amx_bf16)\b", _first_core()) is not None


def bfloat16_by_default(given: Mapping[str, Any]) -> bool:
    """Default of fields that stand after ``device`` and ``weights``: where the device has bfloat16, or the weights are in it."""
    return (
        not given["device"].startswith("cpu")
        or given.get("weights") in ("bf16", "bfloat16")
        or processor_has_bfloat16()
    )


@cache
def _first_core() -> str:
    """Linux's description of it; empty elsewhere."""
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8").partition("\n\n")[0] if path.is_file() else ""
