"""Scores of the literature against computations of their own: evo, NumPy's solver, PyTorch's Adam, plain loops."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.results.evaluate.protocols.consistency import score_consistency
from uni4d_fg.results.evaluate.protocols.depth import (
    DEPTH_PROTOCOLS,
    DepthScore,
    average_depth,
    score_depth,
)
from uni4d_fg.results.evaluate.protocols.fits import adam_absolute, lower_median
from uni4d_fg.results.evaluate.protocols.pose import POSE_PROTOCOLS, score_poses
from uni4d_fg.results.evaluate.protocols.tracks3d import THRESHOLDS_PX, score_tracks

CASES = 100


def random_video(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Truth (T, H, W) with holes and far pixels, a biased noisy prediction of it, masks."""
    shape = (int(rng.integers(2, 5)), int(rng.integers(4, 9)), int(rng.integers(4, 9)))
    truth = np.exp(rng.uniform(np.log(0.3), np.log(rng.choice([9.0, 120.0])), shape)).astype(np.float32)
    disparity = rng.uniform(0.3, 2.0) / truth + rng.uniform(-0.05, 0.3)
    prediction = np.abs(1.0 / disparity * np.exp(rng.normal(scale=0.2, size=shape))).astype(np.float32)
    truth[rng.random(shape) < 0.15] = np.nan
    return truth, prediction, rng.integers(0, 2, shape).astype(np.int32)


