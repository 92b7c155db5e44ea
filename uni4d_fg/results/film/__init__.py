"""Films and stills of a run, rendered on the CPU."""
