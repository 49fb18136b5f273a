"""The report and the recording of an analysis tell the numbers of `--json`, and nothing else."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import programs
import pytest

from trueflight.groundstation import report
from trueflight.groundstation.evaluate.analysis import analyse
from trueflight.groundstation.evaluate.side_by_side import side_by_side
from trueflight.groundstation.output.as_json import analysis_table
from trueflight.groundstation.output.cited import CitedValue, environment, sentences, written
from trueflight.groundstation.reading import read_flight
from trueflight.groundstation.reading.several import told_apart
from trueflight.groundstation.report import SECTIONS, chosen, render, write_report
from trueflight.groundstation.views import write_analysis
from trueflight.models.errors import InputError
from trueflight.models.model import linear_model, rigid_body_model

SAMPLES = Path(__file__).parents[2] / "samples"
BIN = Path(sys.executable).parent
DRAG = SAMPLES / "rotorpy" / "rotor_drag"


@pytest.fixture(scope="module")
def analysis():
    flight, held_out = read_flight(DRAG / "identify.parquet"), read_flight(DRAG / "validate.parquet")
    line = [linear_model(flight.vehicle), rigid_body_model(flight.vehicle)]
    beside = side_by_side([flight, held_out], [line[1:], line[1:]])
    return analyse(flight, line, held_out, side_by_side=beside)


@pytest.fixture(scope="module")
def table(analysis):
    """What `--json` prints, read back."""
    return json.loads(json.dumps(analysis_table(analysis), allow_nan=False))


@pytest.fixture(scope="module")
def page(analysis, table):
    return render(analysis, table)


class Page(HTMLParser):
    """A page's numbers, texts with their place, tags, ids and what it refers to."""

    def __init__(self, text):
        super().__init__()
        self.numbers, self.texts, self.tags, self.ids, self.refers = [], [], [], [], []
        self._open = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        a = dict(attrs)
        self.tags.append((tag, a))
        if "id" in a:
            self.ids.append(a["id"])
        self.refers += [v for k, v in a.items() if k in ("src", "href", "xlink:href", "data", "srcset") and v]
        if tag in ("data", "span"):
            self._open.append((tag, a, []))

    def handle_data(self, data):
        for _, _, words in self._open:
            words.append(data)

    def handle_endtag(self, tag):
        if tag in ("data", "span"):
            kind, a, words = self._open.pop()
            if kind == "data":
                self.numbers.append((a, "".join(words)))
            elif "data-path" in a:
                self.texts.append((a["data-path"], "".join(words)))


def at(table, path):
    for key in path.split("."):
        table = table[int(key)] if isinstance(table, list) else table[key]
    return table


def read_number(shown):
    """The number that a reader sees, and by how much rounding may have moved it."""
    text = shown.replace("−", "-").replace(" %", "")
    mantissa, _, exponent = text.partition("·10")
    exponent = exponent.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    digits = mantissa.partition(".")[2]
    power = 10.0 ** int(exponent or 0)
    return float(mantissa) * power, 0.5 * 10.0 ** -len(digits) * power


def wrong_numbers(page, table):
    """The numbers of a page that are not those of the JSON table."""
    wrong = []
    for a, shown in Page(page).numbers:
        value = at(table, a["data-path"])
        if json.loads(a["value"]) != value:
            wrong.append((a["data-path"], a["value"], value))
        elif value is None:
            if shown != "–":
                wrong.append((a["data-path"], shown, value))
        else:
            percent = 100.0 if a["data-spec"] in ("percent", "change") else 1.0
            seen, rounding = read_number(shown)
            scaled = percent * float(a["data-scale"]) * value
            # "g" formats keep significant digits and drop zeros: three digits are a rounding of half a percent
            if abs(seen - scaled) > max(1.001 * rounding if "." in shown else 0.5, 0.006 * abs(scaled)):
                wrong.append((a["data-path"], shown, scaled))
    return wrong


def test_every_number_of_the_report_is_that_of_the_json(page, table):
    told = Page(page)
    assert len(told.numbers) > 400
    assert wrong_numbers(page, table) == []
    for path, text in told.texts:
        assert text == at(table, path)
    paths = {a["data-path"] for a, _ in told.numbers}
    for needed in (
        "residual_rms.before", "residual_rms.noise_floor", "validation_rms.after", "effects.1.variance_share",
        "effects.1.parameters.x.value", "effects.1.parameters.y.high", "comparison.models.2.rms", "where.worst.0.rms",
        "side_by_side.rows.1.change", "reference.rms.x",
    ):  # fmt: skip
        assert needed in paths


