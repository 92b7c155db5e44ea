"""Model cards: what a network's ONNX file takes and gives, so that no network needs code of its own.

A card is a YAML file. Its ``kind`` says which of the models below checks it; unknown fields are refused.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from uni4d_fg.config.base import Section, setting
from uni4d_fg.config.checked import build_section
from uni4d_fg.config.load import presets_folder, read_yaml
from uni4d_fg.errors import ConfigError
from uni4d_fg.reading import check_regular, expanded, resolved

MODELS_VARIABLE = "UNI4D_FG_MODELS"
"""Environment variable that names the folder of ONNX files."""

CardKind = Literal["depth", "segmentation", "tracks"]

_SUFFIXES = (".yaml", ".yml")


def required(description: str, **bounds: Any) -> Any:
    """Declare a field that a card must give."""
    return Field(description=description, **bounds)


class InputSpec(Section):
    """The image that goes in: ``(value * scale - mean) / std`` of 8-bit values, per channel."""

    name: str = required("Name of the input tensor.")
    layout: Literal["NCHW", "NHWC"] = setting("NCHW", "Order of the axes.")
    color: Literal["rgb", "bgr"] = setting("rgb", "Order of the channels, also of 'mean' and 'std'.")
    scale: float = setting(1.0 / 255.0, "Factor on the 8-bit values, before mean and std.", gt=0)
    mean: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "Subtracted after scaling.")
    std: tuple[float, float, float] = setting((1.0, 1.0, 1.0), "Divided by, after that.")
    type: Literal["float32", "float16", "uint8"] = setting("float32", "Type of the tensor.")


class SizeSpec(Section):
    """The size at which an image goes in."""

    rule: Literal["fixed", "longest", "shortest", "image"] = setting(
        "image",
        "'fixed': height x width; 'longest' or 'shortest': that side becomes 'length'; 'image': as it is, up to "
        "'multiple_of'.",
    )
    height: int | None = setting(None, "Height of 'fixed', px.", ge=1)
    width: int | None = setting(None, "Width of 'fixed', px.", ge=1)
    length: int | None = setting(None, "Side of 'longest' and 'shortest', px.", ge=1)
    multiple_of: int = setting(1, "Both sides become the nearest multiple of this.", ge=1)
    keep_aspect: bool = setting(True, "Of 'fixed': fit the image into the size and pad, instead of stretching it.")
    pad: Literal["center", "end"] = setting("center", "Where the image is placed when it is padded.")
    pad_color: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "RGB of the padding, 0 to 255.")

    @model_validator(mode="after")
    def _complete(self) -> SizeSpec:
        if self.rule == "fixed" and (self.height is None or self.width is None):
            raise ValueError("rule 'fixed' needs height and width")
        if self.rule in ("longest", "shortest") and self.length is None:
            raise ValueError(f"rule '{self.rule}' needs length")
        return self


class DepthOutput(Section):
    """The depth map that comes out."""

    name: str = required("Name of the output tensor: (1, H, W), (1, C, H, W) or (1, H, W, C).")
    kind: Literal["metric_depth", "canonical_depth", "inverse_depth", "affine_disparity"] = required(
        "'metric_depth': meters; 'canonical_depth': meters for a camera of 'canonical_focal_px'; 'inverse_depth': "
        "1 / meters; 'affine_disparity': 1 / depth up to an unknown scale and shift."
    )
    channel: int | None = setting(None, "Channel to take where there are several (2 of a point map is z).", ge=0)
    canonical_focal_px: float | None = setting(None, "Of 'canonical_depth': focal length at the network's size.", gt=0)
    min_depth: float = setting(0.0, "Depth below this is missing, m.", ge=0)
    max_depth: float | None = setting(None, "Depth above this is missing, m; null: no bound.", gt=0)

    @model_validator(mode="after")
    def _complete(self) -> DepthOutput:
        if (self.kind == "canonical_depth") != (self.canonical_focal_px is not None):
            raise ValueError("canonical_focal_px goes with kind 'canonical_depth', and only with it")
        return self


class ConfidenceOutput(Section):
    """A confidence map that comes with the depth; its name is empty where there is none."""

    name: str = setting("", "Name of the output tensor; empty: none.")
    channel: int | None = setting(None, "Channel to take where there are several.", ge=0)
    minimum: float | None = setting(None, "Depth of less confidence is missing; null: all is kept.")


class IntrinsicsOutput(Section):
    """The camera that comes with the depth; its name is empty where there is none."""

    name: str = setting("", "Name of the output tensor; empty: none.")
    kind: Literal["matrix", "focal_px", "fov_deg", "fov_rad"] = setting(
        "matrix",
        "'matrix': (3, 3), px at the network's size; 'focal_px': focal length, px at the network's width; 'fov_deg', "
        "'fov_rad': horizontal field of view of the image.",
    )
    pixel_center: float = setting(
        0.5, "Coordinate of the center of the first pixel in the principal point of 'matrix': 0 or 0.5.", ge=0, le=0.5
    )


class DownloadSpec(Section):
    """Where the ONNX file of a card is published; it is fetched only when the user asks for it by name."""

    url: str = required("Address of the ONNX file.", pattern=r"^https?://")
    pointer: str = setting(
        "", "Address of its Git LFS pointer, the SHA-256 and size that its source publishes; empty: the card's sha256."
    )
    size_bytes: int | None = setting(None, "Size of the file, bytes; null: as the pointer says.", ge=1)


class BaseCard(Section):
    """What every card has."""

    kind: CardKind = required("What the network makes.")
    title: str = required("Name of the network, for messages.")
    file: str = required("ONNX file, relative to the folder of models or to that of the card.")
    sha256: str | None = setting(None, "SHA-256 of the file, hexadecimal; null: not checked.")
    license: str = required("License of the weights.")
    source: str = setting("", "Where the network is published.")
    export: str = required("How to make the ONNX file.")
    download: DownloadSpec | None = setting(None, "Where the ONNX file is published; null: it has to be made.")
    input: InputSpec = required("The image that goes in.")
    size: SizeSpec = setting(SizeSpec(), "The size at which it goes in.")

    @model_validator(mode="after")
    def _can_be_checked(self) -> BaseCard:
        if self.download is not None and not self.download.pointer and self.sha256 is None:
            raise ValueError("a file that is downloaded needs a checksum: sha256, or download.pointer")
        return self


class DepthCard(BaseCard):
    """A network that maps one image to one depth map."""

    kind: Literal["depth"] = required("Depth.")
    depth: DepthOutput = required("The depth map that comes out.")
    confidence: ConfidenceOutput = setting(ConfidenceOutput(), "Its confidence.")
    intrinsics: IntrinsicsOutput = setting(IntrinsicsOutput(), "The camera that comes with it.")


class SegmentationOutputs(Section):
    """The masks that come out."""

    format: Literal["semantic", "yolo_seg", "masks"] = required(
        "'semantic': scores of every class per pixel; 'yolo_seg': candidates with coefficients of prototype masks; "
        "'masks': boxes, classes, scores and one mask each."
    )
    scores: str = setting("", "Of 'semantic': output (1, C, H, W), or class ids (1, H, W). Of 'masks': scores (N,).")
    activation: Literal["none", "sigmoid", "softmax"] = setting(
        "none", "Of 'semantic': what turns the output into probabilities; 'none' where it holds them."
    )
    candidates: str = setting(
        "output0", "Of 'yolo_seg': (1, 4 + C + M, A): box center and size, classes, coefficients."
    )
    prototypes: str = setting("output1", "Of 'yolo_seg': (1, M, h, w).")
    boxes: str = setting("boxes", "Of 'masks': (N, 4) x0, y0, x1, y1, px at the network's size.")
    labels: str = setting("labels", "Of 'masks': (N,) numbers of classes.")
    masks: str = setting("masks", "Of 'masks': (N, H, W) or (N, 1, H, W) probabilities, at the network's size.")


class SegmentationCard(BaseCard):
    """A network that maps one image to the things in it."""

    kind: Literal["segmentation"] = required("Segmentation.")
    outputs: SegmentationOutputs = required("The masks that come out.")
    classes: tuple[str, ...] = required("Names of the classes, in the order of their numbers.", min_length=1)
    moving: tuple[str, ...] | None = setting(
        None, "Classes that may move, where --classes does not say; null: people, animals and vehicles."
    )
    min_score: float = setting(0.5, "Least score of a thing, or probability of a pixel ('semantic').", ge=0, le=1)
    mask_threshold: float = setting(0.5, "Least probability of a pixel of an instance.", ge=0, le=1)
    nms_iou: float = setting(0.5, "Of two boxes of a class that overlap by more, the weaker is dropped.", ge=0, le=1)
    min_area_fraction: float = setting(0.0005, "Smaller pieces are dropped, as a part of the image.", ge=0, lt=1)


class VideoSpec(Section):
    """Frames and queries that a point tracker takes."""

    axes: Literal["NTCHW", "NTHWC"] = setting("NTCHW", "Order of the axes of the frames.")
    frames: int = required("Frames per window.", ge=2)
    points: int | None = setting(None, "Points per call, where the file fixes it; null: any number.", ge=1)
    queries: str = required("Name of the input (1, N, 3) of queries.")
    query_order: Literal["txy", "tyx"] = required("What its three columns are: frame in the window, and pixel.")
    pixel_center: float = setting(
        0.0, "Coordinate of the center of the first pixel, in and out: 0 or 0.5.", ge=0, le=0.5
    )


class TrackOutputs(Section):
    """Tracks that a point tracker gives."""

    tracks: str = required("Name of the output of positions (x, y), px at the network's size.")
    order: Literal["TN", "NT"] = required("Order of frames and points: (1, T, N, ...) or (1, N, T, ...).")
    visibility: str = required("Name of the output that says what is seen.")
    visibility_kind: Literal["probability", "logit", "occlusion_logit"] = required("What it holds.")
    confidence: str = setting("", "Output that says how sure the position is; empty: none.")
    confidence_kind: Literal["probability", "logit", "error_logit"] = setting("probability", "What it holds.")
    min_probability: float = setting(0.5, "Seen where visibility times confidence is at least this.", ge=0, le=1)


class TracksCard(BaseCard):
    """A network that follows points through a window of frames."""

    kind: Literal["tracks"] = required("Tracks.")
    video: VideoSpec = required("Frames and queries that go in.")
    outputs: TrackOutputs = required("What comes out.")
    overlap: int = setting(4, "Frames that a window shares with the one before.", ge=1)

    @model_validator(mode="after")
    def _windows_advance(self) -> TracksCard:
        if self.overlap >= self.video.frames:
            raise ValueError(f"overlap {self.overlap} must be smaller than the {self.video.frames} frames of a window")
        if self.size.rule != "fixed":
            raise ValueError("size.rule must be 'fixed' for a point tracker")
        return self


Card = DepthCard | SegmentationCard | TracksCard

_MODELS: dict[str, type[Section]] = {"depth": DepthCard, "segmentation": SegmentationCard, "tracks": TracksCard}


@dataclass(frozen=True)
class ModelFile:
    """A card, where it was read from, and the ONNX file that goes with it."""

    name: str
    """Name of the card: that of its file."""
    card: Card
    path: Path
    """The card's file."""
    weights: Path
    """The ONNX file; whether it exists is not checked here."""

    def searched(self) -> tuple[Path, ...]:
        """Return where the ONNX file is looked for."""
        return _places(self.card, self.path)


