"""Algorithm 1 is a mean of neighbours, and nothing else."""

import numpy as np

from estimator.denoise import neighbourhood_mean


def test_each_pixel_becomes_the_mean_of_its_120_neighbours() -> None:
    image = np.random.default_rng(1).poisson(300, (23, 31)).astype(np.float32)
    result = neighbourhood_mean(image)
    for row, column in [(5, 5), (11, 15), (17, 25), (6, 20)]:
        square = image[row - 5 : row + 6, column - 5 : column + 6].astype(np.float64)
        neighbours = np.delete(square.ravel(), 60)
        assert len(neighbours) == 120
        # float32 keeps 24 bits: 6e-8 of the value at each of a few steps.
        np.testing.assert_allclose(result[row, column], neighbours.mean(), rtol=3e-7)


def test_it_is_c_minus_the_mean_difference() -> None:
    """The paper's wording: mu_S is the mean of c - c_k (Eq. 14), and the adjusted intensity is c - mu_S."""
    image = np.random.default_rng(2).poisson(50, (11, 11)).astype(np.float32)
    differences = image[5, 5] - np.delete(image.ravel(), 60)
    np.testing.assert_allclose(neighbourhood_mean(image)[5, 5], image[5, 5] - differences.mean(), rtol=3e-7)


def test_at_the_border_the_mean_is_over_the_neighbours_there_are() -> None:
    image = np.random.default_rng(3).poisson(50, (14, 17)).astype(np.float32)
    result = neighbourhood_mean(image)
    corner = np.delete(image[:6, :6].ravel(), 0)
    np.testing.assert_allclose(result[0, 0], corner.mean(), rtol=3e-7)
    side = np.delete(image[3:14, 11:].ravel(), 5 * 6 + 5)
    np.testing.assert_allclose(result[8, 16], side.mean(), rtol=3e-7)


def test_a_flat_image_stays_flat_and_the_input_stays_as_it_was() -> None:
    image = np.full((20, 30), 7.0, np.float32)
    np.testing.assert_allclose(neighbourhood_mean(image), 7.0, rtol=1e-7)
    assert (image == 7).all()


def test_shot_noise_shrinks_to_1_in_120() -> None:
    image = np.random.default_rng(4).poisson(100, (400, 400)).astype(np.float32)
    inner = neighbourhood_mean(image)[5:-5:12, 5:-5:12]
    # 33 x 33 windows that do not overlap: independent means with variance 100 / 120. The sample variance of n normal
    # values has a relative standard error of sqrt(2 / (n - 1)).
    n = inner.size
    assert abs(inner.var(ddof=1) / (100 / 120) - 1) < 5 * np.sqrt(2 / (n - 1))
