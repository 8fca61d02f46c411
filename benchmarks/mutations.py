"""Blind damage to small files of every layout, for as long as asked: an error that is none of this project's is a bug.

Run: `python benchmarks/mutations.py [--cases 2000] [--seed 0] [--layout NAME ...]`. Each case damages one file (bytes changed,
zeroed, repeated, cut; values of JSON exchanged for odd ones), reads everything, and puts the file back. A crash of a
decoder ends the process: the last line printed names layout and seed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

from pydantic import TypeAdapter

from tools.corrupted.mutations import attack
from tools.corrupted.one_of_each import write_one_of_each
from worldline_core.data.sources.open import SourceConfig


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=2000, help="for each layout")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--layout", action="append")
    arguments = parser.parse_args()
    bugs = 0
    with tempfile.TemporaryDirectory() as folder:
        sources = write_one_of_each(Path(folder))
        for layout in arguments.layout or sources:
            config = TypeAdapter(SourceConfig).validate_python(sources[layout])
            print(f"{layout}, seed {arguments.seed}: ", end="", flush=True)
            start = time.process_time()
            found: Counter[tuple[str, str]] = Counter()
            example: dict[tuple[str, str], str] = {}
            for unexpected in attack(config, Path(sources[layout]["path"]), arguments.cases, arguments.seed):
                key = unexpected.trace, unexpected.error.split(":")[0]
                found[key] += 1
                example.setdefault(key, f"{unexpected.file}, case {unexpected.case}: {unexpected.error}")
            seconds = time.process_time() - start
            print(f"{arguments.cases} cases, {seconds:.0f} s of processor time, {found.total()} unexpected errors")
            for key, count in found.most_common():
                print(f"    {count} x {key[1]} at {key[0]}\n        {example[key]}")
            bugs += len(found)
    if bugs:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
