"""The address of the autopilot: its form, and why what it names cannot be opened, each with a line to paste."""

from __future__ import annotations

import errno
import os
import re
import socket
from pathlib import Path

from trueflight.models.errors import InputError

_BAUD = 921_600
_NETWORK = ("udpin", "udpout", "tcpin", "tcpout", "udp", "tcp")  # MAVSDK's, the last two its old ones
_SERIAL = ("serial", "serial_flowcontrol")
_FORMS = (
    f"serial:///dev/ttyAMA0:{_BAUD}, udpin://0.0.0.0:14540 (listens) or udpout://192.168.1.10:14540 (asks)"
)
_CAN = {
    errno.ENOENT: "is not there",
    errno.EACCES: "no permission",
    errno.EPERM: "no permission",
    errno.EBUSY: "busy, another program keeps it for itself",
    errno.ENXIO: "is not connected",
    errno.ENODEV: "is not connected",
    errno.EISDIR: "is a folder",
}


def checked_address(address: str) -> None:
    """Raise `InputError` for an address that is none of MAVSDK's, with what was meant as far as it can be told.

    A serial one needs its baud rate: the one taken without is too slow to fly with.
    """
    scheme, separator, rest = address.partition("://")
    if not separator:
        raise InputError(f"--connect {address}: an address begins with how to connect; {_meant(address)}")
    if scheme in _SERIAL:
        device, _, baud = rest.rpartition(":")
        if not device or not re.fullmatch(r"[0-9]{4,8}", baud):
            device = device or rest.rstrip(":")
            raise InputError(
                f"--connect {address}: no baud rate in it (device, colon, baud rate); write "
                f"--connect {scheme}://{device or '/dev/ttyAMA0'}:{_BAUD}"
            )
        return
    if scheme not in _NETWORK:
        raise InputError(f"--connect {address}: '{scheme}' is no way to connect; write one like {_FORMS}")
    host, _, port = rest.rpartition(":")
    if not re.fullmatch(r"[0-9]{1,5}", port) or not 0 < int(port) < 65536:
        given = host if port.isdigit() else rest.rstrip(":")
        raise InputError(
            f"--connect {address}: no port of 1 to 65535 at its end; write --connect "
            f"{scheme}://{given or '0.0.0.0'}:14540"
        )
    if not host and scheme not in ("udp", "tcp"):
        here = "0.0.0.0" if scheme.endswith("in") else "192.168.1.10"
        raise InputError(f"--connect {address}: no machine in it; write --connect {scheme}://{here}:{port}")


def for_mavsdk(address: str) -> str:
    """The same address as MAVSDK reads it: it knows no device whose name has a colon, such as those by-path."""
    scheme, _, rest = address.partition("://")
    device, _, baud = rest.rpartition(":")
    return f"{scheme}://{os.path.realpath(device)}:{baud}" if scheme in _SERIAL and ":" in device else address


def _meant(address: str) -> str:
    device = re.fullmatch(r"(/dev/[^:]+|COM\d+)(:\d+)?", address)
    if device:
        return f"write --connect serial://{device[1]}{device[2] or f':{_BAUD}'}"
    if re.fullmatch(r"[\w.-]*:\d+", address):
        return f"write --connect udpin://{address if address[0] != ':' else '0.0.0.0' + address}"
    return f"write one like {_FORMS}"


def why_not_open(address: str) -> str:
    """Why a well-formed address cannot be opened, seen by opening what it names once more; what to do about it."""
    scheme, _, rest = address.partition("://")
    name, _, last = rest.rpartition(":")
    if scheme in _SERIAL:
        return _why_not_device(name)
    if scheme in ("tcpout", "tcp"):
        return "nobody listens there; start it, or correct the address"
    kind = socket.SOCK_STREAM if scheme == "tcpin" else socket.SOCK_DGRAM
    if scheme in ("udpin", "udp", "tcpin"):
        return _why_not_port(name or "0.0.0.0", int(last), kind)
    return "the machine's name is not known or there is no way to it; write its number, such as 192.168.1.10"


def taken(address: str) -> str:
    """'' or who else has the address open, so that it must not be opened: MAVSDK would open it all the same, and a
    companion in flight would lose its odometry to the newcomer. Of UDP and serial; TCP refuses by itself."""
    scheme, _, rest = address.partition("://")
    if scheme in _SERIAL:
        return users_of(address)
    host, _, port = rest.rpartition(":")
    if scheme not in ("udpin", "udp") or not re.fullmatch(r"[0-9.]*", host):
        return ""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((host or "0.0.0.0", int(port)))
    except OSError as error:
        return _in_use(int(port), socket.SOCK_DGRAM) if error.errno == errno.EADDRINUSE else ""
    return ""


def _in_use(port: int, kind: int) -> str:
    which = "-ulpn" if kind == socket.SOCK_DGRAM else "-tlpn"
    return (
        f"port {port} is in use by another program, such as a companion or a ground station; "
        f"see which: ss {which} 'sport = :{port}'"
    )


def _why_not_device(name: str) -> str:
    try:
        handle = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        why = _CAN.get(error.errno or 0, str(error.strerror))
        if error.errno == errno.ENOENT:
            there = ", ".join(serial_ports(Path("/"))) or "none"
            return f"{name} {why}; serial ports here: {there} (plugged in, switched on?)"
        if error.errno in (errno.EACCES, errno.EPERM):
            return f"{name}: {why}; sudo usermod -aG dialout $USER, then log in again"
        return f"{name} {why}" + (f"; see which: sudo fuser -v {name}" if error.errno == errno.EBUSY else "")
    try:
        if not os.isatty(handle):
            return f"{name} is no serial port"
    finally:
        os.close(handle)
    return f"{name} does not take these settings; is the baud rate one of its own, such as {_BAUD} or 57600?"


def _why_not_port(host: str, port: int, kind: int) -> str:
    if not re.fullmatch(r"[0-9.]+", host):
        return f"{host} is no number of a machine; write 127.0.0.1 for this one alone, 0.0.0.0 for all its networks"
    try:
        with socket.socket(socket.AF_INET, kind) as probe:
            probe.bind((host, port))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return _in_use(port, kind)
        if error.errno == errno.EADDRNOTAVAIL:
            return f"{host} is no address of this machine; write 0.0.0.0 to listen on all of them"
        if error.errno in (errno.EACCES, errno.EPERM):
            return f"port {port}: no permission; ports above 1023 need none"
        return f"{error.strerror or error}; write 0.0.0.0 to listen on all of this machine's addresses"
    return "it could not be opened; try again"


def serial_ports(root: Path) -> list[str]:
    """Those of a flight controller's kind that this machine has; `root` is where its files are."""
    kinds = ("ttyAMA*", "ttyTHS*", "ttyACM*", "ttyUSB*")
    found = [port for kind in kinds for port in sorted(root.glob(f"dev/{kind}"))]
    return ["/" + str(port.relative_to(root)) for port in found]


def users_of(address: str) -> str:
    """'' or which other programs have a serial address's device open, as far as we may know: of two that read one port
    each gets a part."""
    name = address.partition("://")[2].rpartition(":")[0]
    target, ours = os.path.realpath(name), str(os.getpid())
    users = []
    for process in Path("/proc").glob("[0-9]*"):
        if process.name == ours:
            continue
        try:
            if any(os.path.realpath(handle) == target for handle in (process / "fd").iterdir()):
                users.append(f"{(process / 'comm').read_text().strip()} ({process.name})")
        except OSError:  # gone, or not ours to see
            continue
    return f"{name} is open in {', '.join(users)} as well: end it" if users else ""
