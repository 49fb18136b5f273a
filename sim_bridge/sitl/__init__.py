"""The simulator of a real PX4: its sensors, its clock, and the motor commands that come back."""
