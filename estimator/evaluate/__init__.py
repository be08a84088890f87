"""Evaluation: variants run over a dataset, scored by the sealed truth, and compared with each other."""
