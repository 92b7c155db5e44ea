"""Flat observations of labelled tracks, and the weights of the paper's normalizations."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stage_samples import camera_path, hide, join, observe, static_points

from uni4d_fg.config.solver import KernelConfig
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.slam.stages.energy import Normalization, PaperEnergy
from uni4d_fg.slam.stages.observations import Observations, observations_of, weigh_by_drift


@pytest.fixture
def labelled(rng: np.random.Generator) -> LabelledTracks:
    poses = camera_path(5)
    static = hide(observe(static_points(rng, 6), poses), rng.random((6, 5)) < 0.3)
    moving = observe(static_points(rng, 3), poses, TrackLabel.DYNAMIC, instance=4)
    return join(static, moving)


def test_observations_are_sorted_by_track_and_frame_and_complete(labelled: LabelledTracks) -> None:
    observations = observations_of(labelled, TrackLabel.STATIC)
    assert len(observations) == int((labelled.weight[:6] > 0).sum())
    key = observations.track * 5 + observations.frame
    assert (np.diff(key) > 0).all()
    for index in range(len(observations)):
        track, frame = observations.track[index], observations.frame[index]
        np.testing.assert_array_equal(observations.uv[index], labelled.tracks.uv[track, frame])
        assert observations.depth[index] == labelled.depth[track, frame]


def test_only_the_asked_labels_are_collected(labelled: LabelledTracks) -> None:
    assert set(observations_of(labelled, TrackLabel.DYNAMIC).track) == {6, 7, 8}
    assert len(observations_of(labelled, TrackLabel.REJECTED)) == 0
    both = observations_of(labelled, TrackLabel.STATIC, TrackLabel.DYNAMIC)
    assert len(both) == int((labelled.weight > 0).sum())


def test_an_observation_of_weight_zero_is_left_out(labelled: LabelledTracks) -> None:
    weight = labelled.weight.copy()
    weight[6, 2] = 0.0
    observations = observations_of(dataclasses.replace(labelled, weight=weight), TrackLabel.DYNAMIC)
    assert (6, 2) not in set(zip(observations.track.tolist(), observations.frame.tolist(), strict=True))
    assert len(observations) == 14


def test_rows_number_the_distinct_tracks(labelled: LabelledTracks) -> None:
    observations = observations_of(labelled, TrackLabel.DYNAMIC)
    tracks, row = observations.rows()
    np.testing.assert_array_equal(tracks, [6, 7, 8])
    np.testing.assert_array_equal(tracks[row], observations.track)


def test_short_tracks_are_dropped(rng: np.random.Generator) -> None:
    full = observe(static_points(rng, 3), camera_path(5))
    hidden = np.zeros((3, 5), bool)
    hidden[1, 2:], hidden[2, 3:] = True, True
    observations = observations_of(hide(full, hidden), TrackLabel.STATIC)
    assert sorted(set(observations.with_min_observations(3).track)) == [0, 2]
    assert len(observations.with_min_observations(6)) == 0
    assert len(observations.select(np.zeros(0, np.int64)).with_min_observations(2)) == 0


def reprojection_weights(
    frame: np.ndarray, weight: np.ndarray, num_frames: int, normalization: Normalization
) -> np.ndarray:
    """Weights of the paper's reprojection term, whose sigmas do not count."""
    weighed = PaperEnergy(normalization).observed(0.3, weight, KernelConfig(kind="norm"), frame, num_frames)
    assert "sigma" not in weighed
    return np.asarray(weighed["weight"])


def test_mean_weights_give_the_mean_over_frames_of_per_frame_means(rng: np.random.Generator) -> None:
    frame, weight = rng.integers(0, 7, 200), rng.uniform(0.1, 1.0, 200)
    norms = rng.uniform(0.0, 3.0, 200)
    means = [np.average(norms[frame == t], weights=weight[frame == t]) for t in range(7)]
    found = np.sum(reprojection_weights(frame, weight, 7, "mean") * norms)
    assert found == pytest.approx(np.mean(means), rel=1e-12)


def test_a_frame_without_observations_counts_as_zero_in_the_mean(rng: np.random.Generator) -> None:
    frame = rng.integers(0, 3, 60)
    norms = rng.uniform(0.0, 3.0, 60)
    means = [norms[frame == t].mean() for t in range(3)]
    found = np.sum(reprojection_weights(frame, np.ones(60), 4, "mean") * norms)
    assert found == pytest.approx(sum(means) / 4.0, rel=1e-12)


def test_sum_weights_are_the_trust_itself(rng: np.random.Generator) -> None:
    frame, weight = rng.integers(0, 7, 50), rng.uniform(0.1, 1.0, 50)
    np.testing.assert_array_equal(reprojection_weights(frame, weight, 7, "sum"), weight)


def test_weight_falls_with_the_distance_from_the_query_frame() -> None:
    frame = np.array([0, 3, 6, 1, 2])
    observations = Observations(
        np.array([0, 0, 0, 1, 1]), frame, np.zeros((5, 2)), np.ones(5), np.array([1.0, 1.0, 0.5, 1.0, 1.0])
    )
    query = np.array([3, 1], dtype=np.int32)
    weighed = weigh_by_drift(observations, query, 3.0)
    np.testing.assert_allclose(weighed.weight, [0.5, 1.0, 0.25, 1.0, 0.75])
    np.testing.assert_array_equal(weighed.frame, frame)
    np.testing.assert_allclose(weigh_by_drift(observations, query, 1e12).weight, observations.weight)
