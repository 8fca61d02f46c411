"""A causal linear patch tokenizer with a small convolutional decoder.

The first frame is coded alone in 8 x 8 patches, then groups of four frames in 4 x 8 x 8 patches. The orthonormal basis
of a group has two parts: *static* vectors, constant over the four frames, whose spatial patterns are also those of the
first frame; and *motion* vectors, which sum to zero over time. A group in which nothing moves is therefore coded
exactly as the first frame is, with zero motion channels: copying the background is the identity on latents. The
decoder sharpens, and copies what still equals the observed frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float
from pydantic import Field
from safetensors.torch import save
from torch import Tensor, nn

from worldline_core.config import StrictModel
from worldline_core.errors import CheckpointError, DataError
from worldline_core.model.checkpoint import described, fill, read_description
from worldline_core.model.video_tokenizer import GroupDecoder, check_latents, check_video
from worldline_core.model.weight_files import read_weights
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

DESCRIPTION, WEIGHTS = "tokenizer.json", "tokenizer.safetensors"
FORMAT, VERSION = "worldline.tokenizer", 1


class Residual(nn.Module):
    """Two convolutions beside the identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        return features + self.second(F.gelu(self.first(F.gelu(features))))


class Refinement(nn.Module):
    """A two-level U-Net at half and quarter resolution over one group of frames.

    It sees the coarse frames of the group, the coarse first frame, and the observed first frame; where the group's
    coarse pixels equal the first frame's, the observed pixels can be taken over unchanged. Each output frame is
    ``mask * observed + (1 - mask) * (coarse + residual)``; the residual starts at zero.
    """

    def __init__(self, group: int, width: int, depth: int) -> None:
        super().__init__()
        self.group = group
        inner = 2 * width
        self.enter = nn.Conv2d((group + 2) * 12 + 1, width, 3, padding=1)
        self.fine_in = Residual(width)
        self.down = nn.Conv2d(width, inner, 3, stride=2, padding=1)
        self.coarse = nn.Sequential(*[Residual(inner) for _ in range(depth)])
        self.up = nn.Conv2d(inner, 4 * width, 1)
        self.fine_out = Residual(width)
        self.leave = nn.Conv2d(width, group * 4 * 4, 3, padding=1)
        nn.init.zeros_(self.leave.weight)
        bias = torch.zeros(group, 4, 4)
        bias[:, 3] = -1.0
        self.leave.bias = nn.Parameter(bias.flatten())

    def forward(
        self,
        frames: Float[Tensor, "b g 3 h w"],
        first: Float[Tensor, "b 3 h w"],
        reference: Float[Tensor, "b 3 h w"],
        known: Tensor,
    ) -> Float[Tensor, "b g 3 h w"]:
        """Refined frames; ``known``, ``(b)``, is 1 where ``reference`` is the observed frame, 0 where it only stands in."""
        stacked = torch.cat((rearrange(frames, "b g c h w -> b (g c) h w"), first, reference), dim=1)
        folded = F.pixel_unshuffle(stacked, 2)
        flag = rearrange(known, "b -> b 1 1 1").expand(-1, 1, *folded.shape[-2:]).to(folded.dtype)
        features = self.fine_in(
            self.enter(torch.cat((folded, flag), dim=1).contiguous(memory_format=torch.channels_last))
        )
        deep = self.coarse(self.down(F.gelu(features)))
        features = features + F.pixel_shuffle(self.up(F.gelu(deep)), 2)
        out = self.leave(F.gelu(self.fine_out(features))).float()
        out = rearrange(out, "b (g k p q) h w -> b g k (h p) (w q)", g=self.group, p=2, q=2)
        mask = torch.sigmoid(out[:, :, 3:])
        return mask * rearrange(reference, "b c h w -> b 1 c h w") + (1 - mask) * (frames + out[:, :, :3])


class PatchTokenizerConfig(StrictModel):
    """Layout of the codes and width of the decoder."""

    static_channels: int = Field(default=24, ge=1)
    motion_channels: int = Field(default=8, ge=0)
    spatial_compression: int = Field(default=8, ge=2, multiple_of=4)
    temporal_compression: int = Field(default=4, ge=1)
    refinement_width: int = Field(default=48, ge=4)
    refinement_depth: int = Field(default=2, ge=1)


