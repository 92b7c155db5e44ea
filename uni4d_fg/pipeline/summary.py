"""The report of a run: what every stage did, what was dropped and why, what to distrust."""

from __future__ import annotations

import platform
import resource
import sys
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from uni4d_fg.counted import counted
from uni4d_fg.optim.summary import SolveSummary

_MAX_CURVE_POINTS = 200


@dataclass
class RunSummary:
    """Everything ``summary.json`` holds."""

    sequence: dict[str, Any]
    """Name, root, frames, image size."""
    solver: dict[str, str] = field(default_factory=dict)
    """Minimizer, its backend, and a hint at a faster one."""
    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Per stage: seconds, peak memory, whether it was resumed, solves, dropped counts."""
    warnings: list[str] = field(default_factory=list)
    """What to distrust, one sentence each."""
    cues: dict[str, Any] = field(default_factory=dict)
    """Where cues came from that the video did not bring: ``sources``, ``facts``, ``warnings``, ``metric``."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "sequence": self.sequence,
            "solver": self.solver,
            **({"cues": self.cues} if self.cues else {}),
            "stages": self.stages,
            "warnings": self.warnings,
            "versions": versions(),
        }

    def lines(self) -> list[str]:
        """Return one screen of text."""
        out = [f"{self.sequence['name']}: {self.sequence['num_frames']} frames"]
        if self.cues:
            sources = "; ".join(f"{cue} {source}" for cue, source in self.cues["sources"].items())
            seconds = self.cues.get("seconds", 0.0)
            out.append(f"cues: {sources}" + (f"; {seconds:.1f} s" if seconds else ""))
            out += [f"    {text}" for text in self.cues["facts"]]
        for name, stage in self.stages.items():
            resumed = " (resumed)" if stage.get("resumed") else ""
            out.append(f"{name}{resumed}: {stage.get('seconds', 0.0):.1f} s, {stage.get('peak_memory_mb', 0):.0f} MB")
            for solve in stage.get("solves", [])[-1:]:
                out.append(
                    f"    energy {solve['initial_energy']:.4g} -> {solve['final_energy']:.4g} in "
                    f"{counted(solve['num_iterations'], 'iteration')}, {solve['termination']}"
                )
            out += [f"    {text}" for text in stage.get("facts", [])]
            dropped = {reason: n for reason, n in stage.get("dropped", {}).items() if n}
            out += [f"    dropped: {n} x {reason}" for reason, n in dropped.items()]
        if "backend" in self.solver:
            out.append(f"backend: {self.solver['backend']}")
        if "hint" in self.solver:
            out.append(f"note: {self.solver['hint']}")
        out += [f"warning: {text}" for text in self.warnings]
        return out


def solve_dict(summary: SolveSummary) -> dict[str, Any]:
    """Return a solve's summary with its iteration log reduced to some ``[iteration, energy]`` pairs.

    The energies are those that the solve worked on: while a warm-up lasts, not those of its end.
    """
    data = summary.to_dict()
    count = len(data.pop("iterations"))
    data["num_iterations"] = count
    step = max(1, -(-count // _MAX_CURVE_POINTS))
    kept = sorted({*range(0, count, step), *range(max(count - 1, 0), count)})
    data["energy_curve"] = [[index + 1, summary.iterations[index].energy] for index in kept]
    return data


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0 * 1024.0) if sys.platform == "darwin" else peak / 1024.0


def versions() -> dict[str, str]:
    """Return the versions a result depends on."""
    out = {"python": platform.python_version()}
    for package in ("uni4d-fg", "uni4d-fg-cpp", "gtsam", "numpy", "scipy", "opencv-python-headless", "open3d", "torch"):
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = "not installed"
    return out
