"""What the analyses return: one set of objects that tables, `--json`, Rerun views and reports all print from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from trueflight.models.flight import Flight
from trueflight.models.model import Model
from trueflight.models.vehicle import GRAVITY

RISES = 1.005
"""Times the residual before from which one is said to rise."""


@dataclass(frozen=True)
class AxisError:
    """Model error on one axis of the heading frame ("x", "y", "z"), m/s²; `share_explained` of the linear model's
    squared error above the noise floor, 0 to 1."""

    axis: str
    rms: float
    noise_floor: float
    share_explained: float


@dataclass(frozen=True)
class HorizonError:
    """Open-loop prediction error after `horizon` s: RMS over restarts, per world axis."""

    horizon: float
    position: tuple[float, float, float]  # m
    velocity: tuple[float, float, float]  # m/s
    restarts: int


@dataclass(frozen=True)
class Comparison:
    """One model against one flight.

    All arrays have the flight's N rows. `measured` and `predicted` (N, 3) are accelerations in m/s², heading frame,
    both through the same low-pass of `bandwidth` Hz; `residual` is measured minus predicted; `used` (N,) bool marks
    the samples that count (flying, not saturated, finite).
    """

    flight: Flight
    label: str  # name of the model version, as shown to people
    measured: np.ndarray
    predicted: np.ndarray
    residual: np.ndarray
    used: np.ndarray
    bandwidth: float
    axes: tuple[AxisError, ...]
    horizons: tuple[HorizonError, ...]
    rms: float  # over all axes
    noise_floor: float


@dataclass(frozen=True)
class ErrorMap:
    """Squared residual against one variable, in bins: `edges` (B+1,), the others (B,)."""

    variable: str  # "height", "speed", "tilt", "thrust", "voltage", "time", ...
    unit: str
    edges: np.ndarray
    rms: np.ndarray  # m/s², nan where a bin is empty
    share_of_error: np.ndarray  # of the sum of squares, 0 to 1
    share_of_time: np.ndarray


@dataclass(frozen=True)
class Region:
    """A part of the flight that holds more than its share of the squared error; or, where `variable` is "constant, "
    and the axes, a constant of the size `low` m/s² in them."""

    text: str  # "71 % of the squared error sits below 0.4 m, in 12 % of the flight"
    variable: str
    low: float
    high: float
    share_of_error: float
    share_of_time: float


@dataclass(frozen=True)
class Moment:
    """One of the worst stretches of a flight, s on the flight's clock; rms in m/s²."""

    start: float
    end: float
    rms: float
    text: str


@dataclass(frozen=True)
class PlaceMap:
    """Squared residual over square cells of the ground: `centres` (C, 2) in m, world x and y; `rms` (C,) in m/s²."""

    cell: float  # m
    centres: np.ndarray
    rms: np.ndarray
    share_of_error: np.ndarray
    share_of_time: np.ndarray


@dataclass(frozen=True)
class WhereItFails:
    """Where the residual of a comparison sits."""

    maps: tuple[ErrorMap, ...]
    regions: tuple[Region, ...]
    worst: tuple[Moment, ...]
    place: PlaceMap | None = None  # None where the flight has no position


@dataclass(frozen=True)
class WaterfallStep:
    """The residual RMS (m/s²) of one model version on the fitted and on the held-out flight."""

    label: str
    fitted: float
    held_out: float | None
    noise_floor: float


@dataclass(frozen=True)
class SpectralLine:
    """A narrow peak of the residual's spectrum: `frequency` in Hz, `rms` in m/s² on `axis` (body "x", "y", "z").

    `in_band` where it lies below the bandwidth of the comparison, so that models are judged with it; `text` says what
    it may be.
    """

    frequency: float
    axis: str
    rms: float
    p_value: float
    in_band: bool
    text: str


@dataclass(frozen=True)
class FormulaTerm:
    """`coefficient` times `term` on body axis `axis`, m/s²; 95 % interval from leaving out blocks; `unit` of the
    coefficient."""

    axis: str
    term: str
    coefficient: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class SparseFormula:
    """A short formula for what no effect explains. `variance_share` is the part of what varies in the
    residual (squared, about its mean) that it takes away on held-out blocks."""

    text: str
    terms: tuple[FormulaTerm, ...]
    variance_share: float


