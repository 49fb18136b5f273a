"""`companion doctor` finds what is wrong with a machine, here one that is made of files."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from json_schemas import valid
from onnx_models import drag_model, make_live
from rig import VEHICLE, Bridge, free_port
from test_companion_cli import companion

from trueflight.companion import doctor
from trueflight.companion.findings import FAIL, NOTE, OK, WARN, Finding
from trueflight.companion.settings import Settings
from trueflight.companion.store import ModelStore
from trueflight.companion.zenoh_session import ZenohSettings
from trueflight.models.vehicle import load_vehicle


def write(root: Path, name: str, text: str = "") -> Path:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def found(check: str, settings: Settings, root: Path) -> dict[str, Finding]:
    """What one check finds, by name; the worst of each."""
    out: dict[str, Finding] = {}
    for finding in doctor.CHECKS[check](settings, root):
        assert finding.why or finding.state in (OK, NOTE), f"{finding} does not say what to do"
        if finding.name not in out or finding.state != OK:
            out[finding.name] = finding
    return out


SERIAL = Settings(connect="serial:///dev/ttyAMA0:921600")


def test_a_serial_port_that_is_not_there_and_those_that_are(tmp_path: Path) -> None:
    write(tmp_path, "dev/ttyACM0")
    finding = found("link", SERIAL, tmp_path)["serial port"]
    assert finding.state == FAIL
    assert "/dev/ttyACM0" in finding.why
    assert "enable_uart=1" in finding.why


def test_a_good_serial_port(tmp_path: Path) -> None:
    write(tmp_path, "dev/ttyAMA0")
    write(tmp_path, "proc/cmdline", "console=tty1 root=/dev/mmcblk0p2")
    assert {finding.state for finding in found("link", SERIAL, tmp_path).values()} == {OK}


@pytest.mark.parametrize(("connect", "what"), [("57600", "921600"), ("", "921600")])
def test_a_slow_serial_port_is_told(connect: str, what: str, tmp_path: Path) -> None:
    write(tmp_path, "dev/ttyAMA0")
    settings = Settings(connect=f"serial:///dev/ttyAMA0:{connect}".rstrip(":"))
    finding = found("link", settings, tmp_path)["baud rate"]
    assert finding.state == WARN
    assert what in finding.why


def test_a_console_on_the_port_is_told_under_either_of_its_names(tmp_path: Path) -> None:
    write(tmp_path, "dev/ttyAMA0")
    (tmp_path / "dev/serial0").symlink_to("ttyAMA0")
    for console in ("ttyAMA0", "serial0"):
        write(tmp_path, "proc/cmdline", f"console={console},115200 console=tty1")
        finding = found("link", SERIAL, tmp_path)["console"]
        assert finding.state == FAIL
        assert "raspi-config" in finding.why


def test_the_mini_uart_of_a_raspberry_pi_is_told(tmp_path: Path) -> None:
    write(tmp_path, "dev/ttyS0")
    write(tmp_path, "proc/device-tree/model", "Raspberry Pi 4 Model B Rev 1.4\0")
    finding = found("link", Settings(connect="serial:///dev/ttyS0:921600"), tmp_path)["serial port"]
    assert finding.state == WARN
    assert "ttyAMA0" in finding.why


def test_governor_supply_and_heat(tmp_path: Path) -> None:
    for cpu in range(4):
        write(tmp_path, f"sys/devices/system/cpu/cpu{cpu}/cpufreq/scaling_governor", "ondemand\n")
    write(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "50005\n")
    write(tmp_path, "sys/class/thermal/thermal_zone0/temp", "81000\n")
    findings = found("processor", Settings(), tmp_path)
    assert findings["governor"].state == WARN
    assert "performance" in findings["governor"].why
    assert findings["supply"].state == FAIL
    assert findings["temperature"].value == "81 degrees"


def test_a_quiet_machine_is_left_in_peace(tmp_path: Path) -> None:
    write(tmp_path, "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "performance\n")
    write(tmp_path, "sys/devices/platform/soc/soc:firmware/get_throttled", "0\n")
    write(tmp_path, "sys/class/thermal/thermal_zone0/temp", "45000\n")
    findings = found("processor", Settings(), tmp_path)
    assert findings["governor"].state == OK
    assert not {"supply", "temperature"} & set(findings)


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    findings = found("disk", Settings(records=str(tmp_path / "records")), tmp_path)
    assert {finding.state for finding in findings.values()} <= {OK, WARN}
    assert not (tmp_path / "records").exists(), "it looks and makes nothing"
    assert list(tmp_path.iterdir()) == []
    finding = found("disk", Settings(records="/proc/records"), tmp_path)["disk"]
    assert finding.state == FAIL
    assert "writable" in finding.why


def test_zenoh_ends(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        listening = Settings(zenoh=ZenohSettings(listen=(f"tcp/127.0.0.1:{port}",)))
        finding = found("Zenoh", listening, tmp_path)["Zenoh"]
        assert finding.state == WARN
        assert "another companion" in finding.why
        calling = Settings(zenoh=ZenohSettings(listen=(), connect=(f"tcp/127.0.0.1:{port}",)))
        assert found("Zenoh", calling, tmp_path)["Zenoh"].state == OK
    assert found("Zenoh", calling, tmp_path)["Zenoh"].state == FAIL
    assert found("Zenoh", listening, tmp_path)["Zenoh"].state == NOTE, "free, but only from this machine"


def test_the_live_model_is_checked_again(tmp_path: Path) -> None:
    settings = Settings(vehicle=str(VEHICLE), models=str(tmp_path / "models"))
    assert found("model", settings, tmp_path)["model"].state == NOTE
    make_live(ModelStore(Path(settings.models), load_vehicle(VEHICLE), 0.02), drag_model(0.1))
    findings = found("model", settings, tmp_path)
    assert findings["model"].state == OK, findings
    assert "an inference" in findings["model"].value
    (live,) = Path(settings.models).glob("*.onnx")
    live.write_bytes(b"garbage")
    assert found("model", settings, tmp_path)["model"].state == FAIL
    assert found("model", Settings(vehicle="none.toml"), tmp_path)["vehicle file"].state == FAIL


@pytest.fixture
def bridge() -> Iterator[int]:
    port = free_port()
    bridge = Bridge(port)
    yield port
    bridge.end()


def test_the_whole_examination_with_an_autopilot(bridge: int, tmp_path: Path) -> None:
    flags = ["--vehicle", VEHICLE, "--connect", f"udpin://127.0.0.1:{bridge}", "--root", tmp_path]
    result = companion("doctor", *flags, "--json")
    report = valid("companion doctor", json.loads(result.stdout))
    states = {row["name"]: row["state"] for row in report["findings"]}
    assert states["autopilot"] == states["odometry"] == states["accelerometer"] == OK
    assert result.returncode == (0 if report["ready"] else 2)
    assert report["ready"] is (FAIL not in states.values())


def test_without_an_autopilot_it_says_what_to_look_at_and_fails(tmp_path: Path) -> None:
    result = companion("doctor", "--connect", f"udpin://127.0.0.1:{free_port()}", "--timeout", 0.5)
    assert result.returncode == 2
    assert "no autopilot answering" in " ".join(result.stdout.replace("│", " ").split())
    assert "Traceback" not in result.stderr
