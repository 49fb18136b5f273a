"""What PX4's parameters should be for a flight by the companion: one row each, in the order of their weight.

Source: PX4's parameter reference. The first two decide what happens when the companion falls silent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from trueflight.companion.findings import FAIL, NOTE, WARN
from trueflight.companion.settings import Settings
from trueflight.companion.stopping import Safety

Number = int | float


class Rule(NamedTuple):
    """`good` tells whether a value is what it should be, `change` makes that of one that is not (None: leave it)."""

    good: Callable[[Number], bool]
    change: Callable[[Number], Number | None]


def between(least: Number, most: Number, to: Number) -> Rule:
    """Both bounds are good; anything else becomes `to`."""
    return Rule(lambda value: least <= value <= most, lambda value: to)


def at_least(least: Number, to: Number) -> Rule:
    """Anything less becomes `to`."""
    return between(least, math.inf, to)


def at_most(most: Number, to: Number) -> Rule:
    """Anything more becomes `to`."""
    return between(-math.inf, most, to)


def one_of(*values: Number, to: Number) -> Rule:
    """Anything else becomes `to`."""
    return Rule(lambda value: value in values, lambda value: to)


def bits(mask: int) -> Rule:
    """These bits are set; what somebody set besides stays."""
    return Rule(lambda value: int(value) & mask == mask, lambda value: int(value) | mask)


def around(fence: float) -> Rule:
    """Outside the companion's own fence (m), and not so far that it is none."""
    return Rule(lambda value: fence < value <= 10.0 * fence, lambda value: float(_around(fence)))


def told_only() -> Rule:
    """Nobody can say from here what is right."""
    return Rule(lambda value: True, lambda value: None)


@dataclass(frozen=True)
class RequiredParameter:
    """What a parameter should be, in words and by a rule, and why.

    `state` is how bad it is where it is not, `reboot` whether a change acts only after the autopilot's restart;
    `otherwise` is looked at in a PX4 that does not have the parameter.
    """

    name: str
    wanted: str
    why: str
    rule: Rule
    state: str = FAIL
    reboot: bool = False
    otherwise: RequiredParameter | None = None


_STICKS = RequiredParameter(
    "MAN_OVERRIDE_SPD",
    "0 or more",
    "moving the sticks this fast takes over; negative: never (PX4 1.18)",
    at_least(0.0, to=1.0),
    WARN,
)

ALWAYS = (
    RequiredParameter(
        "COM_OF_LOSS_T",
        "0.2 to 1 s",
        "how long PX4 flies on after the companion fell silent",
        between(0.2, 1.0, to=0.5),
    ),
    RequiredParameter(
        "COM_OBL_RC_ACT",
        "4 (Land), 3 (Return) or 5 (Hold)",
        "what it does then; 0 to 2 need a pilot and end in a blind descent without one",
        one_of(3, 4, 5, to=4),
    ),
    RequiredParameter(
        "COM_RC_OVERRIDE",
        "bit 1 (2 or 3)",
        "moving the sticks takes over in Offboard as well",
        bits(2),
        WARN,
        otherwise=_STICKS,
    ),
    RequiredParameter(
        "COM_RCL_EXCEPT",
        "0 with a radio, bit 2 (4) without",
        "bit 2: losing the radio does not end Offboard",
        told_only(),
        NOTE,
    ),
    RequiredParameter(
        "EKF2_NOAID_TOUT",
        "at most 1000000 us",
        "how long PX4 1.16 and later calls a position without GPS or mocap valid, and drifts",
        at_most(1_000_000, to=1_000_000),
        WARN,
    ),
    RequiredParameter(
        "COM_LOW_BAT_ACT",
        "2 (Land) or 3 (Return)",
        "what PX4 does at a critical battery; 0 only warns",
        one_of(1, 2, 3, to=2),
        WARN,
    ),
)

MOCAP = (
    RequiredParameter(
        "EKF2_EV_CTRL",
        "bits 0, 1 and 3 (11)",
        "takes position, height and yaw from mocap or vision",
        bits(11),
    ),
    RequiredParameter(
        "EKF2_HGT_REF", "3 (vision)", "height is that of mocap or vision", one_of(3, to=3), WARN, True
    ),
    RequiredParameter("EKF2_GPS_CTRL", "0", "GPS would pull against mocap or vision", one_of(0, to=0), WARN),
    RequiredParameter(
        "EKF2_MAG_TYPE",
        "5 (none)",
        "the compass would pull against the yaw of mocap or vision",
        one_of(5, to=5),
        WARN,
        True,
    ),
    RequiredParameter(
        "EKF2_EV_DELAY",
        "about 0 ms",
        "poses carry the time when they were taken ([pose] latency)",
        at_most(20.0, to=0.0),
        WARN,
        True,
    ),
)
"""Where mocap poses are on."""


def required_parameters(settings: Settings) -> list[RequiredParameter]:
    """The parameters that a flight with these settings needs, in the order of their weight."""
    return [
        *ALWAYS,
        *_fence(settings.safety),
        *(_fast(settings.rate) if settings.rate > 100.0 else ()),
        *(MOCAP if settings.pose.enabled else ()),
    ]


def _around(fence: float) -> int:
    return math.ceil(1.5 * fence)


def _fence(safety: Safety) -> tuple[RequiredParameter, ...]:
    radius, height = safety.fence_radius, safety.fence_height
    return (
        RequiredParameter(
            "GF_MAX_HOR_DIST",
            f"about {_around(radius):d} m",
            f"PX4's own fence, outside the companion's {radius:g} m; 0 is none",
            around(radius),
            WARN,
        ),
        RequiredParameter(
            "GF_MAX_VER_DIST",
            f"about {_around(height):d} m",
            f"PX4's own ceiling, above the companion's {height:g} m; 0 is none",
            around(height),
            WARN,
        ),
        RequiredParameter(
            "GF_ACTION",
            "2 (Hold), 3 (Return) or 5 (Land)",
            "what PX4 does outside of it; 1 only warns",
            one_of(2, 3, 5, to=2),
            WARN,
        ),
    )


def _fast(rate: float) -> tuple[RequiredParameter, ...]:
    period = int(1e6 / rate)
    why = f"the estimator gives odometry no faster than this; {rate:g} Hz are asked for"
    rule = at_most(period, to=period // 1000 * 1000 or 1000)
    return (RequiredParameter("EKF2_PREDICT_US", f"at most {period} us", why, rule, reboot=True),)
