"""Which samples of a flight are in the air.

A sample counts as flying when thrust is on and, next to an idle stretch, when the vehicle has left the
ground: it has risen 10 cm above where thrust came on. A file that starts in the air has
no takeoff to cut. The same holds backwards for the landing. Without a position, half a second after thrust
has reached its usual level is left out instead, and before it falls below that level. Impacts are left out,
and what follows a crash.
"""

from __future__ import annotations

import numpy as np

from trueflight.groundstation.reading.sliding import moving_maximum
from trueflight.groundstation.reading.uniform import segments
from trueflight.models.vehicle import Vehicle

IDLE = 0.25  # of hover thrust
DIP = 0.5  # s; a shorter loss of thrust is flown (a drop), not landed
RISE = 0.1  # m
SETTLE = 0.5  # s, without a position
SHORTEST_RUN = 1.0  # s
# m/s², specific force of an impact: above what propellers of a quadrotor in a log give in free flight
CRASH = 40.0
CRASH_RATIO = 4.0  # times the usual specific force
CRASHED = 3.0  # s of thrust after an impact below which it was a crash


def flying_mask(t: np.ndarray, columns: dict[str, np.ndarray], vehicle: Vehicle) -> np.ndarray:
    """Samples in the air (N,) bool, from `thrust_command` and, where they are, `position` and
    `specific_force`."""
    command = columns["thrust_command"]
    on = vehicle.thrust(command) > IDLE * vehicle.weight
    flying = np.zeros(len(t), dtype=bool)
    for part in segments(t):
        for start, end in _runs(on[part], t[part], DIP):
            a, b = part.start + start, part.start + end
            # An edge of the file, or of a gap, is no ground contact: only idle samples beside the run are.
            first = _takeoff(t, columns, a, b) if start > 0 else a
            last = _landing(t, columns, a, b) if b < part.stop else b
            if last > first and t[last - 1] - t[first] >= SHORTEST_RUN:
                flying[first:last] = True
    return flying & ~_impacts(t, columns, flying, vehicle)


def _runs(on: np.ndarray, t: np.ndarray, dip: float) -> list[tuple[int, int]]:
    """Half-open runs of true samples, with false stretches shorter than `dip` s closed."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
    runs = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    joined: list[tuple[int, int]] = []
    for a, b in runs:
        if joined and t[a] - t[joined[-1][1] - 1] < dip:
            joined[-1] = (joined[-1][0], b)
        else:
            joined.append((a, b))
    return joined


def _takeoff(t: np.ndarray, columns: dict[str, np.ndarray], a: int, b: int) -> int:
    """First sample of run [a, b) that has left the ground."""
    if (position := columns.get("position")) is not None:
        up = position[a:b, 2] - position[a, 2] > RISE
        # one that only comes down was taken over in the air
        came_down = bool(position[a, 2] - position[b - 1, 2] > RISE)
        return a + int(np.argmax(up)) if np.any(up) else a if came_down else b
    command = columns["thrust_command"][a:b]
    usual = command >= 0.8 * np.median(command)
    return int(np.searchsorted(t, t[a + int(np.argmax(usual))] + SETTLE))


def _landing(t: np.ndarray, columns: dict[str, np.ndarray], a: int, b: int) -> int:
    """One past the last sample of run [a, b) that is above the ground."""
    if (position := columns.get("position")) is not None:
        up = position[a:b, 2] - position[b - 1, 2] > RISE
        # one that ends at its height was handed over in the air
        went_up = bool(position[b - 1, 2] - position[a, 2] > RISE)
        return b - int(np.argmax(up[::-1])) if np.any(up) else b if went_up else a
    command = columns["thrust_command"][a:b]
    usual = command >= 0.8 * np.median(command)
    return int(np.searchsorted(t, t[b - 1 - int(np.argmax(usual[::-1]))] - SETTLE))


def _impacts(
    t: np.ndarray, columns: dict[str, np.ndarray], flying: np.ndarray, vehicle: Vehicle
) -> np.ndarray:
    """Samples around an impact; after a crash, when flight ends soon, also all that follows in that run."""
    hit = np.zeros(len(t), dtype=bool)
    f = columns.get("specific_force")
    if f is None or not np.any(flying):
        return hit
    norm = np.linalg.norm(f, axis=1)
    # What was commanded explains as much force: a racing quadrotor pulls 6 g without hitting anything.
    width = max(1, round(0.3 / float(np.median(np.diff(t)))))
    commanded = moving_maximum(vehicle.thrust(columns["thrust_command"]) / vehicle.mass, width)
    limit = np.maximum(max(CRASH, CRASH_RATIO * float(np.median(norm[flying]))), 3.0 * commanded)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flying.astype(np.int8), [0]])))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        over = a + np.flatnonzero(norm[a:b] > limit[a:b])
        # One sample is a spike of the sensor; an impact rings.
        if over.size < 2:
            continue
        for row in over:
            hit[np.searchsorted(t, t[row] - 0.1) : np.searchsorted(t, t[row] + SETTLE)] = True
        if t[b - 1] - t[over[-1]] < CRASHED:
            hit[over[-1] : b] = True
    return hit
