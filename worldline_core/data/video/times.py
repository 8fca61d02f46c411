"""When the frames of a video are shown, from its packets: nothing is decoded."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from worldline_core.data.guards.rejection import RejectedInputError
from worldline_core.data.guards.source_paths import AnyPath
from worldline_core.data.video.clip import open_video, undecodable


def frame_times(path: AnyPath) -> np.ndarray:
    """(N,) float64 presentation times [s] of a video's frames from the first one's, in the order of presentation.

    A packet of video is one frame; those that an edit list cuts away are marked and left out.

    Raises: RejectedInputError: missing_file, special_file, too_large, unreadable (no video, or frames without a time),
        truncated_video.
    """
    with open_video(path) as (container, stream):
        base = stream.time_base or Fraction(1, 1000)
        ticks = [packet.pts for packet in container.demux(stream) if packet.size and not packet.is_discard]
    timed = [tick for tick in ticks if tick is not None]
    if not ticks:
        raise undecodable(path, "no frames")
    if len(timed) < len(ticks):
        raise RejectedInputError(
            "unreadable",
            "Frames of the video have no time",
            where=str(path),
            expected=f"{len(ticks)} frames with a time",
            got=f"{len(timed)}",
        )
    ordered = np.sort(np.asarray(timed, dtype=np.int64))
    return (ordered - ordered[0]) * float(base)