@dataclass(frozen=True)
class Misfit:
    """What is left on one axis beyond its noise: `rms` m/s² on `axis` of the "body" or the "world", beside `noise`
    m/s² of the sensor; four fifths of it between `low` and `high` Hz. `held` is the part of it that the description in
    `text` holds, 0 where it only tells the band."""

    frame: str
    axis: str
    rms: float
    noise: float
    low: float
    high: float
    held: float
    text: str


@dataclass(frozen=True)
class Unexplained:
    """Whether more is left than noise or predictable structure, its share of the remaining squared error, and what it
    goes with.

    `misfit` tells the axes on which the residual is well above the noise, whether or not it can be predicted.

    `p_value` is that of the structure against residuals of the same spectrum without it; `variables` the shares that
    go with each variable, `axes` and `moments` (start, end in s, share) where the structure acts, `lines` the narrow
    peaks of the spectrum, `formula` a short formula where one was found.
    """

    verdict: bool
    variance_share: float
    where: tuple[str, ...]
    p_value: float = 1.0
    variables: dict[str, float] = field(default_factory=dict)
    axes: dict[str, float] = field(default_factory=dict)
    moments: tuple[tuple[float, float, float], ...] = ()
    lines: tuple[SpectralLine, ...] = ()
    formula: SparseFormula | None = None
    advice: str = ""
    misfit: tuple[Misfit, ...] = ()


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter with its 95 % interval; `flight` names the one of several flights that alone it holds for."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    flight: str = ""


@dataclass(frozen=True)
class Change:
    """A moment at which an effect changes, with its 95 % interval, s on the flight's clock."""

    time: float
    low: float
    high: float


@dataclass(frozen=True)
class Stretch:
    """What an effect is from `start` to `stop`, s on the flight's clock; where it is `absent` its parameters are those
    without effect."""

    start: float
    stop: float
    parameters: tuple[ParameterEstimate, ...]
    absent: bool = False


@dataclass(frozen=True)
class DriftingParameter:
    """A parameter that changes by and by: `value` (B,) at `times` (B,) s, and its 95 % interval, `low` to `high`."""

    name: str
    unit: str
    times: np.ndarray
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class OverTime:
    """An effect that is not of one size throughout the flight: `stretches` between `changes`, or parameters that
    `drift`."""

    stretches: tuple[Stretch, ...] = ()
    changes: tuple[Change, ...] = ()
    drift: tuple[DriftingParameter, ...] = ()

    @property
    def ended(self) -> bool:
        """Whether there is none of it at the end of the flight."""
        return bool(self.stretches) and self.stretches[-1].absent

    @property
    def courses(self) -> tuple[DriftingParameter, ...]:
        """Each parameter over time, to be drawn: of stretches both ends."""
        names = dict.fromkeys(p.name for s in self.stretches for p in s.parameters)
        drawn = []
        for name in names:
            ends = [(s, p) for s in self.stretches for p in s.parameters if p.name == name]
            times = np.array([t for s, _ in ends for t in (s.start, s.stop)])
            value, low, high = (
                np.repeat(x, 2) for x in zip(*((p.value, p.low, p.high) for _, p in ends), strict=True)
            )
            drawn.append(DriftingParameter(name, ends[0][1].unit, times, value, low, high))
        return (*drawn, *self.drift)

    @property
    def lines(self) -> tuple[str, ...]:
        """One line a parameter: what it is until when."""
        told = [
            f"{d.name} drifts: {_known(d.value[0], d.low[0], d.high[0])} {_unit(d.unit)}at {d.times[0]:.0f} s, "
            f"{_known(d.value[-1], d.low[-1], d.high[-1])} at {d.times[-1]:.0f} s"
            for d in self.drift
        ]
        names = dict.fromkeys(p.name for s in self.stretches for p in s.parameters)
        return (*told, *(f"{name} = {self._in_stretches(name)}" for name in names))

    def _in_stretches(self, name: str) -> str:
        told = []
        for k, stretch in enumerate(self.stretches):
            p = next((p for p in stretch.parameters if p.name == name), None)
            if stretch.absent:
                what = "none" if p is None or p.value == 0.0 else f"{p.value:.3g} {_unit(p.unit)}as believed"
            else:
                what = "unseen" if p is None else f"{_known(p.value, p.low, p.high)} {_unit(p.unit)}".strip()
            if k < len(self.changes):
                c = self.changes[k]
                told.append(f"{what.strip()} until {c.time:.2f} s [{c.low:.2f}, {c.high:.2f}]")
            else:
                told.append(f"{what.strip()} after")
        return ", ".join(told)


