"""Expected images: electrons a second in every pixel, without noise.

Background and one patch of light an LED, with exact edges, lens blur, occlusion and specular reflections; beside them
the path-traced reference and the Cramér-Rao lower bound.
"""
