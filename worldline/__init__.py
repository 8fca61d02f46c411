"""The command `worldline`.

An installation has `flows` and `tasks` in this package's folder `workflows`: as packages of their own they would clash
with a user's. A checkout has them beside this package.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

_INSTALLED = Path(__file__).parent / "workflows"
if _INSTALLED.is_dir() and str(_INSTALLED) not in sys.path:
    sys.path.insert(0, str(_INSTALLED))
    # Processes that a run starts by name (torchrun, Ray) import them as well.
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(_INSTALLED), os.environ.get("PYTHONPATH")]))


def main() -> None:
    """Entry point of the console command."""
    from flows.command_line import main as run

    run()
