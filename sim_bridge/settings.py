"""Settings of `sim-bridge run`, `sitl` and `fly`: one commented TOML file, overridden by flags."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from trueflight.models.errors import InputError
from trueflight.models.outside import is_number, read_toml, shown
from trueflight.sim_bridge.truth.battery import BatteryState
from trueflight.sim_bridge.truth.sensors import NO_NOISE, Noise


@dataclass(frozen=True)
class Settings:
    """What can be set; the meaning of each stands in `sim-bridge.toml` beside this file."""

    vehicle: str = ""
    design: str = ""
    hidden: tuple[str, ...] = ("none",)
    hidden_count: int = 1
    seed: int = 0
    sealed: str = ""
    noise: float = 1.0
    charge: float = 0.97
    battery_age: float = 1.0
    mavlink: str = "udpout:127.0.0.1:14540"
    port: int = 14580
    pilot_port: int = 14590
    speed: float = 1.0
    pilot_takes_over_at: float = 0.0
    pilot_mode: str = "POSCTL"
    duration: float = 0.0
    parameters: dict[str, int | float] = field(default_factory=dict)

    @property
    def sensor_noise(self) -> Noise:
        """The usual noise times `noise`."""
        usual = Noise()
        scaled = {
            f.name: self.noise * getattr(usual, f.name) for f in fields(Noise) if f.name != "wander_time"
        }
        return replace(NO_NOISE, **scaled)

    @property
    def battery(self) -> BatteryState:
        """State of the battery when a flight begins."""
        return BatteryState(self.charge, self.battery_age)

    @property
    def remote(self) -> tuple[str, int]:
        """Host and port of `mavlink`."""
        kind, _, address = self.mavlink.partition(":")
        host, _, port = address.rpartition(":")
        if kind != "udpout" or not host or not _is_port(port):
            raise InputError(
                f"--mavlink {self.mavlink}: write udpout:HOST:PORT, such as udpout:127.0.0.1:14540"
            )
        return host, int(port)


def _is_port(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) < 6 and 0 < int(text) < 65536


_LIMITS = {
    "hidden_count": (1, 20),
    "seed": (0, 2**63),
    "noise": (0.0, 100.0),
    "charge": (0.05, 1.0),
    "battery_age": (0.5, 4.0),
    "port": (1, 65535),
    "pilot_port": (0, 65535),
    "speed": (0.05, 50.0),
    "pilot_takes_over_at": (0.0, 1e6),
    "duration": (0.0, 1e7),
}


def load_settings(config: Path | None, flags: dict[str, Any], free_speed: float | None = None) -> Settings:
    """Defaults, overridden by the file, overridden by the flags that are not None. Raises `InputError`.

    `free_speed` overrides the speed and may be 0: no limit, where nothing waits for the wall clock.
    """
    values: dict[str, Any] = {}
    if config is not None:
        values.update(_read(config))
    for name, value in flags.items():
        if value is None or value == []:
            continue
        values[name] = (
            str(value) if isinstance(value, Path) else tuple(value) if isinstance(value, list) else value
        )
    free = free_speed == 0.0
    if free_speed is not None and not free:
        values["speed"] = free_speed
    settings = Settings(**values)
    check_limits(settings)
    if free:
        settings = replace(settings, speed=0.0)
    if not settings.vehicle:
        raise InputError("no vehicle; pass --vehicle FILE, or set `vehicle` in the configuration file")
    return settings


def check_limits(settings: Settings) -> None:
    """Raise `InputError` for a number outside its range."""
    for name, (low, high) in _LIMITS.items():
        if not low <= getattr(settings, name) <= high:
            option = "--" + name.replace("_", "-")
            raise InputError(f"{option} {getattr(settings, name):g} is outside {low:g} to {high:g}")


def _read(config: Path) -> dict[str, Any]:
    table = read_toml(config, "the configuration")
    known = {f.name: f for f in fields(Settings)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            close = difflib.get_close_matches(key, list(known), 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(known)}"
            raise InputError(f"{config}: unknown key '{key}'; {hint}")
        values[key] = _typed(config, key, value, getattr(Settings(), key))
    # Paths in the file are relative to the file, wherever the command is run.
    for key in ("vehicle", "design", "sealed"):
        if values.get(key):
            values[key] = str(config.parent / values[key])
    return values


def _typed(config: Path, key: str, value: Any, default: Any) -> Any:
    if isinstance(default, tuple):
        items = [value] if isinstance(value, str) else value
        if isinstance(items, list) and all(isinstance(item, str) for item in items):
            return tuple(items)
        raise InputError(f"{config}: '{key}' must be a list of texts, not {shown(value)}")
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(default, dict) and isinstance(value, dict):
        for name, number in value.items():
            if not is_number(number):
                raise InputError(f"{config}: '{key}.{name}' must be a number, not {shown(number)}")
    if type(value) is not type(default):
        kinds = {str: "a text", int: "a whole number", float: "a number", dict: "a table"}
        raise InputError(f"{config}: '{key}' must be {kinds[type(default)]}, not {shown(value)}")
    return value
