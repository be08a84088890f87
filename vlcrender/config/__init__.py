"""Checked configuration: TOML files into frozen models, and presets of sensors and accelerometers.

Error messages name file, key, value and the allowed values.
"""
