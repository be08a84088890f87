"""Illumination of the room: the baked lightmap and its cache, ray casting, and the room as a Mitsuba scene.

Direct light of LEDs is a sum; reflected light and daylight are path traced once per scene and kept in the cache.
"""
