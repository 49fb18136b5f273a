"""The companion put together: the wire, the control loop, the record, Zenoh."""

from __future__ import annotations

import ctypes
import gc
import sys
import time
from pathlib import Path
from typing import Any

import zenoh

from trueflight.companion.batteries import Batteries
from trueflight.companion.bookkeeping import Bookkeeping
from trueflight.companion.deployment import Deployment
from trueflight.companion.director import Director
from trueflight.companion.flight import FlightStateMachine
from trueflight.companion.law.control import ControlLaw
from trueflight.companion.mission_request import SMALL, read_json, read_request
from trueflight.companion.odometry import Odometry
from trueflight.companion.outcome import IDLE
from trueflight.companion.pose import PoseFeed
from trueflight.companion.readiness import Readiness
from trueflight.companion.records import Records
from trueflight.companion.settings import Settings
from trueflight.companion.signature import Signatures
from trueflight.companion.store import ModelStore
from trueflight.companion.telemetry import ATTACHED, Handler, Telemetry, make_event
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.companion.watchdog import Watchdog, raise_priority
from trueflight.companion.zenoh_session import INSECURE, open_planned, plan_session
from trueflight.models.contract import model_hash
from trueflight.models.design import Design, load_design
from trueflight.models.errors import InputError, shown
from trueflight.models.vehicle import load_vehicle

_M_ARENA_MAX = -8  # malloc.h
_RATE_TRIES = 10
_SWITCH_INTERVAL = 0.0001  # s


def _return_memory() -> None:
    """Give what starting needed back to the system, and let threads share one heap: small boards have little.

    Only where the C library is glibc; anywhere else there is nothing to do.
    """
    try:
        library = ctypes.CDLL(None)
        library.mallopt(_M_ARENA_MAX, 1)
        library.malloc_trim(0)
    except (OSError, AttributeError):
        return


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot make the folder ({error.strerror})") from None


