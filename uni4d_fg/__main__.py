"""``python -m uni4d_fg``: the command line, where ``uni4d-fg`` is not on the path."""

from __future__ import annotations

from uni4d_fg.cli.entry import main

if __name__ == "__main__":
    main()
