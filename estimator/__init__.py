"""Estimates camera positions from images of ceiling LEDs, and judges estimates, from a dataset on disk."""
