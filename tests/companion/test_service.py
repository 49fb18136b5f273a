"""`companion install-service` writes what systemd takes, and never over what somebody has changed."""

from __future__ import annotations

import configparser
import json
import re
import shutil
import stat
import subprocess
from pathlib import Path

import pytest
from rig import VEHICLE
from test_companion_cli import companion, refused

from trueflight.companion.service import CONFIG, FOLDER, SYSUSERS, UNIT
from trueflight.companion.settings import Settings, load_settings
from trueflight.groundstation.operate.keys import make_keys


def install(root: Path, *flags: object) -> dict[str, str]:
    """What was done to each file, by its path below the root."""
    result = companion("install-service", "--vehicle", VEHICLE, "--output", root, "--json", *flags)
    assert result.returncode == 0, result.stderr
    files = json.loads(result.stdout)["files"]
    return {str(Path(path).relative_to(root)): state for path, state in files.items()}


def test_everything_is_there_and_the_configuration_holds_what_was_asked_for(tmp_path: Path) -> None:
    done = install(tmp_path, "--connect", "serial:///dev/ttyTHS1:921600", "--realtime", 15)
    assert set(done.values()) == {"new"}
    settings = load_settings(tmp_path / CONFIG)
    assert settings.connect == "serial:///dev/ttyTHS1:921600"
    assert settings.vehicle == f"/{FOLDER}/vehicle.toml"
    assert settings.records == "/var/lib/trueflight/records"
    assert settings.realtime == 15
    assert settings.zenoh.listen == ("tcp/127.0.0.1:7447",), "without keys this machine alone"
    assert settings.safety == Settings().safety
    assert settings.guard == Settings().guard
    text = (tmp_path / CONFIG).read_text()
    assert text.count("#") > 50, "it is commented"
    assert (tmp_path / FOLDER / "vehicle.toml").read_bytes() == VEHICLE.read_bytes()
    assert (tmp_path / FOLDER / "design.json").is_file()
    assert not list(tmp_path.rglob("*.part"))


def test_the_unit_restarts_watches_and_has_a_user_of_its_own(tmp_path: Path) -> None:
    install(tmp_path, "--user", "pilot", "--realtime", 15)
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read(tmp_path / UNIT)
    service = unit["Service"]
    assert service["Type"] == "notify"
    assert service["Restart"] == "always"
    assert float(service["WatchdogSec"]) > 0
    assert service["User"] == "pilot"
    assert service["LimitRTPRIO"] == "15"
    assert service["ExecStart"].endswith(f"run --config /{CONFIG}")
    assert unit["Unit"]["StartLimitIntervalSec"] == "0", (
        "it never gives up on a vehicle that is switched on later"
    )
    assert "u pilot" in (tmp_path / SYSUSERS).read_text()


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    install(tmp_path)
    result = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", tmp_path / UNIT], capture_output=True, text=True, timeout=60
    )
    about_it = [line for line in result.stderr.splitlines() if "trueflight" in line]
    assert about_it == [], result.stderr
    assert result.returncode == 0, result.stderr


def test_a_second_time_changes_nothing_and_new_flags_update_what_nobody_touched(tmp_path: Path) -> None:
    install(tmp_path)
    assert set(install(tmp_path).values()) == {"unchanged"}
    done = install(tmp_path, "--connect", "serial:///dev/ttyAMA2:921600")
    assert done.pop(CONFIG) == "updated"
    assert set(done.values()) == {"unchanged"}
    assert load_settings(tmp_path / CONFIG).connect == "serial:///dev/ttyAMA2:921600"


def test_what_somebody_changed_is_kept(tmp_path: Path) -> None:
    install(tmp_path)
    config = tmp_path / CONFIG
    mine = config.read_text().replace("fence_radius = 10.0", "fence_radius = 3.0")
    assert mine != config.read_text()
    config.write_text(mine)
    vehicle = tmp_path / FOLDER / "vehicle.toml"
    vehicle.write_text(vehicle.read_text() + "# weighed again\n")
    done = install(tmp_path, "--realtime", 30)
    assert done[CONFIG].startswith("kept")
    assert done[f"{FOLDER}/vehicle.toml"].startswith("kept")
    assert done[UNIT] == "updated"
    assert config.read_text() == mine
    assert vehicle.read_text().endswith("# weighed again\n")
    assert load_settings(config.with_name("companion.toml.new")).realtime == 30


def test_a_dry_run_shows_and_writes_nothing(tmp_path: Path) -> None:
    result = companion("install-service", "--vehicle", VEHICLE, "--output", tmp_path, "--dry-run")
    assert result.returncode == 0
    assert "WatchdogSec=" in result.stdout
    assert "fence_radius" in result.stdout
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--vehicle", "none.toml"], "none.toml"),
        (["--user", "Robert; drop"], "no name of a user"),
        (["--user", "root"], "root"),
        (["--realtime", "99"], "0 (off) to 80"),
        (["--connect", "serial:///dev/tty\nExecStartPre=/bin/true"], "control characters"),
        (["--design", "none.json"], "groundstation design"),
        (["--output", VEHICLE], "cannot write"),
    ],
)
def test_what_cannot_be_installed_is_one_line(flags: list[object], message: str, tmp_path: Path) -> None:
    line = refused("install-service", "--vehicle", VEHICLE, "--output", tmp_path, *flags)
    assert message in line
    assert list(tmp_path.iterdir()) == []


def test_with_keys_it_is_open_to_the_network_and_nobody_else_reads_them(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", ["quad5"], [("anna", "operator")])
    root = tmp_path / "root"
    install(root, "--keys", tmp_path / "keys" / "vehicle-quad5")
    settings = load_settings(root / CONFIG)
    assert settings.zenoh.listen == ("tls/0.0.0.0:7447",)
    assert settings.keys == f"/{FOLDER}/keys"
    there = root / FOLDER / "keys"
    assert {path.name for path in there.iterdir()} == {"ca.pem", "cert.pem", "key.pem", "access.toml"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in there.iterdir()} == {0o600}
    assert stat.S_IMODE(there.stat().st_mode) == 0o700
    make_keys(tmp_path / "others", ["x500"])
    line = refused(
        "install-service",
        "--vehicle",
        VEHICLE,
        "--output",
        root,
        "--keys",
        tmp_path / "others" / "vehicle-x500",
    )
    assert "the vehicle file says 'quad5'" in line


def test_open_to_the_network_without_keys_only_when_told_so(tmp_path: Path) -> None:
    flags = ("--vehicle", VEHICLE, "--output", tmp_path, "--listen", "tcp/0.0.0.0:7447")
    assert "--insecure" in refused("install-service", *flags)
    assert not list(tmp_path.iterdir())
    install(tmp_path, "--listen", "tcp/0.0.0.0:7447", "--insecure")
    settings = load_settings(tmp_path / CONFIG).zenoh
    assert settings.insecure and settings.listen == ("tcp/0.0.0.0:7447",)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_systemd_finds_little_exposed(tmp_path: Path) -> None:
    install(tmp_path)
    told = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", tmp_path / UNIT], capture_output=True, text=True
    )
    found = re.search(r"exposure level for \S+: ([\d.]+)", told.stdout)
    if found is None:
        pytest.skip("this systemd-analyze does not judge files")
    assert float(found.group(1)) <= 3.0
    unit = (tmp_path / UNIT).read_text()
    assert "LimitRTPRIO=" in unit and "RestrictRealtime" not in unit, "it flies at real-time priority"
