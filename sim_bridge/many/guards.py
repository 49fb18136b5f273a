"""The guards and watches of many vehicles, with one model each: `companion.law.guard` and `.watch` for one of them.

Deadlines are not watched: many inferences are made at once.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import onnxruntime

from trueflight.companion.law.guard import ACTIVE, FADING_IN, LONGEST_STEP, TRIPPED
from trueflight.companion.law.inference import Model
from trueflight.companion.law.model_check import check_model
from trueflight.companion.law.watch import SMOOTHING, GuardLimits, margin
from trueflight.models import contract
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle
from trueflight.sim_bridge.many.across import stacked
from trueflight.sim_bridge.plan import Plan

ALONE = 3
"""Flights of one model up to which it is evaluated as on board; more go through the runtime together, in 32 bits."""


class Guards:
    """Between the models and the commands of N vehicles; the correction fades in from the first step on.

    `applied` (3, N) are the corrections of the last step, m/s², heading frame; `engaged` (N,) to which share models act
    now; `actuation` (5, N) what each knows of the path from command to motion, in the order of `Actuation`.
    """

    def __init__(self, plans: Sequence[Plan]) -> None:
        count = len(plans)
        known: dict[tuple[bytes, Vehicle], Model] = {}
        models = [_accepted(plan, known) for plan in plans]
        self.limits = limits = GuardLimits()
        self._slew, self._authority = np.array([limits.slew]).T, np.array([limits.authority]).T
        width = max(len(model.info.features) for model in models)
        self.wants_yaw = width > len(contract.FEATURES)
        self._features = [[one.name for one in model.info.features] for model in models]
        ranges = np.full((3, width, count), np.inf)
        ranges[0] = -np.inf  # what a model does not take is always in range
        for i, model in enumerate(models):
            for k, one in enumerate(model.info.features):
                ranges[:, k, i] = one.low, one.high, margin(one, limits.margin)
        self._low, self._high, self._margin = ranges
        known_actuation = [model.info.actuation for model in models]
        self._actuation = stacked(
            [
                (a.rate_delay, a.rate_lag, a.rate_integral, a.thrust_delay, a.thrust_lag)
                for a in known_actuation
            ]
        )
        self._groups = [
            (_Group(model, onnx), np.array([i for i in range(count) if models[i] is model]))
            for (onnx, _), model in known.items()
        ]
        self._weight, self._saturated, self._outside = np.zeros(count), np.zeros(count), np.zeros(count)
        self._live = np.ones(count, dtype=bool)
        self._evidence = _Evidence(count)
        self._reasons = [""] * count
        self.applied = np.zeros((3, count))
        self.inference = np.zeros(count)

    @property
    def engaged(self) -> np.ndarray:
        """Share, 0 to 1, to which models act now."""
        return self._weight

    @property
    def actuation(self) -> np.ndarray:
        """What models that act know of the path from command to motion; nothing where none does."""
        return self._actuation * (self._weight > 0.0)

    def statuses(self) -> list[str]:
        """As in ticks: `fading_in`, `active`, or `tripped: REASON`."""
        return [
            f"{TRIPPED}: {reason}" if reason else ACTIVE if weight == 1.0 else FADING_IN
            for reason, weight in zip(self._reasons, self._weight.tolist(), strict=True)
        ]

    def step(
        self,
        rows: np.ndarray,
        ahead: np.ndarray,
        dt: float,
        height: np.ndarray,
        measured: np.ndarray,
        believed: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Corrections applied (3, N), their rates (2, N), what models returned (3, N), and what those that act say of
        now (3, N).

        `rows` (4, F, N) are the features when tilt acts, `ahead` (N,) s later, when thrust acts, and now; `height` (N,)
        is in m above the ground, `measured` (3, N) the error accelerations that accelerometers show now, where they are
        `believed` (N,).
        """
        dt = min(LONGEST_STEP, dt)
        self._weight = np.where(self._live, np.minimum(1.0, self._weight + dt / self.limits.fade), 0.0)
        raws = np.zeros((len(rows), 3, len(self._live)))
        for group, where in self._groups:
            here = where[self._live[where]]
            if len(here):
                begin = time.thread_time()
                raws[:, :, here] = group.answers(rows[:, :, here])
                self.inference[where] = (time.thread_time() - begin) / len(here)
        shares = self._shares(rows)
        axes, explained = self._evidence.step(raws[3], measured, believed, dt)
        trust = np.maximum(shares.min(axis=1), explained)
        raws = self._judged(raws, shares, trust.min(axis=0) == 0.0, axes, dt)
        weight = self._weight
        said = trust[:, None] * np.clip(raws, -self._authority, self._authority)
        wanted = said * weight
        most = self.limits.authority[2] * height / self.limits.ground
        lift = np.minimum(wanted[2, 2], np.where(most > 0.0, most, 0.0))
        step = self._slew * dt
        asked = np.clip(np.array([wanted[0, 0], wanted[0, 1], lift]), -self._authority, self._authority)
        self.applied = np.clip(asked, self.applied - step, self.applied + step)
        rate = (wanted[1, :2] - wanted[0, :2]) / ahead
        slew = self._slew[:2]
        raw = np.array([raws[0, 0], raws[0, 1], raws[2, 2]])
        return self.applied, np.clip(rate, -slew, slew), raw, said[3] * (weight > 0.0)

    def _shares(self, rows: np.ndarray) -> np.ndarray:
        """How far each feature (4, F, N) may be believed: 1 in the training range, 0 a margin beyond it."""
        inside = rows[:, : len(self._low)]
        beyond = np.maximum(self._low - inside, inside - self._high)
        beyond = np.where(np.isnan(inside), np.inf, np.maximum(beyond, 0.0))
        return np.where(beyond == 0.0, 1.0, np.maximum(1.0 - beyond / self._margin, 0.0))

    def _judged(
        self, raws: np.ndarray, shares: np.ndarray, outside: np.ndarray, axes: np.ndarray, dt: float
    ) -> np.ndarray:
        """Trip what cannot be right; what models returned, nothing where that is not finite.

        `axes` (3, N) are those that the accelerometer bears out.
        """
        limits, live = self.limits, self._live
        finite = np.isfinite(raws).all(axis=(0, 1))
        raws = np.where(finite, raws, 0.0)
        excesses = (np.abs(raws) / self._authority).max(axis=0)
        excess, alone = excesses.max(axis=0), ((excesses > 1.0) & ~axes).any(axis=0)
        self._saturated = np.where(alone, self._saturated + dt, 0.0)
        self._outside = np.where(outside, self._outside + dt, 0.0)
        wild, stuck = excess > limits.absurd, self._saturated > limits.patience
        gone = live & (~finite | wild | stuck | (self._outside > limits.patience))
        for i in np.flatnonzero(gone).tolist():
            worst = self._features[i][int(shares[:, : len(self._features[i]), i].min(axis=0).argmin())]
            self._reasons[i] = (
                "the model returned a number that is not finite"
                if not finite[i]
                else f"a correction {excess[i]:.0f} times its authority"
                if wild[i]
                else f"beyond its authority for {limits.patience:g} s"
                if stuck[i]
                else f"{worst} outside its training range for {limits.patience:g} s"
            )
        if gone.any():
            self._live = live & ~gone
            self._weight = np.where(gone, 0.0, self._weight)
        return raws


