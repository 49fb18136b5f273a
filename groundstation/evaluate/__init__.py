"""How well a model or a controller does: errors, where they are, tracking, the tube."""
