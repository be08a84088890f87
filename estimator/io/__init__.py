"""Files of the dataset format: frames as a device knows them, estimates, and the sealed truth.

Rows are validated models. Files are written atomically.
"""
