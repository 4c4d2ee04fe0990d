"""Stage 3, the camera."""
