"""Pixel model of maximum likelihood: LED images under a pose, lens blur, pixel readings, and their likelihood."""
