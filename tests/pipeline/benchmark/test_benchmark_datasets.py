"""Every dataset from its own files to its tables: the numbers are those of the truth in the files, read here anew."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmark_scenes import CONFIG, SCENE, sintel_task, synthesize
from PIL import Image
from scipy.spatial.transform import Rotation

from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.datasets.sintel_files import read_cam, write_cam
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.pipeline.benchmark.prepare import prepare
from uni4d_fg.results.depth_store import read_depth
from uni4d_fg.results.io import load_reconstruction

pytest.importorskip("open3d")

Run = Callable[..., tuple[int, str, str]]
OPTIONS = ["--config", "fast", "--quiet", "--workers", 1, "--no-pictures", *(w for c in CONFIG for w in ("--set", c))]
KITTI = "2011_09_26_drive_0002_sync"


def rows_of(out: Path, table: str) -> dict[str, dict[str, str]]:
    return {row["method"]: row for row in csv.DictReader((out / "tables" / f"{table}.csv").open())}


def aligned_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square of positions (T, 3) after the similarity that makes it least (Umeyama 1991)."""
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    u, d, vt = np.linalg.svd(b.T @ a)
    s = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (d * s).sum() / (a**2).sum()
    return float(np.sqrt(((scale * a @ (u * s @ vt).T - b) ** 2).sum(axis=1).mean()))


def relative_error(run: Path, files: list[Path], units_per_meter: float) -> float:
    """Mean of |depth / truth - 1| over the pixels with truth, of 16-bit PNGs whose zeros are no depth."""
    depths, errors = read_depth(run / "depth.npy"), []
    assert len(depths) == len(files)
    for depth, path in zip(depths, files, strict=True):
        truth = np.array(Image.open(path)).astype(np.float64) / units_per_meter
        known = (truth > 0.0) & np.isfinite(depth)
        errors.append(np.abs(np.asarray(depth, np.float64)[known] / truth[known] - 1.0))
    return float(np.concatenate(errors).mean())


@pytest.mark.parametrize(
    ("dataset", "layout", "video", "folder", "frames"),
    [
        ("tum-dynamics", "tum", "walking_xyz", "rgbd_dataset_freiburg3_walking_xyz", slice(0, 19, 3)),
        ("bonn", "bonn", "balloon2", "rgbd_bonn_balloon2", slice(30, 36)),
    ],
)
def test_poses_and_depth_of_rgbd_videos_are_scored_against_their_files(
    dataset: str, layout: str, video: str, folder: str, frames: slice, cli: Run, tmp_path: Path
) -> None:
    scene = ["--frames", str(frames.stop), "--set", f"frame_rate={10 * (frames.step or 1)}", *SCENE[2:]]
    synthesize(tmp_path, layout, video, scene=scene)
    out = tmp_path / "out"
    code, _, _ = cli(
        "benchmark", dataset, "--root", tmp_path, "--out", out, "--video", video, "--protocol", "sim3",
        "--protocol", "metric", *OPTIONS,
    )  # fmt: skip
    assert code == 0
    run = out / "runs" / "fast" / video
    rows = np.loadtxt(tmp_path / folder / "groundtruth.txt")[frames]
    found = load_reconstruction(run / "reconstruction.npz").world_T_cam
    poses = rows_of(out, "poses-sim3")["fast"]
    assert float(poses["ATE"]) == pytest.approx(aligned_error(found[:, :3, 3], rows[:, 1:4]), rel=1e-6)
    assert float(poses["ATE"]) < 0.01 < np.ptp(rows[:, 1:4], axis=0).max() / 5
    turns = Rotation.from_matrix(found[:, :3, :3]), Rotation.from_quat(rows[:, 4:8])
    steps = [turn[:-1].inv() * turn[1:] for turn in turns]
    error = np.degrees((steps[0].inv() * steps[1]).magnitude())
    assert float(poses["RPE rot"]) == pytest.approx(float(np.sqrt((error**2).mean())), rel=1e-5)
    assert (poses["posed"], poses["of frames"]) == (str(len(rows)), str(len(rows)))
    files = sorted((tmp_path / folder / "depth").iterdir())[frames]
    depth = rows_of(out, "depth-metric")
    assert float(depth["fast"]["AbsRel"]) == pytest.approx(relative_error(run, files, 5000.0), rel=1e-5)
    assert float(depth["fast"]["AbsRel"]) < min(0.06, float(depth["depth cue"]["AbsRel"]))


