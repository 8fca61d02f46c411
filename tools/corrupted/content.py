"""Synthetic recordings that pass every check: smooth joints, and things that move before a background that does not."""

from __future__ import annotations

import cv2
import numpy as np

NUM_FRAMES = 24
FPS = 8.0
HEIGHT, WIDTH = 72, 96


def joint_motion(random: np.random.Generator, joints: int, num_frames: int = NUM_FRAMES) -> np.ndarray:
    """(n, joints) float64 positions [rad] of a smooth motion of some tenths of a radian, another one for each draw."""
    time = np.arange(num_frames)[:, None] / FPS
    rate, phase, middle = (random.uniform(low, high, (1, joints)) for low, high in ((0.8, 2.0), (0, 6.28), (-0.2, 0.2)))
    return middle + 0.3 * np.sin(rate * time + phase)


def gripper_motion(random: np.random.Generator, num_frames: int = NUM_FRAMES) -> np.ndarray:
    """(n,) openings, 0 closed .. 1 open, that close somewhere in the middle."""
    middle = random.uniform(0.3, 0.7) * num_frames
    return 0.9 / (1 + np.exp((np.arange(num_frames) - middle) / 1.5)) + 0.05


PAIR_NAMES = tuple(f"{arm}/{n}" for arm in ("left", "right") for n in (*(f"joint_{j}" for j in range(6)), "gripper"))
"""State columns of two arms of six joints."""


def pair_motion(random: np.random.Generator, num_frames: int = NUM_FRAMES) -> np.ndarray:
    """float32 (n, 14) joints and openings of PAIR_NAMES."""
    arms = [(joint_motion(random, 6, num_frames), gripper_motion(random, num_frames)[:, None]) for _ in range(2)]
    return np.concatenate([part for arm in arms for part in arm], axis=1).astype(np.float32)


def pictures(random: np.random.Generator, num_frames: int = NUM_FRAMES) -> np.ndarray:
    """uint8 (n, HEIGHT, WIDTH, 3): patches that move smoothly before a background of edges and soft shades."""
    shades = random.uniform(60, 180, (5, 6, 3)).astype(np.float32)
    background = cv2.resize(shades, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    for _ in range(14):
        x, y = int(random.integers(0, WIDTH - 10)), int(random.integers(0, HEIGHT - 10))
        w, h = (int(v) for v in random.integers(6, 24, 2))
        background[y : y + h, x : x + w] = 0.4 * background[y : y + h, x : x + w] + random.uniform(0, 150, 3)
    frames = np.repeat(background[None], num_frames, axis=0)
    time = np.arange(num_frames) / FPS
    for _ in range(2):
        size = int(random.integers(14, 22))
        patch = cv2.resize(random.uniform(0, 255, (4, 4, 3)).astype(np.float32), (size, size))
        rate, phase = random.uniform(1.0, 2.0, 2), random.uniform(0, 6.28, 2)
        reach = (np.array([HEIGHT, WIDTH]) - size) / 2
        place = (reach + 0.9 * reach * np.sin(rate * time[:, None] + phase)).astype(int)
        for n, (y, x) in enumerate(place):
            frames[n, y : y + size, x : x + size] = patch
    return np.clip(frames, 0, 255).astype(np.uint8)