def _known(value: float, low: float, high: float) -> str:
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def _unit(unit: str) -> str:
    return "" if unit == "1" else f"{unit} "


@dataclass(frozen=True)
class Gusts:
    """Air that moves by itself: `acceleration` in m/s², RMS of each horizontal axis of the world, and `time_constant`
    in s, each with its 95 % interval; `speed` in m/s through the drag that was found, None where none was."""

    acceleration: ParameterEstimate
    time_constant: ParameterEstimate
    speed: float | None = None

    @property
    def text(self) -> str:
        """The gusts in words."""
        a, tau = self.acceleration, self.time_constant
        pushes = f"{a.value:.2g} m/s² [{a.low:.2g}, {a.high:.2g}] on world x and y"
        size = pushes if self.speed is None else f"{self.speed:.2g} m/s ({pushes})"
        return f"gusts of {size}, {tau.value:.2g} s [{tau.low:.2g}, {tau.high:.2g}]"


@dataclass(frozen=True)
class EffectVerdict:
    """What the flight says about one effect of the catalogue.

    `verdict` is one of missing, possible, minor, not_supported, not_excited, included. `variance_share` is the part
    of the squared error before that the effect takes away, given the others; `p_value` robust to autocorrelation.
    `rests_on` tells what the verdict stands on where more is left than noise. `undetermined` are parameters that
    this flight does not determine, `products` what it determines of them instead; `confidence` the probability that
    the verdict is right (of a possible effect that it or one it names is there), None where none is known. `over_time`
    tells how it changes in flight, None where it is of one size; `parameters` are then those of the end, or of the last
    stretch in which there was any of it.
    `seen_in` is "acceleration" or "rotation": shares and ranks are each among their own.
    """

    name: str
    verdict: str
    rank: int | None
    variance_share: float
    p_value: float
    parameters: tuple[ParameterEstimate, ...]
    indistinguishable_from: tuple[str, ...]
    advice: str
    seen_in: str = "acceleration"
    rests_on: str = ""
    undetermined: tuple[str, ...] = ()
    products: tuple[ParameterEstimate, ...] = ()
    confidence: float | None = None
    over_time: OverTime | None = None


@dataclass(frozen=True)
class RotationalRms:
    """Residual of the angular acceleration that the rotors' torques explain, RMS over all measured axes in rad/s², up
    to `bandwidth` Hz; `source` is what told it: the "gyroscope", or the "attitude" twice differentiated."""

    before: float
    after: float
    noise_floor: float
    bandwidth: float
    source: str = "gyroscope"


@dataclass(frozen=True)
class VehicleNumber:
    """A number of the vehicle as a flight shows it, with its 95 % interval, beside what its file believes (None where
    it says nothing). `told` says what it rests on."""

    name: str
    value: float
    low: float
    high: float
    unit: str
    believed: float | None
    told: str = ""


@dataclass(frozen=True)
class Identified:
    """What the rotation of a flight says of the vehicle: `numbers`, and which part of the variance of the angular
    acceleration below `bandwidth` Hz their model explains about each of the `axes`; `undetermined` are the names of
    those that it does not tell, for too little is explained. `source` as in `RotationalRms`."""

    flight: str
    numbers: tuple[VehicleNumber, ...]
    undetermined: tuple[str, ...]
    axes: tuple[str, ...]
    explained: tuple[float, ...]
    bandwidth: float
    source: str


@dataclass(frozen=True)
class StateError:
    """Error of the full state `horizon` s after a start, mean over `starts`: of the lengths of the errors of position
    (m), velocity (m/s) and body rates (rad/s), and of the angle between the attitudes (rad)."""

    horizon: float
    position: float
    velocity: float
    attitude: float
    rate: float
    starts: int


