"""Input of the text tower: bytes for the embedded default, the backbone's own chat prompt at full size."""

import json
from types import SimpleNamespace

import pytest
import torch
from pydantic import ValidationError

from tests.training.conftest import TINY_MODEL, losses, stage1, trainer
from worldline_core.errors import CheckpointError, ConfigError, UnavailableError
from worldline_core.model.checkpoint import load_checkpoint
from worldline_core.model.text import VISION_START, ClipFacts, Cosmos3Text, load_text_encoder, padded
from worldline_core.model.world_model_config import MixtureConfig, TextConfig
from worldline_core.rehearsal.outside_models import write_qwen2_tokenizer
from worldline_core.training import stage1 as stage1_module
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipBatch
from worldline_core.training.clip_source import LatentStore
from worldline_core.training.stage1 import StoredText, train_stage1


def test_stage1_feeds_the_chat_prompt_of_each_clip(world, tmp_path, seen):
    write_qwen2_tokenizer(tmp_path / "tokenizer")
    config = stage1(model=TINY_MODEL | {"vocab_size": 1024}, text={"kind": "cosmos3", "path": str(tmp_path / "tokenizer"), "max_length": 200}, text_dropout=0.0, clips={"lengths": [9], "view_weights": {"primary": 1}}, trainer={"steps": 2, "batch_size": 2, "validation_batches": 0})  # fmt: skip
    train_stage1(config, world.inputs, tmp_path / "out")
    text = Cosmos3Text(tmp_path / "tokenizer")
    assert len(seen) == 2
    assert not {clip.episode_id for batch in seen for clip in batch.clips} & {
        "episode-000",
        "episode-001",
    }  # validation
    for batch in seen:
        for clip, ids, mask in zip(batch.clips, batch.text_ids, batch.text_mask, strict=True):
            instruction = f"move {int(clip.episode_id.removeprefix('episode-'))}"
            # 9 frames at 8 a second; the synthetic pictures are 32 pixels high and wide.
            assert ids[mask].tolist() == text.ids(instruction, ClipFacts(9, 8.0, (32, 32)))


def test_a_stride_slows_the_frames_that_the_prompt_names(world):
    asked = []

    def record(texts, clips):
        asked.extend(clips)
        return torch.ones(len(texts), 1, dtype=torch.long), torch.ones(len(texts), 1, dtype=torch.bool)

    store = LatentStore.open(world.latents)
    loader = ClipLoader(store, views=("head",), text=record, frame_rates={"episode-000": 8.0})
    assert loader.clip_facts(Clip("episode-000", 0, 9, 2)) == ClipFacts(9, 4.0, (32, 32))
    batch = loader.load(ClipBatch((Clip("episode-000", 0, 9, 1),), ("head",)))
    assert batch.fps.tolist() == [8.0]
    assert asked == [ClipFacts(9, 8.0, (32, 32))]


def without_text_training(tower):
    clips = {"lengths": [9, 17], "view_weights": {"primary": 1}}
    return stage1(trainer=trainer(2, save_every_steps=1), text_tower=tower, text_dropout=0.0, clips=clips)


def test_stored_prompts_are_read_as_the_text_tower_reads_them(base):
    """Alone or with a longer text, which moves them in time."""
    model, _ = load_checkpoint(base)
    short, long = (7, 8, 9), (5, 4, 3, 11, 12, 13, 14)
    stored = StoredText(model, [short, long], "cpu")
    latents, sigma = torch.randn(2, 1, 4, 3, 4, 4, generator=torch.Generator().manual_seed(3)), torch.tensor([0.3, 0.8])
    for prompts in ([short, short], [long, short]):
        texts = padded(prompts, 0)
        wanted, found = (
            model(latents, sigma, text=read(*texts), views=("head",)).velocity for read in (model.encode_text, stored)
        )
        torch.testing.assert_close(found, wanted, atol=1e-5, rtol=1e-5)


def test_a_text_tower_that_is_not_trained_stays_as_it_is_and_may_be_left_out(
    world, base, tmp_path, killed_after, monkeypatch
):
    given, start = {"base": base, **world.inputs}, load_checkpoint(base, towers="both")[0].state_dict()
    for tower in ("frozen", "stored"):
        train_stage1(without_text_training(tower), given, tmp_path / tower)
        weights = load_checkpoint(tmp_path / tower, towers="both")[0]
        changed = {name for name, value in weights.state_dict().items() if not torch.equal(value, start[name])}
        assert changed and not any(weights.is_text_parameter(name) or "action" in name for name in changed)
    assert losses(tmp_path / "stored") == pytest.approx(losses(tmp_path / "frozen"), rel=1e-4)
    with killed_after(1):
        train_stage1(without_text_training("stored"), given, tmp_path / "killed")
    train_stage1(without_text_training("stored"), given, tmp_path / "killed")
    files = [tmp_path / name / "model.safetensors" for name in ("killed", "stored")]
    assert files[0].read_bytes() == files[1].read_bytes()
    monkeypatch.setattr(stage1_module, "MOST_BYTES", 1000)
    for tower, inputs, message in (
        ("stored", given, r"too much to keep[\s\S]*8 prompts of up to 7 tokens[\s\S]*text_tower to frozen"),
        ("frozen", world.inputs, r"comes from a checkpoint[\s\S]*--input base=FOLDER"),
    ):
        with pytest.raises(ConfigError, match=message):
            train_stage1(without_text_training(tower), inputs, tmp_path / "refused")
    with pytest.raises(ValidationError, match="set text_tower to frozen"):
        stage1(trainer=trainer(1), lora={})


