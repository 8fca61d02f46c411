"""A small random causal model with the shipped tokenizer and recordings, and servers of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("msgpack")
pytest.importorskip("uvicorn")

from worldline_core import WorldLine
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.world_model import WorldModel
from worldline_core.model.world_model_config import CausalSpec
from worldline_core.serving.app import make_server
from worldline_core.serving.serve_config import ServeConfig

Serve = Callable[..., "contextmanager[str]"]


@pytest.fixture(scope="session")
def shipped(project_root: Path) -> Path:
    return project_root / "artifacts" / "shipped"


@pytest.fixture(scope="session")
def small_world(shipped: Path, make_model: Callable[..., WorldModel]) -> WorldLine:
    """Blocks of one latent frame (four pictures), one Euler step."""
    given = WorldLine.from_pretrained(shipped / "models" / "causal")
    _, info = load_checkpoint(shipped / "models" / "causal", towers="generation")
    model = make_model(latent_channels=32, num_layers=1)
    spec = CausalSpec(block_size=1, sink_blocks=1, recent_blocks=2, anchor_blocks=None, sigmas=(1.0, 0.0))
    return WorldLine(model, info.model_copy(update={"config": model.config, "causal": spec}), given.tokenizer)


@pytest.fixture(scope="session")
def serving(small_world: WorldLine, shipped: Path) -> Serve:
    """``with serving(token=None, **settings) as url:`` a server on a free port, in a thread."""

    @contextmanager
    def serve(token: str | None = None, world: WorldLine = small_world, **settings: object) -> Iterator[str]:
        config = ServeConfig.model_validate({"port": 0, "episodes": shipped / "recordings", **settings})
        server = make_server(world, config, token)
        thread = threading.Thread(target=server.run)
        thread.start()
        deadline = time.monotonic() + 20
        while not server.started and thread.is_alive() and time.monotonic() < deadline:
            time.sleep(0.01)
        assert server.started
        try:
            yield f"ws://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join(20)
        assert not thread.is_alive()

    return serve
