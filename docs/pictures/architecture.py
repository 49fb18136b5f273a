"""Draws the pictures of docs/architecture.md: the house from its real imports, one tick and one diagnosis.

python docs/pictures/architecture.py      # writes house.svg, tick.svg and diagnosis.svg beside itself
"""

import ast
from collections.abc import Iterable
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyBboxPatch

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
INK, FILL, ARROW, SHORT_CUT = "#1a2b3c", "#e8eef5", "#4a6a8a", "#c8d4e0"

FLOORS = (  # groundstation/, from the top: who may import stands above what is imported; and how far to the right
    (("commands", -2.4), ("library", 2.4)),
    (("study", -0.6), ("workbench", 2.0), ("export", 4.6)),
    (("views", -3.6), ("report", 1.6)),
    (("output", -1.2),),
    (("versions", -3.4), ("live", 0.2), ("learn", 2.6)),
    (("evaluate", -0.2),),
    (("identify", -1.7),),
    (("reading", -4.6), ("measured", -2.3), ("design", 0.0), ("results", 2.3), ("operate", 4.6)),
)

TICK = (
    ("ODOMETRY", "from the autopilot, NED and FRD"),
    ("companion/vehicle_link.py, odometry.py", "received; turned to ENU and FLU"),
    ("companion/flight.py, phases.py, course.py", "phase, reference; may anything be sent?"),
    ("companion/law/controllers.py", "one command: thrust and body rates"),
    ("companion/law/guard.py, watch.py", "the correction, as far as it may act"),
    ("companion/vehicle_link.py", "SET_ATTITUDE_TARGET to the autopilot"),
    ("companion/stopping.py, succession.py", "after it has left: reasons to stop; models judged"),
    ("models/record.py, companion/telemetry.py", "the tick on disk and on Zenoh, other threads"),
)

DIAGNOSIS = (
    ("flight.ulg, .mcap, .csv, .parquet", "any log, and vehicle.toml"),
    ("groundstation/reading/", "a checked Flight, ENU and FLU, SI"),
    ("groundstation/measured/", "measured acceleration on the command's clock"),
    ("models/prediction.py, effects/", "what a chain of effects predicts"),
    ("groundstation/identify/", "which effect explains the difference"),
    ("groundstation/results.py", "one result object"),
    ("groundstation/output/, views/, report/", "tables, --json, Rerun, one page"),
    ("groundstation/versions/", "model add: an immutable version"),
)


def rooms() -> dict[tuple[str, str], int]:
    """How many imports go from one room of groundstation/ to another, by their names."""
    found: dict[tuple[str, str], int] = {}
    base = ROOT / "groundstation"
    for path in base.rglob("*.py"):
        inside = path.relative_to(base).parts
        room = inside[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "trueflight.groundstation."
            ):
                other = (node.module or "").split(".")[2]
                if other != room:
                    found[room, other] = found.get((room, other), 0) + 1
    return found


def box(axes: plt.Axes, x: float, y: float, width: float, title: str, below: str = "") -> None:
    """A room or a step, its centre at (x, y)."""
    height = 0.62
    axes.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2), width, height, boxstyle="round,pad=0,rounding_size=0.08", fc=FILL,
            ec=INK, lw=1, zorder=2,
        )
    )  # fmt: skip
    axes.text(
        x, y + (0.13 if below else 0), title, ha="center", va="center", color=INK, weight="bold", zorder=3
    )
    if below:
        axes.text(x, y - 0.15, below, ha="center", va="center", color=INK, size=8, zorder=3)


def save(figure: plt.Figure, name: str) -> None:
    """The picture as SVG without a date, so that it changes only with what it shows."""
    figure.savefig(HERE / name, bbox_inches="tight", facecolor="white", metadata={"Date": None})
    plt.close(figure)
    text = (HERE / name).read_text()
    (HERE / name).write_text("\n".join(line.rstrip() for line in text.splitlines()) + "\n")


def over_others(arrows: Iterable[tuple[str, str]]) -> set[tuple[str, str]]:
    """The arrows whose end is reached over other rooms as well."""
    beside: dict[str, set[str]] = {}
    for one, two in arrows:
        beside.setdefault(one, set()).add(two)

    def below(room: str) -> set[str]:
        near = beside.get(room, set())
        return near.union(*(below(other) for other in near))

    return {(one, two) for one, near in beside.items() for two in near if any(two in below(r) for r in near)}


def house() -> None:
    """groundstation/: rooms and arrows; an arrow points from who imports to what is imported."""
    figure, axes = plt.subplots(figsize=(10, 9))
    place = {name: (x, -1.45 * floor) for floor, names in enumerate(FLOORS) for name, x in names}
    arrows = rooms()
    pale = over_others(arrows)
    assert {room for pair in arrows for room in pair} == set(place), "a room is not drawn: add it to FLOORS"
    for (one, two), count in sorted(arrows.items()):
        (x, y), (u, v) = place[one], place[two]
        assert y > v, f"{one} imports {two}, which does not stand below it: move it in FLOORS"
        short_cut = (one, two) in pale
        axes.annotate(
            "", (u, v + 0.33), (x, y - 0.33), zorder=0 if short_cut else 1,
            arrowprops={"arrowstyle": "-|>", "color": SHORT_CUT if short_cut else ARROW,
                        "lw": 0.6 + 0.12 * min(count, 12)},
        )  # fmt: skip
    for name, (x, y) in place.items():
        box(axes, x, y, 1.7, name)
    axes.set(xlim=(-6, 6), ylim=(-10.7, 0.6))
    axes.axis("off")
    save(figure, "house.svg")
    print(f"{len(arrows)} arrows between {len(place)} rooms, {sum(arrows.values())} import statements")


def way(steps: tuple[tuple[str, str], ...], name: str) -> None:
    """Steps one after the other, from the top to the bottom."""
    figure, axes = plt.subplots(figsize=(6, 0.9 * len(steps)))
    for i, (title, below) in enumerate(steps):
        box(axes, 0, -i, 5.6, title, below)
        if i:
            axes.annotate(
                "", (0, -i + 0.31), (0, -i + 0.69), arrowprops={"arrowstyle": "-|>", "color": ARROW}
            )
    axes.set(xlim=(-3, 3), ylim=(-len(steps) + 0.5, 0.5))
    axes.axis("off")
    save(figure, name)


if __name__ == "__main__":
    plt.rcParams.update({"svg.hashsalt": "trueflight", "font.family": "DejaVu Sans", "font.size": 10})
    house()
    way(TICK, "tick.svg")
    way(DIAGNOSIS, "diagnosis.svg")
