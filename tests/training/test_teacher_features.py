"""Teacher features inside of a training step's autocast."""

from __future__ import annotations

from collections import OrderedDict

import torch

from worldline_core.training.clip_source import Clip
from worldline_core.training.relational import TeacherFeatures


def test_cached_features_are_handed_on_in_single_precision_under_autocast() -> None:
    features = TeacherFeatures.__new__(TeacherFeatures)
    clips = [Clip("a", 0, 5, 1), Clip("b", 0, 5, 1)]
    stored = {(clip, ("head",)): torch.randn(1, 2, 4, 6, 8).half() for clip in clips}
    features._cache = OrderedDict(stored)
    with torch.autocast("cpu", torch.bfloat16):
        result = features.features(clips, ("head",))
    assert result.dtype == torch.float32
    assert torch.equal(result[1].half(), stored[clips[1], ("head",)])
