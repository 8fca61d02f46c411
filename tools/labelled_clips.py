"""Labelled clips: a healthy recording spoiled in one known way, to measure the filters with.

Each function takes a healthy clip and a random generator and returns the clip with one fault, and which frames carry it.
Faults are drawn at many severities. They are what a filter meets in the field: encoders and cameras that are noisy,
pictures that are compressed again afterwards. No filter reads this module.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from worldline_core.data.episodes.episode import Episode
from worldline_core.data.video.thumbnails import ThumbnailMaker, ViewThumbnails

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


def with_sensor_noise(clip: Clip, random: np.random.Generator) -> Clip:
    """Encoders noisy by up to 0.002 rad and cameras by up to 2 grey levels (standard deviations)."""
    radians, levels = random.choice([0.0, 0.0005, 0.002]), random.choice([0.0, 1.0, 2.0])
    state = clip.episode.state + random.normal(0, radians, clip.episode.state.shape).astype(np.float32)
    frames = {view: noisy(images, levels, random) for view, images in clip.frames.items()} if levels else clip.frames
    severity = f"{clip.severity}; encoders {radians} rad, camera {levels} levels".lstrip("; ")
    return replace(clip, episode=replace(clip.episode, state=state), frames=frames, severity=severity)


def static(clip: Clip, random: np.random.Generator) -> Clip:
    """The robot is still for 1.75 to 4 s before, in, or after the clip."""
    count = clip.episode.num_frames
    length = int(random.integers(round(1.75 * clip.episode.fps), round(4 * clip.episode.fps) + 1))
    start = int(random.choice([0, int(random.integers(4, count - 4)), count - 1]))
    index = np.concatenate([np.arange(start), np.full(length, start), np.arange(start, count)])
    bad = _marked(len(index), start, start + length)
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
    severity, bad = f"{severity}, frames {span[0]}..{span[1] - 1}", _marked(len(images), *span)
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
    """The same furnished room as in `base_motion`, and the chassis is still: no fault."""
    return replace(_driven(clip, random, (0, 0)), fault="", bad=None)


def _driven(clip: Clip, random: np.random.Generator, span: tuple[int, int]) -> Clip:
    view = clip.episode.primary_view
    images, speed = moving_background(clip.frames[view], clip.masks[view], span, random)
    bad = _marked(len(images), span[0] + 1, span[1])
    severity = f"{speed} of the width a second, frames {span[0]}..{span[1]}"
    return replace(clip, frames={**clip.frames, view: images}, fault="base_motion", bad=bad, severity=severity)


def late_states(clip: Clip, random: np.random.Generator) -> Clip:
    """States and actions are 0.25 to 0.75 s late or early against pictures and camera poses."""
    lag, states, pictures = _lag(clip, random)
    shown, measured = at_frames(clip, pictures), at_frames(clip, states)
    episode = replace(shown.episode, state=measured.episode.state, action=measured.episode.action)
    bad = np.ones(len(states), bool)
    return replace(shown, episode=episode, fault="time_alignment", bad=bad, severity=f"states {lag:+d}")


def late_pictures(clip: Clip, random: np.random.Generator) -> Clip:
    """Pictures of all cameras are 0.25 to 0.75 s late or early against states and camera poses."""
    lag, pictures, states = _lag(clip, random)
    shown, measured = at_frames(clip, pictures), at_frames(clip, states)
    bad = np.ones(len(states), bool)
    return replace(
        measured, frames=shown.frames, masks=shown.masks, fault="time_alignment", bad=bad, severity=f"pictures {lag:+d}"
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
    bad = _marked(count, start, start + 1 if stop == count else stop)
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
    bad = _marked(count, start + 1, start + length + 1)
    severity = f"{speed:.1f} rad/s in joint {joint}"
    return replace(clip, episode=replace(clip.episode, state=state), fault="joint_speed", bad=bad, severity=severity)


# Faults of pictures, uint8 (n, H, W, 3)


def noisy(images: np.ndarray, levels: float, random: np.random.Generator) -> np.ndarray:
    """With independent sensor noise of a standard deviation in grey levels."""
    noise = random.normal(0, levels, images.shape).astype(np.float32)
    return np.clip(images + noise, 0, 255).round().astype(np.uint8)


def garbled(images: np.ndarray, kind: str, random: np.random.Generator) -> np.ndarray:
    """As a damaged stream decodes: "noise" all over, "blank" one level, a grey "band", or misplaced "blocks"."""
    out, (count, height, width) = images.copy(), images.shape[:3]
    if kind == "noise":
        return random.integers(0, 256, images.shape, dtype=np.uint8)
    if kind == "blank":
        return np.full_like(images, random.integers(60, 200))
    if kind == "band":  # a truncated JPEG: the rest of the picture is grey
        out[:, round(height * random.uniform(0.3, 0.65)) :] = 128
        return out
    block = max(8, height // 8)
    for image in out:
        for top in range(0, height, block):
            for left in range(0, width, block):
                if random.uniform() < 0.5:
                    row, column = random.integers(0, height - block + 1), random.integers(0, width - block + 1)
                    patch = images[random.integers(count), row : row + block, column : column + block]
                    place = image[top : top + block, left : left + block]
                    place[:] = 255 - patch[: place.shape[0], : place.shape[1]]
    return out


def darkened(images: np.ndarray, gain: float, random: np.random.Generator) -> np.ndarray:
    """With a share `gain` of the light, and the noise of a sensor that sees little."""
    return noisy((images.astype(np.float32) * gain).round().astype(np.uint8), 1.5, random)


def brightened(images: np.ndarray, share: float, random: np.random.Generator) -> np.ndarray:
    """So bright that about `share` of the pixels are white."""
    luma = images.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    gain = 255 / max(float(np.quantile(luma, 1 - share)), 1.0)
    return noisy(np.clip(images.astype(np.float32) * max(gain, 1.0) * 1.15, 0, 255).astype(np.uint8), 1.0, random)


def blurred(images: np.ndarray, radius_px: float, shaken: bool, random: np.random.Generator) -> np.ndarray:
    """Defocused (a Gaussian of standard deviation `radius_px`), or smeared along a line three times as long."""
    if not shaken:
        return np.stack([cv2.GaussianBlur(image, (0, 0), radius_px) for image in images])
    size = 2 * max(1, round(1.5 * radius_px)) + 1
    out = []
    for image in images:
        angle = random.uniform(0, np.pi)
        kernel = np.zeros((size, size), np.float32)
        reach = (size - 1) / 2
        for step in np.linspace(-reach, reach, 4 * size):
            kernel[round(reach + step * np.sin(angle)), round(reach + step * np.cos(angle))] = 1
        out.append(cv2.filter2D(image, -1, kernel / kernel.sum()))
    return np.stack(out)


def furnished_room(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    """uint8 (height, width, 3): a wall, a floor, and things before them, as a camera on a robot sees a room."""
    wall, floor = random.uniform(70, 200, 3), random.uniform(50, 160, 3)
    horizon = round(height * random.uniform(0.3, 0.6))
    room = np.empty((height, width, 3), np.float32)
    room[:horizon], room[horizon:] = wall, floor
    for _ in range(int(random.integers(40, 90))):
        thing_h, thing_w = random.uniform(0.05, 0.3, 2) * height
        top, left = random.uniform(-0.1, 1, 2) * (height, width)
        colour = tuple(random.uniform(20, 235, 3).tolist())
        box = (int(left), int(top)), (int(left + thing_w), int(top + thing_h))
        if random.integers(2):
            cv2.rectangle(room, *box, colour, -1)
        else:
            cv2.ellipse(room, (*box[0],), (int(thing_w / 2) + 1, int(thing_h / 2) + 1), 0, 0, 360, colour, -1)
    grain = cv2.resize(random.normal(0, 8, (height // 3, width // 3, 1)).astype(np.float32), (width, height))
    return np.clip(cv2.GaussianBlur(room, (0, 0), 0.7) + grain[..., None], 0, 255).astype(np.uint8)


def moving_background(
    images: np.ndarray, masks: np.ndarray, span: tuple[int, int], random: np.random.Generator
) -> tuple[np.ndarray, str]:
    """The robot of a recording (its masks, (n, h, w)) before a room through which its base drives during `span`.

    Driving forward enlarges the room about its middle, driving sideways and turning shift it; the speed rises and falls
    smoothly as a chassis' does.

    Returns: pictures, and the speed in words.
    """
    count, height, width = images.shape[:3]
    room = furnished_room(3 * height, 3 * width, random)
    per_second = float(random.uniform(0.05, 0.3))
    direction = random.uniform(0, 2 * np.pi)
    forward = float(random.uniform(-1, 1)) if random.integers(2) else 0.0
    active = np.zeros(count)
    start, stop = span
    if stop > start:
        ramp = np.minimum(np.arange(stop - start) + 1, np.arange(stop - start)[::-1] + 1)
        active[start:stop] = np.minimum(ramp / 3, 1.0)
        active[start] = 0
    way = np.cumsum(active) * per_second / 8 * width
    out = []
    for i in range(count):
        shift = way[i] * np.array([np.cos(direction), 0.4 * np.sin(direction)])
        zoom = np.exp(forward * way[i] / width)
        corner = np.array([width, height]) * (1.5 - 0.5 / zoom) + np.clip(shift, -0.9 * width, 0.9 * width)
        place = np.array([[1 / zoom, 0, corner[0]], [0, 1 / zoom, corner[1]]], np.float64)
        seen = cv2.warpAffine(
            room, place, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
        )
        robot = cv2.resize(masks[i].astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
        out.append((robot * images[i] + (1 - robot) * seen).round().astype(np.uint8))
    return np.stack(out), f"{per_second:.2f}" + (f", forward {forward:+.2f}" if forward else "")


Change = Callable[[Clip, np.random.Generator], Clip]
FAULTS: dict[str, Change] = {
    change.__name__: change
    for change in (
        static, reset, frozen, broken_pictures, base_motion, late_states, late_pictures, too_dark, overexposed, blur,
        joint_jump, joint_speed,
    )
}  # fmt: skip
"""Faults by name; `Clip.fault` is the quarantine reason that each must get."""

HARMLESS: dict[str, Change] = {c.__name__: c for c in (short_pause, there_and_back, slight_haze, textured_room)}
"""Changes that look like a fault and are none: no filter may drop anything for them."""
