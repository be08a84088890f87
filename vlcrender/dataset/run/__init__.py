"""Runs that make datasets: frames, workers, resuming, repair."""
