"""A simulated vehicle that behaves as a PX4 would, with a truth of its own in which an effect can be
hidden.
"""
