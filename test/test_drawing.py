"""Pictures: what is coloured, what is not, and that colours can be told apart."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from rangeseg_ros.drawing import colours, grey, overlay


def test_colours_can_be_told_apart():
    palette = colours(range(1, 49))
    # CIE L*a*b*: 2.3 is a just noticeable difference.
    lab = cv2.cvtColor(palette[None] / np.float32(255), cv2.COLOR_RGB2LAB)[0]
    distance = np.linalg.norm(lab[:, None] - lab, axis=2)[np.triu_indices(48, 1)]
    assert distance.min() > 5 * 2.3
    assert np.hypot(lab[:, 1], lab[:, 2]).min() > 5 * 2.3  # nor taken for grey
    np.testing.assert_array_equal(colours([5, 9, 49]), palette[[4, 8, 0]])


def test_unlabelled_pixels_stay_grey_and_labelled_ones_have_their_colour():
    inverse = np.full((20, 30), 0.5, np.float32)
    inverse[:, 25:] = 0
    labels = np.zeros((20, 30), np.uint16)
    labels[5:15, 5:15] = 3
    picture = overlay(inverse, labels)
    assert picture.shape == (20, 30, 3)
    assert picture.dtype == np.uint8
    plain = picture[labels == 0]
    assert (plain == plain[:, :1]).all()
    assert not picture[:, 25:].any()
    inner = picture[6:13, 6:13].reshape(-1, 3)
    assert (inner == inner[0]).all()
    assert inner[0].max() > inner[0].min() + 50
    mixed = 0.45 * grey(inverse)[6, 6] + 0.55 * colours([3])[0].astype(float)
    np.testing.assert_allclose(inner[0], mixed, atol=0.51)
    np.testing.assert_array_equal(picture, overlay(inverse, labels))


def test_colours_follow_ids_not_labels():
    inverse = np.full((20, 30), 0.5, np.float32)
    one = np.ones((20, 30), np.uint16)
    plane = SimpleNamespace(label=1, id=9)
    other = SimpleNamespace(label=2, id=9)
    np.testing.assert_array_equal(
        overlay(inverse, one, [plane]), overlay(inverse, 2 * one, [other])
    )
    assert (overlay(inverse, one, [plane]) != overlay(inverse, one)).any()


def test_what_is_near_is_bright_between_the_extremes():
    found = grey(np.linspace(1, 2, 1001)[None].astype(np.float32))[0]
    assert found[0] == found[20] == 60 and found[-1] == found[980] == 235
    assert (np.diff(found.astype(int)) >= 0).all() and found[500] in (147, 148)


@pytest.mark.parametrize('shape', [(1, 1), (1, 7), (424, 3)])
@pytest.mark.parametrize('value', [0.0, 1.0])
def test_any_size_and_no_measurement(shape, value):
    inverse = np.full(shape, value, np.float32)
    assert grey(inverse).shape == shape
    labels = np.ones(shape, np.uint16)
    plane = SimpleNamespace(label=1, id=1)
    assert overlay(inverse, labels, [plane]).shape == (*shape, 3)
