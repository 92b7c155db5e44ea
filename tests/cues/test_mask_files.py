"""Masks in the forms of other programs, written here as they write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from uni4d_fg.config.motion_masks import InstanceConfig
from uni4d_fg.cues.mask_files import open_mask_files
from uni4d_fg.cues.rle import decode_counts, decode_rle
from uni4d_fg.errors import InputError

SIZE = (6, 8)
NAMES = ("00000", "00001", "00002")


def naive_runs(mask: np.ndarray) -> list[int]:
    runs, value = [0], False
    for pixel in mask.T.ravel():
        if bool(pixel) != value:
            runs.append(0)
            value = not value
        runs[-1] += 1
    return runs


def naive_string(counts: list[int]) -> str:
    """The string form, one number and one group of bits at a time."""
    text = ""
    for i, count in enumerate(counts):
        x = count - (counts[i - 2] if i > 2 else 0)
        more = True
        while more:
            bits = x & 31
            x >>= 5
            more = x != (-1 if bits & 16 else 0)
            text += chr(48 + bits + (32 if more else 0))
    return text


def rle(mask: np.ndarray, compressed: bool = True) -> dict[str, Any]:
    runs = naive_runs(mask)
    return {"size": list(mask.shape), "counts": naive_string(runs) if compressed else runs}


def box(y: int, x: int, height: int = 3, width: int = 3) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[y : y + height, x : x + width] = True
    return mask


def save_palette(path: Path, ids: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(ids.astype(np.uint8))
    image.putpalette([(37 * i) % 256 for i in range(768)])
    image.save(path)


def save_rgb(path: Path, ids: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.stack((ids % 256, ids // 256 % 256, ids // 65536), axis=2).astype(np.uint8)).save(path)


def opened(path: Path, names: tuple[str, ...] = NAMES, **options: Any) -> np.ndarray:
    masks = open_mask_files(path, SIZE, len(names), names, **options)
    assert len(masks) == len(names)
    return np.stack(list(masks))


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_rle_is_decoded_like_a_naive_encoder_wrote_it(height: int, width: int, seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < share
    mask = np.repeat(mask, 1 + seed % 40, axis=0)  # long runs need more than one group of bits
    runs = naive_runs(mask)
    np.testing.assert_array_equal(decode_counts(naive_string(runs), "x"), runs)
    for compressed in (True, False):
        np.testing.assert_array_equal(decode_rle(rle(mask, compressed), "x"), mask)


def test_rle_of_a_known_string() -> None:
    # 480 x 640 with one run: 100000 outside, 5 inside, the rest outside.
    counts = [100000, 5, 480 * 640 - 100005]
    assert decode_counts(naive_string(counts), "x").tolist() == counts
    assert decode_counts("0", "x").tolist() == [0]
    assert decode_counts("P1", "x").tolist() == [32]  # two groups: 0 with more to come, then 1


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        ({"size": [6, 8], "counts": [47]}, "do not fill 6 x 8"),
        ({"size": [6, 8], "counts": [50, -2]}, "do not fill"),
        ({"size": [6, 8], "counts": "PP"}, "cut short"),
        ({"size": [6, 8], "counts": "\u00e9!"}, "no compressed run-length string"),
        ({"size": [6, 8], "counts": "oooooooooo0"}, "too large"),
        ({"size": [6, 8], "counts": 3}, "must be a list"),
        ({"size": [6], "counts": [48]}, "needs 'size'"),
        ([[0, 0, 1, 1, 2, 2]], "polygon"),
        ("abc", "no run-length mask"),
    ],
)
def test_a_damaged_rle_is_one_clear_error(segmentation: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        decode_rle(segmentation, "mask 3")


@given(st.text(max_size=30))
def test_no_string_gets_past_the_checks(text: str) -> None:
    try:
        mask = decode_rle({"size": [6, 8], "counts": text}, "x")
    except InputError:
        return
    assert mask.shape == (6, 8)


def test_deva(tmp_path: Path) -> None:
    ids = [70000 * box(0, 0) + 300 * box(3, t) for t in range(3)]
    for t, mask in enumerate(ids):
        save_rgb(tmp_path / "Annotations" / f"{t:05d}.png", mask)
    (tmp_path / "Visualizations").mkdir()
    (tmp_path / "Visualizations" / "00000.jpg").write_bytes(b"no mask")
    segments = [{"id": 70000, "category_id": 1, "score": 0.9}, {"id": 300, "category_id": 0, "score": 0.8}]
    content = {"annotations": [{"file_name": f"{t:05d}.jpg", "segments_info": segments} for t in range(3)]}
    (tmp_path / "pred.json").write_text(json.dumps(content))
    np.testing.assert_array_equal(opened(tmp_path), ids)
    np.testing.assert_array_equal(opened(tmp_path / "Annotations"), ids)
    for path in (tmp_path, tmp_path / "pred.json", tmp_path / "Annotations"):
        only = opened(path, classes=("dog",), class_names={0: "table", 1: "dog"})
        np.testing.assert_array_equal(only, [70000 * box(0, 0)] * 3)
    with pytest.raises(InputError, match="without naming them"):
        opened(tmp_path, classes=("dog",))


def test_sam2_palette(tmp_path: Path) -> None:
    ids = [2 * box(0, 0) + 7 * box(3, t) for t in range(3)]
    for t, mask in enumerate(ids):
        save_palette(tmp_path / "my_video" / f"{t:05d}.png", mask)
    np.testing.assert_array_equal(opened(tmp_path), ids)


def test_sam2_folder_per_object(tmp_path: Path) -> None:
    for number in (1, 12):
        for t in range(3):
            if not (number == 12 and t == 1):
                save_palette(tmp_path / f"{number:03d}" / f"{t:05d}.png", box(0, t) if number == 1 else box(2, t))
    result = opened(tmp_path)
    expected = np.stack([np.where(box(0, t), 1, 12 * box(2, t) * (t != 1)) for t in range(3)])
    np.testing.assert_array_equal(result, expected)


def test_plain_ids_are_matched_by_name_then_by_order(tmp_path: Path) -> None:
    for t in range(5):
        save_palette(tmp_path / f"{t:05d}.png", (t + 1) * box(0, 0))
    assert opened(tmp_path, ("00001", "00003")).max(axis=(1, 2)).tolist() == [2, 4]
    assert opened(tmp_path, ("a", "b", "c", "d", "e")).max(axis=(1, 2)).tolist() == [1, 2, 3, 4, 5]
    with pytest.raises(InputError, match=r"5 masks for 3 images \(none for 7\)"):
        opened(tmp_path, ("00000", "00001", "7"))


@pytest.mark.parametrize("first", [0, 1])
def test_coco_results_of_an_instance_segmenter(tmp_path: Path, first: int) -> None:
    entries = []
    for t in range(3):
        for class_id, score, mask in ((18, 0.9, box(0, t)), (1, 0.8, box(3, 5 - t)), (67, 0.9, box(0, 5))):
            # The order of the detections means nothing.
            entry = {"image_id": t + first, "category_id": class_id, "score": score}
            entries.insert(t % 2, entry | {"segmentation": rle(mask, t == 1), "bbox": [0, 0, 1, 1]})
    entries.append({"image_id": 1, "category_id": 1, "score": 0.1, "segmentation": rle(box(0, 5))})
    path = tmp_path / "coco_instances_results.json"
    path.write_text(json.dumps(entries))
    result = opened(path, config=InstanceConfig(min_area_px=1))
    for t in range(3):
        values = np.unique(result[t][box(0, t)]).tolist() + np.unique(result[t][box(3, 5 - t)]).tolist()
        assert values == np.unique(result[0][box(0, 0)]).tolist() + np.unique(result[0][box(3, 5)]).tolist()
        assert not result[t][box(0, 5) & ~box(0, t)].any()  # a dining table does not move
    assert set(np.unique(result)) == {0, 1, 2}
    tables = opened(path, classes=("dining table",), config=InstanceConfig(min_area_px=1))
    np.testing.assert_array_equal(tables, [1 * box(0, 5)] * 3)


def test_a_data_set_file_with_tracks(tmp_path: Path) -> None:
    content = {
        "images": [{"id": 50 + t, "file_name": f"rgb/{t:05d}.jpg"} for t in range(3)],
        "categories": [{"id": 4, "name": "robot"}],
        "annotations": [
            {"image_id": 50 + t, "category_id": 4, "track_id": track, "segmentation": rle(box(3 * track, t))}
            for t in range(3)
            for track in (0, 1)
            if t != 1 or track
        ],
    }
    path = tmp_path / "annotations.json"
    path.write_text(json.dumps(content))
    expected = [1 * box(0, t) * (t != 1) + 2 * box(3, t) for t in range(3)]
    np.testing.assert_array_equal(opened(path), expected)
    np.testing.assert_array_equal(opened(path, classes=("robot",)), expected)
    with pytest.raises(InputError, match="no class is called 'dog'; choose from robot"):
        opened(path, classes=("dog",))


def test_burst(tmp_path: Path) -> None:
    frames = [
        {"file_name": f"{t:05d}.jpg", "segmentations": [{"id": 5, "score": 1.0, "rle": rle(box(0, t))}]}
        for t in range(3)
    ]
    path = tmp_path / "pred.json"
    path.write_text(json.dumps({"seq_name": "v", "segmentations": frames}))
    np.testing.assert_array_equal(opened(path), [5 * box(0, t) for t in range(3)])


def _json(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "masks.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[{", "cannot be read as JSON"),
        ({"a": 1}, "no masks in a known form"),
        ([{"image_id": 0, "category_id": 1, "bbox": [0, 0, 1, 1]}], "has no mask, only a box"),
        ([{"category_id": 1}], "has no 'image_id'"),
        ([{"image_id": 0, "category_id": "dog", "segmentation": {}}], "that is no whole number"),
        ([{"image_id": "x9", "category_id": 1, "score": 1, "segmentation": rle(box(0, 0))}], "names frames x9"),
        ([{"image_id": 0, "category_id": 1, "score": 1, "segmentation": rle(np.ones((3, 3), bool))}], "3 x 3 px"),
        ([{"image_id": 0, "category_id": 1, "score": 1, "segmentation": {"size": [6, 8]}}], "must be a list"),
    ],
)
def test_a_file_that_does_not_fit_is_one_clear_error(tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        opened(_json(tmp_path, content))


def test_a_folder_that_does_not_fit_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        opened(tmp_path / "absent")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with pytest.raises(InputError, match=r"holds no masks that can be read: .* holds a/, b/"):
        opened(tmp_path)
    with pytest.raises(InputError, match="holds no masks"):
        opened(tmp_path / "a")
    (tmp_path / "x.txt").write_text("no masks")
    with pytest.raises(InputError, match="holds no masks that can be read"):
        opened(tmp_path / "x.txt")
    for t in range(3):
        save_palette(tmp_path / "a" / f"{t:05d}.png", np.zeros((4, 4)))
    with pytest.raises(InputError, match="4 x 4 px"):
        opened(tmp_path / "a")
    with pytest.raises(InputError, match="does not say of which class"):
        opened(tmp_path / "a", classes=("dog",))
    (tmp_path / "a" / "00001.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="cannot be decoded as a mask"):
        open_mask_files(tmp_path / "a", SIZE, 3, NAMES)[1]
