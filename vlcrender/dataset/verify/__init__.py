"""Verification of a dataset on disk."""
