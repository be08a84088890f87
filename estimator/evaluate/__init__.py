"""Evaluation: variants run over a dataset, scored against the sealed truth, and compared with each other."""