@dataclass(frozen=True)
class FullState:
    """The full state of a flight predicted from its inputs alone, by a model of the thrust and forces called `label`
    and by one of the rotation, whose `inputs` are "motors" or "commands"."""

    flight: str
    label: str
    inputs: str
    errors: tuple[StateError, ...]


@dataclass(frozen=True)
class IdentifiedVehicle:
    """A vehicle identified from its flights: `numbers` by each that shows them, `model` of the thrust and forces, the
    `delay` and `lag` in s between the `inputs` ("motors" or "commands") and the rotation, and the full state predicted
    on the flights that were `fitted` and on the one `held_out`, None without one."""

    numbers: tuple[Identified, ...]
    model: Model
    inputs: str
    delay: float
    lag: float
    fitted: tuple[FullState, ...]
    held_out: FullState | None


@dataclass(frozen=True)
class MotorShares:
    """What each of R rotors carries of the thrust, on the mean of a flight.

    `shares` (R) sum to 1, with half-widths of 95 % intervals in `errors`; `uneven` is the difference of the largest and
    the least over the mean. `rotor` is the number (from 1) of the one that stands out, 0 where none does: by `excess`,
    with its 95 % interval, more than the mean of the others, beyond what it carries in a healthy vehicle: in the
    flights `compared_with`, or where there are none in an even one. `changes` (R) since those flights are relative to
    the median rotor; `collective` is by what factor the vehicle is driven harder than in them, NaN without them or
    without motor commands. `losses` is the part of its thrust that this rotor would lack, with its interval; `centre`
    (2) the change of the centre of thrust, m, body x and y, with half-widths in `centre_errors`; `yaw` that of the
    balance about z, a part of all thrust.
    """

    shares: tuple[float, ...]
    errors: tuple[float, ...]
    compared_with: tuple[str, ...]
    changes: tuple[float, ...]
    collective: float
    uneven: float
    rotor: int
    excess: float
    excess_low: float
    excess_high: float
    losses: tuple[float, ...]
    centre: tuple[float, ...]
    centre_errors: tuple[float, ...]
    yaw: float

    @property
    def told(self) -> str:
        """What the shares say, in a sentence; empty where no rotor stands out."""
        if not self.rotor:
            return ""
        text = (
            f"rotor {self.rotor} carries {self.shares[self.rotor - 1]:.1%} of the commanded thrust".replace(
                "%", " %"
            )
        )
        more = f"{100 * self.excess:.0f} % [{100 * self.excess_low:.0f}, {100 * self.excess_high:.0f}]"
        if self.compared_with:
            text += f", {more} more beside the others than in {' and '.join(self.compared_with)}"
            if np.isfinite(self.collective):
                text += f", the whole vehicle is driven {100 * (self.collective - 1):+.0f} %"
            return text
        return f"{text}, {more} more than the others"

    @property
    def advice(self) -> str:
        """What would tell more."""
        if not self.rotor:
            return ""
        if self.compared_with:
            return (
                "a weaker rotor and a weight near it both raise its share: look at the propeller and weigh the "
                "vehicle; or record the gyroscope, and fly rolls, pitches and yaws both ways"
            )
        return (
            "a weaker rotor, a weight near it and the way the vehicle was built all do this: compare with a flight "
            "when it was healthy (--healthy FLIGHT), and weigh it"
        )


@dataclass(frozen=True)
class OneFlight:
    """What one of several flights adds to their common diagnosis; RMS in m/s² over all axes.

    `model` is the base with every effect found, with this flight's own numbers. `clock_shift` (s), `unexplained` and
    `left_out` as in `Diagnosis`.
    """

    flight: Flight
    model: Model
    rms_before: float
    rms_after: float
    noise_floor: float
    clock_shift: float | None
    unexplained: Unexplained
    left_out: dict[str, float]


