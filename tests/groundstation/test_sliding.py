"""Moving mean and maximum are scipy's."""

import numpy as np
import pytest
from scipy import ndimage

from trueflight.groundstation.reading.sliding import moving_maximum, moving_mean


@pytest.mark.parametrize("rows", [5, 100, 1001])
@pytest.mark.parametrize("width", [1, 2, 3, 10, 31])
def test_they_are_what_scipy_computes(rows: int, width: int) -> None:
    column = np.random.default_rng(rows).normal(10.0, 1.0, (rows, 2))
    np.testing.assert_allclose(moving_mean(column, width), ndimage.uniform_filter1d(column, width, axis=0))
    np.testing.assert_allclose(
        moving_mean(column[:, 0], width), ndimage.uniform_filter1d(column[:, 0], width)
    )
    greatest = moving_maximum(column[:, 0], width)
    if width <= rows:
        np.testing.assert_array_equal(greatest, ndimage.maximum_filter1d(column[:, 0], width))
    assert len(greatest) == rows
