r"""Whether the tracks of a grown scene ask for a lens, or for a focal length per frame, and which.

A pinhole that was fitted to tracks of another camera is a minimum that two steps with little damping leave, as in
:mod:`uni4d_fg.slam.lens`: on clips without a lens or zoom they take away 0.07 % of the reprojection energy by
distortion and change a focal length per frame by 1 % at most, on others by 0.6 % and 1.6 % at least. Only where more
is found another camera is looked for.

A lens bends the cameras little, so that its search starts from them. Bundle adjustment with a lens goes part of the way
only, as the tracks that agree with a pinhole are those that a lens bends least; with tracks judged and triangulated
anew, two or three rounds end at the lens, from a focal length of twice its own (k1 of -0.25), too. Only the cameras of
a pan are bent farther than that: what pairs of frames tell of a lens, before any camera is known, is tried as well.

A zoom takes all cameras along; it is looked for in :mod:`uni4d_fg.cues.structure.zoom_search`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from uni4d_fg.arrays import Float32Array
from uni4d_fg.config.models import Config
from uni4d_fg.cues.structure.camera_fit import Fitted, TrackJudge, comparing, fit_lens, part_of, probing
from uni4d_fg.cues.structure.growing import GrowingScene
from uni4d_fg.cues.structure.lens_agreement import halves_agree_on_lens
from uni4d_fg.cues.structure.reversal import exchanged_and_refined
from uni4d_fg.cues.structure.zoom_search import (
    Grown,
    asks_for_zoom,
    explains_most,
    find_zoom,
    focal_range,
    grown_anew,
    may_be_zoom,
    similar_zoom,
)
from uni4d_fg.errors import SolverError
from uni4d_fg.geometry.lens import LensModel
from uni4d_fg.slam.lens.camera_model import CameraModel
from uni4d_fg.slam.lens.sharpness import sharp_frames
from uni4d_fg.slam.lens.strength import Strength, strength_of
from uni4d_fg.slam.stages.observations import Observations

_MIN_LENS_EVIDENCE = 0.003
"""Part of the reprojection energy that distortion must take away for a lens to be looked for."""
_MIN_SECOND_EVIDENCE = 0.004
"""Part of what a lens of one parameter leaves that a second one must take away: 0.31 % at most where there is none, and
k2 of 0.03 beside k1 of -0.1 takes 0.5 to 3.6 %."""
_LENS_ROUNDS = 4
_LENS_STAYS = 0.003
"""Change of k1 in a round below which it is found."""
_MUCH = 0.1
"""Part of the energy that a lens must take away to be told of where halves of the tracks disagree on it; errors of a
tracker take away up to 0.03."""
_HOPELESS = 0.2
"""Part by which a lens has more energy than a rival, after a round, at which no other round follows: a scene with near
and far exchanged that took over had 0.15 less from the first round on, one that did not had 0.66 more."""


@dataclass(frozen=True)
class FoundCamera:
    """A camera that is no plain pinhole."""

    camera: CameraModel
    lens_gain: float
    """Part of the reprojection energy that a lens takes away, if one was looked for."""
    open_focal: tuple[float, ...] = ()
    """Shortest and longest focal length, px, of a zoom that explains all tracks better, but not most of them."""
    told: CameraModel | None = None
    """The lens that pairs of frames tell, if one was refined from that."""
    denied_px: float = 0.0
    """How far distortion that explains the tracks better, but that is no lens in all of them, moves a pixel at most."""


def find_camera(
    scene: GrowingScene,
    real: Observations,
    image_size: tuple[int, int],
    config: Config,
    grown: Grown,
    proposed: CameraModel | None = None,
    blur_px: Float32Array | None = None,
    told: CameraModel | None = None,
) -> FoundCamera | None:
    """Return the camera that the tracks ask for, or None where that is a pinhole that does not zoom, beyond doubt.

    Args:
        scene: Grown with such a pinhole.
        real: All observations, as the images show them.
        image_size: (height, width), px.
        config: Section ``camera``: which cameras to look for.
        grown: Grows a scene with another camera.
        proposed: A camera from elsewhere: its zoom, if it has one, is tried whatever the scene asks for.
        blur_px: (T,) of the frames, where it is known: sharp ones tell the lens.
        told: The lens that pairs of frames tell: a scene is grown with it, too.

    Raises:
        Cancelled: If asked to stop.
        SolverError: If bundle adjustment fails.
    """
    settings = config.camera
    plain = _pinhole(scene, config, blur_px)
    part = plain.scene
    if not part.good.any():
        return None
    if proposed is not None and proposed.zoom is None:
        proposed = None
    similar = similar_zoom(scene, image_size) if asks_for_zoom(plain, config) else None
    asks_for_lens = settings.model == "auto" and (
        told is not None
        or fit_lens(plain, "SIMPLE_RADIAL", config, probing(config), settled=True).evidence >= _MIN_LENS_EVIDENCE
    )
    if proposed is None and similar is None and not asks_for_lens:
        return None
    judge = TrackJudge(part.observations, config.bundle_adjustment.reprojection_sigma_px)
    best, gain, open_focal, denied_px = plain, 0.0, tuple[float, ...](), 0.0
    if asks_for_lens:
        lens = None if told is None else _grown_with(told, plain, judge, real, config, grown)
        if lens is None or judge.better(lens, plain)[0] <= 0.0:
            lens, told = _refined(plain, judge, config), None
        gain = judge.better(lens, plain)[0]
        is_beyond = lens_strength(lens.camera, image_size, config) is Strength.BEYOND
        if is_lens(lens.camera, image_size, gain, config) and halves_agree_on_lens(lens, image_size, config):
            best = judge.anew(_to_its_end(lens, config))
        elif gain >= (settings.min_evidence_unsure if is_beyond else _MUCH):
            denied_px = lens.camera.lens.displacement(lens.camera.intrinsics, image_size)
    if proposed is not None or similar is not None:
        zoom = find_zoom(proposed, similar, plain, judge, scene, real, config, grown)
        if zoom is not None and settings.zoom == "on":
            best = zoom
        elif zoom is not None and may_be_zoom(zoom, best, judge, config):
            if explains_most(zoom, plain, judge, config):
                best = zoom
            else:
                open_focal = focal_range(zoom)
    if best is plain and not open_focal and denied_px == 0.0:
        return None
    told = told if best.camera.zoom is None else None
    return FoundCamera(best.camera, gain, open_focal, told, denied_px if best is plain else 0.0)


def needs_zoom(scene: GrowingScene, config: Config, blur_px: Float32Array | None = None) -> bool:
    """Tell whether the tracks of a scene that was grown without a zoom ask for one. Arguments as of `find_camera`."""
    plain = _pinhole(scene, config, blur_px)
    return not plain.scene.good.any() or asks_for_zoom(plain, config)


def _pinhole(scene: GrowingScene, config: Config, blur_px: Float32Array | None) -> Fitted:
    """Return the part of a scene that cameras are fitted to, with the pinhole that it was grown with."""
    part = part_of(scene, config.camera.observations, sharp_frames(blur_px, len(scene.registered)))
    return Fitted(CameraModel(part.intrinsics), part)


def lens_strength(camera: CameraModel, image_size: tuple[int, int], config: Config) -> Strength:
    """Return how strong the lens of a camera is."""
    displacement = camera.lens.displacement(camera.intrinsics, image_size)
    return strength_of(camera.lens, displacement, image_size, config.camera)


def is_lens(camera: CameraModel, image_size: tuple[int, int], gain: float, config: Config) -> bool:
    """Tell whether a lens bends the image enough, for what it gains: errors of a tracker mimic a weak one."""
    strength = lens_strength(camera, image_size, config)
    if not strength.is_lens:
        return False
    return gain >= config.camera.min_evidence_unsure if strength is Strength.WEAK else gain > 0.0


def _refined(plain: Fitted, judge: TrackJudge, config: Config) -> Fitted:
    """Fit a radial lens to the cameras of a pinhole, and from there once more with near and far exchanged."""
    found = _with_lens(plain, plain, judge, config)
    other = exchanged_and_refined(found.scene)
    # With a lens that is not its own the right scene explains less, but what it explains it explains better.
    if other is None or not other.noise_px < found.scene.noise_px:
        return found
    try:
        mirrored = _with_lens(replace(found, scene=other), found, judge, config)
    except SolverError:
        return found
    return mirrored if judge.better(mirrored, found)[0] > 0.0 else found


def _to_its_end(lens: Fitted, config: Config) -> Fitted:
    """Fit a lens that was taken until it stays: compared with others it was before."""
    return fit_lens(lens, lens.camera.lens.model, config, config.camera.to_the_end)


def _grown_with(
    told: CameraModel, plain: Fitted, judge: TrackJudge, real: Observations, config: Config, grown: Grown
) -> Fitted | None:
    """Return the lens that a scene leads to which is grown with one that was told; None where nothing grows."""
    start = grown_anew(told, plain, real, config, grown)
    try:
        return None if start is None else _with_lens(judge.anew(start), plain, judge, config)
    except SolverError:
        return None


def _with_lens(found: Fitted, rival: Fitted, judge: TrackJudge, config: Config) -> Fitted:
    """Fit one radial parameter, and a second one where there is one already or it takes energy away.

    Which tracks agree, and where they are triangulated, depends on the lens: it is fitted again until it stays, or
    until it explains much less than a rival.
    """
    options = comparing(config, config.camera.max_iterations)
    first: LensModel = "RADIAL" if found.camera.lens.model == "RADIAL" else "SIMPLE_RADIAL"
    for _ in range(_LENS_ROUNDS):
        before = found.camera.lens.padded[0]
        found = judge.anew(fit_lens(found, first, config, options))
        if judge.better(found, rival)[0] < -_HOPELESS:
            return found
        if abs(found.camera.lens.padded[0] - before) < _LENS_STAYS:
            break
    if first == "RADIAL":
        return found
    richer = fit_lens(found, "RADIAL", config, options, settled=True)
    return found if richer.evidence < _MIN_SECOND_EVIDENCE else judge.anew(richer)
