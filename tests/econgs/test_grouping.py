"""Chamfer distances against a plain loop, and clusters against what SciPy's documentation promises."""

import numpy as np
import pytest

from econgs_bench.econgs.grouping import chamfer_distances, cluster


def plain_chamfer(a, b):
    squared = ((a[:, None] - b[None]) ** 2).sum(-1)
    return 0.5 * (squared.min(1).mean() + squared.min(0).mean())


def clouds(seed=0):
    generator = np.random.default_rng(seed)
    return [generator.normal(place, 0.1, (n, 3)) for place, n in ((0.0, 40), (0.05, 60), (2.0, 30))]


def test_distances_agree_with_a_plain_loop():
    points = clouds()
    distances = chamfer_distances(points)
    for i in range(3):
        for j in range(3):
            expected = 0.0 if i == j else plain_chamfer(points[i], points[j])
            assert distances[i, j] == pytest.approx(expected, rel=1e-12)


def test_the_sum_of_directions_is_twice_their_mean():
    points = clouds()
    twice = chamfer_distances(points, direction="sum")
    np.testing.assert_allclose(twice, 2.0 * chamfer_distances(points))


def test_a_sample_is_near_the_whole_and_repeatable():
    generator = np.random.default_rng(1)
    points = [generator.uniform(0.0, 1.0, (5000, 3)), generator.uniform(0.2, 1.2, (5000, 3))]
    whole = chamfer_distances(points, sample=10**6)[0, 1]
    some = chamfer_distances(points)
    assert some[0, 1] == pytest.approx(whole, rel=0.05)
    np.testing.assert_array_equal(some, chamfer_distances(points))
    # In any order of the points: they are spread over space, not over the list.
    mixed = [generator.permutation(cloud) for cloud in points]
    np.testing.assert_allclose(chamfer_distances(mixed), some, rtol=0.02)


def test_an_empty_cloud_is_refused():
    with pytest.raises(ValueError, match="empty"):
        chamfer_distances([np.zeros((0, 3)), np.ones((2, 3))])


def test_near_scenes_share_a_group():
    distances = chamfer_distances(clouds())
    assert cluster(distances, 0.1) == [[0, 1], [2]]
    assert cluster(distances, 0.0) == [[0], [1], [2]]
    assert cluster(distances, 100.0) == [[0, 1, 2]]
    assert cluster(distances[:1, :1], 1.0) == [[0]]


def test_linkages_differ_as_they_should():
    chain = np.abs(np.subtract.outer(np.arange(4.0), np.arange(4.0)))
    assert cluster(chain, 1.0, "single") == [[0, 1, 2, 3]]
    assert len(cluster(chain, 1.0, "complete")) == 2


@pytest.mark.data
def test_groups_of_the_authors_vortex_clouds(data_folder):
    """Average linkage at 0.01 joins three of the four scenes, as the paper's training times imply."""
    from econgs_bench.datasets.cloud import read_ply

    points = [
        read_ply(data_folder / f"vortex_views/TF0{i}/points3d.ply").points.astype(float) for i in range(1, 5)
    ]
    distances = chamfer_distances(points)
    assert cluster(distances, 0.01) == [[0, 2, 3], [1]]
    assert cluster(distances, 0.02) == [[0, 1, 2, 3]]
    assert cluster(distances, 0.005, "average") == [[0, 3], [1], [2]]
