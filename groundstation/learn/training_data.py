"""From flights to a training set: features, and the acceleration that linear model and effects leave unexplained.

Both sides pass the project's low-pass: the target as the comparison of a model with a flight does it, and the features
as well, so that a network sees the motion that the measured acceleration belongs to and little of the sensors' noise.
Thrust is the commanded one after the known delay and lag, and effects with memory act in the base's prediction: what is
left to learn is static. Samples that a comparison leaves out are left out here, and those on or just above the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from trueflight.groundstation.evaluate.compare import heading_acceleration, heading_noise
from trueflight.groundstation.identify.fitting import with_clock
from trueflight.groundstation.measured.measurement import measure
from trueflight.models.contract import FEATURES, YAW_FEATURES
from trueflight.models.effect import Stage
from trueflight.models.errors import InputError
from trueflight.models.features import feature_names
from trueflight.models.flight import Flight
from trueflight.models.model import Model
from trueflight.models.network import features_of_motion
from trueflight.models.prediction import apply_effects, motion_of_flight, specific_force

VALIDATION_SHARE = 1.0 / 3.0
"""Of the samples, as in the paper."""
FLIGHTS_TO_SPLIT = 9
"""From so many flights on whole flights are held out; with fewer, long blocks, or a manoeuvre would be missing."""
LONGEST_BLOCK, SHORTEST_BLOCK = 20.0, 4.0
"""s of a block that is trained on or held out as one."""
GAP = 1.0
"""s left out on each side of the border between a trained and a held-out block: longer than filters and lags reach."""
TOUCHING = 0.03
"""m above ground: lower, the ground may carry the vehicle, and its push would be taken for thrust."""
AFTER_TOUCHING = 0.5
"""s around such a moment that are left out as well: filters spread the shock."""
LEAST_SECONDS = 20.0
"""s of usable flight below which nothing is trained."""
_VARIES = {"m": 0.05, "m/s": 0.1, "V": 0.05, "1": 0.002, "N": 0.02}
"""Least standard deviation of a feature, by unit, from which a network may use it: below it is noise and trim."""


@dataclass(frozen=True)
class Samples:
    """N samples of one or more flights.

    `features` (N, F) in the order of `names`, units as in `models.contract`; `target` (N, 3) is the measured minus the
    base model's acceleration, heading frame, m/s², with noise of RMS `noise` (3,); `flight` (N,) numbers the flights
    of `flights`, `t` (N,) is each flight's own clock in s and `block` (N,) the unit that is held out as a whole.
    `left_out` tells of each flight that nothing could be taken from, and why.
    """

    names: tuple[str, ...]
    features: np.ndarray
    target: np.ndarray
    noise: np.ndarray
    flight: np.ndarray
    t: np.ndarray
    block: np.ndarray
    flights: tuple[str, ...]
    data_hash: str
    period: float
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.target)

    @property
    def seconds(self) -> float:
        """Flight time of all samples."""
        return len(self) * self.period

    @property
    def noise_floor(self) -> float:
        """RMS over the axes that sensor noise alone leaves, m/s²."""
        return float(np.sqrt(np.mean(self.noise**2)))

    def only(self, rows: np.ndarray) -> Samples:
        """Some of the samples, by mask or number."""
        part = {k: getattr(self, k)[rows] for k in ("features", "target", "flight", "t", "block")}
        return replace(self, **part)

    def with_features(self, names: Sequence[str]) -> Samples:
        """The samples with some of the features only."""
        return replace(
            self, names=tuple(names), features=self.features[:, [self.names.index(n) for n in names]]
        )

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of the features that vary: a network can learn nothing of the others, and must not use them."""
        units = {**FEATURES, **YAW_FEATURES}
        spread = self.features.std(axis=0)
        return tuple(n for n, s in zip(self.names, spread, strict=True) if s > _VARIES[units[n]])


