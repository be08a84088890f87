"""LED images: denoising, detection with centroids, and their correspondence to LEDs of the map."""
