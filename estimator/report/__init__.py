"""The report: one self-contained HTML page about the scores of one or more datasets."""
