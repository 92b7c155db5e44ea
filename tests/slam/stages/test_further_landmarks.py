"""More observations than the camera solves take: the other landmarks come out as if they had been in them."""

from __future__ import annotations

import numpy as np
import pytest
from stage_samples import K, camera_path, observe, shift, static_observations, static_points

from uni4d_fg.config.stages import BundleAdjustmentConfig
from uni4d_fg.factors.variable_types import LANDMARK
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.geometry import se3
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.summary import Termination
from uni4d_fg.slam.stages.bundle_adjustment import Freedom, adjust_bundle
from uni4d_fg.slam.stages.energy import MAP, Energy, PaperEnergy
from uni4d_fg.slam.stages.scene import Cameras, StaticNoise, StaticScene
from uni4d_fg.slam.stages.structure import further_landmarks

FRAMES, TRACKS = 8, 400
POSES = camera_path(FRAMES)
WORLD = static_points(np.random.default_rng(5), TRACKS)


@pytest.fixture
def noisy(rng: np.random.Generator) -> LabelledTracks:
    """Observations with 0.3 px of noise and depth with 1 %."""
    labelled = shift(observe(WORLD, POSES), rng.normal(scale=0.3, size=(TRACKS, FRAMES, 2)))
    labelled.depth[:] *= np.exp(rng.normal(scale=0.01, size=labelled.depth.shape))
    return labelled


def adjust(
    labelled: LabelledTracks, limit: int, *, energy: Energy = MAP, hooks: Hooks | None = None, **fields: object
) -> StaticScene:
    values = {"max_camera_observations": limit, "acceleration": {"linear": None, "angular": None}, **fields}
    config = BundleAdjustmentConfig.model_validate(values)
    start = se3.retract(POSES, np.random.default_rng(2).normal(scale=0.003, size=(FRAMES, 6)))
    start[0] = POSES[0]
    cameras = Cameras(start, K, np.zeros(FRAMES))
    return adjust_bundle(static_observations(labelled), cameras, K, config, Freedom(True, False), energy, hooks)


def errors(scene: StaticScene) -> np.ndarray:
    """Distance of every landmark from the truth, m."""
    return np.linalg.norm(scene.landmarks - WORLD[scene.landmark_track], axis=1)


def test_all_landmarks_are_there_and_as_good(noisy: LabelledTracks) -> None:
    whole, thinned = adjust(noisy, 10_000), adjust(noisy, 1_000)
    assert [solve.name for solve in whole.solves] == ["bundle_adjustment"] * 2 + ["structure"] * 2
    parts = [f"further_landmarks[{part}]" for part in (0, 0, 1, 1, 2, 2)]
    assert [solve.name for solve in thinned.solves] == ["bundle_adjustment"] * 2 + ["structure"] * 2 + parts
    assert len(np.intersect1d(thinned.landmark_track, whole.landmark_track)) > 0.99 * len(whole.landmark_track)
    np.testing.assert_array_equal(np.unique(thinned.observations.track), thinned.landmark_track)
    assert (np.diff(thinned.observations.track) >= 0).all()
    assert np.median(errors(thinned)) < 1.2 * np.median(errors(whole))
    np.testing.assert_allclose(np.median(thinned.landmark_error), np.median(whole.landmark_error), rtol=0.05)


def test_the_camera_solves_see_evenly_spread_tracks_with_so_many_observations(noisy: LabelledTracks) -> None:
    cameras, *_ = adjust(noisy, 800).solves
    assert cameras.num_variables == FRAMES - 1 + FRAMES + 100  # poses, scales and 800 / 8 landmarks
    seen = static_observations(noisy)
    chosen = np.unique(seen.track[seen.thinned(800)])
    assert len(chosen) == 100
    assert np.diff(chosen).max() <= 5


def test_landmarks_do_not_depend_on_the_parts(noisy: LabelledTracks) -> None:
    """Cameras and scales are held: a landmark's minimum is its own."""
    solver = {"relative_decrease": 1e-13, "early_relative_decrease": 1e-13, "max_iterations": 100}
    state, found = Cameras(POSES, K, np.zeros(FRAMES)).state(np.zeros((0, 3))), []
    for limit in (5_000, 700):
        config = BundleAdjustmentConfig.model_validate({"max_camera_observations": limit, "structure_solver": solver})
        end, kept, solves = further_landmarks(
            state, static_observations(noisy), StaticNoise(0.3, 0.01), config, dropped={}
        )
        assert len(solves) == (2 if limit == 5_000 else 10)
        np.testing.assert_array_equal(np.unique(kept.track), end.numbers(LANDMARK)[:, 0])
        found.append(end)
    np.testing.assert_array_equal(found[0].numbers(LANDMARK), found[1].numbers(LANDMARK))
    np.testing.assert_allclose(found[0][LANDMARK], found[1][LANDMARK], atol=1e-4)


