"""Damaged files through every reader, and writers that are killed or meet a full disk."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import with_parent
from readers import QUAD5, Reader, readers

from trueflight.groundstation.versions.store import newest, save
from trueflight.models.errors import InputError
from trueflight.models.model import Term, rigid_body_model
from trueflight.models.outside import json_object, toml_table
from trueflight.models.vehicle import load_vehicle

HERE, BIN = Path(__file__).parent, Path(sys.executable).parent


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reader, ...]:
    return readers(tmp_path_factory.mktemp("readers"))


def test_whole_files_are_read(every, tmp_path: Path) -> None:
    """Otherwise the damaged ones would be refused for another reason."""
    assert every
    for reader in every:
        path = tmp_path / f"{reader.name}{reader.suffix}"
        path.write_bytes(reader.seeds[0])
        reader.read(path)


@pytest.mark.parametrize(
    ("script", "words"),
    [("mutate.py", ["--count", "3000", "--seed", "2"]), ("writers.py", ["--kills", "4"])],
)
def test_nothing_is_led_astray(script: str, words: list[str]) -> None:
    """In a process of its own: a library may take the process down with it."""
    done = subprocess.run(
        [sys.executable, HERE / script, *words], capture_output=True, text=True, errors="replace", timeout=280
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]


def test_what_a_writer_left_that_was_killed_just_after_its_version_was_whole_is_removed(
    tmp_path: Path,
) -> None:
    """The next version has another number, so nobody writes that one again; who writes at this moment is left alone."""
    model = rigid_body_model(load_vehicle(QUAD5 / "vehicle.toml"))
    made, path = save(tmp_path, model, None)
    left, begun = (path.with_name(f".{path.name}.{token}.part") for token in ("01234567", "89abcdef"))
    left.mkdir()
    (left / path.name).write_text("whole")
    begun.mkdir()
    save(tmp_path, made, made)
    assert not left.exists() and begun.exists()


def test_what_an_older_version_left_unfinished_is_passed_by(tmp_path: Path, caplog) -> None:
    vehicle = load_vehicle(QUAD5 / "vehicle.toml")
    drag = Term("rotor_drag", {"x": 0.3, "y": 0.4})
    made, path = save(tmp_path, rigid_body_model(vehicle).with_terms((drag,)), None)
    for content in ("", path.read_text()[:200], "\0" * 4096):
        left = path.with_name("v0002-wind.json")
        left.unlink(missing_ok=True)
        left.write_text(content)
        assert newest(tmp_path, vehicle) == made
        assert "remove it" in caplog.text
        again, third = save(tmp_path, made, made)
        assert (again.version, again.parent) == (3, 1)
        third.unlink()


def test_one_damaged_record_does_not_hide_the_others(every, tmp_path: Path) -> None:
    record = next(reader for reader in every if reader.name == "record").seeds[0]
    (tmp_path / "whole.mcap").write_bytes(record)
    for number, content in enumerate(
        (b"", record[:100], record[:200] + b"\xff" * 8 + record[208:], b"\x89MCAP0\r\n" * 50)
    ):
        (tmp_path / f"damaged{number}.mcap").write_bytes(content)
    done = subprocess.run(
        [BIN / "groundstation", "flights", tmp_path, "--json"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    rows = {row["flight"]: row for row in json.loads(done.stdout)}
    assert not rows["whole.mcap"]["error"] and all(rows[f"damaged{n}.mcap"]["error"] for n in (0, 1, 3))


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_a_terminal_of_another_encoding_is_written_to(encoding: str) -> None:
    for command in (
        ["groundstation", "--help"],
        ["groundstation", "design", "no°such²file→.toml"],
        ["sim-bridge", "effects"],
    ):
        done = subprocess.run(
            [BIN / command[0], *command[1:]],
            capture_output=True,
            env={**os.environ, "PYTHONIOENCODING": encoding},
        )
        assert done.returncode in (0, 2) and b"Traceback" not in done.stderr, done.stderr


@pytest.mark.parametrize(
    "name", ["a#b", "a?b", "a$b", "a\\b", "a/b", "*", "", " ", "..", "x" * 65, "a\nb", 'a"b', "@x"]
)
def test_a_vehicles_name_is_part_of_keys_and_files(name: str, tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text(f"name = {json.dumps(name)}\nmass = 1.0\nhover_thrust = 0.5\n")
    with pytest.raises(InputError, match="name"):
        load_vehicle(path)


def test_a_byte_order_mark_is_read_and_numbers_beyond_64_bits_are_not(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_bytes(b"\xef\xbb\xbf" + (QUAD5 / "vehicle.toml").read_bytes())
    assert load_vehicle(path).name == "quad5"
    for text in (f"a = {'9' * 400}", f"a = {{b = [{2**64}]}}", "a = " + "[" * 100_000):
        with pytest.raises(InputError, match="not valid TOML"):
            toml_table(text, "x")
    for text in ('{"a": %s}' % ("9" * 400), '{"a": 1, "a": 2}', "[" * 100_000, "[]", '{"a": 1'):
        with pytest.raises(InputError):
            json_object(text, "x", "correct it")


@pytest.mark.parametrize(
    "address", ["serial:///dev/ttyACM0", "serial:///dev/ttyACM0:", "serial:///dev/ttyACM0:fast"]
)
def test_a_serial_address_without_baud_rate_shows_the_right_form(address: str) -> None:
    for command in (["run"], ["preflight"]):
        words = [BIN / "companion", *command, "--vehicle", QUAD5 / "vehicle.toml", "--connect", address]
        done = subprocess.run(words, capture_output=True, text=True, timeout=60)
        assert done.returncode == 2 and "write --connect serial:///dev/ttyACM0:921600" in done.stderr, (
            done.stderr
        )
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_collection_leaves_no_workers_behind_and_goes_on(how: signal.Signals, tmp_path: Path) -> None:
    words = [
        BIN / "sim-bridge",
        "collect",
        "--vehicle",
        QUAD5 / "vehicle.toml",
        "--minutes",
        "0.5",
        "--jobs",
        "2",
        "--json",
    ]
    words += ["-o", tmp_path / "out"]
    child = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=with_parent,
    )
    end = time.monotonic() + 90
    while len(_workers(child.pid)) < 2 and time.monotonic() < end:
        time.sleep(0.02)
    workers = _workers(child.pid)
    child.send_signal(how)
    _, told = child.communicate(timeout=90)
    if how != signal.SIGKILL:  # nothing of it is left then that could end a worker which still starts
        assert b"Traceback" not in told and b"leaked" not in told
    end = time.monotonic() + 90
    while any(_alive(pid) for pid in workers) and time.monotonic() < end:
        time.sleep(0.05)
    assert workers and not [pid for pid in workers if _alive(pid)]
    if how == signal.SIGKILL:
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        assert not list((tmp_path / "out").glob(".*.mcap.*"))


def _workers(parent: int) -> list[int]:
    path = Path(f"/proc/{parent}/task/{parent}/children")
    children = [int(word) for word in path.read_text().split()] if path.exists() else []
    return [pid for pid in children if "spawn_main" in _command(pid)]


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode("utf-8", "replace")
    except OSError:
        return ""


def _alive(pid: int) -> bool:
    return bool(_command(pid))


@pytest.mark.parametrize("left", ["", '{"seed": 1, "scen', "[1]"])
def test_a_reproduction_goes_on_after_a_kill(left: str, tmp_path: Path) -> None:
    """An older version left half a file; this one a hidden one, or a record that nothing was told of yet."""
    from trueflight.groundstation.study.reproduce import Flown, _kept, same_study

    flown = Flown(1, "unseen", "lqr", (1.0, 2.0, 3.0), "finished", "")
    (tmp_path / "study.json").write_text("")
    (tmp_path / ".study.json.12345678.part").mkdir()
    same_study(tmp_path, {"minutes": 5.0})
    same_study(tmp_path, {"minutes": 5.0})
    with pytest.raises(InputError, match="another study"):
        same_study(tmp_path, {"minutes": 6.0})
    path = tmp_path / "unseen-lqr"
    path.with_name("unseen-lqr.json").write_text(left)
    path.with_name("unseen-lqr.mcap").write_bytes(b"half a record")

    def fly(at: Path) -> Flown:
        assert not at.with_name(f"{at.name}.mcap").exists()
        return flown

    assert _kept(path, fly) == flown
    assert _kept(path, lambda at: pytest.fail("flown again")) == flown
