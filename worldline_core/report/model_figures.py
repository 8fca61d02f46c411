"""Figures of a model from finished evaluations, for its card."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from worldline_core.evaluation.metric_registry import METRICS
from worldline_core.evaluation.paired import EVALUATIONS, collect_metrics
from worldline_core.model.model_card import Measurement
from worldline_core.report.context import SPLIT_LABELS, method, share_interval
from worldline_core.store.artifact_files import finished_artifacts, linked_folder, read_manifest, verify_artifact

VIDEO_METRICS = ("robot_iou_exact", "robot_iou", "object_iou_exact", "ssim", "psnr", "lpips")


def evaluations_of_store(store: Path) -> list[Path]:
    """Finished evaluations of a store, the oldest first."""
    found = [folder for folder in finished_artifacts(store) if folder.parent.name in EVALUATIONS]
    return sorted(found, key=lambda folder: str(read_manifest(folder).get("finished_at")))


def measurements(model: Path, evaluations: Iterable[Path]) -> Sequence[Measurement]:
    """Headline figures of a model: of the rollouts whose manifest names its digest, with the recorded controls.

    Args:
        evaluations: finished ones; a later one counts where two measured the same.

    Raises:
        ArtifactError: an evaluation is damaged.
    """
    digest, found = read_manifest(model).get("digest"), dict[tuple[str, str], Measurement]()
    for folder in evaluations:
        verify_artifact(folder)
        manifest = read_manifest(folder)
        key = f"{manifest.get('step')}/{manifest.get('key')}"
        values = collect_metrics({str(manifest.get("step")): folder})
        most = max((int(name.split("/")[1][2:]) for name in values if name.startswith("planning/")), default=0)
        for name, value in values.items():
            what, group, videos, metric = name.split("/", 3)
            metric, _, view = metric.partition("@")
            if what == "video" and (metric not in VIDEO_METRICS or view != "head"):
                continue
            if group not in SPLIT_LABELS and group not in ("all", f"N={most}"):
                continue
            rollout = linked_folder(folder, f"rollouts.{videos}")
            made_by = {} if rollout is None else read_manifest(rollout).get("inputs", {}).get("checkpoint", {})
            shown = method(videos)
            if made_by.get("digest") != digest or digest is None or shown.kind.endswith(("_zero", "_shuffled")):
                continue
            label = {"accuracy": "outcomes judged rightly", "success": f"plans that succeed, best of {most}"}.get(
                metric
            )
            label = label or f"{METRICS[metric].title}, head view"
            label += f", {shown.label}" if "steps" in videos else ""
            recordings = {"all": "all splits", f"N={most}": "candidate banks"}.get(group) or SPLIT_LABELS[group]
            bounds = {"mean": value.mean, "low": value.low, "high": value.high, "count": value.count}
            bounds = bounds if what == "video" else share_interval(bounds) or bounds
            found[label, recordings] = Measurement(label, recordings, **bounds, source=key)
    return [found[name] for name in sorted(found)]
