"""Damaged recordings and attacks: does each end as it should?

    python -m tools.corrupted [damage] [attacks] [mutations] [--each 2] [--cases 1000] [--seed 0]

- `damage`: recordings in every kind of damage are curated and filtered: kept + quarantined = found, each with its true reason.
- `attacks`: a small recording is read under each attack of `attacks.py`.
- `mutations`: each case damages one small file (bytes changed, zeroed, repeated, cut; JSON values exchanged for odd ones), reads
  everything, and puts the file back. Any error that is not the project's own is a bug. A decoder crash ends the process: the
  last line printed names layout and seed.

Without a name: damage and attacks. The exit status is 1 where an outcome is wrong or missing.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter
from pathlib import Path

from pydantic import TypeAdapter

from tools.corrupted import mutations
from tools.corrupted.attacks import ATTACKS, ending
from tools.corrupted.corpus import confusion, is_right, outcomes, write_corpus
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.curation.curate import curate
from worldline_core.data.sources.open import SourceConfig
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig


def report_damage(folder: Path, each: int, seed: int) -> bool:
    """Print the outcomes of a corpus; returns whether all are right."""
    labels, config = write_corpus(folder, healthy=2 * each, each=each, seed=seed)
    begun = sum(os.times()[:4])
    counts = curate(config, {}, folder / "curated")
    filter_episodes(FilterConfig(), {"episodes": folder / "curated"}, folder / "filtered")
    found = outcomes(folder / "curated", folder / "filtered")
    wrong = Counter((each.layout, each.kind) for each in labels if not is_right(each, found.get(each.episode_id)))
    print("| layout | damage | ended as | right |\n|---|---|---|---|")
    for (layout, kind), ended in confusion(labels, found).items():
        shown = ", ".join(f"{outcome} {count}" for outcome, count in ended.most_common())
        print(f"| {layout} | {kind} | {shown} | {1 - wrong[layout, kind] / ended.total():.0%} |")
    accounted = counts["found"] == counts["kept"] + counts["quarantined"] == len(labels) == len(found)
    spent = 1e3 * (sum(os.times()[:4]) - begun) / len(labels)
    print(f"\n{counts['found']} = {counts['kept']} kept + {counts['quarantined']} quarantined: {accounted}")
    print(f"{spent:.0f} ms of processor time a recording\n")
    return accounted and not wrong


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


def report_mutations(folder: Path, cases: int, seed: int) -> bool:
    """Print the unexpected errors of damaged versions of each layout; returns whether there are none."""
    found = 0
    for layout, source in write_one_of_each(folder).items():
        print(f"{layout}, seed {seed}: ", end="", flush=True)
        config = TypeAdapter(SourceConfig).validate_python(source)
        unexpected = list(mutations.attack(config, Path(str(source["path"])), cases, seed))
        print(f"{cases} cases, {len(unexpected)} unexpected errors")
        kinds = Counter((each.trace, each.error.split(":")[0]) for each in unexpected)
        for (trace, error), count in kinds.most_common():
            example = next(each for each in unexpected if (each.trace, each.error.split(":")[0]) == (trace, error))
            print(f"    {count} x {error} at {trace}\n        {example.file}, case {example.case}: {example.error}")
        found += len(unexpected)
    return not found


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tools.corrupted", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", nargs="*", metavar="WHAT", help="damage, attacks, mutations (default: the first two)")
    parser.add_argument("--each", type=int, default=2, help="recordings of each kind of damage")
    parser.add_argument("--cases", type=int, default=1000, help="mutations of each layout")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        reports = {
            "damage": lambda: report_damage(Path(folder) / "damage", chosen.each, chosen.seed),
            "attacks": lambda: report_attacks(Path(folder) / "attacks"),
            "mutations": lambda: report_mutations(Path(folder) / "mutations", chosen.cases, chosen.seed),
        }
        if unknown := sorted(set(chosen.what) - set(reports)):
            parser.error(f"unknown: {', '.join(unknown)} (choose from {', '.join(reports)})")
        right = [reports[what]() for what in chosen.what or ("damage", "attacks")]
    raise SystemExit(0 if all(right) else 1)


if __name__ == "__main__":
    main()
