"""imr_torch."""
