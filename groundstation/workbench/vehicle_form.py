"""The vehicle file as a form: each value with its unit, where it is from, and whether it is measured or a guess."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from trueflight.groundstation.workbench.quantities import in_unit
from trueflight.models.errors import InputError, plain_line, shown
from trueflight.models.vehicle import THRUST_MODELS, Vehicle, vehicle_from_table
from trueflight.models.whole_file import write_whole

WHERE = "the form"
GIVEN = "as you gave it"


@dataclass(frozen=True)
class Field:
    """One value of the form: `text` as it stands in it, `unit` of the vehicle file, `source` where the value is from.

    `measured` is False for a guess that its owner has to weigh or measure; `problem` why it cannot be taken.
    """

    key: str
    label: str
    unit: str
    text: str = ""
    source: str = ""
    measured: bool = True
    choices: tuple[str, ...] = ()
    problem: str = ""

    @property
    def assumed(self) -> bool:
        """Whether it stands for "nothing", for want of anything that tells."""
        return self.text in ("0", "0.0") and self.source != GIVEN

    @property
    def known(self) -> bool:
        """Whether there is a value at all."""
        return bool(self.text.strip())


FIELDS: tuple[Field, ...] = (
    Field("name", "name", ""),
    Field("mass", "mass, with battery", "kg"),
    Field("hover_thrust", "thrust command in a hover", "of full collective"),
    Field("thrust_model", "command to thrust", "", choices=THRUST_MODELS),
    Field("nominal_voltage", "voltage at which it hovers so", "V"),
    Field("rotor_radius", "radius of a propeller", "m"),
    Field("rotor_height", "rotors above the ground where z is 0", "m"),
    Field("rotor_positions", "rotors from the centre: [x forward, y left, z up]", "m"),
    Field("rotor_directions", "turning seen from above: 1 counter-clockwise, -1 clockwise", ""),
    Field("inertia", "moments of inertia [x, y, z]", "kg m^2"),
    Field("command_delay", "delay of the thrust command", "s"),
    Field("motor_time_constant", "time constant of the motors", "s"),
    Field("rate_time_constant", "time constant of the rate loop", "s"),
)
_LISTS = ("rotor_positions", "rotor_directions", "inertia")
_NEEDED = ("name", "mass", "hover_thrust")
_STAND_IN: Mapping[str, Any] = {"name": "vehicle", "mass": 1.0, "hover_thrust": 0.5}


def drafted_form(path: Path) -> tuple[Field, ...]:
    """The form as drafted from an autopilot's log; of any other file with stand-ins alone.

    Raises `InputError` where the log cannot be read, or is no multirotor's.
    """
    from trueflight.groundstation.versions.vehicle_draft import LOADERS, draft_of

    if path.suffix.lower() not in LOADERS:
        told = "not in the file: as you believe it to be"
        texts = {key: _text(value) for key, value in _STAND_IN.items()}
        return tuple(
            replace(
                f,
                text=texts.get(f.key, ""),
                source=told if f.key in texts else "",
                measured=f.key not in texts,
            )
            for f in FIELDS
        )
    drafted = draft_of(path, path.with_name("a draft that is not written.toml"))
    lines = {line.key: line for line in drafted.lines}
    made = []
    for field in FIELDS:
        line = lines.get(field.key)
        if line is None:
            made.append(field)
            continue
        text = line.value.strip('"') if line.stated else ""
        source = (
            line.source
            if line.stated or field.key not in _LISTS
            else f"{line.source} (for example {line.value})"
        )
        made.append(replace(field, text=text, source=source, measured=line.complete))
    return tuple(made)


def form_of(vehicle: Vehicle) -> tuple[Field, ...]:
    """The form of a vehicle that is known."""
    told = Path(vehicle.source).name if vehicle.source else "the record"
    plain = {f.name: f.default for f in fields(Vehicle)}
    made = []
    for field in FIELDS:
        value = getattr(vehicle, field.key)
        if value == plain[field.key]:
            made.append(
                replace(field, text=_text(value) if value else "", source="not said: usual" if value else "")
            )
        else:
            made.append(replace(field, text=_text(value), source=told))
    return tuple(made)


def filled(form: Sequence[Field], texts: Mapping[str, str]) -> tuple[tuple[Field, ...], Vehicle | None]:
    """The form with what its owner wrote, the problem of each value that cannot be taken beside it, and the vehicle
    where there is none."""
    table: dict[str, Any] = {}
    made = []
    for field in form:
        text = " ".join(str(texts.get(field.key, field.text)).split())
        changed = text != " ".join(field.text.split())
        new = replace(field, text=text, problem="")
        if changed:
            new = replace(new, source=GIVEN, measured=True)
        try:
            if text:
                table[field.key] = _checked(field, text)
            elif field.key in _NEEDED:
                raise InputError("has to be given")
        except InputError as error:
            new = replace(new, problem=plain_line(str(error)))
        made.append(new)
    if any(f.problem for f in made):
        return tuple(made), None
    try:
        return tuple(made), vehicle_from_table(table, WHERE)
    except InputError as error:
        # of two values together: beside the second
        problem = plain_line(str(error)).removeprefix(f"{WHERE}: ")
        told = [replace(f, problem=problem if f.key == "rotor_directions" else "") for f in made]
        return tuple(told), None


def write_vehicle(form: Sequence[Field], path: Path, flight: str) -> None:
    """Write the vehicle file of a form without problems, each value with its unit and source."""
    lines = [f"# The vehicle of {flight}, as filled in on the workbench: world ENU, body FLU, SI units."]
    for field in form:
        if not field.known:
            continue
        value = _checked(field, field.text)
        marks = [field.unit, field.source, "" if field.measured else "A GUESS: MEASURE IT"]
        told = " ".join("; ".join(mark for mark in marks if mark).split())
        lines += [f"# {told}"] if told else []
        lines.append(f"{field.key} = {json.dumps(value)}")
    write_whole(path, "\n".join(lines) + "\n", "the vehicle file", "choose another --folder")


def _checked(field: Field, text: str) -> Any:
    """The value of one field, as it stands in the table of a vehicle file."""
    if field.key in _LISTS:
        value: Any = _list(text, field.unit)
    elif field.unit:
        value = in_unit(text, field.unit)
    else:
        value = text
    alone = {**_STAND_IN, field.key: value}
    if field.key == "rotor_positions":
        alone["rotor_directions"] = [1] * len(value)
    if field.key == "rotor_directions":
        alone["rotor_positions"] = [[0.0, 0.0, 0.0]] * len(value)
    try:
        vehicle_from_table(alone, WHERE)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{WHERE}: ")) from None
    return value


def _list(text: str, unit: str) -> Any:
    """A list as JSON has it; a unit may stand behind it."""
    inside, _, behind = text.rpartition("]")
    try:
        value = json.loads(f"{inside}]")
    except ValueError:
        raise InputError(f"{shown(text)} is no list like [1, 2, 3]") from None
    if not isinstance(value, list) or not behind.strip():
        return value
    scale = in_unit(f"1 {behind}", unit)
    return [[x * scale for x in row] if isinstance(row, list) else row * scale for row in value]


def _text(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return json.dumps(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
