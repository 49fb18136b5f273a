"""Rerun views of what the analyses return: one recording each, with its blueprint."""

from groundstation.views.analysis import write_analysis
from groundstation.views.comparison import write_comparison
from groundstation.views.monitor import monitor
from groundstation.views.side_by_side import write_side_by_side
from groundstation.views.tracking import write_tracking
from groundstation.views.training import write_ablation, write_training
from groundstation.views.tube import write_tube
from groundstation.views.waterfall import write_before_after
from groundstation.views.where import write_where

__all__ = [
    "monitor",
    "write_ablation",
    "write_analysis",
    "write_before_after",
    "write_comparison",
    "write_side_by_side",
    "write_tracking",
    "write_training",
    "write_tube",
    "write_where",
]
