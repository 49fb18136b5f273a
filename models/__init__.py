"""What the processes agree on: vehicle, frames, references, flights, effects, models, records, contracts."""
