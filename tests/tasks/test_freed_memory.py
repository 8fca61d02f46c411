"""Large blocks that are freed and taken again cost no page faults."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

_CODE = """
import resource, sys
from worldline_core.scale.process import keep_freed_memory
kept = keep_freed_memory() if sys.argv[1] == "keep" else False
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
block = bytearray(b"x") * 2**26
del block
before = faults()
for _ in range(8):
    block = bytearray(b"x") * 2**26
    del block
print(kept, faults() - before)
"""


def run(argument: str, **environment: str) -> tuple[bool, int]:
    clean = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    for name in ("GLIBC_TUNABLES", "LD_PRELOAD"):
        clean.pop(name, None)
    command = [sys.executable, "-c", _CODE, argument]
    done = subprocess.run(command, env=clean | environment, capture_output=True, text=True, check=True)
    kept, faults = done.stdout.split()
    return kept == "True", int(faults)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc")
def test_freed_blocks_are_taken_again_without_page_faults() -> None:
    plain = run("leave")[1]
    kept, faults = run("keep")
    assert kept
    assert plain > 8 * 2**26 // os.sysconf("SC_PAGE_SIZE") // 2  # the test sees what it is about
    assert faults < plain / 20


def test_a_choice_of_the_environment_is_left_alone() -> None:
    assert run("keep", MALLOC_ARENA_MAX="2")[0] is False
