"""Pretrained Wan2.2-TI2V-5B weights in a local folder of diffusers, and embeddings of texts by its text encoder, umT5."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from einops import rearrange
from pydantic import ValidationError
from torch import Tensor

from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.backbone_folder import SINGLE, Pretrained, transformer_folder
from worldline_core.model.checkpoint import read_weights
from worldline_core.model.world_model_config import WanConfig, wan_config

PUBLISHED = "Wan-AI/Wan2.2-TI2V-5B-Diffusers"
_RENAMED = {
    r"^patch_embedding\.": "proj_in.",
    r"^condition_embedder\.": "",
    r"^blocks\.": "layers.",
    r"\.to_out\.0\.": ".to_out.",
    r"\.ffn\.net\.0\.proj\.": ".ffn.0.",
    r"\.ffn\.net\.2\.": ".ffn.2.",
}
"""Parts of diffusers' names, and ours."""
_KIND: dict[str, object] = {
    "_class_name": "WanTransformer3DModel", "patch_size": [1, 2, 2], "freq_dim": 256, "qk_norm": "rms_norm_across_heads",
    "cross_attn_norm": True, "image_dim": None, "added_kv_proj_dim": None, "pos_embed_seq_len": None,
}  # fmt: skip


def config_from_diffusers(config: Mapping[str, Any], *, where: object, **changes: object) -> WanConfig:
    """Translate a diffusers ``config.json``, with ``changes`` to fields of the result.

    Raises:
        CheckpointError: the folder holds another model, or a variant this package does not compute.
    """
    kind = _KIND | {"out_channels": config.get("in_channels")}
    wrong = {key: config.get(key) for key, value in kind.items() if config.get(key) != value}
    if wrong:
        raise CheckpointError(
            "Not a Wan transformer of the supported kind", where=where, expected={key: kind[key] for key in wrong}, got=wrong,
            next_step=f"give the folder of {PUBLISHED}",
        )  # fmt: skip
    names = {
        "latent_channels": "in_channels",
        "num_layers": "num_layers",
        "num_heads": "num_attention_heads",
        "head_dim": "attention_head_dim",
        "intermediate_size": "ffn_dim",
        "norm_eps": "eps",
        "text_size": "text_dim",
    }
    try:
        found = {ours: config[theirs] for ours, theirs in names.items()}
        return wan_config(**found | {"hidden_size": found["num_heads"] * found["head_dim"]} | changes)
    except (KeyError, TypeError, ValidationError) as error:
        raise CheckpointError("The Wan config is not valid", where=where, got=str(error)) from error


def read_wan(
    folder: Path,
    *,
    changes: Mapping[str, object] | None = None,
    revision: str | None = None,
    prompts: Sequence[str] = (),
) -> tuple[Pretrained, dict[str, Tensor]]:
    """Wan from a transformer in diffusers format, or a pipeline with a ``transformer`` subfolder; and the embeddings of texts.

    Args:
        changes: fields of the config to set besides (view slots, their unit).
        revision: commit of the hub that the folder must be of; None takes any.
        prompts: texts to embed; the model reads the first of them where it is given none, or without any padding alone.

    Raises:
        UnavailableError: there is no such folder, or no text encoder in it.
        CheckpointError: the folder is incomplete, damaged, or holds another architecture.
    """
    root, raw = transformer_folder(folder, PUBLISHED, revision)
    config = config_from_diffusers(raw, where=root / "config.json", **(changes or {}))
    texts = embed_texts(folder, prompts, config.text_length) if prompts else {}
    prompt = texts[prompts[0]] if prompts else torch.zeros(0, config.text_size)
    tensors: dict[str, Tensor] = {}
    for name, tensor in read_weights(root / SINGLE, None).items():
        for theirs, ours in _RENAMED.items():
            name = re.sub(theirs, ours, name)
        # A convolution over patches is a linear layer of their values.
        tensors[name] = rearrange(tensor, "d c 1 p q -> d (p q c)") if tensor.ndim == 5 else tensor
    tensors["prompt"] = prompt
    return Pretrained.of(config.model_copy(update={"prompt_length": len(prompt)}), tensors, root), texts


def embed_texts(pipeline: Path, texts: Sequence[str], length: int) -> dict[str, Tensor]:
    """Embeddings ``(m s)`` of each text, at most ``length`` tokens, by a pipeline's ``tokenizer`` and ``text_encoder``.

    umT5 is in memory while this runs and no longer: 11 GB in bfloat16.

    Raises:
        UnavailableError: the folder has none.
    """
    for name in ("tokenizer", "text_encoder"):
        if not (pipeline / name).is_dir():
            raise UnavailableError(
                "The text encoder is not here", where=pipeline / name, expected="the folders tokenizer and text_encoder of a pipeline",
                next_step=f"download them from {PUBLISHED}, or import without prompts",
            )  # fmt: skip
    from transformers import AutoTokenizer, UMT5EncoderModel

    tokenizer = AutoTokenizer.from_pretrained(pipeline / "tokenizer", local_files_only=True)
    encoder = UMT5EncoderModel.from_pretrained(
        pipeline / "text_encoder", local_files_only=True, use_safetensors=True, dtype=torch.bfloat16
    ).eval()
    found: dict[str, Tensor] = {}
    for text in texts:
        tokens = tokenizer(" ".join(text.split()), truncation=True, max_length=length, return_tensors="pt")
        with torch.no_grad():
            found[text] = encoder(tokens.input_ids, tokens.attention_mask).last_hidden_state[0]
    return found
