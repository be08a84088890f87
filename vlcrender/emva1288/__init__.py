"""EMVA 1288 data sheets: photon transfer on simulated frames of a sensor.

Each measured value is shown beside the set value, with its tolerance.
"""
