"""Networks run over a video frame by frame, each result on disk before the next is begun."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uni4d_fg.arrays import Float32Array, FloatArray, Int32Array
from uni4d_fg.config.motion_masks import InstanceConfig
from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.cache import FloatMaps, FrameCache, Rate, image_key, maker_key, write_labels
from uni4d_fg.cues.card import find_model
from uni4d_fg.cues.depth_network import DepthNetwork
from uni4d_fg.cues.detections import FrameDetections
from uni4d_fg.cues.instances import associate_instances
from uni4d_fg.cues.point_tracker_network import PointTrackerNetwork
from uni4d_fg.cues.segmentation_network import SegmentationNetwork
from uni4d_fg.errors import Cancelled, InputError
from uni4d_fg.frontend.sequence.frames import MaskFolder
from uni4d_fg.frontend.sequence.model import FrameSource, Video
from uni4d_fg.frontend.track_model import Tracks
from uni4d_fg.frontend.tracks.io import load_tracks, save_tracks
from uni4d_fg.optim.threads import thread_count, workers_in_order
from uni4d_fg.progress import Reporter

ShouldStop = Callable[[], bool]


@dataclass(frozen=True)
class NetworkDepth:
    """Depth of every frame by a network."""

    maps: FloatMaps
    """T maps (H, W): meters, or disparity up to scale and shift per frame."""
    is_affine: bool
    per_frame_intrinsics: FloatArray
    """(T, 4) px; NaN rows where the network says nothing."""
    title: str
    """Name of the network."""
    assumed_focal: bool
    """Whether its scale rests on a focal length that was guessed."""


def network_depth(
    video: Video, choice: str, focal_px: float, focal_known: bool, folder: Path, config: NetworkConfig,
    reporter: Reporter, should_stop: ShouldStop,
) -> NetworkDepth:  # fmt: skip
    """Estimate depth with the card ``choice`` (``CARD`` or ``CARD=FILE``); maps are kept in ``folder``.

    Raises:
        ConfigError: If the card is wrong.
        InputError: If the network or a frame cannot be used.
        OutputError: If a map cannot be written.
        Cancelled: If ``should_stop`` said so; maps that are done are kept.
    """
    network = DepthNetwork(find_model(choice, "depth"), config)
    card = network.card
    focal = [focal_px] if network.needs_focal else []
    key = maker_key(network.network.digest, card.input, card.size, card.depth, card.confidence, card.intrinsics, focal)
    cache = FrameCache(folder / "depth" / f"{network.network.model.name}-{key}")
    paths, cameras = [], np.full((video.num_frames, 4), np.nan)
    reporter.begin(f"depth: {card.title}", video.num_frames)
    rate = Rate(video.num_frames, time.monotonic)
    for frame, image in enumerate(video.images):
        _check(should_stop, f"depth of {frame} of {video.num_frames} frames is kept")
        name = image_key(image)
        made = not cache.has_map(name, video.image_size)
        if made:
            estimate = network.estimate(image, focal_px)
            if estimate.intrinsics is not None:
                cache.put_camera(name, estimate.intrinsics)
            cache.put_map(name, estimate.values)
        camera = cache.camera(name) if card.intrinsics.name else None
        if camera is not None:
            cameras[frame] = camera
        paths.append(cache.map_path(name))
        reporter.advance(frame + 1, rate.text(frame + 1, made))
    reporter.end()
    return NetworkDepth(
        FloatMaps(tuple(paths), video.image_size), network.is_affine, cameras, card.title,
        network.needs_focal and not focal_known,
    )  # fmt: skip


def network_masks(
    video: Video, choice: str, classes: tuple[str, ...] | None, folder: Path, config: NetworkConfig,
    instances: InstanceConfig, reporter: Reporter, should_stop: ShouldStop,
) -> tuple[MaskFolder, str, int]:  # fmt: skip
    """Segment what may move with the card ``choice`` and number it over the video.

    Returns:
        T maps of ids, the name of the network, and the number of instances.

    Raises:
        ConfigError: If the card is wrong, or no class of it moves.
        InputError: If a class is unknown, or the network or a frame cannot be used.
        OutputError: If a mask cannot be written.
        Cancelled: If ``should_stop`` said so; what was found in frames that are done is kept.
    """
    network = SegmentationNetwork(find_model(choice, "segmentation"), config, classes)
    card, digest, name = network.card, network.network.digest, network.network.model.name
    thresholds = [card.min_score, card.mask_threshold, card.nms_iou, card.min_area_fraction]
    key = maker_key(digest, card.input, card.size, card.outputs, thresholds, network.class_ids.tolist())
    cache = FrameCache(folder / "detections" / f"{name}-{key}")
    images = video.images
    count = video.num_frames
    names: list[str] = []
    reporter.begin(f"masks: {card.title}", count)
    rate = Rate(count, time.monotonic)
    for frame, image in enumerate(images):
        _check(should_stop, f"masks of {frame} of {count} frames are kept")
        names.append(image_key(image))
        made = cache.detections(names[-1], video.image_size) is None
        if made:
            cache.put_detections(names[-1], network.detect(image))
        reporter.advance(frame + 1, rate.text(frame + 1, made))
    reporter.end()

    def detections() -> Iterator[FrameDetections]:
        for stored in names:
            found = cache.detections(stored, video.image_size)
            if found is None:
                raise InputError(f"{cache.folder}: {stored}.npz was removed while it was in use; start again")
            yield found

    # Numbers depend on all frames before, so that they have a folder of their own.
    chain = maker_key(key, instances, names)
    target = folder / "masks" / f"{name}-{chain}"
    labels = associate_instances(detections(), images, instances, should_stop)
    masks = store_labels(labels, count, video.image_size, target, "instances over time", reporter)
    return masks, card.title, max((int(mask.max()) for mask in masks), default=0)


def network_tracks(
    video: Video, choice: str, folder: Path, config: NetworkConfig, reporter: Reporter, should_stop: ShouldStop
) -> tuple[Tracks, str, Path]:
    """Track points with the card ``choice``; every window's result is kept until all is done.

    Returns:
        The tracks, the name of the network, and the file where they are kept.

    Raises:
        ConfigError: If the card is wrong.
        InputError: If the network or a frame cannot be used.
        OutputError: If the tracks cannot be written.
        Cancelled: If ``should_stop`` said so; windows that are done are kept.
    """
    network = PointTrackerNetwork(find_model(choice, "tracks"), config)
    card, digest = network.card, network.network.digest
    reporter.begin(f"tracks: {card.title}", None)
    names = []
    for image in video.images:
        _check(should_stop, "nothing was lost")
        names.append(image_key(image))
    grid = [config.grid_columns, config.grid_rows, config.query_interval, config.margin_px, config.min_observations]
    key = maker_key(digest, card.input, card.size, card.video, card.outputs, card.overlap, grid, names)
    path = folder / "tracks" / f"{network.network.model.name}-{key}.npz"
    try:
        tracks = load_tracks(path) if path.is_file() else None
    except InputError:
        tracks = None
    if tracks is None:
        cache = FrameCache(path.with_suffix(""))
        tracks = network.track(
            video.images, lambda done, total: reporter.advance(done, f"window {done} of {total}"), should_stop, cache
        )
        save_tracks(path, tracks)
        cache.clear()
    reporter.end(f"{tracks.num_tracks} tracks")
    return tracks, card.title, path


def store_labels(
    labels: Iterator[Int32Array], count: int, size: tuple[int, int], folder: Path, task: str, reporter: Reporter
) -> MaskFolder:
    """Write label maps as they come, unless all are there, and open them.

    Raises:
        OutputError: If one cannot be written.
    """
    if not labels_are_stored(folder, count, size):
        paths = _label_paths(folder, count)
        reporter.begin(task, count)
        for frame, mask in enumerate(labels):
            write_labels(paths[frame], mask)
            reporter.advance(frame + 1)
        FrameCache(folder).mark_complete()
        reporter.end()
    return open_labels(folder, count, size)


def labels_are_stored(folder: Path, count: int, size: tuple[int, int]) -> bool:
    """Tell whether all label maps of a video of (height, width) are there and undamaged: PNG has checksums."""
    try:
        return FrameCache(folder).is_complete() and all(mask.shape == size for mask in open_labels(folder, count, size))
    except InputError:
        return False


def open_labels(folder: Path, count: int, size: tuple[int, int]) -> MaskFolder:
    """Open the label maps that :func:`store_labels` wrote."""
    return MaskFolder(_label_paths(folder, count), size)


def _label_paths(folder: Path, count: int) -> tuple[Path, ...]:
    return tuple(folder / f"{frame:06d}.png" for frame in range(count))


def store_maps(
    maps: FrameSource[Float32Array], size: tuple[int, int], folder: Path, task: str, reporter: Reporter,
    should_stop: ShouldStop,
) -> FloatMaps:  # fmt: skip
    """Make and write maps (H, W) on all threads, unless all are there, and open them.

    Raises:
        OutputError: If one cannot be written.
        Cancelled: If ``should_stop`` said so.
    """
    cache, count = FrameCache(folder), len(maps)
    names = [f"{frame:06d}" for frame in range(count)]

    def store(frame: int) -> None:
        _check(should_stop, f"{frame} of {count} frames are done")
        cache.put_map(names[frame], maps[frame])

    if not all(cache.has_map(name, size) for name in names):
        reporter.begin(task, count)
        rate = Rate(count, time.monotonic)
        with workers_in_order(thread_count()) as mapped:
            for done, _ in enumerate(mapped(store, list(range(count))), start=1):
                reporter.advance(done, rate.text(done, True))
        reporter.end()
    return FloatMaps(tuple(cache.map_path(name) for name in names), size)


def _check(should_stop: ShouldStop, kept: str) -> None:
    if should_stop():
        raise Cancelled(f"stopped while making cues: {kept}")
