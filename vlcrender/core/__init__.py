"""Foundations without a subject of their own: Mitsuba and Dr.Jit, random keys, planar shapes, quantities with errors.

Counter-based random numbers make every draw reproducible alone and in any order.
"""
