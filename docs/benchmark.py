"""Measure this package beside other programs: python docs/benchmark.py FOLDER...

Prints the rows of the table in docs/benchmark.md. FOLDER holds depth images with their truth, in a
layout that `rangeseg evaluate` reads. Programs that are not installed are left out:

    pip install open3d-cpu

OpenCV has findPlanes from 5 on. Every program gets the depth in metres and the camera, and
returns labels: the time is of all between, on the threads that the program takes by itself, and
the processor time that of all threads together.
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

from rangeseg_ros import RangeImage, segment
from rangeseg_ros.evaluation.datasets import find_cases
from rangeseg_ros.evaluation.figures import COUNTS
from rangeseg_ros.evaluation.hoover import classify
from rangeseg_ros.evaluation.overlap import overlap_figures

try:
    import open3d
except ImportError:
    open3d = None

LEAST = 1000  # pixels of a plane, for every program


def planes(depth, camera):
    """This package."""
    return segment(depth, camera).labels


def normals(depth, camera):
    """The method of the thesis."""
    return segment(depth, camera, method='normals').labels


def ransac(depth, camera, distance=0.02, trials=300, seed=0):
    """Sequential RANSAC: the plane with most inliers among `trials`, refitted, removed, and again.

    M. A. Fischler, R. C. Bolles, "Random sample consensus", Comm. ACM 24 (6), 1981. `distance` in
    metres. Planes with fewer than `LEAST` inliers end the search.
    """
    points = RangeImage.from_depth(depth, camera).points
    left = np.flatnonzero(np.isfinite(points[..., 2]) & (depth > 0))
    points = points.reshape(-1, 3)
    labels, generator = np.zeros(depth.size, np.uint16), np.random.default_rng(seed)
    while len(left) >= LEAST:
        triples = points[generator.choice(left, (trials, 3))]
        normal = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
        offset = np.einsum('ij,ij->i', normal, triples[:, 0])
        sample = points[generator.choice(left, 2000)]
        best = (np.abs(sample @ normal.T - offset) < distance).sum(axis=0).argmax()
        inliers = np.abs(points[left] @ normal[best] - offset[best]) < distance
        centre = points[left[inliers]].mean(axis=0)
        direction = np.linalg.svd(np.cov((points[left[inliers]] - centre).T))[0][:, 2]
        inliers = np.abs((points[left] - centre) @ direction) < distance
        if inliers.sum() < LEAST:
            break
        labels[left[inliers]] = labels.max() + 1
        left = left[~inliers]
    return labels.reshape(depth.shape)


def opencv(depth, camera):
    """OpenCV 5: normals by FALS, and findPlanes with the settings tuned on other rooms."""
    height, width = depth.shape
    matrix = np.array(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32
    )
    filled = np.where(depth > 0, depth, np.nan).astype(np.float32)
    points = cv2.depthTo3d(filled, matrix)
    method = cv2.RgbdNormals_RGBD_NORMALS_METHOD_FALS
    estimator = cv2.RgbdNormals_create(height, width, cv2.CV_32F, matrix, 5, 50, method)
    directions = estimator.apply(points)
    labels, _ = cv2.findPlanes(points, directions, None, None, 10, LEAST, 0.014, 0.002)
    return np.where(labels == 255, 0, labels.astype(np.uint16) + 1).astype(np.uint16)


def open3d_patches(depth, camera):
    """Open3D's detect_planar_patches on every second pixel, with its defaults.

    Each pixel gets the nearest plane of those whose box it lies in.
    """
    image = RangeImage.from_depth(depth, camera)
    points, seen = image.points[::2, ::2], image.valid[::2, ::2]
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[seen]))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    nearest = np.full(len(cloud.points), np.inf)
    found = np.zeros(len(cloud.points), np.uint16)
    for number, box in enumerate(cloud.detect_planar_patches(), 1):
        inside = np.array(box.get_point_indices_within_bounding_box(cloud.points), np.intp)
        away = np.abs((np.asarray(cloud.points)[inside] - box.center) @ box.R[:, 2])
        closer = away < nearest[inside]
        nearest[inside[closer]], found[inside[closer]] = away[closer], number
    labels = np.zeros(seen.shape, np.uint16)
    labels[seen] = found
    labels = labels.repeat(2, 0).repeat(2, 1)[: depth.shape[0], : depth.shape[1]]
    return labels * image.valid


def programs():
    """Name and function of each program that is installed."""
    table = {'rangeseg_ros, `planes`': planes, 'rangeseg_ros, `normals`': normals}
    if hasattr(cv2, 'findPlanes'):
        table['OpenCV findPlanes, tuned'] = opencv
    if open3d:
        table['Open3D planar patches'] = open3d_patches
    return table | {'sequential RANSAC, 20 mm': ransac}


def measure(function, samples):
    """Mean IoU, planes correct at 0.8, planes, and median times of a frame, milliseconds."""
    overlaps, times = [], []
    for sample in samples:
        image, camera = sample.image, sample.image.camera
        depth = np.where(image.valid, image.points[..., 2], 0)
        if not overlaps:  # the first call may compile, or load libraries
            function(depth, camera)
        begin = time.perf_counter(), time.process_time()
        labels = function(depth, camera)
        times.append((time.perf_counter() - begin[0], time.process_time() - begin[1]))
        overlaps.append(sample.truth.compare(labels))
    counts = [classify(overlap, 0.8).counts() for overlap in overlaps]
    regions, correct = (sum(count[key] for count in counts) for key in COUNTS[:2])
    milliseconds = 1000 * np.median(times, axis=0)
    return overlap_figures(overlaps)['mean_iou'], correct, regions, *milliseconds


def main():
    """Print a row for each program and folder."""
    for folder in map(Path, sys.argv[1:]):
        samples = [case.load() for case in find_cases(folder)]
        samples = [sample for sample in samples if sample.image.camera]  # no scans
        head = 'mean IoU | correct at 0.8 | ms | processor ms'
        print(f'\n| {folder.name}, {len(samples)} frames | {head} |')
        print('|---|---|---|---|---|')
        for name, function in programs().items():
            iou, correct, regions, wall, processor = measure(function, samples)
            row = f'{iou:.3f} | {correct} of {regions} | {wall:.0f} | {processor:.0f}'
            print(f'| {name} | {row} |', flush=True)


if __name__ == '__main__':
    main()
