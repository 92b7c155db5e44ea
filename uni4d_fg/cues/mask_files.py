"""Masks of an instance segmenter or a video segmenter, in the files that these programs write.

| from | what is in the path |
|---|---|
| DEVA | ``Annotations/*.png`` with RGB-coded ids, and ``pred.json`` with the class of every id |
| SAM 2 | one PNG per frame with a palette whose index is the id, or a folder per object with a PNG per frame |
| Mask R-CNN, detectron2 and others | a COCO result file: a list of masks as run lengths, with frame, class and score |
| COCO and YouTube-VIS-like files | ``images``, ``categories``, ``annotations`` with run lengths, perhaps ``track_id`` |
| any | one PNG or ``.npy`` of ids per frame, as in the native layout |

Files whose masks carry no number that lasts over time are joined to instances by overlap.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from uni4d_fg.arrays import ImageArray, Int32Array
from uni4d_fg.config.motion_masks import InstanceConfig
from uni4d_fg.cues.coco_files import open_coco_masks
from uni4d_fg.cues.detections import movable_class_ids
from uni4d_fg.frontend.sequence.decode import MAX_PIXELS, read_mask
from uni4d_fg.frontend.sequence.frames import FileFrames, LazyFrames
from uni4d_fg.frontend.sequence.layout import MASK_SUFFIXES, frame_numbers, is_visible_file, list_frames, subfolders
from uni4d_fg.frontend.sequence.model import FrameSource
from uni4d_fg.frontend.sequence.problems import SequenceProblem, some_of
from uni4d_fg.reading import MAX_IMAGE_BYTES, check_regular, is_present, list_folder, read_bytes, read_json

_ANNOTATION_FOLDERS = ("Annotations", "pan_pred")
_DEVA_CLASSES = "pred.json"


def open_mask_files(
    path: Path,
    size: tuple[int, int],
    num_frames: int,
    frame_names: tuple[str, ...] = (),
    *,
    images: FrameSource[ImageArray] | None = None,
    classes: tuple[str, ...] | None = None,
    class_names: dict[int, str] | None = None,
    config: InstanceConfig | None = None,
) -> FrameSource[Int32Array]:
    """Open masks in any of the known forms.

    Args:
        path: Folder or ``.json`` file.
        size: (height, width) of the images, px.
        num_frames: Number of images T.
        frame_names: (T,) stems of the images; masks are matched to them by name where the names agree, and by order
            otherwise.
        images: T images, used to follow instances that the file does not number; without them, overlap alone is.
        classes: Names of the classes that may move. None takes everything from files without scores, and people,
            animals and vehicles from COCO results.
        class_names: Class number to name, where the file does not say it and it is not COCO's.
        config: How detections are joined to instances.

    Returns:
        T maps (H, W) int32: 0 static, otherwise the id of an instance.

    Raises:
        InputError: If the form is not known, a file cannot be read, the number or size of masks does not fit the
            images, or a class is unknown.
    """
    if not is_present(path):
        raise SequenceProblem(path, "no such file or folder", "check the path of the masks")
    names = tuple(frame_names) or tuple(f"{frame:05d}" for frame in range(num_frames))
    if not path.is_dir():
        check_regular(path, "a folder of masks or a COCO .json file")
        if path.suffix.lower() != ".json":
            raise SequenceProblem(
                path, "holds no masks that can be read", "give a folder of masks or a COCO .json file"
            )
        content = read_json(path)
        if _is_class_list(content):
            return open_mask_files(
                path.parent, size, num_frames, frame_names, images=images, classes=classes, class_names=class_names
            )  # fmt: skip
        return open_coco_masks(
            path, content, size, names, images, classes, class_names, config or InstanceConfig()
        )  # fmt: skip
    return _open_folder(path, size, names, classes, class_names)


def _is_class_list(content: object) -> bool:
    """Tell whether this is DEVA's list of classes, whose masks are in PNG files beside it."""
    annotations = content.get("annotations") if isinstance(content, dict) else None
    return isinstance(annotations, list) and all(isinstance(a, dict) and "segments_info" in a for a in annotations)


def _open_folder(
    root: Path,
    size: tuple[int, int],
    names: tuple[str, ...],
    classes: tuple[str, ...] | None,
    class_names: dict[int, str] | None,
) -> FrameSource[Int32Array]:
    folder, class_list = root, None
    # The folder may lie deeper: a folder per video, or DEVA's Annotations/.
    while not _holds_masks(folder):
        below = subfolders(folder)
        if below and all(_object_id(f) is not None and _holds_masks(f) for f in below):
            return _without_classes(classes, root, ObjectFolders(below, size, names))
        if (folder / _DEVA_CLASSES).is_file():
            class_list = folder / _DEVA_CLASSES
        known = [f for f in below if f.name in _ANNOTATION_FOLDERS]
        if len(known or below) != 1:
            found = some_of([f.name + "/" for f in below], 3) if below else "no masks"
            raise SequenceProblem(
                root,
                f"holds no masks that can be read: {folder.name}/ holds {found}",
                "give the folder of one video, with one PNG or .npy per frame or one numbered folder per object",
            )
        folder = (known or below)[0]
    paths = _match(root, list_frames(folder, MASK_SUFFIXES), names)
    if classes is None:
        return IdFolder(paths, size)
    beside = folder.parent / _DEVA_CLASSES
    class_list = class_list or (beside if beside.is_file() else None)
    if class_list is None:
        return _without_classes(classes, root, IdFolder(paths, size))
    return IdFolder(paths, size, _deva_ids(class_list, classes, class_names))


