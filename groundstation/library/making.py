"""What the library makes: models with one effect more, networks, gains, ONNX files, and flights in the simulator."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from trueflight.groundstation.library.flights import Flight, read
from trueflight.groundstation.library.models import Model, as_model
from trueflight.groundstation.library.questions import Which
from trueflight.groundstation.library.shown import Summary
from trueflight.groundstation.versions.choice import check_vehicle, choose_model
from trueflight.groundstation.versions.several import add_effect_to
from trueflight.groundstation.versions.store import DEFAULT_STORE
from trueflight.models import flight as columns
from trueflight.models import model as versions
from trueflight.models.design import Design, save_design
from trueflight.models.effect import Effect
from trueflight.models.effects import catalogue
from trueflight.models.errors import InputError
from trueflight.models.shipped import QUAD5
from trueflight.models.vehicle import Vehicle, load_vehicle

if TYPE_CHECKING:
    from trueflight.groundstation.learn.training import Epoch


@dataclass(frozen=True, repr=False)
class Training:
    """A network that was trained on what a model leaves unexplained: `model` is that model together with the network,
    `history` has every epoch (RMS per axis in m/s²), `before` and `after` are the RMS (m/s²) of what is unexplained
    on the blocks held out.

    `seconds` is the flight time that it was trained and checked on; `noise_floor` (m/s²) what sensor noise leaves.
    """

    model: Model
    history: tuple[Epoch, ...]
    before: float
    after: float
    noise_floor: float
    seconds: float

    def summary(self) -> Summary:
        """The model with the network, as `groundstation model show` prints it."""
        return self.model.summary()

    def __repr__(self) -> str:
        return (
            f"<Training over {len(self.history)} epochs, {self.seconds:.0f} s of flight: remainder "
            f"{self.before:.3f} -> {self.after:.3f} m/s², noise floor {self.noise_floor:.3f} m/s²>"
        )

    def _repr_html_(self) -> str:
        return self.summary().html


def effects(directory: str | Path | None = None) -> dict[str, Effect]:
    """The catalogue of effects by name: parameters in SI units, what excites each, its confounders, its source.

    `directory` is a folder of your own effects, one file each, beside those of trueflight. Raises `InputError` for a
    file there that is no effect.
    """
    return dict(catalogue(None if directory is None else str(directory)))


def add(
    flight: columns.Flight | Sequence[columns.Flight],
    effect: str,
    *,
    model: Which = None,
    bandwidth: float | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Model:
    """A model with one `effect` more, every parameter fitted anew to the `flight` (or several); not saved.

    Of several flights, in the order of time, it has what is the vehicle's; what is each flight's own is left out.

    `model`, `bandwidth` (Hz), `store` and `effects` as for `compare`. `Model.save` writes it as a version. Parameters
    have the units that `effects()` tells. A network of the model is dropped: it was trained without this effect.

    Raises `InputError` for an effect that is there already, acts only through one that is not, or needs columns that a
    flight lacks.
    """
    flights = [flight] if isinstance(flight, columns.Flight) else list(flight)
    base = choose_model(_first(flights), model, store, effects)
    return as_model(add_effect_to(base, effect, flights, bandwidth).model)


def train(
    flights: Sequence[columns.Flight],
    *,
    model: Which = None,
    layers: Sequence[int] = (64, 64),
    recipe: str = "default",
    epochs: int | None = None,
    seed: int = 0,
    bandwidth: float | None = None,
    store: str | Path = DEFAULT_STORE,
    effects: str | Path | None = None,
) -> Training:
    """Train a network on what a model does not explain of `flights`: on two thirds of them, cut into blocks; not
    saved.

    `model`, `bandwidth` (Hz), `store` and `effects` as for `compare`. `layers` are the widths of the hidden layers,
    `recipe` is "default" or "paper" (Carvalho et al. 2022, section V), `epochs` the most that it may take (None: the
    recipe's), `seed` draws the split, the first weights and the batches.

    Raises `InputError` where flights lack columns or are too short, and for impossible layers.
    """
    from trueflight.groundstation.learn.training import recipe_named, train, with_epochs
    from trueflight.groundstation.learn.training_data import samples_of_flights

    base = choose_model(_first(flights), model, store, effects)
    for flight in flights:
        check_vehicle(base, flight)
    samples = samples_of_flights(flights, base, bandwidth)
    done = train(samples, with_epochs(recipe_named(recipe), epochs), layers, seed)
    fit = done.network.fit
    return Training(
        as_model(base.with_network(done.network)),
        done.history,
        fit["before_rms"],
        fit["validation_rms"],
        fit["noise_floor"],
        samples.seconds,
    )


def export(
    flights: columns.Flight | Sequence[columns.Flight], output: str | Path, *, model: versions.Model
) -> Path:
    """Write a `model` to `output` as one ONNX file with its contract, ready to deploy; as C where it ends with `.h`.

    From the `flights` come the range in which it may be trusted, the examples that the companion checks it by, and
    the delay and lag (s) of the rate loop. Returns the path. Raises `InputError` for a flight of another vehicle, and
    where the file cannot be written.
    """
    from trueflight.groundstation.export import correction_c
    from trueflight.groundstation.identify.actuation import actuation_of
    from trueflight.models.export import export_onnx
    from trueflight.models.whole_file import write_whole

    flown = [flights] if isinstance(flights, columns.Flight) else list(flights)
    for flight in flown:
        check_vehicle(model, flight)
    _first(flown)
    data = export_onnx(model, *flown, actuation=actuation_of(model, flown))
    if Path(output).suffix == correction_c.ENDING:
        data = correction_c.write(model, correction_c.deployed(data)).text.encode()
    write_whole(Path(output), data, "the model", "choose another output")
    return Path(output)


def design(
    vehicle: Vehicle | str | Path,
    *,
    bandwidth: float | None = None,
    attitude_bandwidth: float | None = None,
    rate: float = 100.0,
) -> Design:
    """Gains of the linear cascade for a `vehicle` (or its file), by LQR, with and without integral.

    `bandwidth` is that of the position loop and `attitude_bandwidth` that of the attitude loop, Hz (None: the usual);
    `rate` that of the controller, Hz. The gains are those of Carvalho et al. 2022, equations (13) and (16).

    Raises `InputError` where delay and lag of the vehicle, or how close both loops are, forbid it.
    """
    from trueflight.groundstation.design.integral_design import with_integral
    from trueflight.groundstation.design.linear_design import (
        ATTITUDE_BANDWIDTH,
        POSITION_BANDWIDTH,
        make_design,
    )

    believed = vehicle if isinstance(vehicle, Vehicle) else load_vehicle(vehicle)
    made = make_design(
        believed, bandwidth or POSITION_BANDWIDTH, attitude_bandwidth or ATTITUDE_BANDWIDTH, rate
    )
    return with_integral(made, believed)


def simulate(
    output: str | Path,
    *,
    trajectory: str = "excitation",
    parameters: Mapping[str, float] | None = None,
    vehicle: str | Path = QUAD5,
    hidden: str | Sequence[str] = (),
    correction: str | Path | None = None,
    controller: str = "",
    design: Design | str | Path | None = None,
    noise: float = 1.0,
    seed: int = 0,
) -> Flight:
    """Fly in the simulator, by the companion's own control law, and read the record that it writes to `output` (.mcap).

    `trajectory` with its `parameters` (SI units) is one of `groundstation trajectories`, or a CSV file of setpoints.
    `vehicle` is the vehicle.toml of what its owner believes, `hidden` what the simulated vehicle has in addition:
    NAME, NAME:SIZE, "random" (drawn by `seed`; `reveal` tells), "rich". `correction` is an ONNX file, `controller`
    lqr, lqr_integral or corrected (by default corrected where there is a correction), `design` the gains, or their
    file (None: that beside the vehicle). `noise` is a factor on the noise of the sensors (0: none).

    It runs `sim-bridge`, the program, and so needs it installed. Raises `InputError` for whatever that refuses.
    """
    from trueflight.groundstation.operate.processes import run_json

    if isinstance(design, Design):
        gains = Path(output).with_suffix(".design.json")
        save_design(design, gains)
        design = gains
    words: list[object] = ["sim-bridge", "fly", "--trajectory", trajectory, "-o", output, "--json"]
    words += ["--vehicle", vehicle, "--seed", seed, "--noise", noise]
    for name, value in (parameters or {}).items():
        words += ["--set", f"{name}={value:g}"]
    for name in [hidden] if isinstance(hidden, str) else hidden:
        words += ["--hidden", name]
    for option, given in (("--model", correction), ("--controller", controller), ("--design", design)):
        if given:
            words += [option, given]
    run_json(words)
    return read(output)


def simulate_many(
    folder: str | Path,
    flights: Sequence[Mapping[str, object]],
    *,
    vehicle: str | Path = QUAD5,
    jobs: int = 0,
) -> Iterator[Flight]:
    """Fly many flights in the simulator at once, each into `folder`/NAME.mcap; reads them one by one, in order.

    Each of `flights` names the options of its flight, as columns of `sim-bridge fly-many --flights` do: `trajectory`,
    `hidden`, `seed`, `noise`, `controller`, `name` and so on, several texts as a sequence ("excitation" where there is
    no `trajectory`). `vehicle` is the vehicle.toml of those that name none; `jobs` processes fly, one for each core
    with 0. All are flown before the first is read. Numbers of the table are in SI units, as options of `sim-bridge
    fly` are.

    It runs `sim-bridge`, the program. Raises `InputError` for whatever that refuses.
    """
    from trueflight.groundstation.operate.processes import run_json

    columns = list(dict.fromkeys(name for one in flights for name in one))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for one in flights:
        writer.writerow([_cell(name, one.get(name, "")) for name in columns])
    with tempfile.TemporaryDirectory() as place:
        table = Path(place) / "flights.csv"
        table.write_text(out.getvalue(), encoding="utf-8")
        words: list[object] = [
            "sim-bridge",
            "fly-many",
            "--flights",
            table,
            "--vehicle",
            Path(vehicle).resolve(),
        ]
        words += ["--trajectory", "excitation", "-o", folder, "--jobs", jobs, "--json"]
        told = run_json(words)["flights"]
    return (read(one["record"]) for one in told)


def _cell(name: str, value: object) -> str:
    """As a table has it; a file's name is relative to where this program runs, not to the table."""
    if value and (name in ("vehicle", "design", "model") or str(value).endswith(".csv")):
        return str(Path(str(value)).resolve())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ";".join(map(str, value))
    return str(value)


def reveal(flight: columns.Flight) -> dict[str, dict[str, float]]:
    """What was hidden at random in a simulated `flight`: for each effect its values by parameter, in SI units.

    Raises `InputError` where there is no sealed answer beside its record.
    """
    from trueflight.groundstation.operate.processes import run_json

    told = run_json(["sim-bridge", "reveal", Path(flight.origin).with_suffix(".sealed"), "--json"])
    return {
        h["name"]: {name: float(p["value"]) for name, p in h["parameters"].items()} for h in told["effects"]
    }


def _first(flights: Sequence[columns.Flight]) -> columns.Flight:
    if not flights:
        raise InputError("no flight given; pass at least one")
    return flights[0]
