"""Who may ask the workbench, what it takes in, and the vehicle's form: without a browser."""

from __future__ import annotations

import http.client
import re
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import with_parent

from trueflight.groundstation.operate.keys import make_keys
from trueflight.groundstation.workbench.quantities import in_unit
from trueflight.groundstation.workbench.uploads import Dropped, beside, ending, shown_name
from trueflight.groundstation.workbench.vehicle_form import drafted_form, filled, form_of, write_vehicle
from trueflight.models.errors import InputError
from trueflight.models.vehicle import load_vehicle

ROOT = Path(__file__).parents[2]
VEHICLE = ROOT / "models" / "vehicles" / "quad5" / "vehicle.toml"


class Bench:
    """A workbench, asked over plain HTTP."""

    def __init__(self, port: int, token: str, folder: Path) -> None:
        self.port, self.token, self.folder = port, token, folder
        self.host = f"127.0.0.1:{port}"
        self.cookie = ""

    def ask(
        self, method: str, path: str, body: bytes = b"", **headers: str
    ) -> tuple[int, str, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port)
        given = {
            "Host": self.host,
            "Origin": f"http://{self.host}",
            "Content-Type": "application/json",
            "Cookie": self.cookie,
        }
        given |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, body, {k: v for k, v in given.items() if v})
        answer = connection.getresponse()
        text = answer.read().decode(errors="replace")
        connection.close()
        return answer.status, text, answer.headers


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("door")
    program = Path(sys.executable).with_name("groundstation")
    process = subprocess.Popen(
        [program, "open", "--no-browser", "--most", "1"],
        cwd=folder, stdout=subprocess.PIPE, text=True, preexec_fn=with_parent,
    )  # fmt: skip
    assert process.stdout is not None
    link = re.search(r"127\.0\.0\.1:(\d+)/\?token=(\S+)", process.stdout.readline())
    assert link is not None
    made = Bench(int(link[1]), link[2], folder)
    _, _, headers = made.ask("GET", f"/?token={made.token}")
    made.cookie = headers["Set-Cookie"].partition(";")[0]
    yield made
    process.terminate()
    process.wait()


def test_a_link_is_good_for_one_browser(
    bench: Bench,
) -> None:
    status, _, headers = bench.ask("GET", f"/?token={bench.token}", Cookie="")
    assert status == 403
    assert "Set-Cookie" not in headers
    assert bench.ask("GET", "/")[0] == 200