def reference_scores(
    name: str, dataset: str, truth: np.ndarray, prediction: np.ndarray, regions: dict[str, np.ndarray]
) -> dict[str, tuple[float, float]]:
    """AbsRel and delta of every region by the description of each program, on whole arrays."""
    caps = {"sintel": (70.0, 70.0), "bonn": (70.0, None), "kitti": (None, None), "native": (70.0, 70.0)}[dataset]
    if name.startswith("uni4d"):
        caps = (70.0, 70.0)
    low = 0.0
    if name.startswith("depthcrafter"):
        cap = {"sintel": 70.0, "bonn": 10.0, "kitti": 80.0, "native": 70.0}[dataset]
        caps, low = (cap, cap), 1e-3
    gt = np.nan_to_num(truth.astype(np.float64), nan=-1.0)
    mask = (gt > low) & (gt < (np.inf if caps[0] is None else caps[0]))
    g = gt[mask]
    if name == "metric":
        p = prediction[mask].astype(np.float64)
    elif name.startswith("monst3r") or name.startswith("cut3r"):
        p = prediction[mask].astype(np.float64)
        if name == "monst3r-scale":
            p = p * (np.sort(g)[(len(g) - 1) // 2] / np.sort(p)[(len(p) - 1) // 2])
        elif name == "cut3r-scale":
            s = g.mean() / p.mean()
            for _ in range(10):
                w = 1.0 / (np.abs(s * p - g) + 1e-8)
                s = np.sum(w * p * g) / np.sum(w * p**2)
            p = p * max(s, 1e-3)
        else:
            s, t = plain_adam(p, g, 1000)
            p = s * p + t
    else:
        d = (np.float32(1.0) / prediction)[mask].astype(np.float64)
        wanted = 1.0 / (g + 1e-8)
        if name == "uni4d-scale":
            d = d * (np.sort(wanted)[(len(g) - 1) // 2] / np.sort(d)[(len(g) - 1) // 2])
        else:
            d = np.maximum(d, 1e-3) if low else d
            (s, t), *_ = np.linalg.lstsq(np.stack((d, np.ones_like(d)), axis=1), wanted, rcond=None)
            d = s * d + t
        if low:
            d = np.maximum(d, 1e-3)
        p = np.array([1.0 / x if x > 0 else 0.0 for x in d])
    if low:
        p = np.maximum(p, 1e-3)
    if caps[1] is not None:
        p = np.minimum(p, caps[1])
    error = np.abs(p - g) / g
    p = np.maximum(p, 1e-5)
    inlier = (np.maximum(p / g, g / p) < 1.25).astype(float)
    found = {}
    for region, chosen in regions.items():
        keep, frame = chosen[mask], np.nonzero(mask)[0]
        parts = [keep & (frame == f) for f in np.unique(frame[keep])] if low else [keep]
        found[region] = tuple(float(np.mean([v[part].mean() for part in parts])) for v in (error, inlier))
    return found  # type: ignore[return-value]


def plain_adam(x: np.ndarray, y: np.ndarray, iterations: int) -> tuple[float, float]:
    """Adam (Kingma and Ba 2015, algorithm 1) on the sum of absolute deviations, all pixels in every step."""
    s, t = float(np.sort(y)[(len(y) - 1) // 2] / np.sort(x)[(len(x) - 1) // 2]), 0.0
    m_s = m_t = v_s = v_t = 0.0
    before = None
    for step in range(1, iterations + 1):
        residual = s * x + t - y
        g_s, g_t = float(np.sum(np.sign(residual) * x)), float(np.sum(np.sign(residual)))
        m_s, m_t = 0.9 * m_s + 0.1 * g_s, 0.9 * m_t + 0.1 * g_t
        v_s, v_t = 0.999 * v_s + 0.001 * g_s**2, 0.999 * v_t + 0.001 * g_t**2
        first, second = 1.0 - 0.9**step, 1.0 - 0.999**step
        s -= 1e-4 * (m_s / first) / (np.sqrt(v_s / second) + 1e-8)
        t -= 1e-4 * (m_t / first) / (np.sqrt(v_t / second) + 1e-8)
        loss = float(np.abs(residual).sum())
        if before is not None and abs(before - loss) < 1e-6:
            break
        before = loss
    return s, t


def torch_adam(x: np.ndarray, y: np.ndarray, iterations: int) -> tuple[float, float]:
    torch = pytest.importorskip("torch")
    p, g = torch.from_numpy(x), torch.from_numpy(y)
    s = torch.tensor([(torch.median(g) / torch.median(p)).item()], dtype=torch.float64, requires_grad=True)
    t = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    optimizer, before = torch.optim.Adam([s, t], lr=1e-4), None
    for _ in range(iterations):
        optimizer.zero_grad()
        loss = (s * p + t - g).abs().sum()
        loss.backward()
        optimizer.step()
        if before is not None and abs(before - loss.item()) < 1e-6:
            break
        before = loss.item()
    return s.item(), t.item()


@pytest.mark.parametrize("name", DEPTH_PROTOCOLS)
def test_depth_scores_equal_the_programs_descriptions(name: str, rng: np.random.Generator) -> None:
    protocol = DEPTH_PROTOCOLS[name]
    for case in range(CASES):
        dataset = ("sintel", "bonn", "kitti", "native")[case % 4]
        truth, prediction, masks = random_video(rng)
        found = score_depth(protocol, dataset, ArrayFrames(prediction), ArrayFrames(truth), ArrayFrames(masks))
        regions = {"all": masks >= 0, "static": masks == 0, "moving": masks > 0}
        for region, expected in reference_scores(name, dataset, truth, prediction, regions).items():
            score = found.regions[region]
            assert (score.abs_rel, score.delta_125) == pytest.approx(expected, rel=1e-6, abs=1e-6), (case, region)


def test_absolute_deviations_by_adam_equal_torch(rng: np.random.Generator) -> None:
    pytest.importorskip("torch")
    for case in range(CASES):
        y = rng.uniform(0.5, 20.0, 150)
        x = np.abs(0.5 * y + rng.normal(scale=0.5, size=150)) + 0.1
        iterations = 120 if case < 2 else 14
        line = adam_absolute(x, y, iterations=iterations)
        assert (line.scale, line.shift) == pytest.approx(torch_adam(x, y, iterations), rel=1e-6, abs=1e-6)
        assert (line.scale, line.shift) == pytest.approx(plain_adam(x, y, iterations), rel=1e-6, abs=1e-6)


def test_the_program_of_monst3r_leaves_scale_and_shift_near_its_start(rng: np.random.Generator) -> None:
    y = rng.uniform(1.0, 9.0, 500)
    line = adam_absolute(y - 2.0, y)
    assert abs(line.shift) < 0.32  # the least absolute deviations are at a shift of 2


def test_the_median_is_the_lower_one() -> None:
    assert lower_median(np.array([4.0, 1.0, 3.0, 2.0])) == 2.0


def test_a_negative_disparity_is_a_depth_of_zero_for_some_and_far_for_others() -> None:
    truth = np.linspace(1.0, 30.0, 64, dtype=np.float32).reshape(1, 8, 8)
    prediction = 1.0 / (1.0 / truth - 0.02)
    prediction[0, 7, 7] = 1e6
    frames = ArrayFrames(truth), ArrayFrames(prediction.astype(np.float32))
    uni4d = score_depth(DEPTH_PROTOCOLS["uni4d-scale-shift"], "sintel", frames[1], frames[0])
    crafter = score_depth(DEPTH_PROTOCOLS["depthcrafter-scale-shift"], "sintel", frames[1], frames[0])
    assert uni4d.regions["all"].abs_rel != crafter.regions["all"].abs_rel
    assert "clipped to 70 m" in uni4d.text
    assert "mean over frames" in crafter.text


def test_a_smaller_prediction_is_resized_and_a_missing_pixel_counted() -> None:
    truth = np.full((2, 8, 10), 3.0, np.float32)
    prediction = np.full((2, 4, 5), 1.5, np.float32)
    score = score_depth(DEPTH_PROTOCOLS["monst3r-scale"], "sintel", ArrayFrames(prediction), ArrayFrames(truth))
    assert (score.scale, score.regions["all"].abs_rel) == pytest.approx((2.0, 0.0))
    prediction[0, 0, 0] = np.nan
    score = score_depth(DEPTH_PROTOCOLS["monst3r-scale"], "sintel", ArrayFrames(prediction), ArrayFrames(truth))
    assert (score.regions["all"].missing, score.regions["all"].pixels) == (4, 156)


def test_averages_over_videos_are_weighted_as_the_protocol_says() -> None:
    scores = [DepthScore(0.1, 0.9, 100, 0), DepthScore(0.4, 0.5, 300, 0), DepthScore(None, None, 0, 5)]
    assert average_depth(DEPTH_PROTOCOLS["uni4d-scale"], scores) == pytest.approx((0.325, 0.6))
    assert average_depth(DEPTH_PROTOCOLS["depthcrafter-scale-shift"], scores) == pytest.approx((0.25, 0.7))
    assert average_depth(DEPTH_PROTOCOLS["metric"], []) == (None, None)


def random_path(rng: np.random.Generator, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.1, size=(count, 3)), axis=0)).as_matrix()
    poses[:, :3, 3] = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    return poses


@pytest.mark.parametrize("name", POSE_PROTOCOLS)
def test_pose_scores_equal_evo(name: str, rng: np.random.Generator) -> None:
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    protocol = POSE_PROTOCOLS[name]
    for _ in range(CASES):
        count = int(rng.integers(4, 30))
        truth, times = random_path(rng, count), np.arange(count, dtype=np.float64)
        noisy = random_path(rng, count)
        estimate = truth.copy()
        estimate[:, :3, 3] = 0.4 * estimate[:, :3, 3] + 0.1 * noisy[:, :3, 3]
        estimate[:, :3, :3] = estimate[:, :3, :3] @ noisy[:, :3, :3]
        reference = PoseTrajectory3D(poses_se3=list(truth.copy()), timestamps=times)
        if protocol.unit_path:
            reference.scale(1.0 / reference.path_length)
        aligned = copy.deepcopy(PoseTrajectory3D(poses_se3=list(estimate), timestamps=times))
        aligned.align(reference, correct_scale=protocol.alignment == "sim3")
        expected = []
        for metric in (
            metrics.APE(metrics.PoseRelation.translation_part),
            metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames, all_pairs=True),
            metrics.RPE(metrics.PoseRelation.rotation_angle_deg, 1, metrics.Unit.frames, all_pairs=True),
        ):
            metric.process_data((reference, aligned))
            expected.append(metric.get_statistic(metrics.StatisticsType.rmse))
        score = score_poses(protocol, estimate, truth)
        assert score is not None
        found = (score.ate, score.rpe_translation, score.rpe_rotation_deg)
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_frames_without_a_pose_are_counted(rng: np.random.Generator) -> None:
    truth = random_path(rng, 6)
    estimate = truth.copy()
    estimate[2] = np.nan
    score = score_poses(POSE_PROTOCOLS["sim3"], estimate, truth)
    assert score is not None
    assert (score.poses, score.missing) == (5, 1)
    assert score.ate == pytest.approx(0.0, abs=1e-9)
    estimate[1:] = np.nan
    assert score_poses(POSE_PROTOCOLS["sim3"], estimate, truth) is None


def test_track_scores_equal_plain_loops(rng: np.random.Generator) -> None:
    for case in range(CASES):
        tracks, frames = int(rng.integers(3, 8)), int(rng.integers(2, 6))
        truth = rng.normal(size=(tracks, frames, 3)) + np.array([0.0, 0.0, 5.0])
        estimate = 0.5 * truth + rng.normal(scale=0.02, size=truth.shape)
        seen, guessed = rng.random((tracks, frames)) < 0.7, rng.random((tracks, frames)) < 0.7
        seen[0, 0] = guessed[0, 0] = True
        intrinsics = np.array([90.0, 110.0, 40.0, 30.0])
        score = score_tracks(estimate, guessed, truth, seen, intrinsics, "median" if case % 2 else "mean")
        assert score is not None
        reduce = np.median if case % 2 else np.mean
        both = seen & guessed
        scale = reduce([np.linalg.norm(p) for p in truth[both]]) / reduce([np.linalg.norm(p) for p in estimate[both]])
        jaccard, within = [], []
        for threshold in THRESHOLDS_PX:
            tp = fp = hit = 0
            for k in range(tracks):
                for t in range(frames):
                    limit = threshold * truth[k, t, 2] / np.sqrt(90.0 * 110.0)
                    near = bool(np.linalg.norm(scale * estimate[k, t] - truth[k, t]) < limit)
                    hit += near and seen[k, t]
                    tp += near and seen[k, t] and guessed[k, t]
                    fp += guessed[k, t] and not (near and seen[k, t])
            jaccard.append(tp / (seen.sum() + fp))
            within.append(hit / seen.sum())
        found = (score.average_jaccard, score.points_within, score.occlusion_accuracy)
        expected = (np.mean(jaccard), np.mean(within), np.mean(seen == guessed))
        assert found == pytest.approx(expected, rel=1e-6)


def consistency_by_loops(
    depths: np.ndarray, masks: np.ndarray, poses: np.ndarray, cameras: np.ndarray, distance: int, occlusion: float
) -> list[float]:
    """Every static pixel with depth by itself: lifted, moved into the other frame, compared with the pixel there."""
    errors = []
    height, width = depths.shape[1:]
    for t in range(len(depths) - distance):
        fx, fy, cx, cy = cameras[t]
        gx, gy, dx, dy = cameras[t + distance]
        there_T_here = np.linalg.inv(poses[t + distance]) @ poses[t]
        for v in range(height):
            for u in range(width):
                z = depths[t, v, u]
                if not (np.isfinite(z) and z > 0.0) or masks[t, v, u] != 0:
                    continue
                x, y, other, _ = there_T_here @ (z * (u - cx) / fx, z * (v - cy) / fy, z, 1.0)
                if other <= 1e-6:
                    continue
                column, row = round(gx * x / other + dx), round(gy * y / other + dy)
                if not (0 <= column < width and 0 <= row < height) or masks[t + distance, row, column] != 0:
                    continue
                own = depths[t + distance, row, column]
                if np.isfinite(own) and own > 0.0 and other / own - 1.0 <= occlusion:
                    errors.append(abs(other / own - 1.0))
    return errors


def test_self_consistency_equals_plain_loops(rng: np.random.Generator) -> None:
    compared = 0
    for case in range(CASES):
        count, height, width = int(rng.integers(2, 5)), int(rng.integers(9, 15)), int(rng.integers(9, 15))
        poses = np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.05, size=(count, 3))).as_matrix()
        poses[:, :3, 3] = rng.normal(scale=0.2, size=(count, 3))
        depths = rng.uniform(1.5, 2.5, (count, height, width)).astype(np.float32)
        holes = rng.random(depths.shape)
        for value, below in ((np.nan, 0.15), (0.0, 0.1), (-1.0, 0.05)):
            depths[holes < below] = value
        masks = (rng.random(depths.shape) < 0.2).astype(np.int32) * 3
        intrinsics = np.array([9.0, 10.0, width / 2, height / 2]) * np.exp(rng.normal(scale=0.05, size=(count, 4)))
        log_scale = rng.normal(scale=0.05, size=count)
        distance, occlusion = 1 + case % min(2, count - 1), (0.25, 0.1)[case % 2]
        cameras = intrinsics[0] if case % 3 == 0 else intrinsics  # one camera, or one that zooms
        scaled = depths if case % 4 == 0 else depths * np.exp(log_scale)[:, None, None]
        expected = consistency_by_loops(
            np.asarray(scaled, np.float64), masks, poses, np.broadcast_to(cameras, (count, 4)), distance, occlusion
        )
        score = score_consistency(
            ArrayFrames(depths), ArrayFrames(masks), poses, cameras, distance=distance, occlusion=occlusion,
            log_scale=None if case % 4 == 0 else log_scale,
        )  # fmt: skip
        if not expected:  # nothing is seen twice
            assert score is None
            continue
        assert score is not None
        assert score.pixels == len(expected)
        below = [float(np.mean([error < limit for error in expected])) for limit in (0.01, 0.05)]
        found = score.mean, score.below_1, score.below_5
        assert found == pytest.approx((np.mean(expected), *below), rel=1e-6, abs=1e-6), case
        compared += len(expected)
    assert compared > 50 * CASES


def test_depth_of_a_plane_is_consistent_and_flicker_is_not(rng: np.random.Generator) -> None:
    intrinsics, size, count = np.array([60.0, 60.0, 31.5, 23.5]), (48, 64), 4
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.cumsum(rng.normal(scale=0.03, size=(count, 3)), axis=0)
    depths = np.stack([np.full(size, 4.0 - pose[2, 3], np.float32) for pose in poses])
    masks = np.zeros((count, *size), np.int32)
    exact = score_consistency(ArrayFrames(depths), ArrayFrames(masks), poses, intrinsics)
    assert exact is not None
    assert exact.mean < 1e-6
    assert (exact.below_1, exact.below_5) == (1.0, 1.0)
    flicker = depths * np.array([1.0, 1.03, 1.0, 1.03], np.float32)[:, None, None]
    score = score_consistency(ArrayFrames(flicker), ArrayFrames(masks), poses, intrinsics)
    assert score is not None
    assert score.mean == pytest.approx((0.03 / 1.03 * 2 + 0.03) / 3, rel=0.02)
    assert score.below_1 == 0.0
    masks[:, :, :32] = 1
    flicker[:, :, :30] *= 2.0
    half = score_consistency(ArrayFrames(flicker), ArrayFrames(masks), poses, intrinsics)
    assert half is not None
    assert half.mean == pytest.approx(score.mean, rel=0.02)


def test_every_protocol_says_what_it_does() -> None:
    texts = {DEPTH_PROTOCOLS[name].text("sintel") for name in DEPTH_PROTOCOLS}
    assert len(texts) == len(DEPTH_PROTOCOLS)
    assert len({protocol.text for protocol in POSE_PROTOCOLS.values()}) == len(POSE_PROTOCOLS)
