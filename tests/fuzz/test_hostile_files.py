"""Damaged and malicious files: arrays, images, masks, videos, configurations, cards, COCO."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hostile import JSON, changed_json, damaged, judged, judged_verb, special_files
from hypothesis import given, settings
from hypothesis import strategies as st

from uni4d_fg.config.load import load_config
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.cues.card import card_names, cards_folder, load_card
from uni4d_fg.cues.mask_files import open_mask_files, read_ids
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.files import load_npy, load_npz, save_npz
from uni4d_fg.frontend.measurements.gps import read_gps
from uni4d_fg.frontend.measurements.imu import read_imu
from uni4d_fg.frontend.measurements.odometry import read_odometry
from uni4d_fg.frontend.measurements.relative_poses import read_relative_poses
from uni4d_fg.frontend.sequence.calibration_files import Calibration, load_calibration
from uni4d_fg.frontend.sequence.decode import read_depth, read_image, read_mask
from uni4d_fg.frontend.sequence.open_video import open_video
from uni4d_fg.frontend.sequence.validate import validate_sequence
from uni4d_fg.results.clouds import read_ply

hostile = settings(settings.get_profile("hostile"))


@hostile
@given(data=st.data())
def test_arrays(sequence_folder: Path, data: st.DataObject) -> None:
    source = data.draw(st.sampled_from(["K.npy", "c2w.npy", "tracks.npz", "ground_truth.npz"]))
    path = sequence_folder.parent / f"damaged{Path(source).suffix}"
    path.write_bytes(data.draw(damaged((sequence_folder / source).read_bytes())))
    found = judged(load_npy, path) if path.suffix == ".npy" else judged(load_npz, path, {})
    if isinstance(found, np.ndarray):
        assert found.nbytes <= path.stat().st_size
    judged(load_npy, path, memory_map=True)


HEADERS = [
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 3), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 1000000), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<U100000000', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 3), 'x': " + "(" * 200 + ")" * 200 + "}",
    "__import__('os').system('false')",
    "{'descr': [('a', '<f8'), ('b', '|O')], 'fortran_order': False, 'shape': (1,), }",
]


@pytest.mark.parametrize("header", HEADERS)
def test_headers(tmp_path: Path, header: str) -> None:
    text = header.ljust(118).encode("latin1") + b"\n"
    content = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(24)
    (tmp_path / "a.npy").write_bytes(content)
    assert isinstance(judged(load_npy, tmp_path / "a.npy"), InputError)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("uv.npy", content)
    assert isinstance(judged(load_npz, tmp_path / "a.npz", {"uv": 3}), InputError)


def bomb(path: Path, shape: tuple[int, ...]) -> None:
    """An .npz of a few megabytes at most that unpacks to zeros of that shape; the rest is as a track file has it."""
    small = {"visible": np.ones(shape[:2], bool), "query_frame": np.zeros(shape[0], np.int32)}
    save_npz(path, **small)
    header = repr({"descr": "<f8", "fortran_order": False, "shape": shape}).ljust(118).encode() + b"\n"
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("uv.npy", "w") as stream:
        stream.write(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
        left = 8 * int(np.prod(shape))
        while left:
            left -= stream.write(bytes(min(left, 2**24)))


@pytest.mark.parametrize("shape", [(1000, 30_000, 2), (5_000_000, 6, 2)])
def test_an_archive_that_unpacks_to_too_much(sequence_folder: Path, tmp_path: Path, shape: tuple[int, ...]) -> None:
    folder = Path(shutil.copytree(sequence_folder, tmp_path / "room"))
    bomb(folder / "tracks.npz", shape)
    assert (folder / "tracks.npz").stat().st_size < 3_500_000
    code, out, _ = judged_verb("validate", folder)
    assert code == 3
    assert "tracks" in out


@hostile
@given(data=st.data())
def test_images_and_masks(sequence_folder: Path, data: st.DataObject) -> None:
    folder, read = data.draw(
        st.sampled_from([("rgb", read_image), ("masks", read_mask), ("depth_cue", read_depth), ("masks", read_ids)])
    )
    source = sorted((sequence_folder / folder).iterdir())[0].read_bytes()
    if data.draw(st.booleans()):
        pixels = cv2.imdecode(np.frombuffer(source, np.uint8), cv2.IMREAD_UNCHANGED)
        source = cv2.imencode(".jpg", pixels.astype(np.uint8))[1].tobytes()
    path = sequence_folder.parent / "damaged.png"
    path.write_bytes(data.draw(damaged(source)))
    judged(read, path)


def test_an_image_of_too_many_pixels(tmp_path: Path) -> None:
    whole = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    from zlib import crc32

    head = b"IHDR" + (60_000).to_bytes(4, "big") * 2 + whole[24:29]
    (tmp_path / "a.png").write_bytes(whole[:12] + head + crc32(head).to_bytes(4, "big") + whole[33:])
    for read in (read_image, read_mask, read_depth, read_ids):
        assert isinstance(judged(read, tmp_path / "a.png"), InputError)


@pytest.mark.parametrize("before", [b"IDAT", b"IEND"])
def test_a_chunk_that_announces_more_than_the_file_has(tmp_path: Path, before: bytes) -> None:
    whole = cv2.imencode(".png", np.zeros((60, 80), np.uint8))[1].tobytes()
    at = whole.index(before) - 4
    (tmp_path / "a.png").write_bytes(whole[:at] + b"\x7f\xff\xff\xfftEXt" + whole[at:])
    for read in (read_image, read_mask, read_depth):
        assert "a.png: is cut short or damaged" in str(judged(read, tmp_path / "a.png"))


@hostile
@given(data=st.data())
def test_videos(video_file: Path, data: st.DataObject) -> None:
    path = video_file.with_name("damaged.mp4")
    path.write_bytes(data.draw(damaged(video_file.read_bytes())))

    def read() -> int:
        return sum(1 for _ in open_video(path).images)

    judged(read)


LISTS = [
    b"ffconcat version 1.0\nfile {}\n",
    b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n#EXT-X-ENDLIST\n",
    b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nm=video 5004 RTP/AVP 96\n",
    b"<?xml version='1.0'?><MPD></MPD>",
    b"GIF89a",
    b"\0",
]


@pytest.mark.parametrize("number", range(len(LISTS)))
def test_a_list_of_files_is_no_video(video_file: Path, tmp_path: Path, number: int) -> None:
    for suffix in (".mp4", ".mkv", ".avi"):
        path = tmp_path / f"list{suffix}"
        path.write_bytes(LISTS[number].replace(b"{}", str(video_file).encode()))
        assert "cannot be opened as a video" in str(judged(open_video, path))
        assert judged_verb("validate", path)[0] == 3


@hostile
@given(
    text=st.one_of(
        st.text(max_size=60), JSON.map(lambda value: json.dumps(value)), st.text("[]{}&*:,- \n'\"!x1", max_size=60)
    )
)
def test_configurations(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "hostile.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    judged(load_config, path)
    judged(load_card, path)
    judged(load_config, None, [f"camera_init.window={text}"])
    judged(load_config, None, [text])


YAML_BOMBS = {
    "aliases": "a: &a [x, x]\n"
    + "".join(f"{c}: &{c} [*{p}, *{p}, *{p}]\n" for p, c in zip("abcdefghijk", "bcdefghijkl", strict=True)),
    "anchor": "a: &a [*a]",
    "merge": "a: &a {b: 1}\nc:\n  <<: *a",
    "brackets": "a: " + "[" * 400 + "]" * 400,
    "braces": "a: " + "{a: " * 5000,
    "hexadecimal": "camera_init: {window: 0x" + "f" * 5000 + "}",
    "sexagesimal": "camera_init: {window: " + ":".join(["1"] * 500) + "}",
    "float": "camera_init: {window: 1" + "0" * 5000 + ".5}",
    "unknown": "".join(f"key{i}: 1\n" for i in range(20_000)),
    "few unknown": "".join(f"key{i}: 1\n" for i in range(2_000)),
    "unknown below": "camera_init:\n" + "".join(f"  key{i}: 1\n" for i in range(2_000)),
    "large": "a: " + "x" * 10_000_000,
    "python": "a: !!python/object/apply:os.system ['false']",
    "binary": "a: !!binary ////",
    "date": "camera_init: {window: 2020-01-01}",
    "set": "camera_init: !!set {a, b}",
    "keys": "? [a]\n: 1",
    "documents": "a: 1\n---\nb: 2",
    "bad date": "a: 2020-13-45",
}


@pytest.mark.parametrize("name", list(YAML_BOMBS))
def test_yaml_that_takes_time_or_memory(tmp_path: Path, name: str) -> None:
    path = tmp_path / "bomb.yaml"
    path.write_text(YAML_BOMBS[name])
    for load in (load_config, load_card):
        error = judged(load, path)
        assert isinstance(error, ConfigError)
        assert "bomb.yaml" in str(error)
    if len(YAML_BOMBS[name]) < 100_000:
        assert isinstance(judged(load_config, None, [f"camera_init={YAML_BOMBS[name]}"]), ConfigError)


@hostile
@given(data=st.data())
def test_cards(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    source = cards_folder() / f"{data.draw(st.sampled_from(card_names()))}.yaml"
    path = tmp_path_factory.getbasetemp() / "card.yaml"
    path.write_text(yaml.safe_dump(data.draw(changed_json(yaml.safe_load(source.read_text()))), allow_unicode=False))
    judged(load_card, path)


SIZE = (72, 96)
RLE = {"size": list(SIZE), "counts": [1000, 500, SIZE[0] * SIZE[1] - 1500]}
MASK = {"image_id": 0, "category_id": 1, "score": 0.9, "segmentation": RLE}
COCO: list[Any] = [
    [MASK, {**MASK, "image_id": 1, "track_id": 3}],
    {
        "images": [{"id": 0, "file_name": "00000.png"}, {"id": 1, "file_name": "00001.png"}],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [{**MASK, "id": 5, "track_id": 2}, {**MASK, "image_id": 1, "track_id": 2}],
    },
    {"segmentations": [{"file_name": "00000.png", "segmentations": [{"id": 1, "rle": RLE}]}]},
    {"annotations": [{"file_name": "00000.png", "segments_info": [{"id": 1, "category_id": 1}]}]},
]


def read_all(path: Path) -> int:
    return sum(int(mask.max()) >= 0 for mask in open_mask_files(path, SIZE, 2))


@hostile
@given(data=st.data())
def test_coco(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.getbasetemp() / "masks.json"
    path.write_text(json.dumps(data.draw(changed_json(data.draw(st.sampled_from(COCO))))))
    judged(read_all, path)


@hostile
@given(
    counts=st.one_of(
        st.lists(st.sampled_from([0, 1, 5, 6912, -1, 2**31, 2**63 - 1, 2**63, 2**64, True]), max_size=6),
        st.text(max_size=20),
    ),
    size=st.sampled_from([list(SIZE), [2**31, 2**32], [1, 1], [0, 5], [True, 5], [72.0, 96.0]]),
)
def test_run_lengths(tmp_path_factory: pytest.TempPathFactory, counts: Any, size: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "runs.json"
    path.write_text(json.dumps([{**MASK, "segmentation": {"size": size, "counts": counts}}]))
    judged(read_all, path)


@pytest.mark.parametrize(
    "change",
    [
        {"segmentation": {"size": list(SIZE), "counts": [2**63 - 1, 2**63 - 1, 6914]}},
        {"segmentation": {"size": [2**20, 2**20], "counts": [2**40]}},
        {"segmentation": {"size": list(SIZE), "counts": "o" * 30}},
        {"track_id": 1e400},
        {"track_id": "text"},
        {"category_id": 2**40},
        {"category_id": None, "image_id": None},
        {"score": 1e400},
        {"score": "high"},
    ],
)
def test_coco_that_is_wrong_is_one_clear_error(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "masks.json"
    path.write_text(json.dumps([{**MASK, **change}]))
    error = judged(read_all, path)
    assert isinstance(error, InputError)
    assert "masks.json" in str(error)


def test_coco_that_is_odd_but_right(tmp_path: Path) -> None:
    path = tmp_path / "masks.json"
    path.write_text(json.dumps([{**MASK, "track_id": 2**61}, {**MASK, "image_id": 1, "track_id": "7"}]))
    masks = list(open_mask_files(path, SIZE, 2))
    assert [sorted(np.unique(mask)) for mask in masks] == [[0, 2], [0, 1]]
    path.write_text(json.dumps([{**MASK, "score": None, "track_id": None, "category_id": None}]))
    assert judged(read_all, path) == 2
    path.write_text(json.dumps([MASK] * 24_000))
    assert "24000 masks in frame 00000" in str(judged(read_all, path))


@hostile
@given(data=st.data())
def test_clouds(run_folder: Path, data: st.DataObject) -> None:
    path = run_folder.parent / "damaged.ply"
    path.write_bytes(data.draw(damaged((run_folder / "clouds" / "static.ply").read_bytes()[:4000])))
    judged(read_ply, path)


def test_a_cloud_that_announces_too_much(run_folder: Path, tmp_path: Path) -> None:
    data = (run_folder / "clouds" / "static.ply").read_bytes()
    line = next(line for line in data.split(b"\n") if line.startswith(b"element vertex"))
    (tmp_path / "a.ply").write_bytes(data.replace(line, b"element vertex 99999999999"))
    assert "announces 99999999999 points" in str(judged(read_ply, tmp_path / "a.ply"))


ITEMS = [
    "rgb",
    "K.npy",
    "depth_cue",
    "masks",
    "tracks.npz",
    "timestamps.txt",
    "c2w.npy",
    "ground_truth.npz",
    "rgb/00002.png",
]


@pytest.mark.parametrize("item", ITEMS)
def test_pipes_devices_and_links_in_place_of_files(sequence_folder: Path, tmp_path: Path, item: str) -> None:
    folder = Path(shutil.copytree(sequence_folder, tmp_path / "room"))
    place = folder / item
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink()
    (tmp_path / "special").mkdir()
    for special in special_files(tmp_path / "special"):
        place.symlink_to(special)
        code, out, err = judged_verb("validate", folder)
        assert code == 3, (special, out, err)
        assert judged_verb("reconstruct", folder, "--out", tmp_path / "run")[0] in (3, 6)
        place.unlink()


def test_a_dangling_calibration_is_not_an_absent_one(sequence_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(sequence_folder, tmp_path / "room"))
    (folder / "K.npy").unlink()
    assert judged_verb("validate", folder)[0] == 0
    (folder / "K.npy").symlink_to("elsewhere.npy")
    error = judged(open_video, folder)
    assert "is a link to elsewhere.npy, where there is nothing" in str(error)


@pytest.mark.parametrize(
    "options",
    [
        ["--masks"], ["--depth"], ["--tracks"], ["--intrinsics"], ["--config"], ["--depth-model"], ["--odometry"],
        ["--gps"], ["--relative-poses"], ["--imu"], ["--track-model"],
    ],
)  # fmt: skip
def test_pipes_devices_and_links_as_options(sequence_folder: Path, tmp_path: Path, options: list[str]) -> None:
    for special in special_files(tmp_path)[:-1]:
        words = ["reconstruct", sequence_folder, *options, special, "--out", tmp_path / "run"]
        assert judged_verb(*words)[0] in (2, 3), special
        assert not (tmp_path / "run").exists()


CALIBRATIONS: dict[str, Any] = {
    ".json": {"fl_x": 75.0, "fl_y": 75.0, "cx": 40.0, "cy": 30.0, "w": 80, "h": 60, "k1": 0.1, "p1": 0.0},
    ".yaml": {
        "image_width": 80, "image_height": 60, "distortion_model": "plumb_bob",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [75.0, 0, 39.5, 0, 75.0, 29.5, 0, 0, 1]},
        "distortion_coefficients": {"rows": 1, "cols": 4, "data": [0.1, 0.0, 0.0, 0.0]},
    },
    ".yml": {
        "cam0": {
            "camera_model": "pinhole", "distortion_model": "radtan", "resolution": [80, 60],
            "intrinsics": [75.0, 75.0, 39.5, 29.5], "distortion_coeffs": [0.1, 0.0, 0.0, 0.0],
        }
    },
}  # fmt: skip
COLMAP = "1 OPENCV 80 60 75 75 40 30 0.1 0 0 0"
NUMBERS = st.sampled_from(["nan", "inf", "1e400", "-1", "0", "1e300", "1e-300", "9" * 400, "9" * 5000, "x", ""])


@st.composite
def changed_words(draw: st.DrawFn, text: str) -> str:
    """A text with one to three of its words replaced by numbers that are none, or too large."""
    words = text.replace(",", " , ").split(" ")
    for _ in range(draw(st.integers(1, 3))):
        words[draw(st.integers(0, len(words) - 1))] = draw(NUMBERS)
    return " ".join(words).replace(" , ", ",")


@hostile
@given(data=st.data())
def test_calibrations(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    suffix = data.draw(st.sampled_from([".txt", *CALIBRATIONS]))
    path = tmp_path_factory.getbasetemp() / f"calibration{suffix}"
    if suffix == ".txt":
        text = data.draw(changed_words(COLMAP))
    else:
        value = data.draw(changed_json(CALIBRATIONS[suffix]))
        text = json.dumps(value) if suffix == ".json" else yaml.safe_dump(value)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    found = judged(load_calibration, path, 6, (60, 80))
    if isinstance(found, Calibration):
        assert np.isfinite(found.intrinsics).all()
        assert np.isfinite(found.lens.padded).all()


@pytest.mark.parametrize(
    "change",
    [
        {"fl_x": 10**400},
        {"w": 10**400},
        {"w": 1e400, "h": 1e400},
        {"k1": 1e400},
        {"cx": None},
        {"fl_x": [1]},
        {"h": -1},
    ],
)
def test_a_calibration_that_is_wrong_is_one_clear_error(tmp_path: Path, change: dict[str, Any]) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**CALIBRATIONS[".json"], **change}).replace("Infinity", "1e400"))
    error = judged(load_calibration, path, 6, (60, 80))
    assert isinstance(error, InputError)
    assert "transforms.json" in str(error)


UNIT = "0.1 0.2 0.3 0 0 0 1"
MEASURED: dict[str, str] = {
    "odometry.tum": "".join(f"{t} {UNIT}\n" for t in range(6)),
    "gps.csv": "timestamp,x,y,z,sigma\n" + "".join(f"{t},0.1,{t},0.3,0.5\n" for t in range(6)),
    "world.csv": "timestamp,latitude,longitude,altitude\n"
    + "".join(f"{t},48.1,{11 + 1e-5 * t},500\n" for t in range(6)),
    "edges.g2o": "".join(
        f"EDGE_SE3:QUAT {t} {t + 1} {UNIT} {' '.join(['1 0 0 0 0 0', '1 0 0 0 0', '1 0 0 0', '1 0 0', '1 0', '1'])}\n"
        for t in range(5)
    ),
    "imu.csv": "".join(f"{t}000000000,0.1,0.2,0.3,0,0,9.81\n" for t in range(6)),
    "imu.yaml": "noise: euroc\ntime_offset: 0.0\nbody_T_cam: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n",
}


@pytest.mark.parametrize(
    "text",
    [
        f"noise: '{'9' * 5000}'",
        f"x: '{'9' * 5000}'",
        "body_T_cam: [[1,1e300,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
        "time_offset: [1]",
    ],
)
def test_an_imu_that_is_wrong_is_one_clear_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "imu.csv").write_text(MEASURED["imu.csv"])
    (tmp_path / "imu.yaml").write_text(text)
    assert isinstance(judged(read_imu, tmp_path), InputError)


@hostile
@given(data=st.data())
def test_measurements(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(MEASURED)))
    folder = tmp_path_factory.getbasetemp() / "measured"
    folder.mkdir(exist_ok=True)
    for other, text in MEASURED.items():
        (folder / other).write_text(text)
    text = MEASURED[name]
    data_bytes = data.draw(st.one_of(changed_words(text).map(str.encode), damaged(text.encode())))
    (folder / name).write_bytes(data_bytes)
    times, config = np.arange(6.0), MeasurementsConfig()
    if name.endswith("tum"):
        judged(read_odometry, folder / name, times, config)
    elif name.endswith("g2o"):
        judged(read_relative_poses, folder / name, 6)
    elif name.startswith("imu"):
        judged(read_imu, folder)
    else:
        judged(read_gps, folder / name, times, config)


@hostile
@given(data=st.data())
def test_sequences(sequence_folder: Path, data: st.DataObject) -> None:
    folder = sequence_folder.parent / "damaged"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(sequence_folder, folder)
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    for path in data.draw(st.lists(st.sampled_from(paths), min_size=1, max_size=3, unique=True)):
        path.write_bytes(data.draw(damaged(path.read_bytes())))
    report = judged(validate_sequence, folder)

    def read() -> None:
        video = open_video(folder)
        for source in (video.images, video.depths, video.masks):
            list(source or ())

    if isinstance(judged(read), InputError):
        assert not report.ok
