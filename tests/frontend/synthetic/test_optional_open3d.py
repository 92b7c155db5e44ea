import importlib

import pytest

from uni4d_fg.errors import MissingDependencyError
from uni4d_fg.optional import import_open3d


def test_open3d_is_imported() -> None:
    assert hasattr(import_open3d(), "t")


@pytest.mark.parametrize(
    ("fault", "hint"),
    [
        (
            ImportError("libusb-1.0.so.0: cannot open shared object file: No such file or directory"),
            r"libusb-1\.0\.so\.0 is missing: run `apt-get install libusb-1\.0-0 libgl1 libgomp1`",
        ),
        (OSError("libGL.so.1: cannot open shared object file"), r"libGL\.so\.1 is missing.*apt-get install"),
        (ModuleNotFoundError("No module named 'open3d'", name="open3d"), r"pip install 'open3d>=0\.19'"),
        (ModuleNotFoundError("No module named 'dash'", name="dash"), "'dash'"),
    ],
)
def test_a_failed_import_names_what_to_install(monkeypatch: pytest.MonkeyPatch, fault: Exception, hint: str) -> None:
    def fail(name: str) -> None:
        raise fault

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(MissingDependencyError, match=hint):
        import_open3d()
