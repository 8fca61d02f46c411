"""Embodiments in words: the list of all, one in full, and what a check found."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from worldline_core.errors import WorldLineError
from worldline_core.geometry.description import description_variable
from worldline_core.geometry.embodiment import Arm, Embodiment, embodiment_names, load_embodiment
from worldline_core.geometry.embodiment_check import (
    POSITION_TOLERANCE_M,
    ROTATION_TOLERANCE_RAD,
    EmbodimentCheck,
)


def list_embodiments() -> list[dict[str, Any]]:
    """One row an embodiment: arms, joints, state size, whether its description is here, whether it is verified."""
    return [_row(name) for name in embodiment_names()]


def _row(name: str) -> dict[str, Any]:
    try:
        embodiment = load_embodiment(name)
    except WorldLineError as error:
        # A package in another version makes one robot unusable, not the list of the others.
        return {"name": name, "found": False, "problem": str(error)}
    description = embodiment.description
    found = embodiment.description_path.is_file()
    kind = f"package {description.package}" if description.package else "shipped" if found else "your file"
    return {
        "name": name,
        "arms": [arm.name for arm in embodiment.arms],
        "joints": [len(arm.joints) for arm in embodiment.arms],
        "state_size": embodiment.state_size,
        "wrist_cameras": [arm.camera_view for arm in embodiment.arms if arm.wrist_camera is not None],
        "description": kind,
        "found": found,
        "path": str(embodiment.description_path),
        "how_to_get": None if found else _how_to_get(embodiment),
        "verified": embodiment.verified,
        "unverified_reason": embodiment.unverified_reason,
    }


def _how_to_get(embodiment: Embodiment) -> str:
    description = embodiment.description
    ways = [description.how_to_get] if description.how_to_get else []
    if description.package is None:
        ways.append(f"then set {description_variable(embodiment.name)}=/path/to/it")
    return "; ".join(ways)


def format_list(rows: list[dict[str, Any]]) -> str:
    """A table for people, and below it what is missing or not verified."""
    cells = [("name", "arms (joints)", "state", "wrist cameras", "description", "verified")]
    notes: list[str] = []
    for row in rows:
        if "problem" in row:
            cells.append((row["name"], "-", "-", "-", "not usable", "-"))
            notes.append(f"{row['name']}: {row['problem']}")
            continue
        arms = ", ".join(f"{arm} ({joints})" for arm, joints in zip(row["arms"], row["joints"], strict=True))
        found = row["description"] if row["found"] else f"{row['description']}: not here"
        cells.append(
            (row["name"], arms, str(row["state_size"]), ", ".join(row["wrist_cameras"]) or "-", found,
             "yes" if row["verified"] else "no")
        )  # fmt: skip
        if not row["found"]:
            notes.append(f"{row['name']}: {row['how_to_get']}")
        if not row["verified"]:
            notes.append(f"{row['name']}: not verified: {row['unverified_reason']}")
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([*lines, *([""] if notes else []), *notes])


def describe_embodiment(embodiment: Embodiment) -> str:
    """Everything that the file says, for people."""
    description = embodiment.description
    here = "" if embodiment.description_path.is_file() else f" (not here: {_how_to_get(embodiment)})"
    lines = [
        f"{embodiment.name}: state of {embodiment.state_size} columns, angles in {embodiment.joint_units}, "
        f"poses in {embodiment.base_link}",
        f"  description  {description.format}, {embodiment.description_path}{here}",
        *([f"  source       {description.source}"] if description.source else []),
        f"  verified     {'yes' if embodiment.verified else f'no: {embodiment.unverified_reason}'}",
    ]
    lines += [
        f"  mount        {name}: {offset.translation} m, wxyz {offset.rotation_wxyz}"
        for name, offset in description.mounts.items()
    ]
    if embodiment.posture:
        lines.append("  posture      " + ", ".join(f"{name} {value:g}" for name, value in embodiment.posture.items()))
    for arm in embodiment.arms:
        lines += _describe_arm(embodiment, arm)
    return "\n".join(lines)


def _describe_arm(embodiment: Embodiment, arm: Arm) -> list[str]:
    start = embodiment.joint_columns(arm).start
    width = max(len(joint) for joint in arm.joints)
    tool = arm.T_link_tool
    lines = [f"  arm {arm.name}"]
    for number, (joint, (low, high)) in enumerate(zip(arm.joints, arm.limits, strict=True)):
        limits = "no limits" if (low, high) == (-math.inf, math.inf) else f"{low:g} to {high:g}"
        lines.append(f"    column {start + number:<3} {joint:<{width}}  {limits}")
    gripper = arm.gripper
    fingers = ", ".join(f"{f.name} {f.closed:g} to {f.open:g}" for f in gripper.finger_joints) or "no finger joints"
    lines += [
        f"    column {embodiment.gripper_column(arm):<3} {'gripper':<{width}}  {gripper.closed:g} closed, "
        f"{gripper.open:g} open; {fingers}",
        f"    tool       in {arm.end_effector_link}: {tool.translation} m, wxyz {tool.rotation_wxyz}",
    ]
    if arm.wrist_camera is not None:
        lines.append(f"    camera     {arm.camera_view} in {arm.wrist_camera.link}")
    return lines


def format_check(check: EmbodimentCheck) -> str:
    """The errors of a check as a table, the verdict last."""
    rows = [
        f"  {e.kind:<12} {e.frame:<36} {e.max_position_m:>9.1e} {e.mean_position_m:>9.1e} "
        f"{e.max_rotation_rad:>9.1e} {e.mean_rotation_rad:>9.1e}  {'ok' if e.passed else 'FAILED'}"
        for e in check.errors
    ]
    head = [
        f"{check.name}: forward kinematics against {check.engine}, {check.samples} random joint positions (seed "
        f"{check.seed})",
        f"  {'frame':<49} {'max m':>9} {'mean m':>9} {'max rad':>9} {'mean rad':>9}",
    ]
    verdict = "passed" if check.passed else "FAILED"
    return "\n".join(
        [
            *head,
            *rows,
            *(f"  note: {note}" for note in check.notes),
            f"  {verdict}: the limit is {POSITION_TOLERANCE_M:g} m and {ROTATION_TOLERANCE_RAD:g} rad",
        ]
    )


def check_as_json(check: EmbodimentCheck) -> dict[str, Any]:
    """The same as plain values."""
    values = asdict(check)
    values["errors"] = [{**error, "passed": e.passed} for error, e in zip(values["errors"], check.errors, strict=True)]
    tolerances = {"position_m": POSITION_TOLERANCE_M, "rotation_rad": ROTATION_TOLERANCE_RAD}
    return {**values, "tolerances": tolerances, "passed": check.passed}
