"""The bodies of the small world: variants of the robots' colours, link lengths, bases and wrist cameras.

All share one workspace, so that one camera arrangement serves them all; the base frame lies 0.38 m before its middle.
Six bodies are for training; ``panda_ivory`` is held out.
"""

from __future__ import annotations

from worldline_core.recorder.robots import ArmPlacement, CameraMount, Colour, Robot

# Middle of the workspace, where head cameras look.
CENTRE = (0.385, 0.0, 0.115)
REACH_X, REACH_Y = (0.31, 0.46), (0.05, 0.225)
WRIST_STEEP = CameraMount(eye=(0.10, 0.0, -0.105), target=(0.005, 0.0, 0.02), fovy_deg=66.0)
WRIST_FLAT = CameraMount(eye=(0.125, 0.0, -0.09), target=(0.0, 0.0, 0.03), fovy_deg=62.0)
HEAD = CameraMount(eye=(0.86, 0.0, 0.83), target=CENTRE, fovy_deg=29.5)

_VIPERX_HOME = (0.0, -0.75, 0.95, 0.0, 1.2, 0.0)
_UR5E_HOME = (-0.3, -1.9, 2.3, -1.97, -1.57, -1.87)
_XARM7_HOME = (0.0, -0.4, 0.0, 0.9, 0.0, 1.3, 0.0)
_PANDA_HOME = (0.0, 0.0, 0.0, -2.3, 0.0, 2.3, 0.785)


def _body(
    name: str,
    home: tuple[float, ...],
    base: tuple[float, float],
    yaw: float,
    travel: float,
    colours: tuple[tuple[Colour, Colour], ...],
    *,
    link_scale: float = 1.0,
    wrist: CameraMount = WRIST_STEEP,
) -> Robot:
    """A pair of arms; ``base`` is (x, distance from the middle plane) [m], the model is the name's first word."""
    x, distance = base
    return Robot(
        name=name,
        model=name.split("_")[0],
        arms=(
            ArmPlacement("left", (x, distance, 0.0), -yaw, home),
            ArmPlacement("right", (x, -distance, 0.0), yaw, home),
        ),
        finger_travel=(0.0, travel),
        reach_x=REACH_X,
        reach_y=REACH_Y,
        scale=1.0,
        head=HEAD,
        colours=colours,
        wrist=wrist,
        link_scale=link_scale,
    )


# Colours stay weakly saturated: what is saturated is a thing.
_BODIES = (
    _body("viperx_graphite", _VIPERX_HOME, (0.0, 0.27), 0.15, 0.042, (((0.5, 0.5, 0.5), (0.13, 0.13, 0.15)),)),
    _body(
        "viperx_pearl", _VIPERX_HOME, (-0.03, 0.31), 0.25, 0.042, (((0.5, 0.5, 0.5), (0.86, 0.86, 0.84)),),
        link_scale=1.1, wrist=WRIST_FLAT,
    ),
    _body("ur5e_silver", _UR5E_HOME, (-0.07, 0.38), 0.0, 0.040, (((0.75, 0.0, 0.0), (0.20, 0.20, 0.22)),)),
    _body(
        "ur5e_slate", _UR5E_HOME, (-0.04, 0.33), 0.1, 0.040,
        (
            ((0.75, 0.0, 0.0), (0.30, 0.33, 0.38)), ((0.75, 0.75, 0.75), (0.24, 0.28, 0.34)),
            ((0.5, 0.75, 0.75), (0.70, 0.68, 0.62)), ((0.25, 0.25, 0.25), (0.62, 0.60, 0.55)),
            ((0.0, 0.0, 0.0), (0.34, 0.36, 0.40)),
        ),
        link_scale=0.94, wrist=WRIST_FLAT,
    ),
    _body("xarm7_white", _XARM7_HOME, (-0.06, 0.30), 0.0, 0.042, (((1.0, 1.0, 1.0), (0.86, 0.87, 0.90)),)),
    _body(
        "xarm7_bronze", _XARM7_HOME, (-0.08, 0.35), 0.2, 0.042,
        (((1.0, 1.0, 1.0), (0.46, 0.38, 0.31)), ((0.25, 0.25, 0.25), (0.16, 0.15, 0.14))),
        link_scale=1.07, wrist=WRIST_FLAT,
    ),
    _body("panda_ivory", _PANDA_HOME, (-0.08, 0.32), 0.0, 0.040, (((1.0, 1.0, 1.0), (0.84, 0.80, 0.72)),)),
)  # fmt: skip
BODIES: dict[str, Robot] = {body.name: body for body in _BODIES}
