"""What tests of lens and zoom share: a quick configuration, scenes behind a lens, their tracks, and the search."""

from __future__ import annotations

from uni4d_fg.config.load import load_config
from uni4d_fg.config.models import Config
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.frontend.sequence.model import Sequence
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence
from uni4d_fg.frontend.track_model import LabelledTracks
from uni4d_fg.frontend.tracks.labels import label_tracks
from uni4d_fg.geometry.lens import Lens
from uni4d_fg.slam.lens.calibration import LensCalibration, calibrate_lens


def config(*changes: str) -> Config:
    return load_config("default", ["output.clouds=false", "output.pictures=false", *changes])


def scene_behind(lens: Lens, **more: object) -> Sequence:
    plain = {"num_frames": 20, "render_images": False, "camera_model": lens.model, "distortion": lens.parameters}
    return make_synthetic_sequence(SyntheticSceneConfig(**(plain | more)))


def labelled(sequence: Sequence) -> LabelledTracks:
    settings = config()
    assert sequence.tracks is not None
    return label_tracks(sequence.tracks, sequence, settings.labels, settings.input)


def calibrated(sequence: Sequence, *changes: str) -> LensCalibration:
    return calibrate_lens(labelled(sequence), sequence.image_size, sequence.intrinsics, config(*changes))
