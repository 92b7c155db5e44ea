"""Imports that can fail on a machine without certain system libraries, made to fail with a useful message."""

from __future__ import annotations

import errno
import importlib
import re
from typing import Any

from uni4d_fg.errors import MissingDependencyError

_NO_MEMORY = ("cannot allocate memory", "failed to map segment", "cannot map", "out of memory")
"""What the loader of libraries says then; a system library that is missing, it names."""

_APT_COMMAND = "apt-get install libusb-1.0-0 libgl1 libgomp1"


def _import_extra(name: str, extra: str, needs_it: str) -> Any:
    """Import a package of an extra when it is first needed.

    Raises:
        MissingDependencyError: If the package is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = error.name or name
        command = f"pip install 'uni4d-fg[{extra}]'" if missing == name else f"pip install {missing}"
        raise MissingDependencyError(f"{needs_it} {missing}, not installed: run `{command}`") from error
    except (ImportError, OSError) as error:
        _check_memory(name, error)
        raise MissingDependencyError(f"{name} cannot be loaded ({error}): install it anew") from error


def _check_memory(name: str, error: ImportError | OSError) -> None:
    """Raise MemoryError if a library is there, but there is no memory to load it into."""
    text = str(error).lower()
    if getattr(error, "errno", None) == errno.ENOMEM or any(sign in text for sign in _NO_MEMORY):
        raise MemoryError(f"loading {name}: {error}") from error


def import_torch() -> Any:
    """Return the module ``torch``. Raises MissingDependencyError."""
    return _import_extra("torch", "adam", "the Adam solver needs")


def import_onnxruntime() -> Any:
    """Return the module ``onnxruntime``. Raises MissingDependencyError."""
    return _import_extra("onnxruntime", "cues", "networks need")


def import_viser() -> Any:
    """Return ``viser``, the server of the interactive view. Raises MissingDependencyError."""
    return _import_extra("viser", "view", "the viewer needs")


def import_rerun() -> Any:
    """Return ``rerun``, which writes ``.rrd`` recordings. Raises MissingDependencyError."""
    return _import_extra("rerun", "export", "the format rrd needs")


def import_pygltflib() -> Any:
    """Return ``pygltflib``, which writes glTF scenes. Raises MissingDependencyError."""
    return _import_extra("pygltflib", "export", "the format glb needs")


def import_pooch() -> Any:
    """Return ``pooch``, which downloads files. Raises MissingDependencyError."""
    return _import_extra("pooch", "models", "fetching a model needs")


def import_distributed() -> Any:
    """Return Dask's ``distributed``, which runs tasks in other processes. Raises MissingDependencyError."""
    return _import_extra("distributed", "cluster", "worker processes need")


def import_open3d() -> Any:
    """Import Open3D when it is first needed.

    Returns:
        The ``open3d`` module.

    Raises:
        MissingDependencyError: If the package or a system library that it loads is not installed.
    """
    try:
        return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        if error.name == "open3d":
            raise MissingDependencyError("open3d is not installed: run `pip install 'open3d>=0.19'`") from error
        raise MissingDependencyError(f"open3d needs the Python package {error.name!r}: install it") from error
    except (ImportError, OSError) as error:
        _check_memory("open3d", error)
        library = re.search(r"lib[\w.+-]*\.so[.\d]*", str(error))
        missing = f"the system library {library.group()} is missing" if library else str(error)
        raise MissingDependencyError(f"open3d cannot be loaded, {missing}: run `{_APT_COMMAND}`") from error
