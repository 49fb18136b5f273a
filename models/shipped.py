"""What comes with the package."""

from __future__ import annotations

from pathlib import Path

QUAD5 = Path(__file__).parent / "vehicles" / "quad5" / "vehicle.toml"
"""The vehicle that stands where none is named: the 5-inch quadrotor."""
