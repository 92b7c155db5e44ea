"""Samples of an inertial measurement unit (IMU), and the files they are kept in.

    gyroscope       w = w_body + b_g + n                                [rad/s]
    accelerometer   a = R^T (d^2 p / dt^2 - g) + b_a + n                [m/s^2]

with ``g`` the acceleration of gravity in the world; an accelerometer at rest shows ``-g``. The samples are CSV as in
the EuRoC data set (Burri et al. 2016), ``timestamp [ns], w_x, w_y, w_z, a_x, a_y, a_z``; what is known of the device
stands beside them in ``imu.yaml``:

    noise: phone                       # or euroc, or the four numbers of ImuNoise by name
    body_T_cam: [[...], [...], ...]    # 4 x 4; identity if absent
    time_offset: 0.0                   # s, added to the IMU's times to give those of the frames
"""

from __future__ import annotations

import hashlib
import reprlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.yaml_text import parse_yaml
from uni4d_fg.errors import ConfigError, InputError
from uni4d_fg.files import atomic_write_text
from uni4d_fg.reading import read_text

CSV_NAME, YAML_NAME = "imu.csv", "imu.yaml"
_HEADER = "#timestamp [ns],w_x [rad s^-1],w_y [rad s^-1],w_z [rad s^-1],a_x [m s^-2],a_y [m s^-2],a_z [m s^-2]"
_MAX_ROTATION_ERROR = 1e-3
_MAX_GAP = 5.0
"""A step between samples longer than this many times the median step is a gap."""


