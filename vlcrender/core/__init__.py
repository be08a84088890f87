"""Foundations: Mitsuba and Dr.Jit, random keys, planar shapes, and quantities with standard errors.

Random numbers are counter-based, so that every draw is reproducible alone and in any order.
"""
