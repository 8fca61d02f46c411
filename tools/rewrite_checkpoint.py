"""Bring the ``checkpoint.json`` of an earlier causal model up to date; its weights stay as they are.

    python tools/rewrite_checkpoint.py FOLDER...

Block size, window and nodes used to lie in the metadata, where nobody read them; now they are the field ``causal``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from worldline_core.model.checkpoint import DESCRIPTION, read_checkpoint_info, write_description
from worldline_core.store.atomic import write_json_atomic

MOVED = ("block_size", "window", "sigmas", "clip_latent_frames")


def rewritten(content: dict[str, Any]) -> dict[str, Any]:
    """The description with its causal blocks in their own field.

    Of recent blocks only those count that the longest clip of training had: what rollouts have used.
    """
    metadata = content["metadata"]
    if content["kind"] != "causal" or "causal" in content:
        return content
    blocks = (metadata["clip_latent_frames"] - 1) // metadata["block_size"]
    causal = {
        "block_size": metadata["block_size"],
        "sink_blocks": metadata["window"]["sink_blocks"],
        "recent_blocks": max(0, min(metadata["window"]["recent_blocks"], blocks - 1)),
        "sigmas": metadata["sigmas"],
    }
    kept = {name: value for name, value in metadata.items() if name not in MOVED}
    return content | {"metadata": kept, "causal": causal}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    for folder in parser.parse_args().folders:
        path = folder / DESCRIPTION
        write_json_atomic(path, rewritten(json.loads(path.read_text(encoding="utf-8"))))
        write_description(folder, read_checkpoint_info(folder))


if __name__ == "__main__":
    main()