class _Evidence:
    """What the accelerometers of N vehicles say of their models' answers: `companion.law.watch.Evidence` for one."""

    def __init__(self, count: int) -> None:
        self._seen = np.zeros(count)
        self._measured, self._said = np.zeros((3, count)), np.zeros((3, count))

    def step(
        self, said: np.ndarray, measured: np.ndarray, believed: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of each axis (3, N) whether what is measured is nearer to what the model says than to nothing, and what share
        (N,) of the squares of what is measured it explains."""
        believed = believed & np.isfinite(measured).all(axis=0)
        begins = believed & (self._seen == 0.0)
        self._measured = np.where(begins, measured, self._measured)
        self._said = np.where(begins, said, self._said)
        share = dt / (SMOOTHING + dt)
        self._measured = np.where(
            believed, self._measured + share * (measured - self._measured), self._measured
        )
        self._said = np.where(believed, self._said + share * (said - self._said), self._said)
        self._seen = np.where(believed, self._seen + dt, 0.0)
        left, all_ = np.abs(self._measured - self._said), np.abs(self._measured)
        long = self._seen >= 2.0 * SMOOTHING
        (a, b, c), (u, v, w) = self._measured, self._measured - self._said
        squares = a * a + b * b + c * c
        known = long & (squares > 0.0)
        share = 1.0 - (u * u + v * v + w * w) / np.where(known, squares, 1.0)
        return (left < all_) & long, np.where(known, np.maximum(share, 0.0), 0.0)


class _Group:
    """One model, for several vehicles."""

    def __init__(self, model: Model, onnx: bytes) -> None:
        self._model, self._width = model, len(model.info.features)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        session = onnxruntime.InferenceSession(onnx, options, providers=["CPUExecutionProvider"])
        self._session = None if session.get_inputs()[0].shape[0] == 1 else session

    def answers(self, rows: np.ndarray) -> np.ndarray:
        """Accelerations (4, 3, n) for features (4, F, n): of each moment, x, y and z of the heading frame."""
        moments, _, count = rows.shape
        flat = rows[:, : self._width].transpose(2, 0, 1).reshape(-1, self._width)
        if self._session is None or count <= ALONE:
            lists = flat.tolist()
            found = [self._model.rows(lists[i : i + moments]) for i in range(0, len(lists), moments)]
            answers = np.array(found, dtype=float)
        else:
            given = {contract.INPUT_NAME: flat.astype(np.float32)}
            if deployed := self._model.info.deployed:
                given[contract.PARAMETERS_NAME] = np.tile(np.array(deployed, np.float32), (len(flat), 1))
            (out,) = self._session.run([contract.OUTPUT_NAME], given)
            answers = np.asarray(out, dtype=float).reshape(count, moments, 3)
        return answers.transpose(1, 2, 0)


def _accepted(plan: Plan, known: dict[tuple[bytes, Vehicle], Model]) -> Model:
    assert plan.model is not None
    key = plan.model, plan.vehicle
    if key not in known:
        verdict = check_model(*key)
        if verdict.model is None:
            raise InputError(f"--model: refused: {verdict.reason}")
        known[key] = verdict.model
    return known[key]
