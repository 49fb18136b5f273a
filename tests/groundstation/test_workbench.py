"""The workbench in a real browser: from a dropped log to a fallen error, and what stands in the way."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright
from processes import with_parent

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
ROOT = Path(__file__).parents[2]
LOG = ROOT / "samples" / "px4" / "sih_lemniscate.ulg"
VEHICLE = LOG.with_name("vehicle.toml")
PATIENCE = 120_000
"""ms that anything may take."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.fixture(scope="module")
def bench(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page of a workbench of its own."""
    command = [str(Path(sys.executable).with_name("groundstation")), "open", "--no-browser"]
    folder = tmp_path_factory.mktemp("workbench")
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, preexec_fn=with_parent)
    assert process.stdout is not None
    link = re.search(r"http://\S+", process.stdout.readline())
    assert link is not None
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.add_init_script("localStorage.setItem('viewer', 'off')")
    context.set_default_timeout(PATIENCE)
    expect.set_options(timeout=PATIENCE)
    page = context.new_page()
    page.goto(link[0])
    yield page
    context.close()
    process.terminate()
    process.wait()


def drop(page: Page, *files: Path) -> None:
    page.set_input_files("#files", [str(file) for file in files])


def test_from_a_dropped_log_to_a_fallen_error(bench: Page) -> None:
    drop(bench, LOG, VEHICLE)
    bench.get_by_role("button", name="Add thrust_gain").click()
    expect(bench.locator("#falls tr.here")).to_contain_text("v1")
    expect(bench.locator("#falls tr.here td.n").first).to_contain_text("0.")
    expect(bench.locator("#falls tr.here")).to_contain_text("thrust_gain")
    expect(bench.locator("#falls figure svg")).to_be_visible()
    left = [float(text) for text in bench.locator("#falls td.n:nth-child(4)").all_inner_texts()]
    assert left[1] < 0.5 * left[0]
