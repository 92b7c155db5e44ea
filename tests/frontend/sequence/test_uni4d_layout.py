"""Uni4D's preprocessed layout: what its preprocessing writes, choices, encodings, round trip."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sequence_samples import (
    FRAMES,
    HEIGHT,
    TRACKS,
    WIDTH,
    native_folder,
    rewrite_npz,
    sample_sequence,
    uni4d_folder,
    write_image,
)

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.sequence.decode import read_image
from uni4d_fg.frontend.sequence.read import detect_layout, read_sequence
from uni4d_fg.frontend.sequence.uni4d_layout import is_uni4d_layout, read_uni4d
from uni4d_fg.frontend.sequence.validate import validate_sequence


@pytest.mark.parametrize("ids", [(0, 1, 2), (0, 300, 256**3 - 1)])
@pytest.mark.parametrize("far", [False, True])
def test_round_trip(tmp_path: Path, ids: tuple[int, ...], far: bool) -> None:
    written = sample_sequence(3, far=far, ids=ids)
    root = uni4d_folder(tmp_path, seed=3, far=far, ids=ids)
    read = read_sequence(root)
    np.testing.assert_array_equal(np.stack(list(read.images)), np.stack(list(written.images)))
    np.testing.assert_array_equal(np.stack(list(read.depths)), np.stack(list(written.depths)))
    np.testing.assert_array_equal(np.stack(list(read.masks)), np.stack(list(written.masks)))
    np.testing.assert_array_equal(read.intrinsics, written.intrinsics)
    np.testing.assert_array_equal(read.ground_truth.intrinsics, written.ground_truth.intrinsics)
    np.testing.assert_allclose(read.ground_truth.world_T_cam, written.ground_truth.world_T_cam, atol=1e-12)
    assert read.tracks is not None
    assert written.tracks is not None
    np.testing.assert_array_equal(read.tracks.uv, written.tracks.uv)
    np.testing.assert_array_equal(read.tracks.visible, written.tracks.visible)
    np.testing.assert_array_equal(read.tracks.query_frame, written.tracks.query_frame)
    np.testing.assert_array_equal(read.tracks.confidence, written.tracks.confidence)
    truth = read.ground_truth.depths
    assert truth is not None
    assert written.ground_truth.depths is not None
    np.testing.assert_array_equal(np.stack(list(truth)), np.stack(list(written.ground_truth.depths)))
    assert validate_sequence(root).ok


@pytest.mark.parametrize(("num_tracks", "frames"), [(0, 3), (1, 2)])
def test_few_tracks_and_frames(tmp_path: Path, num_tracks: int, frames: int) -> None:
    root = uni4d_folder(tmp_path, num_tracks=num_tracks, frames=frames)
    tracks = read_uni4d(root).tracks
    assert tracks is not None
    assert (tracks.num_tracks, tracks.num_frames) == (num_tracks, frames)
    assert validate_sequence(root).ok


def test_files_are_those_uni4d_reads(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    depth = np.load(root / "unidepth" / "depth.npy")
    assert (depth.shape, depth.dtype) == ((FRAMES, 1, HEIGHT, WIDTH), np.float32)
    assert depth[0, 0, 0, 0] == 0
    assert np.isfinite(depth).all()
    assert np.load(root / "K.npy").shape == (FRAMES, 3, 3)
    assert np.load(root / "unidepth" / "intrinsics.npy").shape == (3, 3)
    masks = sorted((root / "deva" / "Annotations").iterdir())
    label = read_image(masks[0]).astype(int)
    np.testing.assert_array_equal(label @ [1, 256, 65536], sample_sequence().masks[0])
    with np.load(root / "cotrackerv3_10_50" / "results.npz") as results:
        assert sorted(results) == [
            "all_confidences",
            "all_tracks",
            "all_visibilities",
            "init_frames",
            "orig_shape",
        ]
        assert (results["all_tracks"].shape, results["all_tracks"].dtype) == ((FRAMES, TRACKS, 2), np.float64)
        assert set(np.unique(results["all_visibilities"])) <= {0.0, 1.0}
        assert np.isfinite(results["all_tracks"]).all()
        np.testing.assert_array_equal(results["orig_shape"], [HEIGHT, WIDTH])
        tracks = sample_sequence().tracks
        assert tracks is not None
        track, frame = np.argwhere(~tracks.visible)[0]
        last = np.flatnonzero(tracks.visible[track, :frame])[-1]
        np.testing.assert_array_equal(results["all_tracks"][frame, track], tracks.uv[track, last])


def test_candidates(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    shutil.copytree(root / "unidepth", root / "unidepth_gt_K")
    np.save(root / "unidepth_gt_K" / "intrinsics.npy", np.tile(np.diag([30.0, 30.0, 1.0]), (FRAMES, 1, 1)))
    shutil.copytree(root / "deva", root / "custom_segmentation")
    shutil.copytree(root / "cotrackerv3_10_50", root / "cotrackerv3_10_75")
    with pytest.raises(InputError, match="more than one depth folder: unidepth, unidepth_gt_K; choose"):
        read_uni4d(root)
    with pytest.raises(InputError, match="more than one mask folder: custom_segmentation, deva; choose"):
        read_uni4d(root, depth="unidepth")
    with pytest.raises(InputError, match="more than one track folder: cotrackerv3_10_50, cotrackerv3_10_75"):
        read_uni4d(root, depth="unidepth", masks="deva")
    chosen = read_sequence(root, depth="unidepth_gt_K", masks="deva", tracks="cotrackerv3_10_75")
    assert chosen.intrinsics[0] == 30
    with pytest.raises(InputError, match=r"nothing: has no depth\.npy; choose another depth folder"):
        read_uni4d(root, depth="nothing", masks="deva", tracks="cotrackerv3_10_50")
    messages = [f.message for f in validate_sequence(root).of("error")]
    assert [m.split(":")[1].strip() for m in messages] == [
        "has more than one depth folder",
        "has more than one mask folder",
        "has more than one track folder",
    ]


def test_intrinsics_choices(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    np.testing.assert_array_equal(read_uni4d(root).intrinsics, [20, 20.5, 7.5, 5.5])
    np.testing.assert_array_equal(read_uni4d(root, known_intrinsics=True).intrinsics, [21, 21, 7, 5])
    (root / "unidepth" / "intrinsics.npy").unlink()
    np.testing.assert_array_equal(read_uni4d(root).intrinsics, [21, 21, 7, 5])
    (root / "K.npy").unlink()
    np.testing.assert_array_equal(read_uni4d(root).intrinsics, [16, 16, 7.5, 5.5])
    with pytest.raises(InputError, match=r"has no K\.npy, but known intrinsics are asked for"):
        read_uni4d(root, known_intrinsics=True)


def test_true_zoom_is_reported_but_does_not_block(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    matrices = np.load(root / "K.npy")
    matrices[:, 0, 0] *= [1.0, 1.1, 1.2, 1.3]
    np.save(root / "K.npy", matrices)
    assert read_uni4d(root).ground_truth.intrinsics is None
    report = validate_sequence(root)
    assert report.ok
    assert any(f.item == "true intrinsics" for f in report.of("warning"))


@pytest.mark.parametrize(("scale", "value"), [(1000.0, 2560), (256.0, 655), (5000.0, 12800)])
def test_true_depth_encodings(tmp_path: Path, scale: float, value: int) -> None:
    root = uni4d_folder(tmp_path)
    for path in list((root / "depth_gt").iterdir()):
        path.unlink()
        write_image(path.with_suffix(".png"), np.full((HEIGHT, WIDTH), value, np.uint16))
    depths = read_uni4d(root, depth_gt_scale=scale).ground_truth.depths
    assert depths is not None
    np.testing.assert_allclose(depths[2], 2.56, atol=2e-3)
    with pytest.raises(InputError, match="is not positive"):
        read_uni4d(root, depth_gt_scale=0.0)


def test_without_masks_tracks_and_truth(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    for name in ("deva", "cotrackerv3_10_50", "depth_gt"):
        shutil.rmtree(root / name)
    (root / "c2w.npy").unlink()
    read = read_uni4d(root)
    assert not read.masks[1].any()
    assert read.tracks is None
    assert read.ground_truth.depths is None
    assert read.ground_truth.world_T_cam is None


def test_filtered_results(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    folder = root / "cotrackerv3_10_50"
    with np.load(folder / "results.npz") as results:
        np.savez(
            folder / "filtered_results.npz",
            tracks=results["all_tracks"],
            vis=results["all_visibilities"] == 1,
            labels=np.zeros(TRACKS, int),
        )
    full = read_uni4d(root).tracks
    (folder / "results.npz").unlink()
    filtered = read_uni4d(root).tracks
    assert full is not None
    assert filtered is not None
    np.testing.assert_array_equal(filtered.uv, full.uv)
    np.testing.assert_array_equal(filtered.query_frame, full.visible.argmax(axis=1))
    assert filtered.confidence is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"all_tracks": None}, "lacks 'all_tracks'"),
        ({"all_tracks": np.zeros((TRACKS, FRAMES, 2))}, r"uv has shape \(4, 5, 2\) but visible has \(5, 4\)"),
        ({"all_visibilities": np.full((FRAMES, TRACKS), 0.7)}, "values other than 0 and 1"),
        ({"orig_shape": np.array([384, 512])}, "made on images of 512 x 384 px, but these have 16 x 12 px"),
        ({"init_frames": np.array([0.5] * TRACKS)}, "not frames 0 to 3"),
    ],
)
def test_damaged_tracks(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    root = uni4d_folder(tmp_path)
    rewrite_npz(root / "cotrackerv3_10_50" / "results.npz", **changes)
    with pytest.raises(InputError, match=message):
        read_uni4d(root)
    assert not validate_sequence(root).ok


def test_visible_means_one_and_inside(tmp_path: Path) -> None:
    root = uni4d_folder(tmp_path)
    tracks = np.full((FRAMES, TRACKS, 2), 3.0)
    tracks[1, 0] = (WIDTH + 0.5, 3)
    tracks[2, 1] = (np.nan, 3)
    visible = np.ones((FRAMES, TRACKS))
    visible[2, 1] = 0
    rewrite_npz(root / "cotrackerv3_10_50" / "results.npz", all_tracks=tracks, all_visibilities=visible)
    read = read_uni4d(root).tracks
    assert read is not None
    expected = np.ones((TRACKS, FRAMES), bool)
    expected[0, 1] = expected[1, 2] = False
    np.testing.assert_array_equal(read.visible, expected)


def test_layout_detection(tmp_path: Path) -> None:
    uni4d = uni4d_folder(tmp_path / "u")
    native = native_folder(tmp_path / "n")
    assert (detect_layout(uni4d), detect_layout(native)) == ("uni4d", "native")
    assert not is_uni4d_layout(native)
    with pytest.raises(InputError, match=r"is not a sequence folder: there is no rgb/ and no video"):
        detect_layout(tmp_path)
    shutil.copytree(uni4d / "unidepth", native / "unidepth")
    with pytest.raises(InputError, match="holds both the native and Uni4D's layout; choose layout"):
        read_sequence(native)
    assert read_sequence(native, "native").tracks is not None
    assert read_sequence(native, "uni4d").tracks is None
    assert read_sequence(native, depth="depth_gt").tracks is not None
    with pytest.raises(InputError, match="unknown layout 'other'"):
        read_sequence(native, "other")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="Uni4D's layout only"):
        read_sequence(native, "native", masks="deva")
    shutil.rmtree(native / "unidepth")
    shutil.rmtree(native / "depth_cue")
    with pytest.raises(InputError, match="has no depth: neither depth_cue/"):
        read_sequence(native)
