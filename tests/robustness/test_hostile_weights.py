"""Checkpoints of strangers: headers that lie, sizes without end, numbers that are none."""

from __future__ import annotations

import hashlib
import json
import math
import re
import resource
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import load_file, save_file

from worldline_core.distillation.trajectory_regression import TrajectoryStore
from worldline_core.errors import ArtifactError, CheckpointError
from worldline_core.evaluation.segmenters.learned import LearnedSegmenter, UNet, save_segmenter
from worldline_core.model.checkpoint import load_checkpoint, read_checkpoint_info, save_checkpoint
from worldline_core.model.networks import build_world_model
from worldline_core.model.tokenizers import load_tokenizer
from worldline_core.model.world_model_config import MixtureConfig
from worldline_core.store.artifact_files import read_json_lines, read_manifest
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.video_teacher import load_teacher


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    model = build_world_model(
        MixtureConfig(
            latent_channels=4, hidden_size=12, num_layers=2, num_heads=2, num_kv_heads=1, head_dim=12,
            intermediate_size=16, rope_sections=(2, 2, 2), vocab_size=7,
        )
    )  # fmt: skip
    model.initialise(torch.Generator().manual_seed(0))
    save_checkpoint(tmp_path / "c", model, kind="base", action_contract=None)
    return tmp_path / "c"


@pytest.fixture
def little_memory() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def sign(folder: Path, **config: int) -> None:
    """Describe the weights that are there: who writes both files can."""
    described = json.loads((folder / "checkpoint.json").read_text())
    described["weights_sha256"] = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    described["config"] |= config
    (folder / "checkpoint.json").write_text(json.dumps(described))


