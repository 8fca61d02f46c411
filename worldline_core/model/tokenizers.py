"""Video tokenizers: RGB in [-1, 1] to normalised latents and back, causal in time.

The patch tokenizer of the small models, the Wan 2.2 autoencoder through diffusers, and the conversion between stored frames
(uint8) and tensors; one place decides how frames are resized.

Axis legend: b batch, c channel, t frame, h w pixels; ``_l`` marks the latent grid.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, cast, runtime_checkable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float, UInt8
from pydantic import Field
from safetensors import SafetensorError
from safetensors.torch import save
from torch import Tensor, nn

from worldline_core.config import StrictModel
from worldline_core.data.video.frames import Frames
from worldline_core.errors import CheckpointError, DataError, UnavailableError
from worldline_core.model.checkpoint import described, fill, read_description, read_weights
from worldline_core.store.atomic import write_bytes_atomic, write_json_atomic

if TYPE_CHECKING:
    from diffusers.models.autoencoders.autoencoder_kl_wan import AutoencoderKLWan


@runtime_checkable
class VideoTokenizer(Protocol):
    """Causal video codec. Latents are normalised to about unit scale; latent frame 0 codes RGB frame 0 alone."""

    latent_channels: int
    spatial_compression: int
    temporal_compression: int

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]: ...

    def decode(
        self, latents: Float[Tensor, "b c t_l h_l w_l"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b 3 t h w"]:
        """Latents to video in [-1, 1]; with ``reference``, the observed first frame, still background keeps its full detail in
        tokenizers that can use it.
        """
        return self.decoder(reference)(latents)

    def decoder(self, reference: Float[Tensor, "b 3 h w"] | None = None) -> VideoDecoder:
        """Returns a decoder like :meth:`decode` for latents that arrive one after the other."""
        ...


class VideoDecoder(ABC):
    """Decodes clips as their latents arrive; it keeps no more of them than later frames need, in values that it replaces and
    never changes.
    """

    @abstractmethod
    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        """Frames of the next latents, the first of them those of frame 0."""

    @abstractmethod
    def begin(self, first: Float[Tensor, "b c 1 h w"]) -> None:
        """Take in the latents of frame 0 where its picture is known."""

    def out_of_order(self, row: int) -> VideoDecoder | None:
        """A decoder of one clip of the batch for any of its later latents in any order; None before a clip begins, and where a frame
        needs those before it.
        """
        return None

    def copy(self) -> Self:
        """A decoder in the same state that goes on separately."""
        return copy(self)


def check_video(tokenizer: VideoTokenizer, video: Tensor) -> None:
    """Raises: DataError for a video whose length or size the tokenizer cannot code."""
    space, time = tokenizer.spatial_compression, tokenizer.temporal_compression
    if (
        video.ndim != 5
        or video.shape[1] != 3
        or (video.shape[2] - 1) % time
        or video.shape[3] % space
        or video.shape[4] % space
    ):
        raise DataError(
            "The tokenizer cannot code a video of this shape",
            expected=f"(b, 3, 1 + k * {time}, multiple of {space}, multiple of {space})",
            got=tuple(video.shape),
        )


def check_latents(tokenizer: VideoTokenizer, latents: Tensor) -> None:
    """Raises: DataError for other than five axes, or another number of channels."""
    if latents.ndim != 5 or latents.shape[1] != tokenizer.latent_channels:
        expected = f"(b, {tokenizer.latent_channels}, t, h, w)"
        raise DataError("Not latents of this tokenizer", expected=expected, got=tuple(latents.shape))


def resize_frame(frame: np.ndarray, size: tuple[int, int], *, out: np.ndarray) -> None:
    """``uint8 (H, W, 3)`` at ``size`` (H, W) into ``out``: area averages when shrinking, linear when enlarging."""
    if frame.shape[:2] == tuple(size):
        out[...] = frame
        return
    shrinking = size[0] <= frame.shape[0] and size[1] <= frame.shape[1]
    cv2.resize(frame, (size[1], size[0]), dst=out, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)


def resized_video(frames: Frames, size: tuple[int, int]) -> UInt8[Tensor, "3 t h w"]:
    """RGB frames ``(N, H, W, 3)`` at ``size`` (H, W) as a video."""
    return rearrange(torch.from_numpy(resized_frames(frames, size)), "t h w c -> c t h w").contiguous()


def resized_frames(frames: Frames, size: tuple[int, int]) -> np.ndarray:
    """RGB frames ``(N, H, W, 3)`` at ``size`` (H, W), resized one by one."""
    resized = np.empty((len(frames), *size, 3), np.uint8)
    for frame, target in zip(frames, resized, strict=True):
        resize_frame(frame, size, out=target)
    return resized


def frames_to_video(frames: np.ndarray, size: tuple[int, int] | None = None) -> Float[Tensor, "3 t h w"]:
    """``uint8 (N, H, W, 3)`` RGB to float32 in [-1, 1], resized to ``size`` (H, W) by area averaging.

    Raises:
        DataError: the frames have another shape or type.
    """
    if frames.ndim != 4 or frames.shape[3] != 3 or frames.dtype != np.uint8:
        raise DataError("Not RGB frames", expected="uint8 (N, H, W, 3)", got=f"{frames.dtype} {frames.shape}")
    if size is not None and frames.shape[1:3] != tuple(size):
        frames = resized_frames(frames, size)
    return rearrange(torch.from_numpy(np.ascontiguousarray(frames)), "t h w c -> c t h w").float() / 127.5 - 1.0


def video_to_frames(video: Float[Tensor, "3 t h w"]) -> np.ndarray:
    """[-1, 1] to ``uint8 (N, H, W, 3)`` RGB, clamped and rounded."""
    levels = (video.detach().float() + 1.0).mul_(127.5).round_().clamp_(0, 255).to(torch.uint8)
    return rearrange(levels.cpu(), "c t h w -> t h w c").contiguous().numpy()


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


def fold(frames: Float[Tensor, "*n g 3 h w"]) -> Float[Tensor, "*n h2 w2 d"]:
    """Groups of frames at half their height and width: each place has the ``(g p q c)`` values of its 2 x 2 pixels."""
    return rearrange(frames, "... g c (h p) (w q) -> ... h w (g p q c)", p=2, q=2)


class Refinement(nn.Module):
    """A two-level U-Net at half and quarter resolution over one group of frames.

    It sees the coarse frames of the group, the coarse first frame, and the observed first frame; where the group's
    coarse pixels equal the first frame's, the observed pixels can be taken over unchanged. Each output frame is
    ``mask * observed + (1 - mask) * (coarse + residual)``; the residual starts at zero. All frames are folded (`fold`).
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

    def still(self, first: Float[Tensor, "b h w 12"], reference: Tensor, known: bool) -> Float[Tensor, "b width h w"]:
        """Input that all groups of a clip share: features of its coarse first frame and of ``reference``.

        Args:
            known: ``reference`` is the observed frame, no substitute.
        """
        shown = F.pad(torch.cat((first, reference), dim=-1), (0, 1), value=float(known))
        weight = self._entry()[:, 12 * self.group :]
        return F.conv2d(rearrange(shown, "b h w c -> b c h w"), weight, self.enter.bias, padding=1)

    def forward(
        self, groups: Float[Tensor, "b n h w d"], still: Tensor, reference: Float[Tensor, "b h w 12"]
    ) -> Float[Tensor, "b n h w d"]:
        """Refined frames of each group; ``still`` is of their clip."""
        count = groups.shape[1]
        shown = rearrange(groups, "b n h w d -> (b n) d h w")
        features = F.conv2d(shown, self._entry()[:, : 12 * self.group], padding=1)
        features = self.fine_in((features.unflatten(0, (-1, count)) + still[:, None]).flatten(0, 1))
        deep = self.coarse(self.down(F.gelu(features)))
        features = features + F.pixel_shuffle(self.up(F.gelu(deep)), 2)
        out = F.conv2d(F.gelu(self.fine_out(features)), *self._exit(), padding=1)
        parts = rearrange(out, "(b n) (k d) h w -> k b n h w d", n=count, k=2)
        residual, mask = parts.to(torch.float32, memory_format=torch.contiguous_format)
        observed = repeat(reference, "b h w c -> b 1 h w (g c)", g=self.group)
        return torch.lerp(groups + residual, observed, torch.sigmoid(mask))

    def _exit(self) -> tuple[Tensor, Tensor]:
        """Weights and bias of the last convolution for outputs in the order of folded frames, the mask once for each colour."""
        own = torch.cat((self.leave.weight.flatten(1), cast("Tensor", self.leave.bias)[:, None]), dim=1)
        own = rearrange(own, "(g k p q) i -> k g p q i", k=4, p=2, q=2)
        rows = rearrange(torch.stack((own[:3], own[3:].expand_as(own[:3]))), "m c g p q i -> (m g p q c) i")
        return rows[:, :-1].unflatten(1, self.leave.weight.shape[1:]), rows[:, -1]

    def _entry(self) -> Tensor:
        """Weights of the first convolution for inputs in the order of folded frames, the flag last."""
        frames, flag = self.enter.weight.split((self.enter.in_channels - 1, 1), dim=1)
        return torch.cat((rearrange(frames, "o (g c p q) ... -> o (g p q c) ...", c=3, p=2, q=2), flag), dim=1)


