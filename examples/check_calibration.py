"""Do recordings agree with their calibration? Diagnoses every episode and draws where the tools are said to be.

Run: python examples/check_calibration.py [EPISODE_SET] [--episodes 3] [--output FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from worldline_core.calibration.check import check_command, table_text
from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.shipped import shipped_folder


def main() -> None:
    """Check some episodes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("episode_set", type=Path, nargs="?", default=shipped_folder() / "recordings")
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--output", type=Path, default=Path("calibration"))
    arguments = parser.parse_args()
    chosen = [row.episode_id for row in EpisodeSet.open(arguments.episode_set).rows[: arguments.episodes]]
    found = check_command(arguments.episode_set, artifact=True, episodes=chosen, output=arguments.output)
    print(table_text(found))
    print(f"pictures: {arguments.output}")


if __name__ == "__main__":
    main()
