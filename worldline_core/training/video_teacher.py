"""Frozen video encoders whose features the relational terms compare with, and the train_teacher step.

``SmallVideoTeacher`` is the embedded default (trained on the recordings by train_teacher); ``VJepa2Teacher`` is V-JEPA 2 from a
local folder. Neither is ever used with random weights. The features of both are the normalised outputs of their last
four blocks, concatenated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from worldline_core.data.episodes.episode_set import EpisodeSet
from worldline_core.errors import CheckpointError, DataError, UnavailableError
from worldline_core.model.checkpoint import described, fill, read_weights, write_weights
from worldline_core.store.artifact_files import read_json
from worldline_core.store.atomic import write_json_atomic
from worldline_core.training.clip_source import load_views
from worldline_core.training.trainer import Objective, ParameterGroup, held_out_losses, train
from worldline_core.training.training_config import BLOCKS, SmallTeacherShape, TeacherConfig

if TYPE_CHECKING:
    from transformers import VJEPA2Model

DESCRIPTION, WEIGHTS = "teacher.json", "teacher.safetensors"
FORMAT = "worldline.small_video_teacher"
TUBELET = 4
VALIDATION_SEED = 30_000


class VideoTeacher(Protocol):
    """Frames in [0, 1] to features on a (t, h, w) grid of its own, without gradients."""

    name: str

    def features(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 h2 w2 d"]: ...


def concatenated(outputs: list[Tensor], rows: int, columns: int) -> Float[Tensor, "b t h w d"]:
    """Outputs of several blocks, ``(b n d)``, layer-normalised and side by side on their grid."""
    normalised = torch.cat([functional.layer_norm(output.float(), output.shape[-1:]) for output in outputs], dim=-1)
    return rearrange(normalised, "b (t h w) d -> b t h w d", h=rows, w=columns)


class SmallVideoTeacher(nn.Module):
    """A masked-video transformer over tubelets: the first frame alone, then groups of four, as the tokenizer does.

    In training part of the tubelets is hidden, and their pixels are predicted from the rest.
    """

    name = "small video teacher"

    def __init__(self, shape: SmallTeacherShape) -> None:
        super().__init__()
        self.shape = shape
        self.grid = (shape.image_size[0] // shape.patch, shape.image_size[1] // shape.patch)
        values = 3 * TUBELET * shape.patch**2
        width = shape.hidden_size
        self.embed = nn.Linear(values, width)
        self.position = nn.Parameter(torch.zeros(self.grid[0] * self.grid[1], width))
        self.time = nn.Parameter(torch.zeros(shape.max_groups, width))
        self.mask_token = nn.Parameter(torch.zeros(width))
        self.blocks = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width, shape.num_heads, 4 * width, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
            )
            for _ in range(shape.num_layers)
        )
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, values)

    def initialise(self, generator: torch.Generator) -> None:
        """Weights for training: deterministic in the generator."""
        for parameter in self.parameters():
            if parameter.ndim > 1:
                nn.init.normal_(parameter, 0.0, 0.02, generator=generator)

    def tubelets(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 n p"]:
        """Pixels of every tubelet; the first frame is repeated to fill its own.

        Raises:
            DataError: if the clip does not have 4 k + 1 frames, or more than the encoder has positions for.
        """
        batch, _, length = frames.shape[:3]
        if (length - 1) % TUBELET or 1 + (length - 1) // TUBELET > self.shape.max_groups:
            raise DataError(
                "The teacher cannot read a clip of this length.",
                expected=f"4 k + 1 frames, at most {1 + TUBELET * (self.shape.max_groups - 1)}",
                got=length,
            )
        if tuple(frames.shape[-2:]) != self.shape.image_size:
            flat = rearrange(frames, "b c t h w -> (b t) c h w")
            flat = functional.interpolate(flat, self.shape.image_size, mode="area")
            frames = rearrange(flat, "(b t) c h w -> b c t h w", b=batch)
        frames = torch.cat([frames[:, :, :1].expand(-1, -1, TUBELET - 1, -1, -1), frames], dim=2)
        size = self.shape.patch
        return rearrange(frames, "b c (t k) (h p) (w q) -> b t (h w) (c k p q)", k=TUBELET, p=size, q=size)

    def encode(
        self, tubelets: Float[Tensor, "b t n p"], hidden: Bool[Tensor, "b t n"] | None = None
    ) -> list[Float[Tensor, "b m d"]]:
        tokens = self.embed(tubelets * 2 - 1)
        if hidden is not None:
            tokens = torch.where(hidden[..., None], self.mask_token.to(tokens.dtype), tokens)
        tokens = tokens + self.position + self.time[: tokens.shape[1], None]
        tokens = rearrange(tokens, "b t n d -> b (t n) d")
        outputs: list[Tensor] = []
        for block in self.blocks:
            tokens = block(tokens)
            outputs.append(tokens)
        return outputs[-BLOCKS:]

    def masked_loss(self, frames: Float[Tensor, "b 3 t h w"], hidden: Bool[Tensor, "b bins n"]) -> Float[Tensor, ""]:
        """Squared error of the hidden tubelets' pixels.

        The target is the change against the clip's first frame, scaled by its deviation over the clip: predicting it
        takes knowing what moves, not what the table looks like.
        """
        tubelets = self.tubelets(frames)
        tokens = self.encode(tubelets, hidden)[-1]
        predicted = rearrange(self.head(self.norm(tokens)), "b (t n) p -> b t n p", t=tubelets.shape[1])
        target = tubelets - tubelets[:, :1]
        target = target / (target.flatten(1).std(dim=1) + 0.02)[:, None, None, None]
        error = ((predicted.float() - target) ** 2).mean(dim=-1)
        return error[hidden].mean()

    @torch.no_grad()
    def features(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 h2 w2 d"]:
        return concatenated(self.encode(self.tubelets(frames.to(self.embed.weight.device))), *self.grid)


class VJepa2Teacher:
    """V-JEPA 2 (paper: ViT-g/384).

    Frames are resized to the encoder's crop size, because its rotary grid follows from it.
    """

    name = "V-JEPA 2"
    # Mean and standard deviation of the images it was trained on (ImageNet).
    mean = (0.485, 0.456, 0.406)
    std = (0.229, 0.224, 0.225)

    @classmethod
    def load(cls, folder: Path, device: str) -> Self:
        """Read a local folder. Raises: UnavailableError: it has no weights."""
        from transformers import VJEPA2Model

        if not any(folder.glob("*.safetensors")):
            raise UnavailableError(
                "The weights of V-JEPA 2 are not here.",
                where=folder,
                expected="a transformers folder of facebook/vjepa2-vitg-fpc64-384 with model*.safetensors",
                next_step="download it, use the small teacher, or set relational to null",
            )
        model = VJEPA2Model.from_pretrained(folder, local_files_only=True, dtype=torch.float32)
        return cls(model.to(torch.device(device)))  # pyright: ignore[reportArgumentType]

    def __init__(self, model: VJEPA2Model) -> None:
        self.model = model.eval().requires_grad_(False)
        self.crop: int = self.model.config.crop_size
        self.side = self.crop // int(self.model.config.patch_size)  # pyright: ignore[reportArgumentType]
        self.tubelet: int = self.model.config.tubelet_size
        self._outputs: list[Tensor] = []
        for layer in self.model.encoder.layer[-BLOCKS:]:
            layer.register_forward_hook(self._keep)

    def _keep(self, module: torch.nn.Module, inputs: object, output: tuple[Tensor, ...] | Tensor) -> None:
        del module, inputs
        self._outputs.append(output if isinstance(output, Tensor) else output[0])

    @torch.no_grad()
    def features(self, frames: Float[Tensor, "b 3 t h w"]) -> Float[Tensor, "b t2 h2 w2 d"]:
        batch = frames.shape[0]
        pixels = rearrange(frames, "b c t h w -> (b t) c h w")
        pixels = functional.interpolate(pixels, (self.crop, self.crop), mode="bilinear", antialias=True)
        mean, std = (rearrange(torch.tensor(value), "c -> c 1 1").to(pixels) for value in (self.mean, self.std))
        video = rearrange((pixels - mean) / std, "(b t) c h w -> b t c h w", b=batch)
        if video.shape[1] % self.tubelet:
            # The clip's 4 k + 1 frames do not fill the last tubelet: hold the last frame.
            video = torch.cat(
                [video, video[:, -1:].expand(-1, self.tubelet - video.shape[1] % self.tubelet, -1, -1, -1)], 1
            )
        self._outputs.clear()
        parameter = next(self.model.parameters())
        self.model(pixel_values_videos=video.to(parameter.device, parameter.dtype), skip_predictor=True)
        features = concatenated(self._outputs, self.side, self.side)
        self._outputs.clear()
        return features


VJEPA2_GIANT = {"hidden_size": 1408, "num_hidden_layers": 40, "num_attention_heads": 22, "mlp_ratio": 48 / 11}
"""The published encoder at full size (facebook/vjepa2-vitg-fpc64-384, config.json), with a crop of 384."""


def teacher_outline(folder: Path | None) -> tuple[nn.Module, Callable[[Tensor], Tensor]]:
    """A teacher of the right shape without trained weights, to count with, and its features: of the folder, else V-JEPA 2."""
    if folder is not None and (folder / DESCRIPTION).is_file():
        small = SmallVideoTeacher(_small_shape(folder / DESCRIPTION))
        return small.eval().requires_grad_(False), small.features
    from transformers import VJEPA2Config, VJEPA2Model

    shape: dict[str, Any] = VJEPA2_GIANT | {"crop_size": 384}
    if folder is not None and (folder / "config.json").is_file():
        shape = read_json(folder / "config.json")
    model = VJEPA2Model(VJEPA2Config(**shape))
    return model, VJepa2Teacher(model).features


def _small_shape(path: Path) -> SmallTeacherShape:
    content = read_json(path)
    if content.get("format") != FORMAT:
        raise CheckpointError("Not a small teacher", where=path, expected=FORMAT, got=content.get("format"))
    return described(SmallTeacherShape, content.get("shape"), path)


def load_teacher(folder: Path, device: str = "cpu") -> VideoTeacher:
    """The teacher in ``folder``: the small one, or V-JEPA 2.

    Raises:
        CheckpointError: if it holds neither, or a damaged one.
        UnavailableError: if V-JEPA 2's weights are missing.
    """
    path = folder / DESCRIPTION
    if path.is_file():
        teacher = SmallVideoTeacher(_small_shape(path))
        fill(teacher, read_weights(folder / WEIGHTS, None), where=folder / WEIGHTS, dtype=torch.float32)
        return teacher.eval().requires_grad_(False).to(device)
    config = folder / "config.json"
    if read_json(config).get("model_type") == "vjepa2":
        return VJepa2Teacher.load(folder, device)
    raise CheckpointError(
        "This folder holds no relational teacher.",
        where=folder,
        expected=f"{DESCRIPTION} of the small teacher, or config.json of V-JEPA 2",
        got=sorted(path.name for path in folder.glob("*"))[:8],
        next_step="run train_teacher, or download V-JEPA 2",
    )


@dataclass(frozen=True)
class FrameBatch:
    """Clips of single views (episode/view), RGB in [0, 1]."""

    names: tuple[str, ...]
    frames: Float[Tensor, "b 3 t h w"]


class MaskedVideoObjective(Objective[FrameBatch]):
    """Predict hidden tubelets."""

    def __init__(self, teacher: SmallVideoTeacher, hidden: float) -> None:
        self.teacher = teacher
        self.hidden = hidden

    def loss(self, batch: FrameBatch, generator: torch.Generator, step: int) -> tuple[Tensor, dict[str, float]]:
        """Loss on one batch; the first frame is never hidden."""
        del step
        groups = 1 + (batch.frames.shape[2] - 1) // TUBELET
        tokens = self.teacher.grid[0] * self.teacher.grid[1]
        draws = torch.rand(len(batch.names), groups, tokens, generator=generator, device=batch.frames.device)
        hidden = draws < self.hidden
        hidden[:, 0] = False
        return self.teacher.masked_loss(batch.frames, hidden), {}


def teacher_batch(views: Sequence[tuple[str, Tensor]], config: TeacherConfig, seed: int, index: int) -> FrameBatch:
    """Batch ``index``: a pure function of the seed and the index."""
    random = np.random.Generator(np.random.Philox(key=[seed, index]))
    names, frames = [], []
    for _ in range(config.trainer.batch_size):
        name, video = views[int(random.integers(len(views)))]
        start = int(random.integers(video.shape[1] - config.clip_frames + 1))
        names.append(name)
        frames.append(video[:, start : start + config.clip_frames])
    return FrameBatch(tuple(names), torch.stack(frames).to(config.trainer.device).float() / 255.0)


def train_teacher(config: TeacherConfig, inputs: Mapping[str, Path], output: Path) -> dict[str, Any]:
    """Train on ``inputs['episodes']`` (training splits only), write the frozen teacher, and count the episodes.

    Raises:
        DataError: if there are not enough episodes.
    """
    torch.manual_seed(config.trainer.seed)
    episodes = EpisodeSet.open(Path(inputs["episodes"]))
    in_splits = episodes.select(split=config.splits)
    fitting = [i for i in in_splits if episodes.rows[i].video_frames >= config.clip_frames]
    order = np.random.default_rng(config.trainer.seed).permutation(len(fitting))
    held_out_count = min(config.held_out_episodes, len(fitting) // 4)
    if len(fitting) < 2 or held_out_count < 1:
        raise DataError(
            "There are too few episodes to train a teacher.",
            where=inputs["episodes"],
            expected=f"4 or more in {config.splits}, of {config.clip_frames} frames or more",
            got=len(fitting),
        )
    held_out = sorted(fitting[i] for i in order[:held_out_count])
    chosen = sorted(fitting[i] for i in order[held_out_count : held_out_count + config.max_episodes])
    teacher = SmallVideoTeacher(config.shape)
    teacher.initialise(torch.Generator().manual_seed(config.trainer.seed))
    teacher.to(config.trainer.device).train()
    objective = MaskedVideoObjective(teacher, config.hidden)
    training = load_views(episodes, chosen, config.shape.image_size, config.clip_frames)
    validation = load_views(episodes, held_out, config.shape.image_size, config.clip_frames)

    result = train(
        config.trainer,
        groups=[ParameterGroup("teacher", dict(teacher.named_parameters()))],
        objective=objective,
        load=lambda index: teacher_batch(training, config, config.trainer.seed, index),
        validate=lambda: held_out_losses(
            config.trainer,
            lambda index: teacher_batch(validation, config, VALIDATION_SEED, index),
            lambda batch, generator: {"loss": objective.loss(batch, generator, 0)[0].item()},
            VALIDATION_SEED,
        ),
        output=output,
        identity={"config": config.model_dump(mode="json"), "episodes": [name for name, _ in training]},
        title="teacher",
    )
    write_weights(output / WEIGHTS, result.average, torch.float16)
    write_json_atomic(
        output / DESCRIPTION,
        {
            "format": FORMAT,
            "shape": config.shape.model_dump(mode="json"),
            "training": "masked video prediction",
            "episodes": len(chosen),
            "steps": result.steps,
            "seed": config.trainer.seed,
            "metrics": result.metrics,
        },
    )
    parameters = sum(value.numel() for value in teacher.parameters())
    left_out = {
        "in other splits": len(episodes) - len(in_splits),
        f"shorter than {config.clip_frames} frames": len(in_splits) - len(fitting),
        "held out to measure on": len(held_out),
        "beyond max_episodes": len(fitting) - len(held_out) - len(chosen),
    }
    return {
        "found": len(episodes),
        "kept": len(chosen),
        "left_out": left_out,
        "episodes": len(chosen),
        "steps": result.steps,
        "parameters": parameters,
        **result.metrics,
    }
