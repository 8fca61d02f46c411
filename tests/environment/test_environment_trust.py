"""How far the judge of an environment is to be trusted, by a saved calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from worldline_core.environment.environment import WorldLineEnv
from worldline_core.environment.starts import EpisodeStarts
from worldline_core.errors import ConfigError
from worldline_core.evaluation.policy.trust import (
    JudgedBy,
    KnownRecordings,
    PredictedBy,
    TrustCalibration,
    TrustModel,
    content_digest,
    control_vectors,
    setup_vectors,
)

ROBOT = "ur5e_silver"


def test_info_says_how_far_the_judge_is_to_be_trusted(project_root: Path, tmp_path: Path) -> None:
    shipped = project_root / "artifacts" / "shipped"
    starts = EpisodeStarts(shipped / "recordings", embodiment=ROBOT, splits=("test",), views=("head",), fps=8.0)
    options: dict[str, Any] = {"embodiment": ROBOT, "views": ["head"], "episode_frames": 16}
    moves = starts.commands(0)[:16]

    def played(environment: WorldLineEnv, rows: np.ndarray) -> dict[str, Any]:
        assert "trust" not in environment.reset(seed=0)[1]
        return [environment.step(row)[4] for row in rows][-1]

    plain = WorldLineEnv(**options)
    played(plain, moves)
    seen = plain.vector._episodes[0].tracks
    random = np.random.default_rng(0)
    arms, vectors = control_vectors(
        np.concatenate([t.T_base_tool for t in seen]), np.concatenate([t.gripper[:, 0] for t in seen])
    )
    body, place = setup_vectors(seen[0])
    near = [0.01 * random.normal(size=vectors.shape) for _ in range(8)]
    saved = TrustModel(
        judged_by=JudgedBy(
            judge="measured", views=("head",), segmenter="learned",
            segmenter_weights=content_digest(shipped / "models" / "segmenter"),
        ),
        embodiments=(ROBOT,), least_trust=0.6, novelty_level=0.05, training_recordings=8,
        methods={"causal": TrustCalibration(
            predicted_by=PredictedBy(
                checkpoint=content_digest(shipped / "models" / "causal"), sampler="block_causal", steps=None
            ),
            signals=("doubt", "new_controls"), weights=(2.0, 0.0, -0.5),
        )},
        controls=KnownRecordings.of([(arms, vectors), *((arms, vectors + noise) for noise in near)]),
        setups=KnownRecordings.of([(body, place + 0.01 * random.normal(size=place.shape)) for _ in range(8)]),
    )  # fmt: skip
    saved.write(tmp_path)
    environment = WorldLineEnv(trust=tmp_path, **options)
    usual = played(environment, moves)
    assert usual["do_not_trust"] == ""
    assert usual["trust"] == pytest.approx(1 / (1 + np.exp(-2 + 0.5 * np.log(0.1))))
    strange = played(environment, np.repeat(moves[-1:], 16, axis=0))
    assert strange["do_not_trust"].startswith("new controls")
    assert strange["trust"] < usual["trust"]

    with pytest.raises(ConfigError, match="success None"):
        WorldLineEnv(trust=tmp_path, **options, success=None)
    with pytest.raises(ConfigError, match="steps=2"):
        WorldLineEnv(trust=tmp_path, **options, steps=2)
    options["embodiment"] = "viperx_pearl"
    with pytest.raises(ConfigError, match="other robots: viperx_pearl"):
        WorldLineEnv(trust=tmp_path, **options)
