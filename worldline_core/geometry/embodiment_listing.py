"""Embodiments for people: the list of all, and one in full."""

from __future__ import annotations

import math
from typing import Any

from worldline_core.errors import WorldLineError
from worldline_core.geometry.embodiment import Arm, Embodiment, embodiment_names, how_to_get, load_embodiment


def list_embodiments() -> list[dict[str, Any]]:
    """One row per embodiment: arms, joints, state size, whether its description is here, whether it is verified."""
    return [_row(name) for name in embodiment_names()]


def _row(name: str) -> dict[str, Any]:
    try:
        embodiment = load_embodiment(name)
    except WorldLineError as error:
        # A package in another version makes one robot unusable, not the list of the others.
        return {"name": name, "found": False, "problem": str(error)}
    description = embodiment.description
    found = embodiment.description_path.is_file()
    return {
        "name": name,
        "arms": [arm.name for arm in embodiment.arms],
        "joints": [len(arm.joints) for arm in embodiment.arms],
        "state_size": embodiment.state_size,
        "wrist_cameras": [arm.camera_view for arm in embodiment.arms if arm.wrist_camera is not None],
        "description": f"package {description.package}" if description.package else "shipped" if found else "your file",
        "found": found,
        "path": str(embodiment.description_path),
        "how_to_get": None if found else how_to_get(embodiment),
        "verified": embodiment.verified,
        "unverified_reason": embodiment.unverified_reason,
    }


def format_list(rows: list[dict[str, Any]]) -> str:
    """A table for people, and below it what is missing or not verified."""
    cells = [("name", "arms (joints)", "state", "wrist cameras", "description", "verified")]
    notes: list[str] = []
    for row in rows:
        name = row["name"]
        if "problem" in row:
            cells.append((name, "-", "-", "-", "not usable", "-"))
            notes.append(f"{name}: {row['problem']}")
            continue
        arms = ", ".join(f"{arm} ({joints})" for arm, joints in zip(row["arms"], row["joints"], strict=True))
        wrists, verified = ", ".join(row["wrist_cameras"]) or "-", "yes" if row["verified"] else "no"
        found = row["description"] if row["found"] else f"{row['description']}: not here"
        cells.append((name, arms, str(row["state_size"]), wrists, found, verified))
        notes += [] if row["found"] else [f"{name}: {row['how_to_get']}"]
        notes += [] if row["verified"] else [f"{name}: not verified: {row['unverified_reason']}"]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([*lines, *([""] if notes else []), *notes])


def describe_embodiment(embodiment: Embodiment) -> str:
    """Everything that the file says, for people."""
    description = embodiment.description
    here = "" if embodiment.description_path.is_file() else f" (not here: {how_to_get(embodiment)})"
    lines = [
        f"{embodiment.name}: state of {embodiment.state_size} columns, angles in {embodiment.joint_units}, "
        f"poses in {embodiment.base_link}",
        f"  description  {description.format}, {embodiment.description_path}{here}",
        *([f"  source       {description.source}"] if description.source else []),
        f"  verified     {'yes' if embodiment.verified else f'no: {embodiment.unverified_reason}'}",
    ]
    for name, offset in description.mounts.items():
        lines.append(f"  mount        {name}: {offset.translation} m, wxyz {offset.rotation_wxyz}")
    if embodiment.posture:
        lines.append("  posture      " + ", ".join(f"{name} {value:g}" for name, value in embodiment.posture.items()))
    return "\n".join(lines + [line for arm in embodiment.arms for line in _describe_arm(embodiment, arm)])


def _describe_arm(embodiment: Embodiment, arm: Arm) -> list[str]:
    width = max(len(joint) for joint in arm.joints)
    rows = zip(arm.joints, arm.limits, strict=True)
    lines = [f"  arm {arm.name}"]
    for number, (joint, (low, high)) in enumerate(rows, embodiment.joint_columns(arm).start):
        limits = "no limits" if (low, high) == (-math.inf, math.inf) else f"{low:g} to {high:g}"
        lines.append(f"    column {number:<3} {joint:<{width}}  {limits}")
    gripper, tool = arm.gripper, arm.T_link_tool
    fingers = ", ".join(f"{f.name} {f.closed:g} to {f.open:g}" for f in gripper.finger_joints) or "no finger joints"
    lines += [
        f"    column {embodiment.gripper_column(arm):<3} {'gripper':<{width}}  {gripper.closed:g} closed, "
        f"{gripper.open:g} open; {fingers}",
        f"    tool       in {arm.end_effector_link}: {tool.translation} m, wxyz {tool.rotation_wxyz}",
    ]
    if arm.wrist_camera is not None:
        lines.append(f"    camera     {arm.camera_view} in {arm.wrist_camera.link}")
    return lines
