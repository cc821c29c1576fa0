"""The colours of the wheel: primaries, axes, saturation."""

from __future__ import annotations

import numpy as np

from cflow_torch.viz import flow_to_rgb, wheel_image


def test_axes_of_the_ego_frame() -> None:
    # By hand: steps 0, 13.5, 27, 40.5 of 54. 13.5 / 15 of green is 229.5, a tie, hence one level either way.
    expected = [(255, 0, 0), (255, 229.5, 0), (0, 255 - 255 * 2 / 11, 255), (255 * 4.5 / 13, 0, 255)]
    rgb = flow_to_rgb(np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]))
    assert np.abs(rgb - np.array(expected)).max() <= 0.5 + 1e-9


def test_saturation_follows_length() -> None:
    red = flow_to_rgb(np.array([[0.0, 0], [0.25, 0], [0.5, 0], [1, 0], [2, 0]]), max_flow=1.0)
    assert red.tolist() == [[255, 255, 255], [255, 191, 191], [255, 128, 128], [255, 0, 0], [128, 0, 0]]
    assert (flow_to_rgb(np.array([[np.nan, 0.0], [np.inf, 1.0]])) == 255).all()


def test_wheel_image_has_the_axes_of_the_picture() -> None:
    image = wheel_image(101)
    red, yellow = image[50, -2, :3].astype(int), image[1, 50, :3].astype(int)
    assert red[0] == 255 and red[1:].max() < 15
    assert yellow[:2].min() > 220 and yellow[2] < 15
    assert (image[50, 50, :3] > 250).all()
    assert image[0, 0, 3] == 0 and image[50, 50, 3] == 255