def test_depth_of_kitti_is_scored_against_its_pngs(cli: Run, tmp_path: Path) -> None:
    synthesize(tmp_path, "kitti", KITTI)
    folder, rng = tmp_path / "val" / KITTI / "proj_depth" / "groundtruth" / "image_02", np.random.default_rng(5)
    for path in folder.iterdir():  # as sparse as a lidar's
        values = np.array(Image.open(path))
        Image.fromarray(np.where(rng.random(values.shape) < 0.1, values, 0).astype(np.uint16)).save(path)
    out = tmp_path / "out"
    code, _, _ = cli(
        "benchmark", "kitti", "--root", tmp_path, "--out", out, "--video", KITTI, "--protocol", "metric",
        "--protocol", "sim3", *OPTIONS,
    )  # fmt: skip
    assert code == 0
    depth = rows_of(out, "depth-metric")
    expected = relative_error(out / "runs" / "fast" / KITTI, sorted(folder.iterdir()), 256.0)
    assert float(depth["fast"]["AbsRel"]) == pytest.approx(expected, rel=1e-5)
    assert float(depth["fast"]["AbsRel"]) < min(0.06, float(depth["depth cue"]["AbsRel"]))
    assert not (out / "tables" / "poses-sim3.csv").exists()  # of which KITTI's depth has no truth


def test_davis_takes_its_own_masks_and_scores_depth_against_itself(cli: Run, tmp_path: Path) -> None:
    from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

    sequence = make_synthetic_sequence(
        SyntheticSceneConfig(
            num_frames=7, width=80, height=60, focal=75.0, grid_columns=14, grid_rows=10, query_interval=4,
            margin_px=3.0,
        )
    )  # fmt: skip
    truth = sequence.ground_truth
    assert truth.masks is not None
    assert truth.world_T_cam is not None
    for kind in ("JPEGImages", "Annotations"):
        (tmp_path / kind / "480p" / "bear").mkdir(parents=True)
    for t, (image, mask) in enumerate(zip(sequence.images, truth.masks, strict=True)):
        Image.fromarray(image).save(tmp_path / "JPEGImages" / "480p" / "bear" / f"{t:05d}.jpg", quality=95)
        labels = Image.fromarray(mask.astype(np.uint8), "P")
        labels.putpalette(bytes(range(256)) * 3)
        labels.save(tmp_path / "Annotations" / "480p" / "bear" / f"{t:05d}.png")
    write_native(replace(sequence, masks=truth.masks), tmp_path / "cues" / "bear")
    for path in (tmp_path / "cues" / "bear" / "masks").iterdir():
        path.unlink()  # DAVIS brings them
    (tmp_path / "cues" / "bear" / "masks").rmdir()
    grid = tmp_path / "grid.yaml"
    grid.write_text(
        f"base: {{preset: fast, set: [{', '.join(CONFIG)}]}}\nrows: {{true masks: {{masks: 'true'}}, none: {{}}}}\n"
    )
    code, _, _ = cli(
        "benchmark", "davis", "--root", tmp_path, "--out", tmp_path / "out", "--grid", grid, "--no-pictures", "--quiet",
        "--workers", 1,
    )  # fmt: skip
    assert code == 0
    rows = rows_of(tmp_path / "out", "consistency")
    scores = {
        name: json.loads((tmp_path / "out" / "results" / name / "bear.json").read_text())["scores"]
        for name in ("true masks", "none")
    }
    assert [scores[name]["consistency"]["masks"] for name in scores] == ["by true masks", "all, without masks"]
    for name, score in scores.items():
        assert float(rows[name]["SC"]) == score["consistency"]["mean"]
        assert set(score) == {"consistency", "depth_cue", "stages"}  # nothing else has truth
    assert scores["true masks"]["consistency"]["pixels"] < scores["none"]["consistency"]["pixels"]
    assert float(rows["true masks"]["SC"]) < min(0.02, float(rows["depth cue"]["SC"]))
    poses = load_reconstruction(tmp_path / "out" / "runs" / "true masks" / "bear" / "reconstruction.npz").world_T_cam
    assert aligned_error(poses[:, :3, 3], truth.world_T_cam[:, :3, 3]) < 0.01


def test_known_intrinsics_of_a_zoom_are_held_at_their_mean(tmp_path: Path) -> None:
    synthesize(tmp_path, "sintel", "alley_2")
    for t, path in enumerate(sorted((tmp_path / "training" / "camdata_left" / "alley_2").iterdir())):
        matrix, pose = read_cam(path)
        matrix[0, 0] = matrix[1, 1] = 75.0 + 5.0 * (t - 3)
        write_cam(path, matrix, pose)
    prepared = prepare(sintel_task(tmp_path, tmp_path / "out", intrinsics="known"))
    assert prepared.config.input.intrinsics == "fixed"
    np.testing.assert_allclose(prepared.sequence.intrinsics[:2], 75.0)
