"""Small random-weight versions of the outside models that the full-size preset needs.

The same classes of diffusers and transformers write them, in the same files as the published ones (sharded weights with their
index, configuration, processors, tokenizer). Sizes alone differ; LPIPS keeps its own, which is small.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch

from worldline_core.model.backbone_folder import SINGLE
from worldline_core.model.lpips import BACKBONE_FILE, HEADS_FILE, LAYERS
from worldline_core.model.text import SYSTEM_PROMPT, VISION_START
from worldline_core.model.tokenizers import WAN22_MEAN, WAN22_STD

SHARD = "100KB"
"""Largest file of weights: small enough that every model of several files has an index."""

TRANSFORMER: dict[str, Any] = {
    "head_dim": 16, "hidden_size": 32, "intermediate_size": 48, "num_attention_heads": 2, "num_hidden_layers": 4,
    "num_key_value_heads": 1, "rope_axes_dim": (4, 2, 2), "vocab_size": 1024, "action_dim": 8, "num_embodiment_domains": 2,
}  # fmt: skip
EDGE: dict[str, Any] = {
    "hidden_act": "relu2", "qk_norm_for_text": False, "use_und_k_norm_for_gen": True, "rms_norm_eps": 1e-5, "rope_theta": 1e8,
}  # fmt: skip
_WORDS = (
    f"{SYSTEM_PROMPT} system user assistant The video is 4.3 seconds long and is of 30 FPS. This video is of 480x640 "
    "resolution. lift place push press the red green blue yellow orange purple block can tray drawer button on pad closed "
    "with both arms Return only JSON true false null observations confidence"
)
_CHAT = (
    "{% for message in messages %}<|im_start|>{{ message['role'] }}\n"
    "{% if message['content'] is string %}{{ message['content'] }}{% else %}{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}<|vision_start|><|image_pad|><|vision_end|>"
    "{% elif part['type'] == 'video' %}<|vision_start|><|video_pad|><|vision_end|>"
    "{% else %}{{ part['text'] }}{% endif %}{% endfor %}{% endif %}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)


def write_outside_models(weights: Path) -> None:
    """Write small random-weight versions below ``weights``, the same bytes every time."""
    for name, write in OUTSIDE_MODELS.items():
        torch.manual_seed(0)
        (weights / name).mkdir(parents=True, exist_ok=True)
        write(weights / name)


def write_qwen2_tokenizer(folder: Path) -> Any:
    """Qwen2's own tokenizer class over a small vocabulary of byte pairs, its special tokens and a chat template; returns it."""
    from transformers import Qwen2Tokenizer

    special = ("<|im_start|>", VISION_START, "<|vision_end|>", "<|image_pad|>", "<|video_pad|>")
    untrained = Qwen2Tokenizer(
        eos_token="<|im_end|>",  # noqa: S106 - a token of text
        pad_token="<|endoftext|>",  # noqa: S106
        additional_special_tokens=list(special),
    )
    tokenizer = untrained.train_new_from_iterator([_WORDS], vocab_size=768, show_progress=False)
    tokenizer.chat_template = _CHAT
    tokenizer.save_pretrained(folder)
    tokenizer.backend_tokenizer.model.save(str(folder))  # vocab.json and merges.txt, as published beside tokenizer.json
    return tokenizer


def write_cosmos3(folder: Path, **kind: Any) -> None:
    """The Cosmos3 pipeline of diffusers: transformer in shards with an index, Wan autoencoder, text tokenizer, scheduler.

    Args:
        kind: what its transformer has otherwise than Nano's.
    """
    from diffusers.models.transformers.transformer_cosmos3 import Cosmos3OmniTransformer
    from diffusers.pipelines.cosmos.pipeline_cosmos3_omni import Cosmos3OmniPipeline
    from diffusers.schedulers.scheduling_unipc_multistep import UniPCMultistepScheduler

    pipeline = Cosmos3OmniPipeline(
        transformer=Cosmos3OmniTransformer(**TRANSFORMER, **kind),
        text_tokenizer=write_qwen2_tokenizer(folder / "text_tokenizer"),
        vae=small_wan_autoencoder(),
        scheduler=UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True),
        enable_safety_checker=False,
    )
    pipeline.save_pretrained(folder)
    # As published: the transformer in several files, the autoencoder in one.
    (folder / "transformer" / SINGLE).unlink()
    pipeline.transformer.save_pretrained(folder / "transformer", max_shard_size=SHARD)


