"""Stage 1: windows that stay attached to what came before, bridged frames, and its energy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from stage_samples import K, camera_path, hide, observe, shift, static_points

from uni4d_fg.config.solver import KernelConfig, SolverConfig
from uni4d_fg.config.stages import CameraInitConfig, CameraMotionConfig
from uni4d_fg.errors import DegenerateProblemError
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import INTRINSICS, POSE
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.geometry import se3
from uni4d_fg.geometry.camera import camera_to_world, project, unproject, world_to_camera
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.problem import Problem
from uni4d_fg.optim.stage import LevenbergMarquardtRunner, Stage, run_stage
from uni4d_fg.optim.summary import SolveSummary
from uni4d_fg.slam.stages.camera_init import CameraInitResult, PairSource, initialize_cameras, window_stage
from uni4d_fg.slam.stages.energy import MAP, Normalization, PaperEnergy
from uni4d_fg.slam.stages.terms import camera_motion_terms

FRAMES, WINDOW = 12, 4
CONFIG = CameraInitConfig(
    window=WINDOW, solver=SolverConfig(max_iterations=30, relative_decrease=1e-8, gradient_tolerance=1e-12)
)

needs_extension = pytest.mark.skipif(find_extension()[0] is None, reason=find_extension()[1] or "installed")


@pytest.fixture
def exact(rng: np.random.Generator) -> LabelledTracks:
    return observe(static_points(rng, 60), camera_path(FRAMES))


def initialize(labelled: LabelledTracks, config: CameraInitConfig = CONFIG, **options: object) -> CameraInitResult:
    return initialize_cameras(labelled, K, config, **({"free_intrinsics": False} | options))  # type: ignore[arg-type]


def test_exact_tracks_give_exact_poses(exact: LabelledTracks) -> None:
    result = initialize(exact)
    np.testing.assert_allclose(result.cameras.world_T_cam, camera_path(FRAMES), atol=2e-5)
    np.testing.assert_array_equal(result.cameras.world_T_cam[0], np.eye(4))
    np.testing.assert_array_equal(result.cameras.intrinsics, K)
    assert result.bridged_frames == ()
    assert len(result.windows) == FRAMES - 1


def test_a_wrong_focal_length_is_found_when_free(exact: LabelledTracks) -> None:
    wrong = K * [1.04, 1.04, 1.0, 1.0]
    config = CONFIG.model_copy(update={"window": 8})
    result = initialize_cameras(exact, wrong, config, free_intrinsics=True)
    np.testing.assert_allclose(result.cameras.intrinsics[:2], K[:2], rtol=0.01)
    np.testing.assert_array_equal(result.cameras.intrinsics[2:], wrong[2:])


def recorded_poses(labelled: LabelledTracks, config: CameraInitConfig) -> list[np.ndarray]:
    """Poses after every window."""
    after: list[np.ndarray] = []

    def run(stage: Stage, state: State, hooks: Hooks | None) -> tuple[State, SolveSummary]:
        state, summary = run_stage(stage, state, hooks)
        after.append(state[POSE])
        return state, summary

    initialize(labelled, config, run=run)
    return after


def test_frames_that_left_the_window_never_move_again(exact: LabelledTracks, rng: np.random.Generator) -> None:
    noisy = shift(exact, rng.normal(scale=1.0, size=exact.tracks.uv.shape))
    after = recorded_poses(noisy, CONFIG)
    assert len(after) == FRAMES - 1
    for newest in range(1, FRAMES):
        oldest = max(0, newest - WINDOW + 1)
        for later in after[newest:]:
            np.testing.assert_array_equal(later[: oldest + 1], after[newest - 1][: oldest + 1])
        if newest + 1 < FRAMES:
            free = slice(max(0, newest + 1 - WINDOW + 1) + 1, newest + 1)
            assert (after[newest][free] != after[newest - 1][free]).any()


def test_a_disturbance_does_not_change_frames_that_left_the_window_before(
    exact: LabelledTracks, rng: np.random.Generator
) -> None:
    disturbed_from = 8
    offset = np.zeros((60, FRAMES, 2))
    offset[:, disturbed_from:] = rng.normal(scale=15.0, size=(60, FRAMES - disturbed_from, 2))
    calm, disturbed = (initialize(tracks).cameras.world_T_cam for tracks in (exact, shift(exact, offset)))
    old = disturbed_from - WINDOW + 1
    relative = se3.inverse(calm[:old]) @ calm[1 : old + 1]
    np.testing.assert_array_equal(se3.inverse(disturbed[:old]) @ disturbed[1 : old + 1], relative)
    assert np.abs(disturbed[disturbed_from:] - calm[disturbed_from:]).max() > 0.01


def test_every_window_starts_where_the_one_before_ended(exact: LabelledTracks) -> None:
    result = initialize(exact)
    steps = np.linalg.norm(np.diff(result.cameras.world_T_cam[:, :3, 3], axis=0), axis=1)
    truth = np.linalg.norm(np.diff(camera_path(FRAMES)[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, truth, atol=2e-5)


@pytest.mark.parametrize("unseen", [4, FRAMES - 1])
def test_an_unseen_frame_continues_at_constant_velocity(exact: LabelledTracks, unseen: int) -> None:
    result = initialize(hide(exact, np.arange(FRAMES) == unseen))
    assert result.bridged_frames == (unseen,)
    poses, truth = result.cameras.world_T_cam, camera_path(FRAMES)
    predicted = poses[unseen - 1] @ se3.inverse(poses[unseen - 2]) @ poses[unseen - 1]
    np.testing.assert_allclose(poses[unseen], predicted, atol=1e-9)
    np.testing.assert_allclose(np.delete(poses, unseen, 0), np.delete(truth, unseen, 0), atol=2e-5)


def test_frames_after_a_long_gap_hang_on_the_bridged_ones(exact: LabelledTracks) -> None:
    hidden = (np.arange(FRAMES) >= 4) & (np.arange(FRAMES) < 8)
    result = initialize(hide(exact, hidden))
    assert result.bridged_frames == (4, 5, 6, 7, 8)
    assert np.isfinite(result.cameras.world_T_cam).all()
    step = se3.inverse(result.cameras.world_T_cam[8:-1]) @ result.cameras.world_T_cam[9:]
    truth = camera_path(FRAMES)
    np.testing.assert_allclose(step, se3.inverse(truth[8:-1]) @ truth[9:], atol=2e-5)


def test_the_oldest_frame_of_every_part_of_a_window_is_held(exact: LabelledTracks) -> None:
    frames = np.array([3, 4, 5, 6])
    first_half = np.arange(60) < 30
    cut = (first_half[:, None] & (np.arange(FRAMES) > 4)) | (~first_half[:, None] & (np.arange(FRAMES) <= 4))
    for labelled, expected in (
        (exact, [3]),
        (hide(exact, np.arange(FRAMES) == 3), [3, 4]),
        (hide(exact, np.arange(FRAMES) == 5), [3, 5]),
        (hide(exact, cut), [3, 5]),
    ):
        assert PairSource(labelled, 0).held(frames).tolist() == expected
        assert PairSource(labelled, 1).held(frames).tolist() == expected


def test_short_static_tracks_carry_no_camera(exact: LabelledTracks) -> None:
    short = dataclasses.replace(exact, label=np.full(60, TrackLabel.SHORT_STATIC, np.int32))
    with pytest.raises(DegenerateProblemError, match=r"0 static, 0 dynamic, 60 short static, 0 rejected; 0 static obs"):
        initialize(short)


def test_thinning_spreads_and_bounds_the_tracks_of_a_pair(exact: LabelledTracks) -> None:
    pairs = PairSource(exact, 10)
    chosen = pairs.tracks(0, 3)
    assert len(chosen) == 10
    assert chosen[0] == 0
    assert chosen[-1] == 59
    assert len(PairSource(exact, 0).tracks(0, 3)) == 60
    assert pairs.shared([0, 1], 2) == 4 * 60


def direct_energy(
    labelled: LabelledTracks, poses: np.ndarray, frames: list[int], cost: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Mean over tracks of the cost of |r| for every ordered pair of frames, one by one."""
    tracks, out = labelled.tracks, []
    for i in frames:
        for j in frames:
            if i == j:
                continue
            costs = []
            for k in range(tracks.num_tracks):
                if labelled.weight[k, i] == 0 or labelled.weight[k, j] == 0 or not np.isfinite(labelled.depth[k, i]):
                    continue
                lifted = unproject(K, tracks.uv[k, i].astype(float), np.float64(labelled.depth[k, i]))
                seen = project(K, world_to_camera(poses[j], camera_to_world(poses[i], lifted)))
                costs.append(cost(np.linalg.norm(tracks.uv[k, j] - seen)))
            out.append(np.mean(costs))
    return np.array(out)


