"""Datasets: recipes, generation of frames, tables and truth on disk, and verification of a finished dataset.

Generation resumes after an interruption; the bytes are the same for any order and any number of workers.
"""
