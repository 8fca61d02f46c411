"""Section "Provenance": configuration, seeds, digests, versions and times of every artifact on the page."""

from __future__ import annotations

import json

from worldline_core.report.context import ReportContext, Section
from worldline_core.report.markup import Column, Html, code, details, element, join, table

TITLE = "Provenance"


def provenance_section(context: ReportContext) -> Section:
    """What each artifact was made from; times and versions come from the run and are filled in when the page opens."""
    names = sorted(context.inputs.folders)
    if not names:
        return Section("provenance", TITLE, missing="no artifact was given.")
    rows: list[list[object]] = []
    configs: list[Html] = []
    for name in names:
        manifest = context.inputs.manifest(name)
        seeds = ", ".join(f"{key} {json.dumps(value)}" for key, value in sorted((manifest.get("seeds") or {}).items()))
        digest = manifest.get("digest")
        rows.append(
            [name, code(str(digest)[:16]) if digest else None, str(manifest.get("version", "")) or None, seeds or None]
        )
        if manifest.get("config") is not None:
            configs.append(
                details(
                    name, element("pre", json.dumps(manifest["config"], indent=2, sort_keys=True, ensure_ascii=False))
                )
            )
    columns = [Column("Artifact"), Column("Digest"), Column("Version"), Column("Seeds")]
    machine = context.slot("machine", machine_table(context, names))
    parts = [
        table(columns, rows, caption="Artifacts that this page shows"),
        element("h3", "Machine and times"),
        machine,
    ]
    if configs:
        parts += [element("h3", "Configurations"), *configs]
    lead = (
        "Digests name the content of every artifact: the same configuration on the same inputs gives the same digests."
    )
    return Section("provenance", TITLE, lead, join(parts))


def machine_table(context: ReportContext, names: list[str]) -> Html:
    """Wall time, device and versions by artifact, from the manifests."""
    rows: list[list[object]] = []
    packages: dict[str, set[str]] = {}
    machines: set[str] = set()
    for name in names:
        manifest = context.inputs.manifest(name)
        if not manifest:
            continue
        environment = manifest.get("environment") or {}
        for package, version in (environment.get("packages") or {}).items():
            packages.setdefault(package, set()).add(str(version))
        if environment:
            python = environment.get("python", "?")
            machines.add(
                f"{environment.get('platform', '?')}, {environment.get('cpu_count', '?')} cores, Python {python}"
            )
        seconds = manifest.get("wall_seconds")
        commit = environment.get("git_commit")
        shown = duration(float(seconds)) if isinstance(seconds, (int, float)) else None
        rows.append(
            [
                name,
                shown,
                "yes" if manifest.get("resumed") else "no",
                manifest.get("finished_at"),
                code(str(commit)) if commit else None,
            ]
        )
    columns = [
        Column("Artifact"),
        Column("Wall time", numeric=True),
        Column("Resumed"),
        Column("Finished"),
        Column("Commit"),
    ]
    versions = ", ".join(f"{name} {'/'.join(sorted(found))}" for name, found in sorted(packages.items()))
    facts = element("dl", element("dt", "Machine"), element("dd", "; ".join(sorted(machines)) or "not recorded"),
                    element("dt", "Packages"), element("dd", versions or "not recorded"), class_="facts")  # fmt: skip
    return join(facts, table(columns, rows)) if rows else facts


def duration(seconds: float) -> str:
    """Seconds in words a reader takes in at once."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
