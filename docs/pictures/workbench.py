"""The pictures of docs/workbench.md, and the film strip: the workbench in a real browser, step by step.

    python docs/pictures/workbench.py

It needs chromium (apt-get install chromium) and takes the flights in samples/.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Browser, Page, sync_playwright

HERE = Path(__file__).resolve().parent
SAMPLES = HERE.parents[1] / "samples"
SIZE = {"width": 1280, "height": 800}
SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PATIENCE = 180_000  # ms
FRAME = 760  # px, width of a frame of the strip


@contextmanager
def workbench(
    browser: Browser, folder: Path, *words: str, dark: bool = False, viewer: bool = False
) -> Iterator[Page]:
    """A page of a workbench that works in `folder`."""
    program = str(Path(sys.executable).with_name("groundstation"))
    process = subprocess.Popen(
        [program, "open", "--no-browser", *words], cwd=folder, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        link = re.search(r"http://\S+", process.stdout.readline())
        assert link is not None
        context = browser.new_context(
            viewport=SIZE, color_scheme="dark" if dark else "light", reduced_motion="reduce"
        )  # type: ignore[arg-type]
        context.add_init_script(f"localStorage.setItem('viewer', '{'on' if viewer else 'off'}')")
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        page.goto(link[0])
        yield page
        context.close()
    finally:
        process.terminate()
        process.wait()


def idle(page: Page) -> None:
    """Wait until nothing is being done."""
    page.locator("#job .job").wait_for(state="detached")
    page.wait_for_timeout(700)


def at(page: Page, panel: str, above: int = 150) -> None:
    """Scroll so that a panel begins below what stands at the top."""
    page.evaluate(
        "([panel, above]) => window.scrollTo(0, document.getElementById(panel).getBoundingClientRect().top"
        " + window.scrollY - above)",
        [panel, above],
    )
    page.wait_for_timeout(400)


def from_log_to_fallen_error(browser: Browser, folder: Path) -> list[tuple[str, Path]]:
    """The steps with a PX4 log whose owner believes in another hover thrust than was flown."""
    frames: list[tuple[str, Path]] = []

    def take(page: Page, told: str) -> None:
        path = folder / f"step-{len(frames) + 1}.png"
        page.screenshot(path=path)
        frames.append((told, path))

    with workbench(browser, folder, viewer=True) as page:
        take(page, "1  Drop a log")
        page.set_input_files("#files", str(SAMPLES / "px4" / "sih_lemniscate.ulg"))
        page.fill("[name=hover_thrust]", "50 %")
        page.fill("[name=mass]", "1.0 m")
        page.locator("[name=mass]").press("Enter")
        page.locator(".field.wrong").wait_for()
        at(page, "vehicle")
        take(page, "2  The vehicle is drafted; a wrong unit is refused beside its field")
        page.fill("[name=mass]", "1.0 kg")
        page.locator("[name=mass]").press("Enter")
        page.locator("#compare figure").first.wait_for()
        page.wait_for_timeout(2500)
        at(page, "compare")
        take(page, "3  Measured and predicted, while what is missing is looked for")
        idle(page)
        at(page, "where")
        page.locator("button.jump").first.click()
        page.locator("#viewer[data-at]").wait_for(state="attached")
        page.wait_for_timeout(9000)
        take(page, "4  Where it fails; a worst moment moves the viewer's time")
        at(page, "missing")
        take(page, "5  What is missing: how sure, how large, and what it could be as well")
        page.get_by_role("button", name="Add thrust_gain").click()
        page.locator("#falls tr.here", has_text="v1").wait_for()
        idle(page)
        at(page, "falls")
        page.wait_for_timeout(9000)
        take(page, "6  Add it, and the error falls")
    return frames


def fitted_and_held_out(browser: Browser, folder: Path) -> list[Path]:
    """A flight with another held out, in dark, and side by side."""
    folder = folder / "held-out"
    shutil.copytree(SAMPLES / "rotorpy" / "rotor_drag", folder)
    words = ("identify.parquet", "--validate", "validate.parquet")
    taken = []
    with workbench(browser, folder, *words, dark=True) as page:
        page.get_by_role("button", name="Add rotor_drag").click()
        page.locator("#falls tr.here", has_text="v1").wait_for()
        idle(page)
        at(page, "falls")
        taken.append(folder / "workbench-falls.png")
        page.screenshot(path=taken[-1])
        page.get_by_role("button", name="Compare", exact=True).click()
        page.locator("#beside figure").first.wait_for()
        idle(page)
        at(page, "beside")
        taken.append(folder / "workbench-beside.png")
        page.screenshot(path=taken[-1])
    return taken


def strip(frames: list[tuple[str, Path]], path: Path) -> None:
    """The frames two by two, each under its words."""
    height, head, gap = FRAME * SIZE["height"] // SIZE["width"], 34, 14
    rows = -(-len(frames) // 2)
    sheet = Image.new("RGB", (2 * FRAME + 3 * gap, rows * (height + head + gap) + gap), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.truetype("DejaVuSans.ttf", 20)
    for k, (told, frame) in enumerate(frames):
        x, y = gap + (k % 2) * (FRAME + gap), gap + (k // 2) * (height + head + gap)
        draw.text((x, y), told, fill="#1b1f24", font=font)
        small = Image.open(frame).convert("RGB").resize((FRAME, height), Image.Resampling.LANCZOS)
        sheet.paste(small, (x, y + head))
        draw.rectangle((x, y + head, x + FRAME - 1, y + head + height - 1), outline="#c0c6cd")
    smaller(sheet).save(path, optimize=True)


def smaller(image: Image.Image) -> Image.Image:
    """In few colours, as pictures of the docs are kept."""
    return image.convert("RGB").quantize(192, dither=Image.Dither.NONE)


def main() -> None:
    """Draw them all."""
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("error: no chromium here; apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=SOFTWARE)
        frames = from_log_to_fallen_error(browser, Path(folder))
        strip(frames, HERE / "workbench.png")
        names = ("vehicle", "where", "missing")
        for name, number in zip(names, (2, 4, 5), strict=True):
            picture = Image.open(frames[number - 1][1])
            smaller(picture.resize((960, 600), Image.Resampling.LANCZOS)).save(
                HERE / f"workbench-{name}.png", optimize=True
            )
        for path in fitted_and_held_out(browser, Path(folder)):
            smaller(Image.open(path).resize((960, 600), Image.Resampling.LANCZOS)).save(
                HERE / path.name, optimize=True
            )
        browser.close()


if __name__ == "__main__":
    main()
