"""A vehicle file drafted from a log: what the log tells, where from, and what it cannot tell."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import programs
import pytest
from px4_layouts import flown, log_of

from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.px4_log import load_ulog
from trueflight.groundstation.versions.vehicle_draft import draft_vehicle, write_draft
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent


def drafted(log, tmp_path, mass=None):
    return draft_vehicle(load_ulog(log.save(tmp_path / "log.ulg")), mass)


def groundstation(*arguments):
    return programs.run("groundstation", *arguments)


def test_geometry_hover_and_voltage_come_from_the_log(tmp_path):
    draft = drafted(log_of("1.15"), tmp_path)
    vehicle = draft.vehicle
    expected = [[0.09, -0.1, -0.01], [-0.08, 0.1, -0.01], [0.09, 0.1, -0.01], [-0.08, -0.1, -0.01]]
    np.testing.assert_allclose(vehicle.rotor_positions, expected)
    assert vehicle.rotor_directions == (1, 1, -1, -1)
    assert vehicle.hover_thrust == pytest.approx(0.38, rel=0.03)
    assert vehicle.nominal_voltage == pytest.approx(np.median(flown().voltage[flown().middle]), abs=0.1)
    assert vehicle.name == "px4-4001"
    assert "MC_ROLLRATE_MAX 220" in draft.text and "MPC_THR_HOVER is 0.4" in draft.text


def test_the_mass_is_never_made_out_to_be_known(tmp_path):
    draft = drafted(log_of("1.15"), tmp_path)
    assert "mass" in draft.to_complete and "rotor_radius" in draft.to_complete
    above = draft.text.splitlines()[draft.text.splitlines().index("mass = 1.0") - 2]
    assert "TO COMPLETE" in above and "WEIGH" in above
    weighed = drafted(log_of("1.15"), tmp_path, mass=0.75)
    assert weighed.vehicle.mass == 0.75 and "mass" not in weighed.to_complete


def test_a_log_from_before_control_allocation_leaves_the_geometry_to_its_owner(tmp_path):
    draft = drafted(log_of("1.12"), tmp_path)
    assert draft.vehicle.rotor_positions == ()
    assert "rotor_positions" in draft.to_complete and "SYS_AUTOSTART 4001" in draft.text


def test_arms_of_a_metre_are_proportions_not_measures(tmp_path):
    log = log_of("1.16")
    for i, (x, y) in enumerate(((1, 1), (-1, -1), (1, -1), (-1, 1))):
        log.parameters |= {f"CA_ROTOR{i}_PX": float(x), f"CA_ROTOR{i}_PY": float(y), f"CA_ROTOR{i}_PZ": 0.0}
    draft = drafted(log, tmp_path)
    assert draft.vehicle.rotor_positions == () and "rotor_positions" in draft.to_complete


def test_a_log_without_a_flight_gives_what_its_parameters_tell(tmp_path):
    log = log_of("1.15", leave_out=("vehicle_attitude", "sensor_combined", "vehicle_odometry"))
    draft = drafted(log, tmp_path)
    assert draft.vehicle.hover_thrust == pytest.approx(0.4)
    assert draft.vehicle.nominal_voltage == pytest.approx(14.8) and "nominal_voltage" in draft.to_complete


def test_the_simulators_own_parameters_are_the_vehicle(tmp_path):
    draft = draft_vehicle(load_ulog(ROOT / "samples" / "px4" / "sih_lemniscate.ulg"))
    assert draft.vehicle.mass == pytest.approx(1.2)
    assert draft.vehicle.inertia == pytest.approx((0.025, 0.025, 0.03))
    assert draft.vehicle.hover_thrust == pytest.approx(1.2 * 9.81 / 20.0, rel=0.03)


def test_a_draft_is_written_whole_and_replaces_nothing(tmp_path):
    draft = drafted(log_of("1.15"), tmp_path)
    path = tmp_path / "new" / "vehicle.toml"
    write_draft(draft, path)
    loaded = load_vehicle(path)
    assert loaded == draft.vehicle
    with pytest.raises(InputError, match="never replaces"):
        write_draft(drafted(log_of("1.15"), tmp_path, mass=9.0), path)
    assert load_vehicle(path) == loaded and [p.name for p in path.parent.iterdir()] == ["vehicle.toml"]


def test_import_drafts_reads_and_says_what_is_missing(tmp_path):
    log = log_of("1.15").save(tmp_path / "log.ulg")
    target = tmp_path / "mine.toml"
    done = groundstation("import", log, "--draft-vehicle", target, "-o", tmp_path / "flight.csv", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["to_complete"][0] == "mass" and told["values"]["hover_thrust"] == pytest.approx(
        0.38, rel=0.03
    )
    assert told["samples"] > 1000 and load_vehicle(target).name == "px4-4001"
    assert read_flight(tmp_path / "flight.csv").vehicle == load_vehicle(target)
    again = groundstation("import", log, "--draft-vehicle", target)
    assert again.returncode == 2 and again.stderr.count("\n") == 1 and "never replaces" in again.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--mass", "1"), "--draft-vehicle"),
        (("--mass", "1", "-o", "x.csv"), "--draft-vehicle"),
        (("--draft-vehicle", "v.toml", "--vehicle", "w.toml"), "leave out --vehicle"),
        (("--draft-vehicle", "f.vehicle.toml", "-o", "f.csv"), "name the draft otherwise"),
    ],
)
def test_import_says_what_goes_together(arguments, said, tmp_path):
    log = log_of("1.15").save(tmp_path / "log.ulg")
    done = groundstation("import", log, *arguments)
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1


def test_where_the_flight_cannot_be_written_there_is_no_draft_either(tmp_path):
    log = log_of("1.15").save(tmp_path / "log.ulg")
    done = groundstation("import", log, "--draft-vehicle", tmp_path / "v.toml", "-o", tmp_path / "flight.txt")
    assert done.returncode == 2 and not (tmp_path / "v.toml").exists()


def test_a_csv_has_no_parameters_to_draft_from(tmp_path):
    (tmp_path / "flight.csv").write_text("t,x\n0,1\n")
    done = groundstation("import", tmp_path / "flight.csv", "--draft-vehicle", tmp_path / "v.toml")
    assert done.returncode == 2 and "only an autopilot's log" in done.stderr


def test_import_alone_tells_what_a_log_holds_and_writes_nothing(tmp_path: Path) -> None:
    log = shutil.copy(
        Path(__file__).parents[2] / "samples" / "px4" / "sih_lemniscate.ulg", tmp_path / "flight.ulg"
    )
    done = programs.run("groundstation", "import", str(log), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "in the air; measured: accelerometer" in done.stdout
    assert "agrees" in done.stdout and "guesses until you draft one" in done.stdout
    command = done.stdout.strip().splitlines()[-1].removeprefix("next: groundstation ")
    assert [path.name for path in tmp_path.iterdir()] == ["flight.ulg"]
    again = programs.run("groundstation", *command.split(), cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "flight.vehicle.toml").is_file()
