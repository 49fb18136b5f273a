"""The commands of `sim-bridge`: they parse and print. What they do stands in the modules that they call."""
