"""Depth and masks that need no network, kept on disk like those that do."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.arrays import BoolArray, Float32Array, FloatArray
from uni4d_fg.config.models import Config
from uni4d_fg.cues.affine_depth import align_affine
from uni4d_fg.cues.cache import FloatMaps, FrameCache, image_key, maker_key
from uni4d_fg.cues.geometric_depth import GeometricDepth, depth_from_motion
from uni4d_fg.cues.interpolated_depth import GridDepths, InterpolatedDepths
from uni4d_fg.cues.motion_masks import motion_masks
from uni4d_fg.cues.network_makers import labels_are_stored, open_labels, store_labels, store_maps
from uni4d_fg.cues.structure.search import StartCameras
from uni4d_fg.errors import Cancelled
from uni4d_fg.frontend.sequence.digest import add_array
from uni4d_fg.frontend.sequence.frames import MaskFolder
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.optim.runners import solver_settings
from uni4d_fg.progress import Reporter
from uni4d_fg.slam.lens.camera_model import CameraModel

ShouldStop = Callable[[], bool]

_RECORD = "start"


def geometric_depth(
    video: Video, tracks: Tracks, is_static: BoolArray, intrinsics: FloatArray, camera: CameraModel | None,
    start: StartCameras | None, images_key: str, folder: Path, config: Config, reporter: Reporter,
    should_stop: ShouldStop,
) -> GeometricDepth:  # fmt: skip
    """Find depth from the motion of the camera, unless it is there already.

    Args:
        video: Images; its masks, if any, say what moves; its intrinsics, if any, are kept.
        tracks: K tracks.
        is_static: (K,) which of them may be believed to stand still.
        intrinsics: (4,) px, known or to start from.
        camera: A lens or a zoom that is known, or a pinhole if there is none; None looks for one.
        start: Cameras that were found before; None for none.
        images_key: Key of the images.
        folder: Of the cues.
        config: Of all parts.
        reporter: Progress.
        should_stop: Polled often.

    Raises:
        DegenerateProblemError: If the motion does not determine it.
        OutputError: If it cannot be stored.
        Cancelled: If ``should_stop`` turned true.
    """
    key = maker_key(
        config.geometric_depth, config.bundle_adjustment, config.input, config.camera, images_key, _tracks_key(tracks),
        _digest(is_static), intrinsics.tolist(), _camera_key(camera), masks_key(video),
        "" if start is None else _digest(start.world_T_cam, start.intrinsics),
    )  # fmt: skip
    target = folder / "depth" / f"motion-{key}"
    cache = FrameCache(target)
    # Without masks it only leads to them: what it is interpolated from takes less time and room than whole maps.
    leads_to_masks = video.masks is None
    stored = _stored_structure(cache, tracks, leads_to_masks)
    names = [f"{frame:06d}" for frame in range(video.num_frames)]
    if stored is None or not (leads_to_masks or all(cache.has_map(name, video.image_size) for name in names)):
        result = depth_from_motion(
            video, tracks, is_static, intrinsics, config, reporter, should_stop, not leads_to_masks, camera,
            start,
        )  # fmt: skip
        arrays: dict[str, npt.NDArray[Any]] = {}
        if leads_to_masks:
            arrays["grids"] = np.stack(_grids(result.depths, reporter, should_stop))
        else:
            store_maps(result.depths, video.image_size, target, "depth maps", reporter, should_stop)
        said = json.dumps([list(result.facts), list(result.warnings), result.start])
        # Written last: with it, the maps are complete.
        cache.put_arrays(
            _RECORD, sparse=result.sparse, intrinsics=result.intrinsics, world_T_cam=result.world_T_cam,
            moving=result.moving, stray=np.packbits(result.stray, axis=1), has_parallax=np.array([result.has_parallax]),
            is_read_at_once=np.array([result.is_read_at_once]),
            focal_sigma=np.array([result.focal_sigma]), camera=result.camera.to_array(), said=np.array(said), **arrays,
        )  # fmt: skip
        stored = _stored_structure(cache, tracks, leads_to_masks)
        assert stored is not None
    facts, warnings, summary = json.loads(str(stored["said"]))
    depths: FrameSource[Float32Array]
    if leads_to_masks:
        depths = GridDepths(tuple(stored["grids"].astype(np.float32)), video.image_size, target.name)
    else:
        depths = FloatMaps(tuple(cache.map_path(name) for name in names), video.image_size)
    camera = CameraModel.of_array(stored["camera"], stored["intrinsics"])
    stray = np.unpackbits(stored["stray"], axis=1, count=tracks.num_frames).astype(bool)
    return GeometricDepth(
        depths, stored["world_T_cam"], camera, stored["sparse"].astype(np.float32), stored["moving"], stray,
        bool(stored["has_parallax"][0]), float(stored["focal_sigma"][0]), tuple(facts), tuple(warnings),
        bool(stored["is_read_at_once"][0]), summary,
    )  # fmt: skip


def _grids(depths: FrameSource[Float32Array], reporter: Reporter, should_stop: ShouldStop) -> list[Float32Array]:
    """Return the grids from which depth of camera motion is interpolated, made on all threads."""
    assert isinstance(depths, InterpolatedDepths)
    reporter.begin("depth maps", len(depths))
    grids = list(depths.all_grids(reporter, should_stop))
    reporter.end()
    return grids


def _stored_structure(cache: FrameCache, tracks: Tracks, with_grids: bool) -> dict[str, npt.NDArray[Any]] | None:
    ranks = {"sparse": 2, "intrinsics": 1, "world_T_cam": 3, "moving": 1, "stray": 2, "said": None}
    ranks |= {"has_parallax": 1, "is_read_at_once": 1, "focal_sigma": 1, "camera": 1}
    ranks |= {"grids": 3} if with_grids else {}
    stored = cache.arrays(_RECORD, ranks)
    return stored if stored is not None and stored["sparse"].shape == tracks.visible.shape else None


def moving_masks(
    video: Video, depths: FrameSource[Float32Array], tracks: Tracks, camera: CameraModel, images_key: str,
    depth_key: str, moving: BoolArray | None, world_T_cam: FloatArray | None, folder: Path, config: Config,
    reporter: Reporter, should_stop: ShouldStop,
) -> tuple[MaskFolder, list[str], list[str]]:  # fmt: skip
    """Find what moves, unless that is there already.

    ``moving`` (K,) are tracks of which it is known, ``world_T_cam`` (T, 4, 4) poses that are, in the unit of the depth.

    Returns:
        T maps of ids, facts and warnings.

    Raises:
        DegenerateProblemError: If the tracks do not determine the cameras.
        OutputError: If a mask cannot be stored.
        Cancelled: If ``should_stop`` turned true.
    """
    key = maker_key(
        config.motion_masks, config.camera_init, config.bundle_adjustment, config.geometric_depth, config.labels,
        config.input, *solver_settings(config), images_key, depth_key, _tracks_key(tracks), camera.intrinsics.tolist(),
        _camera_key(camera), *("" if known is None else _digest(known) for known in (moving, world_T_cam)),
    )  # fmt: skip
    target = folder / "masks" / f"motion-{key}"
    cache = FrameCache(target)
    said = cache.arrays("said", {"said": None})
    if said is not None and labels_are_stored(target, video.num_frames, video.image_size):
        facts, warnings = json.loads(str(said["said"]))
        return open_labels(target, video.num_frames, video.image_size), facts, warnings
    result = motion_masks(
        video, depths, tracks, camera.intrinsics, config.motion_masks, reporter, should_stop, config, moving, camera,
        world_T_cam, isinstance(depths, GridDepths),
    )  # fmt: skip
    cache.put_arrays("said", said=np.array(json.dumps([result.facts, result.warnings])))
    masks = store_labels(iter(result.labels), video.num_frames, video.image_size, target, "masks to disk", reporter)
    return masks, list(result.facts), list(result.warnings)


def video_key(video: Video, should_stop: ShouldStop) -> str:
    """Return a key of all images, and of the depth maps that came with them.

    Raises:
        Cancelled: If ``should_stop`` said so.
    """
    digest = hashlib.blake2b(digest_size=16)
    for frame, image in enumerate(video.images):
        if should_stop():
            raise Cancelled("stopped while reading the video")
        digest.update(image_key(image).encode())
        if video.depths is not None:
            digest.update(np.ascontiguousarray(video.depths[frame]).data)
    return digest.hexdigest()


def masks_key(video: Video) -> str:
    """Return a key of the masks; empty without any."""
    if video.masks is None:
        return ""
    digest = hashlib.blake2b(digest_size=16)
    for mask in video.masks:
        digest.update(np.ascontiguousarray(mask).data)
    return digest.hexdigest()


def _camera_key(camera: CameraModel | None) -> str:
    return "" if camera is None or camera.is_plain else _digest(camera.to_array())


def _tracks_key(tracks: Tracks) -> str:
    return _digest(np.nan_to_num(tracks.uv), tracks.visible, tracks.query_frame)


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        add_array(digest, array)
    return digest.hexdigest()


def aligned_depth(
    disparity: FloatMaps, tracks: Tracks, structure: GeometricDepth, folder: Path, config: Config, reporter: Reporter,
    should_stop: ShouldStop,
) -> tuple[FloatMaps, list[str], list[str]]:  # fmt: skip
    """Scale and shift a network's disparity, frame by frame, to the depth of static tracks.

    Returns:
        T maps (H, W), in the unit of ``structure``; facts; warnings.

    Raises:
        DegenerateProblemError: If no frame has enough points to align to.
        OutputError: If a map cannot be stored.
        Cancelled: If ``should_stop`` turned true.
    """
    fit = align_affine(
        disparity, tracks, structure.sparse, config.affine_depth, reporter=reporter, should_stop=should_stop
    )
    named = [path.name for path in disparity.paths]
    key = maker_key(disparity.paths[0].parent.name, named, _digest(fit.scale, fit.shift), config.affine_depth)
    maps = store_maps(
        fit.depths, disparity.size, folder / "depth" / f"aligned-{key}", "depth maps", reporter, should_stop
    )
    fact = (
        f"relative depth aligned to {int(np.median(fit.points))} points per frame (median), "
        f"noise {100 * fit.sigma:.1f} % of inverse depth"
    )
    return maps, [fact], list(fit.warnings)
