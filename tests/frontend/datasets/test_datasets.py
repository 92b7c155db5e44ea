"""Every dataset gives back what was written in its layout; every damage ends in an error that says what and where."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import miniatures
import numpy as np
import pytest

from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.frontend.datasets import synthetic
from uni4d_fg.frontend.datasets.base import Dataset
from uni4d_fg.frontend.datasets.registry import DATASETS, find_dataset
from uni4d_fg.frontend.datasets.sintel import DEPTH_VIDEOS, POSE_VIDEOS
from uni4d_fg.frontend.datasets.tum_files import associate
from uni4d_fg.frontend.sequence.model import Video

MAKERS: dict[str, tuple[Callable[[Path], miniatures.Truth], str]] = {
    "sintel": (miniatures.sintel, "alley_2"),
    "sintel-clean": (miniatures.sintel, "alley_2"),
    "tum-dynamics": (miniatures.tum, "walking_xyz"),
    "bonn": (miniatures.bonn, "balloon2"),
    "bonn-associated": (miniatures.bonn, "balloon2"),
    "kitti": (miniatures.kitti, "2011_09_26_drive_0002_sync"),
}
PRECISION = {"sintel": 0.0, "sintel-clean": 0.0, "kitti": 0.5 / 256}


@pytest.mark.parametrize("name", MAKERS)
def test_a_dataset_gives_back_what_was_written(name: str, tmp_path: Path) -> None:
    make, title = MAKERS[name]
    truth, dataset = make(tmp_path), find_dataset(name)
    assert title in dataset.videos(tmp_path)
    assert dataset.found(tmp_path) == (title,)
    video = dataset.open(tmp_path, title)
    assert video.name == title
    assert list(video.frame_names) == truth.names
    np.testing.assert_allclose(np.diff(video.timestamps), np.diff(truth.times), atol=2e-6 if "tum" in name else 1e-2)
    images = 255 - truth.images if name == "sintel-clean" else truth.images
    np.testing.assert_array_equal(np.stack(list(video.images)), images)
    assert video.ground_truth.depths is not None
    found = np.stack(list(video.ground_truth.depths))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(truth.depths))
    known = np.isfinite(truth.depths)
    precision = PRECISION.get(name, 0.5 / 5000)
    assert np.abs(found - truth.depths)[known].max() <= precision * 1.001 + 1e-6 * (precision > 0)
    if name != "kitti":
        assert video.ground_truth.world_T_cam is not None
        np.testing.assert_allclose(video.ground_truth.world_T_cam, truth.poses, atol=1e-6)
    assert video.depths is None
    assert video.intrinsics is None
    assert video.ground_truth.intrinsics is not None
    if name.startswith(("sintel", "kitti")):
        np.testing.assert_allclose(video.ground_truth.intrinsics, truth.intrinsics)
    assert dataset.notes(tmp_path, title) == ()


def test_sintel_has_the_published_splits() -> None:
    assert (len(POSE_VIDEOS), len(DEPTH_VIDEOS)) == (14, 23)
    assert set(POSE_VIDEOS) < set(DEPTH_VIDEOS)
    assert len(DATASETS["kitti"].card.splits["depth"] or ()) == 13
    assert len(DATASETS["bonn"].card.splits["five"] or ()) == 5
    assert len(DATASETS["tum-dynamics"].card.splits["pose"] or ()) == 8


def test_masks_that_were_derived_for_sintel_are_true_masks(tmp_path: Path) -> None:
    truth = miniatures.sintel(tmp_path)
    masks = find_dataset("sintel").open(tmp_path, "alley_2").ground_truth.masks
    assert masks is not None
    np.testing.assert_array_equal(np.stack(list(masks))[:5], truth.masks[:5] > 0)


def test_a_zoom_of_sintel_has_the_mean_of_its_cameras_and_a_note(tmp_path: Path) -> None:
    truth, dataset = miniatures.sintel(tmp_path), find_dataset("sintel")
    fx, fy, cx, cy = truth.intrinsics
    for spread, note in (
        (0.008, ()),
        (0.1, ("the film zooms, with focal lengths from 63 to 77 px: known intrinsics are their mean, 70 px, held for "
               "all frames",)),
    ):  # fmt: skip
        for zoom, name, pose in zip(np.linspace(1 - spread, 1 + spread, 6), truth.names, truth.poses, strict=True):
            matrix = np.array([[zoom * fx, 0, cx], [0, zoom * fy, cy], [0, 0, 1]])
            path = tmp_path / "training" / "camdata_left" / "alley_2" / f"{name}.cam"
            path.write_bytes(miniatures.cam(matrix, pose))
        found = dataset.open(tmp_path, "alley_2").ground_truth.intrinsics
        np.testing.assert_allclose(found, truth.intrinsics, rtol=1e-12)
        assert dataset.notes(tmp_path, "alley_2") == note


def test_davis_has_masks_by_the_index_of_the_palette(tmp_path: Path) -> None:
    truth = miniatures.davis(tmp_path)
    video = find_dataset("davis").open(tmp_path, "bear")
    assert video.ground_truth.masks is not None
    np.testing.assert_array_equal(np.stack(list(video.ground_truth.masks)), truth.masks)
    assert video.ground_truth.world_T_cam is None


def test_tum_takes_every_third_of_the_associated_images(tmp_path: Path) -> None:
    truth = miniatures.tum(tmp_path)
    folder = tmp_path / "rgbd_dataset_freiburg3_walking_xyz"
    poses = (folder / "groundtruth.txt").read_text().splitlines(keepends=True)
    (folder / "groundtruth.txt").write_text("".join(poses[:2] + poses[3:]))  # the first image has no pose now
    video = find_dataset("tum-dynamics").open(tmp_path, "walking_xyz")
    assert truth.names[0] not in video.frame_names
    assert len(video.frame_names) == 5
    assert float(video.frame_names[0]) == pytest.approx(truth.times[0] + 1 / 30, abs=1e-5)


def test_association_is_that_of_the_benchmark(rng: np.random.Generator) -> None:
    first, second = np.sort(rng.uniform(0, 2, 60)), np.sort(rng.uniform(0, 2, 90))
    candidates = sorted(
        (abs(a - b), i, j) for i, a in enumerate(first) for j, b in enumerate(second) if abs(a - b) < 0.02
    )
    expected, used_first, used_second = [], set(), set()
    for _, i, j in candidates:
        if i not in used_first and j not in used_second:
            used_first.add(i)
            used_second.add(j)
            expected.append((i, j))
    assert associate(first, second) == sorted(expected)


def test_bonn_says_where_rows_and_times_disagree(tmp_path: Path) -> None:
    folder = tmp_path / "rgbd_bonn_balloon2"
    truth = miniatures.rgbd(folder, 40, pose_shift=-5 / 30)
    video = find_dataset("bonn").open(tmp_path, "balloon2")
    assert video.ground_truth.world_T_cam is not None
    np.testing.assert_allclose(video.ground_truth.world_T_cam, truth.poses[30:40], atol=1e-6)
    assert "167 ms" in find_dataset("bonn").notes(tmp_path, "balloon2")[0]
    paired = find_dataset("bonn-associated").open(tmp_path, "balloon2")
    assert paired.ground_truth.world_T_cam is not None
    np.testing.assert_allclose(paired.ground_truth.world_T_cam, truth.poses[35:40], atol=1e-6)


def test_an_unknown_dataset_or_split_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="choose one of sintel"):
        find_dataset("cityscapes")
    miniatures.sintel(tmp_path)
    with pytest.raises(InputError, match="no split 'test'"):
        find_dataset("sintel").videos(tmp_path, "test")


@pytest.mark.parametrize("name", [name for name in DATASETS if DATASETS[name].card.urls])
def test_an_empty_folder_says_where_to_get_the_dataset(name: str, tmp_path: Path) -> None:
    dataset = find_dataset(name)
    with pytest.raises(InputError, match=r"holds no video of .*download http"):
        dataset.videos(tmp_path)
    with pytest.raises(InputError, match=r"no such folder; download http"):
        dataset.videos(tmp_path / "absent")


def use(dataset: Dataset, root: Path, video: str) -> Video:
    """Open a video and read all of it."""
    opened = dataset.open(root, video)
    for frames in (opened.images, opened.ground_truth.depths, opened.ground_truth.masks):
        for _ in frames or ():
            pass
    return opened


S, T = "training/{}/alley_2/frame_0002.{}", "rgbd_dataset_freiburg3_walking_xyz/{}"
B = "rgbd_bonn_dataset/rgbd_bonn_balloon2/{}"
KD = "val/2011_09_26_drive_0002_sync/proj_depth/groundtruth/image_02/0000000007.png"
KI = "2011_09_26/2011_09_26_drive_0002_sync/image_02/{}"
D = "DAVIS/{}/480p/bear/00001.{}"


def cut(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


def line(number: int, text: str) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        lines = data.decode().splitlines()
        lines[number] = text
        return ("\n".join(lines) + "\n").encode()

    return change


def other_size(data: bytes) -> bytes:
    return miniatures.dpt(np.ones((10, 12), np.float32))


def eight_bit(data: bytes) -> bytes:
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.full((miniatures.HEIGHT, miniatures.WIDTH), 7, np.uint8)).save(stream, "PNG")
    return stream.getvalue()


def rgb_mask(data: bytes) -> bytes:
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.zeros((miniatures.HEIGHT, miniatures.WIDTH, 3), np.uint8)).save(stream, "PNG")
    return stream.getvalue()


Damage = Callable[[bytes], bytes] | None  # None removes the file or folder

DAMAGES: list[tuple[str, str, Damage, str]] = [
    ("sintel", S.format("depth", "dpt"), None, r"frame_0002.dpt: no such file; download"),
    ("sintel", S.format("depth", "dpt"), cut, r"frame_0002.dpt: has \d+ bytes, but 64 x 48 px take"),
    ("sintel", S.format("depth", "dpt"), lambda b: b"PIEX" + b[4:], r"does not begin with PIEH"),
    ("sintel", S.format("depth", "dpt"), lambda b: b[:4] + b"\xff" * 8 + b[12:], r"announces -1 x -1 px"),
    ("sintel", S.format("depth", "dpt"), lambda b: b[:9], r"cut short"),
    ("sintel", S.format("depth", "dpt"), other_size, r"is 12 x 10 px, but the first image is 64 x 48"),
    ("sintel", "training/depth", None, r"no such folder; download"),
    ("sintel", S.format("camdata_left", "cam"), None, r"frame_0002.cam: no such file; download"),
    ("sintel", S.format("camdata_left", "cam"), cut, r"frame_0002.cam: has \d+ bytes, not 172"),
    ("sintel", S.format("camdata_left", "cam"), lambda b: b"\0" * 4 + b[4:], r"is not a .cam file"),
    ("sintel", S.format("camdata_left", "cam"), lambda b: b[:-8] + b"\xff" * 8, r"NaN or infinite"),
    ("sintel", S.format("camdata_left", "cam"), lambda b: b[:76] + bytes(96), r"not orthonormal"),
    ("sintel", S.format("camdata_left", "cam"), lambda b: b[:4] + bytes(72) + b[76:], r"pinhole"),
    ("sintel", S.format("final", "png"), None, r"lacks frame\(s\) 2"),
    ("sintel", S.format("final", "png"), cut, r"is cut short"),
    ("sintel", S.format("dynamic_label_perfect", "png"), None, r"derive the masks of all frames"),
    ("tum-dynamics", T.format("rgb.txt"), None, r"rgb.txt: no such file; download"),
    ("tum-dynamics", T.format("rgb.txt"), line(4, "never rgb/x.png"), r"line 5: 'never' is not a number"),
    ("tum-dynamics", T.format("rgb.txt"), line(4, "1341845948.0"), r"line 5: 1 column\(s\), expected 2"),
    ("tum-dynamics", T.format("rgb.txt"), line(3, "1341845948.0 rgb/absent.png"), r"absent.png: no such file"),
    ("tum-dynamics", T.format("rgb.txt"), lambda b: b"# nothing\n", r"holds no line"),
    ("tum-dynamics", T.format("groundtruth.txt"), line(3, "1341845949 1 2 3 0 0 0 5"), r"quaternion of length 5"),
    ("tum-dynamics", T.format("groundtruth.txt"), lambda b: b"1 0 0 0 0 0 0 1\n", r"no image is within 0.02 s"),
    ("tum-dynamics", T.format("groundtruth.txt"), lambda b: b"1 0 0 0 0 0 0 0\n", r"holds no pose"),
    ("tum-dynamics", T.format("depth"), None, r"png: no such file; download"),
    ("bonn", B.format("groundtruth.txt"), lambda b: b"\n".join(b.splitlines()[:20]), r"has 18 poses, but images up to"),
    ("bonn", B.format("depth"), None, r"depth: no such folder; download"),
    ("bonn", B.format("rgb/1341845949.033333.png"), None, r"has 5 images but 6 depth maps"),
    ("bonn", B.format("depth/1341845949.042333.png"), eight_bit, r"not one of 16 bits"),
    ("kitti", KD, eight_bit, r"not one of 16 bits"),
    ("kitti", KI.format("data/0000000007.png"), None, r"0000000007.png: no such file; download"),
    ("kitti", "2011_09_26", None, r"no such folder; download"),
    ("kitti", KI.format("timestamps.txt"), line(7, "noon"), r"line 8: 'noon' is not a time"),
    ("kitti", KI.format("timestamps.txt"), lambda b: b[:60], r"has 2 times, but frame 10 is used"),
    ("kitti", "2011_09_26/calib_cam_to_cam.txt", lambda b: b"P_rect_02: 1 2 3\n", r"no P_rect_02 of 12 numbers"),
    ("davis", D.format("Annotations", "png"), None, r"00001.png: no such file; download"),
    ("davis", D.format("Annotations", "png"), rgb_mask, r"mode RGB, not of a palette"),
    ("davis", D.format("JPEGImages", "jpg"), cut, r"00001.jpg: is cut short"),
]


@pytest.mark.parametrize("case", range(len(DAMAGES)), ids=[f"{d[0]}-{i}" for i, d in enumerate(DAMAGES)])
def test_damage_ends_in_an_error_that_says_what_and_where(case: int, tmp_path: Path) -> None:
    name, target, damage, message = DAMAGES[case]
    make, video = MAKERS.get(name, (miniatures.davis, "bear"))
    make(tmp_path)
    path = tmp_path / target
    assert path.exists(), "the damage has something to hit"
    use(find_dataset(name), tmp_path, video)
    if damage is None:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=message) as error:
        use(find_dataset(name), tmp_path, video)
    assert str(tmp_path) in str(error.value)


def test_synthetic_scenes_are_made_when_they_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("open3d")
    whole = [synthetic.scene_of(step) for step in range(synthetic.COUNT)]
    assert [scene.noise.depth_flicker for scene in whole] == sorted({scene.noise.depth_flicker for scene in whole})
    small = {
        "num_frames": 3, "width": 64, "height": 48, "focal": 60.0, "grid_columns": 6, "grid_rows": 5, "margin_px": 2.0
    }  # fmt: skip
    scene = synthetic.scene_of(3, **small)
    monkeypatch.setattr(synthetic, "scene_of", lambda step: scene)
    dataset = find_dataset("synthetic")
    assert len(dataset.videos(tmp_path / "new")) == 10
    video = dataset.open(tmp_path / "new", "scene_3")
    truth = video.ground_truth
    assert truth.masks is not None
    assert truth.track_points is not None
    assert video.depths is not None
    assert (truth.masks[1] > 0).any()
    written = (tmp_path / "new" / "scene_3" / "K.npy").stat().st_mtime_ns
    dataset.open(tmp_path / "new", "scene_3")
    assert (tmp_path / "new" / "scene_3" / "K.npy").stat().st_mtime_ns == written
    with pytest.raises(InputError, match="scene_0 to scene_9"):
        dataset.open(tmp_path / "new", "scene_10")


def test_cards_are_plain_text() -> None:
    for name, dataset in DATASETS.items():
        assert dataset.card.name == name
        assert json.dumps([dataset.card.title, dataset.card.convention])
        assert dataset.card.default_split in dataset.card.splits
