"""Damaged input: is every recording accounted for by its true reason, and does blind damage ever cause an unexpected error?

    python benchmarks/robustness.py accounting [--episodes 2000] [--kills 10]
    python benchmarks/robustness.py mutations [--cases 2000] [--seed 0] [--layout NAME ...]

- `accounting`: a seeded corpus (LeRobot v2.1, AgiBot World, DROID annotations, MCAP, and the project's own recordings, each in
  many states of damage) is curated and filtered: kept + quarantined = found, each kind with its true reason. `--kills`
  does the same work in a process that is killed (SIGKILL) at random moments and started again; its digests must be
  those of the undisturbed run. Processor time.
- `mutations`: each case damages one small file (bytes changed, zeroed, repeated, cut; JSON values exchanged for odd ones), reads
  everything, and puts the file back. Any error that is not the project's own is a bug. A decoder crash ends the
  process: the last line printed names layout and seed.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import TypeAdapter

from benchmarks.harness import RECORDINGS, command_line, print_table, timed
from tools.corrupted.corpus import (
    Outcome,
    confusion,
    kinds_per_layout,
    outcomes,
    read_corpus,
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
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.atomic import remove_unfinished


def work(folder: Path, output: Path) -> None:
    """Curates and filters after removing what a killed process left unfinished, as the store does."""
    _, config = read_corpus(folder)
    remove_unfinished(output)
    for counts in (
        curate(config, {}, output / "curated"),
        filter_episodes(FilterConfig(), {"episodes": output / "curated"}, output / "filtered"),
    ):
        if counts["kept"] + counts["quarantined"] != counts["found"]:
            raise SystemExit(f"the account does not add up: {counts}")


def digests(output: Path) -> dict[str, str]:
    return {step: digest_folder(output / step) for step in ("curated", "filtered")}


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


def killed_run(folder: Path, output: Path, kills: int, seconds: float, seed: int) -> None:
    """Starts the work again and again, killed at a random moment the first `kills` times.

    Args:
        seconds: wall time of the undisturbed work; each try gets a random share of it.
    """
    moments = random.Random(seed)  # noqa: S311
    command = [sys.executable, __file__, "accounting", "--folder", str(folder), "--work", str(output)]
    done = 0
    while done < kills:
        process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
        wait = moments.uniform(0.1, 2.0) * seconds / (kills / 2 + 1)
        try:
            if process.wait(timeout=wait) != 0:
                raise SystemExit(f"the work failed by itself after {done} kills")
            print(f"finished before kill {done + 1}: digests {digests(output)}; once more from the beginning")
            shutil.rmtree(output)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            done += 1
            parts = sum(1 for _ in (output / "curated/run/episodes/parts").glob("[!.]*"))
            verdicts = sum(1 for _ in (output / "filtered/run/verdicts").glob("*.json"))
            print(f"kill {done} after {wait:.1f} s: {parts} parts waiting, {verdicts} verdicts", flush=True)
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    print(f"{done} kills, then through")


def measure_accounting(folder: Path, episodes: int, seed: int, kills: int) -> bool:
    # As many clean recordings of each layout as of three of its kinds.
    each = -(-episodes // (kinds_per_layout() + 3 * 4))
    (labels, _), _, spent = timed(
        lambda: write_corpus(folder, healthy=3 * each, each=each, seed=seed, own_recordings=RECORDINGS)
    )
    print(f"wrote {len(labels)} recordings in {spent:.0f} s")
    _, elapsed, spent = timed(lambda: work(folder, folder / "undisturbed"))
    print(f"curated and filtered in {spent:.0f} s ({1e3 * spent / len(labels):.0f} ms a recording)")
    found = outcomes(folder / "undisturbed/curated", folder / "undisturbed/filtered")
    right = report(labels, found)
    lost, more = {label.episode_id for label in labels} - set(found), set(found) - {x.episode_id for x in labels}
    crashed = sum(outcome.reason == "crashed" for outcome in found.values())
    print(f"lost: {len(lost)}, not in the corpus: {len(more)}, crashed: {crashed}")
    same = True
    if kills:
        killed_run(folder, folder / "killed", kills, elapsed, seed)
        same = digests(folder / "undisturbed") == digests(folder / "killed")
        print(f"digests {'are the same' if same else 'DIFFER'}: {digests(folder / 'killed')}")
    return right and same and not (lost or more or crashed)


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
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--cases", type=int, default=2000, help="mutations of each layout")
    parser.add_argument("--layout", action="append", help="mutations of this layout; default: all")
    parser.add_argument("--folder", type=Path, help="where to work; default: a temporary folder, removed at the end")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work is not None:
        work(arguments.folder, arguments.work)
        return
    with tempfile.TemporaryDirectory(prefix="worldline-damaged-") as scratch:
        folder = arguments.folder or Path(scratch)
        if arguments.what == "accounting":
            right = measure_accounting(folder, arguments.episodes, arguments.seed, arguments.kills)
        else:
            sources = write_one_of_each(folder)
            layouts = arguments.layout or list(sources)
            clean = [attack_layout(name, sources[name], arguments.cases, arguments.seed) for name in layouts]
            right = all(clean)
    if not right:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
