"""What could keep this machine from flying a vehicle: serial port, rates, clock, disk, processor, Zenoh, models.

Each check looks and tells what to do; none changes anything. They read Linux's own files, so that what is not there
(another system, a container) is told as such and is no failure.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import platform
import re
import resource
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from trueflight.companion.access import access_findings
from trueflight.companion.address import serial_ports
from trueflight.companion.findings import FAIL, NOTE, OK, WARN, Finding
from trueflight.companion.inspection import inspect
from trueflight.companion.message_rates import link_too_slow, odometry_too_low
from trueflight.companion.settings import Settings
from trueflight.companion.store import live_file
from trueflight.companion.vehicle_link import NoAutopilot, VehicleLink
from trueflight.companion.zenoh_session import plan_session
from trueflight.models.design import load_design
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle, load_vehicle

_PACKAGES = ("mavsdk", "eclipse-zenoh", "onnxruntime", "mcap", "protobuf", "numpy")
_BAUD = 921_600
_RECORD_RATE = 60_000
"""bytes/s that a record grows by at 100 Hz, at most."""
_SCRATCH = 4 << 20
_HOT = 75.0  # degrees Celsius; a Raspberry Pi slows down at 80
_LATE = 0.005  # s; half a control period at 100 Hz
_NAPS = 100
_PORT = re.compile(r"^(?:tcp|udp|tls|quic|ws)/(.+):(\d+)$")
_LOOPBACK = ("127.", "localhost", "[::1]")

Check = Callable[[Settings, Path], Iterator[Finding]]


def examine(
    settings: Settings, root: Path, progress: Callable[[str], None] = lambda what: None
) -> list[Finding]:
    """Every check in turn; `root` is where the system's files are ('/'). `progress` is told what is next."""
    found: list[Finding] = []
    for name, check in CHECKS.items():
        progress(name)
        found += check(settings, root)
    return found


def _machine(settings: Settings, root: Path) -> Iterator[Finding]:
    kind, version = platform.machine(), platform.python_version()
    wide = sys.maxsize > 2**32
    advice = "" if wide else "install a 64-bit system: ONNX Runtime has no packages for 32-bit Arm"
    yield Finding("machine", f"{kind}, Python {version}", "", advice, OK if wide else FAIL)
    missing = []
    for name in _PACKAGES:
        try:
            importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        yield Finding(
            "packages", f"missing: {', '.join(missing)}", "", 'pip install "trueflight[companion]"', FAIL
        )
    available = _number_after("MemAvailable:", root / "proc/meminfo")
    if available is not None:
        state = OK if available > 200e3 else WARN
        yield Finding(
            "memory",
            f"{available / 1e3:.0f} MB free",
            "",
            "" if state == OK else "stop what is not needed",
            state,
        )


def _serial(settings: Settings, root: Path) -> Iterator[Finding]:
    scheme, _, rest = settings.connect.partition("://")
    if not scheme.startswith("serial"):
        yield Finding("link", settings.connect, "", "", OK)
        return
    name, _, speed = rest.rpartition(":") if rest.rpartition(":")[2].isdigit() else (rest, "", "")
    path = root / name.lstrip("/")
    if not path.exists():
        there = ", ".join(serial_ports(root)) or "none"
        advice = f"serial ports here: {there}; on a Raspberry Pi enable_uart=1 in config.txt, then restart"
        yield Finding("serial port", f"{name} is not there", "", advice, FAIL)
        return
    if os.access(path, os.R_OK | os.W_OK):
        yield Finding("serial port", name, "", "", OK)
    else:
        advice = "sudo usermod -aG dialout $USER, then log in again"
        yield Finding("serial port", f"{name}: no permission", "", advice, FAIL)
    if speed.isdigit() and int(speed) >= _BAUD:
        yield Finding("baud rate", speed, "", "", OK)
    else:
        advice = f"100 Hz of control need {_BAUD} (PX4: SER_TEL2_BAUD {_BAUD} 8N1)"
        yield Finding("baud rate", speed or "not given", "", advice, WARN)
    short = Path(name).name
    aliases = {short, "serial0"} if path.resolve() == (root / "dev/serial0").resolve() else {short}
    words = _text(root / "proc/cmdline").split()
    consoles = {
        word.removeprefix("console=").partition(",")[0] for word in words if word.startswith("console=")
    }
    if consoles & aliases:
        advice = "raspi-config, Interface, Serial: no login shell, hardware on; then restart"
        yield Finding("console", f"the system's console is on {short}", "", advice, FAIL)
    if short == "ttyS0" and "Raspberry Pi" in _text(root / "proc/device-tree/model"):
        advice = (
            "its clock changes with the processor's; dtoverlay=disable-bt in config.txt, use /dev/ttyAMA0"
        )
        yield Finding("serial port", "ttyS0 is the mini UART", "", advice, WARN)


