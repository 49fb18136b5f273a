"""Do the columns of a flight agree with each other?

What physics ties together is compared over the moving parts of the flight: attitude turns as the gyroscope says,
position moves as the velocity says, velocity grows as accelerometer and attitude say (without an accelerometer: as the
tilt says). Where two columns disagree, every fault that logs are known for is tried on all pairs at once: another order
or direction of the quaternion, axes exchanged, mirrored or turned about z, body for world, another unit. The fault that
mends most is named. A small turn is told; a delay, a held value, a glitch and a jump are undone or cut out, and told.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from trueflight.groundstation.reading.breaks import Step, steps, told, without
from trueflight.groundstation.reading.faults import (
    Columns,
    Fault,
    single_faults,
    turn_between,
    turned,
    turned_about_z,
)
from trueflight.groundstation.reading.held import unheld
from trueflight.groundstation.reading.pairs import FORCE, MOTION, ROTATION, TILT, Pair, Windows
from trueflight.groundstation.reading.plausible import body_rate
from trueflight.groundstation.reading.uniform import slopes
from trueflight.models.flight import Check
from trueflight.models.frames import rotate
from trueflight.models.vehicle import GRAVITY

DISAGREE, CONTRADICT = 0.5, 0.8
"""Shares of the motion's energy left between two columns from which on they disagree, and from which on a flight is
refused even where no known fault explains it. Smoothed estimates leave 0.3, strangers 2."""
MENDED, BETTER = 0.35, 0.25
"""A fault explains what two columns differ by if it leaves less than `MENDED` of the motion, and `BETTER` of that."""
SURE = 10.0
"""Log likelihood from which on a fault is believed."""
ALIKE = 0.5
"""Units of log of what is left by which faults must differ to be told apart."""
CLEAN = 0.02
"""Share left below which only mirrored axes are still looked for: one with little motion hides behind the others."""
REFUSED_ANGLE = np.radians(15.0)
"""Turn of one frame against another from which on a flight is refused: a quarter of the horizontal acceleration is
then on the wrong axis."""
TOLD_ANGLE = np.radians(4.0)
"""Turn from which on it is told; compasses and motion capture are aligned within a few degrees."""
TOO_LITTLE = "the flight moves too little to compare them"
UNTOLD = "the accelerometer feels too little along x and y to tell where they point: drag and wind rest on its mounting"
LATEST, TOLD_LATE, UNTOLD_LATE = 0.3, 0.015, 0.05
"""s of delay that are looked for, from which on one is told and undone, and from which on it is told that the flight
leaves open whether there is one."""
STEPS = (0.005, 0.02)
"""s by which delays are tried in the end, and at first: windows of half a second know no narrower valley."""
MOST_JUMPS, MOST_CUT = 5, 0.05
"""Jumps of the heading, and share of the flight, beyond which what looks like steps is disagreement throughout."""


@dataclass(frozen=True)
class Reconciled:
    """A flight's columns as they agree best: the rows (N,) to keep and their `columns`, what was found (`checks`), the
    true rate in Hz of columns that were held (`rates`), and `notes` on what was done."""

    keep: np.ndarray
    columns: Columns
    checks: tuple[Check, ...]
    rates: dict[str, float]
    notes: tuple[str, ...]


def reconcile(t: np.ndarray, columns: Columns, flying: np.ndarray) -> Reconciled:
    """Interpolate what is held, shift what is late, cut out what jumped, and compare the rest.

    `t` (N,) in s, even within its stretches; `columns` (N, k) by the names of `models.flight.COLUMNS`; `flying` (N,).
    """
    columns, rates, notes = unheld(t, columns, flying)
    # what jumps must not look like a delay, and what is late must not look like jumps
    found = steps(t, columns, flying)
    steady = flying & _kept(t, found, flying)
    columns, late = _undelayed(Windows(t, steady, rates), columns)
    if any(c.verdict == "undone" for c in late):
        found = steps(t, columns, flying)
    heading = [s for s in found if s.what == "heading" and not s.glitch]
    if 0 < len(heading) <= MOST_JUMPS:
        columns, said = _without_heading_jumps(Windows(t, flying, rates), columns, heading)
        notes += said
        found = [s for s in steps(t, columns, flying) if s.what != "heading"] + heading
    velocity = [s for s in found if s.what == "velocity"]
    found = [s for s in found if s in velocity or not any(v.overlaps(s) for v in velocity)]
    keep = _kept(t, found, flying)
    if not np.all(keep):
        notes += told(t, found)
        columns = {name: column[keep] for name, column in columns.items()}
    checks = _examined(Windows(t[keep], flying[keep], rates), columns, late)
    notes += [c.text for c in checks if c.verdict in ("undone", "weak")]
    if still := [c.pair for c in checks if c.text == TOO_LITTLE]:
        notes.append(f"{', '.join(still)}: {TOO_LITTLE}; axes, units and frames are taken as they stand")
    agreeing = [c.text.removeprefix(UNTOLD).removeprefix("; ") for c in checks if c.verdict == "agrees"]
    notes += [text for text in agreeing if text]
    return Reconciled(keep, columns, checks, rates, tuple(notes))


def _kept(t: np.ndarray, found: list[Step], flying: np.ndarray) -> np.ndarray:
    """Rows (N,) to keep; all of them where what looks like steps is disagreement throughout."""
    keep = without(t, found)
    throughout = np.sum(~keep & flying) > MOST_CUT * np.sum(flying)
    return np.ones(len(t), dtype=bool) if throughout else keep


def _examined(windows: Windows, columns: Columns, late: list[Check]) -> tuple[Check, ...]:
    """A check for every pair that the columns allow; `late` tells what was undone before."""
    pairs = windows.pairs(columns)
    moving = [p for p in pairs if p.moves]
    still = [Check(p.name, "cannot tell", float("nan"), TOO_LITTLE) for p in pairs if not p.moves]
    fault = _likeliest(windows, columns, moving)
    if fault is not None or any(p.left > DISAGREE for p in moving):
        return (*_disagreements(windows, columns, moving, fault), *still)
    untold = {c.pair: c.text for c in late if c.verdict == "agrees"}
    undone = [c for c in late if c.verdict == "undone"]
    found = {c.pair: c for c in (*undone, *_small_turns(columns, moving))}
    agreeing = [
        replace(c, text="; ".join(filter(None, (c.text, untold.get(c.pair, "")))))
        for c in (_agreement(windows, columns, p) for p in moving if p.name not in found)
    ]
    return (*found.values(), *agreeing, *still)


def _agreement(windows: Windows, columns: Columns, pair: Pair) -> Check:
    """That a pair agrees. Beside the thrust an accelerometer feels little along x and y, and agrees wherever they are:
    they are looked at alone. Told where they seem to point elsewhere, or where the flight does not tell it."""
    if pair.name == TILT:
        return Check(pair.name, "agrees", pair.left, _unsure_axes(windows, columns, pair))
    if pair.name == MOTION:
        return _mirrored(windows, columns, pair)
    if pair.name != FORCE:
        return Check(pair.name, "agrees", pair.left)
    name = "specific_force"
    faults = [f for f in single_faults({name: columns[name]}) if f.axes is not None and f.axes[2, 2] == 1.0]
    angle = _sensor_angle(windows, columns, name)
    others: list[tuple[Pair, Fault]] = []
    for fault in [
        *faults,
        turned("the accelerometer is turned by {} about the body's z axis", angle, (name,)),
    ]:
        (mended,) = windows.mended(columns, [pair], fault)
        others.append((replace(pair, one=mended.one, other=mended.other), fault))
    best, fault = min(others, key=lambda other: other[0].left)
    small = abs(fault.angle) < TOLD_ANGLE  # NaN is none
    others = others[:-1]
    if pair.likelihood(best.left) > SURE and not small:
        text = f"{fault.cause}, it seems: drag and wind rest on it"
        return Check(pair.name, "weak", pair.left, text, fault.mapping, fault.angle)
    told = all(other.likelihood(pair.left) > SURE for other, _ in others)
    return Check(pair.name, "agrees", pair.left, "" if told else UNTOLD)


def _mirrored(windows: Windows, columns: Columns, pair: Pair) -> Check:
    """That position and velocity agree; each axis by itself, for one that hardly moves is nothing beside the others."""
    unsure = []
    for fault in single_faults({"position": columns["position"]}, only_mirrored=True):
        (other,) = windows.mended(columns, [pair], fault)
        if pair.likelihood(other.left) > SURE:
            text = f"{fault.cause}, it seems: heights and places rest on it"
            return Check(pair.name, "weak", pair.left, text, fault.mapping)
        if fault.axes is not None and np.trace(fault.axes) == 1.0 and other.likelihood(pair.left) < SURE:
            unsure.append("xyz"[int(np.argmin(np.diag(fault.axes)))])
    if not unsure:
        return Check(pair.name, "agrees", pair.left)
    text = f"which way {' and '.join(unsure)} of the position points the flight moves too little to tell"
    return Check(pair.name, "agrees", pair.left, text)


def _unsure_axes(windows: Windows, columns: Columns, pair: Pair) -> str:
    """Which axes of the trajectory could as well be others, for all that the tilt tells; '' where none."""
    names = _trajectory(columns)
    unsure: set[str] = set()
    for fault in single_faults({n: columns[n] for n in names}):
        # whether z points up is told by the thrust
        if fault.axes is not None and fault.names == names and fault.axes[0, 0] * fault.axes[1, 1] != 1.0:
            other = windows.pair(TILT, fault.mend(columns))
            if other.likelihood(pair.left) < SURE:
                unsure |= {axis for k, axis in enumerate("xyz") if fault.axes[k, k] != 1.0}
    if not unsure:
        return ""
    return (
        f"{' and '.join(sorted(unsure))} of {' and '.join(names)} could be other axes of the log's: the flight moves "
        "too little along them to tell"
    )


def refusal(checks: tuple[Check, ...]) -> str:
    """The line with which a flight is refused, '' where it is not."""
    wrong = [c for c in checks if c.verdict == "contradicts"]
    if not wrong:
        return ""
    worst = max(wrong, key=lambda c: c.left)
    advice = (
        f"correct it, or read it with {' '.join(as_options(worst.mapping))}"
        if worst.mapping
        else "compare the columns: two vehicles, a sensor that stopped, or different clocks?"
    )
    return f"{', '.join(dict.fromkeys(c.pair for c in wrong))} contradict each other: {worst.text}; {advice}"


def as_options(mapping: str) -> list[str]:
    """The options of a command that hold the lines of a mapping, `--mapping 'velocity.turned = 20'` each."""
    return [f"--mapping '{line}'" for line in mapping.splitlines()]


def _disagreements(
    windows: Windows, columns: Columns, moving: list[Pair], fault: Fault | None
) -> Iterator[Check]:
    """A check for each pair, where some disagree or a `fault` was found."""
    mended = {} if fault is None else {p.name: p.left for p in windows.pairs(fault.mend(columns))}
    for pair in moving:
        if fault is not None and mended[pair.name] < BETTER * pair.left:
            yield Check(pair.name, "contradicts", pair.left, fault.cause, fault.mapping, fault.angle)
        elif pair.left <= DISAGREE:
            yield Check(pair.name, "agrees", pair.left)
        else:
            text = (
                f"{pair.name} differ by {100 * min(pair.left, 9.99):.0f} % of the motion's energy, and no exchange of "
                "axes, frames or units that is known mends it"
            )
            # an estimator may correct its position past its velocity for minutes (GPS): nothing is refused for that
            refused = pair.left > CONTRADICT and pair.name != MOTION
            yield Check(pair.name, "contradicts" if refused else "weak", pair.left, text)


def _likeliest(windows: Windows, columns: Columns, moving: list[Pair]) -> Fault | None:
    """The fault that mends every pair that disagrees, is sure for one at least, and spoils none; or None."""
    before = {p.name: p for p in moving}
    faults: list[Fault] = [*single_faults(columns, all(p.left < CLEAN for p in moving))]
    if any(p.left > DISAGREE for p in moving):
        faults += _turns(windows, columns)
    best: tuple[float, Fault] | None = None
    mending: list[tuple[float, Fault]] = []
    for fault in faults:
        after = {p.name: p.left for p in windows.mended(columns, moving, fault) if p.name in before}
        if not all(left < MENDED or left <= before[name].left for name, left in after.items()):
            continue
        mended = {
            n for n, p in before.items() if after[n] < BETTER * p.left and p.likelihood(after[n]) > SURE
        }
        if not mended or any(p.left > DISAGREE and n not in mended for n, p in before.items()):
            continue
        # what is left below 0.3 % is noise
        misfit = sum(float(np.log(max(left, 0.003))) for left in after.values())
        mending.append((misfit, fault))
        alike = best is not None and misfit < best[0] + ALIKE and fault.rank < best[1].rank
        if best is None or misfit < best[0] - ALIKE or alike:
            best = (misfit, fault)
    return None if best is None else _with_doubt(*best, mending)


def _with_doubt(misfit: float, best: Fault, mending: list[tuple[float, Fault]]) -> Fault:
    """The best of the faults that mend; where others of its columns do as well, with the axes by which they differ."""
    if best.axes is None:
        return best
    others = [f.axes for left, f in mending if left < misfit + ALIKE and f.names == best.names]
    unsure = [
        axis
        for k, axis in enumerate("xyz")
        if any(axes is not None and not np.array_equal(axes[k], best.axes[k]) for axes in others)
    ]
    if not unsure or not np.isnan(best.angle):
        return best
    doubt = f"{best.cause} (of {' and '.join(unsure)} the flight does not tell it)"
    return replace(best, cause=doubt)


def _turns(windows: Windows, columns: Columns) -> Iterator[Fault]:
    """Frames turned about z by the angle that fits best."""
    pairs = {p.name: p for p in windows.pairs(columns) if len(p.one)}
    path = pairs.get(FORCE) or pairs.get(TILT)
    if path is not None:
        angle, names = path.turn(), _trajectory(columns)
        cause = f"the frame of {' and '.join(names)} is turned by {{}} about z against that of the attitude"
        yield turned(cause, angle, names, 1)
    for names, cause in (
        (("angular_velocity", "specific_force"), "the IMU is turned by {} about the body's z axis"),
        (("angular_velocity",), "the gyroscope is turned by {} about the body's z axis"),
        (("specific_force",), "the accelerometer is turned by {} about the body's z axis"),
    ):
        if "quaternion" in columns and all(n in columns for n in names):
            yield turned(cause, _sensor_angle(windows, columns, names[0]), names, 2)
    if (motion := pairs.get(MOTION)) is not None:
        angle = turn_between(motion.one, motion.other)
        yield turned(
            "the velocity's frame is turned by {} about z against the position's", angle, ("velocity",), 3
        )


def _sensor_angle(windows: Windows, columns: Columns, name: str) -> float:
    """The turn about body z of a sensor of the IMU, from what attitude and trajectory say that it should read."""
    q, v = columns["quaternion"], columns.get("velocity")
    if name == "angular_velocity":
        rows = windows.rows(windows.turn)
        turned = body_rate(q[rows], q[rows + windows.turn], windows.turn * windows.dt)
        return turn_between(turned, windows.mean(columns[name], rows, windows.turn))
    if v is None and "position" in columns:
        v = slopes(windows.t, columns["position"])
    if v is None:
        return 0.0
    rows = windows.rows(windows.move)
    gained = (v[rows + windows.move] - v[rows]) / (windows.move * windows.dt) + [0.0, 0.0, GRAVITY]
    inverse = q[rows + windows.move // 2] * [1.0, -1.0, -1.0, -1.0]
    return turn_between(rotate(inverse, gained), windows.mean(columns[name], rows, windows.move))


def _undelayed(windows: Windows, columns: Columns) -> tuple[Columns, list[Check]]:
    """The columns without the delay of attitude, then of position and velocity, against the IMU (without one, against
    the attitude), where it is sure."""
    out, checks = dict(columns), []
    names = {p.name for p in windows.pairs(columns) if p.moves}
    trajectory = _trajectory(columns)
    for name, shifted in ((ROTATION, ("quaternion",)), (FORCE, trajectory), (TILT, trajectory)):
        late, left, unsure = _delay(windows, out, name) if name in names else (0.0, 0.0, 0.0)
        if abs(late) < TOLD_LATE:
            if unsure >= UNTOLD_LATE:
                what = "attitude" if name == ROTATION else " and ".join(shifted)
                text = (
                    f"the {what} may be up to {1e3 * unsure:.0f} ms late: the flight moves too little to tell"
                )
                checks.append(Check(name, "agrees", left, text))
            continue
        for n in shifted:
            out[n] = windows.earlier(out[n], late, n == "quaternion")
        what = "the attitude" if name == ROTATION else " and ".join(shifted)
        side = "later" if late > 0 else "earlier"
        against = "attitude" if name == TILT else "IMU"
        text = f"{what} lagged the {against}: {1e3 * abs(late):.0f} ms {side}, shifted back"
        mapping = "\n".join(f"{n}.late = {late:.3f}" for n in shifted)
        checks.append(Check(name, "undone", left, text, mapping, late=late))
    return out, checks


def _delay(windows: Windows, columns: Columns, name: str) -> tuple[float, float, float]:
    """How late (s) attitude or trajectory is against the IMU, or the trajectory against the attitude; 0 where it is not
    sure. With it the share left then, and how late it could be (s) as far as the flight tells."""
    step, coarse = (max(1, round(seconds / windows.dt)) for seconds in STEPS)
    reach = int(LATEST / windows.dt) // step * step
    here = windows.pair(name, columns, 0, reach)

    def left_at(shifts: np.ndarray) -> np.ndarray:
        return np.array([windows.later(here, columns, int(shift), reach).left for shift in shifts])

    rough = np.arange(-reach, reach + 1, coarse)
    about = left_at(rough)
    near = int(rough[np.argmin(about)])
    shifts = np.arange(max(near - coarse, -reach), min(near + coarse, reach) + 1, step)
    left, now = left_at(shifts), here.left
    best = int(np.argmin(left))
    possible = [abs(k) for k, some in zip(rough, about, strict=True) if here.gained(some, left[best]) < SURE]
    unsure = float(max(possible, default=0) * windows.dt)
    if not here.moves or best in (0, len(left) - 1):
        return 0.0, now, unsure
    if here.gained(now, left[best]) < SURE or left[best] > 0.5 * now:
        return 0.0, now, unsure
    curve = left[best - 1] - 2 * left[best] + left[best + 1]
    vertex = 0.5 * (left[best - 1] - left[best + 1]) / curve if curve > 0 else 0.0
    return float((shifts[best] + vertex * step) * windows.dt), float(left[best]), unsure


def _small_turns(columns: Columns, moving: list[Pair]) -> Iterator[Check]:
    """A turn about z between trajectory and attitude, and between IMU and attitude, where it is sure."""
    for pair in moving:
        if pair.name == MOTION:
            continue
        names: tuple[str, ...] = _trajectory(columns)
        cause = f"the frame of {' and '.join(names)} is turned by {{}} about z against that of the attitude"
        seen = pair
        if pair.name == ROTATION:
            names, cause = ("angular_velocity",), "the gyroscope is turned by {} about the body's z axis"
            seen = replace(pair, one=pair.other, other=pair.one)
        fault = turned(cause, seen.turn(), names, 0)
        left = seen.turned_back(fault.angle).left
        spread = np.sqrt(left * pair.window / (2.0 * pair.seconds))
        if abs(fault.angle) < max(TOLD_ANGLE, 3.0 * spread) or pair.likelihood(left) < SURE:
            continue
        refused = abs(fault.angle) >= REFUSED_ANGLE
        text = fault.cause + ("" if refused else ": forces along x and y mix by as much")
        verdict = "contradicts" if refused else "weak"
        yield Check(pair.name, verdict, pair.left, text, fault.mapping, fault.angle)


def _without_heading_jumps(
    windows: Windows, columns: Columns, jumps: list[Step]
) -> tuple[Columns, list[str]]:
    """The attitude with jumps of its heading undone: what came before is turned, or what came after, whichever fits the
    trajectory; a jump that neither mends stays."""
    t, notes = windows.t, []

    def path(some: Columns) -> Pair | None:
        return next((p for p in windows.pairs(some) if p.name in (FORCE, TILT) and p.moves), None)

    for jump in jumps:
        q, earlier = columns["quaternion"], (np.arange(len(t)) < jump.last)[:, None]
        ways = {
            "before": np.where(earlier, turned_about_z(q, jump.size), q),
            "after": np.where(earlier, q, turned_about_z(q, -jump.size)),
        }
        now = path(columns)
        left = {way: p.left for way in ways if (p := path({**columns, "quaternion": ways[way]})) is not None}
        if now is None or not left:
            continue
        side = min(left, key=lambda way: left[way])
        if left[side] < now.left and now.likelihood(left[side]) > SURE:
            columns = {**columns, "quaternion": ways[side]}
            notes.append(
                f"the heading {side} its jump at t = {t[jump.first]:.2f} s was turned by "
                f"{np.degrees(abs(jump.size)):.0f} degrees: velocity and accelerometer agree then"
            )
    return columns, notes


def _trajectory(columns: Columns) -> tuple[str, ...]:
    return tuple(n for n in ("position", "velocity") if n in columns)
