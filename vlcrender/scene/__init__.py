"""Scenes: TOML into checked geometry in world coordinates.

Room surfaces, textures, panels, LEDs, diffusers, glazing and furniture; and which poses see how many LEDs.
"""
