"""Command lines of the network: train, ablate."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from trueflight.groundstation.commands.options import (
    DEFAULT_STORE,
    BandwidthOption,
    EffectsOption,
    JsonOption,
    MappingOption,
    ModelOption,
    SaveOption,
    StoreOption,
    VehicleOption,
)
from trueflight.groundstation.output.terminal import print_start, print_written
from trueflight.models.errors import InputError
from trueflight.models.printed import print_json
from trueflight.models.terminal import Terminal

if TYPE_CHECKING:
    from trueflight.groundstation.learn.ablation import Ablation
    from trueflight.groundstation.learn.training import Epoch, Training
    from trueflight.groundstation.learn.training_data import Samples
    from trueflight.groundstation.reading.mapping import Given
    from trueflight.models.flight import Flight
    from trueflight.models.model import Model

console = Terminal()
BESIDE = "what is left by"

FlightsArgument = Annotated[
    list[Path], typer.Argument(help="Flights, or folders of them: MCAP records, CSV, Parquet, PX4 ULogs.")
]
RecipeOption = Annotated[str, typer.Option("--recipe", help="default, or paper.")]
SeedOption = Annotated[
    int, typer.Option("--seed", help="Of the split, the first weights and the batches.", min=0)
]
EpochsOption = Annotated[
    int | None, typer.Option("--epochs", help="At most so many; default: the recipe's.", min=1, max=100000)
]


def register(app: typer.Typer) -> None:
    """Add the commands of the network to the ground station's application."""
    app.command("train", epilog="Example: groundstation train flights --model v2 --save training.rrd")(
        train_command
    )
    app.command("ablate", epilog="Example: groundstation ablate flights --features --save ablation.rrd")(
        ablate_command
    )


