"""Choose one of N candidate control sequences by their predicted videos.

Rolls out the first candidates of one shipped bank with the causal model, chooses, and only then reads the outcomes.

Run: python examples/plan_over_bank.py [--bank bank_close_ur5e] [--candidates 8] [--artifacts FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from flows.pipeline import chain
from tasks.execution.chain import outline, ready_inputs
from worldline_core.config import load_config
from worldline_core.pipeline.pipeline_config import PipelineConfig
from worldline_core.store.artifact_files import read_json
from worldline_core.store.store import ArtifactStore

METHOD = "banks_shipped_causal"


def main() -> None:
    """Run the tasks that planning with one bank needs, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", default="bank_close_ur5e")
    parser.add_argument("--candidates", type=int, default=8)
    parser.add_argument("--artifacts", type=Path, default=Path("artifacts"))
    arguments = parser.parse_args()
    candidates = [f"{arguments.bank}-{number:03d}" for number in range(arguments.candidates)]
    budgets = [n for n in (2, 4, 8, 16, 24, 32) if n <= arguments.candidates]
    config = load_config(
        PipelineConfig,
        preset="demo",
        overrides=[
            f"curate_banks.sources=[{{kind: episode_set, path: artifacts/shipped/banks, include: {candidates}}}]",
            f"evaluate_planning.budgets={budgets}",
        ],
    )
    only_causal = config.model_copy(update={"rollouts": {METHOD: config.rollouts[METHOD]}})
    calls, store = outline(chain, only_causal), ArtifactStore(arguments.artifacts)
    for name in ("curate.banks", "render_actions.banks", f"rollout.{METHOD}", "evaluate_planning"):
        call = calls[name]
        planning = call.task.run(store, call.config, ready_inputs(call, calls, store))
    print(planning.path)
    for method, found in read_json(planning.path / "summary.json")["methods"].items():
        for budget, values in found["budgets"].items():
            success, gain = values["success"]["mean"], values["gain"]["mean"]
            print(
                f"{method:24} N = {budget:>2}: success {success:4.0%}, gain over direct execution {100 * gain:+.0f} points"
            )


if __name__ == "__main__":
    main()
