"""The teacher's similarities inside of a training step's autocast."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, cast

import pytest
import torch

from worldline_core.training.clip_sampler import Clip
from worldline_core.training.relational import TeacherSimilarities, similarity_matrices


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_batch_of_cached_relations_is_what_was_kept_under_autocast(dtype: torch.dtype) -> None:
    source = TeacherSimilarities.__new__(TeacherSimilarities)
    clips = [Clip("a", 0, 5, 1), Clip("b", 0, 5, 1)]
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        stored = {(clip, ("head",)): similarity_matrices(torch.randn(1, 1, 2, 4, 6, 8), (2, 2, 3)) for clip in clips}
        cast("Any", source)._cache = OrderedDict(stored)
        result = source.similarities(clips, ("head",), (2, 4, 6))
    assert result.intra.dtype == dtype
    assert torch.equal(result.intra[1], stored[clips[1], ("head",)].intra[0])
