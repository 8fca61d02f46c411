"""Default precision on processors with and without native bfloat16."""

from __future__ import annotations

import pytest

from worldline_core import processor
from worldline_core.config import validate
from worldline_core.errors import ConfigError
from worldline_core.evaluation.evaluation_config import JudgeConfig
from worldline_core.rollout.rollout_config import RolloutConfig
from worldline_core.serving.serve_config import ServeConfig
from worldline_core.training.training_config import TokenizerConfig, TrainerConfig

PROCESSORS = {
    "model name\t: Sapphire\nflags\t\t: fpu avx512f avx512_bf16 amx_bf16 amx_tile": ("Sapphire", True),
    "model name\t: Zen 4\nflags\t\t: fpu avx512f avx512_bf16": ("Zen 4", True),
    "model name\t: Cascade Lake\nflags\t\t: fpu avx2 avx512f avx512_vnni": ("Cascade Lake", False),
    "model name\t: Zen 3\nflags\t\t: fpu avx avx2 fma": ("Zen 3", False),
}


@pytest.mark.parametrize("facts", PROCESSORS)
def test_bfloat16_is_the_default_where_the_device_has_it(facts: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processor, "_first_core", lambda: facts)
    name, has = PROCESSORS[facts]
    assert (processor.processor_name(), processor.processor_has_bfloat16()) == (name, has)
    for model in (RolloutConfig, ServeConfig, TokenizerConfig):
        assert model().bfloat16 is has
        assert model(device="cuda:1").bfloat16
        assert not model(device="cuda", bfloat16=False).bfloat16
    assert TokenizerConfig().trainer.precision == JudgeConfig().trainer.precision == ("bf16" if has else "fp32")
    assert RolloutConfig(weights="bfloat16").bfloat16
    assert TrainerConfig(steps=1).precision == ("bf16" if has else "fp32")
    assert TrainerConfig(steps=1, device="cuda").precision == TrainerConfig(steps=1, weights="bf16").precision == "bf16"
    assert TrainerConfig(steps=1, precision="bf16").precision == "bf16"


def test_a_mistake_beside_it_is_named_alone() -> None:
    with pytest.raises(ConfigError, match=r"got: \n    device: [^\n]*\(got 3\)$"):
        validate(RolloutConfig, {"device": 3}, where="a file")
