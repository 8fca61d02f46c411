"""A running prediction: it begins at what the cameras see now and predicts one unit (a block or a clip) at a time, each
under controls that may be given as late as the step itself.

A causal model predicts block by block. Its KV cache is a window of constant size whose positions count from the window's
start, so they stay within those of a training clip however long the rollout is. A Stage II model chains clips: the last
predicted picture of every view is the observed one of the next clip (they overlap by this one frame). Pictures are decoded
unit by unit, so memory does not grow with the length.

Axis legend: b clips, v views, a channels of the action maps, t latent frames, n frames, h w pixels or latent cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from copy import copy

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from worldline_core.model.video_tokenizer import VideoDecoder, VideoTokenizer, frames_to_video, video_to_frames
from worldline_core.rollout.samplers import BlockCausalSimulator, FullClipSampler

Frames = list[dict[str, np.ndarray]]
"""Of every clip: ``uint8 (n, H, W, 3)`` RGB by view."""


class Session:
    """One running prediction of a batch of clips that share their views.

    Args:
        images: what each view sees now, in [-1, 1] at the model's size.

    Attributes:
        observed: the given images, encoded and decoded by the tokenizer; one frame per view.
    """

    def __init__(
        self,
        sampler: BlockCausalSimulator | FullClipSampler,
        tokenizer: VideoTokenizer,
        images: Float[Tensor, "b v 3 h w"],
        *,
        device: str,
        bfloat16: bool,
    ) -> None:
        self._sampler = sampler
        self._tokenizer = tokenizer
        self._device = device
        self._bfloat16 = bfloat16
        self._decoders: list[VideoDecoder]
        self._first: Tensor | None  # observed latents of a clip that no step has begun
        self._ended: Frames | None = None
        self.observed = self._observe(images)

    @torch.no_grad()
    def step(self, maps: Float[Tensor, "b v a t h w"]) -> Frames:
        """Predict the next unit.

        Args:
            maps: action maps of the last known latent frame and of those to predict.

        Returns:
            The predicted frames, without the known one.

        Raises:
            DataError: the controls given to a causal model are not those of one block.
        """
        if self._ended is not None:
            self._observe(torch.stack([self._last_pictures(clip) for clip in self._ended]))
        frames = self._decode(self._sample(maps))
        self._ended = frames if self._sampler.chained else None
        return frames

    def steps(
        self, maps: Iterable[Float[Tensor, "b v a t h w"]], *, overlapped: bool | None = None
    ) -> Iterator[Frames]:
        """Like `step`, for controls that are known in advance: one block is decoded while the next is sampled.

        Args:
            overlapped: whether to decode while sampling. None: on a GPU, where decoding gets a stream of its own, but not on
                a CPU, whose cores are busy anyway. Chained clips never overlap: each begins at the last picture of the
                one before.
        """
        on_gpu = torch.device(self._device).type == "cuda"
        if self._sampler.chained or not (on_gpu if overlapped is None else overlapped):
            yield from map(self.step, maps)
            return
        beside = torch.cuda.Stream(self._device) if on_gpu else None
        waiting: Future[Frames] | None = None
        with ThreadPoolExecutor(1) as decoding:
            for given in maps:
                latents = self._sample(given)
                if beside is not None:
                    beside.wait_stream(torch.cuda.current_stream(self._device))
                following = decoding.submit(self._decode_beside, latents, beside)
                if waiting is not None:
                    yield waiting.result()
                waiting = following
            if waiting is not None:
                yield waiting.result()

    def _sample(self, maps: Tensor) -> Tensor:
        if self._first is not None:
            self._sampler.start(self._first, maps[:, :, :, :1])
            self._first = None
        return self._sampler.step(maps[:, :, :, 1:])

    @torch.no_grad()
    def _decode_beside(self, latents: Tensor, stream: torch.cuda.Stream | None) -> Frames:
        """Decode in another thread, on a GPU on a stream of its own."""
        if stream is None:
            return self._decode(latents)
        with torch.cuda.stream(stream):
            latents.record_stream(stream)
            return self._decode(latents)

    def select(self, clips: Sequence[int], seeds: Sequence[int] | None = None) -> Session:
        """A session of these clips that continues from their present state, independently of this one. Naming a clip several
        times makes branches of it, which share the cached history of a causal model.

        Args:
            seeds: of the noise from here on, one for each of ``clips``; by default the noise continues unchanged.
        """
        other = copy(self)
        other._sampler = self._sampler.fork(clips, seeds)
        other._first = None if self._first is None else self._first[list(clips)]
        other._decoders = [self._decoders[clip].copy() for clip in clips]
        other._ended = None if self._ended is None else [self._ended[clip] for clip in clips]
        other.observed = [self.observed[clip] for clip in clips]
        return other

    @torch.no_grad()
    def _observe(self, images: Tensor) -> Frames:
        """Begin a clip at these images."""
        images = images.to(self._device)
        self._first = encode_images(self._tokenizer, images)
        self._decoders = [self._tokenizer.decoder(clip) for clip in images]
        return self._decode(rearrange(self._first, "b v c h w -> b v c 1 h w"))

    def _last_pictures(self, clip: dict[str, np.ndarray]) -> Float[Tensor, "v 3 h w"]:
        return torch.stack([frames_to_video(clip[view][-1:])[:, 0] for view in self._sampler.views])

    def _decode(self, latents: Tensor) -> Frames:
        with torch.autocast(self._device.split(":")[0], torch.bfloat16, enabled=self._bfloat16):
            # One clip at a time: the decoder works on whole images, which take a hundred times the memory of latents.
            videos = (decode(clip) for decode, clip in zip(self._decoders, latents, strict=True))
            return [{view: video_to_frames(clip[v]) for v, view in enumerate(self._sampler.views)} for clip in videos]


@torch.no_grad()
def encode_images(tokenizer: VideoTokenizer, images: Float[Tensor, "b v 3 h w"]) -> Float[Tensor, "b v c h_l w_l"]:
    """Latents of single frames."""
    latents = tokenizer.encode(rearrange(images, "b v c h w -> (b v) c 1 h w"))
    return rearrange(latents, "(b v) c 1 h w -> b v c h w", v=images.shape[1])
