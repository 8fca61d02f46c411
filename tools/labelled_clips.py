"""Labelled clips: a healthy recording spoiled in one known way, to measure the filters with.

Each function takes a healthy clip and a random generator and returns the clip with one fault, and which frames carry it.
Faults are drawn at many severities. They are what a filter meets in the field: encoders and cameras that are noisy,
pictures that are compressed again afterwards. No filter reads this module.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from tools.picture_faults import (
    blurred,
    brightened,
    darkened,
    garbled,
    moving_background,
    noisy,
)
from worldline_core.data.episodes.episode import Episode

Frames = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Clip:
    """A recording with what is known about it.

    Attributes:
        frames: by view, uint8 (n, H, W, 3). masks: by view, bool (n, h, w), the robot, where they are known.
        fault: name of the fault, "" for none. bad: bool (n,) frames that carry it; all of them for faults of a whole episode.
        severity: what was drawn, in words.
    """

    episode: Episode
    frames: Frames
    masks: Frames
    fault: str = ""
    bad: np.ndarray | None = None
    severity: str = ""


def at_frames(clip: Clip, index: np.ndarray) -> Clip:
    """The clip at frame numbers (which may repeat); time stays even."""
    episode = clip.episode
    cameras = {
        view: replace(camera, T_base_camera=camera.T_base_camera[index]) if camera.moving else camera
        for view, camera in episode.cameras.items()
    }
    moved = replace(
        episode,
        state=episode.state[index],
        action=episode.action[index],
        timestamps=np.arange(len(index)) / episode.fps,
        cameras=cameras,
        T_base_ee=None if episode.T_base_ee is None else episode.T_base_ee[index],
        gripper=None if episode.gripper is None else episode.gripper[index],
    )
    frames = {view: images[index] for view, images in clip.frames.items()}
    return replace(clip, episode=moved, frames=frames, masks={view: m[index] for view, m in clip.masks.items()})


def _joint_columns(episode: Episode) -> list[int]:
    return [i for i, name in enumerate(episode.state_names or ()) if not name.endswith("gripper")]


def with_sensor_noise(clip: Clip, random: np.random.Generator) -> Clip:
    """Encoders noisy by up to 0.002 rad and cameras by up to 2 grey levels (standard deviations)."""
    radians, levels = random.choice([0.0, 0.0005, 0.002]), random.choice([0.0, 1.0, 2.0])
    state = clip.episode.state + random.normal(0, radians, clip.episode.state.shape).astype(np.float32)
    frames = {view: noisy(images, levels, random) for view, images in clip.frames.items()} if levels else clip.frames
    severity = f"{clip.severity}; encoders {radians} rad, camera {levels} levels".lstrip("; ")
    return replace(clip, episode=replace(clip.episode, state=state), frames=frames, severity=severity)


def static(clip: Clip, random: np.random.Generator) -> Clip:
    """The robot stands for 1.75 to 4 s before, in, or after the clip."""
    count = clip.episode.num_frames
    length = int(random.integers(round(1.75 * clip.episode.fps), round(4 * clip.episode.fps) + 1))
    start = int(random.choice([0, int(random.integers(4, count - 4)), count - 1]))
    index = np.concatenate([np.arange(start), np.full(length, start), np.arange(start, count)])
    bad = np.zeros(len(index), bool)
    bad[start : start + length] = True
    standing = replace(at_frames(clip, index), fault="static", bad=bad, severity=f"{length} frames from {start}")
    return with_sensor_noise(standing, random)


def short_pause(clip: Clip, random: np.random.Generator) -> Clip:
    """A pause of up to a second between two motions, which belongs to manipulation: no fault."""
    count = clip.episode.num_frames
    length = int(random.integers(2, round(clip.episode.fps) + 1))
    start = int(random.choice(_moving(clip, 4, count - 4, quickest=0.12)))
    index = np.concatenate([np.arange(start), np.full(length, start), np.arange(start, count)])
    return with_sensor_noise(replace(at_frames(clip, index), severity=f"pause of {length} frames"), random)


def reset(clip: Clip, random: np.random.Generator) -> Clip:
    """The arms return to the first pose, at once or within 0.5 s, and a second attempt follows in the same file."""
    count = clip.episode.num_frames
    joints = clip.episode.state[:, _joint_columns(clip.episode)]
    away = np.abs(joints - joints[0]).max(axis=1)
    far = np.flatnonzero(away > 0.5 * away.max())
    end = int(random.choice(far[len(far) // 2 :]))
    steps = int(random.integers(1, round(0.5 * clip.episode.fps) + 1))
    back = np.linspace(end, 0, steps + 1).round().astype(int)[1:-1]
    again = np.arange(int(random.integers(count // 3, count)))
    index = np.concatenate([np.arange(end + 1), back, again])
    bad = np.arange(len(index)) > end
    severity = f"home from frame {end} in {steps} steps"
    return with_sensor_noise(replace(at_frames(clip, index), fault="reset", bad=bad, severity=severity), random)


def there_and_back(clip: Clip, random: np.random.Generator) -> Clip:
    """The arms turn in the middle of a motion and return at the speed at which they came: no fault."""
    count = clip.episode.num_frames
    turn = int(random.choice(_moving(clip, count // 2, count - 2)))
    index = np.concatenate([np.arange(turn + 1), np.arange(turn - 1, -1, -1)])
    return with_sensor_noise(replace(at_frames(clip, index), severity="reversed at the end"), random)


def _moving(clip: Clip, start: int, stop: int, quickest: float = np.inf) -> np.ndarray:
    """Frames of start..stop beside which the robot moves: not slower than 0.03 rad a frame, not quicker than `quickest`.

    Where there are none, the one that comes closest to it.
    """
    joints = clip.episode.state[:, _joint_columns(clip.episode)]
    steps = np.abs(np.diff(joints, axis=0)).max(axis=1)
    before, after = steps[start - 1 : stop - 1], steps[start:stop]
    fits = (np.minimum(before, after) >= 0.03) & (np.maximum(before, after) <= quickest)
    found = np.flatnonzero(fits) + start
    return found if len(found) else np.array([start + int(np.argmax(np.minimum(before, after)))])


def _stretch(clip: Clip, random: np.random.Generator, shortest: int, longest: int) -> tuple[int, int]:
    count = clip.episode.num_frames
    length = min(int(random.integers(shortest, longest + 1)), count - 3)
    start = int(random.integers(2, count - length + 1))
    return start, start + length


def _spoil(
    clip: Clip,
    random: np.random.Generator,
    fault: str,
    severity: str,
    span: tuple[int, int],
    change: Callable[[np.ndarray], np.ndarray],
) -> Clip:
    """The task-facing view changed over a stretch of frames."""
    view = clip.episode.primary_view
    images = clip.frames[view].copy()
    images[slice(*span)] = change(images[slice(*span)])
    bad = np.zeros(len(images), bool)
    bad[slice(*span)] = True
    severity = f"{severity}, frames {span[0]}..{span[1] - 1}"
    return replace(clip, frames={**clip.frames, view: images}, fault=fault, bad=bad, severity=severity)


def frozen(clip: Clip, random: np.random.Generator) -> Clip:
    """The task-facing camera delivers one picture for at least 0.75 s while the robot moves on."""
    images = clip.frames[clip.episode.primary_view].astype(np.float32)
    change = np.abs(np.diff(images, axis=0)).mean(axis=(1, 2, 3))
    while True:
        start, stop = _stretch(clip, random, round(0.75 * clip.episode.fps), 24)
        # A freeze in which nothing would have happened cannot be seen.
        if change[start:stop].sum() > 0.25 * change.sum() * (stop - start) / len(change):
            break
    return _spoil(clip, random, "corrupted", "frozen", (start, stop), lambda part: np.repeat(part[:1], len(part), 0))


def broken_pictures(clip: Clip, random: np.random.Generator) -> Clip:
    """Some pictures are noise, one grey level, or partly garbage, as a damaged stream decodes."""
    span = _stretch(clip, random, 1, 8)
    kind = str(random.choice(["noise", "blank", "band", "blocks"]))
    return _spoil(clip, random, "corrupted", kind, span, lambda part: garbled(part, kind, random))


def too_dark(clip: Clip, random: np.random.Generator) -> Clip:
    """The light is off or the shutter is closed."""
    gain = float(random.uniform(0.0, 0.09))
    span = _stretch(clip, random, 4, 16)
    return _spoil(clip, random, "too_dark", f"gain {gain:.3f}", span, lambda part: darkened(part, gain, random))


def overexposed(clip: Clip, random: np.random.Generator) -> Clip:
    """The sensor is saturated over most of the picture."""
    share = float(random.uniform(0.7, 1.0))
    span = _stretch(clip, random, 4, 16)
    return _spoil(clip, random, "overexposed", f"{share:.0%} white", span, lambda part: brightened(part, share, random))


def blur(clip: Clip, random: np.random.Generator) -> Clip:
    """The camera hunts for focus or shakes."""
    radius = float(random.uniform(2.5, 6.0)) * clip.frames[clip.episode.primary_view].shape[2] / 192
    shaken = bool(random.integers(2))
    span = _stretch(clip, random, 5, 16)
    severity = f"{'shake' if shaken else 'defocus'} {radius:.1f} px"
    return _spoil(clip, random, "blur", severity, span, lambda part: blurred(part, radius, shaken, random))


def slight_haze(clip: Clip, random: np.random.Generator) -> Clip:
    """A little darker, brighter or softer, all of which can be trained on: no fault."""
    view = clip.episode.primary_view
    images = clip.frames[view].copy()
    start, stop = _stretch(clip, random, 5, 16)
    kind = str(random.choice(["dim", "bright", "soft"]))
    part = images[start:stop]
    if kind == "soft":
        part = blurred(part, 0.5 * part.shape[2] / 192, False, random)
    else:
        gain = random.uniform(0.4, 0.8) if kind == "dim" else random.uniform(1.1, 1.3)
        part = np.clip(part.astype(np.float32) * gain, 0, 255).astype(np.uint8)
    images[start:stop] = part
    return replace(clip, frames={**clip.frames, view: images}, severity=kind)


def base_motion(clip: Clip, random: np.random.Generator) -> Clip:
    """The chassis drives for 1.5 s or longer: the world passes by behind the arms, whatever they do."""
    count = clip.episode.num_frames
    if random.integers(3) == 0:
        start, stop = 0, count
    else:
        start, stop = _stretch(clip, random, round(1.5 * clip.episode.fps), count - 4)
    return _driven(clip, random, (start, stop))


def textured_room(clip: Clip, random: np.random.Generator) -> Clip:
    """The same furnished room as in `base_motion`, and the chassis stands: no fault."""
    return replace(_driven(clip, random, (0, 0)), fault="", bad=None)


def _driven(clip: Clip, random: np.random.Generator, span: tuple[int, int]) -> Clip:
    view = clip.episode.primary_view
    images, speed = moving_background(clip.frames[view], clip.masks[view], span, random)
    bad = np.zeros(len(images), bool)
    bad[span[0] + 1 : span[1]] = True
    severity = f"{speed} of the width a second, frames {span[0]}..{span[1]}"
    return replace(clip, frames={**clip.frames, view: images}, fault="base_motion", bad=bad, severity=severity)


def late_states(clip: Clip, random: np.random.Generator) -> Clip:
    """States and actions are 0.25 to 0.75 s late or early against pictures and camera poses."""
    lag, states, pictures = _lag(clip, random)
    shown, told = at_frames(clip, pictures), at_frames(clip, states)
    episode = replace(shown.episode, state=told.episode.state, action=told.episode.action)
    bad = np.ones(len(states), bool)
    return replace(shown, episode=episode, fault="time_alignment", bad=bad, severity=f"states {lag:+d}")


def late_pictures(clip: Clip, random: np.random.Generator) -> Clip:
    """Pictures of all cameras are 0.25 to 0.75 s late or early against states and camera poses."""
    lag, pictures, states = _lag(clip, random)
    shown, told = at_frames(clip, pictures), at_frames(clip, states)
    bad = np.ones(len(states), bool)
    return replace(
        told, frames=shown.frames, masks=shown.masks, fault="time_alignment", bad=bad, severity=f"pictures {lag:+d}"
    )


def _lag(clip: Clip, random: np.random.Generator) -> tuple[int, np.ndarray, np.ndarray]:
    """A lag in frames, and the frame numbers of what is late by it and of the rest: the part that both have."""
    fps, count = clip.episode.fps, clip.episode.num_frames
    lag = int(random.integers(round(0.25 * fps), round(0.75 * fps) + 1)) * int(random.choice([-1, 1]))
    rest = np.arange(max(0, lag), count + min(0, lag))
    return lag, rest - lag, rest


def joint_jump(clip: Clip, random: np.random.Generator) -> Clip:
    """A joint reading jumps by 0.35 to 1.2 rad, for one to three frames or for good."""
    count, state = clip.episode.num_frames, clip.episode.state.copy()
    joints = _joint_columns(clip.episode)
    joint, size = int(random.choice(joints)), float(random.uniform(0.35, 1.2)) * float(random.choice([-1, 1]))
    start = int(random.integers(4, count - 4))
    stop = count if random.integers(2) else start + int(random.integers(1, 4))
    state[start:stop, joint] += size
    bad = np.zeros(count, bool)
    bad[start : start + 1 if stop == count else stop] = True
    episode = replace(clip.episode, state=state)
    severity = f"{size:+.2f} rad in joint {joint}, frames {start}..{stop - 1}"
    return replace(clip, episode=episode, fault="joint_jump", bad=bad, severity=severity)


def joint_speed(clip: Clip, random: np.random.Generator) -> Clip:
    """A joint runs at 8 to 14 rad/s for four frames or longer, which no arm here can."""
    count, state = clip.episode.num_frames, clip.episode.state.copy()
    joints = _joint_columns(clip.episode)
    joint, speed = int(random.choice(joints)), float(random.uniform(8, 14))
    length = int(random.integers(4, 9))
    start = int(random.integers(4, count - length - 1))
    ramp = np.clip(np.arange(count) - start, 0, length) * speed / clip.episode.fps
    state[:, joint] += ramp.astype(np.float32)
    bad = np.zeros(count, bool)
    bad[start + 1 : start + length + 1] = True
    severity = f"{speed:.1f} rad/s in joint {joint}"
    return replace(clip, episode=replace(clip.episode, state=state), fault="joint_speed", bad=bad, severity=severity)


FAULTS: dict[str, Callable[[Clip, np.random.Generator], Clip]] = {
    "static": static,
    "reset": reset,
    "frozen": frozen,
    "broken_pictures": broken_pictures,
    "base_motion": base_motion,
    "late_states": late_states,
    "late_pictures": late_pictures,
    "too_dark": too_dark,
    "overexposed": overexposed,
    "blur": blur,
    "joint_jump": joint_jump,
    "joint_speed": joint_speed,
}
"""Faults by name; `Clip.fault` is the quarantine reason that each must get."""

HARMLESS: dict[str, Callable[[Clip, np.random.Generator], Clip]] = {
    "short_pause": short_pause,
    "there_and_back": there_and_back,
    "slight_haze": slight_haze,
    "textured_room": textured_room,
}
"""Changes that look like a fault and are none: no filter may drop anything for them."""