def test_bytes_are_what_the_shipped_checkpoints_were_trained_on():
    ids, mask = load_text_encoder(TextConfig(max_length=6), MixtureConfig(vocab_size=300))(
        [" Lift ", "put it down"], [CLIP, CLIP]
    )
    # Bytes of "lift" and "put i" are shifted by two, 1 ends a text, 0 pads.
    assert ids.tolist() == [[110, 107, 104, 118, 1, 0], [114, 119, 118, 34, 107, 1]]
    assert mask.tolist() == [[True] * 5 + [False], [True] * 6]


def test_text_that_does_not_fit_the_model_is_refused(tmp_path):
    write_qwen2_tokenizer(tmp_path)
    for config, size, error, message in (
        (TextConfig(), 100, ConfigError, "vocabulary is too small"),
        (TextConfig(kind="cosmos3", path=str(tmp_path)), 20, ConfigError, "vocabulary is too small"),
        (TextConfig(kind="cosmos3"), 300, ConfigError, "needs a folder or a file"),
        (TextConfig(kind="cosmos3", path=str(tmp_path / "none")), 151_936, UnavailableError, "is not here"),
    ):
        with pytest.raises(error, match=message):
            load_text_encoder(config, MixtureConfig(vocab_size=size))


UNUSED = [
    f"{name}_template"
    for name in ("inverse_duration", "image_resolution", "inverse_image_resolution", "inverse_video_resolution")
]
CLIP = ClipFacts(num_frames=129, fps=24.0, image_size=(480, 640))


@pytest.fixture
def folder(tmp_path):
    write_qwen2_tokenizer(tmp_path / "tokenizer")
    return tmp_path / "tokenizer"


@pytest.mark.parametrize("system_prompt", [True, False])
def test_ids_are_those_of_diffusers(folder, system_prompt):
    from diffusers.pipelines.cosmos.pipeline_cosmos3_omni import Cosmos3OmniPipeline

    (folder.parent / "model_index.json").write_text(json.dumps({"default_use_system_prompt": system_prompt}))
    text = Cosmos3Text(folder, system_prompt=system_prompt)
    with pytest.raises(CheckpointError, match="system_prompt"):
        Cosmos3Text(folder, system_prompt=not system_prompt)
    pipeline = SimpleNamespace(
        config=SimpleNamespace(default_use_system_prompt=system_prompt),
        text_tokenizer=text.tokenizer,
        llm_special_tokens={
            "start_of_generation": text.tokenizer.convert_tokens_to_ids(VISION_START),
            "eos_token_id": text.tokenizer.eos_token_id,
        },
        duration_template="The video is {duration:.1f} seconds long and is of {fps:.0f} FPS.",
        video_resolution_template="This video is of {height}x{width} resolution.",
        **dict.fromkeys(UNUSED, ""),
    )
    for instruction in ("lift the red cube.", "put it down", ""):
        expected, _ = Cosmos3OmniPipeline.tokenize_prompt(
            pipeline, instruction, num_frames=129, height=480, width=640, fps=24.0
        )
        assert text.ids(instruction, CLIP) == expected


def test_a_long_instruction_loses_its_last_words_and_nothing_else(folder):
    whole = Cosmos3Text(folder).ids("lift the red cube", CLIP)
    assert Cosmos3Text(folder, max_length=len(whole)).ids("lift the red cube", CLIP) == whole
    shorter = Cosmos3Text(folder, max_length=len(whole) - 1)
    assert shorter.ids("lift the red cube", CLIP) == shorter.ids("lift the red", CLIP)
    with pytest.raises(ConfigError, match="too short for the prompt's frame"):
        Cosmos3Text(folder, max_length=10).ids("lift", CLIP)


def test_missing_or_foreign_tokenizers_are_named(tmp_path):
    with pytest.raises(UnavailableError, match="text tokenizer is not here"):
        Cosmos3Text(tmp_path / "nothing")
    write_qwen2_tokenizer(tmp_path)
    for path in tmp_path.glob("tokenizer*.json"):
        path.write_text(path.read_text().replace("<|vision_start|>", "<|vision_begin|>"))
    with pytest.raises(CheckpointError, match="Not the tokenizer of a Cosmos3 model"):
        Cosmos3Text(tmp_path)