def _rates(settings: Settings, root: Path) -> Iterator[Finding]:
    try:
        link = VehicleLink(settings.connect, settings.timeout, settings.system)
    except InputError as error:
        silent = isinstance(error, NoAutopilot)
        cable = "; power it; cable: TX to RX; PX4: MAV_1_CONFIG 102 (TELEM2), MAV_1_MODE 2 (Onboard)"
        yield Finding("autopilot", "none", "", f"{error}{cable if silent else ''}", FAIL)
        return
    try:
        link.commands.request_rates(settings.rate)
        time.sleep(0.5)
        rates = link.measure(2.0)
        reason = odometry_too_low(rates, settings.rate)
        if link.ambiguous:
            yield Finding("autopilot", "several", "", link.ambiguous, FAIL)
        for sender in link.others.describe():
            yield Finding("heard as well", sender, "", "nothing of it is used", NOTE)
        yield Finding(
            "autopilot", f"{link.commands.autopilot_version()}, {link.latest.flight_mode}", "", "", OK
        )
        yield Finding("odometry", f"{rates.odometry:.0f} Hz", "", reason, FAIL if reason else OK)
        slow = rates.imu < 0.5 * min(settings.rate, 100.0)
        advice = link_too_slow("HIGHRES_IMU") if slow else ""
        yield Finding("accelerometer", f"{rates.imu:.0f} Hz", "", advice, FAIL if slow else OK)
        if rates.longest_gap > settings.safety.odometry_gap:
            advice = "this machine or the link is too busy"
            yield Finding("odometry", f"a gap of {1e3 * rates.longest_gap:.0f} ms", "", advice, FAIL)
    finally:
        link.close()


def _clock(settings: Settings, root: Path) -> Iterator[Finding]:
    needed = settings.pose.enabled and settings.pose.clock == "sender"
    kept = _kept_by_ntp()
    advice = "install chrony, and let it ask a server that the ground's machines ask too"
    if kept is None:
        yield Finding("clock", "cannot be asked", "", "", NOTE)
    elif kept:
        yield Finding("clock", "kept by NTP", "", "", OK)
    else:
        why = "; the time stamps of mocap poses need it" if needed else "; records are named by it"
        yield Finding("clock", "not kept by NTP", "", advice + why, FAIL if needed else WARN)
    if time.gmtime().tm_year < 2025:
        yield Finding(
            "clock",
            time.strftime("%Y-%m-%d", time.gmtime()),
            "",
            "no clock chip, no network: set the time",
            WARN,
        )


def _kept_by_ntp() -> bool | None:
    """Whether the kernel's clock is synchronised, by adjtimex(2); None where it cannot be asked."""
    if sys.platform != "linux":
        return None
    buffer = ctypes.create_string_buffer(512)  # struct timex, all zero: ask, change nothing
    try:
        state = ctypes.CDLL(None).adjtimex(buffer)
    except (OSError, AttributeError):
        return None
    unsynchronised = 5  # TIME_ERROR
    return None if state < 0 else state != unsynchronised


def _disk(settings: Settings, root: Path) -> Iterator[Finding]:
    folder = Path(settings.records).absolute()
    there = next(parent for parent in (folder, *folder.parents) if parent.is_dir())
    free = shutil.disk_usage(there).free
    hours = free / _RECORD_RATE / 3600.0
    state = OK if hours > 5.0 else WARN if hours > 0.5 else FAIL
    advice = "" if state == OK else f"fetch records and delete them in {folder}"
    yield Finding("disk", f"{free / 1e9:.1f} GB free, {hours:.0f} h of flight", "", advice, state)
    try:
        with tempfile.NamedTemporaryFile(dir=there) as scratch:
            begin = time.monotonic()
            scratch.write(bytes(_SCRATCH))
            scratch.flush()
            os.fsync(scratch.fileno())
            took = time.monotonic() - begin
    except OSError as error:
        advice = f"{there} must be writable for the user that runs the companion"
        yield Finding("disk", f"cannot write: {error.strerror}", "", advice, FAIL)
        return
    speed = _SCRATCH / took
    state = OK if speed > 20 * _RECORD_RATE else WARN
    advice = "" if state == OK else "take a faster card; records may miss samples"
    yield Finding("disk", f"{speed / 1e6:.0f} MB/s written through", "", advice, state)


def _processor(settings: Settings, root: Path) -> Iterator[Finding]:
    governors = {_text(path) for path in root.glob("sys/devices/system/cpu/cpu*/cpufreq/scaling_governor")}
    if not governors:
        yield Finding("governor", "none", "", "this processor's clock is not governed from here", NOTE)
    elif governors == {"performance"}:
        yield Finding("governor", "performance", "", "", OK)
    else:
        advice = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
        yield Finding("governor", ", ".join(sorted(governors)), "", advice, WARN)
    throttled = _text(root / "sys/devices/platform/soc/soc:firmware/get_throttled")
    if throttled and int(throttled, 16) & 0xF:
        advice = "a better supply (5.1 V, 3 A) or more cooling"
        yield Finding("supply", f"the processor is throttled (0x{throttled})", "", advice, FAIL)
    hottest = (
        max((int(_text(p) or 0) for p in root.glob("sys/class/thermal/thermal_zone*/temp")), default=0) / 1e3
    )
    if hottest > _HOT:
        yield Finding("temperature", f"{hottest:.0f} degrees", "", "a cooler, or less to do", WARN)
    late = 0.0
    for _ in range(_NAPS):
        begin = time.monotonic()
        time.sleep(0.005)
        late = max(late, time.monotonic() - begin - 0.005)
    state = OK if late < _LATE else WARN
    advice = "" if state == OK else "stop other programs; realtime in companion.toml helps"
    yield Finding("wake-up", f"{1e3 * late:.1f} ms late at worst", "", advice, state)
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load > cores:
        yield Finding("load", f"{load:.1f} on {cores} cores", "", "stop other programs", WARN)
    if settings.realtime:
        allowed = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
        if os.geteuid() == 0 or allowed == resource.RLIM_INFINITY or allowed >= settings.realtime:
            yield Finding("real time", f"priority {settings.realtime} is allowed", "", "", OK)
        else:
            advice = "as a service it is (LimitRTPRIO); otherwise 'rtprio' in /etc/security/limits.conf"
            yield Finding("real time", f"priority {settings.realtime} is not allowed", "", advice, WARN)


