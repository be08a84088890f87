"""Scores as words: rounding, units, what is infinite and what is missing."""

from estimator.score_table import length_text


def test_lengths_for_people() -> None:
    lengths = [None, 0.0, 1.234e-5, 0.0123456, 0.5, 12.345, 4.2e7]
    assert [length_text(length) for length in lengths] == [
        "–",
        "0 µm",
        "12.3 µm",
        "12.3 mm",
        "500 mm",
        "12.3 m",
        "4.2e+07 m",
    ]