def models_folder() -> Path:
    """Return the user's folder of ONNX files: that of ``UNI4D_FG_MODELS``, or one in the user's data folder."""
    named = os.environ.get(MODELS_VARIABLE)
    if named:
        return expanded(named)
    data = os.environ.get("XDG_DATA_HOME")
    return (expanded(data) if data else Path.home() / ".local" / "share") / "uni4d_fg" / "models"


def cards_folder() -> Path:
    """Return the folder of the cards that come with the package."""
    return presets_folder() / "models"


@cache
def card_names() -> tuple[str, ...]:
    """Return the names of the cards that come with the package."""
    return tuple(sorted(path.stem for path in cards_folder().glob("*.yaml")))


def load_card(path: Path) -> Card:
    """Read and check a card.

    Raises:
        ConfigError: If the file is missing, not YAML, or a field is unknown, missing or of a wrong value.
    """
    values = read_yaml(path)
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: holds {type(values).__name__}, but a model card is a mapping of fields")
    model = _MODELS.get(str(values.get("kind")))
    if model is None:
        raise ConfigError(f"{path}: kind: got {values.get('kind')!r}, but one of {', '.join(_MODELS)} is expected")
    card: Any = build_section(model, values, lambda _: str(path))
    return card  # type: ignore[no-any-return]


