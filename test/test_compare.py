"""`rangeseg compare`: figures of known label images, pairing of folders, and refusals."""

from functools import partial

import cv2
import numpy as np
import pytest
from dataset_files import raster


@pytest.fixture
def compare(figures_of):
    """Run `rangeseg compare`; exit code, figures (or None), standard output and error."""
    return partial(figures_of, 'compare')


def write(path, labels):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.array(labels, np.uint16)
    if path.suffix == '.png':
        assert cv2.imwrite(str(path), image)
    else:
        path.write_bytes(raster(image.astype(np.uint8)))
    return path


def test_two_png_files(tmp_path, compare):
    # Truth 1: 4 pixels, all in found 5 (5 pixels): (1, 0.8). Truth 2: 3 pixels, 2 in found 6.
    truth = write(tmp_path / 'truth.png', [[1, 1, 1, 1, 2, 2, 2, 0]])
    labels = write(tmp_path / 'labels.png', [[5, 5, 5, 5, 5, 6, 6, 0]])
    code, figures, *_ = compare(truth, labels, '--tolerance', '0.8', '0.9')
    assert code == 0
    names = 'regions', 'correct', 'over', 'under', 'missed', 'noise', 'mean_iou', 'pixel_accuracy'
    shares = pytest.approx((4 / 5 + 2 / 3) / 2), pytest.approx(6 / 7)
    assert figures['tolerances'] == {
        '0.8': dict(zip(names, (2, 1, 0, 0, 1, 1, *shares), strict=True)),
        '0.9': dict(zip(names, (2, 0, 0, 0, 2, 2, *shares), strict=True)),
    }


def test_rasters_count_regions_from_ten(tmp_path, compare):
    # 0-3 are no regions on either side, so nothing is noise.
    truth = write(tmp_path / 'abw.test.1.gt-seg', [[10, 10, 2, 3], [11, 11, 0, 1]])
    labels = write(tmp_path / 'abw.test.1.ms-seg', [[12, 12, 3, 2], [10, 10, 1, 0]])
    code, figures, *_ = compare(truth, labels)
    assert code == 0
    assert list(figures['tolerances']) == ['0.51', '0.6', '0.7', '0.8', '0.9', '0.95']
    row = figures['tolerances']['0.95']
    assert (row['regions'], row['correct'], row['noise']) == (2, 2, 0)


def test_folders_are_paired_by_name_and_summed(tmp_path, compare):
    write(tmp_path / 'gt/2_truth.png', [[1, 1, 0]])
    write(tmp_path / 'gt/10_truth.png', [[1, 2, 0]])
    write(tmp_path / 'ms/2_depth_labels.png', [[1, 1, 0]])
    write(tmp_path / 'ms/10_depth_labels.png', [[0, 2, 3]])
    write(tmp_path / 'ms/10_depth_overlay.png', [[9, 9, 9]])
    code, figures, *_ = compare(tmp_path / 'gt', tmp_path / 'ms', '--tolerance', '0.8')
    assert code == 0
    assert figures['images'] == 2
    row = figures['tolerances']['0.8']
    assert (row['regions'], row['correct'], row['missed'], row['noise']) == (3, 2, 1, 1)
    # Over all three regions and four pixels, not the mean of two images.
    assert row['mean_iou'] == pytest.approx(2 / 3)
    assert row['pixel_accuracy'] == pytest.approx(3 / 4)
    assert list(figures['per_image']) == ['2', '10']
    assert figures['per_image']['10']['tolerances']['0.8']['missed'] == 1


NONE = 65535
# Found 7 has four pixels, of which one is not judged and one judged curved: 2 / 3. Without 65535
# in the truth every pixel counts: 2 / 4.
CURVED, FLAT, WIDE = [1, 1, 0, NONE, NONE], [1, 1, 0, 0, 0], [7, 7, 7, 7, 0]
# Found 8 has 2 of its 6 pixels on truth 1, the rest is not judged; 7 has the other 8.
RIM, PARTS = [1] * 10 + [0] * 4 + [NONE], [7] * 8 + [8] * 6 + [0]
# Half of its 4 judged: it counts, whatever its size.
HALF = [7] * 8 + [8] * 4 + [0] * 3


@pytest.mark.parametrize(
    ('truth', 'labels', 'least', 'expected'),
    [
        (CURVED, WIDE, 1, {'regions': 1, 'noise': 1, 'mean_iou': pytest.approx(2 / 3)}),
        (FLAT, WIDE, 1, {'mean_iou': 1 / 2}),
        (RIM, PARTS, 1, {'correct': 0, 'over': 1, 'noise': 0}),
        (RIM, PARTS, 3, {'correct': 1, 'over': 0, 'noise': 0}),
        (RIM, HALF, 3, {'over': 1}),
        ([1, 1, 1, 2], [1, 1, 1, 0], 1, {'missed': 1}),
        ([1, 1, 1, 2], [1, 1, 1, 0], 2, {'regions': 1, 'missed': 0}),
        ([0, 0], [0, 0], 1, {'mean_iou': None}),
    ],
)
def test_what_is_not_judged_or_too_small_does_not_count(
    tmp_path, compare, truth, labels, least, expected
):
    truth, labels = (write(tmp_path / f'{k}.png', [row]) for k, row in enumerate((truth, labels)))
    row = compare(truth, labels, '--min-pixels', least)[1]['tolerances']['0.8']
    assert {name: row[name] for name in expected} == expected


def refuse(result, *parts):
    code, figures, _, err = result
    assert code == 2 and figures is None
    assert err.count('\n') == 1
    for part in parts:
        assert str(part) in err


def test_refusals(tmp_path, compare):
    one, wide = write(tmp_path / 'gt/1.png', [[1]]), write(tmp_path / 'wide.png', [[1, 1]])
    for tolerance in ('0.5', '1.2', '80', 'nan'):
        refuse(compare(one, one, '--tolerance', tolerance), 'tolerance', 'above 0.5')
    refuse(compare(wide, one), one, 'differ in size')
    refuse(compare(one, one.parent), 'two files or two folders')
    write(tmp_path / 'ms/1.png', [[1]])
    extra = write(tmp_path / 'ms/2.png', [[1]])
    refuse(compare(one.parent, extra.parent), extra, 'no ground truth')
    refuse(compare(extra.parent, one.parent), extra, 'no segmentation')
