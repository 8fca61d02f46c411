"""Faults of pictures, for labelled clips: noise, garbage, exposure, blur, and a world that passes by behind the robot.

Pictures are uint8 (n, H, W, 3).
"""

from __future__ import annotations

import cv2
import numpy as np


def noisy(images: np.ndarray, levels: float, random: np.random.Generator) -> np.ndarray:
    """With independent sensor noise of a standard deviation in grey levels."""
    noise = random.normal(0, levels, images.shape).astype(np.float32)
    return np.clip(images + noise, 0, 255).round().astype(np.uint8)


def garbled(images: np.ndarray, kind: str, random: np.random.Generator) -> np.ndarray:
    """As a damaged stream decodes: "noise" all over, "blank" one level, a grey "band", or misplaced "blocks"."""
    out = images.copy()
    count, height, width = images.shape[:3]
    if kind == "noise":
        return random.integers(0, 256, images.shape, dtype=np.uint8)
    if kind == "blank":
        out[:] = random.integers(60, 200)
        return out
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
        corner = (
            np.array([width, height]) * 1.5
            - np.array([width, height]) / 2 / zoom
            + np.clip(shift, -0.9 * width, 0.9 * width)
        )
        place = np.array([[1 / zoom, 0, corner[0]], [0, 1 / zoom, corner[1]]], np.float64)
        seen = cv2.warpAffine(
            room, place, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
        )
        robot = cv2.resize(masks[i].astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
        out.append((robot * images[i] + (1 - robot) * seen).round().astype(np.uint8))
    return np.stack(out), f"{per_second:.2f}" + (f", forward {forward:+.2f}" if forward else "")
