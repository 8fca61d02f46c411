from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from einops import rearrange
from safetensors.torch import load_file, save_file

from worldline_core.errors import ArtifactError, ConfigError, DataError
from worldline_core.training.clip_config import EncodeLatentsConfig
from worldline_core.training.clip_source import latent_frame_count, longest_clip
from worldline_core.training.encode_latents import choose_layout, encode_episode
from worldline_core.training.latent_store import LatentRow, LatentStore


class Memoryless:
    """Latent frame j sums its own four frames; the first frame alone is its own latent."""

    def encode(self, video: torch.Tensor) -> torch.Tensor:
        first = video[:, :, :1] * 4
        groups = rearrange(video[:, :, 1:], "b c (t k) h w -> b c t k h w", k=4).sum(3)
        return torch.cat([first, groups], 2)


class Remembering(Memoryless):
    """Every latent frame also holds the sum of all before it."""

    def encode(self, video: torch.Tensor) -> torch.Tensor:
        return super().encode(video).cumsum(2)


@pytest.fixture
def video() -> torch.Tensor:
    """White and black, -1 and 1, whose sums are exact."""
    return 255 * torch.randint(0, 2, (2, 3, 30, 2, 2), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("start_step", [2, 3, 4])
@pytest.mark.parametrize("tokenizer", [Memoryless(), Remembering()])
def test_a_clip_of_the_store_equals_direct_encoding(
    tmp_path: Path, video: torch.Tensor, tokenizer: Memoryless, start_step: int, stride: int
) -> None:
    config = EncodeLatentsConfig(start_step=start_step, strides=(stride,), views=("a", "b"))
    layout = choose_layout(tokenizer, video[0], config)
    assert layout == ("clips" if isinstance(tokenizer, Remembering) else "groups")
    save_file(encode_episode(tokenizer, "e", list(video), layout, config), tmp_path / "s.safetensors")
    video = video / 127.5 - 1
    row = LatentRow("e", 30, ("a", "b"), "s", "r", "train", "", "a", "s.safetensors")
    description = {"layout": layout, "start_step": start_step, "strides": [stride], "latent_shape": [3, 2, 2]}
    store = LatentStore(tmp_path, description | {"image_size": [2, 2]}, [row])
    checked = 0
    for start in range(0, 30, start_step):
        for length in range(1, longest_clip(row.num_frames, start, stride) + 1, 4):
            frames = list(range(start, start + stride * length, stride))
            assert torch.equal(store.clip("e", start, length, stride), tokenizer.encode(video[:, :, frames]))
            checked += 1
    assert checked > 15
    assert torch.equal(store.clip("e", 0, 5, stride, ("b",)), store.clip("e", 0, 5, stride)[1:])


def test_groups_are_refused_where_they_would_not_be_exact(video: torch.Tensor) -> None:
    with pytest.raises(ConfigError, match="depend on earlier frames"):
        choose_layout(Remembering(), video[0], EncodeLatentsConfig(layout="groups"))


def test_lengths_that_do_not_fit_the_tokenizer_are_named() -> None:
    assert latent_frame_count(33) == 9
    with pytest.raises(DataError, match="a length that the causal tokenizer cannot encode"):
        latent_frame_count(32)


def test_bad_requests_and_bad_values_are_named(world: object, tmp_path: Path) -> None:
    root = tmp_path / "latents"
    shutil.copytree(world.latents, root)  # type: ignore[attr-defined]
    store = LatentStore.open(root)
    with pytest.raises(DataError, match="does not fit the stored latents"):
        store.clip("episode-000", 4, 17)
    with pytest.raises(ArtifactError, match="not encoded at this stride"):
        store.clip("episode-000", 0, 5, 2)
    with pytest.raises(ArtifactError, match="does not hold this episode"):
        store.clip("nobody", 0, 5)
    with pytest.raises(ArtifactError, match="does not hold this view"):
        store.clip("episode-000", 0, 5, 1, ("top",))
    tensors = load_file(root / "00000.safetensors")
    tensors["episode-000/groups/1/1"][0, 0, 0, 0, 0] = float("nan")
    save_file(tensors, root / "00000.safetensors")
    with pytest.raises(DataError, match="values that are not finite"):
        LatentStore.open(root).clip("episode-000", 0, 17)
    with pytest.raises(ArtifactError, match="not a Latents artifact"):
        LatentStore.open(tmp_path)


def test_a_damaged_and_a_missing_shard_are_named(world: object, tmp_path: Path) -> None:
    root = tmp_path / "latents"
    shutil.copytree(world.latents, root)  # type: ignore[attr-defined]
    content = (root / "00000.safetensors").read_bytes()
    (root / "00000.safetensors").write_bytes(content[: len(content) // 2])
    with pytest.raises(ArtifactError, match="shard is damaged or cannot be opened"):
        LatentStore.open(root).clip("episode-000", 0, 17)
    (root / "00000.safetensors").unlink()
    with pytest.raises(ArtifactError, match=r"(?s)cannot be opened.*00000\.safetensors.*encode the latents again"):
        LatentStore.open(root).clip("episode-000", 0, 17)
