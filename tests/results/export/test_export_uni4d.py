"""Uni4D's result files: what its viewer and its evaluation load from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from export_checks import seen_landmarks
from scipy.spatial.transform import Rotation

from uni4d_fg.results.export import export_run
from uni4d_fg.results.export.uni4d import fill_depth
from uni4d_fg.results.run import Run

Export = Callable[..., tuple[Path, object]]


@pytest.fixture(scope="module")
def video(source: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    (report,) = export_run(source, ["uni4d"], tmp_path_factory.mktemp("uni4d"))
    (folder,) = (report.folder / "data").iterdir()  # its programs take every entry for a video
    return folder


def test_per_frame_files_have_its_layout(source: Run, video: Path) -> None:
    folder, (height, width) = video / "uni4d" / "uni4d_fg", source.reconstruction.image_size
    for frame in range(source.num_frames):
        with np.load(folder / f"{frame:04d}.npz") as file:
            layout = {name: (file[name].dtype.str, file[name].shape) for name in file}
            assert layout == {
                "disp": ("<f4", (height, width)), "img": ("|u1", (height, width, 3)),
                "R": ("<f4", (3, 3)), "t": ("<f4", (3,)), "K": ("<f4", (3, 3)),
            }  # fmt: skip
            np.testing.assert_array_equal(file["img"], source.need_sequence().images[frame])
            known = np.isfinite(source.depth[frame])  # type: ignore[index]
            np.testing.assert_allclose(1.0 / file["disp"][known], source.depth[frame][known], rtol=1e-6)  # type: ignore[index]
            assert np.isfinite(file["disp"]).all()


def test_its_projection_meets_the_observations(source: Run, video: Path) -> None:
    seen, landmarks = seen_landmarks(source), source.reconstruction.landmarks
    for frame in range(source.num_frames):
        file, mine = np.load(video / "uni4d" / "uni4d_fg" / f"{frame:04d}.npz"), seen.frame == frame
        # x = K R^T (X - t), pixel centers at integers
        pixel = (landmarks[seen.landmark[mine]] - file["t"]) @ file["R"] @ file["K"].T
        error = np.linalg.norm(pixel[:, :2] / pixel[:, 2:] - seen.uv[mine], axis=1)
        np.testing.assert_allclose(error, seen.error[mine], atol=1e-3)


def test_the_fused_cloud_has_its_layout(source: Run, video: Path) -> None:
    count, (height, width) = source.num_frames, source.reconstruction.image_size
    with np.load(video / "uni4d" / "uni4d_fg" / "fused_4d.npz", allow_pickle=True) as file:
        fused = {name: file[name] for name in file}
    static = len(fused["static_points"])
    layout = {name: (array.dtype.str, array.shape) for name, array in fused.items()}
    assert layout == {
        "static_points": ("<f8", (static, 3)), "static_rgbs": ("|u1", (static, 3)),
        "dyn_points": ("|O", (count,)), "dyn_rgbs": ("|O", (count,)), "c2w": ("<f8", (count, 4, 4)),
        "rgbs": ("|u1", (count, height, width, 3)), "Ks": ("<f4", (count, 3, 3)),
    }  # fmt: skip
    assert static > 100
    np.testing.assert_array_equal(fused["c2w"], source.reconstruction.world_T_cam)
    for frame in range(count):
        np.testing.assert_array_equal(fused["rgbs"][frame], source.need_sequence().images[frame])
        points, colors = fused["dyn_points"][frame], fused["dyn_rgbs"][frame]
        assert (points.dtype, colors.dtype) == (np.float32, np.uint8)
        assert points.shape == colors.shape == (len(points), 3)


def test_its_evaluation_of_poses_gives_our_score(source: Run, video: Path) -> None:
    """The steps of eval_pose.py through evo, on the exported folder alone."""
    metrics = pytest.importorskip("evo.core.metrics")
    trajectory = pytest.importorskip("evo.core.trajectory")
    truth = np.load(video / "c2w.npy")
    files = [np.load(video / "uni4d" / "uni4d_fg" / f"{frame:04d}.npz") for frame in range(len(truth))]

    def path(rotations: np.ndarray, positions: np.ndarray) -> object:
        quaternions = np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=1)
        return trajectory.PoseTrajectory3D(positions, quaternions, np.arange(float(len(positions))))

    theirs = path(np.stack([f["R"] for f in files]), np.stack([f["t"] for f in files]))
    reference = path(truth[:, :3, :3], truth[:, :3, 3])
    theirs.align(reference, correct_scale=True)  # type: ignore[attr-defined]
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, theirs))
    from uni4d_fg.results.evaluate.run import evaluate_run

    ours = evaluate_run(source.folder.root, source.need_sequence()).to_dict()
    assert _find(ours, "ate") == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-3)


def _find(report: object, word: str) -> float:
    """The first number whose key begins with a word, anywhere in a report."""
    if isinstance(report, dict):
        for key, value in report.items():
            if str(key).lower().startswith(word):
                return float(value["rmse"]) if isinstance(value, dict) else float(value)
            try:
                return _find(value, word)
            except KeyError:
                continue
    raise KeyError(word)


def test_true_depth_is_there_for_its_evaluation(source: Run, video: Path) -> None:
    paths = sorted((video / "depth_gt").iterdir())
    assert len(paths) == source.num_frames
    truth = source.need_sequence().ground_truth.depths
    assert truth is not None
    for frame, path in enumerate(paths):
        np.testing.assert_array_equal(np.load(path), np.nan_to_num(truth[frame], nan=0.0))


def test_missing_depth_takes_the_nearest() -> None:
    nan = np.nan
    depth = np.array([[1.0, nan, nan, nan, 2.0], [nan, nan, nan, nan, nan]], dtype=np.float32)
    filled, count = fill_depth(depth)
    assert count == 8
    assert filled[0, [0, 1, 3, 4]].tolist() == [1.0, 1.0, 2.0, 2.0]
    assert filled[1, [0, 4]].tolist() == [1.0, 2.0]
    nothing, count = fill_depth(np.full((2, 3), nan, dtype=np.float32))
    assert (count, nothing.tolist()) == (6, [[0.0] * 3] * 2)
