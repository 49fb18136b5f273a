"""The control law and what guards it: no clock, no wire, no file but a model's. The simulator may import this alone."""
