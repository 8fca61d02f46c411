"""Recordings of the small world as latents on the device, and what a video teacher says of them.

Axes: n episodes, v views, c latent channels, f video frames, t latent frames, h and w rows and columns.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from einops import rearrange
from torch import Tensor
from tqdm import tqdm

from tools.small_world_data import GRID, SHORT, VIEWS, Fact, Recorded
from worldline_core.actions.action_maps import control_frames, stack_controls
from worldline_core.actions.actions_config import TEMPORAL_FACTOR
from worldline_core.errors import DataError
from worldline_core.model.tokenizers import PatchTokenizer
from worldline_core.training.clip_sampler import Clip
from worldline_core.training.relational import SimilarityMatrices, common_shape, similarity_matrices
from worldline_core.training.train_tokenizer import to_video
from worldline_core.training.training_config import RelationalConfig
from worldline_core.training.video_teacher import VideoTeacher

GIVEN = ("maps", "native", "things", "robot")
"""What `Episodes` have as files give it."""
PATCH = 2
"""Latent cells along the side of a token."""


@dataclass(frozen=True)
class Episodes:
    """Episodes of one length and one split on the device.

    Attributes:
        latents: half (n, v, c, t, h, w).
        maps, things, robot, native: as in `Recorded`.
        singles: half (n, v, c, t, h, w): the last video frame of every latent frame coded alone, as first frames of
            clips are; of long recordings only.
        intra, cross: half: the video teacher's similarity matrices within and between views of short recordings to
            train with, where one is given.
    """

    facts: list[Fact]
    latents: Tensor
    maps: Tensor
    things: Tensor
    robot: Tensor
    native: Tensor
    singles: Tensor | None = None
    intra: Tensor | None = None
    cross: Tensor | None = None

    def __len__(self) -> int:
        return len(self.facts)

    def ended(self, outcomes: Sequence[str] | None) -> Tensor:
        """Rows of the episodes that ended in one of ``outcomes``; None: of all.

        Raises: DataError when none did.
        """
        rows = [row for row, fact in enumerate(self.facts) if outcomes is None or fact.outcome in outcomes]
        if not rows:
            raise DataError("No recording ended so", expected=outcomes, got=sorted({f.outcome for f in self.facts}))
        return torch.tensor(rows)

    def clips(self, rows: Tensor, per_latent_frame: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Latents, action maps, robot masks and shares of things of whole episodes, in single precision.

        Args:
            per_latent_frame: control frames whose maps a latent frame takes.
        """
        maps = maps_of_latent_frames(self.maps[rows], per_latent_frame)
        return self.latents[rows].float(), maps.float(), self.robot[rows].float(), self.things[rows].float()

    def cuts(
        self, rows: Tensor, starts: Tensor, blocks: int, per_latent_frame: int = 1
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The same of parts of long episodes: latent frames `starts` alone as first frames, then blocks of four.

        Raises: DataError for short recordings, whose frames are not coded alone.
        """
        if self.singles is None:
            raise DataError("Short recordings are not cut", expected="recordings of small_world_long.yaml")
        frames = starts[:, None] + torch.arange(4 * blocks + 1, device=starts.device)
        later = rearrange(self.latents[rows[:, None], :, :, frames[:, 1:]], "n t v c h w -> n v c t h w")
        first = rearrange(self.singles[rows, :, :, starts], "n v c h w -> n v c 1 h w")
        seen = torch.arange(4 * blocks * TEMPORAL_FACTOR + 1, device=starts.device)
        every = self.maps[rows[:, None], :, :, TEMPORAL_FACTOR * starts[:, None] + seen]
        maps = maps_of_latent_frames(rearrange(every, "n f v c h w -> n v c f h w"), per_latent_frame)
        robot = rearrange(self.robot[rows[:, None], :, frames], "n t v h w -> n v t h w")
        things = rearrange(self.things[rows[:, None], :, :, frames], "n t v c h w -> n v c t h w")
        return torch.cat((first, later), dim=3).float(), maps.float(), robot.float(), things.float()


def maps_of_latent_frames(maps: Tensor, per_latent_frame: int) -> Tensor:
    """What latent frames take (n v channels t h w) of the maps of every frame (n v 9 f h w)."""
    return stack_controls(maps[:, :, :, control_frames(maps.shape[3], per_latent_frame)], per_latent_frame)


class Gathered:
    """Tensors of so many episodes, filled file by file.

    Each is allocated once, whole: parts that are joined in the end leave gaps that a CPU's allocator keeps.
    """

    def __init__(self, count: int) -> None:
        self.count, self.facts = count, list[Fact]()
        self.tensors: dict[str, Tensor] = {}

    def add(self, facts: list[Fact], tensors: Mapping[str, Tensor]) -> None:
        """The next episodes."""
        rows = slice(len(self.facts), len(self.facts) + len(facts))
        for name, tensor in tensors.items():
            if name not in self.tensors:
                self.tensors[name] = tensor.new_empty((self.count, *tensor.shape[1:]))
            self.tensors[name][rows] = tensor
        self.facts += facts

    def episodes(self) -> Episodes:
        """All of them, in their order."""
        return Episodes(facts=self.facts, **self.tensors)


def recorded_files(folder: Path) -> list[str]:
    """Names of the files that are there, in the order in which they were to be recorded.

    Raises: DataError when there are none.
    """
    names = sorted(path.name for path in folder.glob("[0-9]*.safetensors"))
    if not names:
        raise DataError("No recordings", where=folder, next_step="python -m tools.train_small_world record FOLDER")
    return names


class Memory:
    """Recordings as latents on the tokenizer's device.

    Args:
        names: of the files in ``folder``, as `recorded_files` gives them.
        teacher: says how places relate (relational terms); None where no run asks for it.

    Attributes:
        held: short recordings of other splits than "train", to measure with.

    Raises: DataError when a file is missing.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], tokenizer: PatchTokenizer, teacher: VideoTeacher | None = None
    ) -> None:
        if missing := sorted(set(names) - {path.name for path in folder.iterdir()}):
            raise DataError(
                "Recordings are missing that this output was begun with",
                where=folder,
                expected=f"{len(names)} files",
                got=f"not {missing[0]} and {len(missing) - 1} others",
                next_step="record them again (the same seeds give the same episodes), or use another output folder",
            )
        self.folder, self.names, self.tokenizer, self.teacher = folder, tuple(names), tokenizer, teacher
        self.held: list[Recorded] = []
        counts: Counter[tuple[bool, str]] = Counter()
        for name in names:
            facts, frames = Recorded.outline(folder / name)
            counts[frames == SHORT, facts[0].split] += len(facts)
        found = {kind: Gathered(count) for kind, count in counts.items()}
        for name in tqdm(names, desc="read", unit="file", mininterval=10):
            recorded = Recorded.read(folder / name)
            found[recorded.short, recorded.split].add(recorded.facts, self._encoded(recorded))
            if recorded.short and recorded.split != "train":
                self.held.append(recorded)
        self._episodes = {kind: gathered.episodes() for kind, gathered in found.items()}
        said = {f"{'short' if short else 'long'} {split}": count for (short, split), count in counts.items()}
        print("recordings", json.dumps(said), flush=True)

    @property
    def device(self) -> str:
        return self.tokenizer.mean.device.type

    def count(self, split: str = "train", *, short: bool = True) -> int:
        """Number of recordings of a split."""
        return len(self._episodes[short, split]) if (short, split) in self._episodes else 0

    def episodes(self, split: str = "train", *, short: bool = True) -> Episodes:
        """Recordings of a split.

        Raises:
            DataError: there are none.
        """
        if (short, split) not in self._episodes:
            raise DataError(
                f"No {'short' if short else 'long'} recordings of the split {split}",
                where=self.folder,
                next_step="record them, or leave out of the plan what needs them",
            )
        return self._episodes[short, split]

    @torch.no_grad()
    def _encoded(self, recorded: Recorded) -> dict[str, Tensor]:
        """What `Episodes` hold of a file, by name."""
        video = videos(recorded.frames, self.device)
        given = {name: torch.from_numpy(getattr(recorded, name)).to(self.device) for name in GIVEN}
        latents = self.encode(video)
        if not recorded.short:
            frames = rearrange(video[:, :, :, ::TEMPORAL_FACTOR], "n v c t h w -> (n v t) c 1 h w")
            codes = self.tokenizer.encode(frames).half()
            given["singles"] = rearrange(codes, "(n v t) c 1 h w -> n v c t h w", n=len(video), v=len(VIEWS))
        elif self.teacher is not None and recorded.split == "train":
            features = self.teacher.features((video.flatten(0, 1) + 1) / 2).unflatten(0, (-1, len(VIEWS)))
            grid = (latents.shape[3], GRID[0] // PATCH, GRID[1] // PATCH)
            found = similarity_matrices(features, common_shape(RelationalConfig(), grid, features.shape[2:5]))
            given |= {"intra": found.intra.half(), "cross": found.cross.half()}
        return {**given, "latents": latents.half()}

    def encode(self, video: Tensor) -> Tensor:
        """Latents (n, v, c, t, h, w) of videos (n, v, 3, f, H, W) in [-1, 1]."""
        return self.tokenizer.encode(video.flatten(0, 1)).unflatten(0, (-1, len(VIEWS)))


class KnownSimilarities:
    """What a video teacher has said of episodes in memory: the place of `TeacherSimilarities`.

    Raises: DataError where it was not asked.
    """

    def __init__(self, episodes: Episodes) -> None:
        if episodes.intra is None or episodes.cross is None:
            raise DataError("The relational terms need a teacher", expected="recordings read with one")
        self.intra, self.cross = episodes.intra, episodes.cross
        self.rows = {fact.id: row for row, fact in enumerate(episodes.facts)}

    def similarities(
        self, clips: Sequence[Clip], views: Sequence[str], grid: tuple[int, int, int], frames: Tensor | None = None
    ) -> SimilarityMatrices:
        """SimilarityMatrices of every clip; see `TeacherSimilarities.similarities`."""
        del frames
        rows = torch.tensor([self.rows[clip.episode_id] for clip in clips])
        chosen = [VIEWS.index(view) for view in views]
        intra = self.intra[rows][:, chosen].float()
        cross = self.cross[rows][:, [view - 1 for view in chosen if view > 0]].float()
        shape = common_shape(RelationalConfig(), grid, (intra.shape[2] + 1, *grid[1:]))
        return SimilarityMatrices(shape, intra, cross)


def videos(frames: np.ndarray, device: str) -> Tensor:
    """Frames uint8 (n, v, f, H, W, 3) as (n, v, 3, f, H, W) in [-1, 1]."""
    return to_video(rearrange(torch.from_numpy(frames).to(device), "n v f h w c -> n v c f h w"))
