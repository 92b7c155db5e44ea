"""Stage 3: which points exist, how they are linked and bridged, and what the solve does to them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stage_samples import K, camera_path, hide, join, observe, shift

from uni4d_fg.config.stages import NonRigidConfig
from uni4d_fg.factors.arap import arap
from uni4d_fg.factors.state import State
from uni4d_fg.factors.variable_types import DYNAMIC_POINT
from uni4d_fg.frontend.track_model import LabelledTracks, TrackLabel
from uni4d_fg.optim.backend import choose_backend
from uni4d_fg.optim.extension import find_extension
from uni4d_fg.optim.levenberg_marquardt import Hooks
from uni4d_fg.optim.stage import LevenbergMarquardtRunner
from uni4d_fg.optim.summary import Termination
from uni4d_fg.slam.stages.energy import MAP, Energy, Normalization, PaperEnergy
from uni4d_fg.slam.stages.nonrigid import PointMesh, build_mesh, motion_terms, solve_nonrigid
from uni4d_fg.slam.stages.observations import observations_of
from uni4d_fg.slam.stages.scene import Cameras, DynamicScene, StaticNoise

FRAMES = 9
POSES = camera_path(FRAMES)
CAMERAS = Cameras(POSES, K, np.zeros(FRAMES))
NOISE = StaticNoise(0.5, 0.02)
CONFIG = NonRigidConfig()

needs_extension = pytest.mark.skipif(find_extension()[0] is None, reason=find_extension()[1] or "installed")


def changed(**fields: object) -> NonRigidConfig:
    return NonRigidConfig.model_validate(CONFIG.model_dump() | fields)


def moving_patch(center: tuple[float, float, float], speed: float = 0.03, side: int = 5) -> np.ndarray:
    """A square patch of points, (side * side, T, 3), that moves steadily and turns slowly."""
    axis = np.linspace(-0.3, 0.3, side)
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    time = np.arange(FRAMES)
    angle = 0.02 * time
    out = np.empty((side * side, FRAMES, 3))
    out[..., 0] = center[0] + np.outer(x, np.cos(angle)) + speed * time
    out[..., 1] = center[1] + y[:, None] + 0.0 * time
    out[..., 2] = center[2] + np.outer(x, np.sin(angle)) + 0.5 * speed * time
    return out


@pytest.fixture
def truth() -> np.ndarray:
    return np.concatenate([moving_patch((-0.5, 0.0, 3.0)), moving_patch((0.7, 0.1, 3.5), speed=-0.02)])


@pytest.fixture
def exact(truth: np.ndarray) -> LabelledTracks:
    return join(
        observe(truth[:25], POSES, TrackLabel.DYNAMIC, instance=1),
        observe(truth[25:], POSES, TrackLabel.DYNAMIC, instance=6),
    )


def mesh_of(labelled: LabelledTracks, config: NonRigidConfig = CONFIG) -> tuple[PointMesh, np.ndarray, dict[str, int]]:
    dropped: dict[str, int] = {}
    observations = observations_of(labelled, TrackLabel.DYNAMIC)
    mesh, _, _, state = build_mesh(observations, labelled.instance, FRAMES, CAMERAS, config, dropped)
    return mesh, state[DYNAMIC_POINT], dropped


def solve(labelled: LabelledTracks, config: NonRigidConfig = CONFIG, **options: object) -> DynamicScene:
    observations = observations_of(labelled, TrackLabel.DYNAMIC)
    return solve_nonrigid(observations, labelled.instance, CAMERAS, NOISE, config, **options)  # type: ignore[arg-type]


def with_depth_noise(labelled: LabelledTracks, rng: np.random.Generator, sigma: float) -> LabelledTracks:
    noise = np.exp(rng.normal(scale=sigma, size=labelled.depth.shape))
    return dataclasses.replace(labelled, depth=(labelled.depth * noise).astype(np.float32))


def test_rows_are_numbered_by_track_and_frame(exact: LabelledTracks, truth: np.ndarray) -> None:
    mesh, points, _ = mesh_of(exact)
    np.testing.assert_array_equal(mesh.row, np.arange(50 * FRAMES).reshape(50, FRAMES))
    np.testing.assert_array_equal(mesh.track, np.arange(50))
    np.testing.assert_array_equal(mesh.instance, np.repeat([1, 6], 25))
    np.testing.assert_allclose(points.reshape(50, FRAMES, 3), truth, atol=2e-6)
    assert mesh.num_points == 50 * FRAMES


def test_gaps_within_a_track_exist_and_ends_do_not(exact: LabelledTracks) -> None:
    hidden = np.zeros((50, FRAMES), bool)
    hidden[3, [0, 4, 5, 8]] = True
    mesh, points, _ = mesh_of(hide(exact, hidden))
    np.testing.assert_array_equal(mesh.row[3] >= 0, [False, *[True] * 7, False])
    np.testing.assert_array_equal(mesh.observed[3], ~hidden[3])
    bridged = points[mesh.row[3, 3:7]]
    np.testing.assert_allclose(np.diff(bridged, n=2, axis=0), 0.0, atol=1e-12)

    mesh, _, _ = mesh_of(hide(exact, hidden), changed(bridge_gaps=False))
    np.testing.assert_array_equal(mesh.row[3] >= 0, ~hidden[3])


def test_observed_points_without_depth_start_between_their_neighbors(exact: LabelledTracks) -> None:
    depth = exact.depth.copy()
    depth[7, [0, 4]] = np.nan
    mesh, points, _ = mesh_of(dataclasses.replace(exact, depth=depth))
    assert mesh.observed[7].all()
    np.testing.assert_array_equal(points[mesh.row[7, 0]], points[mesh.row[7, 1]])
    middle = 0.5 * (points[mesh.row[7, 3]] + points[mesh.row[7, 5]])
    np.testing.assert_allclose(points[mesh.row[7, 4]], middle, atol=1e-12)


def test_tracks_never_seen_short_or_without_depth_are_absent(exact: LabelledTracks) -> None:
    hidden = np.zeros((50, FRAMES), bool)
    hidden[0] = True
    hidden[1, 2:] = True
    depth = exact.depth.copy()
    depth[2] = np.nan
    depth[3, 1:] = np.nan
    mesh, _, dropped = mesh_of(hide(dataclasses.replace(exact, depth=depth), hidden))
    np.testing.assert_array_equal(mesh.track, np.arange(4, 50))
    assert dropped == {"dynamic track with too few observations": 1, "dynamic track with too little depth": 2}


def test_links_stay_within_an_instance(exact: LabelledTracks) -> None:
    mesh, _, _ = mesh_of(exact)
    assert len(mesh.pairs) > 50
    np.testing.assert_array_equal(mesh.instance[mesh.pairs[:, 0]], mesh.instance[mesh.pairs[:, 1]])


def test_smoothness_reads_every_run_of_consecutive_frames(exact: LabelledTracks) -> None:
    hidden = np.zeros((50, FRAMES), bool)
    hidden[0, 4] = True
    mesh, _, _ = mesh_of(hide(exact, hidden))
    assert len(mesh.consecutive(3, observed_only=False)[0]) == 50 * (FRAMES - 2)
    before, now, after = mesh.consecutive(3, observed_only=True)
    assert len(now) == 50 * (FRAMES - 2) - 3
    np.testing.assert_array_equal(now - before, 1)
    np.testing.assert_array_equal(after - now, 1)
    assert [len(rows) for rows in mesh.consecutive(FRAMES + 1, observed_only=False)] == [0] * (FRAMES + 1)


def test_a_link_reads_both_points_in_both_frames(exact: LabelledTracks) -> None:
    hidden = np.zeros((50, FRAMES), bool)
    hidden[0, 5:] = True
    mesh, _, _ = mesh_of(hide(exact, hidden))
    rows, pair = mesh.linked(observed_only=False)
    of_first = int((mesh.pairs == 0).any(axis=1).sum())
    assert len(rows[0]) == (len(mesh.pairs) - of_first) * (FRAMES - 1) + of_first * 4
    np.testing.assert_array_equal(rows[2] - rows[0], 1)
    np.testing.assert_array_equal(rows[3] - rows[1], 1)
    here, _ = np.nonzero(mesh.row[mesh.pairs[pair, 0]] == rows[0][:, None])
    np.testing.assert_array_equal(here, np.arange(len(pair)))


@pytest.mark.parametrize("normalization", ["mean", "sum"])
def test_mutual_neighbors_may_count_twice(exact: LabelledTracks, normalization: Normalization) -> None:
    """As a sum, or a mean, over a list in which such a pair stands twice."""
    config = changed(arap_kernel={"kind": "norm"}, arap_weight=100.0)
    mesh, points, _ = mesh_of(exact, config)
    state = State({DYNAMIC_POINT: points + np.sin(np.arange(points.size)).reshape(points.shape)})
    rows, pair = mesh.linked(observed_only=False)
    listed = [np.repeat(r, mesh.times[pair]) for r in rows]
    energy = PaperEnergy(normalization)
    repeated = arap(*listed, **energy.linked(0.01, 100.0, config.arap_kernel, len(listed[0])))
    for how, expected in (("twice", repeated.energy(state)), ("once", None)):
        terms = motion_terms(mesh, config.model_copy(update={"arap_mutual_pairs": how}), energy)
        found = next(term for term in terms if term.name == "arap")
        assert len(found) == len(pair)
        if expected is None:
            assert abs(found.energy(state) / repeated.energy(state) - 1.0) > 1e-3
            assert len(set(found.weight.tolist())) == 1
        else:
            assert found.energy(state) == pytest.approx(expected, rel=1e-12)


@needs_extension
def test_both_backends_count_mutual_neighbors_twice(exact: LabelledTracks, rng: np.random.Generator) -> None:
    noisy = with_depth_noise(exact, rng, 0.02)
    exactly = {"relative_decrease": 1e-12, "early_relative_decrease": None, "cg_tolerance": 1e-6}
    solver = CONFIG.solver.model_copy(update={**exactly, "max_iterations": 200})
    ours, theirs, once = (
        solve(
            noisy, CONFIG.model_copy(update={"arap_mutual_pairs": how, "solver": solver}),
            run=LevenbergMarquardtRunner(choose_backend(name)),
        )
        for name, how in (("python", "twice"), ("cpp", "twice"), ("cpp", "once"))
    )  # fmt: skip
    np.testing.assert_array_equal(theirs.track, ours.track)
    np.testing.assert_allclose(theirs.points, ours.points, atol=1e-5)
    here = np.flatnonzero(np.isin(ours.track, once.track))
    there = np.flatnonzero(np.isin(once.track, ours.track))
    assert np.nanmax(np.abs(once.points[there] - ours.points[here])) > 1e-3


def test_exact_cues_are_left_alone(exact: LabelledTracks, truth: np.ndarray) -> None:
    result = solve(exact)
    kept = result.track
    assert len(kept) >= 48
    assert np.abs(result.points - truth[kept]).max() < 2e-3


def test_noise_is_reduced(exact: LabelledTracks, truth: np.ndarray, rng: np.random.Generator) -> None:
    noisy = with_depth_noise(shift(exact, rng.normal(scale=0.5, size=exact.tracks.uv.shape)), rng, 0.02)
    _, lifted, _ = mesh_of(noisy)
    result = solve(noisy)
    raw = np.sqrt(np.mean((lifted.reshape(truth.shape) - truth)[result.track] ** 2))
    assert np.sqrt(np.mean((result.points - truth[result.track]) ** 2)) < raw / 2.0
    assert result.solve is not None
    assert result.solve.final_energy < 0.3 * result.solve.initial_energy


def test_bridged_points_follow_the_motion(exact: LabelledTracks, truth: np.ndarray) -> None:
    hidden = np.zeros((50, FRAMES), bool)
    hidden[::3, 3:6] = True
    result = solve(hide(exact, hidden))
    bridged = ~result.observed
    assert bridged.sum() > 30
    assert np.linalg.norm((result.points - truth[result.track])[bridged], axis=1).max() < 0.01


def test_an_instance_of_one_track_is_kept(exact: LabelledTracks) -> None:
    instance = exact.instance.copy()
    instance[0] = 99
    result = solve(dataclasses.replace(exact, instance=instance))
    assert 99 in result.instance
    assert np.isfinite(result.points).all()


def test_a_trajectory_that_floats_in_space_is_dropped_and_counted(exact: LabelledTracks) -> None:
    depth = exact.depth.copy()
    depth[4] *= 2.0
    result = solve(dataclasses.replace(exact, depth=depth), changed(outlier_quantile=1.0))
    assert result.dropped["dynamic track far from its instance"] == 1
    assert 4 not in result.track


def test_a_trajectory_that_jumps_is_dropped_and_counted(truth: np.ndarray) -> None:
    torn = truth[:25].copy()
    torn[9, 6:, 1] += 0.5
    result = solve(observe(torn, POSES, TrackLabel.DYNAMIC, instance=1), changed(outlier_quantile=0.9))
    assert result.dropped["dynamic track with a large motion energy"] >= 1
    assert 9 not in result.track
    assert len(result.track) >= 22


@pytest.mark.parametrize("energy", [MAP, PaperEnergy()], ids=["map", "paper"])
def test_the_energy_never_rises_and_the_result_is_finite(
    exact: LabelledTracks, rng: np.random.Generator, energy: Energy
) -> None:
    hidden = rng.random((50, FRAMES)) < 0.3
    noisy = hide(with_depth_noise(exact, rng, 0.1), hidden)
    result = solve(noisy, changed(annealing=(10.0, 1.0)), energy=energy)
    assert result.solve is not None
    assert result.solve.final_energy <= result.solve.initial_energy
    assert np.isfinite(result.points[result.observed]).all()


@pytest.mark.parametrize("warm_up", [0.01, 1e-9])
def test_the_lower_of_both_ways_is_kept(exact: LabelledTracks, rng: np.random.Generator, warm_up: float) -> None:
    noisy = with_depth_noise(shift(exact, rng.normal(scale=1.0, size=exact.tracks.uv.shape)), rng, 0.2)
    with_it = solve(noisy, changed(warm_up_reprojection_weight=warm_up, also_without_warm_up=False)).solve
    without_it = solve(noisy, changed(warm_up_reprojection_weight=1.0)).solve
    both = solve(noisy, changed(warm_up_reprojection_weight=warm_up)).solve
    assert with_it is not None
    assert without_it is not None
    assert both is not None
    ends = [with_it.final_energy, without_it.final_energy]
    assert ends[0] != ends[1]
    assert both.notes["schedule_energies"] == ends
    assert both.final_energy == min(ends)
    assert len(both.iterations) == len(with_it.iterations) + len(without_it.iterations)


def test_coinciding_tracks_have_finite_derivatives(exact: LabelledTracks) -> None:
    result = solve(join(exact, exact))
    assert np.isfinite(result.points).all()
    both = np.intersect1d(result.track, result.track - 50)
    assert len(both) > 20
    first, second = (np.searchsorted(result.track, tracks) for tracks in (both, both + 50))
    np.testing.assert_allclose(result.points[first], result.points[second], atol=5e-3)


def test_no_dynamic_tracks_give_an_empty_result(exact: LabelledTracks) -> None:
    none = dataclasses.replace(exact, label=np.full(50, TrackLabel.REJECTED, np.int32))
    result = solve(none)
    assert result.points.shape == (0, FRAMES, 3)
    assert result.observed.shape == (0, FRAMES)
    assert result.solve is None


def test_stopping_keeps_the_points_so_far(exact: LabelledTracks) -> None:
    result = solve(exact, hooks=Hooks(should_stop=lambda: True))
    assert result.solve is not None
    assert result.solve.termination is Termination.CANCELLED
    assert np.isfinite(result.points).all()
