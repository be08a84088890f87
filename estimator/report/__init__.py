"""Report: one self-contained HTML page of the scores of one or more datasets."""
