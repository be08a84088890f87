"""Sensors: radiometry, quantum efficiency, the EMVA 1288 chain from electrons to digital numbers, accelerometers.

Every parameter is a key of a recipe's [sensor] or [accelerometer] table.
"""
