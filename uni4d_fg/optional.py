"""Imports that can fail on a machine without certain system libraries, made to fail with a useful message."""

from __future__ import annotations

import importlib
import re
from typing import Any

from uni4d_fg.errors import MissingDependencyError

_APT_COMMAND = "apt-get install libusb-1.0-0 libgl1 libgomp1"


def import_torch() -> Any:
    """Import PyTorch when it is first needed.

    Returns:
        The ``torch`` module.

    Raises:
        MissingDependencyError: If the package is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("torch")
    except ModuleNotFoundError as error:
        missing = error.name or "torch"
        command = "pip install 'uni4d-fg[adam]'" if missing == "torch" else f"pip install {missing}"
        raise MissingDependencyError(f"the Adam solver needs {missing}, not installed: run `{command}`") from error
    except (ImportError, OSError) as error:
        raise MissingDependencyError(f"torch cannot be loaded ({error}): install it anew") from error


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
        library = re.search(r"lib[\w.+-]*\.so[.\d]*", str(error))
        missing = f"the system library {library.group()} is missing" if library else str(error)
        raise MissingDependencyError(f"open3d cannot be loaded, {missing}: run `{_APT_COMMAND}`") from error


def import_onnxruntime() -> Any:
    """Import ONNX Runtime when it is first needed.

    Returns:
        The ``onnxruntime`` module.

    Raises:
        MissingDependencyError: If the package is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("onnxruntime")
    except ModuleNotFoundError as error:
        missing = error.name or "onnxruntime"
        command = "pip install 'uni4d-fg[cues]'" if missing == "onnxruntime" else f"pip install {missing}"
        raise MissingDependencyError(f"networks need {missing}, which is not installed: run `{command}`") from error
    except (ImportError, OSError) as error:
        raise MissingDependencyError(f"onnxruntime cannot be loaded ({error}): install it anew") from error


def import_viser() -> Any:
    """Import viser, the server of the interactive view, when it is first needed.

    Returns:
        The ``viser`` module.

    Raises:
        MissingDependencyError: If the package is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("viser")
    except ModuleNotFoundError as error:
        missing = error.name or "viser"
        command = "pip install 'uni4d-fg[view]'" if missing == "viser" else f"pip install {missing}"
        raise MissingDependencyError(f"the viewer needs {missing}, not installed: run `{command}`") from error
    except (ImportError, OSError) as error:
        raise MissingDependencyError(f"viser cannot be loaded ({error}): install it anew") from error


def import_rerun() -> Any:
    """Import rerun, which writes ``.rrd`` recordings, when it is first needed.

    Returns:
        The ``rerun`` module.

    Raises:
        MissingDependencyError: If the package is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("rerun")
    except ModuleNotFoundError as error:
        missing = error.name or "rerun"
        command = "pip install 'uni4d-fg[export]'" if missing == "rerun" else f"pip install {missing}"
        raise MissingDependencyError(f"the format rrd needs {missing}, not installed: run `{command}`") from error
    except (ImportError, OSError) as error:
        raise MissingDependencyError(f"rerun cannot be loaded ({error}): install it anew") from error