def _zenoh(settings: Settings, root: Path) -> Iterator[Finding]:
    yield from access_findings(settings)
    try:
        keys = settings.own_keys()
        plan = plan_session(settings.zenoh if keys else replace(settings.zenoh, insecure=True), keys)
    except InputError:
        return  # told above
    named = "Zenoh" if settings.zenoh.listen or settings.zenoh.config else "Zenoh port"
    for end in plan.listen:
        found = _PORT.match(end)
        if found is None:
            yield Finding(named, end, "", "write tcp/ADDRESS:PORT", WARN)
            continue
        host, port = found.group(1), int(found.group(2))
        problem = _cannot_listen(host, port)
        if problem:
            advice = (
                "another companion is running (systemctl status trueflight-companion), or choose another port"
            )
            yield Finding(named, f"{end}: {problem}", "", advice, WARN)
        elif host.startswith(_LOOPBACK):
            advice = "only this machine can reach it; for the ground make keys (groundstation keys)"
            yield Finding(named, f"{end} is free", "", advice, NOTE)
        else:
            yield Finding(named, f"{end} is free", "", "", OK)
    for end in plan.connect:
        found = _PORT.match(end)
        if found is None or not end.startswith("tcp/"):
            continue
        try:
            socket.create_connection((found.group(1).strip("[]"), int(found.group(2))), 2.0).close()
            yield Finding("Zenoh", f"{end} answers", "", "", OK)
        except OSError as error:
            advice = "start what listens there; check address and firewall"
            yield Finding("Zenoh", f"{end}: {error.strerror or 'no answer'}", "", advice, FAIL)


def _cannot_listen(host: str, port: int) -> str:
    """'' where a TCP port can be listened on, otherwise why not."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host.strip("[]"), port))
        except OSError as error:
            return str(error.strerror)
    return ""


def _model(settings: Settings, root: Path) -> Iterator[Finding]:
    if not settings.vehicle:
        yield Finding("vehicle file", "none given", "", "--vehicle, or vehicle in companion.toml", WARN)
        return
    vehicle: Vehicle | None = None
    try:
        vehicle = load_vehicle(settings.vehicle)
        yield Finding("vehicle file", f"{vehicle.name}: {vehicle.mass:g} kg", "", "", OK)
        load_design(settings.design_path, vehicle)
        yield Finding("design", str(settings.design_path), "", "", OK)
    except InputError as error:
        yield Finding("design" if vehicle else "vehicle file", "cannot be used", "", str(error), FAIL)
    if vehicle is None:
        return
    path = live_file(Path(settings.models))
    if path is None:
        yield Finding("model", "none deployed", "", "flights are lqr until the ground deploys one", NOTE)
        return
    try:
        (finding,) = inspect([path.read_bytes()], vehicle, settings.guard.deadline)
    except OSError as error:
        yield Finding("model", f"{path.name}: cannot be read ({error.strerror})", "", "deploy it again", FAIL)
        return
    if finding.open:
        advice = "a newer kernel with Landlock and seccomp keeps the check of models from files and network"
        yield Finding("check of models", "; ".join(finding.open), "", advice, NOTE)
    if finding.accepted and finding.info is not None:
        told = f"{finding.info.name} {finding.info.version}, {1e6 * finding.median:.0f} us an inference"
        yield Finding("model", told, "", "", OK)
    else:
        advice = "deploy it again (groundstation deploy), or roll back"
        yield Finding("model", f"{path.name}: {finding.reason}", "", advice, FAIL)


CHECKS: dict[str, Check] = {
    "machine": _machine,
    "link": _serial,
    "autopilot": _rates,
    "clock": _clock,
    "disk": _disk,
    "processor": _processor,
    "Zenoh": _zenoh,
    "model": _model,
}
"""What `companion doctor` looks at, in this order."""


def _text(path: Path) -> str:
    """A small file of the system without its end; '' where it cannot be read."""
    try:
        return path.read_text(errors="replace").strip().strip("\0")
    except OSError:
        return ""


def _number_after(word: str, path: Path) -> float | None:
    found = re.search(re.escape(word) + r"\s*(\d+)", _text(path))
    return float(found.group(1)) if found else None
