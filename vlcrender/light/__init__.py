"""Illumination of the room: the baked lightmap, ray casting, and the room as Mitsuba sees it.

Direct LED light is summed, interreflection is path traced once a scene and kept in the cache.
"""
