"""Stage I: action-free, text-conditioned prediction of a single task-facing view (docs/method.md sections 1 and 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from worldline_core.errors import ConfigError
from worldline_core.model.checkpoint import CheckpointInfo, load_checkpoint, read_checkpoint_info
from worldline_core.model.layers import TextContext
from worldline_core.model.networks import build_world_model
from worldline_core.model.text import load_text_encoder, padded
from worldline_core.model.world_model import WorldModel
from worldline_core.progress import with_progress
from worldline_core.training.clip_config import ClipSampling
from worldline_core.training.clip_loader import ClipLoader
from worldline_core.training.clip_sampler import Clip, ClipRow
from worldline_core.training.flow_matching import FlowMatchingObjective
from worldline_core.training.processes import hold_weights, processes
from worldline_core.training.stage import Stage
from worldline_core.training.trainer import ParameterGroup, autocast, trained_groups
from worldline_core.training.training_config import Stage1Config

MOST_BYTES = 2**32
"""Most bytes of the machine's memory that the keys and values of all prompts may take."""


def stage1_groups(model: WorldModel) -> list[ParameterGroup]:
    """Group the trained parameters of both towers; the action branch is untouched, so it is still zero when Stage II begins."""
    generation = ParameterGroup("generation", dict(model.generation_parameters()))
    return trained_groups(generation, ParameterGroup("text", dict(model.text_parameters())))


def train_stage1(config: Stage1Config, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on ``inputs['episodes']``, by cached ``latents`` or by frames and a ``tokenizer``; optionally from ``base``.

    Raises:
        CheckpointError: if ``base`` is not a base or Stage I checkpoint.
        ConfigError: if the text does not fit the model's vocabulary.
        DataError: if no clip is long enough, or one cannot be read.
    """

    parent = Path(inputs["base"]) if "base" in inputs else None
    title = "stage I" if config.kind == "stage1" else "base"
    if parent is None and config.text_tower != "trained":
        raise ConfigError(
            "A text tower that is not trained comes from a checkpoint", where=f"{title}: text_tower", expected="an input base",
            got="none", next_step="give --input base=FOLDER, or set text_tower to trained",
        )  # fmt: skip

    def load_model() -> tuple[WorldModel, CheckpointInfo | None]:
        if parent is not None:
            towers = "generation" if config.text_tower == "stored" else "both"
            first = processes()[0] == 0
            model, info = load_checkpoint(parent, expect_kind=("base", "stage1"), towers=towers, weights=first)
            for _, parameter in model.text_parameters():
                parameter.requires_grad_(config.text_tower == "trained")
            return model, info
        model = build_world_model(config.model)
        model.initialise(torch.Generator().manual_seed(config.trainer.seed))
        return model, None

    stage = Stage.open(config, inputs, output, number=1, title=title, load_model=load_model, parent=parent)
    model = stage.model
    loader = stage.loader(text=load_text_encoder(config.text, model.config))
    objective = FlowMatchingObjective(
        model, sigma=config.sigma, weighting=config.weighting, text_dropout=config.text_dropout
    )
    if parent is not None and config.text_tower == "stored":
        objective.encode_text = _stored_text(config, parent, prompts_of(loader, stage.rows, config.clips))
    result = stage.train(objective, stage1_groups(model), loader)
    facts = {"start": stage.start, "text": config.text.model_dump(mode="json")}
    towers = None if parent is None else read_checkpoint_info(parent).config.towers
    counts = stage.save(result, kind=config.kind, action_contract=None, facts=facts, towers=towers)
    parameters = sum(value.numel() for value in model.parameters())
    return {**counts, "parameters": parameters, **result.metrics}


def _stored_text(config: Stage1Config, base: Path, prompts: Sequence[tuple[int, ...]]) -> StoredText:
    """Keys and values of the prompts, by the text tower of ``base``, which alone is on the device meanwhile."""
    trainer = config.trainer
    model, _ = load_checkpoint(base, towers="both")
    hold_weights(model.requires_grad_(False), trainer.precision)
    for _, parameter in model.text_parameters():
        parameter.data = parameter.data.to(trainer.device)
    with autocast(trainer):
        return StoredText(model, prompts, trainer.device)


def prompts_of(loader: ClipLoader, rows: Sequence[ClipRow], clips: ClipSampling) -> list[tuple[int, ...]]:
    """Token ids of every text that clips of some episodes can have: a prompt may also state length and rate."""
    if loader.text is None:
        return []
    asked = dict.fromkeys(
        (row.instruction, loader.clip_facts(Clip(row.episode_id, 0, length, stride)))
        for row in rows
        for length in clips.lengths
        for stride in clips.strides
    )
    found = (loader.text([instruction], [facts])[0][0] for instruction, facts in asked)
    return list(dict.fromkeys(map(_key, found)))


def _key(ids: Tensor) -> tuple[int, ...]:
    return tuple(cast("Any", ids).tolist())


class StoredText:
    """Reads texts as `WorldModel.encode_text` does, from the machine's memory.

    Args:
        model: with its text tower on ``device``; it is not kept.

    Raises:
        ConfigError: the prompts are too many.
    """

    @torch.no_grad()
    def __init__(self, model: WorldModel, prompts: Sequence[tuple[int, ...]], device: str) -> None:
        self._numbers = {prompt: number for number, prompt in enumerate(prompts)}
        self._device = device
        # All at one width, as in a batch with the longest: a text's place in time depends on it.
        ids, self._mask = padded(prompts)
        layers: list[tuple[list[Tensor], list[Tensor]]] = [([], []) for _ in model.layers]
        for number in with_progress(range(len(prompts)), "reading prompts", "prompt"):
            context = model.encode_text(ids[number, None].to(device), self._mask[number, None].to(device))
            size = sum(value.nbytes for pair in context.layers for value in pair)
            if size * len(prompts) > MOST_BYTES:
                raise ConfigError(
                    "The keys and values of all prompts are too much to keep", where="train_stage1.text_tower: stored",
                    expected=f"at most {MOST_BYTES / 1e9:.1f} GB", next_step="set text_tower to frozen, or cut text.max_length",
                    got=f"{size * len(prompts) / 1e9:.1f} GB, of {len(prompts)} prompts of up to {ids.shape[1]} tokens",
                )  # fmt: skip
            for kept, pair in zip(layers, context.layers, strict=True):
                for values, one in zip(kept, pair, strict=True):
                    values.append(one.cpu())
        self._layers = [(torch.cat(keys), torch.cat(values)) for keys, values in layers]

    def __call__(self, text_ids: Int[Tensor, "b m"], text_mask: Bool[Tensor, "b m"] | None = None) -> TextContext:
        """Return the keys and values that the layers read of right-padded texts; each must be among the prompts."""
        mask = torch.ones_like(text_ids, dtype=torch.bool) if text_mask is None else text_mask
        texts = [_key(ids[real]) for ids, real in zip(text_ids, mask, strict=True)]
        rows = torch.tensor([self._numbers[text] for text in texts])
        layers = tuple((keys[rows].to(self._device), values[rows].to(self._device)) for keys, values in self._layers)
        return TextContext(layers, self._mask[rows].to(self._device), self._mask.shape[1])