def tensor_file(header: dict[str, Any] | bytes, content: bytes = b"", length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + content


def entry(dtype: str = "F32", shape: tuple[int, ...] = (1,), at: tuple[int, int] = (0, 4)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": at}


FILES = {
    "empty": b"",
    "a header of 2^63 bytes": tensor_file({}, length=2**63),
    "a header beyond the end": tensor_file({}, length=10**6),
    "offsets that overlap": tensor_file({"a": entry(), "b": entry()}, b"\0" * 4),
    "offsets beyond the end": tensor_file({"a": entry(shape=(10**9,), at=(0, 4 * 10**9))}, b"\0" * 4),
    "offsets backwards": tensor_file({"a": entry(at=(4, 0))}, b"\0" * 4),
    "a negative shape": tensor_file({"a": entry(shape=(-1,))}, b"\0" * 4),
    "a shape that overflows": tensor_file({"a": entry(shape=(2**63, 2**63))}, b"\0" * 4),
    "an unknown type": tensor_file({"a": entry("OBJECT")}, b"\0" * 4),
    "no JSON": tensor_file(b"\xff" * 40),
    "nested without end": tensor_file(b"[" * 200_000),
    "a pickle": b"\x80\x04cos\nsystem\n(S'touch harmed'\ntR.",
}


NO_NUMBERS = {
    **{str(value): lambda old, value=value: old.clone().fill_(value) for value in (math.nan, math.inf, -math.inf)},
    **{str(dtype): lambda old, dtype=dtype: old.to(dtype) for dtype in (torch.int64, torch.bool, torch.complex64)},
}


@pytest.mark.parametrize("change", NO_NUMBERS.values(), ids=NO_NUMBERS)
def test_weights_that_are_no_real_numbers_are_refused(
    change: Callable[[torch.Tensor], torch.Tensor], folder: Path, segmenter: Path
) -> None:
    for place, name, error in ((folder, None, CheckpointError), (segmenter, "head.bias", ArtifactError)):
        tensors = load_file(place / "model.safetensors")
        name = name or sorted(tensors)[-1]
        save_file(tensors | {name: change(tensors[name])}, place / "model.safetensors")
        if place == folder:
            sign(folder)
        with pytest.raises(error, match=rf"(?s)(?=.*(not finite|floating-point)).*({name}|segmenter)"):
            load_checkpoint(folder) if place == folder else LearnedSegmenter.load(segmenter)


@pytest.mark.parametrize("size", [{"hidden_size": 10**6}, {"vocab_size": 10**12}, {"num_layers": 10**9}], ids=str)
def test_a_description_of_terabytes_takes_no_memory(size: dict[str, int], folder: Path, little_memory: None) -> None:
    sign(folder, **size)
    with pytest.raises(CheckpointError, match=r"wrong shape|do not fit|not valid"):
        load_checkpoint(folder)


@pytest.fixture
def segmenter(tmp_path: Path) -> Path:
    save_segmenter(tmp_path / "s", (8, 16), UNet((8, 16)).state_dict(), {"threshold": 0.5})
    return tmp_path / "s"


@pytest.mark.parametrize(
    "change",
    [
        {"widths": [8, 10**9]}, {"widths": [8] * 10**5}, {"widths": []}, {"widths": [8, 0]}, {"widths": [7, 16]},
        {"widths": 8}, {"widths": ["x"]}, {"widths": [8, 16, 24]}, {"threshold": None}, {"threshold": 1e400},
        {"threshold": math.nan}, {"threshold": -1},
    ],
    ids=lambda change: str(change)[:40],
)  # fmt: skip
def test_a_segmenters_description_that_fits_no_weights_is_refused(
    change: dict[str, Any], segmenter: Path, little_memory: None
) -> None:
    path = segmenter / "segmenter.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ArtifactError, match="segmenter cannot be read"):
        LearnedSegmenter.load(segmenter)


CLIP = {"episode_id": "a", "start": 0, "num_frames": 5, "stride": 1}


def write_shard(path: Path, clips: object = (CLIP,), **tensors: torch.Tensor) -> None:
    whole = {"nodes": torch.zeros(1, 2, 1, 1, 1, 2, 2).half(), "mask": torch.zeros(1, 1, 2, 2, 2).byte()} | tensors
    listed = clips if isinstance(clips, str) else json.dumps([clips, ["head"]])
    save_file(whole, path, metadata={"clips": listed})


@pytest.fixture
def trajectories(tmp_path: Path) -> Path:
    (tmp_path / "trajectories.json").write_text(json.dumps({"settings": {}, "shards": [""]}))
    write_shard(tmp_path / "shard-00000.safetensors")
    assert len(TrajectoryStore.open(tmp_path)) == 1
    return tmp_path


NODES = torch.zeros(1, 2, 1, 1, 1, 2, 2)


@pytest.mark.parametrize(
    ("shard", "match"),
    [
        *(
            ({"clips": clips}, "shard of trajectories")
            for clips in (
                "[" * 100_000, "{}", "[[]]", '[[1], ["head"]]', [CLIP | {"start": "0"}], [CLIP | {"num_frames": 1e99}],
                [{"start": 1}], [], [CLIP, CLIP], [CLIP | {"episode_id": 3}],
            )
        ),
        *(
            (tensors, "do not fit its clips")
            for tensors in (
                {"nodes": torch.zeros(1)}, {"nodes": NODES}, {"nodes": NODES.to(torch.int16)},
                {"mask": torch.zeros(1, 3, 2, 2, 2).byte()}, {"mask": torch.zeros(1, 1, 2, 2, 2)},
            )
        ),
        ({"nodes": torch.full_like(NODES, math.nan).half()}, "not finite"),
    ],
    ids=lambda shard: str(shard)[:60].split("tensor")[0],
)  # fmt: skip
def test_shards_that_are_none_are_refused(shard: dict[str, Any], match: str, trajectories: Path) -> None:
    write_shard(trajectories / "shard-00000.safetensors", **shard)
    with pytest.raises(ArtifactError, match=match):
        TrajectoryStore.open(trajectories).read("nodes", [0])


@pytest.mark.parametrize(
    "index", ["[" * 100_000, "[]", "{}", '{"shards": 3}', '{"shards": {"a": 1}}', '{"shards": []}']
)
def test_an_index_of_trajectories_that_is_none_is_refused(index: str, trajectories: Path) -> None:
    (trajectories / "trajectories.json").write_text(index)
    with pytest.raises(ArtifactError, match=r"damaged|wrong form|lists no shards"):
        TrajectoryStore.open(trajectories)


@pytest.mark.parametrize("content", FILES.values(), ids=FILES)
def test_weights_that_lie_are_refused(content: bytes, folder: Path, segmenter: Path, trajectories: Path) -> None:
    for file in (
        folder / "model.safetensors",
        segmenter / "model.safetensors",
        trajectories / "shard-00000.safetensors",
    ):
        file.write_bytes(content)
    sign(folder)
    with pytest.raises(CheckpointError, match=r"weights file is damaged|do not fit"):
        load_checkpoint(folder)
    with pytest.raises(ArtifactError, match="segmenter cannot be read"):
        LearnedSegmenter.load(segmenter)
    with pytest.raises(ArtifactError, match="shard of trajectories cannot be read"):
        TrajectoryStore.open(trajectories)


DAMAGED = {
    "nothing": b"", "a brace": b"{", "deep": b"[" * 100_000, "deep objects": b'{"a": ' * 100_000,
    "5,000 digits": b'{"a": ' + b"9" * 5000 + b"}", "a list": b"[]", "no text": b"\xff\xfe",
}  # fmt: skip


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_small_descriptions_that_are_none_are_named(tmp_path: Path, content: bytes) -> None:
    for name in ("config.json", "manifest.json", "store.json", "checkpoint.json", "teacher.json"):
        (tmp_path / name).write_bytes(content)
    pq.write_table(pa.table({"episode_id": ["a"]}), tmp_path / "index.parquet")
    for read in (load_teacher, LatentStore.open, load_tokenizer, read_manifest, read_checkpoint_info):
        with pytest.raises(ArtifactError, match=re.escape(str(tmp_path))):
            read(tmp_path)
    (tmp_path / "store.json").write_bytes(content + b"\n{}\n")
    if content not in (b"", b"[]"):
        with pytest.raises(ArtifactError, match="not JSON"):
            read_json_lines(tmp_path / "store.json")
