"""Measurements from files as what a run adds to its stages."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from uni4d_fg.arrays import FloatArray
from uni4d_fg.config.measurements import MeasurementsConfig
from uni4d_fg.frontend.measurements.gps import read_gps
from uni4d_fg.frontend.measurements.odometry import read_odometry
from uni4d_fg.frontend.measurements.relative_poses import read_relative_poses
from uni4d_fg.optim.added_factors import FactorSource
from uni4d_fg.reading import MAX_TEXT_BYTES, read_bytes
from uni4d_fg.slam.measurements.gps import GpsSource
from uni4d_fg.slam.measurements.odometry import OdometrySource
from uni4d_fg.slam.measurements.relative_poses import RelativePoseSource


@dataclass(frozen=True)
class MeasurementFiles:
    """Files of measurements of the camera; see ``docs/measurements.md`` for their formats."""

    odometry: Path | None = None
    """TUM trajectory, with or without sigmas."""
    gps: Path | None = None
    """CSV."""
    relative_poses: Path | None = None
    """g2o."""


@dataclass(frozen=True)
class Measurements:
    """What the files said."""

    sources: list[FactorSource] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)
    """One line per file, for the summary."""
    warnings: list[str] = field(default_factory=list)


def read_measurements(files: MeasurementFiles, timestamps: FloatArray, config: MeasurementsConfig) -> Measurements:
    """Read the files of a sequence.

    Args:
        files: Which.
        timestamps: (T,) s of the frames.
        config: How they are taken.

    Raises:
        InputError: If a file cannot be read or fits no frame; the message names the line.
        ConfigError: If a field of the configuration does not fit.
    """
    out = Measurements()
    count = len(timestamps)
    if files.odometry is not None:
        odometry, warnings = read_odometry(files.odometry, timestamps, config)
        out.sources.append(OdometrySource(odometry, _fingerprint("odometry", files.odometry, config)))
        out.facts.append(f"odometry of {len(odometry.frame)} of {count} frames from {files.odometry.name}")
        out.warnings.extend(warnings)
    if files.gps is not None:
        positions, warnings = read_gps(files.gps, timestamps, config)
        source = GpsSource.of(positions, config, _fingerprint("gps", files.gps, config))
        out.sources.append(source)
        out.facts.append(f"GPS positions of {len(positions.frame)} of {count} frames from {files.gps.name}")
        out.warnings.extend([*warnings, *_spread_warning(files.gps, source)])
    if files.relative_poses is not None:
        poses, warnings = read_relative_poses(files.relative_poses, count)
        key = _fingerprint("relative poses", files.relative_poses, config)
        out.sources.append(RelativePoseSource(poses, config.relative_poses_kernel, key))
        out.facts.append(f"{len(poses.first)} relative poses from {files.relative_poses.name}")
        out.warnings.extend(warnings)
    return out


def _spread_warning(path: Path, source: GpsSource) -> list[str]:
    """Say so if GPS can never join."""
    if source.is_of_use:
        return []
    return [
        f"{path.name} is not used: its {len(source.positions.frame)} positions lie so close together, for their "
        "sigmas, that they do not say how the map lies (measurements.gps_min_spread)"
    ]


def _fingerprint(kind: str, path: Path, config: MeasurementsConfig) -> str:
    """Return a hash of a file's content and of how it is taken.

    Raises:
        InputError: If the file cannot be read.
    """
    content = read_bytes(path, MAX_TEXT_BYTES, "a file of measurements")
    digest = hashlib.blake2b(f"{kind} {config.model_dump_json()}".encode(), digest_size=16)
    digest.update(content)
    return digest.hexdigest()
