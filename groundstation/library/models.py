"""Model versions of the library: their parameters as numbers, and kept in a store."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trueflight.groundstation.library.shown import Summary, answering, summary_of
from trueflight.models import model as versions


@dataclass(frozen=True, repr=False)
class Model(versions.Model):
    """A model of one vehicle: the hover linearisation, `terms` (effects with fitted values) and a `network`.

    `vehicle` is the one it was made for, `name` and `version` what it is in a store (version 0: not saved), `created`
    when, `fit` the figures of its fit (residual RMS in m/s²). `effects_directory` is the folder of its own effects,
    None where all are trueflight's. Everything in trueflight that takes a `models.model.Model` takes this one.
    """

    @property
    def params(self) -> dict[str, float]:
        """Fitted values by `effect.parameter`, in the units that `effects()` tells."""
        return {f"{t.effect}.{name}": value for t in self.terms for name, value in t.values.items()}

    def conf_int(self) -> dict[str, tuple[float, float]]:
        """95 % intervals (low, high) by `effect.parameter`, of the values that were estimated with one."""
        return {f"{t.effect}.{name}": ends for t in self.terms for name, ends in t.intervals.items()}

    def summary(self) -> Summary:
        """Effects with their values and intervals, and the network, as `groundstation model show` prints them."""
        from trueflight.groundstation.output.tables import print_model

        return summary_of(lambda console: print_model(console, self))

    def save(self, store: str | Path, parent: versions.Model | None = None) -> Model:
        """Write this model to the folder `store` as the next version of its vehicle, made from `parent` (None: from
        none that is in the store).

        Returns the saved version, with its number. Raises `InputError` where it cannot be written.
        """
        from trueflight.groundstation.versions.store import save

        made, _ = save(Path(store), self, parent if parent is not None and parent.version else None)
        return as_model(made)

    def export(
        self,
        output: str | Path,
        to: str,
        *,
        hover_speed: float | None = None,
        torque_length: float | None = None,
    ) -> dict[str, tuple[str, str]]:
        """Write this model to the file `output` for another simulator, autopilot or solver: `to` is mujoco, rotorpy,
        crazyflow, gazebo, px4, px4-sih, casadi or sympy.

        `hover_speed` (rad/s) of the rotors and `torque_length` (m), a rotor's drag torque over its thrust, are a usual
        propeller's where they are not given. Returns of each effect whether the file holds it (whole, roughly, not),
        and where or why not. Raises `InputError` where the vehicle lacks what the file needs, or it cannot be written.
        """
        from trueflight.groundstation.export.target import Known
        from trueflight.groundstation.export.targets import export

        written = export(self, to, Path(output), Known(hover_speed, torque_length))
        return {line.effect: (line.held, line.how) for line in written.lines}

    def __repr__(self) -> str:
        values = ", ".join(f"{name} {value:.4g}" for name, value in self.params.items())
        return f"<Model {self.label} of {self.vehicle.name}{': ' if values else ''}{values}>"

    def _repr_html_(self) -> str:
        return self.summary().html


def as_model(model: versions.Model) -> Model:
    """A model with answers."""
    return model if isinstance(model, Model) else answering(Model, model)
