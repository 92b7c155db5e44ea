"""Exports as a whole: whole or absent, never over something else, and one clear error."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from uni4d_fg.errors import Cancelled, InputError, OutputError
from uni4d_fg.frontend.sequence.frames import ImageFolder
from uni4d_fg.frontend.sequence.model import ArrayFrames
from uni4d_fg.results.export import export_run
from uni4d_fg.results.export import run as export_module
from uni4d_fg.results.export.frames import frame_names, write_images
from uni4d_fg.results.export.model import Exporter, ExportJob, ExportOptions
from uni4d_fg.results.export.registry import FORMATS
from uni4d_fg.results.run import Run
from uni4d_fg.results.shot_list import Shot, write_shots

Cli = Callable[..., tuple[int, str, str]]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_verb_writes_several_formats_into_the_run(cli: Cli, finished_run: Path) -> None:
    try:
        code, out, err = cli("export", finished_run, "--to", "tum", "--to", "kitti", "--to", "colmap", "--quiet")
        assert (code, err) == (0, "")
        assert names(finished_run / "export") == ["colmap", "kitti", "tum"]
        assert "mean reprojection error" in out
        code, _, err = cli("export", finished_run, "--to", "tum")
        assert code == 6
        assert "--overwrite" in err
        code, out, _ = cli("export", finished_run, "--to", "tum", "--overwrite", "--json")
        assert code == 0
        assert json.loads(out)["tum"]["poses"] == 7
    finally:
        shutil.rmtree(finished_run / "export", ignore_errors=True)


def test_every_format_has_a_name_on_the_command_line() -> None:
    from uni4d_fg.cli.exports import FormatChoice

    assert [choice.value for choice in FormatChoice] == list(FORMATS)


def test_a_moved_sequence_is_asked_for(cli: Cli, finished_run: Path, tmp_path: Path) -> None:
    moved = tmp_path / "run"
    shutil.copytree(finished_run, moved)
    root = finished_run.parent / "room"
    (moved / "summary.json").write_text(json.dumps({"sequence": {"root": str(tmp_path / "gone")}}))
    code, _, err = cli("export", moved, "--to", "colmap", "--quiet")
    assert code == 3
    assert err.count("\n") == 1
    assert "--sequence" in err
    assert str(tmp_path / "gone") in err
    assert not (moved / "export").exists()
    assert cli("export", moved, "--to", "tum", "--quiet")[0] == 0  # needs no images
    assert cli("export", moved, "--to", "colmap", "--sequence", root, "--quiet")[0] == 0


def test_what_is_no_finished_run_is_named(cli: Cli, finished_run: Path, tmp_path: Path) -> None:
    for folder, text in ((tmp_path / "nowhere", "no such folder"), (tmp_path, "holds no run")):
        code, _, err = cli("export", folder, "--to", "tum")
        assert code == 3
        assert text in err
    begun = tmp_path / "begun"
    shutil.copytree(finished_run, begun, ignore=shutil.ignore_patterns("summary.json"))
    code, _, err = cli("export", begun, "--to", "tum")
    assert code == 3
    assert "not finished" in err
    assert "--resume" in err


def test_a_sequence_that_does_not_fit_the_run_is_refused(source: Run, tmp_path: Path) -> None:
    shorter = dataclasses.replace(source.need_sequence(), images=ArrayFrames(np.zeros((3, 96, 128, 3), np.uint8)))
    wrong = Run(source.folder.root, lambda: shorter)
    with pytest.raises(InputError, match=r"has 3 frames .* has 7"):
        export_run(wrong, ["colmap"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unknown_format_is_refused_before_anything_is_written(source: Run, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="colmap"):
        export_run(source, ["tum", "fbx"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_overwrite_touches_nothing_but_exports(source: Run, tmp_path: Path) -> None:
    (tmp_path / "tum").mkdir()
    (tmp_path / "tum" / "precious.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match="is no export"):
            export_run(source, ["kitti", "tum"], tmp_path, overwrite=overwrite)
    assert names(tmp_path) == ["tum"]
    assert names(tmp_path / "tum") == ["precious.txt"]


def test_an_empty_folder_is_filled(source: Run, tmp_path: Path) -> None:
    (tmp_path / "tum").mkdir()
    export_run(source, ["tum"], tmp_path)
    assert names(tmp_path / "tum") == ["export.json", "trajectory.txt"]


def test_a_folder_that_is_in_the_way_is_told_in_words_of_python(source: Run, tmp_path: Path) -> None:
    export_run(source, ["tum"], tmp_path)
    with pytest.raises(OutputError, match=r"replace it with overwrite=True or choose another folder$"):
        export_run(source, ["tum"], tmp_path)


def test_overwriting_leaves_nothing_of_the_old(source: Run, tmp_path: Path) -> None:
    export_run(source, ["colmap"], tmp_path)
    export_run(source, ["colmap"], tmp_path, ExportOptions(text=False), overwrite=True)
    assert "sparse_text" not in names(tmp_path / "colmap")


def test_files_of_others_in_an_export_stay(source: Run, tmp_path: Path) -> None:
    export_run(source, ["colmap"], tmp_path)
    (tmp_path / "colmap" / "mine").write_text("mine")
    with pytest.raises(OutputError, match="holds mine, which is not of the export"):
        export_run(source, ["colmap"], tmp_path, overwrite=True)
    assert (tmp_path / "colmap" / "mine").read_text() == "mine"
    assert names(tmp_path) == ["colmap"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), Cancelled("stop"), ZeroDivisionError()])
def test_a_failure_keeps_the_old_export_and_leaves_no_rest(
    source: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    export_run(source, ["tum"], tmp_path)
    before = (tmp_path / "tum" / "trajectory.txt").read_bytes()

    def fails(job: ExportJob) -> None:
        (job.folder / "half").write_text("written")
        raise error

    monkeypatch.setitem(FORMATS, "tum", Exporter(fails))
    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)):
        export_run(source, ["tum"], tmp_path, overwrite=True)
    assert names(tmp_path) == ["tum"]
    assert (tmp_path / "tum" / "trajectory.txt").read_bytes() == before


def test_an_export_that_cannot_be_moved_into_place_brings_the_old_one_back(
    source: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_run(source, ["tum"], tmp_path)
    replace, calls = export_module.os.replace, []

    def stumbles(a: Path, b: Path) -> None:
        if Path(b) == tmp_path / "tum":
            calls.append(b)
            if len(calls) == 1:
                raise PermissionError(13, "Permission denied")
        replace(a, b)

    monkeypatch.setattr(export_module.os, "replace", stumbles)
    with pytest.raises(OutputError, match="Permission denied"):
        export_run(source, ["tum"], tmp_path, overwrite=True)
    assert names(tmp_path) == ["tum"]
    assert names(tmp_path / "tum") == ["export.json", "trajectory.txt"]


def test_ctrl_c_ends_within_a_frame(source: Run, tmp_path: Path) -> None:
    polled: list[int] = []

    def stop() -> bool:
        polled.append(1)
        return len(polled) > 3

    with pytest.raises(Cancelled):
        export_run(source, ["colmap"], tmp_path / "out", should_stop=stop)
    assert len(polled) == 4
    assert names(tmp_path / "out") == []


def _job(source: Run, folder: Path, images: object, stems: tuple[str, ...]) -> ExportJob:
    sequence = dataclasses.replace(source.need_sequence(), images=images, frame_names=stems)
    return ExportJob(source.with_parts(sequence=sequence), folder)


def test_files_are_copied_only_if_others_see_the_same_pixels(source: Run, tmp_path: Path) -> None:
    rgb = tmp_path / "rgb"
    rgb.mkdir()
    images = list(source.need_sequence().images)
    variants = {1: images[1][:, :, :1], 2: images[2].astype(np.uint16) * 257}  # gray, 16 bits
    paths = []
    for frame, image in enumerate(images):
        paths.append(rgb / f"f{frame}.png")
        cv2.imwrite(str(paths[-1]), variants.get(frame, image)[:, :, ::-1])
    folder = ImageFolder(tuple(paths))
    written = write_images(_job(source, tmp_path, folder, tuple(p.stem for p in paths)), tmp_path / "out")
    assert written == [p.name for p in paths]
    for frame, name in enumerate(written):
        raw = cv2.imread(str(tmp_path / "out" / name), cv2.IMREAD_UNCHANGED)
        assert (raw.dtype, raw.shape) == (np.uint8, images[0].shape)
        np.testing.assert_array_equal(raw[:, :, ::-1], folder[frame])
        assert (tmp_path / "out" / name).read_bytes() == paths[frame].read_bytes() or frame in variants


def test_frames_of_a_video_become_jpegs_named_by_number(source: Run, tmp_path: Path) -> None:
    images = ArrayFrames(np.stack(list(source.need_sequence().images)))
    written = write_images(_job(source, tmp_path, images, ()), tmp_path / "out")
    assert written == [f"{frame:05d}.jpg" for frame in range(source.num_frames)]
    read = cv2.imread(str(tmp_path / "out" / written[2]))[:, :, ::-1]
    assert np.abs(read.astype(float) - images[2]).mean() < 6.0


@pytest.mark.parametrize("stems", [tuple("gfedcba"), tuple("aabcdef"), tuple("abc/efg"), ("a b", *"bcdefg")])
def test_names_that_would_not_sort_or_not_parse_become_numbers(
    source: Run, tmp_path: Path, stems: tuple[str, ...]
) -> None:
    job = _job(source, tmp_path, source.need_sequence().images, stems)
    assert frame_names(job.run)[0] == "00000"


def test_a_run_is_opened_by_its_folder(finished_run: Path, tmp_path: Path) -> None:
    (report,) = export_run(str(finished_run), ["tum"], str(tmp_path / "text"))
    assert report.folder == tmp_path / "text" / "tum"
    export_run(finished_run, ["tum"], tmp_path / "path")
    written = [(tmp_path / name / "tum" / "trajectory.txt").read_bytes() for name in ("text", "path")]
    assert written[0] == written[1]
    with pytest.raises(InputError, match=r"its sequence was not given; open the run with Run\(folder, read_sequence\)"):
        export_run(str(finished_run), ["colmap"], tmp_path / "out")
    with pytest.raises(InputError, match="no such folder"):
        export_run(str(tmp_path / "nosuch"), ["tum"])


def test_shots_of_a_split_run_are_exported_one_by_one(tmp_path: Path) -> None:
    write_shots(tmp_path, [Shot("shots/000", 0, 6, 6)])
    with pytest.raises(InputError, match="a run in several shots; give the folder of one of them"):
        export_run(tmp_path, ["tum"])
