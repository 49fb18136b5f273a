"""The companion's settings: a commented TOML file, overridden by flags."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from trueflight.companion.address import checked_address
from trueflight.companion.agreement import AgreementLimits
from trueflight.companion.law.control import Limits
from trueflight.companion.law.controllers import TrimLimits
from trueflight.companion.law.residual import ObserverLimits
from trueflight.companion.law.watch import GuardLimits
from trueflight.companion.pose import PoseSettings
from trueflight.companion.shadow import ShadowLimits
from trueflight.companion.signature import LOCAL, UNSIGNED
from trueflight.companion.stopping import Safety
from trueflight.companion.zenoh_session import ZenohSettings
from trueflight.models.access import Keys, read_keys
from trueflight.models.errors import InputError
from trueflight.models.outside import is_number, read_toml, shown

T = TypeVar("T")


@dataclass(frozen=True)
class Settings:
    """Everything `companion run` needs; the sections are the settings of the parts.

    `design` empty means `design.json` beside the vehicle file. `rate` in Hz, `timeout` in s to wait for an
    autopilot, `system` its MAVLink system id, 0 for the first that is heard, `battery` PX4's number of the flight's
    battery, 0 for the lowest of those that fit. `realtime` is the priority (SCHED_FIFO)
    that the control thread asks for, 0 for none. `keys` is the vehicle's folder of `groundstation keys`;
    `unsigned_models` one of `companion.signature.UNSIGNED`. `require_record`: no flight begins whose record cannot be
    written.
    """

    vehicle: str = ""
    design: str = ""
    connect: str = "udpin://127.0.0.1:14540"
    system: int = field(default=0, metadata={"zero": True})
    battery: int = field(default=0, metadata={"zero": True})
    timeout: float = 10.0
    rate: float = 100.0
    records: str = "records"
    models: str = "deployed"
    zenoh: ZenohSettings = field(default_factory=ZenohSettings)
    safety: Safety = field(default_factory=Safety)
    limits: Limits = field(default_factory=Limits)
    guard: GuardLimits = field(default_factory=GuardLimits)
    shadow: ShadowLimits = field(default_factory=ShadowLimits)
    trim: TrimLimits = field(default_factory=TrimLimits)
    observer: ObserverLimits = field(default_factory=ObserverLimits)
    agreement: AgreementLimits = field(default_factory=AgreementLimits)
    pose: PoseSettings = field(default_factory=PoseSettings)
    realtime: int = field(default=0, metadata={"zero": True})
    keys: str = ""
    unsigned_models: str = LOCAL
    require_record: bool = True

    def checked(self) -> Settings:
        """The same, or `InputError` for a value without sense."""
        self.check_numbers()
        self.check_address()
        self.pose.checked()
        self.check_signing()
        if not self.vehicle:
            raise InputError("no vehicle file; pass --vehicle FILE or set 'vehicle' in the configuration")
        return self

    def check_numbers(self) -> None:
        """Raise `InputError` for a number without sense."""
        if not 10.0 <= self.rate <= 1000.0:
            raise InputError(f"rate = {self.rate:g} is outside 10 to 1000 Hz")
        if not 0 <= self.system <= 255:
            raise InputError(
                f"system = {self.system} is outside 1 to 255 (0: the first autopilot that is heard)"
            )
        if not 0 <= self.battery <= 16:
            raise InputError(f"battery = {self.battery} is outside 1 to 16 (0: the lowest of those that fit)")
        if not 0.1 <= self.timeout <= 600.0:
            raise InputError(f"timeout = {self.timeout:g} is outside 0.1 to 600 s")
        if not 0 <= self.realtime <= 80:
            raise InputError(f"realtime = {self.realtime} is outside 0 (off) to 80")

    def check_address(self) -> None:
        """Raise `InputError` for an address that is none."""
        checked_address(self.connect)

    def check_signing(self) -> None:
        """Raise `InputError` for an `unsigned_models` without sense."""
        if self.unsigned_models not in UNSIGNED:
            raise InputError(f"unsigned_models = '{self.unsigned_models}' is none of {', '.join(UNSIGNED)}")

    def own_keys(self) -> Keys | None:
        """The vehicle's keys; None without. Raises `InputError` where they cannot be used."""
        return read_keys(self.keys) if self.keys else None

    @property
    def design_path(self) -> Path:
        """The design file."""
        return Path(self.design) if self.design else Path(self.vehicle).with_name("design.json")


def load_settings(path: str | Path | None) -> Settings:
    """Read `companion.toml`; the defaults without a file. File names in it are relative to it.

    Raises `InputError` for a file that cannot be read and for every key or value that does not fit, with a
    suggestion.
    """
    if path is None:
        return Settings()
    path = Path(path)
    table = read_toml(path, "the configuration")
    settings = _filled(Settings(), table, str(path), "")
    changes: dict[str, Any] = {
        name: str(path.parent / getattr(settings, name))
        for name in ("vehicle", "design", "records", "models", "keys")
        if name in table and getattr(settings, name)
    }
    settings = replace(settings, **changes)
    if "config" in table.get("zenoh", {}):
        file = replace(settings.zenoh, config=str(path.parent / settings.zenoh.config))
        settings = replace(settings, zenoh=file)
    return settings


def _filled(default: T, table: dict[str, Any], where: str, section: str) -> T:
    known = {f.name: getattr(default, f.name) for f in fields(default)}  # type: ignore[arg-type]
    may_be_zero = [f.name for f in fields(default) if f.metadata.get("zero")]  # type: ignore[arg-type]
    changes: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{section}.{key}" if section else key
        if key not in known:
            close = difflib.get_close_matches(key, list(known), 1)
            hint = f"did you mean '{close[0]}'?" if close else f"known keys: {', '.join(known)}"
            raise InputError(f"{where}: unknown key '{name}'; {hint}")
        if value == 0 and key in may_be_zero and not isinstance(value, bool):
            changes[key] = type(known[key])(0)
            continue
        changes[key] = _value(known[key], value, f"{where}: '{name}'")
    return replace(default, **changes)  # type: ignore[type-var]


def _value(default: Any, value: Any, where: str) -> Any:
    """`value` where it fits the type of `default`, otherwise `InputError`."""
    if hasattr(default, "__dataclass_fields__"):
        if not isinstance(value, dict):
            raise InputError(f"{where} must be a section, not {shown(value)}")
        file, _, section = where.partition(": ")
        return _filled(default, value, file, section.strip("'"))
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise InputError(f"{where} must be true or false, not {shown(value)}")
        return value
    if isinstance(default, str):
        if not isinstance(value, str):
            raise InputError(f"{where} must be a text, not {shown(value)}")
        return value
    if isinstance(default, tuple):
        if not isinstance(value, list):
            raise InputError(f"{where} must be a list, not {shown(value)}")
        if default and isinstance(default[0], float):
            if len(value) != len(default):
                raise InputError(f"{where} must have {len(default)} numbers, not {len(value)}")
            return tuple(_number(one, where) for one in value)
        return tuple(_value("", one, where) for one in value)
    number = _number(value, where)
    return int(number) if isinstance(default, int) else number


def _number(value: Any, where: str) -> float:
    if not is_number(value) or value <= 0:
        raise InputError(f"{where} must be a positive number, not {shown(value)}")
    return float(value)