def _without_classes(
    classes: tuple[str, ...] | None, root: Path, masks: FrameSource[Int32Array]
) -> FrameSource[Int32Array]:
    if classes is not None:
        raise SequenceProblem(root, "does not say of which class its masks are", "leave out the classes")
    return masks


def _holds_masks(folder: Path) -> bool:
    return any(is_visible_file(p) and p.suffix.lower() in MASK_SUFFIXES for p in list_folder(folder))


def _object_id(folder: Path) -> int | None:
    """Return the number of a folder ``001`` or ``object_1``, None without a positive one."""
    numbers = frame_numbers([folder.name])
    return numbers[0] if numbers and numbers[0] > 0 else None


def _match(root: Path, paths: tuple[Path, ...], names: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the file of every frame: by name if the names agree, else by order."""
    by_stem = {path.stem: path for path in paths}
    if set(names) <= set(by_stem):
        return tuple(by_stem[name] for name in names)
    if len(paths) != len(names):
        missing = [name for name in names if name not in by_stem]
        detail = f" (none for {some_of(missing, 3)})" if len(missing) < len(names) else ""
        raise SequenceProblem(
            root, f"has {len(paths)} masks for {len(names)} images{detail}", "give exactly one per image"
        )
    return paths


def _deva_ids(path: Path, classes: tuple[str, ...], class_names: dict[int, str] | None) -> frozenset[int]:
    """Return the ids whose class may move."""
    if class_names is None:
        raise SequenceProblem(
            path, "numbers its classes without naming them", "give the names in the order of the prompt"
        )
    moving = set(movable_class_ids(class_names, classes).tolist())
    content = read_json(path)
    if not _is_class_list(content):
        raise SequenceProblem(path, "has no 'annotations' with 'segments_info'", "give DEVA's own file")
    assert isinstance(content, dict)
    try:
        segments = [s for annotation in content["annotations"] for s in annotation["segments_info"]]
        return frozenset(int(s["id"]) for s in segments if int(s["category_id"]) in moving)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SequenceProblem(path, "has a segment without id or category_id", "give DEVA's own file") from error


def read_ids(path: Path) -> Int32Array:
    """Read a label map like :func:`~uni4d_fg.frontend.sequence.decode.read_mask`, but a palette PNG by its index.

    Programs that write ids with a palette mean the index; the colors are only for looking at.

    Returns:
        (H, W) int32.

    Raises:
        InputError: If the file cannot be read.
    """
    if path.suffix.lower() == ".png":
        data = read_bytes(path, MAX_IMAGE_BYTES, "a .png file")
        try:
            with Image.open(io.BytesIO(data)) as image:
                if image.mode in ("P", "1") and image.width * image.height <= MAX_PIXELS:
                    return np.asarray(image, np.int32) if image.mode == "P" else np.asarray(image).astype(np.int32)
        except (OSError, SyntaxError, ValueError, UnidentifiedImageError, Image.DecompressionBombError) as error:
            raise SequenceProblem(path, "cannot be decoded as a mask", "replace the file or export it again") from error
    return read_mask(path)


class IdFolder(FileFrames[Int32Array]):
    """One label file per frame.

    Args:
        paths: T files.
        size: (height, width) of the images.
        kept: Ids that may move; None keeps all.
    """

    def __init__(self, paths: tuple[Path, ...], size: tuple[int, int], kept: frozenset[int] | None = None) -> None:
        self.kept = None if kept is None else np.array(sorted(kept), np.int32)
        super().__init__(paths, size)

    def _decode(self, path: Path) -> Int32Array:
        ids = read_ids(path)
        return ids if self.kept is None else np.where(np.isin(ids, self.kept), ids, 0).astype(np.int32)


class ObjectFolders(LazyFrames[Int32Array]):
    """A folder per object with a mask per frame; the number that ends the folder's name is the id.

    Args:
        folders: One per object.
        size: (height, width) of the images.
        names: (T,) stems of the frames. A frame without a file shows nothing of the object.

    Raises:
        InputError: If the files of an object match no frame.
    """

    def __init__(self, folders: list[Path], size: tuple[int, int], names: tuple[str, ...]) -> None:
        self.size = size
        self.length = len(names)
        self.objects: list[tuple[int, dict[int, Path]]] = []
        for folder in folders:
            number = _object_id(folder)
            assert number is not None
            paths = list_frames(folder, MASK_SUFFIXES)
            by_stem = {path.stem: path for path in paths}
            matched = {frame: by_stem[name] for frame, name in enumerate(names) if name in by_stem}
            if not matched:
                matched = dict(enumerate(_match(folder, paths, names)))
            self.objects.append((number, matched))

    def __len__(self) -> int:
        return self.length

    def where(self, frame: int) -> str:
        """Return the files of frame ``frame``."""
        return ", ".join(str(paths[frame]) for _, paths in self.objects if frame in paths) or f"frame {frame}"

    def _read(self, frame: int) -> Int32Array:
        labels = np.zeros(self.size, np.int32)
        # As SAM 2 packs them: where objects overlap, the lower number lies on top.
        for number, paths in sorted(self.objects, key=lambda entry: -entry[0]):
            if frame in paths:
                ids = IdFolder((paths[frame],), self.size)[0]
                labels[ids > 0] = number
        return labels
