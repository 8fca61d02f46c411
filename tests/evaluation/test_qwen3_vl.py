"""Qwen3-VL with transformers' own classes at a very small random size: everything but the weights is the real path."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers import LogitsProcessor, LogitsProcessorList

from worldline_core.errors import UnavailableError
from worldline_core.evaluation.evaluation_config import VLMConfig
from worldline_core.evaluation.policy.evidence import GraspEvidence, MotionEvidence, establishes_success
from worldline_core.evaluation.policy.judge import VLMJudge
from worldline_core.evaluation.recordings import Trajectory
from worldline_core.evaluation.vlm import MAX_NEW_TOKENS, Image, Qwen3VLModel, Text, Video, open_vlm
from worldline_core.rehearsal.outside_models import write_qwen3_vl

HEIGHT_PX = 64


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("qwen3-vl")
    torch.manual_seed(0)
    write_qwen3_vl(folder)
    return folder


class Calls:
    """The real `generate`, with what it was given and, on request, the answer it is led to."""

    def __init__(self, model: Any, tokenizer: Any) -> None:
        self.inner = model.generate
        self.tokenizer = tokenizer
        self.inputs: list[dict[str, Any]] = []
        self.answer: str | None = None
        self.outputs: list[torch.Tensor] = []

    def __call__(self, **inputs: Any) -> torch.Tensor:
        self.inputs.append(inputs)
        leading = []
        if self.answer is not None:
            tokens = [*self.tokenizer(self.answer)["input_ids"], self.tokenizer.eos_token_id]
            leading = [Leading(tokens, inputs["input_ids"].shape[1])]
        self.outputs.append(self.inner(**inputs, logits_processor=LogitsProcessorList(leading)))
        return self.outputs[-1]


class Leading(LogitsProcessor):
    """Makes the model say given tokens, then end: what weights would have to be trained for."""

    def __init__(self, tokens: list[int], prompt: int) -> None:
        self.tokens, self.prompt = tokens, prompt

    def __call__(self, input_ids: torch.Tensor, scores: torch.Tensor) -> torch.Tensor:
        wanted = self.tokens[input_ids.shape[1] - self.prompt]
        return torch.full_like(scores, float("-inf")).index_fill(1, torch.tensor([wanted]), 0.0)


@pytest.fixture
def opened(folder: Path) -> tuple[Qwen3VLModel, Calls]:
    model = open_vlm("qwen3_vl", VLMConfig(weights=folder))
    assert isinstance(model, Qwen3VLModel)
    calls = Calls(model.model, model.processor.tokenizer)
    model.model.generate = calls
    return model, calls


@pytest.fixture
def trajectory() -> Trajectory:
    random = np.random.default_rng(0)
    frames = {
        view: random.integers(0, 256, (20, 48, 64, 3), dtype=np.uint8) for view in ("head", "left_wrist", "right_wrist")
    }
    return Trajectory("lift the red cube", frames, 8.0)  # pyright: ignore[reportArgumentType]


def test_generation_is_greedy_bounded_and_sees_every_picture(opened: tuple[Qwen3VLModel, Calls]) -> None:
    model, calls = opened
    picture = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    parts = [Text("what?"), Image(picture), Text("and"), Image(picture[:32])]
    answer = model.answer(parts)
    assert model.answer(parts) == answer
    assert model.answer([Text("what?"), Image(255 - picture), Text("and"), Image(picture[:32])]) is not None
    first, _, changed = calls.inputs
    assert (first["do_sample"], first["max_new_tokens"]) == (False, MAX_NEW_TOKENS)
    # Patches of 8 pixels: 8 x 12 and 4 x 12 of them, four of which become one token.
    assert first["image_grid_thw"].tolist() == [[1, 8, 12], [1, 4, 12]]
    image_token = model.processor.image_token_id
    assert int((first["input_ids"] == image_token).sum()) == (8 * 12 + 4 * 12) // 4
    assert not torch.equal(first["pixel_values"], changed["pixel_values"])
    prompt = model.processor.tokenizer.decode(first["input_ids"][0])
    assert prompt.startswith("<|im_start|>user\nwhat?<|vision_start|><|image_pad|>")
    assert prompt.endswith("<|im_end|>\n<|im_start|>assistant\n")
    new = calls.outputs[0].shape[1] - first["input_ids"].shape[1]
    assert 1 <= new <= MAX_NEW_TOKENS
    assert model.model.dtype == torch.bfloat16


def test_chosen_frames_of_a_video_are_shown_as_they_are_at_their_times(opened: tuple[Qwen3VLModel, Calls]) -> None:
    model, calls = opened
    frames = np.random.default_rng(0).integers(0, 256, (20, 32, 48, 3), dtype=np.uint8)
    chosen = (0, 5, 11, 19)
    model.answer([Video(frames[list(chosen)], chosen, 8.0, 20), Text("what happens?")])
    inputs = calls.inputs[0]
    # Two frames make one temporal patch; sampling again would have left fewer of them.
    assert inputs["video_grid_thw"].tolist() == [[2, 4, 6]]
    prompt = model.processor.tokenizer.decode(inputs["input_ids"][0])
    # Mean time of frames 0 and 5, and of 11 and 19, at eight a second.
    assert [float(part.split(" seconds>")[0]) for part in prompt.split("<") if " seconds>" in part] == [0.3, 1.9]


def test_a_readable_answer_becomes_evidence(opened: tuple[Qwen3VLModel, Calls], trajectory: Trajectory) -> None:
    model, calls = opened
    judge = VLMJudge(model)
    facts = {"target_held_for_two_late_steps": True, "wrong_object_or_drop": False}
    calls.answer = f"```json\n{json.dumps(facts)}\n```"
    grasp = judge.extract(trajectory, "grasp", (0, 10, 19), HEIGHT_PX)
    assert grasp.well_formed
    assert isinstance(grasp.evidence, GraspEvidence)
    assert establishes_success(grasp.evidence)
    # A grasp's facts are no lift's evidence, and words instead of facts are none.
    assert not judge.extract(trajectory, "lift", (0, 19), HEIGHT_PX).well_formed
    calls.answer = '{"target_held_for_two_late_steps": "true"}'
    spoken = judge.extract(trajectory, "grasp", (0, 19), HEIGHT_PX)
    assert (spoken.well_formed, spoken.evidence) == (False, GraspEvidence())
    calls.answer = '{"task_effect_completed": true, "observations": "it went up"}'
    motion = judge.inspect_motion(trajectory, (0, 10, 19), "nothing earlier")
    assert (motion.well_formed, motion.evidence) == (
        True, MotionEvidence(task_effect_completed=True, observations="it went up"),
    )  # fmt: skip
    calls.answer = '{"observations_prove_completion": false, "reason": "held, not placed"}'
    assert judge.reconcile(trajectory, "grasp", "{}", "{}").evidence.observations_prove_completion is False
    # One image a time step for grasps, one a view and time step for lifts, one video a view for motion.
    counts = [(len(inputs.get("image_grid_thw", ())), len(inputs.get("video_grid_thw", ()))) for inputs in calls.inputs]
    assert counts == [(3, 0), (6, 0), (2, 0), (0, 3), (0, 0)]


def test_a_folder_without_readable_weights_is_named(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    with pytest.raises(UnavailableError, match="Qwen3-VL weights cannot be opened"):
        Qwen3VLModel.load(tmp_path)
