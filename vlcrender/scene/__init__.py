"""Scenes: TOML files into checked geometry in world coordinates.

Room surfaces, textures, panels, LEDs, diffusers, glazing and furniture; visibility of LEDs from poses.
"""