def test_outliers_among_them_are_dropped_and_counted(noisy: LabelledTracks) -> None:
    offset = np.zeros((TRACKS, FRAMES, 2))
    offset[:100, 5] = [40.0, -25.0]
    whole, thinned = (adjust(shift(noisy, offset), limit) for limit in (10_000, 1_000))
    reason = "observation with a large reprojection error"
    assert whole.dropped[reason] == thinned.dropped[reason] == 100
    kept = thinned.observations
    assert not ((kept.frame == 5) & (kept.track < 100)).any()


def test_where_landmarks_are_not_refined_all_take_part(noisy: LabelledTracks) -> None:
    assert [s.name for s in adjust(noisy, 1_000, structure="keep").solves] == ["bundle_adjustment"] * 2
    paper = adjust(noisy, 1_000, energy=PaperEnergy(), depth_prior=False)
    assert [s.name for s in paper.solves] == ["bundle_adjustment"]
    assert len(paper.landmarks) > 0.98 * TRACKS


def test_stopping_skips_the_parts_that_follow(noisy: LabelledTracks) -> None:
    count = sum(len(solve.iterations) for solve in adjust(noisy, 1_000).solves[:4])
    for stop_at in (1, count + 4):
        asked = iter(range(1000))
        result = adjust(noisy, 1_000, hooks=Hooks(should_stop=lambda asked=asked, at=stop_at: next(asked) >= at))
        assert result.solves[-1].termination is Termination.CANCELLED
        assert len(result.solves) < 10


def test_fragments_of_one_point_stay_joined(noisy: LabelledTracks) -> None:
    """Tracks that are joined among those of the camera solves have one place, and the others their own."""
    labelled = noisy
    limit = 1_600
    config = BundleAdjustmentConfig.model_validate({"max_camera_observations": limit})
    seen = static_observations(labelled)
    chosen = np.unique(seen.track[seen.thinned(limit)])
    first, second = int(chosen[10]), int(chosen[20])
    # The second track becomes the later half of the first one's point.
    keep = ~(((seen.track == first) & (seen.frame >= 4)) | ((seen.track == second) & (seen.frame < 4)))
    uv = seen.uv.copy()
    later = (seen.track == second) & (seen.frame >= 4)
    uv[later] = seen.uv[(seen.track == first) & (seen.frame >= 4)]
    depth = seen.depth.copy()
    depth[later] = seen.depth[(seen.track == first) & (seen.frame >= 4)]
    seen = type(seen)(seen.track, seen.frame, uv, depth, seen.weight).select(keep)

    def find(state: object, observations: object, noise: StaticNoise) -> np.ndarray:
        tracks = observations.rows()[0]  # type: ignore[attr-defined]
        return np.where(tracks == second, first, tracks)

    scene = adjust_bundle(
        seen, Cameras(POSES, K, np.zeros(FRAMES)), K, config, Freedom(True, False), find_fragments=find
    )
    assert scene.joined == 1
    place = dict(zip(scene.landmark_track.tolist(), scene.landmarks, strict=True))
    np.testing.assert_array_equal(place[first], place[second])
    assert np.linalg.norm(place[first] - WORLD[first]) < 0.05
    assert len(scene.landmark_track) > 0.98 * TRACKS
    assert np.median(errors(scene)) < 0.03


@pytest.mark.parametrize("early", [1e-4, None])
def test_blurred_frames_weigh_less_for_them_however_early_the_first_solve_ends(
    noisy: LabelledTracks, rng: np.random.Generator, early: float | None
) -> None:
    blurred = shift(noisy, rng.normal(scale=3.0, size=(TRACKS, FRAMES, 2)) * (np.arange(FRAMES)[:, None] == 4))
    scene = adjust(blurred, 1_000, structure_solver={"early_relative_decrease": early})
    assert scene.solves[-1].name.startswith("further_landmarks")
    seen = scene.observations  # a quarter of the tracks is in the camera solves, and weighed there as well
    assert np.mean(seen.weight[seen.frame == 4] < 0.2) > 0.95
    assert np.mean(seen.weight[seen.frame == 3] > 0.5) > 0.95
