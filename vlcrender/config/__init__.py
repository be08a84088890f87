"""Checked configuration: TOML files into frozen models, and presets of sensors and accelerometers.

Every refusal names file, key, value and the allowed values.
"""
