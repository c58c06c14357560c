"""Questions that runs which exist can answer; each module is an entry point, and its answer in `results/`."""
