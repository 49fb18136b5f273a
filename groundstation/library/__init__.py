"""trueflight as a library: what `import trueflight as tf` offers, over the same rooms as the commands.

Results are the result objects of those rooms, given answers (`summary`, `plot`, `conf_int`, ...): subclasses without
data of their own, so that whatever takes a `Diagnosis` or a `Flight` takes these. They stand here, above the rooms that
compute, and not in them: a result that could print and draw itself would import what prints and draws it.
"""

from trueflight.groundstation.library.answers import (
    Comparison,
    Diagnosis,
    SideBySide,
    Tracking,
    Tube,
    WhereItFails,
)
from trueflight.groundstation.library.flights import Flight, read, read_all
from trueflight.groundstation.library.making import (
    Training,
    add,
    design,
    effects,
    export,
    reveal,
    simulate,
    simulate_many,
    train,
)
from trueflight.groundstation.library.models import Model
from trueflight.groundstation.library.questions import (
    bound,
    compare,
    diagnose,
    report,
    side_by_side,
    track,
    where,
)
from trueflight.groundstation.library.shown import Summary
from trueflight.models.design import Design
from trueflight.models.effect import Effect
from trueflight.models.errors import InputError
from trueflight.models.vehicle import Vehicle

__all__ = [
    "Comparison",
    "Design",
    "Diagnosis",
    "Effect",
    "Flight",
    "InputError",
    "Model",
    "SideBySide",
    "Summary",
    "Tracking",
    "Training",
    "Tube",
    "Vehicle",
    "WhereItFails",
    "add",
    "bound",
    "compare",
    "design",
    "diagnose",
    "effects",
    "export",
    "read",
    "read_all",
    "report",
    "reveal",
    "side_by_side",
    "simulate",
    "simulate_many",
    "track",
    "train",
    "where",
]