def find_model(choice: str, kind: CardKind) -> ModelFile:
    """Find a card and its ONNX file from what was said on the command line.

    Args:
        choice: ``CARD`` or ``CARD=FILE``: the name of a card of the package or the path of a card, and the ONNX
            file to use with it.
        kind: What the card must be for.

    Raises:
        ConfigError: If there is no such card, it is not valid, or it is for something else.
        InputError: If ``FILE`` is given and does not exist.
    """
    named, _, file = choice.partition("=")
    path = expanded(named)
    if path.suffix.lower() == ".onnx":
        raise ConfigError(
            f"{choice}: an ONNX file needs a card that says what it takes and gives: CARD={choice}, where CARD is one "
            f"of {', '.join(_names_of(kind))} or a YAML file"
        )
    if path.suffix.lower() not in _SUFFIXES:
        if named not in card_names():
            raise ConfigError(
                f"{named}: no such model card; choose one of {', '.join(_names_of(kind))}, or give a YAML file"
            )
        path = cards_folder() / f"{named}.yaml"
    card = load_card(path)
    if card.kind != kind:
        raise ConfigError(f"{named}: this card is for {card.kind}, but one for {kind} is needed")
    if file:
        weights = expanded(file)
        check_regular(weights, f"the ONNX file of {named}=")
        return ModelFile(path.stem, card, path, resolved(weights))
    places = _places(card, path)
    weights = next((place for place in places if place.is_file()), places[0])
    return ModelFile(path.stem, card, path, weights)


def _places(card: Card, path: Path) -> tuple[Path, ...]:
    file = expanded(card.file)
    if file.is_absolute():
        return (file,)
    return (models_folder() / file, resolved(path.parent / file))


def _names_of(kind: str) -> list[str]:
    return [name for name in card_names() if load_card(cards_folder() / f"{name}.yaml").kind == kind]
