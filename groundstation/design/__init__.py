"""Gains of the linear cascade, and the linear behaviour that they promise."""
