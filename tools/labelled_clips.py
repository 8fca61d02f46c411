"""Labelled clips: a healthy recording spoiled in one known way, to measure the filters with.

Each change in FAULTS and HARMLESS takes a healthy clip and a random generator and returns the clip with one fault, and which
frames carry it. Faults are drawn at many severities. They are what a filter meets in the field: encoders and cameras that are
noisy, pictures that are compressed again afterwards. No filter reads this module.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.video.thumbnails import ThumbnailMaker, ViewThumbnails

Frames = Mapping[str, np.ndarray]
Random = np.random.Generator


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


Change = Callable[[Clip, Random], Clip]


def view_thumbnails(frames_rgb: Iterable[np.ndarray], fps: float = 30.0) -> ViewThumbnails:
    """Thumbnails of pictures that do not come from a video.

    Args:
        frames_rgb: uint8 (H, W, 3) each, RGB.
        fps: their rate, from which follows how often sharpness is measured.

    Raises: RejectedInputError when there are none, or they differ in shape.
    """
    maker = ThumbnailMaker(fps)
    for frame in frames_rgb:
        maker.add(cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY), full_range=True)
    return maker.thumbnails()


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


def _marked(count: int, start: int, stop: int) -> np.ndarray:
    """bool (count,), true from start to stop."""
    frames = np.arange(count)
    return (start <= frames) & (frames < stop)


def _joint_columns(episode: Episode) -> list[int]:
    return [i for i, name in enumerate(episode.state_names or ()) if not name.endswith("gripper")]


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


def _stretch(clip: Clip, random: Random, shortest_s: float, longest_s: float) -> tuple[int, int]:
    count, fps = clip.episode.num_frames, clip.episode.fps
    length = min(int(random.integers(round(shortest_s * fps), round(longest_s * fps) + 1)), count - 3)
    start = int(random.integers(2, count - length + 1))
    return start, start + length


# Faults of time: the clip at other frame numbers


def _retimed(clip: Clip, random: Random, index: np.ndarray, fault: str, bad: np.ndarray | None, severity: str) -> Clip:
    """The clip at frame numbers, with encoders noisy by up to 0.002 rad and cameras by up to 2 grey levels."""
    clip = at_frames(clip, index)
    radians, levels = random.choice([0.0, 0.0005, 0.002]), random.choice([0.0, 1.0, 2.0])
    state = clip.episode.state + random.normal(0, radians, clip.episode.state.shape).astype(np.float32)
    frames = {view: noisy(images, levels, random) for view, images in clip.frames.items()} if levels else clip.frames
    severity = f"{severity}; encoders {radians} rad, camera {levels} levels"
    episode = replace(clip.episode, state=state)
    return replace(clip, episode=episode, frames=frames, fault=fault, bad=bad, severity=severity)


def _paused(clip: Clip, random: Random, start: int, length: int, fault: str = "") -> Clip:
    count = clip.episode.num_frames
    index = np.concatenate([np.arange(start), np.full(length, start), np.arange(start, count)])
    bad = _marked(len(index), start, start + length) if fault else None
    return _retimed(clip, random, index, fault, bad, f"{length} frames from {start}")


def static(clip: Clip, random: Random) -> Clip:
    """The robot is still for 1.75 to 4 s before, in, or after the clip."""
    count, fps = clip.episode.num_frames, clip.episode.fps
    length = int(random.integers(round(1.75 * fps), round(4 * fps) + 1))
    start = int(random.choice([0, int(random.integers(4, count - 4)), count - 1]))
    return _paused(clip, random, start, length, "static")


def short_pause(clip: Clip, random: Random) -> Clip:
    """A pause of up to a second between two motions, which belongs to manipulation: no fault."""
    length = int(random.integers(2, round(clip.episode.fps) + 1))
    start = int(random.choice(_moving(clip, 4, clip.episode.num_frames - 4, quickest=0.12)))
    return _paused(clip, random, start, length)


def reset(clip: Clip, random: Random) -> Clip:
    """The arms return to the first pose, at once or within 0.5 s, and a second attempt follows in the same file."""
    count = clip.episode.num_frames
    joints = clip.episode.state[:, _joint_columns(clip.episode)]
    away = np.abs(joints - joints[0]).max(axis=1)
    far = np.flatnonzero(away > 0.5 * away.max())
    end = int(random.choice(far[len(far) // 2 :]))
    steps = int(random.integers(1, round(0.5 * clip.episode.fps) + 1))
    back = np.linspace(end, 0, steps + 1).round().astype(int)[1:-1]
    index = np.concatenate([np.arange(end + 1), back, np.arange(int(random.integers(count // 3, count)))])
    severity = f"home from frame {end} in {steps} steps"
    return _retimed(clip, random, index, "reset", np.arange(len(index)) > end, severity)


def there_and_back(clip: Clip, random: Random) -> Clip:
    """The arms turn in the middle of a motion and return at the speed at which they came: no fault."""
    count = clip.episode.num_frames
    turn = int(random.choice(_moving(clip, count // 2, count - 2)))
    index = np.concatenate([np.arange(turn + 1), np.arange(turn - 1, -1, -1)])
    return _retimed(clip, random, index, "", None, f"reversed at {turn}")


def _late(states: bool) -> Change:
    """States and actions, or pictures, 0.25 to 0.75 s late or early against all else."""

    def change(clip: Clip, random: Random) -> Clip:
        fps, count = clip.episode.fps, clip.episode.num_frames
        lag = int(random.integers(round(0.25 * fps), round(0.75 * fps) + 1)) * int(random.choice([-1, 1]))
        index = np.arange(max(0, lag), count + min(0, lag))
        late, rest = at_frames(clip, index - lag), at_frames(clip, index)
        if states:
            spoiled = replace(rest, episode=replace(rest.episode, state=late.episode.state, action=late.episode.action))
        else:
            spoiled = replace(rest, frames=late.frames, masks=late.masks)
        return replace(spoiled, fault="time_alignment", bad=np.ones(len(index), bool), severity=f"{lag:+d} frames")

    return change


# Faults of joint readings


def _misread(clip: Clip, fault: str, joint: int, offset: np.ndarray, bad: np.ndarray) -> Clip:
    """The clip with an offset (n,) [rad] on one joint."""
    state = clip.episode.state.copy()
    state[:, joint] += offset.astype(np.float32)
    severity = f"{offset.max():+.2f} to {offset.min():+.2f} rad in joint {joint} from frame {np.argmax(bad)}"
    return replace(clip, episode=replace(clip.episode, state=state), fault=fault, bad=bad, severity=severity)


def joint_jump(clip: Clip, random: Random) -> Clip:
    """A joint reading jumps by 0.35 to 1.2 rad, for one to three frames or for good."""
    count, joint = clip.episode.num_frames, int(random.choice(_joint_columns(clip.episode)))
    size = float(random.uniform(0.35, 1.2)) * float(random.choice([-1, 1]))
    start = int(random.integers(4, count - 4))
    stop = count if random.integers(2) else start + int(random.integers(1, 4))
    bad = _marked(count, start, start + 1 if stop == count else stop)
    return _misread(clip, "joint_jump", joint, size * _marked(count, start, stop), bad)


def joint_speed(clip: Clip, random: Random) -> Clip:
    """A joint runs at 8 to 14 rad/s for four frames or longer, which no arm here can."""
    count, joint = clip.episode.num_frames, int(random.choice(_joint_columns(clip.episode)))
    speed, length = float(random.uniform(8, 14)), int(random.integers(4, 9))
    start = int(random.integers(4, count - length - 1))
    ramp = np.clip(np.arange(count) - start, 0, length) * speed / clip.episode.fps
    return _misread(clip, "joint_speed", joint, ramp, _marked(count, start + 1, start + length + 1))


# Faults of pictures, uint8 (n, H, W, 3), of the task-facing view


def _spoiled(clip: Clip, fault: str, span: tuple[int, int], part: np.ndarray, severity: str) -> Clip:
    """The clip with other pictures in a stretch of frames, which carry the fault if it is one."""
    view = clip.episode.primary_view
    images = clip.frames[view].copy()
    images[slice(*span)] = part
    bad = _marked(len(images), *span) if fault else None
    severity = f"{severity}, frames {span[0]}..{span[1] - 1}"
    return replace(clip, frames={**clip.frames, view: images}, fault=fault, bad=bad, severity=severity)


def _pictures(
    fault: str,
    shortest_s: float,
    longest_s: float,
    change: Callable[[np.ndarray, Any, Random], np.ndarray],
    draw: Callable[[Random], Any] = lambda random: None,
) -> Change:
    """A change of the pictures over some time, at a severity that `draw` draws."""

    def spoil(clip: Clip, random: Random) -> Clip:
        severity, span = draw(random), _stretch(clip, random, shortest_s, longest_s)
        part = change(clip.frames[clip.episode.primary_view][slice(*span)], severity, random)
        return _spoiled(clip, fault, span, part, f"{change.__name__} {severity}")

    return spoil


def frozen(clip: Clip, random: Random) -> Clip:
    """The camera delivers one picture for 0.75 to 3 s while the robot moves on."""
    images = clip.frames[clip.episode.primary_view]
    change = np.abs(np.diff(images.astype(np.float32), axis=0)).mean(axis=(1, 2, 3))
    while True:
        start, stop = _stretch(clip, random, 0.75, 3)
        # A freeze in which nothing would have happened cannot be seen.
        if change[start:stop].sum() > 0.25 * change.sum() * (stop - start) / len(change):
            return _spoiled(clip, "corrupted", (start, stop), images[start], "frozen")


def noisy(images: np.ndarray, levels: float, random: Random) -> np.ndarray:
    """Pictures with independent sensor noise of a standard deviation in grey levels."""
    noise = random.normal(0, levels, images.shape).astype(np.float32)
    return np.clip(images + noise, 0, 255).round().astype(np.uint8)


def garbled(images: np.ndarray, _: None, random: Random) -> np.ndarray:
    """Pictures as a damaged stream decodes: noise, one grey level, grey from some row on, or misplaced blocks."""
    kind, (height, width) = random.choice(["noise", "blank", "band", "blocks"]), images.shape[1:3]
    if kind == "noise":
        return random.integers(0, 256, images.shape, dtype=np.uint8)
    if kind == "blank":
        return np.full_like(images, random.integers(60, 200))
    out = images.copy()
    if kind == "band":
        out[:, round(height * random.uniform(0.3, 0.65)) :] = 128
        return out
    for image in out:
        cells = random.integers(0, 2, (8, 8 * width // height), np.uint8)
        blocks = cv2.resize(cells, (width, height), interpolation=cv2.INTER_NEAREST) == 1
        other = np.roll(images[random.integers(len(images))], random.integers(0, height, 2), (0, 1))
        image[blocks] = 255 - other[blocks]
    return out


def darkened(images: np.ndarray, gain: float, random: Random) -> np.ndarray:
    """Pictures with a share `gain` of the light, and the noise of a sensor that sees little."""
    return noisy((images.astype(np.float32) * gain).round().astype(np.uint8), 1.5, random)


def brightened(images: np.ndarray, share: float, random: Random) -> np.ndarray:
    """Pictures so bright that about `share` of the pixels are white."""
    luma = images.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    gain = 255 / max(float(np.quantile(luma, 1 - share)), 1.0)
    return noisy(np.clip(images.astype(np.float32) * max(gain, 1.0) * 1.15, 0, 255).astype(np.uint8), 1.0, random)


def blurred(images: np.ndarray, severity: tuple[float, bool], random: Random) -> np.ndarray:
    """Pictures out of focus by a Gaussian of so many 192ths of the width, or smeared along a line three times as long."""
    radius_px, shaken = severity[0] * images.shape[2] / 192, severity[1]
    if not shaken:
        return np.stack([cv2.GaussianBlur(image, (0, 0), radius_px) for image in images])
    size = 2 * max(1, round(1.5 * radius_px)) + 1
    line, out = np.zeros((size, size), np.float32), []
    line[size // 2] = 1
    for image in images:
        turn = cv2.getRotationMatrix2D((size // 2, size // 2), random.uniform(0, 180), 1)
        kernel = cv2.warpAffine(line, turn, (size, size))
        out.append(cv2.filter2D(image, -1, kernel / kernel.sum()))
    return np.stack(out)


def hazy(images: np.ndarray, _: None, random: Random) -> np.ndarray:
    """Pictures a little darker, brighter or softer, all of which can be trained on."""
    kind = random.choice(["dim", "bright", "soft"])
    if kind == "soft":
        return blurred(images, (0.5, False), random)
    gain = random.uniform(0.4, 0.8) if kind == "dim" else random.uniform(1.1, 1.3)
    return np.clip(images.astype(np.float32) * gain, 0, 255).astype(np.uint8)


def base_motion(clip: Clip, random: Random) -> Clip:
    """The chassis drives for 1.5 s or longer: the world passes by behind the arms, whatever they do."""
    count = clip.episode.num_frames
    drive = (0, count) if random.integers(3) == 0 else _stretch(clip, random, 1.5, (count - 4) / clip.episode.fps)
    spoiled = _before_a_room(clip, drive, random)
    return replace(spoiled, fault="base_motion", bad=_marked(count, drive[0] + 1, drive[1]))


def textured_room(clip: Clip, random: Random) -> Clip:
    """The same furnished room as in `base_motion`, and the chassis is still: no fault."""
    return _before_a_room(clip, (0, 0), random)


def _before_a_room(clip: Clip, drive: tuple[int, int], random: Random) -> Clip:
    """The robot before a room through which its base drives.

    Driving forward enlarges the room about its middle, driving sideways and turning shift it; the speed rises and falls
    smoothly as a chassis' does.
    """
    view = clip.episode.primary_view
    images, masks = clip.frames[view], clip.masks[view]
    count, height, width = images.shape[:3]
    room = furnished_room(3 * height, 3 * width, random)
    per_second, direction = random.uniform(0.05, 0.3), random.uniform(0, 2 * np.pi)
    forward, frames = random.uniform(-1, 1) * random.integers(2), np.arange(count)
    speed = np.clip(np.minimum(frames - drive[0] + 1, drive[1] - frames) / 3, 0, 1) * (frames > drive[0])
    way = np.cumsum(speed) * per_second / 8 * width
    out = []
    for image, mask, gone in zip(images, masks, way, strict=True):
        shift = gone * np.array([np.cos(direction), 0.4 * np.sin(direction)])
        zoom = np.exp(forward * gone / width)
        corner = np.array([width, height]) * (1.5 - 0.5 / zoom) + np.clip(shift, -0.9 * width, 0.9 * width)
        place = np.column_stack([np.eye(2) / zoom, corner])
        how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpAffine(room, place, (width, height), flags=how, borderMode=cv2.BORDER_REFLECT)
        robot = cv2.resize(mask.astype(np.float32), (width, height))[..., None]
        out.append((robot * image + (1 - robot) * seen).round().astype(np.uint8))
    return _spoiled(clip, "", (0, count), np.stack(out), f"{per_second:.2f} widths a second, forward {forward:+.2f}")


def furnished_room(height: int, width: int, random: Random) -> np.ndarray:
    """uint8 (height, width, 3): a wall, a floor, and things before them, as a camera on a robot sees a room."""
    wall, floor = random.uniform(70, 200, 3), random.uniform(50, 160, 3)
    horizon = round(height * random.uniform(0.3, 0.6))
    room = np.empty((height, width, 3), np.float32)
    room[:horizon], room[horizon:] = wall, floor
    for _ in range(int(random.integers(40, 90))):
        thing_h, thing_w = random.uniform(0.05, 0.3, 2) * height
        top, left = random.uniform(-0.1, 1, 2) * (height, width)
        colour = tuple(random.uniform(20, 235, 3).tolist())
        cv2.rectangle(room, (int(left), int(top)), (int(left + thing_w), int(top + thing_h)), colour, -1)
    grain = cv2.resize(random.normal(0, 8, (height // 3, width // 3, 1)).astype(np.float32), (width, height))
    return np.clip(cv2.GaussianBlur(room, (0, 0), 0.7) + grain[..., None], 0, 255).astype(np.uint8)


FAULTS: dict[str, Change] = {
    "static": static,
    "reset": reset,
    "frozen": frozen,
    "broken_pictures": _pictures("corrupted", 0.125, 1, garbled),
    "base_motion": base_motion,
    "late_states": _late(states=True),
    "late_pictures": _late(states=False),
    "too_dark": _pictures("too_dark", 0.5, 2, darkened, lambda random: float(random.uniform(0, 0.09))),
    "overexposed": _pictures("overexposed", 0.5, 2, brightened, lambda random: float(random.uniform(0.7, 1))),
    "blur": _pictures("blur", 0.625, 2, blurred, lambda random: (random.uniform(2.5, 6), bool(random.integers(2)))),
    "joint_jump": joint_jump,
    "joint_speed": joint_speed,
}
"""Faults by name; `Clip.fault` is the quarantine reason that each must get."""

HARMLESS: dict[str, Change] = {
    "short_pause": short_pause,
    "there_and_back": there_and_back,
    "slight_haze": _pictures("", 0.625, 2, hazy),
    "textured_room": textured_room,
}
"""Changes that look like a fault and are none: no filter may drop anything for them."""
