"""The onboard process: flies the linear cascade, corrected by a deployed model, and records every tick."""