def test_a_corrupted_number_is_seen(page, table):
    """The test above can fail: a digit shown wrongly, and a value that is not the table's."""
    shown = re.search(r'(<data value="[^"]+" data-path="residual_rms.after"[^>]*>)0\.213<', page)
    assert shown
    assert wrong_numbers(page.replace(shown[0], f"{shown[1]}0.231<"), table)
    other = json.loads(json.dumps(table))
    other["effects"][1]["parameters"]["x"]["value"] *= 1.02
    assert [path for path, *_ in wrong_numbers(page, other)] == ["effects.1.parameters.x.value"] * 2


def test_no_number_is_written_into_the_templates():
    """Between tags and braces the templates hold words: a figure in them would be nobody's result."""
    rooms = Path(report.__file__).parents[1]
    files = [f for kind in ("*.txt", "*.md", "sections/*.html") for f in rooms.glob(f"*/templates/{kind}")]
    assert {"verdict.txt", "ranking.md", "where.html"} <= {f.name for f in files}
    for file in files:
        text = re.sub(r"{{.*?}}|{%.*?%}|<[^>]+>", "", file.read_text(), flags=re.DOTALL)
        text = text.replace("95 %", "").replace("SHA-256", "")
        assert not re.search(r"\d", text), f"{file.name}: {text}"


def test_a_number_cannot_slip_into_a_page_unformatted(table):
    with pytest.raises(TypeError, match=r"residual_rms\.before"):
        environment(True).from_string("{{ t.residual_rms.before }}").render(t=CitedValue(table))
    with pytest.raises(Exception, match="no attribute 'befor'"):
        environment(True).from_string("{{ t.residual_rms.befor | num('.3f') }}").render(t=CitedValue(table))


def test_the_page_needs_nothing_else_and_is_accessible(page):
    told = Page(page)
    assert all(ref.startswith("#") for ref in told.refers)
    assert not re.search(r"https?://(?!www\.w3\.org)|@import|<script|<link|<img", page)
    assert {ref[1:] for ref in told.refers} <= set(told.ids)
    assert len(told.ids) == len(set(told.ids))
    assert dict(told.tags[0][1] if told.tags[0][0] == "html" else {}).get("lang") == "en"
    charts = [a for tag, a in told.tags if tag == "svg"]
    assert len(charts) >= 7 and all(a["role"] == "img" and len(a["aria-label"]) > 30 for a in charts)
    assert page.count("<h1>") == 1
    assert "prefers-color-scheme: dark" in page and "@page { size: A4" in page
    # a chart keeps no colour of its own: all of them follow the page's light and dark
    drawn = "".join(re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL))
    assert not re.search(r"#0[0-9a-f]{5}\b", drawn) and "var(--ink)" in drawn


def test_sections_stand_alone(analysis, table):
    for section in SECTIONS:
        if section.name == "flights":  # of several; tests/groundstation/test_several_flights.py has them
            continue
        page = render(analysis, table, [section])
        assert f'id="{section.name}"' in page
        assert wrong_numbers(page, table) == []
    assert [s.name for s in chosen(["where", "worst"])] == [
        s.name for s in SECTIONS if s.name not in ("where", "worst")
    ]
    with pytest.raises(InputError, match="no such section; there are: ranking"):
        chosen(["wherever"])


def test_the_verdict_says_in_words_what_was_found(table):
    headline, effect, fall, held_out = sentences(table, html=False)
    assert headline == "rotor_drag is missing from the model."
    assert "linear drag in the rotor plane" in effect and "54 %" in effect
    assert "0.315 to 0.213" in fall and "0.300 to 0.212" in held_out
    course = {"ended": True, "changes": [{"time": 41.2}], "text": ["x = 0.2 until 41.2 s, none after"]}
    gone = [{**e, "over_time": course} if e["verdict"] == "missing" else e for e in table["effects"]]
    headline, ended, *_ = sentences({**table, "effects": gone}, html=False)
    assert headline.startswith("Nothing is missing from the model at the end of this flight; rotor_drag was")
    assert ended == "rotor_drag ended at 41.2 s: x = 0.2 until 41.2 s, none after."
    nothing = {**table, "effects": [e for e in table["effects"] if e["verdict"] == "included"]}
    assert (
        sentences(nothing, html=False)[0] == "Nothing is missing from the model that this flight could show."
    )


@pytest.mark.parametrize(
    ("value", "spec", "scale", "shown"),
    [
        (0.0042, "percent", 1.0, "0.4 %"),
        (-0.25, "change", 1.0, "−25 %"),
        (0.0123, ".1f", 100.0, "1.2"),
        (1.3e-5, ".2e", 1.0, "1.30·10⁻⁵"),
        (None, ".3f", 1.0, "–"),
    ],
)
def test_numbers_as_people_read_them(value, spec, scale, shown):
    assert written(value, spec, scale) == shown