@pytest.mark.parametrize("normalization", ["mean", "sum"])
def test_the_energy_of_a_window_is_the_sum_over_its_pairs(
    exact: LabelledTracks, rng: np.random.Generator, normalization: Normalization
) -> None:
    noisy = hide(shift(exact, rng.normal(size=exact.tracks.uv.shape)), rng.random((60, FRAMES)) < 0.2)
    config = CONFIG.model_copy(
        update={
            "kernel": KernelConfig(kind="norm", threshold=0.1),
            "camera_motion": CameraMotionConfig(rotation_weight=0.0, translation_weight=0.0),
            "max_tracks_per_pair": 0,
        }
    )
    frames, poses = [2, 3, 4, 5], se3.retract(camera_path(FRAMES), rng.normal(scale=0.01, size=(FRAMES, 6)))
    state = State({POSE: poses, INTRINSICS: K[None]})
    stage = window_stage(
        np.array(frames), state, PairSource(noisy, 0), config,
        free_intrinsics=False, energy=PaperEnergy(normalization),
    )  # fmt: skip
    energies = stage.problem.energies(state)
    assert set(energies) == {"depth_reprojection"}
    means = direct_energy(noisy, poses, frames, lambda r: np.sqrt(r**2 + 0.01) - 0.1)
    if normalization == "mean":
        assert energies["depth_reprojection"] == pytest.approx(means.mean(), rel=1e-6)
    else:
        counts = [len(PairSource(noisy, 0).tracks(i, j)) for i in frames for j in frames if i != j]
        assert energies["depth_reprojection"] == pytest.approx(float(means @ counts), rel=1e-6)


