"""Physically correct images of ceiling LED panels as a tilted camera sees them, with ground truth."""

from importlib.metadata import version

__version__ = version("vlcrender")