def test_the_waterfall_ends_at_the_diagnosed_model(analysis):
    labels = [s.label for s in analysis.waterfall]
    assert labels == ["linear", "+ rigid_body", "+ rotor_drag"]
    assert analysis.before is analysis.comparisons[1]
    assert analysis.after.rms == pytest.approx(analysis.diagnosis.rms_after, rel=0.02)
    falling = [s.held_out for s in analysis.waterfall]
    assert falling == sorted(falling, reverse=True)
    for before, left in zip(analysis.where.maps, analysis.where_left.maps, strict=True):
        np.testing.assert_array_equal(before.edges, left.edges)


def test_flights_are_compared_over_the_same_bins(analysis):
    first, second = analysis.side_by_side.where
    for a, b in zip(first.maps, second.maps, strict=True):
        np.testing.assert_array_equal(a.edges, b.edges)
        assert np.nansum(a.share_of_time) == pytest.approx(1.0)
    speed = next(m for m in first.maps if m.variable == "horizontal speed")
    other = next(m for m in second.maps if m.variable == "horizontal speed")
    both = np.isfinite(speed.rms) & np.isfinite(other.rms)
    # the same vehicle with the same drag: as fast, as wrong
    np.testing.assert_allclose(speed.rms[both], other.rms[both], rtol=0.1)
    assert np.isnan(other.rms[-1]) and speed.rms[-1] > 2 * speed.rms[0]


def test_flights_of_one_name_are_told_apart(analysis):
    flight = analysis.flight
    names = [f.name for f in told_apart([flight, replace(flight, origin="elsewhere/identify.parquet")])]
    assert names == ["rotor_drag/identify", "elsewhere/identify"]


def test_the_recording_tells_the_same(tmp_path, analysis, table):
    """Read back: its texts hold the numbers of the table, its moments the times, its bars the waterfall."""
    path = tmp_path / "analysis.rrd"
    write_analysis(path, analysis)
    told = subprocess.run(
        [BIN / "rerun", "rrd", "print", "-vvv", path], capture_output=True, text=True, check=True
    )
    for number in (
        written(table["residual_rms"]["before"], ".3f"),
        written(table["effects"][1]["parameters"]["x"]["high"], ".3f"),
        f"{table['where']['worst'][0]['rms']:.2f} m/s²",
    ):
        assert number in told.stdout, number
    for entity in (
        "/verdict/moments", "/predicted/acceleration/z/measured", "/where/space/path", "/where/maps/tilt/before",
        "/where/place/cells", "/steps/bars/fitted_flight", "/beside/maps/height/1",
    ):  # fmt: skip
        assert entity in told.stdout, entity
    assert path.stat().st_size < 5_000_000


def test_a_report_that_cannot_be_written_is_told(tmp_path):
    with pytest.raises(InputError, match=r"cannot write the report.*choose another --output"):
        write_report(Path("/proc/none/report.html"), "")
    assert list(tmp_path.iterdir()) == []


def run(*arguments, cwd):
    return programs.run("groundstation", *arguments, cwd=cwd)


def test_a_flight_without_accelerometer_position_or_attitude_has_a_report(tmp_path):
    flight = SAMPLES / "crazyflie" / "crazypad_normal_E9_log03.csv"
    done = run("report", flight, "-o", tmp_path / "report.html", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    page, table = (tmp_path / "report.html").read_text(), json.loads(done.stdout)
    assert wrong_numbers(page, table) == []
    assert 'id="tracking"' not in page and 'id="ranking"' in page


def test_two_flights_in_one_command(tmp_path):
    nothing = SAMPLES / "rotorpy" / "nothing_hidden"
    done = run(
        "compare", DRAG / "validate.parquet", nothing / "validate.parquet", "--json",
        "--save", "c.rrd", "-o", "c.html", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    table = json.loads(done.stdout)
    drag, none = table["side_by_side"]["rows"]
    assert (drag["name"], none["name"]) == ("rotor_drag/validate", "nothing_hidden/validate")
    assert none["rms"] < 1.05 * none["noise_floor"] < drag["rms"]
    assert none["change"] == pytest.approx(none["rms"] / drag["rms"] - 1, rel=1e-3)
    assert (tmp_path / "c.rrd").stat().st_size > 10_000
    assert wrong_numbers((tmp_path / "c.html").read_text(), table) == []


def test_two_models_in_one_command(tmp_path):
    added = run("model", "add", "rotor_drag", "--flight", DRAG / "identify.parquet", "--json", cwd=tmp_path)
    assert added.returncode == 0, added.stderr
    done = run(
        "compare", DRAG / "validate.parquet", "--model", "linear", "--model", "v1", "--json", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["side_by_side"]["rows"]
    assert [r["name"] for r in rows] == ["linear", "v1 + rotor_drag"]
    assert rows[1]["change"] < -0.2
    shown = run("compare", DRAG / "validate.parquet", "--model", "linear", "--model", "v1", cwd=tmp_path)
    assert "v1 + rotor_drag" in shown.stdout and max(map(len, shown.stdout.splitlines())) <= 100
