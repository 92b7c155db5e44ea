"""Running an ONNX file, and refusing at once one that is damaged or does not fit its card."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from uni4d_fg.config.networks import NetworkConfig
from uni4d_fg.cues.card import ModelFile
from uni4d_fg.errors import InputError, MissingDependencyError
from uni4d_fg.optim.threads import thread_count
from uni4d_fg.optional import import_onnxruntime

_PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
_ERRORS_ONLY = 3
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}
_CHUNK = 1 << 22


@lru_cache(maxsize=8)
def _sha256(path: Path, size: int, modified: int) -> str:
    return file_sha256(path)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while chunk := stream.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def weights_hash(model: ModelFile) -> str:
    """Return the SHA-256 of an ONNX file, hexadecimal.

    Raises:
        InputError: If it does not exist, cannot be read, or is not the one that the card names.
    """
    path = model.weights
    try:
        state = path.stat()
        found = _sha256(path, state.st_size, state.st_mtime_ns)
    except FileNotFoundError as error:
        looked = " and ".join(str(place) for place in model.searched())
        raise InputError(
            f"card {model.name}: there is no ONNX file of {model.card.title} (looked at {looked}); make it as the card "
            f"says (uni4d-fg doctor --cards), or fetch it if it is published (uni4d-fg models fetch {model.name}); then"
            f" put it there (uni4d-fg models add FILE) or give {model.name}=FILE"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    expected = model.card.sha256
    if expected is not None and found != expected.lower():
        raise InputError(
            f"{path}: SHA-256 is {found}, but card {model.name} expects {expected.lower()}; get the right file, or "
            "change the card"
        )
    return found


class Network:
    """An ONNX file that is loaded and fits its card.

    Args:
        model: Card and file.
        inputs: Tensors that the card speaks of, each with its shape; None where a size is not fixed.
        outputs: Names of the outputs that the card speaks of.
        config: Provider and threads.

    Raises:
        InputError: If the file is missing, damaged, or has other tensors or shapes than the card says.
        MissingDependencyError: If ONNX Runtime, or the provider asked for, is not installed.
    """

    def __init__(
        self,
        model: ModelFile,
        inputs: Mapping[str, tuple[int | None, ...]],
        outputs: tuple[str, ...],
        config: NetworkConfig,
    ) -> None:
        self.model = model
        self.digest = weights_hash(model)
        self.outputs = outputs
        self._session = _open(model, config)
        self._types = self._check_inputs(inputs)
        self._check_outputs()

    def _check_inputs(self, inputs: Mapping[str, tuple[int | None, ...]]) -> dict[str, Any]:
        found = {tensor.name: tensor for tensor in self._session.get_inputs()}
        self._same_names("input", set(inputs), set(found))
        if extra := set(found) - set(inputs):
            raise self._misfit(f"it also needs the input {_listed(extra)}, which the card does not have")
        types = {}
        for name, expected in inputs.items():
            shape = found[name].shape
            fits = len(shape) == len(expected) and all(
                want is None or not isinstance(have, int) or have == want
                for have, want in zip(shape, expected, strict=True)
            )
            if not fits:
                raise self._misfit(
                    f"its input {name!r} has the shape {_shape(shape)}, but by the card it is {_shape(expected)}"
                )
            if found[name].type not in _TYPES:
                raise self._misfit(f"its input {name!r} is a {found[name].type}, which no card can feed")
            types[name] = _TYPES[found[name].type]
        return types

    def _check_outputs(self) -> None:
        found = {tensor.name for tensor in self._session.get_outputs()}
        self._same_names("output", set(self.outputs), found)

    def _same_names(self, what: str, wanted: set[str], found: set[str]) -> None:
        if missing := wanted - found:
            raise self._misfit(f"it has no {what} {_listed(missing)}; its {what}s are {_listed(found)}")

    def _misfit(self, what: str) -> InputError:
        return InputError(
            f"{self.model.weights}: does not fit card {self.model.name} ({self.model.path}): {what}; change the card "
            "or export the network as the card says"
        )

    def run(self, feeds: Mapping[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
        """Run the network once; inputs are brought to the types that it takes.

        Raises:
            InputError: If it cannot be run on such an input.
        """
        typed = {name: np.ascontiguousarray(array, self._types[name]) for name, array in feeds.items()}
        try:
            results = self._session.run(list(self.outputs), typed)
        except Exception as error:  # ONNX Runtime has no common base of its errors
            shapes = ", ".join(f"{name} {array.shape}" for name, array in feeds.items())
            raise self._misfit(f"it cannot be run on {shapes} ({_reason(error)})") from error
        return {name: np.asarray(array) for name, array in zip(self.outputs, results, strict=True)}

    def misfit(self, output: str, shape: tuple[int, ...], expected: str) -> InputError:
        """Return the error of an output whose shape is not the card's."""
        return self._misfit(f"its output {output!r} has the shape {_shape(shape)}, but by the card it is {expected}")


def available_providers() -> list[str]:
    """Return the providers of the installed ONNX Runtime. Raises MissingDependencyError."""
    return list(import_onnxruntime().get_available_providers())


def _open(model: ModelFile, config: NetworkConfig) -> Any:
    runtime = import_onnxruntime()
    provider = _PROVIDERS[config.provider]
    if provider not in runtime.get_available_providers():
        raise MissingDependencyError(
            f"networks.provider is '{config.provider}', but the installed ONNX Runtime lacks {provider}: run "
            "`pip install onnxruntime-gpu`, or set networks.provider to 'cpu'"
        )
    options = runtime.SessionOptions()
    options.intra_op_num_threads = thread_count(config.threads)
    options.inter_op_num_threads = 1
    options.log_severity_level = _ERRORS_ONLY
    chosen = [provider] if provider == _PROVIDERS["cpu"] else [provider, _PROVIDERS["cpu"]]
    try:
        return runtime.InferenceSession(str(model.weights), sess_options=options, providers=chosen)
    except Exception as error:  # ONNX Runtime has no common base of its errors
        raise InputError(
            f"{model.weights}: cannot be loaded as an ONNX network ({_reason(error)}); export or download it again"
        ) from error


def _reason(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 200 else f"{text[:197]}..."


def _listed(names: set[str]) -> str:
    return ", ".join(repr(name) for name in sorted(names)) or "none"


def _shape(shape: Any) -> str:
    return "(" + ", ".join(str(size) if isinstance(size, int) else "any" for size in shape) + ")"
