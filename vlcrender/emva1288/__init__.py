"""EMVA 1288 data sheets: photon transfer measured on the sensor model's own frames.

Measured values stand beside the configured ones, each with its tolerance.
"""