@dataclass(frozen=True)
class SharedNumber:
    """A number of the vehicle, asked whether it is the same in all of several flights.

    `ratio` is twice the log likelihood ratio of one value for each flight against one for all, in independent samples;
    `p_value` the probability of as much by chance. `values` has one estimate for each flight. Where the flights differ,
    `apart` names those that disagree with the others, whose value is `common` (all, and None, where no two agree).
    """

    effect: str
    parameter: str
    ratio: float
    p_value: float
    values: tuple[ParameterEstimate, ...]
    common: ParameterEstimate | None
    apart: tuple[str, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether it is not the same in all flights."""
        return bool(self.apart)


@dataclass(frozen=True)
class Diagnosis:
    """The result of `diagnose`. RMS figures in m/s² over all axes, behind the stated bandwidth in Hz.

    `base` is the model that was asked about, `model` the same with every effect found, `effects` what the flight says
    of each. `axes` are the body axes that were measured (0 to 2). `validation_before` and `validation_after` are the
    RMS on the held-out flight, None without one. `clock_shift` is by how much later than its vehicle file says the
    command acts, s, None where no clock was fitted. `unexplained` tells whether predictable structure is left;
    `left_out` the share of the samples that did not count, by reason. `rotational` is the residual of the angular
    acceleration, None where it was not seen; `shares` is what each rotor carries, None where it was not logged;
    `alternatives` are other sets of effects that explain the flight nearly as well as those found. Of what changes in
    flight, `model` keeps what holds at its end. `gusts` are what is left of the air's own motion, None where none are
    seen.

    Of several flights fitted together, `flights` tells what each adds (empty for one), and `flight` is the last of
    them; `shared` asks of each number of the vehicle whether it is the same in all; `model` has what is the vehicle's,
    and `set_aside` names what is not: "wind"; `held_out_model` has the held-out flight's own numbers. RMS figures are
    then over all flights.
    """

    flight: Flight
    base: Model
    model: Model
    rms_before: float
    rms_after: float
    noise_floor: float
    bandwidth: float
    axes: tuple[int, ...]
    validation_before: float | None
    validation_after: float | None
    clock_shift: float | None
    effects: tuple[EffectVerdict, ...]
    unexplained: Unexplained
    left_out: dict[str, float]
    rotational: RotationalRms | None = None
    alternatives: tuple[tuple[str, ...], ...] = ()
    shares: MotorShares | None = None
    gusts: Gusts | None = None
    flights: tuple[OneFlight, ...] = ()
    shared: tuple[SharedNumber, ...] = ()
    set_aside: tuple[str, ...] = ()
    held_out_model: Model | None = None

    @property
    def differing(self) -> tuple[SharedNumber, ...]:
        """Numbers of the vehicle that are not the same in all of several flights."""
        return tuple(n for n in self.shared if n.differs)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What has to be said of a residual that rises with what was found, or that no vehicle has."""
        said: list[str] = []
        if self.rms_before > GRAVITY:
            said.append(
                f"the model is wrong by {self.rms_before:.0f} m/s², more than the weight: that is no effect; compare "
                "mass, hover_thrust and the unit of the thrust with the vehicle, and cut off what was not flown"
            )
        if not any(e.rank for e in self.effects):
            return tuple(said)
        if self.rms_after > RISES * self.rms_before:
            said.append(
                "the residual rises with what was found: an effect seen in the rotation does not show in the "
                "thrust; do not add it before another flight shows it"
            )
        if (
            self.validation_before is not None
            and (self.validation_after or 0.0) > RISES * self.validation_before
        ):
            said.append(
                "the held-out flight is predicted worse with what was found: it does not hold there, and may "
                "have begun in flight"
            )
        return tuple(said)

    @property
    def to_add(self) -> tuple[str, ...]:
        """Names of what is missing from a model of the vehicle as it is now, in order of rank: not what ended in
        flight, nor what is each flight's own."""
        missing = [e for e in self.effects if e.verdict == "missing"]
        now = [e for e in missing if e.over_time is None or not e.over_time.ended]
        return tuple(e.name for e in sorted(now, key=lambda e: e.rank or 0) if e.name not in self.set_aside)

    def named(self, verdict: str) -> tuple[str, ...]:
        """Names of the effects with this verdict, in order of rank."""
        return tuple(e.name for e in self.effects if e.verdict == verdict)
