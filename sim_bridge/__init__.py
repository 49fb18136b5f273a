"""Stands in for the vehicle: MuJoCo physics with a truth of its own, speaking MAVLink as a PX4 would."""