def small_wan_autoencoder() -> Any:
    """Wan 2.2's autoencoder, 48 latent channels, 16 x 16 x 4, with eight channels where it has 160."""
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

    return AutoencoderKLWan(
        base_dim=8, decoder_base_dim=8, z_dim=48, dim_mult=[1, 1, 1, 1], num_res_blocks=1, is_residual=True,
        in_channels=12, out_channels=12, patch_size=2, scale_factor_spatial=16, scale_factor_temporal=4,
        temperal_downsample=[False, True, True], latents_mean=list(WAN22_MEAN), latents_std=list(WAN22_STD),
    ).eval()  # fmt: skip


def write_vjepa2(folder: Path) -> None:
    """V-JEPA 2 with its predictor, and its video processor."""
    from transformers import VJEPA2Config, VJEPA2Model, VJEPA2VideoProcessor

    config = VJEPA2Config(
        crop_size=64, hidden_size=32, num_attention_heads=2, num_hidden_layers=5, mlp_ratio=2.0, pred_hidden_size=32,
        pred_num_attention_heads=2, pred_num_hidden_layers=2,
    )  # fmt: skip
    VJEPA2Model(config).save_pretrained(folder)
    VJEPA2VideoProcessor(crop_size={"height": 64, "width": 64}, size={"shortest_edge": 73}).save_pretrained(folder)


