"""Photographs: pictures that a camera took, an LED map and a calibration, to positions."""
