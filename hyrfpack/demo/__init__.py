"""The built-in scene, and the demo that runs all stages on it."""