@dataclass(frozen=True)
class ImuNoise:
    """Continuous-time noise, as data sheets and calibrations state it.

    Raises:
        InputError: On construction, if a number is not finite and positive.
    """

    accelerometer: float
    """Density, m/s^2/sqrt(Hz)."""
    gyroscope: float
    """Density, rad/s/sqrt(Hz)."""
    accelerometer_walk: float
    """Random walk of the bias, m/s^3/sqrt(Hz)."""
    gyroscope_walk: float
    """Random walk of the bias, rad/s^2/sqrt(Hz)."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not number or not np.isfinite(value) or value <= 0:
                raise InputError(f"IMU noise: {name} is {value!r}, but a finite positive number is needed")


NOISE_PRESETS: Mapping[str, ImuNoise] = {
    "euroc": ImuNoise(2.0e-3, 1.6968e-4, 3.0e-3, 1.9393e-5),
    "phone": ImuNoise(4.0e-3, 5.0e-4, 3.0e-3, 5.0e-5),
}
"""``euroc``: the ADIS16448 as calibrated with the EuRoC data. ``phone``: about three times the data sheets of the chips
in phones, which leaves room for temperature and vibration."""


@dataclass(frozen=True)
class ImuSamples:
    """N samples of an accelerometer and a gyroscope.

    Raises:
        InputError: On construction, if a shape is wrong, a number is not finite, times do not increase, or
            ``body_T_cam`` is no rigid transform.
    """

    timestamps: FloatArray
    """(N,) s, strictly increasing, on the clock of the frames."""
    accelerometer: FloatArray
    """(N, 3) m/s^2, in the body's axes."""
    gyroscope: FloatArray
    """(N, 3) rad/s, in the body's axes."""
    body_T_cam: FloatArray = field(default_factory=lambda: np.eye(4))
    """(4, 4) where the camera is on the body: ``X_body = R x_cam + c``, m."""
    noise: ImuNoise = NOISE_PRESETS["phone"]

    def __post_init__(self) -> None:
        count = len(self.timestamps)
        shapes = {"timestamps": (count,), "accelerometer": (count, 3), "gyroscope": (count, 3), "body_T_cam": (4, 4)}
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name))
            if array.shape != shape:
                raise InputError(f"IMU: {name} has shape {array.shape}, but {shape} is needed")
            if not np.isfinite(array).all():
                raise InputError(f"IMU: {name} has NaN or infinite entries; leave such samples out")
        if count < 2:
            raise InputError(f"IMU: {count} sample(s), but at least 2 are needed")
        if (np.diff(self.timestamps) <= 0).any():
            row = int(np.argmax(np.diff(self.timestamps) <= 0))
            raise InputError(f"IMU: timestamps do not increase after sample {row}; sort the samples by time")
        rotation = np.clip(self.body_T_cam[:3, :3], -2.0, 2.0)  # beyond, it is none, and must not overflow
        rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _MAX_ROTATION_ERROR and np.linalg.det(rotation) > 0
        if not rigid or np.abs(self.body_T_cam[3] - [0, 0, 0, 1]).max() > _MAX_ROTATION_ERROR:
            raise InputError("IMU: body_T_cam is no rigid transform (4 x 4, rotation and translation in meters)")

    def __len__(self) -> int:
        return len(self.timestamps)

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return accelerometer and gyroscope at times (M,) s, each (M, 3), linearly between samples."""
        out = [
            np.stack([np.interp(times, self.timestamps, values[:, axis]) for axis in range(3)], axis=1)
            for values in (self.accelerometer, self.gyroscope)
        ]
        return out[0], out[1]

    def check_covers(self, frame_times: FloatArray) -> None:
        """Make sure that there are samples around every frame (T,) s.

        Raises:
            InputError: If the IMU starts late, ends early, or has a gap between two frames.
        """
        steps = np.diff(self.timestamps)
        longest = _MAX_GAP * float(np.median(steps))
        first, last = float(frame_times[0]), float(frame_times[-1])
        begin, end = float(self.timestamps[0]), float(self.timestamps[-1])
        if begin > first + longest or end < last - longest:
            raise InputError(
                f"IMU: samples from {begin:.3f} s to {end:.3f} s do not cover the frames from {first:.3f} s to "
                f"{last:.3f} s; both need the same clock ('time_offset' in {YAML_NAME} shifts the IMU's), and the "
                "sequence needs its timestamps.txt"
            )
        gaps = (steps > longest) & (self.timestamps[1:] > first) & (self.timestamps[:-1] < last)
        if gaps.any():
            row = int(np.argmax(gaps))
            raise InputError(
                f"IMU: no sample for {steps[row]:.3f} s after {self.timestamps[row]:.3f} s "
                f"(usual step {np.median(steps):.4f} s); give a recording without gaps between the frames"
            )

    def at_camera(self, gyroscope_bias: FloatArray | None = None) -> ImuSamples:
        """Return what an IMU at the camera's center, in the camera's axes, would have measured.

        With ``c`` the camera on the body and R its axes, ``w' = R^T w`` and
        ``a' = R^T (a + dw/dt x c + w x (w x c))``; biases become ``R^T b``. The gyroscope's derivative is noisy, but
        what it adds to a velocity is ``(w_end - w_start) x c``: its noise does not accumulate.

        Args:
            gyroscope_bias: (3,) rad/s in the body's axes, subtracted where rates turn the lever arm; zero if None.
        """
        rotation, lever = self.body_T_cam[:3, :3], self.body_T_cam[:3, 3]
        rate = self.gyroscope - (0.0 if gyroscope_bias is None else gyroscope_bias)
        change = np.gradient(rate, self.timestamps, axis=0)
        moved = self.accelerometer + np.cross(change, lever) + np.cross(rate, np.cross(rate, lever))
        return replace(self, accelerometer=moved @ rotation, gyroscope=self.gyroscope @ rotation, body_T_cam=np.eye(4))

    def digest(self) -> str:
        """Return a hash of every number."""
        found = hashlib.blake2b(digest_size=16)
        for array in (self.timestamps, self.accelerometer, self.gyroscope, self.body_T_cam):
            found.update(np.ascontiguousarray(array, dtype=np.float64).data)
        found.update(repr(self.noise).encode())
        return found.hexdigest()


def read_imu(path: Path) -> ImuSamples:
    """Read samples and what is known of the device.

    Args:
        path: A CSV file, or a folder with ``imu.csv``; ``imu.yaml`` is looked for beside it, and without it the noise
            is that of a phone and the body is the camera.

    Raises:
        InputError: If a file is missing, cannot be read, or does not hold what it should.
    """
    file = path / CSV_NAME if path.is_dir() else path
    rows = _csv_rows(file)
    known = _device(file.with_name(YAML_NAME))
    times = 1e-9 * rows[:, 0] + known.pop("time_offset", 0.0)
    try:
        return ImuSamples(times, rows[:, 4:7], rows[:, 1:4], **known)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def write_imu(samples: ImuSamples, folder: Path) -> None:
    """Write ``imu.csv`` and ``imu.yaml`` into a folder.

    Raises:
        OutputError: If a file cannot be written.
    """
    lines = [_HEADER]
    for time, gyroscope, accelerometer in zip(
        samples.timestamps.tolist(), samples.gyroscope.tolist(), samples.accelerometer.tolist(), strict=True
    ):
        lines.append(",".join([str(round(1e9 * time)), *(f"{value:.9g}" for value in (*gyroscope, *accelerometer))]))
    atomic_write_text(folder / CSV_NAME, "\n".join(lines) + "\n")
    device = {"noise": asdict(samples.noise), "body_T_cam": samples.body_T_cam.tolist()}
    atomic_write_text(folder / YAML_NAME, yaml.safe_dump(device, sort_keys=False))


def _csv_rows(file: Path) -> FloatArray:
    text = read_text(file, what="the CSV of an IMU, as EuRoC has it,").removeprefix("\ufeff")
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = line.split(",")
        try:
            if len(cells) != 7:
                raise ValueError(f"{len(cells)} columns")
            rows.append([float(cell) for cell in cells])
        except ValueError as error:
            if not rows and number == 1:  # a header without '#'
                continue
            raise InputError(
                f"{file}: line {number}: {error}; each line needs 7 numbers: "
                "timestamp [ns], w_x, w_y, w_z [rad/s], a_x, a_y, a_z [m/s^2]"
            ) from error
    if not rows:
        raise InputError(f"{file}: holds no samples")
    return np.array(rows)


def _device(file: Path) -> dict[str, Any]:
    """Return the arguments of :class:`ImuSamples`, and ``time_offset``, that a YAML file gives."""
    if not file.is_file():
        return {}
    try:
        read = parse_yaml(read_text(file))
    except ConfigError as error:
        raise InputError(f"{file}: cannot be read ({error})") from error
    allowed = ("noise", "body_T_cam", "time_offset")
    if not isinstance(read, dict) or set(read) - set(allowed):
        raise InputError(f"{file}: must be a mapping with some of {', '.join(allowed)}, got {reprlib.repr(read)}")
    known: dict[str, Any] = {}
    if "noise" in read:
        known["noise"] = _noise(read["noise"], file)
    try:
        if "body_T_cam" in read:
            known["body_T_cam"] = np.array(read["body_T_cam"], dtype=np.float64)
        if "time_offset" in read:
            known["time_offset"] = float(read["time_offset"])
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}: {error}; body_T_cam is 4 x 4 numbers, time_offset a number of seconds") from error
    return known


def _noise(given: Any, file: Path) -> ImuNoise:
    if isinstance(given, str) and given in NOISE_PRESETS:
        return NOISE_PRESETS[given]
    names = [f.name for f in fields(ImuNoise)]
    if isinstance(given, dict) and set(given) == set(names):
        try:
            return ImuNoise(**given)
        except InputError as error:
            raise InputError(f"{file}: {error}") from error
    raise InputError(
        f"{file}: noise is {reprlib.repr(given)}; give one of {', '.join(NOISE_PRESETS)}, or all of {', '.join(names)}"
    )
