"""The workbench: a local page on which a flight is opened, the model held against it, and what is missing added."""
