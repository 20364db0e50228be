"""One step a file; steps meet only in tables."""