def samples_of_flights(
    flights: Sequence[Flight],
    model: Model,
    bandwidth: float | None = None,
    advance: Callable[[], None] = lambda: None,
) -> Samples:
    """The training set of `flights` for a network beside the effects of `model` (a network of its own is ignored).

    `advance` is called after each flight. Raises `InputError` where a flight lacks position, velocity, attitude or
    command, or where too little of all flights can be used; one flight of many may be too short or too wild.
    """
    names = feature_names(model)
    parts, left_out = [], []
    for number, flight in enumerate(flights):
        for column in ("position", "velocity", "quaternion", "thrust_command"):
            flight.column(column)
        try:
            parts.append(_of_flight(flight, number, model, names, bandwidth))
        except InputError as error:
            if len(flights) == 1:
                raise
            left_out.append(str(error))
        advance()
    if not parts:
        raise InputError(f"none of {len(flights)} flights can be used; the last one: {left_out[-1]}")
    samples = Samples(
        names=names,
        features=np.concatenate([p.features for p in parts]),
        target=np.concatenate([p.target for p in parts]),
        noise=np.sqrt(np.average([p.noise**2 for p in parts], axis=0, weights=[len(p) for p in parts])),
        flight=np.concatenate([p.flight for p in parts]),
        t=np.concatenate([p.t for p in parts]),
        block=np.zeros(sum(map(len, parts)), dtype=int),
        flights=tuple(f.name for f in flights),
        data_hash="+".join(f.data_hash for f in flights),
        period=float(np.median([p.period for p in parts])),
        left_out=tuple(left_out),
    )
    if samples.seconds < LEAST_SECONDS:
        raise InputError(
            f"only {samples.seconds:.0f} s of flight can be trained on; give {LEAST_SECONDS:g} s or more, "
            "better half an hour"
        )
    return replace(samples, block=blocks(samples))


def _of_flight(
    flight: Flight, number: int, model: Model, names: tuple[str, ...], bandwidth: float | None
) -> Samples:
    measurement = measure(flight, bandwidth, thin=False)
    motion = motion_of_flight(flight)
    chain = with_clock(measure(flight, bandwidth), model.effect_chain())
    base = measurement.see(specific_force(apply_effects(motion, chain)))
    target = heading_acceleration(motion, measurement.value) - heading_acceleration(motion, base)
    delivered = apply_effects(
        motion, [(effect, values) for effect, values in chain if effect.stage is Stage.COMMAND]
    )
    features = measurement.smooth(np.asarray(features_of_motion(delivered, names)))
    used = measurement.used & np.all(np.isfinite(target), axis=1) & np.all(np.isfinite(features), axis=1)
    touching = ndimage.binary_dilation(
        flight.column("position")[:, 2] < TOUCHING, iterations=max(1, round(AFTER_TOUCHING / flight.dt))
    )
    used &= ~touching
    count = int(used.sum())
    return Samples(
        names=names,
        features=features[used].astype(np.float32),
        target=target[used].astype(np.float32),
        noise=heading_noise(measurement, motion),
        flight=np.full(count, number),
        t=flight.t[used] - flight.t[0],
        block=np.zeros(count, dtype=int),
        flights=(flight.name,),
        data_hash=flight.data_hash,
        period=flight.dt,
    )


def blocks(samples: Samples) -> np.ndarray:
    """Number of the unit (N,) that each sample is held out with: its flight, or a long block of it."""
    if len(samples.flights) >= FLIGHTS_TO_SPLIT:
        return samples.flight
    length = float(np.clip(samples.seconds / 12.0, SHORTEST_BLOCK, LONGEST_BLOCK))
    place = np.stack([samples.flight, (samples.t / length).astype(int)], axis=1)
    return np.unique(place, axis=0, return_inverse=True)[1].ravel()


def split(samples: Samples, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Masks (N,) of the samples to train on and of those held out: whole blocks, two thirds to one third, by `seed`.

    Samples within `GAP` of a border between the two inside one flight are in neither.
    """
    generator = np.random.default_rng(seed)
    size = np.bincount(samples.block)
    order = generator.permutation(len(size))
    wanted = VALIDATION_SHARE * size.sum()
    held = np.zeros(len(size), dtype=bool)
    for block in order:
        # a block goes to the side that this brings nearer to a third
        if abs(size[held].sum() + size[block] - wanted) < abs(size[held].sum() - wanted):
            held[block] = True
    if held.all() or not held.any():
        raise InputError(f"{len(size)} blocks of flight cannot be split in two; give a longer flight")
    validation = held[samples.block]
    train = ~validation
    near = np.zeros(len(samples), dtype=bool)
    # samples are in order of flight and time: a border is where neighbours of one flight differ in side
    borders = np.flatnonzero(
        (validation[1:] != validation[:-1]) & (samples.flight[1:] == samples.flight[:-1])
    )
    for border in borders:
        same = samples.flight == samples.flight[border]
        middle = 0.5 * (samples.t[border] + samples.t[border + 1])
        near |= same & (np.abs(samples.t - middle) < GAP)
    return train & ~near, validation & ~near