def train_command(
    flight: FlightsArgument,
    model: ModelOption = None,
    recipe: RecipeOption = "default",
    layers: Annotated[str, typer.Option("--layers", help="Widths of the hidden layers.")] = "64,64",
    seed: SeedOption = 0,
    epochs: EpochsOption = None,
    store: StoreOption = DEFAULT_STORE,
    save: SaveOption = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the training that Ctrl-C interrupted.")
    ] = False,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train a network on what a model leaves over, and write a new model version with it.

    The network learns what the linear model plus the effects of --model (default: the newest version, else
    exact rotation alone; `linear` as in the paper) do not explain of these flights.
    """
    from trueflight.groundstation.learn.training import recipe_named, train, with_epochs
    from trueflight.groundstation.output.as_json import training_table
    from trueflight.groundstation.versions.store import save as save_version

    widths, chosen = _widths(layers), with_epochs(recipe_named(recipe), epochs)
    flights = _read_flights(flight, vehicle, mapping, as_json)
    base = _base(model, flights, store, effects)
    samples = _samples(flights, base, bandwidth, as_json)
    checkpoint = store / base.vehicle.name / "training.checkpoint"
    with nullcontext() if as_json else _bar("training", chosen.epochs) as show:

        def progress(number: int, epoch: Epoch) -> None:
            if show is not None:
                show(number, f"held out {epoch.validation_rms:.4f} m/s²")

        done = train(samples, chosen, widths, seed, checkpoint, resume, progress)
    if done.interrupted:
        console.print(
            f"interrupted after {len(done.history)} epochs; --resume goes on from {checkpoint}",
            style="yellow",
        )
        raise typer.Exit(130)
    made, path = save_version(store, base.with_network(done.network), base if base.version else None)
    checkpoint.unlink(missing_ok=True)
    if save is not None:
        from trueflight.groundstation.views import write_training

        write_training(save, done, samples, made.label)
    if as_json:
        table = training_table(made, done, samples, path)
        print_json({**table, "recording": None if save is None else str(save)})
        return
    print_start(console, base, BESIDE)
    _print_training(done, samples, base)
    console.print(f"model version: {path}", highlight=False)
    print_written(console, save)


def ablate_command(
    flight: FlightsArgument,
    model: ModelOption = None,
    recipe: RecipeOption = "default",
    widths: Annotated[str, typer.Option("--widths", help="Widths to try.")] = "8,16,32,64,128",
    depths: Annotated[str, typer.Option("--depths", help="Numbers of hidden layers to try.")] = "1,2,3",
    features: Annotated[
        bool, typer.Option("--features", help="Also ask what each feature is worth.")
    ] = False,
    seed: SeedOption = 0,
    epochs: EpochsOption = None,
    store: StoreOption = DEFAULT_STORE,
    save: SaveOption = None,
    vehicle: VehicleOption = None,
    mapping: MappingOption = None,
    effects: EffectsOption = None,
    bandwidth: BandwidthOption = None,
    as_json: JsonOption = False,
) -> None:
    """How small a network may be: layers and widths against error, size and inference time.

    Trains one network of each size on the same flights and marks the smallest within 5 % of the best.
    """
    from dataclasses import asdict

    from trueflight.groundstation.learn.ablation import LEAST_IMPORTANT, ablate, architectures
    from trueflight.groundstation.learn.training import recipe_named, with_epochs
    from trueflight.groundstation.output.as_json import plain

    tried = architectures(_numbers("--depths", depths, 7), _numbers("--widths", widths, 1024))
    chosen = with_epochs(recipe_named(recipe), epochs)
    flights = _read_flights(flight, vehicle, mapping, as_json)
    base = _base(model, flights, store, effects)
    samples = _samples(flights, base, bandwidth, as_json)
    jobs = len(tried) + (len(samples.varying) + LEAST_IMPORTANT if features else 0)
    with nullcontext() if as_json else _bar("ablation", jobs) as show:
        count = 0

        def progress(what: str) -> None:
            nonlocal count
            count += 1
            if show is not None:
                show(count, what)

        result = ablate(samples, base, flights[0], chosen, seed, tried, features, progress)
    if save is not None:
        from trueflight.groundstation.views import write_ablation

        write_ablation(save, result)
    if as_json:
        print_json(
            plain({**asdict(result), "recipe": chosen.name, "recording": None if save is None else str(save)})
        )
        return
    print_start(console, base, BESIDE)
    _print_ablation(result)
    print_written(console, save)


# --- what goes in ---------------------------------------------------------------------------------------------------


def _read_flights(paths: list[Path], vehicle: Path | None, mapping: Given, quiet: bool) -> list[Flight]:
    from trueflight.groundstation.reading.several import flights_in, read_flights

    files = flights_in(paths)
    with nullcontext() if quiet or len(files) < 4 else _bar("reading flights", len(files)) as show:

        def tell(done: int, file: Path) -> None:
            if show is not None:
                show(done, file.name)

        return read_flights(files, vehicle, mapping, tell)


def _base(which: str | None, flights: list[Flight], store: Path, effects: Path | None) -> Model:
    """The model whose remainder is learnt, checked against the vehicle of every flight."""
    from trueflight.groundstation.versions.choice import check_vehicle, choose_model

    model = choose_model(flights[0], which, store, effects)
    for flight in flights:
        check_vehicle(model, flight)
    return model


def _samples(flights: list[Flight], base: Model, bandwidth: float | None, quiet: bool) -> Samples:
    from trueflight.groundstation.learn.training_data import samples_of_flights

    with nullcontext() if quiet else _bar("measuring the remainder", len(flights)) as show:
        count = 0

        def advance() -> None:
            nonlocal count
            count += 1
            if show is not None:
                show(count, "")

        return samples_of_flights(flights, base, bandwidth, advance)


def _widths(text: str) -> tuple[int, ...]:
    return _numbers("--layers", text, 1024)


def _numbers(option: str, text: str, most: int) -> tuple[int, ...]:
    parts = [p.strip() for p in text.split(",")]
    if not all(p.isdecimal() and len(p) < 6 and 1 <= int(p) <= most for p in parts) or len(parts) > 20:
        raise InputError(
            f"{option} {text}: give whole numbers from 1 to {most} with commas between, like 64,64"
        )
    return tuple(map(int, parts))


# --- what comes out -------------------------------------------------------------------------------------------------


@contextmanager
def _bar(what: str, total: int) -> Iterator[Callable[[int, str], None]]:
    """A progress bar; yields a function of (done, note)."""
    columns = (
        TextColumn("{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(what, total=total, note="")

        def show(done: int, note: str) -> None:
            progress.update(task, completed=done, note=note)

        yield show


def _print_training(done: Training, samples: Samples, base: Model) -> None:
    from trueflight.models.terminal import Table

    network, fit = done.network, done.network.fit
    table = Table(
        title=f"{network.label} beside {base.with_network(None).label}: remainder on held-out blocks, RMS in m/s²",
    )
    for column in ("axis", "before", "with network", "noise floor"):
        table.add_column(column, justify="left" if column == "axis" else "right")
    before = samples.only(done.validation).target
    for axis, name in enumerate("xyz"):
        was = float((before[:, axis].astype(float) ** 2).mean() ** 0.5)
        table.add_row(
            name, f"{was:.4f}", f"{fit[f'validation_rms_{name}']:.4f}", f"{fit[f'noise_floor_{name}']:.4f}"
        )
    table.add_row(
        "all",
        f"{fit['before_rms']:.4f}",
        f"{fit['validation_rms']:.4f}",
        f"{fit['noise_floor']:.4f}",
        style="bold",
    )
    console.print(table)
    if told := no_help(fit, base):
        console.print(told, style="yellow", highlight=False)
    _print_remarks(done, samples, base)


def no_help(fit: Mapping[str, float], base: Model) -> str:
    """'' or, of a network that predicts held-out flight no better than `base` alone, what to fly instead."""
    if fit["validation_rms"] < fit["before_rms"]:
        return ""
    without = f"--model v{base.version}" if base.version else "--model linear, or a version that has none"
    return (
        "the network predicts held-out flight no better than without it: fly and diagnose without it "
        f"({without}), or train on more"
    )


def _print_remarks(done: Training, samples: Samples, base: Model) -> None:
    """What was trained on, and what to know of it."""
    from trueflight.groundstation.learn.training import MATERIAL_MEMORY, memory_share
    from trueflight.models.effect import Stage
    from trueflight.models.effects import catalogue

    network, minutes = done.network, samples.seconds / 60.0
    console.print(
        f"{minutes:.1f} min of {len(samples.flights)} flights, {100 * done.train.mean():.0f} % trained on, "
        f"{100 * done.validation.mean():.0f} % held out; {network.parameters} parameters; {len(done.history)} epochs "
        f"in {done.seconds:.1f} s, epoch {done.best} kept",
        style="dim",
        highlight=False,
    )
    for reason in samples.left_out:
        console.print(f"left out: {reason}", style="yellow", highlight=False)
    unused = [n for n in samples.names if n not in network.features]
    if unused:
        console.print(f"not used, for it did not vary in these flights: {', '.join(unused)}", style="yellow")
    share = memory_share(samples, done)
    if share > MATERIAL_MEMORY:
        late = " or ".join(n for n, e in catalogue().items() if e.stage is Stage.COMMAND)
        console.print(
            f"{100 * share:.0f} % of what is left in z goes with the rate at which thrust changes: lag or delay are "
            f"not as believed, and a network has no memory. Add {late} first; "
            "'groundstation diagnose' tells which",
            style="yellow",
            highlight=False,
        )
    if base.network is not None:
        console.print(f"replaces the network of v{base.version}", style="yellow")


def _print_ablation(result: Ablation) -> None:
    from trueflight.models.terminal import Table

    table = Table(
        title=f"remainder on held-out blocks, RMS in m/s²: {result.before_rms:.4f} without a network, noise floor "
        f"{result.noise_floor:.4f}",
    )
    for column in ("layers", "numbers", "trained", "held out", "kB", "µs", "s", ""):
        table.add_column(column, justify="left" if column in ("layers", "") else "right", no_wrap=True)
    for r in result.networks:
        marks = [w for w, is_it in (("best", r.best), ("embed this", r.smallest)) if is_it]
        table.add_row(
            r.label, str(r.parameters), f"{r.train_rms:.4f}", f"{r.validation_rms:.4f}",
            f"{r.onnx_bytes / 1000:.1f}", f"{1e6 * r.inference:.1f}", f"{r.seconds:.1f}", ", ".join(marks),
            style="bold green" if r.smallest else "",
        )  # fmt: skip
    console.print(table)
    console.print(
        "numbers: trained parameters; kB of the exported file and µs of one inference (ONNX Runtime, one thread) with "
        "the base's effects; s of training; embed this: the smallest within 5 % of the best",
        style="dim",
        highlight=False,
    )
    if not result.features:
        return
    table = Table(
        title=f"what each feature is worth to {result.reference} ({result.reference_rms:.4f} m/s²)",
    )
    for column in ("feature", "shuffled", "trained without"):
        table.add_column(column, justify="left" if column == "feature" else "right")
    for f in result.features:
        table.add_row(
            f.feature, f"{f.shuffled_rms:.4f}", "" if f.without_rms is None else f"{f.without_rms:.4f}"
        )
    console.print(table)
