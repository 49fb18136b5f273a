"""Rerun views of what the analyses return: one recording each, with its blueprint."""

from trueflight.groundstation.views.analysis import write_analysis
from trueflight.groundstation.views.comparison import write_comparison
from trueflight.groundstation.views.monitor import viewer
from trueflight.groundstation.views.narrow import write_narrow
from trueflight.groundstation.views.side_by_side import write_side_by_side
from trueflight.groundstation.views.tracking import write_tracking
from trueflight.groundstation.views.training import write_ablation, write_training
from trueflight.groundstation.views.tube import write_tube
from trueflight.groundstation.views.waterfall import write_before_after
from trueflight.groundstation.views.where import write_where

__all__ = [
    "viewer",
    "write_ablation",
    "write_analysis",
    "write_before_after",
    "write_comparison",
    "write_narrow",
    "write_side_by_side",
    "write_tracking",
    "write_training",
    "write_tube",
    "write_where",
]
