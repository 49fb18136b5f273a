"""The simulated vehicle on MAVLink, as PX4 speaks it."""
