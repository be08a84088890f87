"""The sensor: radiometry, quantum efficiency and the EMVA 1288 signal chain; and the accelerometer beside it.

Expected electrons in, digital numbers out.
"""
