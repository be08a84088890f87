"""Datasets: a recipe into frames, truth and tables on disk, and the check of a finished set.

A set resumes after an interruption and has the same bytes for any order and any number of workers.
"""
