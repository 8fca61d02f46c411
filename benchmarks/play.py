"""Can the page be driven in real time? Blocks of `worldline play` through its own session, against the model's rate.

python benchmarks/play.py [--blocks 8] [--checkpoint FOLDER] [--decoder FOLDER] [--threads 2]
"""

from __future__ import annotations

import argparse
import json
import statistics
import threading
import time
from pathlib import Path

import torch
from websockets.sync.client import connect

from worldline_core import WorldLine
from worldline_core.serving.app import make_server
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.shipped import shipped_folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=8)
    parser.add_argument("--checkpoint", type=Path, default=shipped_folder() / "models" / "causal")
    parser.add_argument("--decoder", type=Path, help="folder of a small decoder")
    parser.add_argument("--episode", default="ur5e_silver-test-s1-00000")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    world = WorldLine.from_pretrained(options.checkpoint, decoder=options.decoder)
    config = ServeConfig.model_validate({"port": 0, "episodes": shipped_folder() / "recordings"})
    server = make_server(world, config, None)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    firsts, blocks, frames, views = [], [], 0, 0
    with connect(
        f"ws://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}/play/session", max_size=None, proxy=None
    ) as page:

        def until_block() -> dict:
            while not isinstance(found := page.recv(timeout=300), bytes):
                if json.loads(found)["type"] == "error":
                    raise SystemExit(found)
            return json.loads(found[4 : 4 + int.from_bytes(found[:4], "little")])

        for _ in range(3):
            begin = time.perf_counter()
            page.send(json.dumps({"type": "start", "episode": options.episode}))
            until_block()
            firsts.append(time.perf_counter() - begin)
        for _ in range(options.blocks):
            # As fast as it goes: the ticks' inverse kinematics and marks are counted, waiting for a person is not.
            begin = time.perf_counter()
            for _ in range(world.frames_per_unit):
                page.send(json.dumps({"type": "tick", "arms": [{}, {"move": [0.2, 0, 0.3]}]}))
            head = until_block()
            blocks.append(time.perf_counter() - begin)
            frames, views = head["frames"], len(head["views"])
    server.should_exit = True
    thread.join()
    rate = frames / statistics.median(blocks)
    print(json.dumps({
        "threads": options.threads, "views": views, "frames_per_block": frames, "model_fps": world.contract.fps,
        "first_picture_s": firsts, "block_s": {"median": statistics.median(blocks), "largest": max(blocks)},
        "frames_per_second": rate, "times_real_time": rate / world.contract.fps,
    }, indent=1))  # fmt: skip


if __name__ == "__main__":
    main()
