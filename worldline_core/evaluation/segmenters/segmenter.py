"""Robot segmenters: their protocol, how one is opened by name, SAM 3's video tracker and the classical one.

The classical one is independent of anything learned. What is unlike the table around the projected tool centres of the first frame
says what the robot looks like; GrabCut (Rother et al. 2004) grows from there. Later frames start from the mask of the frame before, with
the colour models of the first frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch

from worldline_core.errors import ArtifactError, UnavailableError
from worldline_core.evaluation.evaluation_config import SegmenterName

MaskStream = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""Masks of the next frames of one video; arguments and result as of `Segmenter.segment`."""


class Segmenter(Protocol):
    """Masks the robot in one video, without knowing of any other video."""

    @property
    def name(self) -> str: ...

    @property
    def description(self) -> str: ...

    @property
    def follows(self) -> bool:
        """True where it tracks the robot from the first frame on, False where it masks each frame by itself."""
        ...

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """Mask the robot in every frame.

        Args:
            video: uint8 (n, h, w, 3) RGB.
            points: (n, p, 2) projected tool centres u, v [px], NaN where invalid; they may only *start* a
                segmentation (the first frame's), never tell where the robot is later. None: no points known.

        Returns:
            bool (n, h, w).
        """
        ...

    def stream(self) -> MaskStream:
        """:meth:`segment` for a video that comes piece by piece."""
        ...


def open_segmenter(name: SegmenterName, *, learned: Path | None, sam3: Path | None) -> Segmenter:
    """A segmenter by name; ``learned`` and ``sam3`` are the folders of their weights.

    Raises:
        ArtifactError: the learned one has no folder.
        UnavailableError: SAM 3 has no local weights.
    """
    if name == "colour":
        return ColourSegmenter()
    if name == "sam3":
        if sam3 is None:
            raise UnavailableError(
                "SAM 3 needs local weights", next_step="set sam3_weights to a downloaded facebook/sam3 folder"
            )
        return Sam3Segmenter.load(sam3)
    from worldline_core.evaluation.segmenters.learned import LearnedSegmenter

    if learned is None:
        raise ArtifactError(
            "The learned segmenter has no weights", expected="an input named segmenter",
            next_step="give artifacts/shipped/models/segmenter, run train_segmenter, or choose segmenters: [colour]",
        )  # fmt: skip
    return LearnedSegmenter.load(learned)


class Sam3Segmenter:
    """Each arm is one tracked object of a Sam3TrackerVideoModel (transformers), prompted by one point; the robot's mask is their union.

    Frames and session state stay on the CPU: long videos otherwise fill the accelerator's memory.
    """

    name = "sam3"
    follows = True
    description = "SAM 3 video tracker, started from the projected tool centres of the first frame"

    def __init__(self, model: Any, processor: Any, *, device: torch.device | str = "cpu") -> None:
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
                "SAM 3 weights not found", where=folder, expected="a downloaded facebook/sam3 folder with config.json",
                next_step="accept the licence and download facebook/sam3, or choose another segmenter",
            )  # fmt: skip
        from transformers.models.sam3_tracker_video import Sam3TrackerVideoModel, Sam3TrackerVideoProcessor

        try:
            model = Sam3TrackerVideoModel.from_pretrained(folder, local_files_only=True)
            processor = Sam3TrackerVideoProcessor.from_pretrained(folder, local_files_only=True)
        except (OSError, ValueError) as error:
            raise UnavailableError("SAM 3 weights cannot be opened", where=folder, got=str(error)) from error
        return cls(model, processor, device=device or ("cuda" if torch.cuda.is_available() else "cpu"))

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """Empty masks where no point of the first frame is valid."""
        return self.stream()(video, points)

    def stream(self) -> MaskStream:
        """Keeps of the frames only what the tracker looks back at."""
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
        start = _inside(points, (height, width))
        if len(video) == 0 or len(start) == 0:
            return None
        session = self.processor.init_video_session(
            video=list(video), inference_device=self.device, inference_state_device="cpu", processing_device="cpu",
            video_storage_device="cpu", dtype=self.dtype,
        )  # fmt: skip
        self.processor.add_inputs_to_inference_session(
            inference_session=session, frame_idx=0, obj_ids=list(range(1, len(start) + 1)),
            input_points=[[[[float(u), float(v)]] for u, v in start]], input_labels=[[[1] for _ in start]],
        )  # fmt: skip
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


def _inside(points: np.ndarray | None, size: Sequence[int]) -> np.ndarray:
    """Points (p, 2) of the first frame that are in the picture; comparisons with NaN are False."""
    start = np.zeros((0, 2)) if points is None or len(points) == 0 else points[0]
    return start[((start >= 0) & (start < np.array(size[::-1]))).all(axis=-1)]


SEED_FRACTION = 0.10  # the robot is surely within this distance of a point, of the frame height
TABLE_DISTANCE = 28.0  # from the frame's median colour, in 8-bit Lab units: farther is no table
REACH_FRACTION = 1.0  # the robot is looked for within this distance of a point, of the frame height
CARRY_FRACTION = 0.12  # how far the robot may move between two frames, of the frame height
_BINS = 12


