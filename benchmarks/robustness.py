"""Damaged input: is every recording accounted for by its true reason, and does blind damage ever cause an unexpected error?

    python benchmarks/robustness.py accounting [--episodes 2000]
    python benchmarks/robustness.py mutations [--cases 2000] [--seed 0]

- `accounting`: a seeded corpus (LeRobot v2.1, DROID annotations, MCAP, each in many states of damage) is curated and filtered:
  kept + quarantined = found, each kind with its true reason. Processor time.
- `mutations`: each case damages one small file (bytes changed, zeroed, repeated, cut; JSON values exchanged for odd ones), reads
  everything, and puts the file back. Any error that is not the project's own is a bug. A decoder crash ends the
  process: the last line printed names layout and seed.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import TypeAdapter

from benchmarks.harness import command_line, print_table, timed
from tools.corrupted.corpus import (
    LAYOUTS,
    Outcome,
    confusion,
    outcomes,
    shares_right,
    write_corpus,
)
from tools.corrupted.labels import Label
from tools.corrupted.mutations import attack
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.curation.curate import curate
from worldline_core.data.sources.open import SourceConfig
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig


def report(labels: Sequence[Label], found: Mapping[str, Outcome]) -> bool:
    """Prints the confusion table; returns whether every kind is right in at least 99 %."""
    table, shares = confusion(labels, found), shares_right(labels, found)
    rows = (
        (*key, counts.total(), f"{100 * shares[key]:.1f} %", ", ".join(f"{o} {n}" for o, n in counts.most_common()))
        for key, counts in table.items()
    )
    print_table(("layout", "kind", "recordings", "right", "ended as"), rows)
    wrong = [key for key, share in shares.items() if share < 0.99]
    right = sum(share * table[key].total() for key, share in shares.items())
    print(f"\n{len(labels)} recordings, {len(table)} kinds: {100 * right / len(labels):.2f} % right")
    print("below 99 %:", ", ".join("/".join(key) for key in wrong) or "none")
    return not wrong


def measure_accounting(folder: Path, episodes: int, seed: int) -> bool:
    # As many clean recordings of each layout as of three of its kinds.
    each = -(-episodes // (sum(module.KIND_COUNT for module in LAYOUTS) + 3 * len(LAYOUTS)))
    (labels, config), _, spent = timed(lambda: write_corpus(folder, healthy=3 * each, each=each, seed=seed))
    print(f"wrote {len(labels)} recordings in {spent:.0f} s")
    curated, filtered = folder / "curated", folder / "filtered"
    _, _, spent = timed(
        lambda: (curate(config, {}, curated), filter_episodes(FilterConfig(), {"episodes": curated}, filtered))
    )
    print(f"curated and filtered in {spent:.0f} s ({1e3 * spent / len(labels):.0f} ms a recording)")
    found = outcomes(curated, filtered)
    right = report(labels, found)
    lost, more = {label.episode_id for label in labels} - set(found), set(found) - {x.episode_id for x in labels}
    crashed = sum(outcome.reason == "crashed" for outcome in found.values())
    print(f"lost: {len(lost)}, not in the corpus: {len(more)}, crashed: {crashed}")
    return right and not (lost or more or crashed)


def attack_layout(layout: str, source: Mapping[str, object], cases: int, seed: int) -> bool:
    """Reads `cases` damaged versions of a layout and prints unexpected errors; returns whether there are none."""
    config = TypeAdapter(SourceConfig).validate_python(source)
    print(f"{layout}, seed {seed}: ", end="", flush=True)
    unexpected, _, seconds = timed(lambda: list(attack(config, Path(str(source["path"])), cases, seed)))
    print(f"{cases} cases, {seconds:.0f} s of processor time, {len(unexpected)} unexpected errors")
    kinds = Counter((each.trace, each.error.split(":")[0]) for each in unexpected)
    for (trace, error), count in kinds.most_common():
        example = next(x for x in unexpected if (x.trace, x.error.split(":")[0]) == (trace, error))
        print(f"    {count} x {error} at {trace}\n        {example.file}, case {example.case}: {example.error}")
    return not unexpected


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("accounting", "mutations"))
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=2000, help="mutations of each layout")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="worldline-damaged-") as scratch:
        if arguments.what == "accounting":
            right = measure_accounting(Path(scratch), arguments.episodes, arguments.seed)
        else:
            sources = write_one_of_each(Path(scratch))
            clean = [attack_layout(name, sources[name], arguments.cases, arguments.seed) for name in sources]
            right = all(clean)
    if not right:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
