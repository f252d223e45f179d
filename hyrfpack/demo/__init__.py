"""The built-in scene, and the round through everything on it."""
