"""Settings of the documentation."""
