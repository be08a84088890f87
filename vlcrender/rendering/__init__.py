"""Expected images: electrons a second in every pixel, without noise.

A background and one patch of light for each LED, with exact edges, lens blur, occlusion and specular reflections; and
the path-traced reference and the Cramér-Rao bound.
"""