class PatchTokenizer(nn.Module):
    """Linear codes, orthonormal bases, and a decoder that adds what the codes leave out."""

    KIND = "patch"
    mean: Tensor
    static_basis: Tensor
    motion_basis: Tensor
    scale: Tensor

    def __init__(self, config: PatchTokenizerConfig | None = None) -> None:
        super().__init__()
        self.config = config or PatchTokenizerConfig()
        self.latent_channels = self.config.static_channels + self.config.motion_channels
        self.spatial_compression = self.config.spatial_compression
        self.temporal_compression = self.config.temporal_compression
        pixels = 3 * self.spatial_compression**2
        self.register_buffer("mean", torch.zeros(pixels))
        self.register_buffer("static_basis", torch.zeros(self.config.static_channels, pixels))
        self.register_buffer(
            "motion_basis", torch.zeros(self.config.motion_channels, self.temporal_compression * pixels)
        )
        self.register_buffer("scale", torch.ones(self.latent_channels))
        self.refinement = Refinement(
            self.temporal_compression, self.config.refinement_width, self.config.refinement_depth
        )
        self.weights_sha256 = ""

    @property
    def encoder_digest(self) -> str:
        """Digest of all that :meth:`encode` depends on; a retrained decoder does not change it."""
        content = repr((self.config.static_channels, self.config.motion_channels, self.spatial_compression)).encode()
        for name in ("mean", "static_basis", "motion_basis", "scale"):
            content += getattr(self, name).detach().float().cpu().contiguous().numpy().tobytes()
        return hashlib.sha256(content).hexdigest()

    def _patches(self, video: Tensor) -> Tensor:
        size = self.spatial_compression
        return rearrange(video, "b c t (h p) (w q) -> b t h w (c p q)", p=size, q=size) - self.mean

    def _pixels(self, patches: Tensor) -> Tensor:
        size = self.spatial_compression
        return rearrange(patches + self.mean, "b t h w (c p q) -> b c t (h p) (w q)", p=size, q=size)

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]:
        """Codes of a clip of ``1 + 4 k`` frames in [-1, 1].

        Raises:
            DataError: the video has another shape.
        """
        check_video(self, video)
        with torch.autocast(device_type=video.device.type, enabled=False):
            patches = self._patches(video.float())
            first, groups = patches[:, :1], patches[:, 1:]
            groups = rearrange(groups, "b (n g) h w d -> b n g h w d", g=self.temporal_compression)
            means = torch.cat((first, groups.mean(dim=2)), dim=1)
            static = means @ self.static_basis.T
            motion = rearrange(groups, "b n g h w d -> b n h w (g d)") @ self.motion_basis.T
            motion = torch.cat(
                (torch.zeros_like(static[:, :1, ..., :1]).expand(*static[:, :1].shape[:-1], motion.shape[-1]), motion),
                dim=1,
            )
            codes = torch.cat((static, motion), dim=-1) / self.scale
        return rearrange(codes, "b t h w c -> b c t h w")

    def decode_linear(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        """What the codes alone say (the orthogonal projection of the video)."""
        check_latents(self, latents)
        with torch.autocast(device_type=latents.device.type, enabled=False):
            codes = rearrange(latents.float(), "b c t h w -> b t h w c") * self.scale
            static, motion = codes.split((self.config.static_channels, self.config.motion_channels), dim=-1)
            means = static @ self.static_basis
            groups = repeat(means[:, 1:], "b n h w d -> b n g h w d", g=self.temporal_compression)
            moving = motion[:, 1:] @ self.motion_basis
            groups = groups + rearrange(moving, "b n h w (g d) -> b n g h w d", g=self.temporal_compression)
            patches = torch.cat((means[:, :1], rearrange(groups, "b n g h w d -> b (n g) h w d")), dim=1)
            return self._pixels(patches)

    def decode(
        self, latents: Float[Tensor, "b c t_l h_l w_l"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b 3 t h w"]:
        """Latents to video in [-1, 1]; with the observed first frame, still background keeps its full detail.

        Group ``j`` is decoded from latent frames 0 and ``j`` only, so blocks can be decoded as they arrive.
        """
        return self.refine(self.decode_linear(latents), reference)

    def decoder(self, reference: Float[Tensor, "b 3 h w"] | None = None) -> GroupDecoder:
        """Decode block by block, with the frames of :meth:`decode`."""
        return GroupDecoder(self.decode, reference)

    def refine(
        self, coarse: Float[Tensor, "b 3 t h w"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b 3 t h w"]:
        """Run the convolutional decoder over a linear decode."""
        batch, time = coarse.shape[0], self.temporal_compression
        if reference is not None and reference.shape != coarse[:, :, 0].shape:
            raise DataError(
                "The reference frame does not fit the latents",
                expected=tuple(coarse[:, :, 0].shape),
                got=tuple(reference.shape),
            )
        first = repeat(coarse[:, :, 0], "b c h w -> b g c h w", g=time)
        groups = rearrange(coarse[:, :, 1:], "b c (n g) h w -> b n g c h w", g=time)
        groups = torch.cat((first[:, None], groups), dim=1)
        count = groups.shape[1]
        known = torch.full((batch,), float(reference is not None), device=coarse.device)
        reference = coarse[:, :, 0] if reference is None else reference.to(coarse.dtype)
        refined = self.refinement(
            rearrange(groups, "b n g c h w -> (b n) g c h w"),
            repeat(coarse[:, :, 0], "b c h w -> (b n) c h w", n=count),
            repeat(reference, "b c h w -> (b n) c h w", n=count),
            repeat(known, "b -> (b n)", n=count),
        )
        refined = rearrange(refined, "(b n) g c h w -> b n g c h w", n=count)
        rest = rearrange(refined[:, 1:], "b n g c h w -> b c (n g) h w")
        return torch.cat((rearrange(refined[:, 0, :1], "b g c h w -> b c g h w"), rest), dim=2)

    def save(self, folder: Path, metadata: Mapping[str, Any] | None = None) -> None:
        """Write the bases in float32 and the decoder in float16. Equal weights give equal bytes."""
        tensors = {}
        for name, tensor in sorted(self.state_dict().items()):
            dtype = torch.float16 if name.startswith("refinement.") else torch.float32
            tensors[name] = tensor.detach().to("cpu", dtype).contiguous().clone()
        content = save(tensors)
        write_bytes_atomic(folder / WEIGHTS, content)
        write_json_atomic(
            folder / DESCRIPTION,
            {
                "format": FORMAT,
                "version": VERSION,
                "kind": self.KIND,
                "config": self.config.model_dump(mode="json"),
                "metadata": dict(metadata or {}),
                "weights_sha256": hashlib.sha256(content).hexdigest(),
            },
        )

    @classmethod
    def outline(cls, folder: Path) -> PatchTokenizer:
        """A tokenizer as ``folder`` describes it, without its weights.

        Raises:
            CheckpointError: the description is damaged, or of another kind.
        """
        path = folder / DESCRIPTION
        content = read_description(path, FORMAT, "tokenizer", version=VERSION)
        if content.get("kind") != cls.KIND:
            raise CheckpointError("Unknown kind of tokenizer", where=path, expected=cls.KIND, got=content.get("kind"))
        tokenizer = cls(described(PatchTokenizerConfig, content.get("config"), "The tokenizer's config", path))
        tokenizer.weights_sha256 = content["weights_sha256"]
        return tokenizer.eval().requires_grad_(False)

    @classmethod
    def load(cls, folder: Path) -> PatchTokenizer:
        """Read a tokenizer written by :meth:`save`, strictly.

        Raises:
            CheckpointError: the folder is incomplete, damaged, or of another kind.
        """
        tokenizer, weights = cls.outline(folder), folder / WEIGHTS
        fill(tokenizer, read_weights(weights, tokenizer.weights_sha256), where=weights, dtype=torch.float32)
        return tokenizer


def fit_patch_tokenizer(
    clips: Iterable[Float[Tensor, "b 3 t h w"]],
    *,
    channels: int = 32,
    spatial: int = 8,
    temporal: int = 4,
    motion_weight: float = 4.0,
    whitening: float = 0.5,
    refinement_width: int = 48,
    refinement_depth: int = 2,
) -> PatchTokenizer:
    """Fit the linear part to clips of ``1 + k * temporal`` frames in [-1, 1]: principal components of patches.

    Static and motion components lie in orthogonal subspaces, so the best ``channels`` of the two spectra together are
    the best basis of this form; how many are static follows from the data.

    Args:
        motion_weight: extra weight of patches that differ from the clip's first frame (arms and what they move).
        whitening: 0 divides all channels by one number, 1 each by its standard deviation, in between by that power of
            it. Always followed by one number, so that latents have unit variance over all channels of a group.

    Raises:
        DataError: there are no clips.
    """
    pixels = 3 * spatial**2
    static = torch.zeros(pixels, pixels, dtype=torch.float64)
    motion = torch.zeros(temporal * pixels, temporal * pixels, dtype=torch.float64)
    total, total_weight = torch.zeros(pixels, dtype=torch.float64), 0.0
    for video in clips:
        patches = rearrange(video.float(), "b c t (h p) (w q) -> b t (h w) (c p q)", p=spatial, q=spatial)
        groups = rearrange(patches[:, 1:], "b (n g) s d -> b n s g d", g=temporal)
        means = groups.mean(dim=3)
        change = (groups - rearrange(patches[:, 0], "b s d -> b 1 s 1 d")).abs().mean(dim=(3, 4))
        weight = rearrange(1.0 + motion_weight * (change > 0.05).float(), "b n s -> (b n s) 1")
        flat = rearrange(means, "b n s d -> (b n s) d")
        moving = rearrange(groups - rearrange(means, "b n s d -> b n s 1 d"), "b n s g d -> (b n s) (g d)")
        static += ((flat * weight).T @ flat).double()
        motion += ((moving * weight).T @ moving).double()
        total += (flat * weight).sum(dim=0).double()
        total_weight += float(weight.double().sum())
    if total_weight == 0:
        raise DataError("No clips to fit the tokenizer to", next_step="check the selection of episodes")
    mean = total / total_weight
    # Eigenvalues and eigenvectors in falling order.
    static_values, static_vectors = (
        part.flip(-1) for part in torch.linalg.eigh(static / total_weight - torch.outer(mean, mean))
    )
    motion_values, motion_vectors = (part.flip(-1) for part in torch.linalg.eigh(motion / total_weight))
    # A static vector stands for `temporal` equal frames: its energy in pixels is that many times its variance.
    energies = torch.cat((static_values * temporal, motion_values[: channels - 1]))
    static_count = int((torch.argsort(energies, descending=True)[:channels] < pixels).sum())
    motion_count = channels - static_count
    tokenizer = PatchTokenizer(
        PatchTokenizerConfig(
            static_channels=static_count,
            motion_channels=motion_count,
            spatial_compression=spatial,
            temporal_compression=temporal,
            refinement_width=refinement_width,
            refinement_depth=refinement_depth,
        )
    )
    kept = torch.cat((static_values[:static_count] * temporal, motion_values[:motion_count]))
    deviation = kept.clamp_min(1e-12).sqrt()
    scale = deviation**whitening
    scale = scale * ((deviation / scale) ** 2).mean().sqrt()
    scale[:static_count] /= temporal**0.5
    tokenizer.mean.copy_(mean)
    tokenizer.static_basis.copy_(_signed(static_vectors[:, :static_count].T))
    tokenizer.motion_basis.copy_(_signed(motion_vectors[:, :motion_count].T))
    tokenizer.scale.copy_(scale)
    return tokenizer


def _signed(basis: Float[Tensor, "k d"]) -> Float[Tensor, "k d"]:
    """Eigenvectors have no sign of their own; make the largest entry positive, so that equal data give equal bases."""
    largest = basis.gather(1, basis.abs().argmax(dim=1, keepdim=True))
    return basis * torch.where(largest < 0, -1.0, 1.0)
