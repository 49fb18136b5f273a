"""The simulator's own truth: rotors, battery, air and sensors, written independently of the models that fit
it.
"""
