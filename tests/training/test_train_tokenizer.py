"""The train_tokenizer step: from scratch, from another tokenizer, measured on another set."""

import json

import pytest
import torch

from tasks.train_tokenizer import train_tokenizer as tokenizer_task
from worldline_core.model.small_decoder import SmallDecoder
from worldline_core.model.tokenizers import PatchTokenizer
from worldline_core.rehearsal.outside_models import small_wan_autoencoder
from worldline_core.store.artifact_files import digest_folder, read_json_lines
from worldline_core.training.train_tokenizer import train_tokenizer
from worldline_core.training.training_config import TokenizerConfig

CONFIG = TokenizerConfig(
    image_size=(32, 32), channels=8, refinement_width=4, refinement_depth=1, held_out_episodes=1, clip_frames=9,
    fit_clips=6, steps=3, checkpoint_every=1, batch_size=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def trained(world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    train_tokenizer(CONFIG, {"episodes": world.episodes}, folder)
    return folder


def test_the_step_writes_a_tokenizer_its_losses_and_its_metrics(trained):
    metrics = json.loads((trained / "metrics.json").read_text())
    assert (metrics["training_episodes"], metrics["training_views"]) == (6, 18)
    assert metrics["held_out"]["psnr/decoded"] > 10
    assert read_json_lines(trained / "metrics.jsonl")[-1]["step"] == 3
    assert PatchTokenizer.load(trained).latent_channels == 8


def test_a_killed_training_ends_with_the_same_bytes(world, trained, tmp_path, killed_after):
    with killed_after(2):
        train_tokenizer(CONFIG, {"episodes": world.episodes}, tmp_path)
    train_tokenizer(CONFIG, {"episodes": world.episodes}, tmp_path)
    assert digest_folder(tmp_path) == digest_folder(trained)


def test_without_steps_only_the_bases_are_fitted(world, tmp_path):
    changes = {"steps": 0, "max_episodes": 2}
    counts = train_tokenizer(CONFIG.model_copy(update=changes), {"episodes": world.episodes}, tmp_path)
    assert not (tmp_path / "metrics.jsonl").exists()
    # Every episode is accounted for: the line that ends the step says so.
    assert (counts["found"], counts["kept"]) == (8, 2)
    assert counts["left_out"] == {"in other splits": 2, "beyond max_episodes": 4, "shorter than 5 frames": 0}
    assert PatchTokenizer.load(tmp_path).latent_channels == 8


def test_a_small_decoder_is_trained_for_the_latents_of_an_existing_tokenizer(world, trained, tmp_path):
    inputs = {"episodes": world.episodes, "encoder": trained}
    tokenizer_task.check_inputs(inputs)
    before = digest_folder(trained)
    found = [
        train_tokenizer(CONFIG.model_copy(update={"steps": steps}), inputs, tmp_path / str(steps)) for steps in (0, 12)
    ]
    assert found[1]["held_out"] != found[0]["held_out"]
    assert all(metrics["held_out"]["psnr/decoded"] > metrics["own_decoder"]["psnr/linear"] for metrics in found)
    assert found[0]["own_decoder"] == found[1]["own_decoder"]
    assert found[0]["own_decoder"]["psnr/decoded"] > 10
    assert digest_folder(trained) == before
    tokenizer = PatchTokenizer.load(trained)
    assert SmallDecoder.load(tmp_path / "12", tokenizer, tokenizer.encoder_digest[:16]).config.width == 4
    assert not (tmp_path / "12" / "tokenizer.json").exists()


def test_a_wan_autoencoder_gets_one_too(world, tmp_path):
    torch.manual_seed(0)
    small_wan_autoencoder().save_pretrained(tmp_path / "wan" / "vae")
    inputs = {"episodes": world.episodes, "encoder": tmp_path / "wan"}
    changes = {"steps": 1, "max_episodes": 1}
    metrics = train_tokenizer(CONFIG.model_copy(update=changes), inputs, tmp_path / "decoder")
    assert metrics["held_out"].keys() == metrics["own_decoder"].keys()
    assert json.loads((tmp_path / "decoder" / "decoder.json").read_text())["config"]["spatial_compression"] == 16
