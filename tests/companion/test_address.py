"""An address that is misspelt, or names what cannot be opened: what was seen, what was expected, a line to paste."""

from __future__ import annotations

import os
import pty
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk
from processes import with_parent
from rig import free_port

from trueflight.companion.address import checked_address, for_mavsdk, users_of, why_not_open
from trueflight.companion.vehicle_link import VehicleLink
from trueflight.models.errors import InputError


@pytest.mark.parametrize(
    ("address", "line"),
    [
        ("serial:///dev/ttyAMA0", "--connect serial:///dev/ttyAMA0:921600"),
        ("serial:///dev/ttyAMA0:", "--connect serial:///dev/ttyAMA0:921600"),
        ("serial:///dev/ttyUSB1:fast", "--connect serial:///dev/ttyUSB1:921600"),
        ("serial_flowcontrol:///dev/ttyTHS1", "--connect serial_flowcontrol:///dev/ttyTHS1:921600"),
        ("/dev/ttyACM0", "--connect serial:///dev/ttyACM0:921600"),
        ("/dev/ttyACM0:57600", "--connect serial:///dev/ttyACM0:57600"),
        ("COM3", "--connect serial://COM3:921600"),
        (":14540", "--connect udpin://0.0.0.0:14540"),
        ("127.0.0.1:14540", "--connect udpin://127.0.0.1:14540"),
        ("udpin://:14540", "--connect udpin://0.0.0.0:14540"),
        ("udpin://127.0.0.1", "--connect udpin://127.0.0.1:14540"),
        ("udpin://127.0.0.1:", "--connect udpin://127.0.0.1:14540"),
        ("udpin://127.0.0.1:99999", "--connect udpin://127.0.0.1:14540"),
        ("http://127.0.0.1:80", "udpin://0.0.0.0:14540"),
        ("carrier-pigeon", "udpin://0.0.0.0:14540"),
        ("", "udpin://0.0.0.0:14540"),
    ],
)
def test_a_misspelt_address_is_answered_with_the_right_one(address: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        checked_address(address)
    assert line in str(caught.value)
    assert address in str(caught.value)


@pytest.mark.parametrize("address", ["udp://:14540", "tcpout://10.0.0.1:5760", "serial:///dev/ttyS0:57600"])
def test_a_good_one_passes(address: str) -> None:
    checked_address(address)
    assert for_mavsdk(address) == address


def opened(address: str) -> str:
    """What the link says where it cannot be opened."""
    with pytest.raises(InputError) as caught:
        VehicleLink(address, timeout=0.1)
    return str(caught.value)


def test_a_device_that_cannot_be_opened_is_told_with_the_reason(tmp_path: Path) -> None:
    missing, plain = tmp_path / "ttyACM7", tmp_path / "ttyACM8"
    plain.touch()
    assert "ttyACM7 is not there; serial ports here: " in opened(f"serial://{missing}:57600")
    assert "ttyACM8 is no serial port" in opened(f"serial://{plain}:57600")
    assert "is a folder" in opened(f"serial://{tmp_path}:57600")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_no_permission_is_told_with_the_group() -> None:
    """As a user who may not: files of root are closed to nobody."""
    device = Path("/tmp") / f"ttyACM{os.getpid()}"
    device.touch(mode=0o600)
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.setuid(65534)
        os.write(writer, why_not_open(f"serial://{device}:57600").encode())
        os._exit(0)
    os.waitpid(child, 0)
    device.unlink()
    os.close(writer)
    with os.fdopen(reader) as said:
        assert "no permission; sudo usermod -aG dialout $USER" in said.read()


def test_a_serial_port_that_another_program_reads_is_not_opened() -> None:
    """Of two programs that read one port each gets a part."""
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    sleeping = [sys.executable, "-c", "import time; time.sleep(60)"]
    with subprocess.Popen(sleeping, stdin=theirs, preexec_fn=with_parent) as other:
        os.close(theirs)
        line = opened(f"serial://{name}:57600")
        other.terminate()
    os.close(ours)
    assert not users_of(f"serial://{name}:57600")
    assert line.startswith(f"cannot open serial://{name}:57600: {name} is open in")
    assert f"({other.pid}) as well: end it" in line


def test_a_port_at_which_another_companion_listens_is_not_taken_from_it() -> None:
    """Two programs of MAVSDK's can listen at one port of UDP; the later one gets what is sent there."""
    port = free_port()
    first = Mavsdk(Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER))
    assert first.add_any_connection(f"udpin://127.0.0.1:{port}") == ConnectionResult.SUCCESS
    for address in (f"udpin://127.0.0.1:{port}", f"udpin://0.0.0.0:{port}", f"udp://:{port}"):
        assert f"cannot open {address}: port {port} is in use by another program" in opened(address)
    first.destroy()
    assert "no autopilot answering" in opened(f"udpin://127.0.0.1:{port}")


def test_a_device_with_a_colon_in_its_name_is_opened(tmp_path: Path) -> None:
    """/dev/serial/by-path has them, and MAVSDK takes the colon for that of the baud rate."""
    ours, theirs = pty.openpty()
    link = tmp_path / "pci-0000:01:00.0-usb"
    link.symlink_to(os.ttyname(theirs))
    assert for_mavsdk(f"serial://{link}:57600") == f"serial://{os.ttyname(theirs)}:57600"
    assert "no autopilot answering" in opened(f"serial://{link}:57600")
    os.close(ours)
    os.close(theirs)


def test_a_network_port_that_cannot_be_opened_is_told_with_the_reason() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        assert f"port {port} is in use" in (line := opened(f"udpin://127.0.0.1:{port}"))
        assert f"ss -ulpn 'sport = :{port}'" in line
    assert "192.0.2.1 is no address of this machine" in opened(f"udpin://192.0.2.1:{free_port()}")
    assert "write 127.0.0.1" in opened(f"udpin://localhost:{free_port()}")