class Companion:
    """Everything of one run of the companion.

    Building it connects and measures; it raises `InputError` where nothing can be flown (no autopilot, rates
    too low, port in use, files that do not fit). `run` flies missions until `stop`.
    """

    def __init__(self, settings: Settings) -> None:
        settings = settings.checked()
        vehicle = load_vehicle(settings.vehicle)
        design = load_design(settings.design_path, vehicle)
        law = ControlLaw(vehicle, design, settings.limits)
        records, models = Path(settings.records), Path(settings.models)
        for folder in (records, models):
            _make(folder)
        keys = settings.own_keys()
        plan = plan_session(settings.zenoh, keys, vehicle.name)
        signatures = Signatures(models, vehicle.name, keys, settings.unsigned_models, bool(plan.exposed))
        store = ModelStore(models, vehicle, settings.guard.deadline, signatures.stored)
        signatures.sweep()
        session = open_planned(plan)
        try:
            batteries = Batteries(settings.battery, vehicle.nominal_voltage)
            self.link = VehicleLink(settings.connect, settings.timeout, settings.system, batteries)
        except InputError:
            session.close()
            raise
        self._signatures = signatures
        self.access = {
            "keys": keys.certificate if keys is not None else "",
            "exposed": list(plan.exposed),
            "loose": plan.loose,
            "listen": list(plan.listen),
        }
        self.watchdog = Watchdog()
        self._priority = settings.realtime
        self._vehicle_time_us = self._errors_told = 0
        self._told_by_autopilot = ""
        self.vehicle = vehicle
        self.flight = FlightStateMachine(
            law, settings.safety, self.emit, settings.trim, settings.agreement, settings.observer
        )
        self._direct(settings, design, store)
        self._open(session, settings, records)
        if plan.exposed:
            self.emit("error", "insecure", f"{INSECURE}; it {' and '.join(plan.exposed)}")
        for reason in store.refused_at_start:
            self.emit("warning", "model_refused", f"no longer accepted: {reason}")
        self._listen(settings.rate)

    def _direct(self, settings: Settings, design: Design, store: ModelStore) -> None:
        """What flies missions and brings models into flights."""
        link, flight, vehicle = self.link, self.flight, self.vehicle
        safety, rate, folder = settings.safety, settings.rate, Path(settings.records)
        self.books = Bookkeeping(self._write_tick, lambda text: self.emit("warning", "ticks_dropped", text))
        self.records = Records(
            folder, vehicle, design, rate, settings.require_record, self.emit, self.books.flush
        )
        self.readiness = Readiness(link, flight, self.records, safety, vehicle, rate)
        self.deployment = Deployment(store, flight, settings.guard, settings.shadow, self.emit)
        self.director = Director(
            link, flight, self.records, self.readiness, self.deployment, safety, vehicle.name, self.emit
        )

    def _open(self, session: zenoh.Session, settings: Settings, records: Path) -> None:
        """The ground's end, and that of mocap poses where they are on."""
        handlers: dict[str, Handler] = {
            "status": lambda payload, parameters: self._status(),
            "mission": lambda payload, parameters: self.director.request(read_request(payload)),
            "model": self._model,
        }
        self.telemetry = Telemetry(session, self.vehicle.name, handlers, records)
        self.pose: PoseFeed | None = None
        if settings.pose.enabled:
            self.pose = self.readiness.pose = PoseFeed(settings.pose, self.link.send_pose, self.emit)
            self.link.share_clock()
            self.telemetry.subscribe("pose", self.pose.take, self.pose.refuse_size)

    def _listen(self, rate: float) -> None:
        """Answer to what the vehicle tells from here on."""
        self.link.on_odometry = self._control
        self.link.on_error = self._wire_error
        self.link.on_blind = self.watchdog.tick  # nothing to control by, but the control thread is well
        self.link.messages.on_notice = self._autopilot_tells
        self.link.others.tell(lambda text: self.emit("info", "others", text))
        try:
            self._settle_rates(rate)
        except InputError:
            self.close()
            raise
        self.link.read_capacities()
        batteries = self.link.latest.batteries
        if len(batteries.connected) > 1 or batteries.why_not:
            self.emit("warning", "batteries", batteries.why_not or f"several batteries: {batteries.words}")

    def run(self) -> None:
        """Fly missions until `stop`; the calling thread must be the one that may block."""
        # The control thread allocates no cycles; a collection for others could stop it for 10 ms.
        gc.collect()
        gc.freeze()
        gc.disable()
        _return_memory()
        # How long another Python thread may keep the control thread from running.
        sys.setswitchinterval(_SWITCH_INTERVAL)
        self.director.run()

    def stop(self) -> None:
        """Land what is in the air and let `run` return; safe from a signal handler."""
        self.watchdog.stopping()
        self.director.stopping.set()

    def close(self) -> None:
        """Disconnect from vehicle and ground."""
        self.link.on_odometry = lambda odometry: None
        if self.pose is not None:
            self.pose.close()
        self.link.close()
        self.books.close()
        self.telemetry.close()

    def emit(self, level: str, kind: str, text: str) -> None:
        """Tell an event to the ground and to the record; any thread, never blocks."""
        event = make_event(level, kind, text, self._vehicle_time_us)
        self.telemetry.event(event)
        self.records.event(event)

    def _control(self, odometry: Odometry) -> None:
        """The control loop: one odometry message in, at most one setpoint out, then the book-keeping."""
        if self._priority:
            self._raise_priority()
        latest = self.link.latest
        outcome = self.flight.tick(odometry, latest)
        latency = 1e-9 * (time.monotonic_ns() - odometry.host_time_ns)
        if self.flight.may_leave(outcome, odometry.age + latency):
            step = outcome.step
            assert step is not None
            self.link.send_rates(odometry.vehicle_time_us, step.thrust_command, step.command.body_rate)
            latency = 1e-9 * (time.monotonic_ns() - odometry.host_time_ns)
            outcome.age = odometry.age + latency
        self.flight.watch(latest)
        self._vehicle_time_us = odometry.vehicle_time_us
        self.books.note(odometry, latest, outcome, latency)
        self.watchdog.tick()

    def _write_tick(self, data: bytes, vehicle_time_us: int, host_time_ns: int) -> None:
        """The record first: it must not wait for the network."""
        self.records.tick(data, vehicle_time_us, host_time_ns)
        self.telemetry.tick(data)

    def _raise_priority(self) -> None:
        """Once, by the control thread itself, which is MAVSDK's."""
        priority, self._priority = self._priority, 0
        reason = raise_priority(priority)
        if reason:
            self.emit("warning", "realtime", f"the control thread has no real-time priority: {reason}")
        else:
            self.emit("info", "realtime", f"the control thread runs at real-time priority {priority}")

    def _autopilot_tells(self, text: str) -> None:
        """What the autopilot says of failsafes and switches belongs into the record of a flight, once."""
        if self.flight.phase == IDLE:
            self._told_by_autopilot = ""
        elif text != self._told_by_autopilot:
            self._told_by_autopilot = text
            self.emit("warning", "autopilot", text)

    def _wire_error(self, text: str) -> None:
        self._errors_told += 1
        if self._errors_told <= 5:
            self.emit("warning", "malformed_message", text)

    def _status(self) -> dict[str, Any]:
        """What the companion does, and who may make it do something else."""
        status = self.director.status()
        known = [*status["models"], *([status["staged"]] if status["staged"] else [])]
        signers = {entry["hash"]: self._signatures.signer(entry["hash"]) for entry in known}
        return {
            **status,
            "access": {**self.access, "signers": signers},
            "requests_refused": self.telemetry.refused,
        }

    def _model(self, payload: bytes, parameters: dict[str, str]) -> dict[str, Any]:
        for name in parameters:
            if name not in ("shadow", ATTACHED):
                raise InputError(f"unknown parameter {shown(name)} of a model; known: shadow")
        if payload[:1] != b"{":
            signature = parameters.get(ATTACHED, "").encode()
            reason = self._signatures.admit(payload, signature)
            if reason:
                self.emit("warning", "model_refused", f"{model_hash(payload)}: {reason}")
                return {"accepted": False, "reason": reason}
            if signature:
                name = model_hash(payload)
                self.emit("info", "model_signed", f"{name}: {self._signatures.told(name)}")
            shadow = parameters.get("shadow")
            try:
                return self.deployment.deploy(payload, float(shadow) if shadow is not None else None)
            except ValueError:
                return {"accepted": False, "reason": f"shadow = {shown(shadow)} is not a number of seconds"}
        if len(payload) > SMALL:
            raise InputError("no ONNX file, and too long for a command; send list, rollback or an ONNX file")
        command = read_json(payload).get("command")
        if command == "list":
            return {"accepted": True, "reason": "", **self.deployment.store.describe()}
        if command == "rollback":
            return self.deployment.roll_back()
        return {
            "accepted": False,
            "reason": f"unknown command {shown(command)}; send list, rollback or an ONNX file",
        }

    def _settle_rates(self, rate: float) -> None:
        """Ask for rates until they arrive; an autopilot that has just started takes a moment."""
        for _ in range(_RATE_TRIES):
            self.link.commands.request_rates(rate)
            self.readiness.rates = self.link.measure(1.0)
            reason = self.readiness.rates_too_low(self.readiness.rates)
            if not reason:
                return
        raise InputError(f"{self.link.address}: {reason}")