def write_sam3(folder: Path) -> None:
    """SAM 3 as published: detector and tracker in one folder, from which the tracker is loaded by itself."""
    from transformers import CLIPTokenizer, Sam3ImageProcessor, Sam3VideoConfig, Sam3VideoModel, Sam3VideoProcessor
    from transformers.models.sam2_video.video_processing_sam2_video import Sam2VideoVideoProcessor

    size, width = 56, {"hidden_size": 128}
    layer = width | {"intermediate_size": 64, "num_attention_heads": 2, "num_layers": 1}
    backbone = {
        "model_type": "sam3_vit_model", "hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": size, "patch_size": 14, "window_size": 4, "global_attn_indexes": [1],
        "pretrain_image_size": size,
    }  # fmt: skip
    vision = {
        "model_type": "sam3_vision_model", "fpn_hidden_size": 128, "backbone_config": backbone,
        "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
    }  # fmt: skip
    text = {
        "model_type": "clip_text_model", "vocab_size": 32, "hidden_size": 32, "intermediate_size": 64,
        "projection_dim": 32, "num_hidden_layers": 1, "num_attention_heads": 2, "max_position_embeddings": 32,
        "bos_token_id": 26, "eos_token_id": 27,
    }  # fmt: skip
    detector = {
        "model_type": "sam3", "vision_config": vision, "text_config": text, "geometry_encoder_config": layer,
        "detr_encoder_config": layer, "detr_decoder_config": layer | {"num_queries": 4},
        "mask_decoder_config": width | {"num_attention_heads": 2},
    }  # fmt: skip
    tracker = {
        "model_type": "sam3_tracker_video", "vision_config": vision, "image_size": size,
        "prompt_encoder_config": width | {"image_size": size},
        "mask_decoder_config": width | {"mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 64},
        "memory_attention_hidden_size": 128, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 64, "memory_encoder_hidden_size": 128,
        "memory_encoder_output_channels": 64, "mask_downsampler_embed_dim": 128, "memory_fuser_embed_dim": 128,
        "memory_fuser_intermediate_dim": 64,
    }  # fmt: skip
    config = Sam3VideoConfig(detector_config=detector, tracker_config=tracker, low_res_mask_size=16)
    Sam3VideoModel(config).save_pretrained(folder)
    square = {"height": size, "width": size}
    letters = {letter: number for number, letter in enumerate("abcdefghijklmnopqrstuvwxyz")}
    ends = {"<|startoftext|>": len(letters), "<|endoftext|>": len(letters) + 1}
    processor = Sam3VideoProcessor(
        image_processor=Sam3ImageProcessor(size=square, mask_size={"height": 16, "width": 16}),
        video_processor=Sam2VideoVideoProcessor(size=square),
        tokenizer=CLIPTokenizer(vocab=letters | ends, merges=[]),
    )
    processor.save_pretrained(folder)


def write_qwen3_vl(folder: Path) -> None:
    """Qwen3-VL in shards with an index, its image and video processors, its tokenizer and generation settings."""
    from transformers import (
        GenerationConfig,
        Qwen2VLImageProcessor,
        Qwen3VLConfig,
        Qwen3VLForConditionalGeneration,
        Qwen3VLProcessor,
        Qwen3VLVideoProcessor,
    )

    tokenizer = write_qwen2_tokenizer(folder)
    sizes: dict[str, Any] = {"patch_size": 8, "temporal_patch_size": 2, "merge_size": 2}
    pixels: dict[str, Any] = {"shortest_edge": 16 * 16, "longest_edge": 96 * 96}
    Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(**sizes, size=pixels),
        tokenizer=tokenizer,
        video_processor=Qwen3VLVideoProcessor(**sizes, size=pixels),
        chat_template=_CHAT,
    ).save_pretrained(folder)
    ids = {name: int(tokenizer.convert_tokens_to_ids(f"<|{name}|>")) for name in
           ("image_pad", "video_pad", "vision_start", "vision_end", "im_end", "endoftext")}  # fmt: skip
    config = Qwen3VLConfig(
        text_config={
            "vocab_size": 1024, "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2,
            "num_attention_heads": 2, "num_key_value_heads": 1, "head_dim": 16,
            "rope_parameters": {"rope_type": "default", "rope_theta": 5e6, "mrope_section": [4, 2, 2]},
        },
        vision_config={
            "depth": 2, "hidden_size": 32, "intermediate_size": 48, "num_heads": 2, "patch_size": 8, "out_hidden_size": 32,
            "num_position_embeddings": 64, "deepstack_visual_indexes": [0, 1],
        },
        image_token_id=ids["image_pad"],
        video_token_id=ids["video_pad"],
        vision_start_token_id=ids["vision_start"],
        vision_end_token_id=ids["vision_end"],
    )  # fmt: skip
    model: Any = Qwen3VLForConditionalGeneration(config)
    ends = {"eos_token_id": [ids["im_end"], ids["endoftext"]], "pad_token_id": ids["endoftext"]}
    # As published: sampling is on unless it is switched off.
    model.generation_config = GenerationConfig(do_sample=True, temperature=0.7, top_p=0.8, top_k=20, **ends)
    model.to(torch.bfloat16).save_pretrained(folder, max_shard_size=SHARD)


def write_lpips(folder: Path) -> None:
    """The two files of LPIPS at their own size: torchvision's AlexNet (convolutions alone) and the linear heads."""
    backbone: dict[str, torch.Tensor] = {}
    heads: dict[str, torch.Tensor] = {}
    for number, (name, cin, cout, kernel, *_) in enumerate(LAYERS):
        convolution = torch.nn.Conv2d(cin, cout, kernel)
        backbone |= {f"features.{name}.{key}": value.detach() for key, value in convolution.named_parameters()}
        heads[f"lin{number}.model.1.weight"] = torch.rand(1, cout, 1, 1) / cout
    torch.save(backbone, folder / BACKBONE_FILE)
    torch.save(heads, folder / HEADS_FILE)


OUTSIDE_MODELS: dict[str, Callable[[Path], None]] = {
    "Cosmos3-Nano": write_cosmos3,
    "Cosmos3-Edge": partial(write_cosmos3, **EDGE),
    "vjepa2-vitg-fpc64-384": write_vjepa2,
    "sam3": write_sam3,
    "Qwen3-VL-8B-Instruct": write_qwen3_vl,
    "lpips": write_lpips,
}
"""Writers by the names of the published folders, as presets name them."""