class ColourSegmenter:
    """GrabCut from points in the first frame, carried from frame to frame."""

    name = "colour"
    follows = True
    description = "colour models and GrabCut, started from the projected tool centres of the first frame"

    def segment(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        """Empty masks where no point of the first frame is valid."""
        return self.stream()(video, points)

    def stream(self) -> MaskStream:
        return _Following().masks


class _Following:
    """One video: colour models of its first frame, and the mask of the frame before."""

    def __init__(self) -> None:
        self._previous: np.ndarray | None = None
        self._foreground, self._background = np.zeros((1, 65)), np.zeros((1, 65))
        self._start: np.ndarray | None = None
        self._colours = np.zeros(0)

    def masks(self, video: np.ndarray, points: np.ndarray | None) -> np.ndarray:
        if self._start is None and len(video):
            self._start = _inside(points, video.shape[1:3])
        masks = np.zeros(video.shape[:3], dtype=bool)
        for frame, mask in zip(video, masks, strict=True):
            mask[:] = self._mask(frame, self._start)
        return masks

    def _mask(self, frame: np.ndarray, start: np.ndarray | None) -> np.ndarray:
        mask = np.zeros(frame.shape[:2], dtype=bool)
        if start is None or len(start) == 0:
            return mask
        lab, begins = cv2.cvtColor(frame, cv2.COLOR_RGB2LAB), self._previous is None
        if self._previous is None:
            cv2.setRNGSeed(0)  # GrabCut starts its colour models by k-means
            labels = self._first_labels(lab, start)
            self._colours = colour_ratio(lab, _robot(labels))
        else:
            labels = self._carried_labels(self._previous, robot_likely(lab, self._colours))
        if _robot(labels).any() and not _robot(labels).all():
            mode = cv2.GC_INIT_WITH_MASK if begins else cv2.GC_EVAL_FREEZE_MODEL
            rounds = 3 if begins else 1
            picture = np.ascontiguousarray(frame[..., ::-1])
            cv2.grabCut(picture, labels, (0, 0, 0, 0), self._background, self._foreground, rounds, mode)
            mask = _robot(labels)
            if begins:
                self._colours = colour_ratio(lab, mask)
        self._previous = mask
        return mask

    def _first_labels(self, lab: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Sure robot: what is unlike the table near the points. Likely robot: what hangs together with it.

        A tool centre lies between the fingers, so the pixel at the point itself often shows the table.
        """
        height, width = lab.shape[:2]
        rows, columns = np.mgrid[:height, :width]
        distance = np.min([np.hypot(columns - u, rows - v) for u, v in points], axis=0)
        table = np.median(lab.reshape(-1, 3), axis=0)
        unlike = np.linalg.norm(lab.astype(np.float64) - table, axis=-1) > TABLE_DISTANCE
        seeds = unlike & (distance <= SEED_FRACTION * height)
        if not seeds.any():
            seeds = distance <= max(1.5, 0.4 * SEED_FRACTION * height)
        _, components = cv2.connectedComponents((unlike | seeds).astype(np.uint8))
        robot = np.isin(components, np.unique(components[seeds])) & (distance < REACH_FRACTION * height)
        labels = np.full((height, width), cv2.GC_PR_BGD, dtype=np.uint8)
        labels[distance >= REACH_FRACTION * height] = cv2.GC_BGD
        labels[robot] = cv2.GC_PR_FGD
        labels[seeds] = cv2.GC_FGD
        return labels

    def _carried_labels(self, previous: np.ndarray, likely: np.ndarray) -> np.ndarray:
        """Likely robot where colours fit near the previous mask; far from it is background."""
        size = 2 * max(1, round(CARRY_FRACTION * previous.shape[0])) + 1
        near = cv2.dilate(previous.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
        labels = np.full(previous.shape, cv2.GC_BGD, dtype=np.uint8)
        labels[near] = cv2.GC_PR_BGD
        labels[near & likely] = cv2.GC_PR_FGD
        return labels


def _robot(labels: np.ndarray) -> np.ndarray:
    """Sure and likely foreground of GrabCut's labels."""
    return (labels & cv2.GC_FGD).astype(bool)  # GC_FGD is 1 and GC_PR_FGD is 3; background labels are even


def colour_ratio(lab: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Log ratio of the colour histograms inside and outside of ``mask``: (bins, bins, bins), above 0 is robot-like."""
    edges = [(0, 256)] * 3
    inside, _ = np.histogramdd(lab[mask], bins=_BINS, range=edges)
    outside, _ = np.histogramdd(lab[~mask], bins=_BINS, range=edges)
    inside, outside = (cv2.GaussianBlur(h.astype(np.float32), (3, 3), 0.8) for h in (inside, outside))
    return np.log((inside / max(1.0, float(inside.sum())) + 1e-5) / (outside / max(1.0, float(outside.sum())) + 1e-5))


def robot_likely(lab: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Pixels whose colour is more frequent inside the robot than outside (h, w)."""
    index = np.clip(lab.astype(np.int32) * _BINS // 256, 0, _BINS - 1)
    return ratio[index[..., 0], index[..., 1], index[..., 2]] > 0
