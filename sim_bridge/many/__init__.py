"""Many simulated vehicles at once, as arrays: the same flights as one by one, within float error."""
