"""Solvers: from LEDs and their images to distances and poses."""
