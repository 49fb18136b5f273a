"""The measured side of a comparison: acceleration as the flight shows it, and its bins."""