def test_the_cookie_is_kept_from_scripts_and_other_pages(bench: Bench, tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("groundstation")
    process = subprocess.Popen(
        [program, "open", "--no-browser"],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True, preexec_fn=with_parent,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        link = re.search(r"127\.0\.0\.1:(\d+)/\?token=(\S+)", process.stdout.readline())
        assert link is not None
        one = Bench(int(link[1]), link[2], tmp_path)
        status, _, headers = one.ask("GET", f"/?token={one.token}")
        assert (status, headers["Location"]) == (303, "/")
        assert {"HttpOnly", "SameSite=strict", "Path=/"} <= set(headers["Set-Cookie"].split("; "))
    finally:
        process.terminate()
        process.wait()


@pytest.mark.parametrize(
    "path", ["/", "/events", "/panels/flights", "/results/x.html", "/viewer", "/static/workbench.js"]
)
def test_without_the_cookie_nothing_is_told(bench: Bench, path: str) -> None:
    assert bench.ask("GET", path, Cookie="")[0] == 403
    assert bench.ask("GET", path, Cookie=bench.cookie[:-1] + "x")[0] == 403


def test_a_name_of_somebody_elses_that_points_here_is_refused(bench: Bench) -> None:
    assert bench.ask("GET", "/", Host=f"evil.example:{bench.port}")[0] == 421
    assert bench.ask("GET", f"/?token={bench.token}", Host="evil.example")[0] == 421


@pytest.mark.parametrize(
    "origin", ["", "null", "http://evil.example", "https://127.0.0.1", "http://127.0.0.1:1"]
)
def test_what_another_page_asks_is_refused(bench: Bench, origin: str) -> None:
    assert bench.ask("POST", "/cancel", b"{}", Origin=origin)[0] == 403
    assert bench.ask("POST", "/cancel", b"{}")[0] == 200


def test_a_page_can_load_and_send_nothing_elsewhere(bench: Bench) -> None:
    headers = bench.ask("GET", "/")[2]
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert "frame-ancestors 'self'" in headers["Content-Security-Policy"]
    assert "http" not in headers["Content-Security-Policy"]


def test_the_name_of_a_dropped_file_leads_nowhere(bench: Bench) -> None:
    name = "..%2F..%2Fetc%2Fpasswd.csv"
    status, told, _ = bench.ask("POST", "/upload", b"t,x\n", X_Name=name, X_Batch="b")
    assert (status, told) == (200, '{"name":"etc/passwd.csv"}')
    dropped = bench.folder / "trueflight-workbench" / "dropped"
    assert [p.name for p in dropped.iterdir()] == ["0001.csv"]
    assert bench.ask("GET", "/results/..%2Fdropped%2F0001.csv")[0] == 404
    assert bench.ask("GET", "/static/..%2f..%2fserver.py")[0] == 404


def test_a_file_that_is_too_large_leaves_nothing(bench: Bench) -> None:
    before = sorted(bench.folder.rglob("*"))
    status, told, _ = bench.ask("POST", "/upload", bytes(1_000_001), X_Name="big.ulg", X_Batch="c")
    assert status == 422
    assert "big.ulg: larger than 1 MB" in told
    assert sorted(bench.folder.rglob("*")) == before


@pytest.mark.parametrize(
    "body", [b"", b"{", b"[]", b"[" * 50_000, b'{"flight": "x"}', b"x" * 70_000, b'{"values": 3}']
)
def test_nonsense_is_refused_in_one_line(bench: Bench, body: bytes) -> None:
    status, told, _ = bench.ask("POST", "/vehicle", body)
    assert status in (400, 409, 413)
    assert re.fullmatch(r'\{"problem":"[^\n]+"\}', told)


@pytest.mark.parametrize(
    ("text", "unit", "number"),
    [("450 g", "kg", 0.45), ("5 in", "m", 0.127), ("20ms", "s", 0.02), ("0,3", "kg", 0.3), ("16 V", "V", 16.0),
     ("1.5e-2", "m", 0.015), ("45 %", "of full collective", 0.45)],
)  # fmt: skip
def test_a_number_is_turned_into_the_unit_of_the_file(text: str, unit: str, number: float) -> None:
    assert in_unit(text, unit) == pytest.approx(number)


@pytest.mark.parametrize("text", ["0.8 m", "eight", "", "1 2 kg", "nan", "1e999 kg", "9" * 400])
def test_a_wrong_unit_or_no_number_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        in_unit(text, "kg")


def test_a_filled_form_is_the_vehicle_and_each_problem_stands_at_its_field(tmp_path: Path) -> None:
    vehicle = load_vehicle(VEHICLE)
    form = form_of(vehicle)
    taken, same = filled(form, {f.key: f.text for f in form})
    assert same is not None
    assert {f.name: getattr(same, f.name) for f in vehicle.__dataclass_fields__.values() if f.compare} == {
        f.name: getattr(vehicle, f.name) for f in vehicle.__dataclass_fields__.values() if f.compare
    }
    write_vehicle(taken, tmp_path / "vehicle.toml", "a flight")
    assert load_vehicle(tmp_path / "vehicle.toml") == vehicle
    wrong, none = filled(form, {"mass": "500", "rotor_radius": "3 s", "inertia": "[1, 2", "name": ""})
    assert none is None
    assert {f.key for f in wrong if f.problem} == {"mass", "rotor_radius", "inertia", "name"}


def test_a_flight_without_a_log_of_an_autopilot_gets_a_form_of_guesses(tmp_path: Path) -> None:
    form = drafted_form(tmp_path / "flight.csv")
    assert {f.key for f in form if not f.measured} == {"name", "mass", "hover_thrust"}


def test_other_machines_are_served_with_keys_alone_and_nobody_without_one_is_let_in(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    make_keys(keys, people=[("anna", "engineer"), ("carl", "operator")])
    make_keys(keys, removed=["carl"])
    program = Path(sys.executable).with_name("groundstation")
    words = [program, "open", "--no-browser", "--host", "127.0.0.2"]
    refused = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "only with keys" in refused.stderr
    process = subprocess.Popen(
        [*words, "--keys", keys], cwd=tmp_path, stdout=subprocess.PIPE, text=True, preexec_fn=with_parent
    )
    try:
        assert process.stdout is not None
        link = re.search(r"https://127\.0\.0\.2:(\d+)(/\?token=\S+)", process.stdout.readline())
        assert link is not None

        def opened_by(person: str) -> int:
            context = ssl.create_default_context(cafile=str(keys / "ca" / "ca.pem"))
            if person:
                context.load_cert_chain(keys / person / "cert.pem", keys / person / "key.pem")
            connection = http.client.HTTPSConnection("127.0.0.2", int(link[1]), context=context)
            connection.request("GET", link[2])
            return connection.getresponse().status

        assert opened_by("anna") == 303
        for person in ("carl", ""):
            with pytest.raises(OSError):
                opened_by(person)
    finally:
        process.terminate()
        process.wait()


def test_files_dropped_together_find_each_other_by_their_names() -> None:
    names = ["a/log1.csv", "a/log1.vehicle.toml", "a/vehicle.toml", "b/log1.csv", "vehicle.toml"]
    files = [Dropped(n, Path(str(k))) for k, n in enumerate(names)]
    assert beside(files[0], files, "vehicle.toml") == Path("1")
    assert beside(files[3], files, "vehicle.toml") is None
    assert beside(Dropped("x.ulg", Path("x")), files, "vehicle.toml") == Path("4")


def test_names_are_shown_as_text_and_endings_are_ours() -> None:
    assert shown_name("..\\..\\a\u202eb\n.ulg") == "ab.ulg"
    assert ending("A.ULG") == ".ulg"
    assert ending("q.vehicle.toml") == ".vehicle.toml"
    with pytest.raises(InputError, match="no kind of flight file"):
        ending("x.sh")