def test_the_squared_norm_of_the_papers_text_ends_where_squares_do(
    exact: LabelledTracks, rng: np.random.Generator
) -> None:
    """The two energies differ by weights alone, which are all 1 with plain sums: the solutions are one."""
    noisy = shift(exact, rng.normal(scale=0.5, size=exact.tracks.uv.shape))
    squared = CONFIG.model_copy(update={"kernel": KernelConfig(kind="quadratic")})
    text = initialize(noisy, squared, energy=PaperEnergy("sum"))
    likelihood = initialize(noisy, squared, energy=MAP)
    np.testing.assert_array_equal(text.cameras.world_T_cam, likelihood.cameras.world_T_cam)
    truth = camera_path(FRAMES)
    assert 1e-4 < np.abs(text.cameras.world_T_cam - truth)[:, :3, 3].max() < 0.05


def test_axes_of_the_camera_leave_a_steady_turn_alone() -> None:
    """Poses D, D^2, D^3, ...: in axes of the camera the motion is constant, in those of the world it turns."""
    step = se3.se3_exp(np.array([[0.0, 0.2, 0.0, 0.1, 0.0, 0.3]]))[0]
    poses = np.stack([np.linalg.matrix_power(step, t) for t in range(5)])
    energies = {}
    for axes in ("world", "camera"):
        motion = CameraMotionConfig(rotation_weight=0.0, translation_axes=axes)  # type: ignore[arg-type]
        problem = Problem().add(camera_motion_terms(np.arange(5), motion, PaperEnergy("sum")))
        energies[axes] = problem.energies(State({POSE: poses}), exact=True)
    assert energies["camera"]["camera_translation"] < 1e-12
    # Three changes of direction by 0.2 rad each, a chord of 2 sin 0.1 of the steps' equal length.
    length = np.linalg.norm(step[:3, 3])
    assert energies["world"]["camera_translation"] == pytest.approx(
        6.0 * np.sin(0.1) * length / np.sqrt(length**2 + 1e-6), rel=1e-9
    )


@pytest.mark.parametrize("changed", [{"translation_axes": "camera"}, {"kernel": KernelConfig(kind="quadratic")}])
@needs_extension
def test_both_backends_end_alike_with_what_the_papers_text_has(
    exact: LabelledTracks, rng: np.random.Generator, changed: dict[str, object]
) -> None:
    """Also where C++ has no kernel of a term."""
    noisy = shift(exact, rng.normal(scale=0.5, size=exact.tracks.uv.shape))
    motion = CameraMotionConfig(**{k: v for k, v in changed.items() if k != "kernel"})  # type: ignore[arg-type]
    kernel = changed.get("kernel", KernelConfig(kind="norm", threshold=0.1))
    config = CONFIG.model_copy(update={"kernel": kernel, "camera_motion": motion})
    ours, theirs = (
        initialize(noisy, config, energy=PaperEnergy(), run=LevenbergMarquardtRunner(choose_backend(name)))
        for name in ("python", "cpp")
    )
    assert theirs.windows[-1].notes["backend"] == "cpp"
    np.testing.assert_allclose(theirs.cameras.world_T_cam, ours.cameras.world_T_cam, atol=1e-4)


def test_only_the_newer_frames_of_a_window_are_free(exact: LabelledTracks) -> None:
    state = State({POSE: camera_path(FRAMES), INTRINSICS: K[None]})
    stage = window_stage(
        np.array([3, 4, 5, 6]), state, PairSource(exact, 0), CONFIG,
        free_intrinsics=True, energy=MAP,
    )  # fmt: skip
    free = stage.problem.free
    assert np.flatnonzero(free[POSE].any(axis=1)).tolist() == [4, 5, 6]
    np.testing.assert_array_equal(free[INTRINSICS], [[True, True, False, False]])
    assert "intrinsics_prior" in {batch.name for batch in stage.problem.batches}


def test_no_window_raises_its_energy(exact: LabelledTracks, rng: np.random.Generator) -> None:
    result = initialize(shift(exact, rng.normal(scale=2.0, size=exact.tracks.uv.shape)))
    for window in result.windows:
        assert window.final_energy <= window.initial_energy


def test_stopping_ends_with_the_window_at_hand(exact: LabelledTracks) -> None:
    windows = iter(range(100))
    hooks = Hooks(should_stop=lambda: next(windows) >= 3)
    result = initialize(exact, hooks=hooks)
    assert result.windows[-1].termination.value == "stopped: cancelled"
    assert len(result.windows) < FRAMES - 1
