"""What the surroundings can do to a process at any time, as errors of this package: no space, no rights, no memory."""

from __future__ import annotations

import contextlib
import errno
import os
import sys

from uni4d_fg.errors import Cancelled, InputError, OutputError, Uni4dFgError
from uni4d_fg.reading import read_failure

_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
_NO_MORE = (errno.EMFILE, errno.ENFILE, errno.EAGAIN, errno.ENOMEM)
_BROKEN_OUTPUT = "standard output cannot be written ({reason}); give it somewhere to go"


def known_error(error: BaseException) -> Uni4dFgError | None:
    """Return an error of the surroundings as one of this package, None if it is a mistake of the program."""
    if isinstance(error, Uni4dFgError):
        return error
    if isinstance(error, KeyboardInterrupt):
        return Cancelled("aborted; what was finished before is on disk")
    if isinstance(error, MemoryError):
        return InputError(
            f"there is not enough memory ({error or 'the machine gives no more'}); free some, or use --max-size, "
            "--stride or --window"
        )
    if isinstance(error, OSError):
        return _of_system(error)
    if isinstance(error, UnicodeEncodeError | UnicodeDecodeError):
        return InputError(f"a file name or text is not UTF-8 ({error.reason}), and cannot be written down; rename it")
    return None


def _of_system(error: OSError) -> Uni4dFgError:
    reason = error.strerror or str(error) or type(error).__name__
    if error.errno in _NO_MORE:
        return OutputError(f"the system gives no more to this process ({reason}); close other programs")
    if error.filename is None:
        if error.errno == errno.ENOENT:
            return InputError("the working directory no longer exists; change to another one")
        return OutputError(_BROKEN_OUTPUT.format(reason=reason))
    name = os.fsdecode(error.filename) if isinstance(error.filename, bytes) else str(error.filename)
    if error.errno in _NO_SPACE:
        return OutputError(f"cannot write {name}: {reason}; free space or choose another --out")
    return read_failure(name, error)


def finish(code: int) -> int:
    """Flush standard output and return the exit code: of a run whose output was lost, that of an output error."""
    try:
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()
    except (OSError, ValueError) as error:
        _to_nowhere()
        if code == 0:
            code = OutputError.exit_code
            with contextlib.suppress(OSError, ValueError, AttributeError):
                reason = getattr(error, "strerror", None) or str(error)
                print(f"error: {_BROKEN_OUTPUT.format(reason=reason)}", file=sys.stderr)
    return code


def _to_nowhere() -> None:
    """Keep the interpreter from flushing standard output once more at its end, with a traceback."""
    with contextlib.suppress(OSError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.close(null)
