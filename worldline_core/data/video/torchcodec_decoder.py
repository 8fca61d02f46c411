"""Frames through torchcodec, found by presentation time and checked against it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
from torchcodec.decoders import VideoDecoder

from worldline_core.data.guards.limits import check_image_size
from worldline_core.data.guards.source_paths import local_file
from worldline_core.data.video.clip import FRAME_TOLERANCE, VideoClip, undecodable
from worldline_core.data.video.frame_decoder import OpenFiles, frame_times, lost_frame, torchcodec_name
from worldline_core.data.video.header import check_video_header

_CHUNK_BYTES = 8 << 20
"""Frames are fetched in chunks of this size, so that the allocator hands out the same warm memory again: for whole
clips of 480 x 640 the page faults of fresh memory cost about a third of the decoding."""
SeekMode = Literal["approximate", "exact"]


class TorchcodecDecoder:
    """torchcodec on the CPU, one thread a file.

    Files are opened in its approximate mode, which reads the header alone, while the exact mode first reads through the
    whole file (hundreds of megabytes where episodes are joined). Approximate is only where it looks for a frame: the
    times of the decoded frames are compared with the wanted ones, and where one differs (variable frame rates), the file
    is opened again in exact mode, and stays so (``exact_files``).
    """

    def __init__(self, *, open_files: int = 16) -> None:
        self.name = torchcodec_name()
        self._files: OpenFiles[VideoDecoder] = OpenFiles(open_files)
        self.exact_files: set[str] = set()

    def frames(self, clip: VideoClip, indices: Sequence[int]) -> Iterator[np.ndarray]:
        times = frame_times(clip, indices)
        done = 0
        while done < len(times):
            decoder = self._file(clip)
            chunk = max(1, _CHUNK_BYTES // max(1, _frame_bytes(decoder)))
            wanted = times[done : done + chunk]
            pictures = self._fetch(clip, decoder, wanted)
            if pictures is None and str(clip.path) not in self.exact_files:
                self.exact_files.add(str(clip.path))
                self._files.remove(clip.path)
                continue
            if pictures is None:
                self._files.remove(clip.path)
                raise lost_frame(clip, len(times), done)
            yield from pictures
            done += len(wanted)

    def close(self) -> None:
        self._files.clear()

    def _fetch(self, clip: VideoClip, decoder: VideoDecoder, times: list[float]) -> np.ndarray | None:
        """uint8 (n, H, W, 3) of the frames at ``times``; None where they cannot be had in this mode."""
        # A little after a frame begins: rounding must not name the frame before.
        inside = [time + FRAME_TOLERANCE / clip.fps for time in times]
        try:
            batch = decoder.get_frames_played_at(inside)
        except (RuntimeError, IndexError, ValueError):
            return None
        late = (batch.pts_seconds.numpy() - np.asarray(times)) * clip.fps
        return batch.data.numpy() if bool((np.abs(late) <= FRAME_TOLERANCE).all()) else None

    def _file(self, clip: VideoClip) -> VideoDecoder:
        decoder = self._files.get(clip.path)
        if decoder is None:
            file = check_video_header(local_file(clip.path))
            mode: SeekMode = "exact" if str(clip.path) in self.exact_files else "approximate"
            try:
                decoder = VideoDecoder(
                    str(file), dimension_order="NHWC", num_ffmpeg_threads=1, seek_mode=mode, device="cpu"
                )
            except (RuntimeError, ValueError) as error:
                raise undecodable(clip.path, str(error).splitlines()[0]) from error
            check_image_size(decoder.metadata.width or 0, decoder.metadata.height or 0, str(clip.path))
            self._files.add(clip.path, decoder)
        return decoder


def _frame_bytes(decoder: VideoDecoder) -> int:
    return 3 * (decoder.metadata.width or 0) * (decoder.metadata.height or 0)