class PatchTokenizerConfig(StrictModel):
    """Layout of the codes and width of the decoder."""

    static_channels: int = Field(default=24, ge=1)
    motion_channels: int = Field(default=8, ge=0)
    spatial_compression: int = Field(default=8, ge=2, multiple_of=4)
    temporal_compression: int = Field(default=4, ge=1)
    refinement_width: int = Field(default=48, ge=4)
    refinement_depth: int = Field(default=2, ge=1)


class PatchTokenizer(nn.Module, VideoTokenizer):
    """Linear codes on orthonormal bases, and a decoder that adds what the codes leave out."""

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

    def encode(self, video: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b c t_l h_l w_l"]:
        """Codes of a clip of ``1 + 4 k`` frames in [-1, 1]. Raises: DataError when the video has another shape."""
        check_video(self, video)
        with torch.autocast(device_type=video.device.type, enabled=False):
            patches = self._patches(video.float())
            first, groups = patches[:, :1], patches[:, 1:]
            groups = rearrange(groups, "b (n g) h w d -> b n g h w d", g=self.temporal_compression)
            means = torch.cat((first, groups.mean(dim=2)), dim=1)
            static = means @ self.static_basis.T
            motion = rearrange(groups, "b n g h w d -> b n h w (g d)") @ self.motion_basis.T
            motion = torch.cat((motion.new_zeros(*static[:, :1].shape[:-1], motion.shape[-1]), motion), dim=1)
            codes = torch.cat((static, motion), dim=-1) / self.scale
        return rearrange(codes, "b t h w c -> b c t h w")

    def decode_groups(
        self, latents: Float[Tensor, "b c t_l h_l w_l"], *, begins: bool
    ) -> Float[Tensor, "b t_l h2 w2 d"]:
        """Folded frames of each latent frame from its codes alone; where the clip ``begins``, the first one's are all alike."""
        check_latents(self, latents)
        axes = {"c": 3, "i": self.spatial_compression // 2, "p": 2, "j": self.spatial_compression // 2, "q": 2}
        with torch.autocast(device_type=latents.device.type, enabled=False):
            static = repeat(self.static_basis, "k d -> k (g d)", g=self.temporal_compression)
            basis = torch.cat((static, self.motion_basis)) * self.scale[:, None]
            mean = repeat(self.mean, "d -> 1 (g d)", g=self.temporal_compression)
            order = "k (g c i p j q) -> k (i j g p q c)"
            basis, mean = (rearrange(part, order, g=self.temporal_compression, **axes) for part in (basis, mean))
            codes = rearrange(latents.float(), "b k t h w -> b t h w k")
            if begins:
                codes = codes.clone()
                codes[:, :1, ..., self.config.static_channels :] = 0.0
            cells = torch.addmm(mean[0], codes.flatten(0, 3), basis)
            sizes = {"b": len(latents), "h": latents.shape[3], "w": latents.shape[4], "i": axes["i"], "j": axes["j"]}
            return rearrange(cells, "(b t h w) (i j d) -> b t (h i) (w j) d", **sizes)

    def decode_linear(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        """Decode the codes alone (the orthogonal projection of the video)."""
        return self.unfold(self.decode_groups(latents, begins=True), begins=True)

    def unfold(self, groups: Float[Tensor, "b n h2 w2 d"], *, begins: bool) -> Float[Tensor, "b 3 t h w"]:
        """Video of folded groups, stored frame by frame and pixel by pixel; the first group of a clip is one frame."""
        video = rearrange(groups, "b n h w (g p q c) -> b (n g) (h p) (w q) c", p=2, q=2, c=3)
        if begins:
            video = torch.cat((video[:, :1], video[:, self.temporal_compression :]), dim=1)
        return rearrange(video, "b t h w c -> b c t h w")

    def decoder(self, reference: Float[Tensor, "b 3 h w"] | None = None) -> PatchDecoding:
        return PatchDecoding(self, reference)

    def refine(
        self, coarse: Float[Tensor, "b 3 t h w"], reference: Float[Tensor, "b 3 h w"] | None = None
    ) -> Float[Tensor, "b 3 t h w"]:
        """The convolutional decoder on a linear decode. Raises: DataError when the reference has another size."""
        frames = rearrange(coarse, "b c t h w -> b t c h w")
        frames = torch.cat((frames[:, :1].expand(-1, self.temporal_compression - 1, -1, -1, -1), frames), dim=1)
        groups = fold(rearrange(frames, "b (n g) c h w -> b n g c h w", g=self.temporal_compression))
        return self.unfold(self.refinement(groups, *self.still(groups[:, 0], reference)), begins=True)

    def still(self, group: Float[Tensor, "b h w d"], reference: Tensor | None) -> tuple[Tensor, Tensor]:
        """Features and folded reference for all groups of a clip with this first group. Raises: DataError when the sizes differ."""
        first = group[..., :12]
        size = (len(group), 3, 2 * group.shape[1], 2 * group.shape[2])
        if reference is not None and reference.shape != size:
            raise DataError("The reference frame does not fit the latents", expected=size, got=tuple(reference.shape))
        shown = first if reference is None else fold(reference[:, None].to(first.dtype))
        return self.refinement.still(first, shown, reference is not None), shown

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
        """A tokenizer as ``folder`` describes it, without its weights. Raises: CheckpointError when it describes none."""
        path = folder / DESCRIPTION
        content = read_description(path, FORMAT, "tokenizer", VERSION)
        if content.get("kind") != cls.KIND:
            raise CheckpointError("Unknown kind of tokenizer", where=path, expected=cls.KIND, got=content.get("kind"))
        tokenizer = cls(described(PatchTokenizerConfig, content.get("config"), path))
        tokenizer.weights_sha256 = content["weights_sha256"]
        return tokenizer.eval().requires_grad_(False)

    @classmethod
    def load(cls, folder: Path) -> PatchTokenizer:
        """Read a tokenizer written by :meth:`save`. Raises: CheckpointError when it is incomplete, damaged, or of another kind."""
        tokenizer, weights = cls.outline(folder), folder / WEIGHTS
        fill(tokenizer, read_weights(weights, tokenizer.weights_sha256), where=weights, dtype=torch.float32)
        return tokenizer


class PatchDecoding(VideoDecoder):
    """Decodes for a patch tokenizer: each latent frame is decoded beside the first one and the observed picture."""

    def __init__(self, tokenizer: PatchTokenizer, reference: Tensor | None) -> None:
        self._tokenizer, self._reference = tokenizer, reference
        self._still: tuple[Tensor, Tensor] | None = None

    def begin(self, first: Float[Tensor, "b c 1 h w"]) -> None:
        group = self._tokenizer.decode_groups(first, begins=True)[:, 0]
        self._still = self._tokenizer.still(group, self._reference)

    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        begins = self._still is None
        groups = self._tokenizer.decode_groups(latents, begins=begins)
        if self._still is None:
            self._still = self._tokenizer.still(groups[:, 0], self._reference)
        return self._tokenizer.unfold(self._tokenizer.refinement(groups, *self._still), begins=begins)

    def out_of_order(self, row: int) -> PatchDecoding | None:
        if self._still is None:
            return None
        features, shown = self._still
        other = PatchDecoding(self._tokenizer, None)
        other._still = features[row : row + 1], shown[row : row + 1]
        return other


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

    Static and motion components span orthogonal subspaces, so the best ``channels`` of the two spectra together are
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


_DEFAULT_CHANNELS = 16
"""Channels of Wan 2.1, whose statistics are ``AutoencoderKLWan``'s default for a folder that states none."""


class WanTokenizer(nn.Module, VideoTokenizer):
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
        if self.latent_channels == len(WAN22_MEAN) and len(mean) == len(std) == _DEFAULT_CHANNELS:
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
        """Normalised latents of a clip of ``1 + 4 k`` frames in [-1, 1]. Raises: DataError when the video has another shape."""
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


class WanDecoder(VideoDecoder):
    """Decodes clips as their latents arrive. The autoencoder's convolutions are causal: what they need of earlier frames
    is held by one cache per convolution, which `AutoencoderKLWan.decode` clears at its end and this keeps.
    """

    def __init__(self, tokenizer: WanTokenizer) -> None:
        self._tokenizer = tokenizer
        self._cache: list[Any] = [None] * tokenizer.vae._cached_conv_counts["decoder"]
        self._begun = False

    def __call__(self, latents: Float[Tensor, "b c t_l h_l w_l"]) -> Float[Tensor, "b 3 t h w"]:
        from diffusers.models.autoencoders.autoencoder_kl_wan import unpatchify

        tokenizer, vae = self._tokenizer, self._tokenizer.vae
        check_latents(tokenizer, latents)
        frames, self._cache = list[Tensor](), list(self._cache)
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

    def begin(self, first: Float[Tensor, "b c 1 h w"]) -> None:
        """Take in the latents of frame 0, which costs as much as its picture."""
        self(first)


WAN22_SHAPE = {
    "base_dim": 160, "decoder_base_dim": 256, "z_dim": 48, "dim_mult": [1, 2, 4, 4], "num_res_blocks": 2,
    "temperal_downsample": [False, True, True], "is_residual": True, "in_channels": 12, "out_channels": 12,
    "patch_size": 2, "scale_factor_temporal": 4, "scale_factor_spatial": 16,
}  # fmt: skip
"""The published autoencoder (Wan-AI/Wan2.2-TI2V-5B-Diffusers, vae/config.json)."""


def _wan_shape(root: Path) -> dict[str, Any]:
    """``config.json`` of an autoencoder. Raises: CheckpointError when it is damaged, or of another one."""
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

    root, shape = _wan_outline(folder)
    vae: Any = AutoencoderKLWan.from_config(shape)
    return WanTokenizer(vae.eval().requires_grad_(False), where=root)


def spatial_compression(folder: Path | None) -> int:
    """That of `tokenizer_outline`, without the seconds that diffusers takes to load."""
    if folder is not None and (folder / DESCRIPTION).is_file():
        return PatchTokenizer.outline(folder).spatial_compression
    return int(_wan_outline(folder)[1]["scale_factor_spatial"])


def _wan_outline(folder: Path | None) -> tuple[Path | None, dict[str, Any]]:
    """Folder and configuration of an autoencoder; the published one without a folder."""
    places = [] if folder is None else [folder / "vae", folder]
    root = next((place for place in places if (place / "config.json").is_file()), None)
    shape = WAN22_SHAPE if root is None else {"scale_factor_spatial": 8, **_wan_shape(root)}
    return root, {"latents_mean": WAN22_MEAN, "latents_std": WAN22_STD, **shape}


def require_device(device: str) -> None:
    """Raises: UnavailableError: a GPU is asked for where torch can use none."""
    if torch.device(device).type == "cuda" and not torch.cuda.is_available():
        raise UnavailableError(
            "No GPU that torch can use is here", where=f"device={device}", expected="a GPU and torch with CUDA",
            got=f"torch {torch.__version__}", next_step="device=cpu, or `worldline doctor`",
        )  # fmt: skip


def load_tokenizer(folder: Path, device: str = "cpu", dtype: torch.dtype = torch.float32) -> VideoTokenizer:
    """Load whatever tokenizer ``folder`` holds: a patch tokenizer, or a diffusers Wan autoencoder.

    Args:
        dtype: of a Wan autoencoder, which computes in it; a patch tokenizer stays in float32.

    Raises:
        CheckpointError: the folder holds none, or a damaged one.
        UnavailableError: there is no such device.
    """
    require_device(device)
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
