"""SAM 3's video tracker (transformers), started by the projected tool centres of the first frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from worldline_core.errors import UnavailableError


class Sam3Segmenter:
    """Each arm is one tracked object, prompted by one point; the robot's mask is their union.

    Frames and session state stay on the CPU: long videos otherwise fill the accelerator's memory.

    Args:
        model, processor: a Sam3TrackerVideoModel and its Sam3TrackerVideoProcessor (transformers).
    """

    name = "sam3"
    follows = True
    description = "SAM 3 video tracker, started from the projected tool centres of the first frame"

    def __init__(
        self,
        model: Any,
        processor: Any,
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self.dtype = torch.bfloat16 if self.device.type == "cuda" else torch.float32
        self.model = model.to(self.device, self.dtype).eval()
        self.processor = processor

    @classmethod
    def load(cls, folder: Path, *, device: torch.device | str | None = None) -> Sam3Segmenter:
        """Open weights from a local folder; nothing is downloaded.

        Raises: UnavailableError when the folder has no SAM 3.
        """
        if not (folder / "config.json").is_file():
            raise UnavailableError(
                "SAM 3 weights not found",
                where=folder,
                expected="a downloaded facebook/sam3 folder with config.json",
                next_step="accept the licence and download facebook/sam3, or choose another segmenter",
            )
        from transformers.models.sam3_tracker_video import Sam3TrackerVideoModel, Sam3TrackerVideoProcessor

        try:
            model = Sam3TrackerVideoModel.from_pretrained(folder, local_files_only=True)
            processor = Sam3TrackerVideoProcessor.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError) as error:
            raise UnavailableError("SAM 3 weights cannot be opened", where=folder, got=str(error)) from error
        return cls(model, processor, device=device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """Bool masks (n, h, w) of uint8 frames (n, h, w, 3).

        Without a valid point in the first frame there is nothing to track: all masks are empty.
        """
        return self.stream()(video, points)

    def stream(self) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
        """Masks of a video that comes piece by piece; of its frames only what the tracker looks back at is kept."""
        session: Any = None
        done = 0

        @torch.inference_mode()
        def masks_of(video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
            nonlocal session, done
            masks = np.zeros(video.shape[:3], dtype=bool)
            if done == 0:
                session = self._started(video, points)
            elif session is not None:
                inputs = self.processor.video_processor(videos=list(video), device="cpu", return_tensors="pt")
                for number, pixels in enumerate(inputs.pixel_values_videos[0]):
                    session.add_new_frame(pixels, done + number)
            for index in range(len(video)):
                if session is not None:
                    masks[index] = self._tracked(session, done, video.shape[1:3])
                done += 1
            return masks

        return masks_of

    def _started(self, video: np.ndarray, points: np.ndarray | None) -> Any:
        """A session with these first frames, one object a valid point of the first one; None without any."""
        height, width = video.shape[1:3]
        start = np.zeros((0, 2)) if points is None or len(video) == 0 else points[0]
        # Comparisons with NaN are False, so points that are not valid drop out as well.
        inside = np.logical_and(start >= 0, start < np.array([width, height]))
        start = start[np.all(inside, axis=-1)]
        if len(start) == 0:
            return None
        session = self.processor.init_video_session(
            video=list(video),
            inference_device=self.device,
            inference_state_device="cpu",
            processing_device="cpu",
            video_storage_device="cpu",
            dtype=self.dtype,
        )
        self.processor.add_inputs_to_inference_session(
            inference_session=session,
            frame_idx=0,
            obj_ids=list(range(1, len(start) + 1)),
            input_points=[[[[float(u), float(v)]] for u, v in start]],
            input_labels=[[[1] for _ in start]],
        )
        return session

    def _tracked(self, session: Any, frame: int, size: Sequence[int]) -> np.ndarray:
        """Mask (h, w) of a frame; what later frames do not need is dropped."""
        output = self.model(session, frame_idx=frame)
        objects = self.processor.post_process_masks(
            [output.pred_masks.float().cpu()], original_sizes=[list(size)], binarize=True
        )[0]
        session.processed_frames[frame] = torch.empty(0)
        config = self.model.config
        seen_again = max(config.num_maskmem, config.max_object_pointers_in_encoder)
        for outputs in session.output_dict_per_obj.values():
            outputs["non_cond_frame_outputs"].pop(frame - seen_again, None)
        return objects.numpy().astype(bool).any(axis=(0, 1))
