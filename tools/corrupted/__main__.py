"""Damaged recordings and attacks: does each end as it should?

    python -m tools.corrupted [damage | attacks] [--each 2] [--seed 0]

- `damage`: recordings in every kind of damage are curated and filtered: kept + quarantined = found, each with its true reason.
- `attacks`: a small recording is read under each attack of `attacks.py`.

The exit status is 1 where an outcome is wrong or missing.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

from tools.corrupted.attacks import ATTACKS, ending
from tools.corrupted.corpus import outcomes, write_corpus
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
    table: dict[tuple[str, str], Counter[str]] = {}
    for label in labels:
        ended = found.get(label.episode_id, "lost")
        shown = ended if ended in label.endings else f"{ended} (WRONG)"
        table.setdefault((label.layout, label.kind), Counter())[shown] += 1
    print("| layout | damage | ended as |\n|---|---|---|")
    for (layout, kind), ended in table.items():
        print(f"| {layout} | {kind} | {', '.join(f'{outcome} {count}' for outcome, count in ended.most_common())} |")
    accounted = counts["found"] == counts["kept"] + counts["quarantined"] == len(labels) == len(found)
    print(f"\n{counts['found']} = {counts['kept']} kept + {counts['quarantined']} quarantined: {accounted}\n")
    return accounted and all(found[each.episode_id] in each.endings for each in labels)


def report_attacks(folder: Path) -> bool:
    """Print the ending of each attack; returns whether all are allowed."""
    sources, right = write_one_of_each(folder), True
    print("| layout | attack | ended as | seconds | right |\n|---|---|---|---|---|")
    for attack in ATTACKS:
        start = time.monotonic()
        ended = ending(attack, sources[attack.layout], folder / "attacked")
        right &= ended in attack.endings
        spent, allowed = time.monotonic() - start, ended in attack.endings
        print(f"| {attack.layout} | {attack.name} | {ended} | {spent:.1f} | {allowed} |", flush=True)
    return right


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.corrupted", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("only", nargs="?", choices=("damage", "attacks"))
    parser.add_argument("--each", type=int, default=2, help="recordings of each kind of damage")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        right = chosen.only == "attacks" or report_damage(Path(folder) / "damage", chosen.each, chosen.seed)
        right &= chosen.only == "damage" or report_attacks(Path(folder) / "attacks")
    raise SystemExit(0 if right else 1)


if __name__ == "__main__":
    main()
