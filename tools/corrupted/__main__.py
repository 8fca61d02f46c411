"""Damaged recordings and attacks: does each end as it should? `python -m tools.corrupted [--each 2] [--seed 0]`

Writes recordings in every kind of damage, curates and filters them, and compares each outcome with the truth; then reads a small
recording under each attack of `attacks.py`. Prints both tables; the exit status is 1 where an outcome is wrong or missing.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from tools.corrupted.attacks import ATTACKS, ending
from tools.corrupted.corpus import confusion, outcomes, shares_right, write_corpus
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.curation.curate import curate
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig


def report_damage(folder: Path, each: int, seed: int) -> bool:
    """Print the outcomes of a corpus; returns whether all are right."""
    labels, config = write_corpus(folder, healthy=2 * each, each=each, seed=seed)
    counts = curate(config, {}, folder / "curated")
    filter_episodes(FilterConfig(), {"episodes": folder / "curated"}, folder / "filtered")
    found = outcomes(folder / "curated", folder / "filtered")
    shares = shares_right(labels, found)
    print("| layout | damage | ended as | right |\n|---|---|---|---|")
    for (layout, kind), ended in confusion(labels, found).items():
        shown = ", ".join(f"{outcome} {count}" for outcome, count in ended.most_common())
        print(f"| {layout} | {kind} | {shown} | {shares[layout, kind]:.0%} |")
    accounted = counts["found"] == counts["kept"] + counts["quarantined"] == len(labels) == len(found)
    print(f"\n{counts['found']} = {counts['kept']} kept + {counts['quarantined']} quarantined: {accounted}\n")
    return accounted and all(share == 1 for share in shares.values())


def report_attacks(folder: Path) -> bool:
    """Print the ending of each attack; returns whether all are allowed."""
    sources, right = write_one_of_each(folder), True
    print("| layout | attack | ended as | seconds | right |\n|---|---|---|---|---|")
    for attack in ATTACKS:
        start = time.monotonic()
        ended = ending(attack, sources[attack.layout], folder / "attacked")
        right &= ended in attack.endings
        seconds = time.monotonic() - start
        print(f"| {attack.layout} | {attack.name} | {ended} | {seconds:.1f} | {ended in attack.endings} |", flush=True)
    return right


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.corrupted", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=2, help="recordings of each kind of damage")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        right = report_damage(Path(folder) / "damage", chosen.each, chosen.seed)
        right &= report_attacks(Path(folder) / "attacks")
    raise SystemExit(0 if right else 1)


if __name__ == "__main__":
    main()
