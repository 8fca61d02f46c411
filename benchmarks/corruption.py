"""Accounting on a corpus of corrupted recordings: kept + quarantined = found, and is every reason the true one?

Run: `python benchmarks/corruption.py [--episodes 2000] [--kills 10]`. Writes a seeded corpus (LeRobot v2.1,
AgiBot World, DROID annotations, MCAP, and the project's own recordings, each in many states of damage), curates and
filters it, and prints what became of each kind. With `--kills` the same work is done again in a process that is
killed (SIGKILL) at random moments and started again until it is through; digests must be those of the undisturbed run.
Seconds are of processor time.
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
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

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
from worldline_core.data.curation.curate import curate
from worldline_core.filters.filter import filter_episodes
from worldline_core.filters.filter_config import FilterConfig
from worldline_core.store.artifact_files import digest_folder
from worldline_core.store.atomic import remove_unfinished

ROOT = Path(__file__).resolve().parents[1]
OWN = ROOT / "artifacts" / "shipped" / "recordings"


def cpu_seconds() -> float:
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def work(folder: Path, output: Path) -> None:
    """Curate and filter; where both are finished nothing is done. As in the store, what a killed process left half written is
    removed first."""
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


def print_table(labels: Sequence[Label], found: Mapping[str, Outcome]) -> bool:
    """The confusion table; returns whether every kind is right in at least 99 %."""
    table, shares = confusion(labels, found), shares_right(labels, found)
    print("| layout | kind | recordings | right | ended as |\n|---|---|---:|---:|---|")
    for (layout, kind), counts in table.items():
        ended = ", ".join(f"{outcome} {count}" for outcome, count in counts.most_common())
        print(f"| {layout} | {kind} | {counts.total()} | {100 * shares[layout, kind]:.1f} % | {ended} |")
    wrong = {key: share for key, share in shares.items() if share < 0.99}
    right = sum(share * table[key].total() for key, share in shares.items())
    print(f"\n{len(labels)} recordings, {len(table)} kinds: {100 * right / len(labels):.2f} % right")
    print("below 99 %:", ", ".join("/".join(key) for key in wrong) or "none")
    return not wrong


def killed_run(folder: Path, output: Path, kills: int, seconds: float, seed: int) -> None:
    """Start the work again and again; the first `kills` times it is killed at a random moment.

    Args:
        seconds: what the undisturbed work takes on the clock; each try gets a drawn share of it.
    """
    moments = random.Random(seed)  # noqa: S311
    command = [sys.executable, __file__, "--folder", str(folder), "--work", str(output)]
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="where to work; default: a temporary folder, removed at the end")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work is not None:
        work(arguments.folder, arguments.work)
        return
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="worldline-corruption-"))
    try:
        start = cpu_seconds()
        kinds = kinds_per_layout()
        # As many clean recordings of each layout as of three of its kinds.
        each = -(-arguments.episodes // (kinds + 3 * 4))
        labels, _ = write_corpus(folder, healthy=3 * each, each=each, seed=arguments.seed, own_recordings=OWN)
        print(f"wrote {len(labels)} recordings in {cpu_seconds() - start:.0f} s")
        start, clock = cpu_seconds(), time.monotonic()
        work(folder, folder / "undisturbed")
        spent, elapsed = cpu_seconds() - start, time.monotonic() - clock
        print(f"curated and filtered in {spent:.0f} s ({1e3 * spent / len(labels):.0f} ms a recording)\n")
        found = outcomes(folder / "undisturbed/curated", folder / "undisturbed/filtered")
        lost, more = {label.episode_id for label in labels} - set(found), set(found) - {x.episode_id for x in labels}
        right = print_table(labels, found)
        print(f"lost: {len(lost)}, not in the corpus: {len(more)}, crashed: {_crashed(found)}")
        ok = right and not lost and not more and not _crashed(found)
        if arguments.kills:
            killed_run(folder, folder / "killed", arguments.kills, elapsed, arguments.seed)
            same = digests(folder / "undisturbed") == digests(folder / "killed")
            print(f"digests {'are the same' if same else 'DIFFER'}: {digests(folder / 'killed')}")
            ok = ok and same
    finally:
        if arguments.folder is None:
            shutil.rmtree(folder, ignore_errors=True)
    if not ok:
        raise SystemExit(1)


def _crashed(found: Mapping[str, Outcome]) -> int:
    return sum(outcome.reason == "crashed" for outcome in found.values())


if __name__ == "__main__":
    main()
