"""Samples of an IMU: what files hold, what is refused, and what a lever arm does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from uni4d_fg.errors import InputError
from uni4d_fg.frontend.measurements.imu import NOISE_PRESETS, ImuNoise, ImuSamples, read_imu, write_imu
from uni4d_fg.geometry.se3 import se3_exp

HEADER = "#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n"
ROWS = "0,0.1,0.2,0.3,1,2,3\n5000000,0.1,0.2,0.3,1,2,3\n10000000,0.1,0.2,0.3,1,2,3\n"


def samples(count: int = 50) -> ImuSamples:
    rng = np.random.default_rng(0)
    body_T_cam = se3_exp(np.array([0.3, -0.2, 1.0, 0.1, 0.05, -0.2]))
    times = 100.0 + 0.005 * np.arange(count)
    return ImuSamples(
        times, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), body_T_cam, NOISE_PRESETS["euroc"]
    )


def write(folder: Path, csv: str = HEADER + ROWS, yaml: str | None = None) -> Path:
    (folder / "imu.csv").write_text(csv)
    if yaml is not None:
        (folder / "imu.yaml").write_text(yaml)
    return folder


def test_what_is_written_is_read(tmp_path: Path) -> None:
    before = samples()
    write_imu(before, tmp_path)
    for path in (tmp_path, tmp_path / "imu.csv"):
        after = read_imu(path)
        np.testing.assert_allclose(after.timestamps, before.timestamps, atol=1e-9)
        np.testing.assert_allclose(after.accelerometer, before.accelerometer, rtol=1e-8)
        np.testing.assert_allclose(after.gyroscope, before.gyroscope, rtol=1e-8)
        np.testing.assert_allclose(after.body_T_cam, before.body_T_cam, rtol=1e-12)
        assert after.noise == before.noise


def test_gyroscope_comes_before_accelerometer_and_times_are_nanoseconds(tmp_path: Path) -> None:
    read = read_imu(write(tmp_path, yaml="noise: phone\ntime_offset: 2.5\n"))
    np.testing.assert_allclose(read.timestamps, [2.5, 2.505, 2.51])
    np.testing.assert_array_equal(read.gyroscope[0], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(read.accelerometer[0], [1, 2, 3])
    assert read.noise == NOISE_PRESETS["phone"]


def test_a_header_without_a_hash_is_skipped(tmp_path: Path) -> None:
    assert len(read_imu(write(tmp_path, HEADER[1:] + ROWS))) == 3


@pytest.mark.parametrize(
    ("csv", "yaml", "message"),
    [
        (HEADER, None, "holds no samples"),
        (HEADER + "0,1,2,3,4,5,6\n", None, "1 sample"),
        (HEADER + ROWS + "15000000,1,2\n", None, "line 5: 3 columns"),
        (HEADER + ROWS + "15000000,1,2,x,4,5,6\n", None, "line 5"),
        (HEADER + ROWS + "15000000,1,2,nan,4,5,6\n", None, "gyroscope has NaN"),
        (HEADER + ROWS + "10000000,1,2,3,4,5,6\n", None, "do not increase after sample 2"),
        (HEADER + ROWS, "noise: car\n", "noise is 'car'; give one of euroc, phone"),
        (HEADER + ROWS, "noise: {gyroscope: 1}\n", "or all of accelerometer"),
        (HEADER + ROWS, "noise: [\n", "cannot be read"),
        (HEADER + ROWS, "rate: 3\n", "a mapping with some of noise"),
        (HEADER + ROWS, "time_offset: soon\n", "time_offset a number of seconds"),
        (HEADER + ROWS, "body_T_cam: [[1, 2], [3, 4]]\n", "body_T_cam has shape"),
        (
            HEADER + ROWS,
            "body_T_cam: [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n",
            "no rigid transform",
        ),
        (
            HEADER + ROWS,
            "noise: {accelerometer: 0, gyroscope: 1, accelerometer_walk: 1, gyroscope_walk: 1}\n",
            "accelerometer is 0",
        ),
    ],
)
def test_a_bad_file_is_refused_by_name(tmp_path: Path, csv: str, yaml: str | None, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_imu(write(tmp_path, csv, yaml))
    assert str(tmp_path) in str(error.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"imu\.csv: no such file"):
        read_imu(tmp_path)


def test_frames_outside_of_the_recording_are_refused() -> None:
    recording = samples()
    recording.check_covers(np.array([100.0, 100.2]))
    with pytest.raises(InputError, match="do not cover the frames"):
        recording.check_covers(np.array([0.0, 1.0]))
    kept = np.r_[0:10, 30:50]
    gap = ImuSamples(recording.timestamps[kept], recording.accelerometer[kept], recording.gyroscope[kept])
    with pytest.raises(InputError, match=r"no sample for 0.105 s after 100.045 s"):
        gap.check_covers(np.array([100.0, 100.2]))
    gap.check_covers(np.array([100.15, 100.2]))


def test_noise_must_be_positive() -> None:
    with pytest.raises(InputError, match="gyroscope_walk is nan"):
        ImuNoise(1.0, 1.0, 1.0, float("nan"))


def test_the_digest_sees_every_number() -> None:
    one = samples()
    assert one.digest() == samples().digest()
    changed = ImuSamples(one.timestamps, one.accelerometer, one.gyroscope, one.body_T_cam, NOISE_PRESETS["phone"])
    assert one.digest() != changed.digest()
