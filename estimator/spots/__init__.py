"""Spots: denoising, detection of LED images with centroids, and their correspondence to LEDs of the map."""
