"""The workbench in a real browser: from a dropped log to a fallen error, and what stands in the way."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import programs
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright
from processes import with_parent

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
ROOT = Path(__file__).parents[2]
LOG = ROOT / "samples" / "px4" / "sih_lemniscate.ulg"
VEHICLE = LOG.with_name("vehicle.toml")
PATIENCE = 60_000
"""ms that anything may take."""
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    expect.set_options(timeout=PATIENCE)
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
        yield started
        started.close()


@contextmanager
def opened(browser: Browser, folder: Path, *words: object, viewer: str = "off") -> Iterator[Page]:
    """The page of a workbench of its own."""
    command = [Path(sys.executable).with_name("groundstation"), "open", "--no-browser", *words]
    process = subprocess.Popen(
        list(map(str, command)), cwd=folder, stdout=subprocess.PIPE, text=True, preexec_fn=with_parent
    )
    context: BrowserContext | None = None
    try:
        assert process.stdout is not None
        link = re.search(r"http://\S+", process.stdout.readline())
        assert link is not None
        context = browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
        context.add_init_script(f"localStorage.setItem('viewer', '{viewer}')")
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        page.goto(link[0])
        yield page
    finally:
        if context is not None:
            context.close()
        process.terminate()
        process.wait()


def drop(page: Page, *files: Path) -> None:
    page.set_input_files("#files", [str(file) for file in files])


def residuals(page: Page) -> dict[str, float]:
    """What each version leaves on the fitted flight, as far as it is known."""
    rows = page.locator("#falls tr[data-version-row]").all()
    told = {row.get_attribute("data-version-row"): row.locator("td.n").first.inner_text() for row in rows}
    return {str(label): float(text) for label, text in told.items() if text}


def test_from_a_dropped_log_to_a_fallen_error_and_back(browser: Browser, tmp_path: Path) -> None:
    with opened(browser, tmp_path) as page:
        drop(page, LOG, VEHICLE)
        # measured and predicted, and where, come before what is missing is known; a second tab sees the same
        other = page.context.new_page()
        other.goto(page.url)
        expect(other.locator("#compare figure svg").first).to_be_visible()
        other.get_by_role("button", name="Add thrust_gain").click()
        # both tabs show the fit, and so does one that is reloaded in its middle
        expect(page.locator("#doing")).to_contain_text("adding thrust_gain")
        page.reload()
        expect(page.locator("#doing, #falls tr.here")).to_contain_text(["thrust_gain"])
        here = page.locator("#falls tr.here")
        expect(here).to_contain_text("v1")
        expect(here.locator("td.n").first).to_contain_text("0.")
        expect(other.locator("#falls tr.here")).to_contain_text("v1")
        left = residuals(page)
        assert left["v1"] < 0.5 * left["linear"]
        expect(page.locator("#job code")).to_contain_text("groundstation model add thrust_gain --flight")
        expect(page.locator("#job .job")).to_have_count(0)
        with page.expect_download() as report:
            page.get_by_role("link", name="Download the report").click()
        assert "thrust" in Path(report.value.path()).read_text()
        page.get_by_role("button", name="Undo v1").click()
        expect(here).to_contain_text("none added")
        page.get_by_role("button", name="Compare", exact=True).click()
        expect(page.locator("#beside figure svg").first).to_be_visible()
        other.close()
        # a worst moment moves the time of the viewer, which says itself where it is
        page.get_by_role("button", name="3D and curves").click()
        jump = page.locator("#where button.jump").first
        jump.click()
        moment = float(jump.get_attribute("data-seconds") or "nan")
        expect(page.locator("#viewer")).to_have_attribute("data-at", f"{moment:g}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench")


@pytest.fixture(scope="module")
def bench(browser: Browser, folder: Path) -> Iterator[Page]:
    with opened(browser, folder) as page:
        yield page


def test_a_bad_file_is_one_line_in_the_words_of_the_terminal(bench: Page, folder: Path) -> None:
    cut = folder / "cut.ulg"
    cut.write_bytes(LOG.read_bytes()[:3000])
    shutil.copy(VEHICLE, folder)
    evil = folder / "<img src=x onerror=alert(1)>.exe"
    evil.write_text("no flight")
    said = programs.run("groundstation", "import", cut, "--check")
    words = said.stderr.removeprefix(f"error: {cut}").strip()
    drop(bench, cut, VEHICLE)
    expect(bench.locator("#flights tr .problem")).to_have_text(f"cut.ulg{words}")
    drop(bench, evil)
    expect(bench.locator("#drop-problem")).to_contain_text("is no kind of flight file")
    drop(bench, VEHICLE)
    expect(bench.locator("#drop-problem")).to_contain_text("no flight among these files")
    stored = [p.name for p in (folder / "trueflight-workbench" / "dropped").iterdir()]
    assert [name for name in stored if not re.fullmatch(r"\d{4}\.(ulg|vehicle\.toml)", name)] == []
    bench.get_by_role("button", name="take cut.ulg off the page").click()
    expect(bench.locator("#flights tbody tr")).to_have_count(0)


def test_a_vehicle_is_drafted_and_a_wrong_unit_refused_beside_its_field(bench: Page, folder: Path) -> None:
    drop(bench, LOG)
    mass = bench.get_by_label("mass, with battery")
    beside = bench.locator(".field", has=mass)
    expect(beside).to_contain_text("SIH_MASS")
    radius = bench.locator(".field", has=bench.get_by_label("radius of a propeller"))
    expect(radius).to_contain_text("guess")
    mass.fill("0.8 m")
    bench.keyboard.press("Enter")
    expect(beside).to_contain_text("'m' is no unit of mass")
    expect(mass).to_be_focused()
    mass.fill("800 g")
    bench.keyboard.press("Enter")
    # what is being done can be ended, and the page stays
    expect(bench.locator("#doing")).to_contain_text("what is missing")
    bench.keyboard.press("Escape")
    expect(bench.locator("#job .problem")).to_contain_text("cancelled")
    written = list((folder / "trueflight-workbench" / "vehicles").iterdir())
    assert ["mass = 0.8\n" in path.read_text() for path in written] == [True]
