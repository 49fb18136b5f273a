"""The onboard process: flies the linear cascade, corrected by a deployed model, and records every tick."""

import models  # noqa: F401 - before anything loads ONNX Runtime
