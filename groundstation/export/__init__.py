"""A model as the files of other simulators, autopilots and solvers. One module each."""
