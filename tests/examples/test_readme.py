"""The Python of README runs as it stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import uni4d_fg.factors.terms  # noqa: F401 - what the package declares stays when the test's own goes
from uni4d_fg.config.synthetic import SyntheticSceneConfig
from uni4d_fg.factors import factor_type
from uni4d_fg.frontend.sequence.write import write_native
from uni4d_fg.frontend.synthetic.simulate import make_synthetic_sequence

README = Path(__file__).parents[2] / "README.md"


def test_the_library_examples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = make_synthetic_sequence(SyntheticSceneConfig(num_frames=8, width=200, height=150, focal=188.0))
    write_native(scene, tmp_path / "my_video")
    assert scene.ground_truth is not None
    world_T_cam = scene.ground_truth.world_T_cam
    truth = (np.linalg.inv(world_T_cam[0]) @ world_T_cam)[:, :3, 3]
    np.savetxt(tmp_path / "positions.txt", truth)
    monkeypatch.chdir(tmp_path)
    # What the page declares is gone after the test.
    monkeypatch.setattr(factor_type, "_LISTED", dict(factor_type._LISTED))
    library = README.read_text(encoding="utf-8").split("## As a library\n")[1].split("\n## ")[0]
    blocks = [block.split("```")[0] for block in library.split("```python\n")[1:]]
    assert len(blocks) == 3
    for block in blocks:
        names: dict[str, object] = {"__name__": "readme"}
        exec(compile(block, "README.md", "exec"), names)
        centers = names["result"].world_T_cam[:, :3, 3]  # type: ignore[attr-defined]
        assert np.abs(centers - truth).max() < 0.05
    out = capsys.readouterr().out
    assert "(8, 4, 4)" in out
    assert out.count("\n7 ") == 1
    assert (tmp_path / "runs" / "library" / "pictures" / "scene.png").exists()
