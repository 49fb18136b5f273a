"""Studies over many simulated flights: calibration of the verdicts, the paper reproduced."""
