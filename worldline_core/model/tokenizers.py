"""The video tokenizer of a folder: our patch tokenizer, or the Wan 2.2 autoencoder through diffusers."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from torch import Tensor, nn

from worldline_core.errors import CheckpointError, UnavailableError
from worldline_core.model.patch_tokenizer import DESCRIPTION, PatchTokenizer
from worldline_core.model.video_tokenizer import VideoTokenizer, check_latents, check_video

if TYPE_CHECKING:
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

# fmt: off
WAN22_MEAN = (
    -0.2289, -0.0052, -0.1323, -0.2339, -0.2799, 0.0174, 0.1838, 0.1557, -0.1382, 0.0542, 0.2813, 0.0891,
    0.1570, -0.0098, 0.0375, -0.1825, -0.2246, -0.1207, -0.0698, 0.5109, 0.2665, -0.2108, -0.2158, 0.2502,
    -0.2055, -0.0322, 0.1109, 0.1567, -0.0729, 0.0899, -0.2799, -0.1230, -0.0313, -0.1649, 0.0117, 0.0723,
    -0.2839, -0.2083, -0.0520, 0.3748, 0.0152, 0.1957, 0.1433, -0.2944, 0.3573, -0.0548, -0.1681, -0.0667,
)
WAN22_STD = (
    0.4765, 1.0364, 0.4514, 1.1677, 0.5313, 0.4990, 0.4818, 0.5013, 0.8158, 1.0344, 0.5894, 1.0901,
    0.6885, 0.6165, 0.8454, 0.4978, 0.5759, 0.3523, 0.7135, 0.6804, 0.5833, 1.4146, 0.8986, 0.5659,
    0.7069, 0.5338, 0.4889, 0.4917, 0.4069, 0.4999, 0.6866, 0.4093, 0.5709, 0.6065, 0.6415, 0.4944,
    0.5726, 1.2042, 0.5458, 1.6887, 0.3971, 1.0600, 0.3943, 0.5537, 0.5444, 0.4089, 0.7468, 0.7744,
)
# fmt: on


class WanTokenizer(nn.Module):
    """``AutoencoderKLWan``: encoding takes the mode of the posterior, latents are ``(mode - mean) / std`` a channel."""

    mean: Tensor
    std: Tensor

    def __init__(self, vae: AutoencoderKLWan, *, where: object = "AutoencoderKLWan") -> None:
        super().__init__()
        self.vae = vae
        self.latent_channels = int(vae.config["z_dim"])
        self.spatial_compression = int(vae.config["scale_factor_spatial"])
        self.temporal_compression = int(vae.config["scale_factor_temporal"])
        mean, std = vae.config["latents_mean"], vae.config["latents_std"]
        if self.latent_channels == len(WAN22_MEAN) != len(mean):
            mean, std = WAN22_MEAN, WAN22_STD
        if len(mean) != self.latent_channels or len(std) != self.latent_channels:
            raise CheckpointError(
                "The autoencoder's latent statistics do not match its channels",
                where=where,
                expected=f"{self.latent_channels} means and deviations",
                got=f"{len(mean)} and {len(std)}",
            )
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32).view(1, -1, 1, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std, dtype=torch.float32).view(1, -1, 1, 1, 1), persistent=False)

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]:
        """Normalised latents of a clip of ``1 + 4 k`` frames in [-1, 1].

        Raises:
            DataError: the video has another shape.
        """
        check_video(self, video)
        # The autoencoder was trained without mixed precision; it runs in the dtype of its weights.
        with torch.autocast(device_type=video.device.type, enabled=False):
            mode = self.vae.encode(video.to(self.vae.dtype), return_dict=False)[0].mode()
        return ((mode.float() - self.mean) / self.std).to(video.dtype)

    def decode(
        self, latents: Float[Tensor, "b c t_l h_l w_l"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b 3 t h w"]:
        """Video in [-1, 1]. The reference frame is not used: this decoder needs no help with still background."""
        check_latents(self, latents)
        with torch.autocast(device_type=latents.device.type, enabled=False):
            codes = (latents.float() * self.std + self.mean).to(self.vae.dtype)
            return self.vae.decode(codes, return_dict=False)[0].to(latents.dtype)

    def decoder(self, reference: Float[Tensor, "b 3 h w"] | None = None) -> WanDecoder:
        """Decode latent frame by latent frame, with the frames of :meth:`decode`."""
        return WanDecoder(self)

    @classmethod
    def load(cls, folder: Path, dtype: torch.dtype = torch.float32) -> WanTokenizer:
        """Read a local diffusers folder (an autoencoder, or a pipeline with a ``vae`` subfolder); nothing is downloaded.

        Raises:
            UnavailableError: there is no such folder.
            CheckpointError: it is incomplete, damaged, or holds another autoencoder.
        """
        from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

        root = folder / "vae" if (folder / "vae").is_dir() else folder
        if not (root / "config.json").is_file():
            raise UnavailableError(
                "The Wan autoencoder is not here",
                where=folder,
                expected="a diffusers folder with config.json and *.safetensors",
                next_step="download Wan-AI/Wan2.2-TI2V-5B-Diffusers (subfolder vae) and give its folder",
            )
        _wan_shape(root)
        try:
            vae = AutoencoderKLWan.from_pretrained(
                str(root), local_files_only=True, use_safetensors=True, torch_dtype=dtype, low_cpu_mem_usage=False
            )
        except (OSError, ValueError, RuntimeError, SafetensorError) as error:
            raise CheckpointError("The Wan autoencoder cannot be read", where=root, got=str(error)) from error
        return cls(vae.eval().requires_grad_(False), where=root)


class WanDecoder:
    """Decodes clips as their latents arrive. The autoencoder's convolutions are causal: what they need of earlier frames
    lies in one cache per convolution, which `AutoencoderKLWan.decode` clears at its end and this keeps.
    """

    def __init__(self, tokenizer: WanTokenizer) -> None:
        self._tokenizer = tokenizer
        self._cache: list[Any] = [None] * tokenizer.vae._cached_conv_counts["decoder"]
        self._begun = False

    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        """Frames of the next latents."""
        from diffusers.models.autoencoders.autoencoder_kl_wan import unpatchify

        tokenizer, vae = self._tokenizer, self._tokenizer.vae
        check_latents(tokenizer, latents)
        frames: list[Tensor] = []
        with torch.autocast(device_type=latents.device.type, enabled=False):
            codes = vae.post_quant_conv((latents.float() * tokenizer.std + tokenizer.mean).to(vae.dtype))
            for code in codes.split(1, dim=2):
                first = {} if self._begun else {"first_chunk": True}
                frames.append(vae.decoder(code, feat_cache=self._cache, feat_idx=[0], **first))
                self._begun = True
            video = torch.cat(frames, dim=2)
            if vae.config["patch_size"] is not None:
                video = unpatchify(video, patch_size=vae.config["patch_size"])
            return video.clamp(-1.0, 1.0).to(latents.dtype)

    def copy(self) -> WanDecoder:
        """A decoder in the same state that goes on separately; tensors of the cache are replaced, never changed."""
        other = WanDecoder(self._tokenizer)
        other._cache, other._begun = list(self._cache), self._begun
        return other


WAN22_SHAPE = {
    "base_dim": 160, "decoder_base_dim": 256, "z_dim": 48, "dim_mult": [1, 2, 4, 4], "num_res_blocks": 2,
    "temperal_downsample": [False, True, True], "is_residual": True, "in_channels": 12, "out_channels": 12,
    "patch_size": 2, "scale_factor_temporal": 4, "scale_factor_spatial": 16,
}  # fmt: skip
"""The published autoencoder (Wan-AI/Wan2.2-TI2V-5B-Diffusers, vae/config.json)."""


def _wan_shape(root: Path) -> dict[str, Any]:
    """What an autoencoder's ``config.json`` says.

    Raises:
        CheckpointError: it is damaged, or of another autoencoder.
    """
    try:
        shape = json.loads((root / "config.json").read_text(encoding="utf-8"))
        name = shape.get("_class_name")
    except (ValueError, AttributeError, RecursionError) as error:
        raise CheckpointError("The autoencoder's config is not a JSON object", where=root, got=str(error)) from error
    if name != "AutoencoderKLWan":
        raise CheckpointError("Not a Wan autoencoder", where=root, expected="AutoencoderKLWan", got=name)
    return shape


def tokenizer_outline(folder: Path | None) -> WanTokenizer | PatchTokenizer:
    """A tokenizer of the right shape without trained weights, to count with: of the folder, else the published Wan 2.2."""
    if folder is not None and (folder / DESCRIPTION).is_file():
        return PatchTokenizer.outline(folder)
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan

    places = [] if folder is None else [folder / "vae", folder]
    root = next((place for place in places if (place / "config.json").is_file()), None)
    shape = WAN22_SHAPE if root is None else _wan_shape(root)
    vae: Any = AutoencoderKLWan.from_config({"latents_mean": WAN22_MEAN, "latents_std": WAN22_STD, **shape})
    return WanTokenizer(vae.eval().requires_grad_(False), where=root)


def load_tokenizer(folder: Path, device: str = "cpu", dtype: torch.dtype = torch.float32) -> VideoTokenizer:
    """Load whatever tokenizer ``folder`` holds: a patch tokenizer, or a diffusers Wan autoencoder.

    Args:
        dtype: of a Wan autoencoder, which computes in it; a patch tokenizer stays in float32.

    Raises:
        CheckpointError: the folder holds none, or a damaged one.
    """
    if (folder / "config.json").is_file() or (folder / "vae" / "config.json").is_file():
        return WanTokenizer.load(folder, dtype).to(device)
    return PatchTokenizer.load(folder).to(device)


def tokenizer_fingerprint(tokenizer: VideoTokenizer, folder: Path) -> str:
    """Name of the encoder, 16 hexadecimal digits, so that latents and models of one tokenizer stay together.

    A patch tokenizer tells its encoder from its decoder: a better decoder keeps the latents valid. Otherwise it is a
    digest of the folder's weights and configuration.
    """
    if isinstance(tokenizer, PatchTokenizer):
        return tokenizer.encoder_digest[:16]
    digest = hashlib.sha256()
    root = folder / "vae" if (folder / "vae").is_dir() else folder  # a pipeline's other models do not encode
    for path in sorted(root.rglob("*")):
        if path.suffix in {".safetensors", ".json"} and path.name != "manifest.json":
            digest.update(path.relative_to(root).as_posix().encode())
            with path.open("rb") as stream:
                while chunk := stream.read(1 << 24):
                    digest.update(chunk)
    return digest.hexdigest()[:16]
