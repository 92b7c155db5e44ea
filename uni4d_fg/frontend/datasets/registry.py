"""All datasets by name."""

from __future__ import annotations

from uni4d_fg.errors import ConfigError
from uni4d_fg.frontend.datasets.base import Dataset
from uni4d_fg.frontend.datasets.bonn import Bonn
from uni4d_fg.frontend.datasets.davis import Davis
from uni4d_fg.frontend.datasets.kitti import KittiDepth
from uni4d_fg.frontend.datasets.native import SequenceFolders
from uni4d_fg.frontend.datasets.sintel import Sintel
from uni4d_fg.frontend.datasets.synthetic import SyntheticSeries
from uni4d_fg.frontend.datasets.tum import TumDynamics

DATASETS: dict[str, Dataset] = {
    dataset.card.name: dataset
    for dataset in (
        Sintel("final"), Sintel("clean"), TumDynamics(), Bonn("rows"), Bonn("times"), KittiDepth(), Davis(),
        SequenceFolders(), SequenceFolders("uni4d"), SyntheticSeries(),
    )
}  # fmt: skip


def find_dataset(name: str) -> Dataset:
    """Return a dataset by its name. Raises ConfigError if there is none of that name."""
    if name not in DATASETS:
        raise ConfigError(f"there is no dataset {name!r}; choose one of {', '.join(DATASETS)}")
    return DATASETS[name]
