"""Every bad file: exit code 2 and one line that says what, where and what to do."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.flight_file import ENDINGS
from trueflight.groundstation.reading.several import check_held_out, flights_in
from trueflight.groundstation.reading.writing import own_table
from trueflight.models.errors import InputError, run_command_line

SAMPLES = Path(__file__).parents[2] / "samples"
DRAG = SAMPLES / "rotorpy" / "rotor_drag"
VEHICLE = DRAG / "vehicle.toml"
CRAZYFLIE = SAMPLES / "crazyflie"


@pytest.fixture(scope="module")
def table():
    columns = own_table(read_flight(DRAG / "identify.parquet").part(slice(0, 1200)))
    return {name: column for name, column in columns.items() if name != "flying"}


def refused(arguments, capsys) -> str:
    """What the command line says to bad input; asserts that it is one line, and exit code 2."""
    with pytest.raises(SystemExit) as stopped:
        run_command_line(lambda: app([str(a) for a in arguments], standalone_mode=False))
    told = capsys.readouterr()
    assert stopped.value.code == 2
    assert told.out == ""
    assert told.err.count("\n") == 1 and told.err.startswith("error: ")
    return told.err


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    header = ",".join(columns)
    rows = "\n".join(
        ",".join("" if np.isnan(v) else f"{v:.9g}" for v in row)
        for row in zip(*columns.values(), strict=True)
    )
    path.write_text(f"{header}\n{rows}\n")
    return path


def scaled(prefix, factor):
    return lambda c: {n: v * factor if n.startswith(prefix) else v for n, v in c.items()}


def renamed(old, new):
    return lambda c: {(new if n == old else n): v for n, v in c.items()}


def without(*prefixes):
    return lambda c: {n: v for n, v in c.items() if not n.startswith(prefixes)}


def at(name, rows, value):
    def change(columns):
        changed = columns[name].copy()
        changed[rows] = value
        return {**columns, name: changed}

    return change


def as_xyzw(c):
    w, x, y, z = (c[f"quaternion_{a}"] for a in "wxyz")
    return {**c, "quaternion_w": x, "quaternion_x": y, "quaternion_y": z, "quaternion_z": w}


def conjugated(c):
    return {n: -v if n in ("quaternion_x", "quaternion_y", "quaternion_z") else v for n, v in c.items()}


BAD = {
    # name: (change of a good table, words that must be in the line)
    "missing group": (without("thrust_command"), ["no thrust_command", "mapping"]),
    "missing part of a group": (without("velocity_y"), ["'velocity_y' is missing", "add it"]),
    "misspelt column": (
        renamed("thrust_command", "thurst_command"),
        ["thurst_command", "did you mean 'thrust_command'"],
    ),
    "no measurement": (without("specific_force", "quaternion"), ["neither an accelerometer", "add one"]),
    "no time": (renamed("t", "when"), ["'t'", "is missing"]),
    "time in ms": (scaled("t", 1e3), ["is it in ms", 'unit = "ms"']),
    "time in us": (lambda c: {**c, "t": c["t"] * 1e6}, ["is it in us", 'unit = "us"']),
    "time backwards": (at("t", slice(500, 600), 1.0), ["line 502", "time goes back from 4.99 to 1", "sort"]),
    "duplicated times": (lambda c: {**c, "t": np.floor(c["t"])}, ["duplicates", "more digits"]),
    "too slow": (lambda c: {n: v[::20] for n, v in c.items()}, ["sampled at 5 Hz", "100 Hz is good"]),
    "a time that is no number": (at("t", 77, np.nan), ["line 79", "time is not a number", "remove that row"]),
    "values missing": (
        at("velocity_x", slice(100, 500), np.nan),
        ["line 102", "velocity", "33 % of the rows", "log all"],
    ),
    "half the samples lost": (
        lambda c: {n: np.delete(v, np.s_[200:800]) for n, v in c.items()},
        ["50 % of the samples are lost", "after t = 1.99 s", "cut the flight there"],
    ),
    "quaternion not unit": (
        at("quaternion_w", slice(100, 400), 0.3),
        ["quaternion is not unit", "unit quaternion"],
    ),
    "quaternion in degrees": (scaled("quaternion", 57.3), ["quaternion is not unit", "degrees"]),
    "quaternion xyzw": (as_xyzw, ["attitude and gyroscope", "contradict", "x, y, z, w", 'order = "xyzw"']),
    "quaternion world to body": (
        conjugated,
        ["attitude and gyroscope", "contradict", "world to body", "inverse = true"],
    ),
    "rates in deg/s": (scaled("angular_velocity", 57.29578), ["deg/s", "Convert it to rad/s"]),
    "commanded rates in deg/s": (scaled("body_rate_command", 57.29578), ["commanded body rates", "deg/s"]),
    "specific force in g": (
        scaled("specific_force", 1 / 9.81),
        ["'specific_force.unit = \"g\"'"],
    ),
    "specific force FRD": (scaled("specific_force", -1.0), ['specific_force.axes = ["-x", "-y", "-z"]']),
    "gravity taken out": (
        lambda c: {**c, "specific_force_z": c["specific_force_z"] - 9.81},
        ["gravity was taken out"],
    ),
    "axes swapped": (
        lambda c: {**c, "specific_force_x": c["specific_force_z"], "specific_force_z": c["specific_force_x"]},
        ['specific_force.axes = ["z", "y", "x"]'],
    ),
    "thrust in u16": (scaled("thrust_command", 65535.0), ["16-bit", 'unit = "u16"']),
    "thrust in percent": (scaled("thrust_command", 100.0), ["percent"]),
    "thrust down": (scaled("thrust_command", -1.0), ["up is positive", "sign = -1"]),
    "battery in mV": (scaled("battery_voltage", 1e3), ["in mV", 'unit = "mV"']),
    "position in mm": (scaled("position_", 1e3), ["position and velocity contradict", 'unit = "mm"']),
    "velocity down": (
        lambda c: {**c, "velocity_y": -c["velocity_y"]},
        ["velocity is in other axes", 'axes = ["x", "-y", "z"]'],
    ),
    "too short": (
        lambda c: {n: v[:150] for n, v in c.items()},
        ["only 1.5 s of 1.5 s are in the air", "fly longer"],
    ),
    "a few rows": (lambda c: {n: v[:10] for n, v in c.items()}, ["only 10 samples", "2 s of flight"]),
    "never flies": (scaled("thrust_command", 0.01), ["only 0.0 s", "hover_thrust"]),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_table_is_told_in_one_line(case, table, tmp_path, capsys):
    change, words = BAD[case]
    path = write(tmp_path / "flight.csv", change(table))
    line = refused(["import", path, "--vehicle", VEHICLE, "-o", tmp_path / "out.csv"], capsys)
    for word in ["flight.csv", *words]:
        assert word in line, line
    assert not (tmp_path / "out.csv").exists()


def test_the_good_table_passes(table, tmp_path):
    path = write(tmp_path / "flight.csv", table)
    assert read_flight(path, VEHICLE).notes == ()


CONTENTS = {
    "empty": (b"", ["is empty"]),
    "header only": (b"t,thrust_command\n", ["no rows"]),
    "words": (b"t,thrust_command\n0.01,0.4\n0.02,full\n0.03,0.4\n", ["line 3", "'full'", "not a number"]),
    "two columns of a name": (b"t,x,x\n0.01,1,2\n0.02,1,2\n", ["two columns are named 'x'", "rename"]),
    "ragged": (b"t,thrust_command\n0.01,0.4\n0.02,0.4,9\n0.03,0.4\n", ["correct that line"]),
    "points, then commas": (
        b"t;thrust_command\n0.01;0.4\n0,02;0,4\n0.03;0.4\n",
        ["line 3", "'0,02'", "decimal points and commas are mixed"],
    ),
    "commas between commas": (
        b"t,thrust_command\n" + b"".join(b"0,%d,0,4\n" % k for k in range(10, 40)),
        ["decimal commas between commas?", "semicolons"],
    ),
    "lists": (
        b't,thrust_command,p\n0.01,"[0.4]","[0,1]"\n0.02,"[0.4]","[0,1]"\n',
        ["thrust_command", "'[0.4]'", "not a number"],
    ),
    "binary": (bytes(range(256)) * 40, ["bad.csv"]),
}


@pytest.mark.parametrize("case", CONTENTS)
def test_a_file_that_is_no_table_is_told_in_one_line(case, tmp_path, capsys):
    content, words = CONTENTS[case]
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    line = refused(["import", path, "--vehicle", VEHICLE, "-o", tmp_path / "out.csv"], capsys)
    for word in ["bad.csv", *words]:
        assert word in line, line


FILES = {
    "no file": ("nothing.csv", None, ["no such file", "check the path"]),
    "unknown kind": ("flight.bag", b"x", ["'.bag' is no kind of flight file", ".mcap"]),
    "no Parquet": ("flight.parquet", b"hello", ["Parquet"]),
    "no MCAP": ("flight.mcap", b"hello", ["not an MCAP file"]),
    "no ULog": ("flight.ulg", b"hello", ["not a whole ULog", "copy it"]),
    "ULog header only": (
        "flight.ulg",
        (SAMPLES / "px4" / "sih_lemniscate.ulg").read_bytes()[:2000],
        ["flight.ulg"],
    ),
    "ULog cut short": (
        "flight.ulg",
        (SAMPLES / "px4" / "sih_lemniscate.ulg").read_bytes()[:60000],
        ["flight.ulg", "cut short"],
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_a_file_of_the_wrong_kind_is_told_in_one_line(case, tmp_path, capsys):
    name, content, words = FILES[case]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    line = refused(["import", tmp_path / name, "--vehicle", VEHICLE, "-o", tmp_path / "out.csv"], capsys)
    for word in [name, *words]:
        assert word in line, line


MAPPINGS = {
    "unknown quantity": ("[thrust]\ncolumn = 'a'", ["unknown quantity 'thrust'", "thrust_command"]),
    "unknown key": ("[time]\ncolum = 't_s'", ["unknown key 'colum'", "did you mean 'column'"]),
    "unknown unit": ("[time]\ncolumn = 't_s'\nunit = 'minutes'", ["unit is 'minutes'", "ms"]),
    "wrong count": ("[time]\ncolumn = 't_s'\n[position]\ncolumns = ['px_m']", ["[position]", "3 names"]),
    "missing column": (
        "[time]\ncolumn = 't_s'\n[position]\ncolumns = ['px_m', 'py_m', 'pz']",
        ["column 'pz' for [position]", "did you mean 'pz_m'"],
    ),
    "bad frame": ("frame = 'ned'\n[time]\ncolumn = 't_s'", ["frame is 'ned'", "ned_frd"]),
    "bad order": (
        "[time]\ncolumn = 't_s'\n[quaternion]\ncolumns = ['qx', 'qy', 'qz', 'qw']\norder = 'zyxw'",
        ["order is 'zyxw'", "xyzw"],
    ),
    "bad sign": ("[time]\ncolumn = 't_s'\nsign = 2", ["[time] sign", "1 or -1"]),
    "pitch without acceleration": (
        "[time]\ncolumn = 't_s'\n[attitude]\nroll = 'qx'\npitch = 'from_acceleration'\nyaw = 'qz'",
        ["needs [world_acceleration]"],
    ),
    "no TOML": ("[time\n", ["not valid TOML", "correct that line"]),
}


@pytest.mark.parametrize("case", MAPPINGS)
def test_a_bad_mapping_is_told_in_one_line(case, tmp_path, capsys):
    text, words = MAPPINGS[case]
    mapping = tmp_path / "my.toml"
    mapping.write_text(text)
    log = CRAZYFLIE / "crazyswarm2_log08.csv"
    line = refused(["import", log, "--mapping", mapping, "-o", tmp_path / "out.csv"], capsys)
    for word in ["my.toml", *words]:
        assert word in line, line


def test_a_mapping_of_foreign_columns_needs_their_time(tmp_path, capsys):
    log, mapping = tmp_path / "log.csv", tmp_path / "my.toml"
    log.write_bytes((CRAZYFLIE / "crazyswarm2_log08.csv").read_bytes())
    mapping.write_text("[position]\ncolumns = ['px_m', 'py_m', 'pz_m']")
    vehicle = CRAZYFLIE / "crazyswarm2_log08.vehicle.toml"
    line = refused(
        ["import", log, "--mapping", mapping, "--vehicle", vehicle, "-o", tmp_path / "out.csv"], capsys
    )
    assert "my.toml" in line and "[time] is missing" in line


def test_degrees_in_an_attitude_are_told(tmp_path, capsys):
    mapping = tmp_path / "my.toml"
    text = (CRAZYFLIE / "crazypad.mapping.toml").read_text()
    mapping.write_text(text.replace('unit = "deg"\n', ""))
    log = CRAZYFLIE / "crazypad_cut_M3_3mm_E9_log00.csv"
    line = refused(["import", log, "--mapping", mapping, "-o", tmp_path / "out.csv"], capsys)
    assert "is it in degrees" in line and 'unit = "deg"' in line


VEHICLES = {
    "typo": ("mass = 0.9", "masss = 0.9", ["unknown key 'masss'", "did you mean 'mass'"]),
    "mass of 500": ("mass = 0.9", "mass = 500", ["mass = 500 is outside", "kg"]),
    "missing": ("hover_thrust = 0.45", "#", ["'hover_thrust' is missing"]),
}


@pytest.mark.parametrize("case", VEHICLES)
def test_a_bad_vehicle_file_is_told_in_one_line(case, tmp_path, capsys):
    old, new, words = VEHICLES[case]
    path = tmp_path / "vehicle.toml"
    text = re.sub(r"mass = 0\.9", "mass = 0.9", VEHICLE.read_text())
    assert old in text
    path.write_text(text.replace(old, new))
    line = refused(
        ["import", DRAG / "validate.parquet", "--vehicle", path, "-o", tmp_path / "out.csv"], capsys
    )
    for word in ["vehicle.toml", *words]:
        assert word in line, line


def test_no_vehicle_beside_a_flight_is_told(table, tmp_path, capsys):
    path = write(tmp_path / "flight.csv", table)
    assert "pass --vehicle FILE" in refused(["import", path, "-o", tmp_path / "out.csv"], capsys)


def test_import_neither_overwrites_its_source_nor_invents_a_format(table, tmp_path, capsys):
    path = write(tmp_path / "flight.csv", table)
    before = path.read_bytes()
    assert "that is the file itself" in refused(["import", path, "--vehicle", VEHICLE, "-o", path], capsys)
    assert path.read_bytes() == before
    line = refused(["import", path, "--vehicle", VEHICLE, "-o", tmp_path / "out.json"], capsys)
    assert ".csv or .parquet" in line
    line = refused(["import", path, "--vehicle", VEHICLE, "-o", "/proc/no/out.csv"], capsys)
    assert "cannot write" in line


def test_a_folder_with_a_bad_flight_lists_the_others(table, tmp_path, capsys):
    write(tmp_path / "good.csv", table)
    (tmp_path / "bad.csv").write_text("")
    (tmp_path / "vehicle.toml").write_text(VEHICLE.read_text())
    import json

    app(["flights", str(tmp_path), "--json"], standalone_mode=False)
    rows = {row["flight"]: row for row in json.loads(capsys.readouterr().out)}
    assert "is empty" in rows["bad.csv"]["error"]
    assert rows["good.csv"]["error"] == "" and rows["good.csv"]["duration"] > 11
    assert "no such folder" in refused(["flights", tmp_path / "nowhere"], capsys)
    assert "is a folder; pass one of its flights" in refused(["diagnose", tmp_path], capsys)


def test_of_files_that_differ_in_their_ending_only_one_is_read(tmp_path):
    for ending in ENDINGS:
        (tmp_path / f"one{ending}").touch()
    (tmp_path / f"two{ENDINGS[-1]}").touch()
    assert flights_in([tmp_path]) == [tmp_path / f"one{ENDINGS[0]}", tmp_path / f"two{ENDINGS[-1]}"]


@pytest.mark.parametrize(
    "command",
    ["diagnose", "report -o page.html", "identify", "model add rotor_drag --store store --flight"],
)
def test_a_flight_is_not_held_out_of_its_own_fit(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flight = DRAG / "identify.parquet"
    told = refused([*command.split(), flight, "--validate", flight], capsys)
    assert "identify.parquet: the flight that is fitted; hold out another one, or none" in told
    assert not (tmp_path / "store").exists() and not (tmp_path / "page.html").exists()


def test_a_folder_that_holds_no_effects_and_a_file_that_is_no_store_are_told(tmp_path, capsys):
    flight = DRAG / "identify.parquet"
    told = refused(["diagnose", flight, "--effects", tmp_path], capsys)
    assert f"{tmp_path}: holds no effects (*.py)" in told and "groundstation effect new" in told
    (tmp_path / "store").write_text("")
    told = refused(["compare", flight, "--store", tmp_path / "store"], capsys)
    assert "is a file and no model store; pass its folder with --store" in told


def test_a_flight_of_another_vehicle_is_not_held_out(tmp_path):
    fitted = read_flight(DRAG / "identify.parquet")
    other = read_flight(DRAG / "validate.parquet")
    check_held_out(other, [fitted])
    other = replace(other, vehicle=replace(other.vehicle, name="scout"))
    with pytest.raises(
        InputError, match=r"validate.parquet is of vehicle 'scout', .*identify.parquet of 'hb'"
    ):
        check_held_out(other, [fitted])
