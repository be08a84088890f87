"""Files of the dataset format: frames as the device sees them, estimates, and the sealed truth.

Every row is a checked model; writes are atomic.
"""
